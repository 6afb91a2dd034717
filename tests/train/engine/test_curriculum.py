"""The order of images: passes and the time window."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import Frame, SceneData, load_scene
from msdgs_train.engine.curriculum import (
    MIN_NEW_FRAME_DISTANCE,
    NEW_FRAME_BORDER,
    WindowCurriculum,
    distances_from_middle,
)
from msdgs_train.engine.schedule import Schedule, require_same_phase
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.spline import SplineLayer
from msdgs_train.supports.nodes import NodesSupport
from tests.support.scene_files import level_camera
from tests.support.training_scene import SPLINES, small_config, trained, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneData:
    return load_scene(write_scene(tmp_path_factory.mktemp("scene"), train=41))


PHASES = {"static_fraction": 0.1, "static_window_fraction": 0.1, "window_full_fraction": 0.6}


def frames_drawn(scene: SceneData, numbers: range, **changes: Any) -> list[Frame]:
    """Some of a run of 1,000 steps: 100 on all images, 100 around the middle, then up to step 600."""
    schedule = Schedule.from_config(small_config(**{**PHASES, "steps": 1000, "window_start_width": 0.1, **changes}))
    curriculum = WindowCurriculum(schedule, scene.splits["train"], scene.time_range)
    generator = torch.Generator().manual_seed(0)
    return [curriculum.next(number, number // schedule.config.run.batch_size, generator) for number in numbers]


def distance(scene: SceneData, t: float) -> float:
    first, last = scene.time_range
    return abs(t - (first + last) / 2) / (last - first)


def test_every_image_once_a_pass(scene: SceneData) -> None:
    names = [frame.name for frame in frames_drawn(scene, range(82), window_full_fraction=0.0)]
    assert len(set(names[:41])) == len(set(names[41:])) == 41
    assert names[:41] != names[41:]


def test_first_and_last_are_all_images(scene: SceneData) -> None:
    drawn = frames_drawn(scene, range(1000))
    for part in (drawn[:100], drawn[600:]):
        assert {frame.name for frame in part} == {frame.name for frame in scene.splits["train"]}


@pytest.mark.parametrize("batch_size", [1, 2])
def test_the_window_grows_from_the_middle(scene: SceneData, batch_size: int) -> None:
    """In the steps 200 to 580; every other image is at the border, up to step 600."""
    numbers = range(600 * batch_size)
    for number, frame in zip(numbers, frames_drawn(scene, numbers, batch_size=batch_size), strict=True):
        step = number // batch_size
        if step < 100:
            continue
        window = np.interp(step, (200, 580), (0.1, 0.5)) + 1e-9
        assert distance(scene, frame.t) <= window
        if number % 2 and step >= 200:
            outermost = max(d for f in scene.splits["train"] if (d := distance(scene, f.t)) <= window)
            border = max(window - NEW_FRAME_BORDER, MIN_NEW_FRAME_DISTANCE * window)
            assert distance(scene, frame.t) >= min(outermost, border) - 2e-9


@pytest.mark.parametrize("count", [2, 3, 4, 6, 7, 16])
def test_a_window_always_has_all_cameras(count: int) -> None:
    frames = [Frame(f"{camera}_{i}", level_camera(), i / (count - 1), Path()) for i in range(count) for camera in "abc"]
    distances = distances_from_middle((0.0, 1.0), frames)
    middle = [frame.t for frame, distance in zip(frames, distances.tolist(), strict=True) if distance == 0]
    nearest = [count // 2] if count % 2 else [count // 2 - 1, count // 2]
    assert middle == [i / (count - 1) for i in nearest for _ in "abc"]


def test_a_single_time_leaves_no_window_empty(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path, train=1))
    assert {frame.name for frame in frames_drawn(scene, range(1000))} == {scene.splits["train"][0].name}


def test_regularizers_begin_with_the_deformation(scene: SceneData, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, smooth, rigid = [], [], []
    following = WindowCurriculum.next
    monkeypatch.setattr(WindowCurriculum, "next", lambda *args: drawn.append(following(*args)) or drawn[-1])
    monkeypatch.setattr(SplineLayer, "temporal_smoothness", lambda _, t: smooth.append(float(t)) or 0.0)
    monkeypatch.setattr(NodesSupport, "local_rigidity", lambda _, motions: rigid.append(motions) or 0.0)
    trained(small_config(model=SPLINES, steps=100, **PHASES), scene, 40)
    assert smooth == pytest.approx([frame.t for frame in drawn[20:]])
    assert len(rigid) == len(drawn[20:])


def test_without_density_control_nothing_waits_for_its_end() -> None:
    settings = {"steps": 1000, "reset_every_fraction": 0.1, "ema_fraction": 0.1, "window_full_fraction": 0.0}
    on, off = (
        Schedule.from_config(small_config(**settings, refine_every_fraction=every, refine_stop_fraction=0.7))
        for every in (0.01, 0.0)
    )
    prunes = [schedule.prunes_hidden(0, several_per_time=True) for schedule in (on, off)]
    assert prunes == [True, False]
    assert [on.resets_at(100), on.averages_at(699), on.averages_at(701)] == [True, False, True]
    assert [off.resets_at(100), off.averages_at(699)] == [False, True]


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


def test_trained_bands_of_color_stay_in_use() -> None:
    """Of 3,300 steps the first 3,000 train degree 3, of 9,000 degree 1."""
    static = small_config(steps=3000, sh_degree_fraction=0.3, model=ModelConfig(layers=(), embedding_dim=0))
    before, near, far = (Schedule.from_config(static.updated(steps=steps)) for steps in (3000, 3300, 9000))
    assert [schedule.sh_degree(3000) for schedule in (before, near, far)] == [3, 3, 1]
    require_same_phase(before, near, range(3000, 3001), lambda steps: [])
    with pytest.raises(InvalidInput, match=r"config\.steps"):
        require_same_phase(before, far, range(3000, 3001), lambda steps: [])


@pytest.mark.parametrize("milestone", [True, False], ids=["of the system", "motion"])
@pytest.mark.parametrize(
    ("reached", "other", "is_same"),
    [
        (range(9, 10), 110, True), (range(9, 10), 90, False), (range(10, 11), 100, True), (range(10, 11), 90, False),
        (range(10, 11), 110, False), (range(11, 12), 110, False), (range(12, 13), 110, True), (range(8, 12), 90, True),
        (range(8, 12), 60, False), (range(8, 12), 150, False),
    ],
)  # fmt: skip
def test_what_happens_once_is_neither_missed_nor_repeated(
    milestone: bool, reached: range, other: int, is_same: bool
) -> None:
    """At a tenth of 100 steps."""
    start = 0.0 if milestone else 0.1
    config = small_config(static_fraction=start, window_full_fraction=0.0, sh_degree_fraction=0.0)
    before, after = (Schedule.from_config(config.updated(steps=steps)) for steps in (100, other))
    expectation = contextlib.nullcontext() if is_same else pytest.raises(InvalidInput, match=r"config\.steps")
    with expectation:
        require_same_phase(before, after, reached, lambda steps: [steps // 10] if milestone else [])
