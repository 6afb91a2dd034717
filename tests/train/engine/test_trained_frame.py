"""Runs on a scene far from the origin or in other units are those of the same scene at the origin."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.scene.similarity import IDENTITY, Similarity
from msdgs_train.engine.run import RunResult, fit
from msdgs_train.engine.run_record import CONFIG, KEPT, RECORD, read_record
from msdgs_train.evaluation.evaluate import evaluate_run
from msdgs_train.gaussians.model_file import load_model
from tests.support.splat_files import ply_bytes
from tests.support.tolerances import tolerance
from tests.support.training_scene import assert_same_bits, small_config, state_of

pytestmark = pytest.mark.slow

PLACES = {"far": Similarity(1.0, (512.0, -256.0, 1024.0)), "large": Similarity(64.0), "small": Similarity(1 / 64)}


def placed(data: Path, folder: Path, place: Similarity) -> Path:
    """A copy of a dataset whose files describe another world."""
    shutil.copytree(data, folder)
    for file in folder.glob("transforms_*.json"):
        contents = json.loads(file.read_text())
        for frame in contents["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = place.to_world(pose[:3, 3])
            frame["transform_matrix"] = pose.tolist()
        file.write_text(json.dumps(contents))
    return folder


@pytest.fixture(scope="module")
def plain(data: Path, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return fit(small_config(steps=12), data, tmp_path_factory.mktemp("runs") / "plain")


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_a_run_has_the_quality_of_the_scene_at_the_origin(
    data: Path, plain: RunResult, tmp_path: Path, place: Similarity
):
    files, run = placed(data, tmp_path / "data", place), tmp_path / "run"
    result = fit(small_config(steps=12), files, run)
    assert result.metrics["test"].psnr == pytest.approx(plain.metrics["test"].psnr, abs=tolerance("placed_run_db"))
    record, scene = read_record(run), load_model(run / "model.pt").scene
    assert record is not None
    assert record.scene_to_world == scene.placement
    assert scene.placement.scale == pytest.approx(place.scale, rel=tolerance("normalized.scale"))
    assert scene.placement.offset == place.offset
    (last,) = (model for model in evaluate_run(run, brief=True).models if model.name == "last")
    assert last.mean.psnr == pytest.approx(result.metrics["test"].psnr, abs=tolerance("float32.relative"))


def test_a_run_of_the_files_own_frame_is_continued_in_it(data: Path, tmp_path: Path):
    files, run = placed(data, tmp_path / "data", PLACES["large"]), tmp_path / "run"
    fit(small_config(steps=4), files, run)
    record = json.loads((run / RECORD).read_text())
    del record["scene_to_world"]  # as runs of older versions are
    (run / RECORD).write_text(json.dumps(record))
    fit(small_config(steps=6), files, run, resume=True)
    assert load_model(run / "model.pt").scene.placement == IDENTITY


@pytest.mark.usefixtures("no_curve")
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.0, 0.0, 1e4)], ids=["seen", "unseen"])
def test_a_run_that_starts_again_starts_with_the_same_points(
    data: Path, tmp_path: Path, offset: tuple[float, float, float]
):
    """Points that no camera sees are left out there, too."""
    files, run = placed(data, tmp_path / "data", PLACES["far"]), tmp_path / "run"
    points = PLACES["far"].to_world(np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))) + offset
    (files / "points.ply").write_bytes(ply_bytes(dict(zip("xyz", points.T, strict=True))))
    contents = json.loads((files / "transforms_train.json").read_text())
    (files / "transforms_train.json").write_text(json.dumps({**contents, "ply_file_path": "points.ply"}))
    result = fit(small_config(steps=3), files, run)
    first = state_of(run)
    for name in KEPT:
        if name not in (CONFIG, RECORD) and (run / name).is_file():
            (run / name).unlink()
    assert fit(small_config(steps=3), files, run, resume=True).gaussians == result.gaussians
    assert_same_bits(first, state_of(run))


def test_the_half_size_is_given_in_units_of_the_files(data: Path, tmp_path: Path):
    files, run = placed(data, tmp_path / "data", PLACES["large"]), tmp_path / "run"
    fit(small_config(steps=1, scene_half_size=64.0), files, run)
    reach = load_model(run / "model.pt").model.gaussians.means.detach().abs().amax(dim=1)
    assert 0.7 < float(reach.median()) < 0.9  # 1.03 for the layout's own half size
