"""Progress: bars in a terminal, lines in a log, ticks within long poses."""

import io

import numpy as np
import pytest
from rich.console import Console

from msdgs_export.measure import poses
from msdgs_export.progress import tracked
from tests.support.models import NODES, random_model
from tests.support.tolerances import assert_close


@pytest.mark.parametrize("config", [{}, {"support": NODES}])
@pytest.mark.parametrize("ids", [None, np.arange(3, 20)])
def test_poses_tick_after_each_block(monkeypatch: pytest.MonkeyPatch, config: dict, ids: np.ndarray | None):
    model, ticks = random_model(20, **config).double(), list[None]()
    whole = poses.posed(model, 0.3, ids)
    monkeypatch.setattr(poses, "BLOCK", 7)
    got = poses.posed(model, 0.3, ids, on_block=lambda: ticks.append(None))
    assert len(ticks) == 3
    for name, values in vars(got).items():
        assert_close(values, getattr(whole, name), "float32.relative")


def test_a_log_names_the_tasks_of_known_length():
    log = io.StringIO()
    with tracked(Console(file=log, width=100)) as track:
        track("all frames", 3)()
        track("trials", 0)()
    assert "0 s  all frames …" in log.getvalue()
    assert "trials" not in log.getvalue()


def test_a_task_of_unknown_length_counts_while_others_run():
    terminal = io.StringIO()
    with tracked(Console(file=terminal, width=150, force_terminal=True)) as track:
        on_trial = track("trials", 0)
        track("frames", 5)  # hides it until it moves
        for _ in range(37):
            on_trial()
    assert "37/?" in terminal.getvalue()
    assert "0/5" in terminal.getvalue()
