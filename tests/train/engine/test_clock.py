"""A schedule that follows the clock."""

import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from msdgs_train.datasets import load_scene
from msdgs_train.engine.clock import Clock
from msdgs_train.engine.run import fit
from msdgs_train.engine.trainer import EvaluatedFrame, StepResult, Trainer
from msdgs_train.supports.nodes import NodesSupport
from tests.support.training_scene import MODELS, small_config

STEPS, LIMIT, HELD_OUT, IMAGES = 16_000, 300.0, 40, 2


@pytest.mark.parametrize("steps", [STEPS, 500])
@pytest.mark.parametrize("evaluation", [0.0, 0.3])
def test_it_spends_the_time_evenly_whatever_a_step_costs(steps: int, evaluation: float) -> None:
    """Steps become eight times slower during the schedule, and every 500th is followed by an evaluation."""
    clock, position, seconds, halfway = Clock(steps, LIMIT, HELD_OUT, 0), 1, 20.0, None
    for number in range(1, 10**6):
        cost = 0.01 if position < steps / 3 else 0.08
        seconds += cost
        advance = clock.advance(position, cost, IMAGES, seconds)
        assert advance >= 0
        position += advance
        seconds += evaluation if number % 500 == 0 else 0.0
        halfway = position if seconds < 160 else halfway
        if position >= steps:
            break
    assert position == steps
    assert seconds + HELD_OUT * 0.08 / IMAGES == pytest.approx(LIMIT, rel=0.01)
    assert halfway == pytest.approx(steps / 2, rel=0.05)


@pytest.mark.parametrize("measured", [5.0, 4.0])
def test_faster_static_steps_have_their_share_of_the_steps(measured: float) -> None:
    """Steps become five times slower where motion begins; the factor is measured before, with an error."""
    static, position, seconds, counts = 1_600, 0, 0.0, [0, 0]
    clock = Clock(STEPS, LIMIT, 0, 0, static, measured)
    while position < STEPS:
        cost = 0.01 if position < static else 0.05
        counts[position >= static] += 1
        seconds += cost
        position += clock.advance(position, cost, IMAGES, seconds)
    assert seconds == pytest.approx(LIMIT, rel=0.01)
    assert counts[0] / sum(counts) == pytest.approx(static / STEPS, rel=0.03 if measured == 5 else 0.25)


def test_slow_held_out_images_leave_most_of_the_time_for_training() -> None:
    """As those of volumes in their first steps: 40 images of 20 s, in a run of 300."""
    clock, position, seconds = Clock(STEPS, LIMIT, HELD_OUT, 0), 0, 0.0
    while position < STEPS:
        seconds += 0.4
        position += clock.advance(position, 0.4, 0.02, seconds)
    assert seconds == pytest.approx(0.75 * LIMIT, rel=0.01)


def test_an_evaluation_of_slow_images_waits_for_the_end_of_the_run() -> None:
    """40 images of 1 s are more than a tenth of 300 s, of 0.5 s they aren't; 10 s are 3 % of 333."""
    clock = Clock(STEPS, LIMIT, HELD_OUT, 0)
    assert clock.allows_evaluation(5.0, 0.0)
    clock.advance(1, 1.0, 1, 5.0)
    assert not clock.allows_evaluation(5.0, 0.0)
    for _ in range(100):
        clock.advance(1, 0.5, 1, 5.0)
    assert clock.allows_evaluation(5.0, 0.0)
    assert [clock.allows_evaluation(seconds, 10.0) for seconds in (330.0, 340.0)] == [False, True]


def test_it_goes_on_from_where_a_stopped_run_was() -> None:
    clock = Clock(STEPS, LIMIT, 0, STEPS // 2)
    advances = [clock.advance(STEPS // 2, 1.0, IMAGES, 151.0 + i) for i in range(3)]
    assert advances == [53, 107, 161]


@pytest.mark.usefixtures("no_curve")
def test_a_run_that_has_no_time_left_ends_its_schedule(data: Path, tmp_path: Path) -> None:
    config = small_config(minutes=1e-9)
    outcome = fit(config, data, tmp_path / "run")
    assert (outcome.status, outcome.step) == ("finished", config.run.steps)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["optimizer_steps"] == 2
    assert set(outcome.metrics) == {"test", "val"}
    assert (tmp_path / "run" / "checkpoint.pt").exists()


@pytest.mark.usefixtures("no_curve")
def test_compiling_kernels_does_not_count_as_training_time(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, costs, step = 0.0, itertools.chain([60.0, 0.5, 60.0], itertools.repeat(0.5)), Trainer.step

    def timed(trainer: Trainer, advance: int) -> StepResult:
        nonlocal now
        now += next(costs)
        return step(trainer, advance)

    monkeypatch.setattr(Trainer, "step", timed)
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    outcome = fit(small_config(minutes=0.5), data, tmp_path / "run")
    assert outcome.status == "finished"
    assert outcome.seconds == pytest.approx(30, rel=0.1)


@pytest.mark.usefixtures("no_curve")
def test_evaluations_take_a_small_part_of_a_timed_run(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps take 10 s, an evaluation 24 s: of nine that are due, the second waits until that is 3 % of the time."""
    now, step, evaluate = 0.0, Trainer.step, Trainer.evaluate
    evaluated: list[float] = []

    def timed(trainer: Trainer, advance: int) -> StepResult:
        nonlocal now
        now += 10
        return step(trainer, advance)

    def slow(trainer: Trainer, split: str) -> Iterator[EvaluatedFrame]:
        nonlocal now
        evaluated.append(now)
        now += 12
        return evaluate(trainer, split)

    monkeypatch.setattr(Trainer, "step", timed)
    monkeypatch.setattr(Trainer, "evaluate", slow)
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    config = small_config(minutes=20, steps=50, eval_every=5)
    outcome = fit(config, data, tmp_path / "run")
    assert outcome.seconds == pytest.approx(1200, rel=0.05)
    trial, *during, last_test, last_val = evaluated
    first, second = during[::2]
    compiling, between = 52, 150
    assert trial < first < compiling + between
    assert 24 / 0.03 < second - compiling < 24 / 0.03 + between
    assert [first + 12, second + 12, last_test + 12] == [*during[1::2], last_val]


def test_steps_that_the_clock_passes_over_take_effect_once(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The steps taken skip those at which the deformation and density control start."""
    placed: list[int] = []
    place = NodesSupport.on_deform_start
    monkeypatch.setattr(NodesSupport, "on_deform_start", lambda *given: placed.append(1) or place(*given))
    trainer = Trainer(small_config(model=MODELS["mlp on nodes"]), load_scene(data))
    sizes, steps = [trainer.system.size], trainer.schedule.num_steps
    while trainer.step_count < steps:
        trainer.step(min(5, steps - trainer.step_count))
        sizes.append(trainer.system.size)
        trainer.step(0)
        assert trainer.system.size == sizes[-1]
    assert trainer.schedule.deform_start_step % 5
    assert placed == [1]
    rounds = [step for step in range(1, steps + 1) if trainer.schedule.refines_at(step)]
    changed = [number for number in range(1, len(sizes)) if sizes[number] != sizes[number - 1]]
    assert changed
    assert set(changed) <= {-(-step // 5) for step in rounds}
