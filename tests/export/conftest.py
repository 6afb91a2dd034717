"""Shared settings of the tests of export."""

from collections.abc import Iterator
from dataclasses import replace

import pytest

from export.plans.registry import PLANS


@pytest.fixture(scope="module")
def few_candidates() -> Iterator[None]:
    """Sweeps of few candidates, each compared in few frames and timed a few times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("export.jobs.sweep.PRUNING_STEPS", (5.0, 1.0, -5.0))
        patch.setattr("export.jobs.sweep.SMALLER_STEPS", (-15.0,))
        patch.setitem(PLANS, "compact", replace(PLANS["compact"], candidates=lambda layers: ["compact:50"]))
        for name, value in (
            ("EVALUATION_TIMES", 6),
            ("SELECTION_TIMES", 9),
            ("SELECTION_CAMERAS", 1),
            ("STABILITY_TIMES", 3),
        ):
            patch.setattr(f"export.jobs.job.{name}", value)
        patch.setattr("export.jobs.store.EVALUATION_TIMES", 6)
        patch.setattr("export.jobs.timing.REPEATS", 3)
        yield
