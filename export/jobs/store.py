"""Storage of arrays in as few bytes as an error of frames allows: of the chosen candidate, or of a scene file."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import onnx

from export.jobs.job import CAMERAS_PER_TIME, EVALUATION_TIMES, Candidate, ExportJob
from export.jobs.sweep import ESTIMATE_STRIDE
from export.jobs.write import properties, set_properties
from export.measure.rendered_error import ExactFrames, RenderedError
from export.measure.views import cameras_of, evaluation_views
from export.storage.choice import fewest_bytes
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import as_trained
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.evaluation.metrics import MAX_PSNR
from msdgs_train.gaussians.model_file import SceneInfo

PLAN_PART = 0.75
"""Of the squared error that a file may have, the part that plan and pruning may use."""

LOWEST_MIN_PSNR = 10.0
"""Smallest `min_psnr`, dB. Frames below it don't resemble the scene."""

Measure = Callable[[onnx.ModelProto, int], RenderedError]
"""The error of a scene file's frames: of all, or of every n-th."""


def stored(job: ExportJob, chosen: Candidate, error: RenderedError, min_psnr: float) -> tuple[Candidate, RenderedError]:
    """The candidate with packed arrays and its error, whose worst frame has at least `min_psnr` dB as the given one
    has; or the given ones if nothing can be packed."""
    smaller, on_trial = replace(chosen, path=job.folder / "stored.onnx"), job.progress("storage in fewer bits", 0)

    def written(model: onnx.ModelProto) -> Candidate:
        smaller.close()
        smaller.path.write_bytes(model.SerializeToString())
        return smaller

    def measured(model: onnx.ModelProto, every: int) -> RenderedError:
        on_trial()
        return job.error(written(model), every)

    allowed = squared(min_psnr) - squared(error.psnr_worst)
    found = _in_fewer_bits(onnx.load(chosen.path), measured, min_psnr, allowed)
    return (chosen, error) if found is None else (written(found[0]), found[1])


def stored_anew(contents: onnx.ModelProto, min_psnr: float) -> tuple[onnx.ModelProto, RenderedError] | None:
    """A scene file with packed arrays, and the error of its frames against those of the given one, of which the worst
    has at least `min_psnr` dB; None if nothing can be packed.

    Raises `InvalidInput` for a `min_psnr` that can't be reached or is too low, and `SceneFileInvalid`.
    """
    check_min_psnr(min_psnr)

    def session(model: onnx.ModelProto) -> DeformationSession:
        return DeformationSession("scene.onnx", contents=model.SerializeToString())

    exact = session(contents)
    metadata = exact.scene.metadata
    info = SceneInfo(
        bounds=[list(corner) for corner in metadata.bounds], cameras=[c.to_plain() for c in metadata.cameras]
    )
    views = evaluation_views(cameras_of(info), metadata.time_range, EVALUATION_TIMES, CAMERAS_PER_TIME)
    if not exact.scene.moving_count:
        views = list({view.name: view for view in views}.values())
    ids = np.arange(len(exact.scene))
    frames = ExactFrames(exact.gaussians, len(ids), views, metadata.background, as_trained(metadata))

    def measured(model: onnx.ModelProto, every: int) -> RenderedError:
        return frames.measure(session(model).gaussians, ids, every=every)

    return _in_fewer_bits(contents, measured, min_psnr, squared(min_psnr))


def _in_fewer_bits(
    contents: onnx.ModelProto, measured: Measure, min_psnr: float, allowed: float
) -> tuple[onnx.ModelProto, RenderedError] | None:
    """The smallest file by estimates of its squared error within `allowed`, and its error."""
    tried = list[RenderedError]()

    def estimate(every: int) -> Callable[[onnx.ModelProto], float]:
        return lambda model: squared(measured(model, every).psnr_worst)

    def is_allowed(model: onnx.ModelProto) -> bool:
        tried.append(measured(model, 1))
        return tried[-1].psnr_worst >= min_psnr

    found = fewest_bytes(contents, [estimate(ESTIMATE_STRIDE), estimate(1)], is_allowed, allowed)
    if found is None:
        return None
    saved = contents.ByteSize() - found.contents.ByteSize()
    numbers = {"count": saved, "of": contents.ByteSize(), "bytes_saved": saved, "worst_frame_db": tried[-1].psnr_worst}
    entry = {"rule": "float32", "what": "bytes of arrays in float32", **numbers, "stored": found.kinds}
    set_properties(found.contents, left_out=[*properties(contents)["left_out"], entry])
    return found.contents, tried[-1]


def check_min_psnr(min_psnr: float) -> None:
    """Raise `InvalidInput` for a minimum PSNR, dB, that no file reaches or whose frames don't resemble the scene."""
    if not (math.isfinite(min_psnr) and LOWEST_MIN_PSNR <= min_psnr <= MAX_PSNR):
        allowed = f"a PSNR in dB from {LOWEST_MIN_PSNR:g} to {MAX_PSNR:g}; at 50 no difference is visible"
        raise InvalidInput("min_psnr", allowed, min_psnr)


def squared(psnr: float) -> float:
    """Squared error of a frame of this PSNR, dB."""
    return 10 ** (-psnr / 10)
