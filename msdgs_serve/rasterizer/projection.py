"""Project 3D Gaussians to 2D splats: position, depth, inverse covariance, footprint and color, 16 at a time.

Computed in float64, so that extreme shapes and sizes lose nothing to cancellation; stored in the Gaussians' dtype.
"""

import math
from dataclasses import replace

import numpy as np

from msdgs_serve.rasterizer.atomic import DONE, TAKEN, all_done, fetch_add
from msdgs_serve.rasterizer.culling import seen_blocks
from msdgs_serve.rasterizer.geometry import covariance2d, direction, half_axis, project_points, rotate, rotation_columns
from msdgs_serve.rasterizer.harmonics import raw_colors
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.scratch import scratch
from msdgs_serve.rasterizer.simd.exponential import log2
from msdgs_serve.rasterizer.simd.memory import (
    append_keys,
    load_four_columns,
    load_or,
    load_triples,
    prefetch,
    store,
    store_rows,
    store_uint16,
)
from msdgs_serve.rasterizer.simd.types import NUM_LANES, Mask, Vector
from msdgs_serve.rasterizer.simd.vectors import (
    bits_of,
    converted,
    fma,
    maximum,
    minimum,
    negative,
    select,
    spread,
    square_root,
)
from msdgs_serve.rasterizer.splats import RECORD, ROOT_SCALE, Splats
from msdgs_serve.rasterizer.view import TILE, RasterizerOptions, View, view_of
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.region import Region
from msdgs_serve.scene.static_bounds import BLOCK, StaticBounds
from msdgs_serve.threads import run_together, threads_to_use

PREFETCH_DISTANCE = 2 * NUM_LANES
"""Gaussians between prefetch and use; a frame of 1,000,000 takes 0.95 times as long with it."""
MIN_PARTS = 8
"""Parts for two or more threads: the others start later, by the time that waking up takes, and do fewer parts."""


def project(
    gaussians: Gaussians,
    camera: Camera,
    options: RasterizerOptions,
    tiles: Region | None = None,
    static: StaticBounds | None = None,
) -> Splats:
    """Project N Gaussians into the camera's image, of which whole `tiles` are drawn, or all. Of `static` ones,
    blocks that can't be seen are not read and have no records."""
    gaussians = _kernel_arrays(gaussians)
    if any(camera.distortion):
        gaussians = _without_ghosts(gaussians, camera)
    count, dtype = len(gaussians), gaussians.means.dtype
    view = view_of(camera, options, tiles)
    rows = -(-count // NUM_LANES) * NUM_LANES  # whole vectors: stores need no mask
    records, rectangles = scratch((rows, RECORD), dtype), scratch((count, 4), np.uint16)
    keys = scratch((rows,), np.uint64)
    g = gaussians
    arrays = (g.means, g.quats, g.scales, g.opacities, g.sh.reshape(count, 3 * g.sh.shape[1]))
    found = np.empty((part_count(count), 5), np.int64)
    counters = np.zeros(2, np.int64)
    seen = np.empty(0, np.uint8) if static is None else seen_blocks(static, view, count)
    run_together(_project_parts, (counters, found, view, seen, arrays, (records, rectangles, keys)))
    _, _, nearest, farthest, valid = found.T.tolist()
    drawn = found[:, :2].copy()  # a view of one row would be of another type, for which numba compiles again
    origin, depth_range = (view.left, view.top), (min(nearest), max(farthest))
    return Splats(records[:count], rectangles, keys, drawn, depth_range, origin, all(valid))


def part_count(count: int) -> int:
    """Return into how many parts `range(count)` is split for the threads."""
    threads = threads_to_use()
    return max(min(max(2 * threads, MIN_PARTS) if threads > 1 else 1, -(-count // NUM_LANES)), 1)


@kernel
def part_range(part: int, parts: int, count: int) -> tuple[int, int]:
    """Return start and stop of a part of `range(count)`; all parts but the last are whole vectors of 16."""
    groups = -(-count // NUM_LANES)
    return groups * part // parts * NUM_LANES, min(groups * (part + 1) // parts * NUM_LANES, count)


def _without_ghosts(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Return the Gaussians with opacity 0 from the angle on where the image of a fisheye folds back: where the
    derivative of rho(theta) first is 0."""
    k1, k2, k3, k4 = camera.distortion
    roots = np.roots([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4])  # 1 / theta²
    fold = roots.real[roots.imag == 0].max(initial=0)
    world_to_camera = camera.world_to_camera
    x, y, z = world_to_camera[:3, :3] @ gaussians.means.T.astype(np.float64) + world_to_camera[:3, 3:]
    drawn = fold * np.arctan2(np.hypot(x, y), z) ** 2 < 1
    return replace(gaussians, opacities=np.where(drawn, gaussians.opacities, gaussians.opacities.dtype.type(0)))


def _kernel_arrays(gaussians: Gaussians) -> Gaussians:
    """Return the arrays in C order, writable and of one dtype: numba compiles once for each combination."""
    dtype = np.float64 if gaussians.means.dtype == np.float64 else np.float32
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    return Gaussians(*(np.require(array, dtype, ("C", "W")) for array in arrays))


@kernel
def _project_parts(
    counters: np.ndarray, found: np.ndarray, view: View, seen: np.ndarray, gaussians: tuple, splats: tuple
) -> bool:
    """Project parts until none is left, and write for each its start and the results of `_project_range` into `found`,
    [P, 5]. Return whether all parts are done.

    `seen` are the blocks that are read, or none to read all. `gaussians` are the arrays of `Gaussians` with flattened
    SH; `splats` are records, rectangles and keys of `Splats`.
    """
    while True:
        k = fetch_add(counters, TAKEN, 1)
        if k >= len(found):
            return all_done(counters, len(found))
        start, stop = part_range(k, len(found), len(gaussians[0]))
        end, nearest, farthest, valid = _project_range(start, stop, view, seen, gaussians, splats)
        found[k, 0], found[k, 1], found[k, 2], found[k, 3], found[k, 4] = start, end, nearest, farthest, valid
        fetch_add(counters, DONE, 1)


@kernel
def _project_range(
    start: int, stop: int, view: View, seen: np.ndarray, gaussians: tuple, splats: tuple
) -> tuple[int, int, int, bool]:
    """Project Gaussians `start` to `stop`; keys of drawn splats are written from `start`. Return the end of the keys,
    the bits of the smallest and the largest drawn depth, and whether all values that were read are valid."""
    means, quats, scales, opacities, sh = gaussians
    records, rectangles, keys = splats
    real = records.dtype.type
    zero = spread(real(0))
    double = np.empty(1, np.float64)
    r, t = view.rotation, view.translation
    first_column, first_row = spread(real(view.left // TILE)), spread(real(view.top // TILE))
    past_column, past_row = spread(real(-(-view.right // TILE))), spread(real(-(-view.bottom // TILE)))
    arrays = (
        (means.reshape(-1), np.uint64(3)),
        (quats.reshape(-1), np.uint64(4)),
        (scales.reshape(-1), np.uint64(3)),
        (sh.reshape(-1), np.uint64(sh.shape[1])),
    )
    found, valid = start, True
    nearest, farthest = spread(real(np.inf)), zero
    for first in range(start, stop, NUM_LANES):
        if len(seen) > 0 and seen[first // BLOCK] == 0:
            continue
        for array, numbers in arrays:
            upcoming = np.uint64(first + PREFETCH_DISTANCE) * numbers
            for place in range(upcoming, upcoming + np.uint64(NUM_LANES) * numbers, np.uint64(NUM_LANES)):
                prefetch(array, place)
        mean = load_triples(means, first)
        wx, wy, wz = converted(mean[0], double), converted(mean[1], double), converted(mean[2], double)
        opacity = converted(load_or(opacities, first, spread(opacities.dtype.type(0))), double)
        qs, ss = load_four_columns(quats, first, 0), load_triples(scales, first)
        usable = _usable(mean, qs, ss, opacity)
        x = fma(spread(r[0][0]), wx, fma(spread(r[0][1]), wy, fma(spread(r[0][2]), wz, spread(t[0]))))
        y = fma(spread(r[1][0]), wx, fma(spread(r[1][1]), wy, fma(spread(r[1][2]), wz, spread(t[1]))))
        z = fma(spread(r[2][0]), wx, fma(spread(r[2][1]), wy, fma(spread(r[2][2]), wz, spread(t[2]))))
        past_end = np.uint64(0xFFFF) << np.uint64(min(stop - first, NUM_LANES))
        valid = valid and (bits_of(usable) | past_end) & np.uint64(0xFFFF) == np.uint64(0xFFFF)
        drawn = (z > view.near_plane) & (opacity >= view.alpha_min)
        if bits_of(drawn) == np.uint64(0):
            _store_nothing(records, first)
            continue
        u, v, jacobian = project_points(view, x, y, z)
        qw, qx = converted(qs[0], double), converted(qs[1], double)
        qy, qz = converted(qs[2], double), converted(qs[3], double)
        axes = rotation_columns(qw, qx, qy, qz)
        half = (
            half_axis(jacobian, rotate(r, axes[0]), converted(ss[0], double)),
            half_axis(jacobian, rotate(r, axes[1]), converted(ss[1], double)),
            half_axis(jacobian, rotate(r, axes[2]), converted(ss[2], double)),
        )
        xx, xy, yy, sharp, det = covariance2d(half, view.eps2d)
        if view.mip:
            opacity = opacity * square_root(sharp / det)
            drawn = drawn & (opacity >= view.alpha_min)
        # from here on in the records' dtype: ratios, roots and sums lose nothing in float32
        u, v = converted(u, records), converted(v, records)
        # alpha_min <= 2^(log2_opacity - |root @ d|²) bounds the distance; that ellipse has this bounding box
        log2_opacity = log2(maximum(converted(opacity, records), spread(real(view.alpha_min))))
        reach = (log2_opacity - view.log2_alpha_min) * (2 * math.log(2))
        extent_x = square_root(reach * converted(xx, records)) * 1.0001 + 1e-3
        extent_y = square_root(reach * converted(yy, records)) * 1.0001 + 1e-3
        drawn = drawn & (det > 0) & (det < np.inf)
        drawn = drawn & (u + extent_x >= view.left) & (u - extent_x <= view.right)
        drawn = drawn & (v + extent_y >= view.top) & (v - extent_y <= view.bottom)
        bits = bits_of(drawn)
        if bits == np.uint64(0):
            _store_nothing(records, first)
            continue
        # a sum of two squares, |root @ d|², keeps its digits along a needle where the quadratic form cancels
        root_a = square_root(converted(yy / det, records))
        root_b = -converted(xy / yy, records) * root_a
        root_c = 1 / square_root(converted(yy, records))
        dx, dy, dz = direction(view, wx, wy, wz, z, records)
        red, green, blue = raw_colors(sh, first, dx, dy, dz)
        valid = valid and bits_of(drawn & (abs_sum(red, green, blue) < np.inf)) == bits
        store_rows(
            records,
            first,
            (
                select(drawn, u, zero),
                select(drawn, v, zero),
                select(drawn, ROOT_SCALE * root_a, zero),
                select(drawn, ROOT_SCALE * root_b, zero),
                select(drawn, ROOT_SCALE * root_c, zero),
                select(drawn, log2_opacity, zero),
                select(drawn, maximum(red, zero), zero),
                select(drawn, maximum(green, zero), zero),
                select(drawn, maximum(blue, zero), zero),
                select(drawn, converted(z, records), zero),
                select(drawn, extent_x, zero),
                select(drawn, extent_y, zero),
            ),
        )
        scale = 1 / TILE
        # clamped as floats: bounds of large splats overflow integers
        sides = (
            select(drawn, maximum(scale * (u - extent_x), first_column) - first_column, zero),
            select(drawn, minimum(scale * (u + extent_x) + 1, past_column) - first_column, zero),
            select(drawn, maximum(scale * (v - extent_y), first_row) - first_row, zero),
            select(drawn, minimum(scale * (v + extent_y) + 1, past_row) - first_row, zero),
        )
        store_uint16(rectangles, first, sides)
        depth = converted(z, records)
        nearest, farthest = (
            minimum(nearest, select(drawn, depth, nearest)),
            maximum(farthest, select(drawn, depth, zero)),
        )
        found = append_keys(keys, found, bits, depth, first)
    ends = np.empty(2 * NUM_LANES, records.dtype)
    store(ends, 0, nearest)
    store(ends, NUM_LANES, farthest)
    low, high = ends[0], ends[NUM_LANES]
    for lane in range(1, NUM_LANES):
        low, high = min(low, ends[lane]), max(high, ends[NUM_LANES + lane])
    return found, int(depth_bits(low)), int(depth_bits(high)), valid


@kernel
def abs_sum(a: Vector, b: Vector, c: Vector) -> Vector:
    """Return |a| + |b| + |c|, which is finite if all three are."""
    return -(negative(a) + negative(b) + negative(c))


@kernel
def _usable(means: tuple, quats: tuple, scales: tuple, opacities: Vector) -> Mask:
    """Whether Gaussians pass the checks of `Gaussians.validate`, except those of SH coefficients."""
    squares = quats[0] * quats[0] + quats[1] * quats[1] + quats[2] * quats[2] + quats[3] * quats[3]
    usable = (abs_sum(means[0], means[1], means[2]) < np.inf) & (abs_sum(scales[0], scales[1], scales[2]) < np.inf)
    usable = usable & (scales[0] > 0) & (scales[1] > 0) & (scales[2] > 0)
    usable = usable & (squares > 0.9981) & (squares < 1.0019)
    return usable & (opacities >= 0) & (opacities <= 1)


@kernel
def depth_bits(depth: float) -> np.uint64:
    """Return the bits of a depth as float32; bits of positive numbers sort as the numbers do."""
    return np.uint64(np.float32(depth).view(np.uint32))


@kernel
def _store_nothing(records: np.ndarray, first: int) -> None:
    zero = spread(records.dtype.type(0))
    store_rows(records, first, (zero,))
