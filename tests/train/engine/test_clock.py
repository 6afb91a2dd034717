"""A schedule that follows the clock."""

import pytest

from msdgs_train.engine.clock import Clock

STEPS, LIMIT, HELD_OUT, IMAGES = 16_000, 300.0, 40, 2


@pytest.mark.parametrize("steps", [STEPS, 500])
@pytest.mark.parametrize("evaluation", [0.0, 0.3])
def test_it_spends_the_time_evenly_whatever_a_step_costs(steps: int, evaluation: float) -> None:
    """Steps become eight times as slow while the schedule goes on, and every 500th is followed by an evaluation."""
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


def test_it_goes_on_from_where_a_stopped_run_was() -> None:
    clock = Clock(STEPS, LIMIT, 0, STEPS // 2)
    advances = [clock.advance(STEPS // 2, 1.0, IMAGES, 151.0 + i) for i in range(3)]
    assert advances == [53, 107, 161]
