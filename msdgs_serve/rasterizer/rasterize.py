"""Render an image of Gaussians with a camera."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.counts import count_splats
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.splats import BLUE, RED, Splats
from msdgs_serve.rasterizer.tiles import TileLists, TooManyPairs, bin_into_tiles
from msdgs_serve.rasterizer.view import GSPLAT, TILE, RasterizerOptions, in_tiles
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.region import Region
from msdgs_serve.scene.static_bounds import StaticBounds
from msdgs_serve.threads import sharing_cores

MAX_PAIRS = 1 << 28
"""Pairs of a splat and a tile, a GiB of ids. Images with more are drawn in parts."""


class Rendering(NamedTuple):
    """One frame in the dtype of its Gaussians."""

    rgb: np.ndarray  # [H, W, 3] display-referred, background included
    alpha: np.ndarray  # [H, W] 1 - transmittance
    depth: np.ndarray  # [H, W] expected distance along the camera axis, infinite if alpha is 0; [0, 0] if not requested
    extra: np.ndarray  # [H, W, C] blended as colors are; divide by alpha for a mean
    counts: np.ndarray  # [H, W] Gaussians that contribute to each pixel; [0, 0] if not requested

    def cut(self, area: Region, region: Region) -> "Rendering":
        """Return the part that shows `region`, of images that show `area`."""
        if area == region:
            return self
        rows = slice(region.y - area.y, region.bottom - area.y)
        columns = slice(region.x - area.x, region.right - area.x)
        return Rendering(*(np.ascontiguousarray(image[rows, columns]) for image in self))


@sharing_cores()
def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: npt.ArrayLike = (0.0, 0.0, 0.0),
    depth: bool = False,
    extra: np.ndarray | None = None,
    counts: bool = False,
    options: RasterizerOptions = GSPLAT,
    region: Region | None = None,
    static: StaticBounds | None = None,
) -> Rendering:
    """Render the Gaussians (equations 1 and 2) over a background color.

    With a `region`, only this part of the camera's image is drawn: the pixels that the whole image has there, bit by
    bit. `static`, the bounds of Gaussians that don't move, saves reading those that can't be seen, which must be valid,
    and changes no bit.

    Depths are in scene units. `extra` [N, C] are any C numbers per Gaussian, blended like colors without a background;
    three of them take as long as the colors. `counts` takes a pass of its own.

    Safe to call from several threads; the same input gives the same bytes, whatever the number of threads.

    Raises:
        InvalidInput: if an array of the Gaussians, the background, an option or the region breaks its contract, by
            name.
    """
    gaussians.validate_shapes()
    background = checked_background(background, gaussians.means.dtype)
    region = region or Region.whole(camera)
    region.check(camera)
    area = in_tiles(region, camera)
    splats = project(gaussians, camera, options, area, static)
    if not splats.valid:
        gaussians.validate()
    channels = _checked_extra(extra, gaussians)

    def draw(left: int, top: int, right: int, bottom: int) -> Rendering:
        size = right - left, bottom - top
        part = splats if size == area[2:] else _cut(splats, left, top, right, bottom)
        tiles = bin_into_tiles(part, *size, MAX_PAIRS)
        frame = composite(part, tiles, *size, background, options, depth=depth)
        counted = count_splats(part, tiles, *size, options).blended if counts else np.empty((0, 0), part.records.dtype)
        return Rendering(*frame, _drawn_extra(channels, part, tiles, size, options), counted)

    return _in_parts(draw, area.x, area.y, area.right, area.bottom).cut(area, region)


def checked_background(background: npt.ArrayLike, dtype: np.dtype) -> np.ndarray:
    """Return a background color as an array, [3]. Raises `InvalidInput`."""
    color = np.asarray(background, dtype=dtype)
    if color.shape != (3,) or not np.isfinite(color).all():
        raise InvalidInput("background", "3 finite numbers", color.tolist())
    return color


def _in_parts(draw: Callable[..., Rendering], left: int, top: int, right: int, bottom: int) -> Rendering:
    """Return what `draw` returns for an area in pixels, from halves if it raises `TooManyPairs`."""
    try:
        return draw(left, top, right, bottom)
    except TooManyPairs:
        pass  # after the handler, so that the area's splats are freed
    across = right - left > bottom - top
    middle = TILE * -(-(right - left if across else bottom - top) // (2 * TILE))
    if across:
        areas = (left, top, left + middle, bottom), (left + middle, top, right, bottom)
    else:
        areas = (left, top, right, top + middle), (left, top + middle, right, bottom)
    halves = (_in_parts(draw, *area) for area in areas)
    return Rendering(*(np.concatenate(pair, axis=int(across)) for pair in zip(*halves, strict=True)))


def _cut(splats: Splats, left: int, top: int, right: int, bottom: int) -> Splats:
    """Return the splats for an area of whole tiles of the camera's image, each with the tiles that are inside."""
    x, y = splats.origin
    first = np.array([left - x, left - x, top - y, top - y], np.uint16) // TILE
    past = (np.array([right - x, right - x, bottom - y, bottom - y], np.uint16) + (TILE - 1)) // TILE
    return splats._replace(rectangles=splats.rectangles.clip(first, past) - first, origin=(left, top))


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
    extra: np.ndarray, splats: Splats, tiles: TileLists, size: tuple[int, int], options: RasterizerOptions
) -> np.ndarray:
    """Return the blended extra channels, drawn three at a time in place of the colors."""
    channels = extra.shape[1]
    dtype, (width, height) = splats.records.dtype, size
    drawn = np.empty((height, width, channels), dtype)
    for first in range(0, channels, 3):
        part = extra[:, first : first + 3]
        records = splats.records.copy()
        records[:, RED : BLUE + 1] = 0
        records[:, RED : RED + part.shape[1]] = part
        frame = composite(splats._replace(records=records), tiles, width, height, np.zeros(3, dtype), options)
        drawn[:, :, first : first + 3] = frame.rgb[:, :, : part.shape[1]]
    return drawn
