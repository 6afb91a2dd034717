"""Storage of arrays, of candidates or of a scene file: in as few bytes as an error of frames allows, or as fine as so
many bytes allow."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np
import onnx

from export.jobs.job import CAMERAS_PER_TIME, ESTIMATE_STRIDE, EVALUATION_TIMES, Candidate, ExportJob
from export.jobs.write import properties, set_properties
from export.measure.rendered_error import ExactFrames, RenderedError, within_memory
from export.measure.views import cameras_of_file, evaluation_views
from export.storage.choice import COARSEST, Stored, fewest_bytes, packed, smallest_error
from export.target import TargetNotReached, check_min_psnr, squared
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import as_trained
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid

METADATA_BYTES = 3000
"""Bytes that are kept free for what is measured last and added to the metadata of the written file."""

UNUSABLE = (InvalidInput, SceneFileInvalid)
"""Errors of a file whose poses can't be drawn: rounded to fewer bits, or overflowing in float32."""

Measured = TypeVar("Measured")
Measure = Callable[[onnx.ModelProto, int], RenderedError]
"""The error of a scene file's frames: of all, or of every n-th."""


def stored(job: ExportJob, chosen: Candidate, error: RenderedError, min_psnr: float) -> tuple[Candidate, RenderedError]:
    """The candidate with packed arrays and its error, whose worst frame has at least `min_psnr` dB as the given one
    has; or the given ones if nothing can be packed."""
    trial = _Trial(job, chosen)
    found = _in_fewer_bits(trial.contents, trial.error, min_psnr)
    return (chosen, error) if found is None else trial.kept(*found)


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
    views = evaluation_views(cameras_of_file(metadata), metadata.time_range, EVALUATION_TIMES, CAMERAS_PER_TIME)
    if not exact.scene.moving_count:
        views = list({view.name: view for view in views}.values())
    ids = np.arange(len(exact.scene))
    views = within_memory(views, len(ids))
    place = metadata.scene_to_world
    frames = ExactFrames(exact.gaussians, views, metadata.background, as_trained(metadata), unit=place.scale)

    def measured(model: onnx.ModelProto, every: int) -> RenderedError:
        return frames.measure(session(model).gaussians, ids, every=every)

    found = _in_fewer_bits(contents, measured, min_psnr)
    return None if found is None else (_with_entry(contents, *found), found[1])


def within_bytes(
    job: ExportJob, candidates: Sequence[Candidate], refused: list[tuple[str, str]]
) -> list[tuple[Candidate, RenderedError]]:
    """Those of the candidates that fit into the job's bytes, with arrays as fine as these allow, and their errors.

    Raises `TargetNotReached` if none fits, and as `usable` does, which also adds to `refused`.
    """
    assert job.max_bytes is not None
    limit, sizes = job.max_bytes, {candidate: min_bytes(job, candidate) for candidate in candidates}
    if fitting := [candidate for candidate, size in sizes.items() if size <= limit]:
        return list(usable(fitting, lambda candidate: _finest(job, candidate, limit), refused))
    by_size = sorted(sizes, key=sizes.__getitem__)
    candidate, error = next(usable(by_size, lambda candidate: (candidate, _finest(job, candidate, limit)[1]), refused))
    size, worst = math.ceil(sizes[candidate] / 1e3) / 1e3, error.psnr_worst
    smallest = f"at least {size:.3f}, the smallest file tried: {worst:.1f} dB on its worst frame"
    raise TargetNotReached("max_mb", smallest, limit / 1e6)


def usable(
    candidates: Iterable[Candidate],
    measure: Callable[[Candidate], tuple[Candidate, Measured]],
    refused: list[tuple[str, str]],
) -> Iterator[tuple[Candidate, Measured]]:
    """What `measure` returns for each candidate; those that can't be drawn are added to `refused`, by plan and why.

    Raises `InvalidInput` if no other is left.
    """
    none = True
    for candidate in candidates:
        try:
            measured = measure(candidate)
        except UNUSABLE as error:  # its motion overflows in float32 at a time that no estimate has tried
            refused.append((candidate.plan, str(error)))
        else:
            none = False
            yield measured
    if none:
        raise nothing_left(refused)


def nothing_left(refused: Sequence[tuple[str, str]]) -> InvalidInput:
    """The error of a model of which all plans were refused."""
    return InvalidInput("model", "one that some plan can hold", "; ".join(why for _, why in refused))


def min_bytes(job: ExportJob, candidate: Candidate) -> int:
    """Size of the smallest file in which a candidate can be written."""
    size = packed(onnx.load(candidate.path), COARSEST).ByteSize() if job.packs else candidate.size
    return size + METADATA_BYTES


def _in_fewer_bits(
    contents: onnx.ModelProto, measured: Measure, min_psnr: float
) -> tuple[Stored, RenderedError] | None:
    """The smallest file whose worst frame has `min_psnr`, and its error."""
    allowed = list[RenderedError]()

    def is_allowed(model: onnx.ModelProto) -> bool:
        with suppress(*UNUSABLE):
            error = measured(model, 1)
            allowed.extend([error] if error.psnr_worst >= min_psnr else [])
            return error.psnr_worst >= min_psnr
        return False

    found = fewest_bytes(contents, _estimate(measured), is_allowed)
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


def _finest(job: ExportJob, candidate: Candidate, max_bytes: int) -> tuple[Candidate, RenderedError]:
    if not job.packs or candidate.size + METADATA_BYTES <= max_bytes:
        return candidate, job.error(candidate)
    trial = _Trial(job, candidate)
    found = smallest_error(trial.contents, _estimate(trial.error), max_bytes - METADATA_BYTES)
    return trial.kept(found, trial.error(found.contents))


class _Trial:
    """A candidate whose arrays are packed in several ways."""

    def __init__(self, job: ExportJob, candidate: Candidate) -> None:
        self.contents = onnx.load(candidate.path)
        self._job = job
        self._smaller = replace(candidate, path=candidate.path.with_suffix(".stored.onnx"), float32=candidate.path)
        self._on_trial = job.progress("storage in fewer bits", 0)

    def error(self, model: onnx.ModelProto, every: int = 1) -> RenderedError:
        """The error of a packed file, of all frames or of every n-th."""
        self._write(model)
        self._on_trial()
        return self._job.error(self._smaller, every)

    def kept(self, found: Stored, error: RenderedError) -> tuple[Candidate, RenderedError]:
        """The packed candidate and its error."""
        self._write(_with_entry(self.contents, found, error))
        return self._smaller, error

    def _write(self, model: onnx.ModelProto) -> None:
        self._smaller.close()
        self._smaller.path.write_bytes(model.SerializeToString())
