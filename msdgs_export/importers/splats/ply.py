"""PLY files as INRIA's trainer writes them, with properties in any order, and SuperSplat's compressed ones.

Mip-Splatting, 2DGS and SpacetimeGaussians add or leave out properties, and ns-export stores colors in their place.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats.axes import up_direction
from msdgs_export.importers.splats.base import LOG_SCALE_LIMIT, ROWS, Splats, Stored, sigmoid, splats
from msdgs_export.importers.splats.compressed_ply import compressed
from msdgs_export.importers.splats.ply_columns import Columns, rest_of
from msdgs_export.importers.splats.ply_fields import checked_fields
from msdgs_export.importers.splats.spacetime import is_spacetime, motion_of
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.spherical_harmonics import SH_C0
from msdgs_train.datasets.common.ply_file import PlyFile, PlyInvalid

RENDER_MODE = "SplatRenderMode:"
"""Begins Brush's comment on anti-aliasing, which goes on with `mip` or `default`."""

UP_COMMENT = re.compile(
    r"(?:(?:vertical|up)[ _-]?axis|world[ _-]?up|up[ _-]?(?:vector|direction))\b\s*[:=]?\s*(.*)", re.I
)
BY_BRUSH = "exported from brush"
"""Begins a comment of Brush, whose files all say `Vertical axis: y`, while the scene's own up is what it was."""

SURFELS = "it has no `scale_2`, as 2DGS writes: its surfels are drawn as flat Gaussians, with slightly other edges"

ROUNDING = 1e-6  # of opacities in float32
ACTIVATED = (
    "all its scales are above 1 and all opacities from 0.5 to 0.73, as if its `scale_…` and `opacity` were stored as "
    "they are: programs read them as logarithms and logits"
)


def read_ply(file: Path) -> Splats:
    """Read a PLY file. Raises `ImportFailed` naming its error."""
    try:
        contents = PlyFile(file)
    except PlyInvalid as error:
        raise ImportFailed(file, str(error)) from None
    columns = {"vertex": Columns.of(file, contents, "vertex")}
    vertex = columns["vertex"]
    if vertex.has("packed_position"):
        columns |= {name: Columns.of(file, contents, name) for name in ("chunk", "sh") if contents.element(name)}
    others = [each.name for each in contents.elements if each.count and each.name not in columns]
    warnings = checked_fields(file, [name for each in columns.values() for name in each.names] + others)
    if vertex.has("packed_position"):
        found = compressed(file, vertex, columns.get("chunk"), columns.get("sh"))
    else:
        found = splats(file, vertex.rows, (_stored(file, part) for part in vertex.parts(ROWS)))
        warnings += [] if vertex.has("scale_2") else [SURFELS]
        warnings += [ACTIVATED] if _is_activated(found.gaussians) else []
    up, unknown = _up(contents.comments)
    return replace(found, antialiasing=_antialiasing(contents.comments), up=up, warnings=(*warnings, *unknown))


def _is_activated(gaussians: Gaussians) -> bool:
    """Whether all that was stored is above 0 for log-scales, and in [0, 1] for logits."""
    low, high = sigmoid(np.array([0.0, 1.0])) + np.array([-ROUNDING, ROUNDING])
    return bool((gaussians.scales > 1).all() and ((low <= gaussians.opacities) & (gaussians.opacities <= high)).all())


def _antialiasing(comments: Sequence[str]) -> str:
    """`mip` if Brush's or Postshot's comment says so, the last one if there are several."""
    found = "dilate"
    for comment in comments:
        match comment.lower().split():
            case [name, mode] if name == RENDER_MODE.lower():
                found = "mip" if mode == "mip" else "dilate"
            case ["antialiased", flag]:
                found = "mip" if flag == "1" else "dilate"
    return found


def _up(comments: Sequence[str]) -> tuple[np.ndarray | None, list[str]]:
    """The direction [3] that the last such comment says is up, as ns-export writes `Vertical Axis: z`, and a warning
    for one that can't be read."""
    said = [found[1].strip() for comment in comments if (found := UP_COMMENT.match(comment.strip()))]
    if not said or any(comment.lower().startswith(BY_BRUSH) for comment in comments):
        return None, []
    words = said[-1].replace(",", " ").split()
    for text in (" ".join(words[:3]), " ".join(words[:1])):
        if (up := up_direction(text)) is not None:
            return up, []
    return None, [f"its header names the vertical axis {said[-1]!r}, no axis such as z or -y; --up says which is up"]


def _stored(file: Path, columns: Columns) -> Stored:
    moves = is_spacetime(columns)
    rest = rest_of(file, columns, columns.read)
    sh = np.concatenate([_dc(columns, moves and not rest.size)[:, None], rest], axis=1)
    log_scales = columns.stack("scale_", 3 if columns.has("scale_2") else 2)
    if log_scales.shape[1] == 2:  # surfels of 2DGS
        log_scales = np.pad(log_scales, ((0, 0), (0, 1)), constant_values=-LOG_SCALE_LIMIT)
    opacities = sigmoid(columns.read("opacity"))
    if columns.has("filter_3D"):
        opacities, log_scales = _filtered(opacities, log_scales, columns.read("filter_3D"))
    quats = columns.stack("rot_", 4)
    motion = motion_of(file, columns, quats) if moves else None
    return Stored(columns.named("x", "y", "z"), log_scales, quats, opacities, sh, motion)


def _dc(columns: Columns, is_color: bool) -> np.ndarray:
    """[N, 3] SH of degree 0. They may be stored as the colors that they stand for, in [0, 1]: by SpacetimeGaussians
    under the same names, and by `ns-export --ply-color-mode rgb` as red, green and blue."""
    if not columns.has("f_dc_0") and columns.has("opacity", "red", "green", "blue"):
        return (np.stack([columns.fraction(name) for name in ("red", "green", "blue")], axis=1) - 0.5) / SH_C0
    stored = columns.stack("f_dc_", 3)
    return (stored - 0.5) / SH_C0 if is_color else stored


def _filtered(opacities: np.ndarray, log_scales: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opacities and log-scales that Mip-Splatting renders, with its 3D smoothing filter of this standard deviation:
    each Gaussian is convolved with it and keeps its integral."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        log_scales = log_scales.clip(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
        wider = np.logaddexp(2 * log_scales, 2 * np.log(np.abs(width))[:, None]) / 2
        return opacities * np.exp((log_scales - wider).sum(axis=1)), wider
