"""Frames of one camera at several times: what doesn't move is projected, sorted and drawn once."""

import numpy as np

from msdgs_serve.rasterizer.compositing import Still, composite
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.rasterize import MAX_PAIRS, Rendering, checked_background
from msdgs_serve.rasterizer.scratch import aligned
from msdgs_serve.rasterizer.simd.types import NUM_LANES
from msdgs_serve.rasterizer.splats import DEPTH, RECORD, Splats
from msdgs_serve.rasterizer.tiles import TileLists, bin_into_tiles
from msdgs_serve.rasterizer.view import GSPLAT, RasterizerOptions, in_tiles
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.region import Region
from msdgs_serve.threads import run_parallel, sharing_cores, split_evenly, threads_to_use


class FrameSequence:
    """One camera, and the Gaussians that stand still in front of it.

    A frame projects and sorts the moving Gaussians only, merges them into the lists of the tiles that they touch, and
    draws these tiles; all others are those of the image of the static Gaussians. Not safe to use from several threads.
    """

    @sharing_cores()
    def __init__(
        self,
        static: Gaussians,
        moving_count: int,
        camera: Camera,
        *,
        background: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
        depth: bool = False,
        options: RasterizerOptions = GSPLAT,
        region: Region | None = None,
    ) -> None:
        """Draw the static Gaussians; other arguments are those of `rasterize`.

        Raises:
            TooManyPairs: if the static Gaussians can only be drawn in parts.
            InvalidInput: as `rasterize` does.
        """
        self._camera, self._options, self._depth = camera, options, depth
        self._region = region or Region.whole(camera)
        self._region.check(camera)
        self._area = in_tiles(self._region, camera)
        self._background = checked_background(background, static.means.dtype)
        splats, lists = self._binned(static)
        size = self._area.width, self._area.height
        self._still = composite(splats, lists, *size, self._background, options, depth=depth)
        self.touched = 0.0
        """Fraction of tiles that the last frame has drawn again."""
        first = -(-moving_count // NUM_LANES) * NUM_LANES
        self._records = aligned((first + len(static), RECORD), static.means.dtype)
        self._records[first:] = splats.records
        self._depths = _depths_of(splats, lists)
        self._lists = lists._replace(splat_ids=lists.splat_ids + np.uint32(first))

    @staticmethod
    def least_bytes(count: int, pixels: int, dtype: np.dtype) -> int:
        """Return a lower bound of the memory of a sequence of `count` Gaussians."""
        return (count * RECORD + 4 * pixels) * dtype.itemsize

    @property
    def nbytes(self) -> int:
        """Memory that it keeps."""
        arrays = (*self._still, self._records, self._depths, self._lists.offsets, self._lists.splat_ids)
        return sum(array.nbytes for array in arrays)

    @sharing_cores()
    def frame(self, moving: Gaussians) -> Rendering:
        """Return the image of these and the static Gaussians: bit by bit what `rasterize` returns for the moving ones
        followed by the static ones.

        Raises:
            TooManyPairs: if the frame can only be drawn in parts.
            InvalidInput: as `rasterize` does.
        """
        splats, lists = self._binned(moving)
        self._records[: len(moving)] = splats.records
        depths, counts = _depths_of(splats, lists), np.diff(lists.offsets)
        touched = counts > 0
        self.touched = float(touched.mean())
        counts[touched] += np.diff(self._lists.offsets)[touched]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        merged = lists._replace(offsets=offsets, splat_ids=np.empty(offsets[-1], np.uint32))
        parts = split_evenly(len(counts), 4 * threads_to_use())
        run_parallel(_merge, [(*part, lists, depths, self._lists, self._depths, merged) for part in parts])
        drawn = composite(
            splats._replace(records=self._records),
            merged,
            self._area.width,
            self._area.height,
            self._background,
            self._options,
            depth=self._depth,
            still=Still(self._still, touched.view(np.uint8)),
        )
        empty = np.empty((0, 0), self._records.dtype)
        nothing = np.empty((*drawn.alpha.shape, 0), self._records.dtype)
        return Rendering(*drawn, nothing, empty).cut(self._area, self._region)

    def _binned(self, gaussians: Gaussians) -> tuple[Splats, TileLists]:
        gaussians.validate_shapes()
        splats = project(gaussians, self._camera, self._options, self._area)
        if not splats.valid:
            gaussians.validate()
        return splats, bin_into_tiles(splats, self._area.width, self._area.height, MAX_PAIRS)


def _depths_of(splats: Splats, lists: TileLists) -> np.ndarray:
    """Return the float32 depth of each entry of the tiles' lists, by which they are sorted."""
    return splats.records[lists.splat_ids, DEPTH].astype(np.float32)


@kernel
def _merge(
    start: int,
    stop: int,
    moving: TileLists,
    moving_depths: np.ndarray,
    static: TileLists,
    static_depths: np.ndarray,
    merged: TileLists,
) -> None:
    """Merge the lists of tiles `start` to `stop` by depth, of equal depths the moving splat first; tiles without moving
    splats get none."""
    for tile in range(start, stop):
        k, end = moving.offsets[tile], moving.offsets[tile + 1]
        if k == end:
            continue
        other, other_end = static.offsets[tile], static.offsets[tile + 1]
        for place in range(merged.offsets[tile], merged.offsets[tile + 1]):
            if other == other_end or (k < end and moving_depths[k] <= static_depths[other]):
                merged.splat_ids[place] = moving.splat_ids[k]
                k += 1
            else:
                merged.splat_ids[place] = static.splat_ids[other]
                other += 1
