"""Render an image of Gaussians with a camera."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.counts import count_splats
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.splats import BLUE, RED, Splats
from msdgs_serve.rasterizer.tiles import TileLists, bin_into_tiles
from msdgs_serve.rasterizer.view import GSPLAT, RasterizerOptions
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.threads import sharing_cores


class Rendering(NamedTuple):
    """One frame in the dtype of its Gaussians."""

    rgb: np.ndarray  # [H, W, 3] display-referred, background included
    alpha: np.ndarray  # [H, W] 1 - transmittance
    depth: np.ndarray  # [H, W] expected distance along the camera axis, infinite if alpha is 0; [0, 0] if not requested
    median_depth: np.ndarray  # [H, W] depth at which transmittance falls to 1/2, or infinite; [0, 0] if not requested
    extra: np.ndarray  # [H, W, C] blended as colors are; divide by alpha for a mean
    counts: np.ndarray  # [H, W] Gaussians that contribute to each pixel; [0, 0] if not requested


@sharing_cores()
def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: npt.ArrayLike = (0.0, 0.0, 0.0),
    depth: bool = False,
    median_depth: bool = False,
    extra: np.ndarray | None = None,
    counts: bool = False,
    options: RasterizerOptions = GSPLAT,
) -> Rendering:
    """Render the Gaussians (equations 1 and 2) over a background color.

    Depths are in scene units; `median_depth` implies `depth`. `extra` [N, C] are any C numbers per Gaussian, blended
    like colors without a background; three of them take as long as the colors. `counts` takes a pass of its own.

    Safe to call from several threads; the same input gives the same bytes, whatever the number of threads.

    Raises:
        InvalidInput: if an array of the Gaussians, the background or an option breaks its contract, by name.
    """
    gaussians.validate_shapes()
    background = np.asarray(background, dtype=gaussians.means.dtype)
    if background.shape != (3,) or not np.isfinite(background).all():
        raise InvalidInput("background", "3 finite numbers", background.tolist())
    splats = project(gaussians, camera, options)
    if not splats.valid:
        gaussians.validate()
    extra = _checked_extra(extra, gaussians)
    tiles = bin_into_tiles(splats, camera.width, camera.height)
    size = (camera.width, camera.height)
    frame = composite(splats, tiles, *size, background, options, depth=depth, median_depth=median_depth)
    dtype = splats.records.dtype
    counted = count_splats(splats, tiles, *size, options).blended if counts else np.empty((0, 0), dtype)
    return Rendering(*frame, _drawn_extra(extra, splats, tiles, camera, options), counted)


def _checked_extra(extra: np.ndarray | None, gaussians: Gaussians) -> np.ndarray:
    count = len(gaussians)
    if extra is None:
        return np.empty((count, 0), gaussians.means.dtype)
    extra = np.asarray(extra)
    if extra.ndim != 2 or len(extra) != count:
        raise InvalidInput("extra", f"of shape ({count}, channels)", extra.shape)
    bad = int(np.count_nonzero(~np.isfinite(extra)))
    if bad:
        raise InvalidInput("extra", "finite", f"{bad} values that are NaN or infinite")
    return extra


def _drawn_extra(
    extra: np.ndarray, splats: Splats, tiles: TileLists, camera: Camera, options: RasterizerOptions
) -> np.ndarray:
    """Return the blended extra channels, drawn three at a time in place of the colors."""
    channels = extra.shape[1]
    dtype = splats.records.dtype
    drawn = np.empty((camera.height, camera.width, channels), dtype)
    for first in range(0, channels, 3):
        part = extra[:, first : first + 3]
        records = splats.records.copy()
        records[:, RED : BLUE + 1] = 0
        records[:, RED : RED + part.shape[1]] = part
        frame = composite(
            splats._replace(records=records), tiles, camera.width, camera.height, np.zeros(3, dtype), options
        )
        drawn[:, :, first : first + 3] = frame.rgb[:, :, : part.shape[1]]
    return drawn
