"""The reader of scene files: times, ids, threads and memory."""

import hashlib
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_export.bake import bake
from msdgs_export.importers.scene import static_scene
from msdgs_export.importers.splats.base import Splats
from msdgs_export.plans.registry import build
from msdgs_serve import deformation
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import CONSTANT_OUTPUTS
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo
from tests.support.models import MLP, random_model
from tests.support.processes import run_python
from tests.support.scene_files import write_scene
from tests.support.splat_files import some_gaussians
from tests.support.tolerances import tolerance


def written(path: Path, model: DynamicGaussians, **scene: Any) -> Path:
    path.write_bytes(build("network", bake(model, SceneInfo(**scene), "0" * 64)).SerializeToString())
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("scene") / "scene.onnx", random_model(1000))


@pytest.fixture(scope="module")
def session(path: Path) -> DeformationSession:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deformation, "CHUNK", 128)
        return DeformationSession(path)


def test_all_moving_gaussians_by_default(session: DeformationSession):
    means, quats, scales = session.pose(0.5)
    assert (means.shape, quats.shape, scales.shape) == ((1000, 3), (1000, 4), (1000, 3))
    gaussians = session.gaussians(0.5).validate()
    assert (len(gaussians), gaussians.sh_degree) == (1000, 3)
    assert np.array_equal(gaussians.means, means)


def test_a_scene_file_may_come_from_a_pipe(path: Path, tmp_path: Path):
    pipe = tmp_path / "scene.onnx"
    os.mkfifo(pipe)
    with ThreadPoolExecutor(1) as pool:
        written = pool.submit(pipe.write_bytes, path.read_bytes())
        session = DeformationSession(pipe)
        assert written.result() == path.stat().st_size
    assert session.scene.moving_count == 1000


def test_moving_gaussians_come_first_then_static_ones(tmp_path: Path):
    session = DeformationSession(write_scene(tmp_path / "scene.onnx"))
    assert (session.scene.moving_count, session.scene.static_count) == (1, 1)
    for t in (0.0, 0.25, 1.0):
        assert np.allclose(session.gaussians(t).means, [[0, 0, 2 * t - 1], [0, 0, 0]])


@pytest.mark.parametrize("ids", [[], [3], [999, 0, 5, 5], list(range(999, -1, -1))])
def test_ids_come_back_in_their_order(session: DeformationSession, ids: list[int]):
    for some, every in zip(session.pose(0.5, ids), session.pose(0.5), strict=True):
        assert some.shape == every[ids].shape
        # the order of sums in a product may depend on the length of the chunk
        assert np.abs(some - every[ids]).max(initial=0) <= tolerance("export.relative")


def test_layers_may_be_applied_one_after_the_other(tmp_path: Path):
    model = random_model(200, layers=("mlp", "plane", "mlp"))
    session = DeformationSession(written(tmp_path / "scene.onnx", model))
    assert session.max_steps == 3
    for steps in range(4):
        with torch.no_grad():
            want = model.pose(0.37, num_layers=steps)
        got = dict(zip(("means", "quats", "scales"), session.pose(0.37, steps=steps), strict=True))
        for part, values in got.items():
            assert np.abs(values - getattr(want, part).detach().numpy()).max() <= tolerance("export.relative")
    for part, every in zip(session.pose(0.37, steps=3), session.pose(0.37), strict=True):
        assert np.array_equal(part, every)


def test_a_layer_may_be_applied_in_part(tmp_path: Path):
    session = DeformationSession(written(tmp_path / "scene.onnx", random_model(200, layers=("mlp", "mlp"))))
    start, first = (session.pose(0.37, steps=steps)[0] for steps in (0, 1))
    assert np.abs(first - start).max() > 10 * tolerance("export.relative")
    part = session.pose(0.37, steps=0.25)[0]
    assert np.abs(part - (start + 0.25 * (first - start))).max() <= tolerance("export.relative")


OUTSIDE = (-0.001, 2.001, float("nan"), float("inf"))


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        *(({"t": t}, r"`t` must be in the scene's range \[0.0, 1.0\]") for t in OUTSIDE),
        *(({"steps": steps}, r"`steps` must be in \[0, 2\], the scene's layers") for steps in OUTSIDE),
        *(({"ids": ids}, "ids") for ids in ([-1], [1000], [0.5], [[1]], ["a"], 3)),
    ],
)
def test_invalid_times_ids_and_steps_are_refused(session: DeformationSession, asked: dict[str, Any], message: str):
    with pytest.raises(InvalidInput, match=message):
        session.pose(**{"t": 0.5, **asked})
    if "ids" not in asked:
        with pytest.raises(InvalidInput, match=message):
            session.gaussians(**{"t": 0.5, **asked})


@pytest.mark.parametrize("steps", [0.0, 1.0, float("nan")])
def test_a_scene_without_layers_has_no_steps(tmp_path: Path, steps: float):
    session = DeformationSession(write_scene(tmp_path / "scene.onnx"))
    assert session.max_steps == 0
    with pytest.raises(InvalidInput, match="`steps` must be left out, as the plan network runs no layers"):
        session.pose(0.5, steps=steps)


def test_the_scene_has_its_own_range_of_times(tmp_path: Path):
    session = DeformationSession(written(tmp_path / "scene.onnx", random_model(9), time_range=(0.2, 0.6)))
    session.pose(0.2)
    session.pose(0.6)
    with pytest.raises(InvalidInput, match="t"):
        session.pose(0.1)


def test_the_same_bits_for_any_number_of_threads(session: DeformationSession, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MSDGS_THREADS", "2")
    parallel = session.pose(0.7)
    monkeypatch.setenv("MSDGS_THREADS", "1")
    for one, two in zip(session.pose(0.7), parallel, strict=True):
        assert one.tobytes() == two.tobytes()


def test_several_callers_at_once(session: DeformationSession):
    times = np.linspace(0, 1, 12).tolist()
    alone = [session.pose(t)[0].tobytes() for t in times]
    with ThreadPoolExecutor(4) as callers:
        together = list(callers.map(lambda t: session.pose(t)[0].tobytes(), times))
    assert together == alone


POSE = """
import sys
from msdgs_serve.deformation import DeformationSession
from tests.support.memory import measured

session = DeformationSession(sys.argv[1])
session.pose(0.5, range(2 * 2048))  # compiles kernels and fills caches
print(measured(lambda: session.pose(0.5))[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from Linux's /proc")
def test_memory_does_not_grow_with_gaussians_times_width(tmp_path: Path):
    count, width = 60_000, 256
    model = random_model(1, layers=(replace(MLP, width=width),), sh_degree=0, embedding_dim=0)
    for name, parameter in list(model.gaussians.named_parameters()):
        setattr(
            model.gaussians, name, torch.nn.Parameter(parameter.detach().repeat(count, *[1] * (parameter.ndim - 1)))
        )
    path = written(tmp_path / "scene.onnx", model)
    grown_mb = float(run_python(POSE, path))  # alone in its process: other work there would count
    activation_mb = count * width * 4 / 2**20
    outputs_mb = count * 10 * 4 / 2**20
    assert grown_mb < outputs_mb + 0.25 * activation_mb


@pytest.mark.parametrize("shift", range(4))
def test_arrays_at_any_place_of_a_file_are_aligned_in_its_memory(tmp_path: Path, shift: int):
    model = static_scene(Splats(some_gaussians(500, 1)), "0" * 64)
    model.graph.name = "x" * (1 + shift)
    contents = model.SerializeToString()
    (tmp_path / "scene.onnx").write_bytes(contents)
    found = DeformationSession(tmp_path / "scene.onnx")
    copied = DeformationSession("scene.onnx", contents=contents)
    assert found.sha256 == copied.sha256 == hashlib.sha256(contents).hexdigest()
    for name in CONSTANT_OUTPUTS:
        array, expected = getattr(found.scene, name), getattr(copied.scene, name)
        np.testing.assert_array_equal(array, expected, strict=True)
        assert array.flags.carray
        assert not array.flags.owndata
        assert expected.flags.owndata
    assert contents == model.SerializeToString()
