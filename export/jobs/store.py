"""Storage of candidates: arrays in as few bytes as an error allows, or as fine as so many bytes allow."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import onnx

from export.jobs.job import ESTIMATE_STRIDE, Candidate, ExportJob, TargetNotReached
from export.jobs.write import properties, set_properties
from export.measure.rendered_error import RenderedError
from export.storage.choice import COARSEST, Stored, fewest_bytes, packed, smallest_error

PLAN_PART = 0.75
"""Of the squared error that a file may have, the part that plan and pruning may use."""

METADATA_BYTES = 3000
"""Bytes that are kept free for what is measured last and added to the metadata of the written file."""


def stored(job: ExportJob, chosen: Candidate, error: RenderedError, min_psnr: float) -> tuple[Candidate, RenderedError]:
    """The candidate with packed arrays and its error, whose worst frame has at least `min_psnr` dB as the given one
    has; or the given ones if nothing can be packed."""
    trial, tried = _Trial(job, chosen), list[RenderedError]()

    def is_allowed(model: onnx.ModelProto) -> bool:
        tried.append(trial.error(model))
        return tried[-1].psnr_worst >= min_psnr

    allowed = squared(min_psnr) - squared(error.psnr_worst)
    estimates = [trial.estimate(ESTIMATE_STRIDE), trial.estimate(1)]
    found = fewest_bytes(trial.contents, estimates, is_allowed, allowed)
    return trial.kept(found, tried[-1]) if found else (chosen, error)


def within_bytes(job: ExportJob, candidates: Sequence[Candidate]) -> list[tuple[Candidate, RenderedError]]:
    """Those of the candidates that fit into the job's bytes, with arrays as fine as these allow, and their errors.

    Raises `TargetNotReached` if none fits.
    """
    assert job.max_bytes is not None
    sizes = {candidate: min_bytes(job, candidate) for candidate in candidates}
    if fitting := [candidate for candidate, size in sizes.items() if size <= job.max_bytes]:
        return [_finest(job, candidate, job.max_bytes) for candidate in fitting]
    candidate, size = min(sizes.items(), key=lambda each: each[1])
    worst = _finest(job, candidate, job.max_bytes)[1].psnr_worst
    smallest = f"at least {math.ceil(size / 1e3) / 1e3:.3f}, the smallest file tried: {worst:.1f} dB on its worst frame"
    raise TargetNotReached("max_mb", smallest, job.max_bytes / 1e6)


def min_bytes(job: ExportJob, candidate: Candidate) -> int:
    """Size of the smallest file in which a candidate can be written."""
    size = packed(onnx.load(candidate.path), COARSEST).ByteSize() if job.packs else candidate.size
    return size + METADATA_BYTES


def squared(psnr: float) -> float:
    """Squared error of a frame of this PSNR, dB."""
    return 10 ** (-psnr / 10)


def _finest(job: ExportJob, candidate: Candidate, max_bytes: int) -> tuple[Candidate, RenderedError]:
    if not job.packs or candidate.size + METADATA_BYTES <= max_bytes:
        return candidate, job.error(candidate)
    trial = _Trial(job, candidate)
    found = smallest_error(trial.contents, trial.estimate(ESTIMATE_STRIDE), max_bytes - METADATA_BYTES)
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

    def estimate(self, every: int) -> Callable[[onnx.ModelProto], float]:
        """A function that returns the squared error of the worst of every n-th frame."""
        return lambda model: squared(self.error(model, every).psnr_worst)

    def kept(self, found: Stored, error: RenderedError) -> tuple[Candidate, RenderedError]:
        """The packed candidate, which says in its metadata what was saved, and its error."""
        size = self.contents.ByteSize()
        saved = size - found.contents.ByteSize()
        numbers = {"count": saved, "of": size, "bytes_saved": saved, "worst_frame_db": error.psnr_worst}
        entry = {"rule": "float32", "what": "bytes of arrays in float32", **numbers, "stored": found.kinds}
        set_properties(found.contents, left_out=[*properties(self.contents)["left_out"], entry])
        self._write(found.contents)
        return self._smaller, error

    def _write(self, model: onnx.ModelProto) -> None:
        self._smaller.close()
        self._smaller.path.write_bytes(model.SerializeToString())
