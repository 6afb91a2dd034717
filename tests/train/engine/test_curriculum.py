"""Which images come, and what they update: passes, the time window, and the three kinds of samples."""

import json
from collections import Counter
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.curriculum import MIN_NEW_FRAME_DISTANCE, NEW_FRAME_BORDER, TrainingSample, WindowCurriculum
from msdgs_train.engine.gradients import average_gradients
from msdgs_train.engine.optimizer import NEW_FRAME_LR_MULTIPLIER, step_with_new_frames
from msdgs_train.engine.schedule import Schedule
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.spline import SplineLayer
from msdgs_train.supports.nodes import NodesSupport
from msdgs_train.systems import gaussian_splatting as system_module
from tests.support.training_scene import MIXED_ON_NODES, MOTION_BASES, SMALL_MODEL, small_config, splatting, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneData:
    return load_scene(write_scene(tmp_path_factory.mktemp("scene"), train=41))


def samples(scene: SceneData, numbers: range, **changes: Any) -> list[TrainingSample]:
    """Some of a run of 1,000 steps: 100 on all images, 100 around the middle, then up to step 600."""
    settings = {"steps": 1000, "static_fraction": 0.1, "static_window_fraction": 0.1, "window_full_fraction": 0.6}
    schedule = Schedule.from_config(small_config(**{**settings, **changes}))
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


def test_time_window_grows_from_the_middle(scene: SceneData) -> None:
    for step, sample in enumerate(samples(scene, range(1000), window_start_widths=(0.1,))):
        if 100 <= step < 600:
            window = 0.1 + 0.4 * max(step - 200, 0) / 400
            inside = distance(scene, sample.frame.t) <= window + 1e-9
            assert inside == (sample.update != "static")
            assert distance(scene, sample.t) <= window + 1e-9


def test_second_window_grows_as_the_first(scene: SceneData) -> None:
    changes = {"window_start_widths": (0.1, 0.3)}
    for step, sample in enumerate(samples(scene, range(1000), **changes)):
        if 200 <= step < 600:
            window = 0.1 + 0.4 * (step - 200) / 200 if step < 400 else 0.3 + 0.2 * (step - 400) / 200
            assert (distance(scene, sample.frame.t) <= window + 1e-9) == (sample.update != "static")
            assert distance(scene, sample.t) <= window + 1e-9


def test_all_images_of_the_second_window_update_everything(scene: SceneData) -> None:
    changes = {"window_start_widths": (0.1, 0.3), "window_full_fraction": 0.9, "steps": 2000}
    updates = Counter(sample.update for sample in samples(scene, range(480, 800), **changes))
    assert updates == {"all": 80, "motion": 160, "static": 80}
    second = samples(scene, range(1101, 1800), **changes)
    assert {sample.update for sample in second} == {"all"}
    inside = [frame for frame in scene.splits["train"] if distance(scene, frame.t) <= 0.3]
    drawn = Counter(sample.frame.name for sample in second)
    times = [drawn[frame.name] for frame in inside]
    assert max(times) - min(times) <= 2


def test_second_window_keeps_the_motions_of_the_first(scene: SceneData, monkeypatch: pytest.MonkeyPatch) -> None:
    extrapolated = []
    monkeypatch.setattr(SplineLayer, "on_window", lambda _, before, after: extrapolated.append((before, after)))
    changes = {"static_fraction": 0.1, "static_window_fraction": 0.1, "window_full_fraction": 0.6, "steps": 50}
    config = small_config(model=MOTION_BASES, window_start_widths=(0.1, 0.2), **changes)
    trainer = Trainer(config, scene)
    while trainer.step_count < 50:
        trainer.step()
    assert extrapolated == [(pytest.approx(0.1 + 0.04 * k), pytest.approx(0.14 + 0.04 * k)) for k in range(9)]


def test_only_the_first_window_takes_in_times_that_were_never_in_it() -> None:
    config = small_config(
        steps=1000,
        static_fraction=0.1,
        static_window_fraction=0.1,
        window_full_fraction=0.6,
        window_start_widths=(0.03, 0.3),
    )
    schedule = Schedule.from_config(config)
    assert [step for step in range(1000) if schedule.is_first_pass(step)] == list(range(401))


def test_samples_of_one_step_differ_and_share_its_window(scene: SceneData) -> None:
    drawn = samples(scene, range(400, 1120), batch_size=2, window_start_widths=(0.1,))
    assert [sample.update for sample in drawn[:4]] == ["static", "motion", "all", "motion"]
    assert Counter(sample.update for sample in drawn) == {"all": 180, "motion": 360, "static": 180}
    for number, sample in enumerate(drawn, 400):
        window = 0.1 + 0.4 * (number // 2 - 200) / 400
        assert distance(scene, sample.t) <= window + 1e-9


def test_of_four_samples_two_update_motion_and_one_static_parts(scene: SceneData) -> None:
    drawn = samples(scene, range(200, 560), window_start_widths=(0.1,))
    assert Counter(sample.update for sample in drawn) == {"all": 90, "motion": 180, "static": 90}


def test_switches(scene: SceneData) -> None:
    drawn = samples(scene, range(200, 560), window_start_widths=(0.1,), new_frames_motion_only=False)
    assert Counter(sample.update for sample in drawn) == {"all": 270, "static": 90}
    drawn = samples(scene, range(200, 560), window_start_widths=(0.1,), outside_frames_static_only=False)
    assert Counter(sample.update for sample in drawn) == {"all": 180, "motion": 180}


def test_new_images_update_motion(scene: SceneData) -> None:
    for step, sample in enumerate(samples(scene, range(600), window_start_widths=(0.1,))):
        if sample.update == "motion":
            window = 0.1 + 0.4 * (step - 200) / 400
            assert step >= 200
            outermost = max(d for f in scene.splits["train"] if (d := distance(scene, f.t)) <= window + 1e-9)
            border = max(window - NEW_FRAME_BORDER, MIN_NEW_FRAME_DISTANCE * window)
            assert distance(scene, sample.frame.t) >= min(outermost, border) - 1e-9


def test_a_single_time_leaves_no_window_empty(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path, train=1))
    assert {sample.frame.name for sample in samples(scene, range(1000))} == {scene.splits["train"][0].name}


@pytest.mark.parametrize("model", [SMALL_MODEL, MIXED_ON_NODES], ids=["mlp on gaussians", "mixed on nodes"])
def test_a_sample_changes_only_parameters_of_its_roles(scene: SceneData, model: ModelConfig) -> None:
    config = small_config(
        model=model,
        static_fraction=0.1,
        static_window_fraction=0.1,
        refine_every_fraction=0.0,
        steps=100,
        window_full_fraction=0.6,
    )
    trainer = Trainer(config, scene)
    while trainer.step_count < 22:
        trainer.step()
    groups = trainer.system.parameter_groups()
    seen = set()
    for _ in range(12):
        before = [(group.role, p, p.detach().clone()) for group in groups for p in group.params]
        views = trainer._render_and_backward()
        average_gradients(groups, views)
        trainer.optimizer.step()
        trainer.step_count += 1
        trainer.optimizer_steps += 1
        changed = {role for role, p, old in before if not torch.equal(p, old)}
        (update,) = [view.sample.update for view in views]
        roles = {group.role for group in groups}
        assert changed == (roles if update == "all" else {update})
        seen.add(update)
    assert seen == {"all", "motion", "static"}
    names = {role: {group.name for group in groups if group.role == role} for role in ("static", "motion", "binding")}
    canonical = {"means", "log_scales", "raw_quats", "raw_opacities", "sh_dc", "sh_rest"}
    assert names["static"] == canonical | {"modulation", "embeddings"}
    assert all(name.startswith("layers.") for name in names["motion"])
    assert names["binding"] == ({"skinning_logits"} if model.support.moves_nodes else set())


def test_curves_take_larger_steps_at_new_frames_but_stretches_do_not(scene: SceneData) -> None:
    config = small_config(
        model=MOTION_BASES, static_fraction=0.1, static_window_fraction=0.1, steps=100, refine_every_fraction=0.0
    )
    trainer = Trainer(config, scene)
    while trainer.step_count < 25:
        trainer.step()
    (layer,) = splatting(trainer).model.deformation
    assert isinstance(layer, SplineLayer)
    curves = {"transls": layer.transls, "rots": layer.rots, "stretches": layer.stretches}
    (view,) = views = trainer._render_and_backward()
    assert view.sample.update == "motion"
    read, _ = layer.knots_at(torch.tensor(view.sample.t))
    average_gradients(trainer.system.parameter_groups(), views)
    start = deepcopy((splatting(trainer).model.state_dict(), trainer.optimizer.state_dict()))
    before = {name: curve.detach().clone() for name, curve in curves.items()}
    trainer.optimizer.step()
    steps = {name: curve.detach() - before[name] for name, curve in curves.items()}
    splatting(trainer).model.load_state_dict(start[0])
    trainer.optimizer.load_state_dict(start[1])
    step_with_new_frames(trainer.optimizer, trainer.system.new_frame_rows([view.sample.t]))
    for name, curve in curves.items():
        times = torch.ones(len(curve))
        times[read] = 1.0 if name == "stretches" else NEW_FRAME_LR_MULTIPLIER
        assert steps[name][read].abs().max() > 0
        torch.testing.assert_close(
            curve.detach() - before[name], steps[name] * times[:, None, None], rtol=1e-4, atol=1e-6
        )


def test_only_new_frames_are_asked_for_larger_steps(scene: SceneData, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(SplineLayer, "new_frame_rows", lambda _, times: asked.extend(times) or [])
    config = small_config(model=MOTION_BASES, static_fraction=0.1, static_window_fraction=0.1, steps=100)
    trainer, expected = Trainer(config, scene), []
    curriculum = WindowCurriculum(trainer.schedule, scene.splits["train"], scene.time_range)
    generator = torch.Generator().manual_seed(config.run.seed)
    for step in range(40):
        sample = curriculum.next(step, step, generator)
        expected += [sample.t] if sample.update == "motion" else []
        trainer.step()
    assert asked == expected != []


def test_pooled_images_are_compared_for_samples_of_motion(scene: SceneData, monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []
    monkeypatch.setattr(system_module, "pooled_l1", lambda *images: compared.append(images) or 0.0)
    config = small_config(static_fraction=0.1, static_window_fraction=0.1, steps=100, pooled_l1_weight=1.0)
    trainer, updates = Trainer(config, scene), []
    while trainer.step_count < 40:
        (view,) = trainer._render_and_backward()
        updates.append(view.sample.update)
        trainer.step_count += 1
        trainer.optimizer_steps += 1
    assert len(compared) == updates.count("motion") > 0


def test_motion_at_new_frames_need_not_be_smooth(scene: SceneData, monkeypatch: pytest.MonkeyPatch) -> None:
    smoothness, rigidity, samples_seen = [], [], []
    monkeypatch.setattr(SplineLayer, "temporal_smoothness", lambda _, t: smoothness.append(float(t)) or 0.0)
    monkeypatch.setattr(NodesSupport, "local_rigidity", lambda _, chain, t: rigidity.append(float(t)) or 0.0)
    config = small_config(
        model=MOTION_BASES,
        static_fraction=0.1,
        static_window_fraction=0.1,
        steps=100,
        outside_frames_static_only=False,
    )
    trainer = Trainer(config, scene)
    while trainer.step_count < 40:
        (view,) = trainer._render_and_backward()
        samples_seen += [view.sample] if trainer.schedule.deforms(trainer.step_count) else []
        trainer.step_count += 1
        trainer.optimizer_steps += 1
    assert {sample.update for sample in samples_seen} == {"all", "motion"}
    assert rigidity == [pytest.approx(sample.t) for sample in samples_seen]
    assert smoothness == [pytest.approx(sample.t) for sample in samples_seen if sample.update != "motion"]


def test_phases_follow_each_other_and_cover_the_run() -> None:
    settings = {"steps": 1000, "static_fraction": 0.1, "static_window_fraction": 0.1, "window_full_fraction": 0.6}
    two = small_config(**settings, window_start_widths=(0.1, 0.3))
    assert [tuple(phase) for phase in Schedule.from_config(two).phases()] == [
        ("static, all images", 0, 100),
        ("static, first time window", 100, 200),
        ("time window grows from 0.1", 200, 400),
        ("time window grows from 0.3", 400, 600),
        ("all times", 600, 1000),
    ]
    whole = two.updated(window_full_fraction=0.0)
    assert [tuple(phase) for phase in Schedule.from_config(whole).phases()] == [
        ("static, all images", 0, 100),
        ("all times", 100, 1000),
    ]
    static = two.updated(model=ModelConfig(layers=(), embedding_dim=0))
    assert [tuple(phase) for phase in Schedule.from_config(static).phases()] == [("static, all images", 0, 1000)]


@pytest.mark.parametrize("starts", [(), [0.6], [-0.1], [float("nan")], ["0.1"], [True], 0.1])
def test_starts_of_windows_that_cannot_be_are_named(starts: object) -> None:
    with pytest.raises(InvalidInput, match=r"config\.window_start_widths"):
        small_config(window_start_widths=starts)


def test_starts_of_windows_read_from_json_are_the_same() -> None:
    config = small_config(window_start_widths=(0.1, 0.3, 0.3))
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_a_third_window_grows_as_the_second() -> None:
    config = small_config(
        steps=1000,
        static_fraction=0.1,
        static_window_fraction=0.1,
        window_full_fraction=0.8,
        window_start_widths=(0.1, 0.3, 0.2),
    )
    schedule = Schedule.from_config(config)
    windows = [schedule.window(step) for step in (200, 300, 400, 500, 600, 700, 800)]
    assert windows == pytest.approx([0.1, 0.3, 0.3, 0.4, 0.2, 0.35, 0.5])
