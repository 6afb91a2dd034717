"""The presets of volumes on a tiny scene: learning, growth, resuming, model files, evaluation, comparison, refusals."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli import main as cli
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.run import fit
from msdgs_train.engine.run_record import CHECKPOINT, MODEL
from msdgs_train.engine.trainer import Trainer
from msdgs_train.evaluation.evaluate import evaluate_run
from msdgs_train.gaussians.safe_load import CheckpointInvalid
from msdgs_train.gaussians.stored import load_stored
from msdgs_train.systems.registry import preset
from msdgs_train.volumes.hexplane import HexPlaneConfig
from msdgs_train.volumes.model_file import StoredVolume
from msdgs_train.volumes.space import Box
from msdgs_train.volumes.system import VolumeSystem
from tests.support.training_scene import VOLUMES, StopAfter, assert_same_bits, state_of

PRESETS = pytest.mark.parametrize("name", VOLUMES)

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_curve")]


def small(name: str, **changes: Any) -> TrainConfig:
    """A run of 20 steps that goes through all changes of the volume."""
    values = {"steps": 20, "threads": 1, "rays": 64, "log_every": 1, "eval_every": 0, "checkpoint_every": 0}
    return preset(name).updated(**{**values, **VOLUMES[name], **changes})


@PRESETS
def test_it_learns_grows_and_resumes_with_the_same_bits(name: str, data: Path, tmp_path: Path) -> None:
    config = small(name, batch_size=2, threads=2, steps=40)
    whole = fit(config, data, tmp_path / "whole")
    assert whole.metrics["test"].psnr > 10
    for stop in (1, 5, 17):
        parts = tmp_path / f"after {stop}"
        assert fit(config, data, parts, observer=StopAfter(stop)).step == stop
        assert fit(config, data, parts, resume=True).status == "finished"
        assert_same_bits(state_of(tmp_path / "whole"), state_of(parts))
    first = Trainer(config, load_scene(data)).system.size
    assert whole.gaussians == load_stored(tmp_path / "whole" / MODEL).size > first


def test_no_cell_is_masked_before_something_is_opaque() -> None:
    """As after few steps. Later a mask leaves where the field is dense at some time, and the cells next to that."""
    config = HexPlaneConfig(**VOLUMES["hexplane-slim"])
    field = config.build(Box(-torch.ones(3), torch.ones(3)))
    field.mask_if_learned()
    assert field.cells is None
    with torch.no_grad():
        for planes in (field.density_space, field.density_time):
            for plane in planes:
                plane.zero_()
        field.density_space[0][:, :, :3, :2] = 1  # y and x
        field.density_time[0][..., 1] = 1
    field.mask_if_learned()
    assert field.cells is not None
    assert field.cells.sum(dim=(1, 2)).tolist() == [4 * 7] * 3 + [0] * 4


def test_it_is_not_resumed_with_steps_that_miss_or_repeat_a_growth(data: Path, tmp_path: Path) -> None:
    """It grows before steps 2, 4 and 6 of 20."""
    run = tmp_path / "run"
    fit(small("tineuvox-s"), data, run, observer=StopAfter(5))
    for steps in (16, 26):
        with pytest.raises(InvalidInput, match=r"config\.steps.*so near it that step 5 stays in its phase"):
            fit(small("tineuvox-s", steps=steps), data, run, resume=True)
    grown = fit(small("tineuvox-s", steps=19), data, run, resume=True).gaussians
    assert grown == fit(small("tineuvox-s"), data, tmp_path / "whole").gaussians


@PRESETS
def test_its_model_file_renders_the_same(name: str, data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    result = fit(small(name), data, run)
    loaded = load_stored(run / MODEL)
    assert isinstance(loaded, StoredVolume)
    assert loaded.step == 20
    assert name in loaded.description
    (evaluated,) = evaluate_run(run, brief=True).models
    assert evaluated.mean.psnr == pytest.approx(result.metrics["test"].psnr)
    assert cli.main(["eval", str(run)]) == 0
    report = json.loads((run / "eval" / "test.json").read_text())
    assert report["moving_region"]["source"] == "none"
    assert "what moves in a volume is unknown" in report["unavailable"]["moving_psnr"]
    assert "| unavailable |" in (run / "eval" / "test.md").read_text()


@pytest.fixture(scope="module")
def model(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model file of TiNeuVox."""
    path = tmp_path_factory.mktemp("volume") / "model.pt"
    trainer = Trainer(small("tineuvox-s"), load_scene(data))
    trainer.step()
    trainer.system.save(path, 1)
    return path


def test_what_needs_gaussians_refuses_it_by_name(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sentence = r"holds a volume that rays are marched through \(system tineuvox-s\), and no Gaussians"
    with pytest.raises(CheckpointInvalid, match=sentence):
        Checkpoint.load(model)
    for command in (["steps", model, "--out", tmp_path / "steps.png"], ["view", model]):
        assert cli.main(list(map(str, command))) == cli.EXIT_INVALID
        assert "(system tineuvox-s), and no Gaussians" in capsys.readouterr().err
    assert not (tmp_path / "steps.png").exists()


def test_damaged_model_files_are_refused(model: Path, tmp_path: Path) -> None:
    def damaged(**changes: Any) -> Path:
        contents = torch.load(model, weights_only=True)
        for name, value in changes.items():
            part, _, leaf = name.partition("__")
            if leaf:
                contents[part][leaf] = value
            else:
                contents[part] = value
        torch.save(contents, tmp_path / "damaged.pt")
        return tmp_path / "damaged.pt"

    assert load_stored(damaged()).step == 1
    for changes in (
        {"system": "msdgs-nodes"}, {"system": 3}, {"config__width": 10**9}, {"config__voxels": 10**12},
        {"config__color": 1}, {"state__grid": torch.zeros(1, 5, 3, 3, 3)}, {"state__grid": torch.zeros(4)},
        {"state__corners": torch.zeros(2, 3)}, {"state__voxel_size": torch.zeros(())},
        {"state__more": torch.zeros(3)}, {"state__grid": torch.full((1, 4, 3, 3, 3), float("nan"))},
    ):  # fmt: skip
        with pytest.raises(CheckpointInvalid, match=r"damaged\.pt: (isn't a complete model|holds values that are NaN)"):
            load_stored(damaged(**changes))


@pytest.mark.usefixtures("in_threads")
def test_it_is_compared_with_gaussians(data: Path, tmp_path: Path) -> None:
    table = tmp_path / "volumes.toml"
    settings = "".join(f"{name} = {value}\n" for name, value in {**VOLUMES["hexplane-slim"], "rays": 64}.items())
    table.write_text(f'[planes]\npreset = "hexplane-slim"\n{settings}[still]\npreset = "static"\n')
    arguments = [str(table), "--data", str(data), "--out", str(tmp_path / "out"), "--seeds", "0", "--steps", "12"]
    assert cli.main(["compare", *arguments, "--init-num-pts", "60", "--max-gaussians", "90", "--threads", "1"]) == 0
    planes, still = json.loads((tmp_path / "out" / "comparison.json").read_text())["runs"]
    assert (planes["system"], still["system"]) == ("planes", "still")
    model = load_stored(tmp_path / "out" / planes["run"] / MODEL)
    assert planes["deformation_parameters"] == model.parameter_counts.motion > 0
    assert planes["modulation_parameters"] == 0


def test_runs_of_given_minutes_grow_too(data: Path, tmp_path: Path) -> None:
    config = small("tineuvox-s", minutes=0.01, time="cpu", steps=20_000)
    assert fit(config, data, tmp_path / "run").step == 20_000
    volume = load_stored(tmp_path / "run" / MODEL)
    last = Trainer(small("tineuvox-s"), load_scene(data))
    last.system.before_step(last.optimizer, range(21))
    assert volume.size == last.system.size


def test_settings_of_gaussians_are_refused(data: Path) -> None:
    for setting, value in (
        ("sh_degree", 1), ("ssim_lambda", 0.5), ("static_fraction", 0.1), ("pose_opt", True), ("scene_half_size", 3.0),
        ("ema_fraction", 0.1), ("means_lr_init", 1e-3), ("gradient_clip", None), ("grow_grad2d", 1e-3),
    ):  # fmt: skip
        with pytest.raises(InvalidInput, match=rf"`config\.{setting}` must be not given: tineuvox-s doesn't use it"):
            Trainer(small("tineuvox-s", **{setting: value}), load_scene(data))
    Trainer(small("tineuvox-s", init_num_pts=100, max_gaussians=200), load_scene(data))


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("rays", 0),
        ("near", -1.0),
        ("far", 0.0),
        ("voxels", 10),
        ("width", 1),
        ("first_alpha", 1.0),
        ("entropy_weight", -1.0),
    ],
)
def test_settings_out_of_range_are_named(setting: str, value: object) -> None:
    with pytest.raises(InvalidInput, match=rf"`config\.{setting}`"):
        preset("tineuvox-s").updated(**{setting: value})


def _volume(config: TrainConfig, scene: SceneData) -> VolumeSystem:
    system = Trainer(config, scene).system
    assert isinstance(system, VolumeSystem)
    return system


@pytest.mark.parametrize("has_points", [True, False])
@PRESETS
def test_lengths_are_those_of_the_scene(name: str, data: Path, has_points: bool) -> None:
    """D-NeRF's stay as published. In others rays and box hold what the images show; here a cloud of radius 5."""
    scene = load_scene(data)
    own = _volume(small(name), scene).settings
    assert own.depths == (2, 6)
    points = np.random.default_rng(0).normal(size=(2000, 3))
    points *= 5 / np.linalg.norm(points, axis=1, keepdims=True)
    other = replace(scene, has_nominal_size=False, scene_half_size=5.0, points=points if has_points else None)
    system = _volume(small(name), other)
    near, far = system.settings.depths
    assert 0 < near < far
    shares = []
    for frame in scene.splits["train"]:
        pixels, depths = frame.camera.project(points)
        seen = (depths > 0) & ((pixels >= 0) & (pixels < (frame.camera.width, frame.camera.height))).all(axis=1)
        in_box = system.model.box.contains(torch.from_numpy(points[seen]).float()).numpy()
        distances = np.linalg.norm(points[seen] - frame.camera.position, axis=1)  # larger than depths off the center
        shares.append((in_box & (depths[seen] >= near) & (distances <= far)).mean())
    assert np.mean(shares) > 0.95
    given = small(name).updated(near=1.5, far=5.0)
    assert _volume(given, other).settings.depths == (1.5, 5.0)


@pytest.mark.parametrize(("setting", "value", "message"), [("near", 7.0, "below 6"), ("far", 1.0, "above 2")])
def test_one_length_beyond_the_other_is_named(data: Path, setting: str, value: float, message: str) -> None:
    with pytest.raises(InvalidInput, match=rf"`config\.{setting}` must be {message}, where the scene"):
        _volume(small("tineuvox-s", **{setting: value}), load_scene(data))


def test_a_checkpoint_of_other_sizes_is_refused(data: Path, tmp_path: Path) -> None:
    config = small("hexplane-slim", steps=2)
    fit(config, data, tmp_path)
    state = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    state["system"]["model"]["color_time.1"] = torch.zeros(1, 48, 5, 4)
    torch.save(state, tmp_path / CHECKPOINT)
    with pytest.raises(CheckpointInvalid, match="isn't a complete checkpoint of these settings"):
        fit(config.updated(steps=4), data, tmp_path, resume=True)


def test_training_goes_back_to_its_checkpoint(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a growth, to before it."""
    calls = iter(range(10**6))
    whole = VolumeSystem.ray_loss

    def breaking(self: VolumeSystem, *arguments: Any) -> Any:
        view = whole(self, *arguments)
        return view._replace(loss=view.loss * (float("nan") if next(calls) in range(4, 24) else 1.0))

    monkeypatch.setattr(VolumeSystem, "ray_loss", breaking)
    config = small("tineuvox-s", steps=40, checkpoint_every=3)
    assert fit(config, data, tmp_path).status == "finished"
    assert torch.load(tmp_path / CHECKPOINT, weights_only=True)["rollbacks"] == 1


def test_a_step_can_be_timed_without_training(data: Path) -> None:
    trainer = Trainer(small("tineuvox-s"), load_scene(data))
    before = [p.detach().clone() for group in trainer.system.parameter_groups() for p in group.params]
    trainer.rehearse(5)
    after = [p for group in trainer.system.parameter_groups() for p in group.params]
    assert trainer.step_count == 5
    assert all(torch.equal(old, new) for old, new in zip(before, after, strict=True))
