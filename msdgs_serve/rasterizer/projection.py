"""3D Gaussians to 2D splats: position, depth, inverse covariance, footprint and color, 16 Gaussians at a time.

Computed in float64, stored as the Gaussians' dtype: the arithmetic is once a Gaussian, and needles and giants lose
nothing to cancellation.
"""

import math
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.atomic import DONE, TAKEN, all_done, fetch_add
from msdgs_serve.rasterizer.exponential import arctangent, log2
from msdgs_serve.rasterizer.harmonics import harmonics
from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.lane_types import LANES, Index, Lanes, Mask
from msdgs_serve.rasterizer.lanes import (
    bits_of,
    converted,
    filled,
    fma,
    lowest_bit,
    maximum,
    minimum,
    negative,
    select,
    spread,
    square_root,
)
from msdgs_serve.rasterizer.lanes_memory import (
    load_four_columns,
    load_or,
    load_triples,
    prefetch,
    store,
    store_rows,
    store_whole_numbers,
)
from msdgs_serve.rasterizer.view import FISHEYE, ORTHOGRAPHIC, TILE, RasterizerOptions, View, view_of
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.threads import run_together, threads_to_use

RECORD = LANES
"""Numbers that a splat's record has: one load. Their places:"""
(X, Y, ROOT_A, ROOT_B, ROOT_C, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_X, EXTENT_Y) = (
    np.uint64(place) for place in range(12)
)
CACHE_LINE = 64
"""Bytes."""
AHEAD = 2 * LANES
"""Gaussians between asking for their numbers and needing them; of 1,000,000 a frame takes 0.95 of the time for it."""
LEAST_PARTS = 8
"""Of the Gaussians, for two threads and more: another is late by the time it takes to wake up, and takes fewer."""
ROOT_SCALE = math.sqrt(0.5 / math.log(2))
"""alpha = 2^(LOG2_OPACITY - |root @ d|²): the root is that of the inverse covariance times this."""


class Splats(NamedTuple):
    """N projected Gaussians. Of one that isn't drawn the record is 0 and the rectangle empty.

    A record: the mean X, Y in pixels; the root [[A, B], [0, C]] of the inverse 2D covariance times `ROOT_SCALE`²,
    1/px; log2 of the opacity; the color seen from the camera, 0 or more; the depth along the camera's axis, scene
    units; half the size of the box outside of which alpha < alpha_min, pixels.
    """

    records: np.ndarray  # [N, RECORD]
    rectangles: np.ndarray  # [N, 4] uint16: columns and rows of tiles, each first and past the last
    keys: np.ndarray  # [N] uint64: bits of the float32 depth above the index of each splat that is drawn
    drawn: np.ndarray  # [P, 2] start and stop of the keys that there are, in the order of the indices
    depth_range: tuple[int, int]  # bits of the least and the largest depth of what is drawn
    sound: bool  # whether `Gaussians.validate` has nothing to say; harmonics of what isn't drawn are not looked at

    @property
    def visible(self) -> int:
        """The number of splats that are drawn."""
        return sum(stop - start for start, stop in self.drawn.tolist())

    @property
    def extents(self) -> np.ndarray:
        """[N, 2] half of the footprint's box in pixels, 0 where nothing is drawn."""
        return self.records[:, EXTENT_X : EXTENT_Y + 1]


def project(gaussians: Gaussians, camera: Camera, options: RasterizerOptions) -> Splats:
    """Project N Gaussians into the camera's image."""
    gaussians = _kernel_arrays(gaussians)
    count, dtype = len(gaussians), gaussians.means.dtype
    view = view_of(camera, options)
    records = empty_records(-(-count // LANES) * LANES, dtype)  # whole groups: stored without a look at the end
    rectangles = np.empty((count, 4), np.uint16)
    keys = np.empty(count, np.uint64)
    g = gaussians
    arrays = (g.means, g.quats, g.scales, g.opacities, g.sh.reshape(count, 3 * g.sh.shape[1]))
    found = np.empty((parts_of_lanes(count), 5), np.int64)
    counters = np.zeros(2, np.int64)
    run_together(_project_parts, (counters, found, view, arrays, (records, rectangles, keys)))
    _, _, nearest, farthest, sound = found.T.tolist()
    return Splats(records[:count], rectangles, keys, found[:, :2], (min(nearest), max(farthest)), all(sound))


def empty_records(count: int, dtype: np.dtype) -> np.ndarray:
    """[count, RECORD] from a multiple of 64 bytes on, so that a record of float32 is one cache line and not two."""
    size = count * RECORD * dtype.itemsize
    raw = np.empty(size + CACHE_LINE, np.uint8)
    start = -raw.ctypes.data % CACHE_LINE
    return raw[start : start + size].view(dtype).reshape(count, RECORD)


def parts_of_lanes(count: int) -> int:
    """How many parts of `range(count)` the threads take."""
    threads = threads_to_use()
    return max(min(max(2 * threads, LEAST_PARTS) if threads > 1 else 1, -(-count // LANES)), 1)


@kernel
def part_of_lanes(part: int, parts: int, count: int) -> tuple[int, int]:
    """Where a part of `range(count)` starts and stops; all but the last have whole groups of 16."""
    groups = -(-count // LANES)
    return groups * part // parts * LANES, min(groups * (part + 1) // parts * LANES, count)


def _kernel_arrays(gaussians: Gaussians) -> Gaussians:
    """The same numbers in C order, writable and of one dtype: for each other combination numba would compile anew."""
    dtype = np.float64 if gaussians.means.dtype == np.float64 else np.float32
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    return Gaussians(*(np.require(array, dtype, ("C", "W")) for array in arrays))


@kernel
def _project_parts(counters: np.ndarray, found: np.ndarray, view: View, gaussians: tuple, splats: tuple) -> bool:
    """Project all parts, one at each turn, and write where each starts and what it has `found`, [P, 5]; whether all of
    them are done.

    `gaussians` are the arrays of `Gaussians`, harmonics flat; `splats` the records, rectangles and keys of `Splats`.
    """
    while True:
        k = fetch_add(counters, TAKEN, 1)
        if k >= len(found):
            return all_done(counters, len(found))
        start, stop = part_of_lanes(k, len(found), len(gaussians[0]))
        end, nearest, farthest, sound = _project_range(start, stop, view, gaussians, splats)
        found[k, 0], found[k, 1], found[k, 2], found[k, 3], found[k, 4] = start, end, nearest, farthest, sound
        fetch_add(counters, DONE, 1)


@kernel
def _project_range(start: int, stop: int, view: View, gaussians: tuple, splats: tuple) -> tuple[int, int, int, bool]:
    """Splats `start` to `stop`. Keys are written from `start`; where they end, bits of the least and the largest depth
    that is drawn, and whether all that was read is what a Gaussian may have."""
    means, quats, scales, opacities, sh = gaussians
    records, rectangles, keys = splats
    real = records.dtype.type
    zero = spread(real(0))
    double = np.empty(1, np.float64)
    depths = np.empty(LANES, records.dtype)
    r, t = view.rotation, view.translation
    arrays = (
        (means.reshape(-1), np.uint64(3)),
        (quats.reshape(-1), np.uint64(4)),
        (scales.reshape(-1), np.uint64(3)),
        (sh.reshape(-1), np.uint64(sh.shape[1])),
    )
    found, nearest, farthest, sound = start, np.uint64(0xFFFFFFFF), np.uint64(0), True
    for first in range(start, stop, LANES):
        for array, numbers in arrays:
            ahead = np.uint64(first + AHEAD) * numbers
            for place in range(ahead, ahead + np.uint64(LANES) * numbers, np.uint64(LANES)):
                prefetch(array, place)
        mean = load_triples(means, first)
        wx, wy, wz = converted(mean[0], double), converted(mean[1], double), converted(mean[2], double)
        opacity = converted(load_or(opacities, first, spread(opacities.dtype.type(0))), double)
        qs, ss = load_four_columns(quats, first, 0), load_triples(scales, first)
        usable = _usable(mean, qs, ss, opacity)
        x = fma(spread(r[0, 0]), wx, fma(spread(r[0, 1]), wy, fma(spread(r[0, 2]), wz, spread(t[0]))))
        y = fma(spread(r[1, 0]), wx, fma(spread(r[1, 1]), wy, fma(spread(r[1, 2]), wz, spread(t[1]))))
        z = fma(spread(r[2, 0]), wx, fma(spread(r[2, 1]), wy, fma(spread(r[2, 2]), wz, spread(t[2]))))
        past_end = np.uint64(0xFFFF) << np.uint64(min(stop - first, LANES))
        sound = sound and (bits_of(usable) | past_end) & np.uint64(0xFFFF) == np.uint64(0xFFFF)
        drawn = (z > view.near_plane) & (opacity >= view.alpha_min)
        if bits_of(drawn) == np.uint64(0):
            _store_nothing(records, first)
            continue
        u, v, jacobian = seen_at(view, x, y, z)
        qw, qx = converted(qs[0], double), converted(qs[1], double)
        qy, qz = converted(qs[2], double), converted(qs[3], double)
        axes = rotation_columns(qw, qx, qy, qz)
        half = (
            half_axis(jacobian, turned(r, axes[0]), converted(ss[0], double)),
            half_axis(jacobian, turned(r, axes[1]), converted(ss[1], double)),
            half_axis(jacobian, turned(r, axes[2]), converted(ss[2], double)),
        )
        xx, xy, yy, sharp, det = covariance2d(half, view.eps2d)
        if view.mip:
            opacity = opacity * square_root(sharp / det)
            drawn = drawn & (opacity >= view.alpha_min)
        # from here on in the records' dtype: ratios, roots and sums of the above lose nothing in float32
        u, v = converted(u, records), converted(v, records)
        # alpha_min <= 2^(log2_opacity - |root @ d|²) bounds the distance; that ellipse has this bounding box
        log2_opacity = log2(maximum(converted(opacity, records), spread(real(view.alpha_min))))
        reach = (log2_opacity - view.log2_alpha_min) * (2 * math.log(2))
        extent_x = square_root(reach * converted(xx, records)) * 1.0001 + 1e-3
        extent_y = square_root(reach * converted(yy, records)) * 1.0001 + 1e-3
        drawn = drawn & (det > 0) & (det < np.inf)
        drawn = drawn & (u + extent_x >= 0) & (u - extent_x <= view.width)
        drawn = drawn & (v + extent_y >= 0) & (v - extent_y <= view.height)
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
        sound = sound and bits_of(drawn & (abs_sum(red, green, blue) < np.inf)) == bits
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
        scale, past_column, past_row = 1 / TILE, spread(real(view.tile_columns)), spread(real(view.tile_rows))
        # clamped as floats: a giant's bounds do not fit an integer
        sides = (
            select(drawn, maximum(scale * (u - extent_x), zero), zero),
            select(drawn, minimum(scale * (u + extent_x) + 1, past_column), zero),
            select(drawn, maximum(scale * (v - extent_y), zero), zero),
            select(drawn, minimum(scale * (v + extent_y) + 1, past_row), zero),
        )
        store_whole_numbers(rectangles, first, sides)
        store(depths, 0, converted(z, records))
        while bits != np.uint64(0):
            lane = lowest_bit(bits)
            bits &= bits - np.uint64(1)
            depth = depth_bits(depths[lane])
            nearest, farthest = min(nearest, depth), max(farthest, depth)
            keys[np.uint64(found)] = (depth << np.uint64(32)) | (np.uint64(first) + lane)
            found += 1
    return found, int(nearest), int(farthest), sound


@kernel
def abs_sum(a: Lanes, b: Lanes, c: Lanes) -> Lanes:
    """|a| + |b| + |c|: less than infinity where all are finite."""
    return -(negative(a) + negative(b) + negative(c))


@kernel
def _usable(means: tuple, quats: tuple, scales: tuple, opacities: Lanes) -> Mask:
    """What `Gaussians.validate` asks of all but harmonics."""
    squares = quats[0] * quats[0] + quats[1] * quats[1] + quats[2] * quats[2] + quats[3] * quats[3]
    usable = (abs_sum(means[0], means[1], means[2]) < np.inf) & (abs_sum(scales[0], scales[1], scales[2]) < np.inf)
    usable = usable & (scales[0] > 0) & (scales[1] > 0) & (scales[2] > 0)
    usable = usable & (squares > 0.9981) & (squares < 1.0019)
    return usable & (opacities >= 0) & (opacities <= 1)


@kernel
def depth_bits(depth: float) -> np.uint64:
    """The bits of a depth as a float32: of positive ones they sort as the numbers do."""
    return np.uint64(np.float32(depth).view(np.uint32))


@kernel
def _store_nothing(records: np.ndarray, first: int) -> None:
    zero = spread(records.dtype.type(0))
    store_rows(records, first, (zero,))


@kernel
def rotation_columns(w: Lanes, x: Lanes, y: Lanes, z: Lanes) -> tuple:
    """The rotation matrix of unit quaternions, by columns, [3][3]."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@kernel
def turned(rotation: np.ndarray, vector: tuple) -> tuple[Lanes, Lanes, Lanes]:
    """A matrix [3, 3] times a vector."""
    a, b, c = vector
    return (
        rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c,
        rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c,
        rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c,
    )


@kernel
def half_axis(jacobian: tuple, axis: tuple, size: Lanes) -> tuple[Lanes, Lanes]:
    """J times a vector in camera axes, times its length: x and y in the image."""
    x, y, z = axis
    (xx, xy, xz), (yx, yy, yz) = jacobian
    return (xx * x + xy * y + xz * z) * size, (yx * x + yy * y + yz * z) * size


@kernel
def covariance2d(half: tuple, eps2d: float) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes]:
    """xx, xy, yy of M Mᵀ + eps I for half-axes M, [3][2], and the determinants before eps I and with it.

    These are sums of squares (Cauchy-Binet), so that a needle of 1e6 : 1 keeps its digits.
    """
    (mx0, my0), (mx1, my1), (mx2, my2) = half
    xx, yy = mx0 * mx0 + mx1 * mx1 + mx2 * mx2, my0 * my0 + my1 * my1 + my2 * my2
    xy = mx0 * my0 + mx1 * my1 + mx2 * my2
    d0, d1, d2 = mx1 * my2 - mx2 * my1, mx2 * my0 - mx0 * my2, mx0 * my1 - mx1 * my0
    sharp = d0 * d0 + d1 * d1 + d2 * d2
    return xx + eps2d, xy, yy + eps2d, sharp, sharp + eps2d * (xx + yy) + eps2d * eps2d


@kernel
def seen_at(view: View, x: Lanes, y: Lanes, z: Lanes) -> tuple:
    """Where points in camera axes are drawn, and the Jacobian of that, [2][3]."""
    zero = filled(0, z)
    if view.model == ORTHOGRAPHIC:
        u, v = view.fx * x, view.fy * y
        jacobian = ((filled(view.fx, z), zero, zero), (zero, filled(view.fy, z), zero))
    elif view.model == FISHEYE:
        # a speck away from the axis, so that nothing is divided by 0 on it
        square = x * x + y * y + 1e-20 * z * z
        radius = square_root(square)
        theta = arctangent(radius / z)
        tt = theta * theta
        k = view.distortion
        rho = theta * (1 + tt * (k[0] + tt * (k[1] + tt * (k[2] + tt * k[3]))))
        growth = 1 + tt * (3 * k[0] + tt * (5 * k[1] + tt * (7 * k[2] + tt * (9 * k[3]))))
        u, v = view.fx * rho * x / radius, view.fy * rho * y / radius
        per_distance = growth / (square + z * z)
        outwards, around = z * per_distance / square, rho / (radius * square)
        mixed = x * y * (outwards - around)
        xx = x * x * outwards + (square - x * x) * around
        yy = y * y * outwards + (square - y * y) * around
        jacobian = (
            (view.fx * xx, view.fx * mixed, -view.fx * x * per_distance),
            (view.fy * mixed, view.fy * yy, -view.fy * y * per_distance),
        )
    else:
        per_z = 1 / z
        ratio_x, ratio_y = x * per_z, y * per_z
        u, v = view.fx * ratio_x, view.fy * ratio_y
        xx, yy = view.fx * per_z, view.fy * per_z
        xz = -xx * maximum(minimum(ratio_x, filled(view.max_x, z)), filled(view.min_x, z))
        yz = -yy * maximum(minimum(ratio_y, filled(view.max_y, z)), filled(view.min_y, z))
        jacobian = ((xx, zero, xz), (zero, yy, yz))
    return u + view.cx, v + view.cy, jacobian


@kernel
def direction(view: View, x: Lanes, y: Lanes, z: Lanes, depth: Lanes, like: np.ndarray) -> tuple[Lanes, Lanes, Lanes]:
    """Unit vectors of the lines of sight to points in the world, in the dtype of `like`."""
    if view.model == ORTHOGRAPHIC:
        r = view.rotation
        return spread(like.dtype.type(r[2, 0])), spread(like.dtype.type(r[2, 1])), spread(like.dtype.type(r[2, 2]))
    # divided by the depth before anything is squared: its square need not be a float32
    per_depth, position = 1 / depth, view.position
    dx = converted((x - position[0]) * per_depth, like)
    dy = converted((y - position[1]) * per_depth, like)
    dz = converted((z - position[2]) * per_depth, like)
    per_distance = 1 / square_root(dx * dx + dy * dy + dz * dz)
    return dx * per_distance, dy * per_distance, dz * per_distance


@inlined_kernel
def raw_colors(sh: np.ndarray, first: int, x: Lanes, y: Lanes, z: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    """SH + 0.5 towards the unit directions (x, y, z), before the cut at 0; `sh` is [N, 3 coefficients]."""
    functions = sh.shape[1] // 3
    basis = harmonics(x, y, z)
    color = filled(0.5, x), filled(0.5, x), filled(0.5, x)
    for k in range(np.uint64(0), np.uint64(functions & ~3), np.uint64(4)):
        c = four_coefficients(sh, first, k)
        color = _added(color, c[0], basis[k])
        color = _added(color, c[1], basis[k + np.uint64(1)])
        color = _added(color, c[2], basis[k + np.uint64(2)])
        color = _added(color, c[3], basis[k + np.uint64(3)])
    if functions % 4:
        color = _added(color, last_coefficient(sh, first), basis[functions - 1])
    return color


@kernel
def _added(color: tuple, coefficient: tuple, value: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    r, g, b = coefficient
    return fma(r, value, color[0]), fma(g, value, color[1]), fma(b, value, color[2])


@kernel
def four_coefficients(sh: np.ndarray, first: int, k: Index) -> tuple:
    """Of 16 Gaussians from `first` the coefficients of functions `k` to `k` + 3, red, green and blue, [4][3].

    Loaded one function at a time projecting takes 1.4 times as long.
    """
    place = np.uint64(3) * k
    a = load_four_columns(sh, first, place)
    b, c = load_four_columns(sh, first, place + np.uint64(4)), load_four_columns(sh, first, place + np.uint64(8))
    return (a[0], a[1], a[2]), (a[3], b[0], b[1]), (b[2], b[3], c[0]), (c[1], c[2], c[3])


@kernel
def last_coefficient(sh: np.ndarray, first: int) -> tuple[Lanes, Lanes, Lanes]:
    """Of 16 Gaussians from `first` the coefficient of the last function, red, green and blue."""
    if sh.shape[1] == 3:
        return load_triples(sh, first)
    _, r, g, b = load_four_columns(sh, first, sh.shape[1] - 4)
    return r, g, b
