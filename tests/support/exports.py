"""The shortest way from a model file to a scene file: all layers as trained, nothing pruned, no sweep."""

import hashlib
from collections.abc import Callable
from pathlib import Path

from export.jobs.bake import bake
from export.jobs.write import Exported, write_scene
from export.measure.stability import assess
from export.measure.verify import TIMES, TOLERANCE
from export.plans.base import BASELINE
from export.plans.registry import build
from msdgs_train.gaussians.model_file import load_model

STABILITY_TIMES = 8


def export_scene(
    checkpoint: Path,
    output: Path,
    *,
    tolerance: float = TOLERANCE,
    times: int = TIMES,
    on_time: Callable[[], object] = lambda: None,
) -> Exported:
    """Bake `checkpoint`, write it beside `output`, compare that file with the model, and only then move it there.

    Whatever goes wrong before, `output` stays as it was. Raises `CheckpointInvalid`, `ModelNotExportable`,
    `PlanUnsafe`, `VerificationFailed`, or `SceneFileInvalid` where the written file breaks its contract.
    """
    loaded = load_model(checkpoint)
    with checkpoint.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    baked = bake(loaded.model, loaded.scene, sha256)
    assess(loaded.model, loaded.scene, times=STABILITY_TIMES).require(BASELINE)
    return write_scene(output, build(BASELINE, baked), loaded.model, tolerance=tolerance, times=times, on_time=on_time)
