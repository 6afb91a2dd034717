"""Storage of the arrays of a candidate or of a scene file, in as few bytes as an error of frames allows, or as fine as
so many bytes allow."""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import onnx
from onnx import numpy_helper

from msdgs_export.jobs.candidate import UNUSABLE, Candidate, Measured
from msdgs_export.jobs.ruler import CAMERAS_PER_TIME, ESTIMATE_STRIDE, EVALUATION_TIMES, Ruler
from msdgs_export.jobs.write import properties, set_properties
from msdgs_export.measure.rendered_error import ExactFrames, RenderedError, within_memory
from msdgs_export.measure.views import cameras_of_file, evaluation_views
from msdgs_export.storage.choice import Stored, fewest_bytes, smallest_error
from msdgs_export.target import check_min_psnr, squared
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import as_trained

METADATA_BYTES = 3000
"""Bytes that are kept free for what is measured last and added to the metadata of the written file."""

SAMPLE = 250_000
"""Gaussians of a static scene, at most, by which kinds of storage are chosen; the result is measured with all."""

Measure = Callable[[onnx.ModelProto, int], RenderedError]
"""The error of a scene file's frames: of all, or of every n-th."""


def stored(chosen: Measured, ruler: Ruler, min_psnr: float) -> Measured:
    """The candidate with packed arrays, whose worst frame has at least `min_psnr` dB as the given one has; or the given
    one if nothing can be packed."""
    trial = _Trial(chosen.candidate, ruler)
    found = _in_fewer_bits(trial.contents, trial.error, min_psnr, trial.contents, trial.error)
    return chosen if found is None else trial.kept(*found)


def stored_anew(contents: onnx.ModelProto, min_psnr: float) -> tuple[onnx.ModelProto, RenderedError] | None:
    """A scene file with packed arrays, and the error of its frames against those of the given one, of which the worst
    has at least `min_psnr` dB; None if nothing can be packed.

    Raises `InvalidInput` for a `min_psnr` that can't be reached or is too low, and `SceneFileInvalid`.
    """
    check_min_psnr(min_psnr)
    exact = _session(contents)
    measured = _against(exact)
    sample, of_sample = contents, measured
    if not exact.scene.moving_count and len(exact.scene) > SAMPLE:
        with suppress(*UNUSABLE):  # of graphs that need the number of Gaussians
            thinned = _thinned(contents, len(exact.scene))
            sample, of_sample = thinned, _against(_session(thinned))
    found = _in_fewer_bits(contents, measured, min_psnr, sample, of_sample)
    return None if found is None else (_with_entry(contents, *found), found[1])


def _session(model: onnx.ModelProto) -> DeformationSession:
    return DeformationSession("scene.onnx", contents=model.SerializeToString())


def _against(exact: DeformationSession) -> Measure:
    """The error of files with the same Gaussians."""
    metadata = exact.scene.metadata
    views = evaluation_views(cameras_of_file(metadata), metadata.time_range, EVALUATION_TIMES, CAMERAS_PER_TIME)
    if not exact.scene.moving_count:
        views = list({view.name: view for view in views}.values())
    ids = np.arange(len(exact.scene))
    views = within_memory(views, len(ids))
    place = metadata.scene_to_world
    frames = ExactFrames(exact.gaussians, views, metadata.background, as_trained(metadata), unit=place.scale)
    return lambda model, every: frames.measure(_session(model).gaussians, ids, every=every)


def _thinned(contents: onnx.ModelProto, count: int) -> onnx.ModelProto:
    """A static scene file with every n-th of its `count` Gaussians: `SAMPLE` or fewer."""
    model, every = onnx.ModelProto(), math.ceil(count / SAMPLE)
    model.CopyFrom(contents)
    for tensor in model.graph.initializer:
        if tensor.dims and tensor.dims[0] == count:
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor)[::every], tensor.name))
    for output in model.graph.output:
        for rows in output.type.tensor_type.shape.dim[:1]:
            rows.dim_value = math.ceil(count / every) if rows.dim_value == count else rows.dim_value
    return model


def _in_fewer_bits(
    contents: onnx.ModelProto, measured: Measure, min_psnr: float, sample: onnx.ModelProto, of_sample: Measure
) -> tuple[Stored, RenderedError] | None:
    """The smallest file whose worst frame has `min_psnr`, and its error; `sample` and its errors tell which arrays can
    be coarse."""
    allowed = list[RenderedError]()

    def is_allowed(model: onnx.ModelProto) -> bool:
        with suppress(*UNUSABLE):
            error = measured(model, 1)
            allowed.extend([error] if error.psnr_worst >= min_psnr else [])
            return error.psnr_worst >= min_psnr
        return False

    found = fewest_bytes(contents, _estimate(of_sample), is_allowed, sample)
    return None if found is None else (found, allowed[-1])


def _estimate(measured: Measure) -> Callable[[onnx.ModelProto], float]:
    """A function that returns the squared error of the worst of every n-th frame, infinite if they can't be drawn."""

    def estimate(model: onnx.ModelProto) -> float:
        with suppress(*UNUSABLE):
            return squared(measured(model, ESTIMATE_STRIDE).psnr_worst)
        return math.inf

    return estimate


def _with_entry(contents: onnx.ModelProto, found: Stored, error: RenderedError) -> onnx.ModelProto:
    """The packed file, which says in its metadata what was saved."""
    size = contents.ByteSize()
    saved = size - found.contents.ByteSize()
    numbers = {"count": saved, "of": size, "bytes_saved": saved, "worst_frame_db": error.psnr_worst}
    entry = {"rule": "float32", "what": "bytes of arrays in float32", **numbers, "stored": found.kinds}
    set_properties(found.contents, left_out=[*properties(contents)["left_out"], entry])
    return found.contents


def finest(candidate: Candidate, ruler: Ruler, max_bytes: int) -> Measured:
    """The candidate with arrays as fine as `max_bytes` allow."""
    if candidate.size + METADATA_BYTES <= max_bytes:
        return ruler.measured(candidate)
    trial = _Trial(candidate, ruler)
    found = smallest_error(trial.contents, _estimate(trial.error), max_bytes - METADATA_BYTES)
    return trial.kept(found, trial.error(found.contents))


class _Trial:
    """A candidate whose arrays are packed in several ways."""

    def __init__(self, candidate: Candidate, ruler: Ruler) -> None:
        self.contents = onnx.load(candidate.path)
        self._ruler = ruler
        self._smaller = replace(candidate, path=candidate.path.with_suffix(".stored.onnx"), float32=candidate.path)
        self._on_trial = ruler.track("storage in fewer bits", 0)

    def error(self, model: onnx.ModelProto, every: int = 1) -> RenderedError:
        """The error of a packed file, of all frames or of every n-th."""
        self._write(model)
        self._on_trial()
        return self._ruler.error(self._smaller, every)

    def kept(self, found: Stored, error: RenderedError) -> Measured:
        """The packed candidate and its error."""
        self._write(_with_entry(self.contents, found, error))
        return Measured(self._smaller, error)

    def _write(self, model: onnx.ModelProto) -> None:
        self._smaller.close()
        self._smaller.path.write_bytes(model.SerializeToString())
