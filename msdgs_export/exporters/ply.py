"""PLY in the layout of INRIA's trainer: binary, float32, 17 properties and those of the SH bands."""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from msdgs_export.importers.splats.base import logit
from msdgs_export.importers.splats.ply import RENDER_MODE
from msdgs_serve.scene.gaussians import Gaussians


def write_ply(file: Path, gaussians: Gaussians, antialiasing: str = "dilate") -> None:
    """Write all Gaussians. A comment tells `mip` anti-aliasing, as in files of Brush."""
    comments = [f"{RENDER_MODE} mip"] if antialiasing == "mip" else []
    PlyData([PlyElement.describe(ply_rows(gaussians), "vertex")], byte_order="<", comments=comments).write(str(file))


def ply_rows(gaussians: Gaussians) -> np.ndarray:
    """[N] structured rows in storage space: logits of opacities, log-scales, wxyz quaternions; normals are 0."""
    rest = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(len(gaussians), -1)  # by channel
    columns = {
        **_columns("xyz", gaussians.means),
        **{f"n{axis}": np.zeros(len(gaussians), np.float32) for axis in "xyz"},
        **_columns([f"f_dc_{i}" for i in range(3)], gaussians.sh[:, 0]),
        **_columns([f"f_rest_{i}" for i in range(rest.shape[1])], rest),
        "opacity": logit(gaussians.opacities),
        **_columns([f"scale_{i}" for i in range(3)], np.log(gaussians.scales.astype(np.float64))),
        **_columns([f"rot_{i}" for i in range(4)], gaussians.quats),
    }
    rows = np.empty(len(gaussians), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    return rows


def _columns(names: str | list[str], values: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names, values.T, strict=True))
