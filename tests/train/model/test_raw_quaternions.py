"""Quaternions that keep their length after deltas: what they draw, and the unit quaternions and scales of the same."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_train.gaussians.raw_quaternions import unit_form
from msdgs_train.rendering.rasterize import rasterize
from msdgs_train.supports.nodes import NodesConfig
from tests.support.models import random_model
from tests.support.scenes import FIELDS, front_camera, random_scene
from tests.support.tolerances import assert_close, tolerance
from tests.support.training_scene import MLP
from tests.support.without_kernels import switch_kernels_off


def covariances(quats: Tensor, scales: Tensor) -> np.ndarray:
    """R S S R transposed, with the matrix of a unit quaternion whatever the length, in float64."""
    halves = to_matrix(quats.double().numpy()) * scales.double().numpy()[:, None]
    return halves @ halves.transpose(0, 2, 1)


@pytest.mark.parametrize(("low", "high"), [(0.999, 1.001), (0.5, 1.5), (0.05, 3.0)])
@pytest.mark.parametrize("stretch", [0.0, 0.5, 3.0], ids=["balls", "ellipsoids", "needles"])
def test_the_unit_form_is_the_same_ellipsoid(low: float, high: float, stretch: float) -> None:
    generator = torch.Generator().manual_seed(0)
    quats = torch.nn.functional.normalize(torch.randn(500, 4, generator=generator, dtype=torch.float64), dim=1)
    quats = quats * (low + (high - low) * torch.rand(500, 1, generator=generator))
    scales = torch.exp(stretch * torch.randn(500, 3, generator=generator, dtype=torch.float64))
    expected, found = covariances(quats, scales), covariances(*unit_form(quats, scales))
    sizes = np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert float((np.abs(found - expected) / sizes).max()) <= tolerance("rotation")
    lengths = torch.linalg.vector_norm(unit_form(quats, scales)[0], dim=1)
    assert float((lengths - 1).abs().max()) <= tolerance("rotation")


def test_unit_quaternions_keep_their_directions() -> None:
    quats = torch.nn.functional.normalize(torch.randn(50, 4, generator=torch.Generator().manual_seed(1)), dim=1)
    scales = torch.tensor([0.1, 0.2, 0.3]).repeat(50, 1)
    found, lengths = unit_form(quats, scales)
    assert float(((found * quats).sum(dim=1).abs() - 1).abs().max()) <= tolerance("float32.relative")
    assert float((lengths / scales - 1).abs().max()) <= tolerance("float32.relative")


def test_training_and_evaluation_draw_the_same() -> None:
    """A training step draws quaternions as they are, everything else their unit form."""
    model = random_model(
        60, noise=0.3, layers=(MLP, MLP), scale_space="linear", quat_space="raw", embedding_dim=0
    ).double()
    raw = model.pose(0.4)
    with torch.no_grad():
        unit = model.pose(0.4)
    norms = torch.linalg.vector_norm(raw.quats.detach(), dim=1)
    assert float((norms - 1).abs().max()) > 0.05
    assert float((torch.linalg.vector_norm(unit.quats, dim=1) - 1).abs().max()) <= tolerance("rotation")
    camera = front_camera()
    frames = [rasterize(*posed, camera, torch.zeros(3).double())[0].detach() for posed in (raw, unit)]
    assert float(frames[0].std()) > 0.01
    assert float((frames[0] - frames[1]).abs().max()) <= tolerance("rgb.float64")
    scaled = dataclasses.replace(model.config, quat_space="unit")
    model.config = scaled
    other = rasterize(*model.pose(0.4), camera, torch.zeros(3).double())[0].detach()
    assert float((other - frames[0]).abs().max()) > 0.01, "lengths matter"


@pytest.mark.parametrize("stretch", [0.0, 1.0], ids=["balls", "ellipsoids"])
@pytest.mark.parametrize("absolute", [False, True], ids=["sums", "absolute"])
def test_a_gpu_draws_them_by_covariances(stretch: float, absolute: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same image as the kernels, and the same gradients."""
    gaussians, camera = random_scene(0, 200)
    given = {name: torch.from_numpy(getattr(gaussians, name)) for name in FIELDS}
    given["scales"] = 0.1 * (given["scales"] / 0.1) ** stretch
    given["quats"] = torch.linspace(0.7, 1.3, len(given["quats"]))[:, None] * given["quats"]
    weights = torch.randn(camera.height, camera.width, 4, generator=torch.Generator().manual_seed(0))

    def drawn() -> dict[str, Tensor]:
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in given.items()}
        rgb, alpha, info = rasterize(
            *leaves.values(),
            camera=camera,
            background=torch.tensor([0.2, 0.6, 0.9]),
            absolute_gradients=absolute,
            raw_quats=True,
        )
        (torch.cat([rgb, alpha[..., None]], dim=2) * weights).sum().backward()
        assert info.means2d_grads is not None
        found = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
        return found | {"means2d": info.means2d_grads, "rgb": rgb.detach(), "alpha": alpha.detach()}

    want = drawn()
    switch_kernels_off(monkeypatch)
    got = drawn()
    assert got.keys() == want.keys() == {*FIELDS, "means2d", "rgb", "alpha"}
    for name in ("rgb", "alpha"):
        assert_close(got.pop(name).numpy(), want.pop(name).numpy(), f"{name}.float32")
    for name, gradients in want.items():
        error = float((got[name] - gradients).abs().max() / gradients.abs().max())
        assert error <= tolerance("gradient.float32"), name


def test_nodes_have_unit_quaternions() -> None:
    with pytest.raises(InvalidInput, match=r"`model\.quat_space` must be unit with nodes"):
        random_model(10, support=NodesConfig(num_nodes=2), quat_space="raw")
