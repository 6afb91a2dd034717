"""Candidates that fit into the bytes allowed."""

import math
from collections.abc import Sequence

import onnx

from msdgs_export.jobs.candidate import Candidate, Measured, usable
from msdgs_export.jobs.packing import METADATA_BYTES, finest
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.storage.choice import COARSEST, packed
from msdgs_export.target import Target, TargetNotReached


def within_bytes(
    candidates: Sequence[Candidate], ruler: Ruler, target: Target, refused: list[tuple[str, str]]
) -> list[Measured]:
    """Those of the candidates that fit into the target's bytes, with arrays as fine as these allow.

    Raises `TargetNotReached` if none fits, and as `usable` does, which also adds to `refused`.
    """
    assert target.max_bytes is not None
    limit, sizes = target.max_bytes, {candidate: min_bytes(candidate, target) for candidate in candidates}

    def measured(candidate: Candidate) -> Measured:
        return finest(candidate, ruler, limit) if target.packs else ruler.measured(candidate)

    if fitting := [candidate for candidate, size in sizes.items() if target.fits(size)]:
        return list(usable(fitting, measured, refused))
    smallest, error = next(usable(sorted(sizes, key=sizes.__getitem__), lambda c: (c, measured(c).error), refused))
    size, worst = math.ceil(sizes[smallest] / 1e3) / 1e3, error.psnr_worst
    found = f"at least {size:.3f}, the smallest file tried: {worst:.1f} dB on its worst frame"
    raise TargetNotReached("max_mb", found, limit / 1e6)


def min_bytes(candidate: Candidate, target: Target) -> int:
    """Size of the smallest file in which a candidate can be written."""
    size = packed(onnx.load(candidate.path), COARSEST).ByteSize() if target.packs else candidate.size
    return size + METADATA_BYTES
