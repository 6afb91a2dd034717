"""`.spz` version 3: one gzip stream of fixed-point positions, and bytes for everything else but rotations."""

import gzip
import math
from pathlib import Path

import numpy as np

from msdgs_export.importers.splats.axes import from_right_up_back
from msdgs_export.importers.splats.spz import COLOR_SCALE
from msdgs_export.importers.splats.spz_container import HEADER, MAGIC, MIP
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians

VERSION = 3
MAX_FIXED = 2**23 - 1
MAX_FRACTIONAL_BITS = 23
SIGN, MAGNITUDE = 512, 511


def write_spz(file: Path, gaussians: Gaussians, antialiasing: str) -> None:
    """Write all Gaussians; positions have as many fractional bits as the furthest of them allows.

    Raises `InvalidInput` if one is too far away for 24 bits.
    """
    means, quats, sh = from_right_up_back(*(getattr(gaussians, name) for name in ("means", "quats", "sh")))
    bits = _fractional_bits(float(np.abs(means).max(initial=0)))
    flags = MIP if antialiasing == "mip" else 0
    parts = [
        HEADER.pack(MAGIC, VERSION, len(gaussians), gaussians.sh_degree, bits, flags, 0),
        _fixed_point(means, bits),
        _bytes(255 * gaussians.opacities),
        _bytes(255 * (COLOR_SCALE * sh[:, 0] + 0.5)),
        _bytes(16 * (np.log(gaussians.scales.astype(np.float64)) + 10)),
        _rotations(quats.astype(np.float64)),
        _bytes(128 * sh[:, 1:] + 128),
    ]
    with file.open("wb") as stream, gzip.GzipFile("", "wb", fileobj=stream, mtime=0) as packed:
        for part in parts:
            packed.write(part)


def _fractional_bits(largest: float) -> int:
    if largest > MAX_FIXED:
        raise InvalidInput("scene", f"within {MAX_FIXED:,} units of its origin for SPZ", largest)
    return min(MAX_FRACTIONAL_BITS, math.floor(math.log2(MAX_FIXED / max(largest, 1e-9))))


def _fixed_point(means: np.ndarray, bits: int) -> bytes:
    fixed = np.round(means.astype(np.float64) * 2**bits).clip(-MAX_FIXED, MAX_FIXED).astype("<i4")
    return fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].tobytes()


def _bytes(values: np.ndarray) -> bytes:
    return np.round(values).clip(0, 255).astype(np.uint8).tobytes()


def _rotations(quats: np.ndarray) -> bytes:
    """[N] 32 bits: the index of the largest of x, y, z, w, then a sign and 9 bits of each of the others."""
    quats = quats[:, [1, 2, 3, 0]]
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1, 1)
    others = np.argsort(np.arange(4)[None] == largest[:, None], axis=1, kind="stable")[:, :3]
    small = np.take_along_axis(quats, others, axis=1)
    sizes = np.round(np.abs(small) * (MAGNITUDE * math.sqrt(2))).clip(0, MAGNITUDE).astype(np.uint32)
    fields = sizes | np.where(small < 0, SIGN, 0).astype(np.uint32)
    packed = largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return packed.astype("<u4").tobytes()
