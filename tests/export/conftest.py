"""Shared settings of the tests of export."""

from collections.abc import Iterator
from dataclasses import replace

import pytest

from msdgs_export.plans.registry import PLANS


@pytest.fixture(scope="module")
def few_candidates() -> Iterator[None]:
    """Sweeps of few candidates, each compared in few frames and timed a few times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANS, "compact", replace(PLANS["compact"], candidates=lambda layers: ["compact:50"]))
        for name, value in (
            ("pruned_models.PRUNING_STEPS", (5.0, 1.0, -5.0)),
            ("pruned_models.SMALLER_STEPS", (-15.0,)),
            ("pruned_models.SELECTION_TIMES", 9),
            ("pruned_models.SELECTION_CAMERAS", 1),
            ("ruler.EVALUATION_TIMES", 6),
            ("builder.STABILITY_TIMES", 3),
            ("packing.EVALUATION_TIMES", 6),
            ("timing.REPEATS", 3),
        ):
            patch.setattr(f"msdgs_export.jobs.{name}", value)
        yield
