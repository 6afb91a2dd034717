"""`.splat`, 32 bytes per Gaussian: position and linear scales as float32, color, opacity and rotation as bytes."""

from pathlib import Path

import numpy as np

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats.base import Splats, Stored, parts_of, splats
from msdgs_serve.scene.fields import FieldTable
from msdgs_serve.scene.spherical_harmonics import SH_C0

FIELDS = FieldTable(
    ".splat",
    {"position": "applied", "scale": "applied", "color": "applied", "opacity": "applied", "rotation": "applied"},
)

RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def read_splat(file: Path) -> Splats:
    """Read a `.splat` file, which has no header. Raises `ImportFailed` if its size isn't a multiple of a record."""
    size = file.stat().st_size
    if size % RECORD.itemsize or not size:
        raise ImportFailed(
            file, f"is cut off or no .splat: {size:,} bytes aren't a multiple of 32, which each Gaussian has"
        )
    records = np.fromfile(file, RECORD)
    return splats(file, len(records), (_stored(records[rows]) for rows in parts_of(len(records))))


def _stored(records: np.ndarray) -> Stored:
    rgba = records["rgba"] / 255
    quats = (records["quats"].astype(np.float64) - 128) / 128
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(records["scales"].astype(np.float64))
    dc = ((rgba[:, :3] - 0.5) / SH_C0)[:, None]
    return Stored(records["means"], log_scales, quats, rgba[:, 3], dc)
