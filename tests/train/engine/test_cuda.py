"""Training on a GPU, with gsplat as the renderer; skipped where torch finds none."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_serve.scene import InvalidInput
from msdgs_train.engine.run import fit
from msdgs_train.gaussians.model import PosedGaussians
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.rendering import rasterize as rasterize_module
from msdgs_train.rendering.rasterize import rasterize
from tests.support.scenes import FIELDS, random_scene
from tests.support.tolerances import assert_close, tolerance
from tests.support.training_scene import MODELS, StopAfter, small_config

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")
GAUSSIANS, CAMERA = random_scene(0, 400, 96, 64)


def drawn(device: str, weights: Tensor) -> dict[str, np.ndarray]:
    """Image, alpha, and gradients of a weighted sum of both."""
    arrays = {name: getattr(GAUSSIANS, name) for name in FIELDS}
    tensors = {name: torch.tensor(array, device=device, requires_grad=True) for name, array in arrays.items()}
    parameters = PosedGaussians(**tensors)
    posed = parameters._replace(quats=torch.nn.functional.normalize(parameters.quats, dim=1))
    rgb, alpha, info = rasterize(*posed, CAMERA, torch.tensor([0.2, 0.6, 0.9]))
    values = torch.cat([rgb, alpha[:, :, None]], dim=2)
    grads = torch.autograd.grad((values * weights.to(device)).sum(), parameters)
    assert info.means2d_grads is not None
    named = dict(zip(FIELDS, grads, strict=True))
    named |= {"means2d": info.means2d_grads, "rgb": rgb, "alpha": alpha}
    return {name: tensor.detach().cpu().numpy() for name, tensor in named.items()}


@needs_gpu
def test_gpu_and_cpu_draw_the_same_image_and_gradients() -> None:
    weights = torch.randn(CAMERA.height, CAMERA.width, 4, generator=torch.Generator().manual_seed(0))
    on_cpu, on_gpu = drawn("cpu", weights), drawn("cuda", weights)
    for name in ("rgb", "alpha"):
        assert_close(on_gpu.pop(name), on_cpu.pop(name), "cuda.pixel")
    for name, expected in on_cpu.items():
        error = np.abs(on_gpu[name] - expected).max() / np.abs(expected).max()
        assert error < tolerance("cuda.gradient"), name


@needs_gpu
@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("strategy", ["gradient", "mcmc"])
def test_run_goes_on_from_gpu_to_cpu(name: str, strategy: str, data: Path, tmp_path: Path) -> None:
    config = small_config(model=MODELS[name], density_strategy=strategy, alpha_weight=0.1, device="cuda")
    stopped = fit(config, data, tmp_path / "run", observer=StopAfter(14))
    assert stopped.status == "interrupted"
    finished = fit(config.updated(device="cpu"), data, tmp_path / "run", resume=True)
    assert finished.status == "finished"
    assert finished.step == config.run.steps
    whole = fit(config, data, tmp_path / "whole")
    assert whole.metrics.keys() == finished.metrics.keys()
    for run in ("run", "whole"):
        assert load_model(tmp_path / run / "model.pt").model.gaussians.means.device.type == "cpu"


def test_machine_without_gpu_or_gsplat_is_named(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InvalidInput, match="torch finds no GPU"):
        fit(small_config(device="cuda"), data, tmp_path / "run")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(rasterize_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InvalidInput, match="pip install gsplat"):
        fit(small_config(device="cuda"), data, tmp_path / "run")
    assert not (tmp_path / "run").exists()
