"""HexPlane-Slim and TiNeuVox against vectors of their own repositories, and their published sizes.

The vectors are those of `tests/support/volume_references.py`.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from msdgs_train.datasets.rays import Rays
from msdgs_train.engine.masked_adam import MaskedAdam
from msdgs_train.volumes import tineuvox as tineuvox_module
from msdgs_train.volumes.field import RayField
from msdgs_train.volumes.hexplane import HexPlane, HexPlaneConfig
from msdgs_train.volumes.march import march
from msdgs_train.volumes.space import Box
from msdgs_train.volumes.tineuvox import TiNeuVoxConfig
from tests.support.tolerances import assert_close
from tests.support.volume_references import (
    GROWN_AFTER,
    HEX_NAMES,
    HEX_SIZES,
    STEPS,
    TINEUVOX_NAMES,
    VOXELS,
    kept,
    scene_of_rays,
    seeded,
)

BETAS, EPS = (0.9, 0.99), 1e-8
WHITE = (1.0, 1.0, 1.0)
Vectors = dict[str, np.ndarray]


def vectors(name: str) -> Vectors:
    with np.load(Path(__file__).parent / f"{name}.npz") as stored:
        return dict(stored)


def load_seeded(field: RayField, names: dict[str, str]) -> None:
    state = seeded({name: tuple(field.get_parameter(name).shape) for name in names})
    field.load_grown({**field.state_dict(), **state})


class Loop(NamedTuple):
    """What differs between the loops of the two, and hardly matters in a run."""

    steps: int  # of a whole run
    is_late: bool  # whether rates follow a step late, and are whole after a restart
    eps_before: bool  # whether Adam's ε is added before its bias is corrected, as in masked groups

    def rate_step(self, step: int, started: int) -> int:
        return step if not self.is_late else max(step - 1, 0) if step > started else 0

    def eps(self, taken: int) -> float:
        return EPS / math.sqrt(1 - BETAS[1] ** taken) if self.eps_before else EPS


def follow(field: RayField, want: Vectors, loop: Loop, changes: dict[int, Callable[[], None]]) -> None:
    """Take the steps of the vectors, and compare."""
    scene, white = scene_of_rays(), torch.tensor(WHITE)
    rays = Rays(scene.origins, scene.directions, scene.times)
    with torch.no_grad():
        assert_close(march(field, rays, white).rgb, want["rgb.0"], "volume.forward")
    generator, optimizer, started = torch.Generator().manual_seed(0), None, 0
    for step in range(STEPS):
        before = {id(parameter) for parameter in field.parameters()}
        changes.get(step, lambda: None)()
        if {id(parameter) for parameter in field.parameters()} != before:
            optimizer, started = None, step
        groups = [
            g._asdict() | {"lr": g.lr.init} for g in field.parameter_groups(loop.rate_step(step, started) / loop.steps)
        ]
        optimizer = optimizer or MaskedAdam(groups, betas=BETAS)
        for mine, group in zip(optimizer.param_groups, groups, strict=True):
            mine["lr"], mine["eps"] = group["lr"], EPS if group["skips_zero"] else loop.eps(step - started + 1)
        marched = march(field, rays, white, generator)
        loss = (marched.rgb - scene.rgb).square().mean() + field.regularizers(marched, scene.rgb, step / loop.steps)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        assert_close(march(field, rays, white).rgb, want["rgb.last"], "volume.trained")
    compared = [name for name in want if name.startswith("state.")]
    assert len(compared) == len(list(field.parameters()))
    for name in compared:
        assert_close(kept(field.get_parameter(name.removeprefix("state."))), want[name], "volume.trained")


@pytest.fixture
def in_float64() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def hexplane(**sizes: int) -> HexPlane:
    return HexPlane(HexPlaneConfig(near=2.0, far=6.0, **sizes), Box(torch.full((3,), -1.5), torch.full((3,), 1.5)))


@pytest.mark.usefixtures("in_float64")
def test_hexplane_as_its_repository() -> None:
    (n, times), (grown, grown_times) = HEX_SIZES
    want, field = (
        vectors("hexplane"),
        hexplane(first_voxels=n**3, voxels=grown**3, first_times=times, times=grown_times),
    )
    load_seeded(field, HEX_NAMES)
    changes = {GROWN_AFTER: lambda: field.grow(grown, grown_times), GROWN_AFTER + 1: field.mask}
    follow(field, want, Loop(25_000, is_late=True, eps_before=False), changes)
    assert field.cells is not None
    assert 0 < want["empty"] < 1, "the mask hides some"
    assert 0 < float(field.cells.double().mean()) < 1


@pytest.mark.usefixtures("in_float64")
def test_tineuvox_as_its_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tineuvox_module, "GROWS_AT", (GROWN_AFTER / 20_000,))
    want = vectors("tineuvox")
    field = TiNeuVoxConfig(voxels=VOXELS, near=2.0, far=6.0).build(Box(*torch.from_numpy(want["box"])))
    load_seeded(field, TINEUVOX_NAMES)
    scene = scene_of_rays()
    with torch.no_grad():
        left = march(field, Rays(scene.origins, scene.directions, scene.times), torch.tensor(WHITE)).left
    assert 0 < float((left < field.stop).double().mean()) < 1, "some rays end within the volume"
    follow(field, want, Loop(20_000, is_late=False, eps_before=True), {GROWN_AFTER: lambda: field.grow(1)})


def count(field: RayField) -> int:
    return sum(parameter.numel() for parameter in field.parameters())


def test_published_numbers_of_parameters() -> None:
    field = hexplane()
    assert count(field) == 1_146_107
    assert field.config.resolutions() == [(64, 16), (93, 18), (136, 21), (200, 24)]
    field.grow(*field.config.resolutions()[-1])
    assert count(field) == 9_716_987
    box = Box(-torch.ones(3), torch.ones(3))
    for width, channels, wanted in ((64, 4, 28_667), (256, 6, 252_837)):
        volume = TiNeuVoxConfig(voxels=64, width=width, channels=channels).build(box)
        assert count(volume) - volume.grid.numel() == wanted
