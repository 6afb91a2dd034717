"""The order of images and the parameters that they update: passes, the time window, kinds of samples."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.engine.curriculum import MIN_NEW_FRAME_DISTANCE, NEW_FRAME_BORDER, TrainingSample, WindowCurriculum
from msdgs_train.engine.gradients import average_gradients
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.spline import SplineLayer
from msdgs_train.supports.nodes import NodesSupport
from tests.support.training_scene import MODELS, SPLINES, small_config, trained, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneData:
    return load_scene(write_scene(tmp_path_factory.mktemp("scene"), train=41))


PHASES = {"static_fraction": 0.1, "static_window_fraction": 0.1, "window_full_fraction": 0.6}


def samples(scene: SceneData, numbers: range, **changes: Any) -> list[TrainingSample]:
    """Some of a run of 1,000 steps: 100 on all images, 100 around the middle, then up to step 600."""
    schedule = Schedule.from_config(small_config(**{**PHASES, "steps": 1000, "window_start_width": 0.1, **changes}))
    curriculum = WindowCurriculum(schedule, scene.splits["train"], scene.time_range)
    generator = torch.Generator().manual_seed(0)
    return [curriculum.next(number, number // schedule.config.run.batch_size, generator) for number in numbers]


def distance(scene: SceneData, t: float) -> float:
    first, last = scene.time_range
    return abs(t - (first + last) / 2) / (last - first)


def test_every_image_once_a_pass(scene: SceneData) -> None:
    names = [sample.frame.name for sample in samples(scene, range(82), window_full_fraction=0.0)]
    assert len(set(names[:41])) == len(set(names[41:])) == 41
    assert names[:41] != names[41:]


def test_first_and_last_all_images_update_everything(scene: SceneData) -> None:
    drawn = samples(scene, range(1000))
    for part in (drawn[:100], drawn[600:]):
        assert {sample.frame.name for sample in part} == {frame.name for frame in scene.splits["train"]}
        assert {sample.update for sample in part} == {"all"}


@pytest.mark.parametrize("batch_size", [1, 2])
def test_the_window_grows_from_the_middle(scene: SceneData, batch_size: int) -> None:
    """In the steps 200 to 600; motion-only samples are at the border."""
    numbers = range(600 * batch_size)
    drawn = samples(scene, numbers, batch_size=batch_size)
    for number, sample in zip(numbers, drawn, strict=True):
        step = number // batch_size
        if step < 100:
            continue
        window = np.interp(step, (200, 600), (0.1, 0.5)) + 1e-9
        assert (distance(scene, sample.frame.t) <= window) == (sample.update != "static")
        assert distance(scene, sample.t) <= window
        if sample.update == "motion":
            assert step >= 200
            outermost = max(d for f in scene.splits["train"] if (d := distance(scene, f.t)) <= window)
            border = max(window - NEW_FRAME_BORDER, MIN_NEW_FRAME_DISTANCE * window)
            assert distance(scene, sample.frame.t) >= min(outermost, border) - 2e-9


@pytest.mark.parametrize(
    ("numbers", "changes", "updates"),
    [
        (range(200, 560), {}, {"all": 90, "motion": 180, "static": 90}),
        (range(400, 1120), {"batch_size": 2}, {"all": 180, "motion": 360, "static": 180}),
        (range(200, 560), {"new_frames_motion_only": False}, {"all": 270, "static": 90}),
        (range(200, 560), {"outside_frames_static_only": False}, {"all": 180, "motion": 180}),
    ],
)
def test_kinds_of_samples_while_a_window_grows(
    scene: SceneData, numbers: range, changes: dict[str, Any], updates: dict[str, int]
) -> None:
    assert Counter(sample.update for sample in samples(scene, numbers, **changes)) == updates


def test_samples_of_one_step_differ(scene: SceneData) -> None:
    drawn = samples(scene, range(400, 404), batch_size=2)
    assert [sample.update for sample in drawn] == ["static", "motion", "all", "motion"]


def test_a_single_time_leaves_no_window_empty(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path, train=1))
    assert {sample.frame.name for sample in samples(scene, range(1000))} == {scene.splits["train"][0].name}


@pytest.mark.parametrize("name", ["mlp", "mixed on nodes"])
def test_a_sample_changes_only_parameters_of_its_roles(scene: SceneData, name: str) -> None:
    model = MODELS[name]
    trainer = trained(small_config(model=model, refine_every_fraction=0.0, steps=100, **PHASES), scene, 22)
    groups, seen = trainer.system.parameter_groups(), set()
    for _ in range(12):
        before = [(group.role, p, p.detach().clone()) for group in groups for p in group.params]
        views = trainer._render_and_backward(trainer.system.parameter_groups())
        average_gradients(groups, views)
        trainer.optimizer.step()
        trainer.step_count += 1
        trainer.optimizer_steps += 1
        changed = {role for role, p, old in before if not torch.equal(p, old)}
        (update,) = [view.sample.update for view in views]
        assert changed == ({"static", "motion"} if update == "all" else {update})
        seen.add(update)
    assert seen == {"all", "motion", "static"}
    names = {role: {group.name for group in groups if group.role == role} for role in ("static", "motion")}
    canonical = {"means", "log_scales", "raw_quats", "raw_opacities", "sh_dc", "sh_rest"}
    skinning = {"skinning_logits"} if model.support.moves_nodes else set()
    assert names["static"] == canonical | {"modulation", "embeddings"} | skinning
    assert all(name.startswith("layers.") for name in names["motion"])


def test_the_loss_depends_on_the_sample(scene: SceneData, monkeypatch: pytest.MonkeyPatch) -> None:
    """Temporal smoothness and local rigidity are for all but static-only samples."""
    drawn, smooth, rigid = [], [], []
    next_sample = WindowCurriculum.next
    monkeypatch.setattr(WindowCurriculum, "next", lambda *args: drawn.append(next_sample(*args)) or drawn[-1])
    monkeypatch.setattr(SplineLayer, "temporal_smoothness", lambda _, t: smooth.append(float(t)) or 0.0)
    monkeypatch.setattr(NodesSupport, "local_rigidity", lambda _, motions: rigid.append(motions) or 0.0)
    trained(small_config(model=SPLINES, steps=100, **PHASES), scene, 40)
    deformed = [sample for sample in drawn[20:] if sample.update != "static"]
    assert 0 < len(deformed) < 20
    assert smooth == pytest.approx([sample.t for sample in deformed])
    assert len(rigid) == len(deformed)


def test_phases_follow_each_other_and_cover_the_run() -> None:
    config = small_config(**PHASES, steps=1000)
    assert [tuple(phase) for phase in Schedule.from_config(config).phases()] == [
        ("static, all images", 0, 100),
        ("static, first time window", 100, 200),
        ("growing time window", 200, 600),
        ("all times", 600, 1000),
    ]
    whole = config.updated(window_full_fraction=0.0)
    assert [tuple(phase) for phase in Schedule.from_config(whole).phases()] == [
        ("static, all images", 0, 100),
        ("all times", 100, 1000),
    ]
    static = config.updated(model=ModelConfig(layers=(), embedding_dim=0))
    assert [tuple(phase) for phase in Schedule.from_config(static).phases()] == [("static, all images", 0, 1000)]
