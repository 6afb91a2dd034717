"""Which images come, and what they teach: of passes, the window, and the three kinds of steps."""

import json
from collections import Counter
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.engine import trainer as trainer_module
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.curriculum import MIDDLE, NEW, Curriculum, TrainingSample
from msdgs_train.engine.trainer import NEW_FRAME_LR_MULTIPLIER, Trainer
from msdgs_train.supports.nodes import BasisLayer
from tests.support.training_scene import SHARED_MOTIONS, small_config, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneData:
    return load_scene(write_scene(tmp_path_factory.mktemp("scene"), train=41))


def lessons(scene: SceneData, numbers: range, **changes: Any) -> list[TrainingSample]:
    """Some of a run of 1,000 steps: 100 on all images, 100 around the middle, then up to step 600."""
    settings = {"steps": 1000, "static_fraction": 0.1, "static_window_fraction": 0.1, "window_full_fraction": 0.6}
    curriculum = Curriculum(small_config(**{**settings, **changes}), scene.splits["train"], scene.time_range)
    generator = torch.Generator().manual_seed(0)
    return [curriculum.next(number, generator) for number in numbers]


def distance(scene: SceneData, t: float) -> float:
    first, last = scene.time_range
    return abs(t - (first + last) / 2) / (last - first)


def test_every_image_once_a_pass(scene: SceneData) -> None:
    names = [lesson.frame.name for lesson in lessons(scene, range(82), window_full_fraction=0.0)]
    assert len(set(names[:41])) == len(set(names[41:])) == 41
    assert names[:41] != names[41:]


def test_first_and_last_all_images_teach_everything(scene: SceneData) -> None:
    drawn = lessons(scene, range(1000))
    for part in (drawn[:100], drawn[600:]):
        assert {lesson.frame.name for lesson in part} == {frame.name for frame in scene.splits["train"]}
        assert {lesson.subject for lesson in part} == {"everything"}


def test_time_window_grows_from_the_middle(scene: SceneData) -> None:
    for step, lesson in enumerate(lessons(scene, range(1000), window_start_widths=(0.1,))):
        if 100 <= step < 600:
            window = 0.1 + 0.4 * max(step - 200, 0) / 400
            inside = distance(scene, lesson.frame.t) <= window + 1e-9
            assert inside == (lesson.subject != "stillness")
            assert distance(scene, lesson.t) <= window + 1e-9


def test_second_window_grows_as_the_first(scene: SceneData) -> None:
    changes = {"window_start_widths": (0.1, 0.3)}
    for step, lesson in enumerate(lessons(scene, range(1000), **changes)):
        if 200 <= step < 600:
            window = 0.1 + 0.4 * (step - 200) / 200 if step < 400 else 0.3 + 0.2 * (step - 400) / 200
            assert (distance(scene, lesson.frame.t) <= window + 1e-9) == (lesson.subject != "stillness")
            assert distance(scene, lesson.t) <= window + 1e-9


def test_all_images_of_the_second_window_teach_everything(scene: SceneData) -> None:
    changes = {"window_start_widths": (0.1, 0.3), "window_full_fraction": 0.9, "steps": 2000}
    subjects = Counter(lesson.subject for lesson in lessons(scene, range(480, 800), **changes))
    assert subjects == {"everything": 80, "motion": 160, "stillness": 80}
    second = lessons(scene, range(1101, 1800), **changes)
    assert {lesson.subject for lesson in second} == {"everything"}
    inside = [frame for frame in scene.splits["train"] if distance(scene, frame.t) <= 0.3]
    drawn = Counter(lesson.frame.name for lesson in second)
    times = [drawn[frame.name] for frame in inside]
    assert max(times) - min(times) <= 2


def test_second_window_keeps_the_motions_that_the_first_has_found(
    scene: SceneData, monkeypatch: pytest.MonkeyPatch
) -> None:
    carried = []
    monkeypatch.setattr(BasisLayer, "on_window", lambda _, before, after: carried.append((before, after)))
    changes = {"static_fraction": 0.1, "static_window_fraction": 0.1, "window_full_fraction": 0.6, "steps": 50}
    config = small_config(model=SHARED_MOTIONS, window_start_widths=(0.1, 0.2), **changes)
    trainer = Trainer(config, scene)
    while trainer.step_count < 50:
        trainer.step()
    assert carried == [(pytest.approx(0.1 + 0.04 * k), pytest.approx(0.14 + 0.04 * k)) for k in range(9)]


def test_first_window_discovers_and_the_second_does_not(scene: SceneData) -> None:
    config = small_config(
        steps=1000,
        static_fraction=0.1,
        static_window_fraction=0.1,
        window_full_fraction=0.6,
        window_start_widths=(0.03, 0.3),
    )
    curriculum = Curriculum(config, scene.splits["train"], scene.time_range)
    assert [step for step in range(1000) if curriculum.is_first_pass(step)] == list(range(401))


def test_lessons_of_one_step_differ_and_its_window_is_theirs(scene: SceneData) -> None:
    drawn = lessons(scene, range(400, 1120), batch_size=2, window_start_widths=(0.1,))
    assert [lesson.subject for lesson in drawn[:4]] == ["stillness", "motion", "everything", "motion"]
    assert Counter(lesson.subject for lesson in drawn) == {"everything": 180, "motion": 360, "stillness": 180}
    for number, lesson in enumerate(drawn, 400):
        window = 0.1 + 0.4 * (number // 2 - 200) / 400
        assert distance(scene, lesson.t) <= window + 1e-9


def test_of_four_lessons_two_teach_motion_and_one_stillness(scene: SceneData) -> None:
    drawn = lessons(scene, range(200, 560), window_start_widths=(0.1,))
    assert Counter(lesson.subject for lesson in drawn) == {"everything": 90, "motion": 180, "stillness": 90}


def test_switches(scene: SceneData) -> None:
    drawn = lessons(scene, range(200, 560), window_start_widths=(0.1,), new_frames_motion_only=False)
    assert Counter(lesson.subject for lesson in drawn) == {"everything": 270, "stillness": 90}
    drawn = lessons(scene, range(200, 560), window_start_widths=(0.1,), outside_frames_static_only=False)
    assert Counter(lesson.subject for lesson in drawn) == {"everything": 180, "motion": 180}


def test_what_is_new_teaches_motion(scene: SceneData) -> None:
    for step, lesson in enumerate(lessons(scene, range(600), window_start_widths=(0.1,))):
        if lesson.subject == "motion":
            window = 0.1 + 0.4 * (step - 200) / 400
            assert step >= 200
            outermost = max(d for f in scene.splits["train"] if (d := distance(scene, f.t)) <= window + 1e-9)
            assert distance(scene, lesson.frame.t) >= min(outermost, max(window - NEW, MIDDLE * window)) - 1e-9


def test_a_single_time_leaves_no_window_empty(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path, train=1))
    assert {lesson.frame.name for lesson in lessons(scene, range(1000))} == {scene.splits["train"][0].name}


def test_a_lesson_changes_only_what_it_teaches(scene: SceneData) -> None:
    trainer = Trainer(small_config(static_fraction=0.1, static_window_fraction=0.1, refine_every=0, steps=100), scene)
    groups = {"motion": list(trainer.model.deformation.parameters())}
    while trainer.step_count < 22:
        trainer.step()
    seen = set()
    for _ in range(12):
        gaussians = list(trainer.model.gaussians.parameters())
        before = {name: [p.detach().clone() for p in ps] for name, ps in (*groups.items(), ("still", gaussians))}
        (shot,) = shots = trainer._shots()
        trainer._set_gradients(shots)
        trainer.optimizer.step()
        trainer.step_count += 1
        changed = {
            "motion": any(not torch.equal(a, b) for a, b in zip(before["motion"], groups["motion"], strict=True)),
            "still": any(not torch.equal(a, b) for a, b in zip(before["still"], gaussians, strict=True)),
        }
        subject = shot.lesson.subject
        assert changed == {"motion": subject != "stillness", "still": subject != "motion"}
        seen.add(subject)
    assert seen == {"everything", "motion", "stillness"}


def test_motions_hurry_to_where_new_images_show_them_but_stretches_do_not(scene: SceneData) -> None:
    config = small_config(
        model=SHARED_MOTIONS, static_fraction=0.1, static_window_fraction=0.1, steps=100, refine_every=0
    )
    trainer = Trainer(config, scene)
    while trainer.step_count < 25:
        trainer.step()
    bases = trainer.model.bases
    assert bases is not None
    curves = {"shifts": bases.shifts, "turns": bases.turns, "stretches": bases.stretches}
    (shot,) = shots = trainer._shots()
    assert shot.lesson.subject == "motion"
    read, _ = bases.knots_at(torch.tensor(shot.lesson.t))
    trainer._set_gradients(shots)
    start = deepcopy((trainer.model.state_dict(), trainer.optimizer.state_dict()))
    before = {name: curve.detach().clone() for name, curve in curves.items()}
    trainer.optimizer.step()
    steps = {name: curve.detach() - before[name] for name, curve in curves.items()}
    trainer.model.load_state_dict(start[0])
    trainer.optimizer.load_state_dict(start[1])
    trainer._move(shots)
    for name, curve in curves.items():
        times = torch.ones(len(curve))
        times[read] = 1.0 if name == "stretches" else NEW_FRAME_LR_MULTIPLIER
        assert steps[name][read].abs().max() > 0
        torch.testing.assert_close(
            curve.detach() - before[name], steps[name] * times[:, None, None], rtol=1e-4, atol=1e-6
        )


def test_blocks_of_images_are_compared_where_motion_alone_is_taught(
    scene: SceneData, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = []
    monkeypatch.setattr(trainer_module, "pooled_l1", lambda *images: compared.append(images) or 0.0)
    config = small_config(static_fraction=0.1, static_window_fraction=0.1, steps=100, pooled_l1_weight=1.0)
    trainer, taught = Trainer(config, scene), []
    while trainer.step_count < 40:
        (shot,) = trainer._shots()
        taught.append(shot.lesson.subject)
        trainer.step_count += 1
    assert len(compared) == taught.count("motion") > 0


def test_motions_of_new_images_may_bend(scene: SceneData, monkeypatch: pytest.MonkeyPatch) -> None:
    bends, strains, taught = [], [], []
    monkeypatch.setattr(BasisLayer, "bends", lambda _, t: bends.append(float(t)) or 0.0)
    monkeypatch.setattr(BasisLayer, "strains", lambda _, t: strains.append(float(t)) or 0.0)
    config = small_config(
        model=SHARED_MOTIONS,
        static_fraction=0.1,
        static_window_fraction=0.1,
        steps=100,
        outside_frames_static_only=False,
    )
    trainer = Trainer(config, scene)
    while trainer.step_count < 40:
        (shot,) = trainer._shots()
        taught += [shot.lesson] if trainer.parts_in_use[0] else []
        trainer.step_count += 1
    assert {lesson.subject for lesson in taught} == {"everything", "motion"}
    assert strains == [pytest.approx(lesson.t) for lesson in taught]
    assert bends == [pytest.approx(lesson.t) for lesson in taught if lesson.subject != "motion"]


@pytest.mark.parametrize("starts", [(), [0.6], [-0.1], [float("nan")], ["0.1"], [True], 0.1])
def test_starts_of_windows_that_cannot_be_are_named(starts: object) -> None:
    with pytest.raises(InvalidInput, match=r"config\.window_start_widths"):
        small_config(window_start_widths=starts)


def test_starts_of_windows_read_from_json_are_the_same() -> None:
    config = small_config(window_start_widths=(0.1, 0.3, 0.3))
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_a_third_window_grows_as_the_second(scene: SceneData) -> None:
    config = small_config(
        steps=1000,
        static_fraction=0.1,
        static_window_fraction=0.1,
        window_full_fraction=0.8,
        window_start_widths=(0.1, 0.3, 0.2),
    )
    curriculum = Curriculum(config, scene.splits["train"], scene.time_range)
    windows = [curriculum.window(step) for step in (200, 300, 400, 500, 600, 700, 800)]
    assert windows == pytest.approx([0.1, 0.3, 0.3, 0.4, 0.2, 0.35, 0.5])
