"""The kernel of the photometric loss and its gradient: L1, MSE and SSIM in one pass over the image.

SSIM blurs four maps of the images and, for the gradient, three of its derivatives. Only the eleven rows around the
present one are kept of each, blurred along the row: with whole maps an image of 400×400 takes 1.6 times as long.
"""

import numpy as np

from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.simd.memory import load, store
from msdgs_serve.rasterizer.simd.types import NUM_LANES, Index, Vector
from msdgs_serve.rasterizer.simd.vectors import filled, fma, maximum, select

RADIUS = 5  # pixels; the window is 11 pixels wide
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


_WEIGHTS = np.exp(-(np.arange(-RADIUS, RADIUS + 1) ** 2) / (2 * SIGMA**2))
TAPS = _WEIGHTS / _WEIGHTS.sum()

ROWS = 2 * RADIUS + 1
MARGIN = 3 * RADIUS
"""Zeros on both sides of a row of colors while it is blurred."""


@kernel
def loss_sums_and_gradient(
    x: np.ndarray, y: np.ndarray, taps: tuple[float, ...], weights: tuple[float, float, float], gradient: np.ndarray
) -> np.ndarray:
    """Return the sums of |x - y|, (x - y)² and SSIM over images [H, W * 3], and write the gradient in x, of the same
    shape, of these sums times `weights`; SSIM is 0 if its weight is. `taps` are the first six of the window, which is
    symmetric."""
    height, width = x.shape
    lanes = (width + NUM_LANES - 1) // NUM_LANES * NUM_LANES
    maps, slopes = np.zeros((ROWS, 4, lanes), x.dtype), np.zeros((ROWS, 3, lanes), x.dtype)
    wide, pixels = np.zeros((4, lanes + 2 * MARGIN), x.dtype), np.zeros((2, lanes), x.dtype)
    wide_slopes, out, sums = np.zeros_like(wide[:3]), np.zeros(lanes, x.dtype), np.zeros((3, lanes), x.dtype)
    compares = weights[2] != 0
    for row in range(height + 2 * RADIUS):
        if compares and row < height:
            wide[0, MARGIN : MARGIN + width], wide[1, MARGIN : MARGIN + width] = x[row], y[row]
            _multiply(wide)
            _blur_rows(wide, taps, maps[row % ROWS])
        else:
            maps[row % ROWS] = 0
        middle = row - RADIUS
        if compares and 0 <= middle < height:
            _compare(maps, _rows_around(middle, 4 * lanes), taps, wide_slopes, sums[2])
            wide_slopes[:, MARGIN + width :] = 0
            _blur_rows(wide_slopes, taps, slopes[middle % ROWS])
        elif middle >= height:
            slopes[middle % ROWS] = 0
        last = middle - RADIUS
        if last >= 0:
            pixels[0, :width], pixels[1, :width] = x[last], y[last]
            _differentiate(pixels, slopes, _rows_around(last, 3 * lanes), taps, weights, out, sums)
            gradient[last] = out[:width]
    return sums[:, :width].astype(np.float64).sum(axis=1)


@inlined_kernel
def _multiply(wide: np.ndarray) -> None:
    """Write x² + y² and xy, of padded rows of x and y, below them."""
    flat, size = wide.reshape(-1), np.uint64(wide.shape[1])
    for j in range(np.uint64(MARGIN), size - np.uint64(MARGIN), np.uint64(NUM_LANES)):
        a, b = load(flat, j), load(flat, size + j)
        store(flat, np.uint64(2) * size + j, a * a + b * b)
        store(flat, np.uint64(3) * size + j, a * b)


@kernel
def _blur_rows(wide: np.ndarray, taps: tuple[float, ...], out: np.ndarray) -> None:
    """Blur padded rows [M, lanes + 2 MARGIN] along themselves into [M, lanes]."""
    flat, flat_out = wide.reshape(-1), out.reshape(-1)
    lanes, size = np.uint64(out.shape[1]), np.uint64(wide.shape[1])
    for m in range(np.uint64(len(out))):
        for j in range(np.uint64(0), lanes, np.uint64(NUM_LANES)):
            store(flat_out, m * lanes + j, _blurred(flat, _COLUMNS, m * size + j, taps))


@kernel
def _compare(
    maps: np.ndarray, places: tuple, taps: tuple[float, ...], wide_slopes: np.ndarray, sums: np.ndarray
) -> None:
    """Add SSIM of one row to `sums`, and write its derivatives in blur(x), blur(x²) and blur(xy) as padded rows."""
    flat, flat_slopes = maps.reshape(-1), wide_slopes.reshape(-1)
    lanes, size = np.uint64(len(sums)), np.uint64(wide_slopes.shape[1])
    for j in range(np.uint64(0), lanes, np.uint64(NUM_LANES)):
        mx = _blurred(flat, places, j, taps)
        my = _blurred(flat, places, lanes + j, taps)
        squares = _blurred(flat, places, np.uint64(2) * lanes + j, taps)
        xy = _blurred(flat, places, np.uint64(3) * lanes + j, taps)
        means = mx * mx + my * my
        top1, top2 = 2 * mx * my + C1, 2 * (xy - mx * my) + C2
        inverse1, inverse2 = 1 / (means + C1), 1 / (squares - means + C2)
        scale = inverse1 * inverse2
        value = top1 * top2 * scale
        store(sums, j, load(sums, j) + value)
        place = np.uint64(MARGIN) + j
        store(flat_slopes, place, 2 * (my * (top2 - top1) * scale - mx * value * (inverse1 - inverse2)))
        store(flat_slopes, size + place, -value * inverse2)
        store(flat_slopes, np.uint64(2) * size + place, 2 * top1 * scale)


@kernel
def _differentiate(
    pixels: np.ndarray,
    slopes: np.ndarray,
    places: tuple,
    taps: tuple[float, ...],
    weights: tuple[float, float, float],
    out: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Add |x - y| and (x - y)² of one row to `sums`, and write its gradient in x; a blur is its own transpose."""
    flat, flat_slopes, flat_sums, lanes = pixels.reshape(-1), slopes.reshape(-1), sums.reshape(-1), np.uint64(len(out))
    for j in range(np.uint64(0), lanes, np.uint64(NUM_LANES)):
        x, y = load(flat, j), load(flat, lanes + j)
        error = x - y
        store(flat_sums, j, load(flat_sums, j) + maximum(error, -error))
        store(flat_sums, lanes + j, fma(error, error, load(flat_sums, lanes + j)))
        absolute = filled(weights[0], error)
        sign = select(error > 0, absolute, select(error < 0, -absolute, 0 * error))
        by_x = _blurred(flat_slopes, places, j, taps)
        by_xx = _blurred(flat_slopes, places, lanes + j, taps)
        by_xy = _blurred(flat_slopes, places, np.uint64(2) * lanes + j, taps)
        structure = by_x + 2 * x * by_xx + y * by_xy
        store(out, j, sign + 2 * weights[1] * error + weights[2] * structure)


_COLUMNS = tuple(np.uint64(3 * k) for k in range(ROWS))


@inlined_kernel
def _rows_around(row: int, size: int) -> tuple:
    """Where the 11 rows around one are in a ring of rows of this size."""
    return (
        np.uint64((row + 6) % ROWS * size),
        np.uint64((row + 7) % ROWS * size),
        np.uint64((row + 8) % ROWS * size),
        np.uint64((row + 9) % ROWS * size),
        np.uint64((row + 10) % ROWS * size),
        np.uint64(row % ROWS * size),
        np.uint64((row + 1) % ROWS * size),
        np.uint64((row + 2) % ROWS * size),
        np.uint64((row + 3) % ROWS * size),
        np.uint64((row + 4) % ROWS * size),
        np.uint64((row + 5) % ROWS * size),
    )


@inlined_kernel
def _blurred(source: np.ndarray, places: tuple, j: Index, taps: tuple[float, ...]) -> Vector:
    """The symmetric sum of 16 numbers at each of 11 places, from `j` on, times the taps."""
    return (
        taps[5] * load(source, places[5] + j)
        + taps[4] * (load(source, places[4] + j) + load(source, places[6] + j))
        + taps[3] * (load(source, places[3] + j) + load(source, places[7] + j))
        + taps[2] * (load(source, places[2] + j) + load(source, places[8] + j))
        + taps[1] * (load(source, places[1] + j) + load(source, places[9] + j))
        + taps[0] * (load(source, places[0] + j) + load(source, places[10] + j))
    )
