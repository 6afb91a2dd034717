"""Ray marching of the synthetic scene: sphere tracing, one soft-edged light, ambient occlusion.

Each object is marched separately, inside its bounding sphere, so that a ray evaluates only the objects that it passes.
"""

import math

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.scene import Camera
from msdgs_serve.threads import run_parallel, split_evenly, thread_count
from msdgs_train.datasets.synthetic.motion import GROUND_RADIUS, GROUND_Z, OBJECTS, Motion, motion_at
from msdgs_train.datasets.synthetic.shapes import GROUND, GROUND_ROUNDING, PALETTE, color_at_rest, distance_at_rest

SAMPLES = 2  # rays along each side of a pixel
MAX_STEPS = 400
HIT = 2e-4  # scene units; a pixel of an 800-pixel image is 20 times larger
SURFACE_OFFSET = 4e-3  # start of shadow rays
PENUMBRA = 7.0  # larger values give harder shadows
PENUMBRA_REACH = 0.25  # an object farther from a shadow ray doesn't dim it
OCCLUSION_STEPS = (0.03, 0.08, 0.16, 0.28)
NO_OBJECT = -1

LIGHT = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])
LIGHT_COLOR = np.array([0.62, 0.58, 0.52])
SKY_COLOR = np.array([0.60, 0.64, 0.70])
BOUNCE_COLOR = np.array([0.36, 0.33, 0.31])
GLOSS = 0.10

_PALETTE_LINEAR = np.where(PALETTE <= 0.04045, PALETTE / 12.92, ((PALETTE + 0.055) / 1.055) ** 2.4)
_MISS = 1e9


def render(camera: Camera, t: float) -> np.ndarray:
    """Render the scene at time t: [H, W, 4] uint8, sRGB, straight alpha, color 0 for rays that hit nothing."""
    motion = motion_at(t)
    linear = np.zeros((camera.height, camera.width, 4))
    view = np.ascontiguousarray(camera.camera_to_world)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    bands = split_evenly(camera.height, 4 * thread_count())
    run_parallel(_render_rows, [(motion, view, intrinsics, linear, *band) for band in bands])
    coverage = linear[..., 3:]
    rgb = linear[..., :3] / np.where(coverage > 0, coverage, 1)
    rgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * np.maximum(rgb, 0.0031308) ** (1 / 2.4) - 0.055)
    rgba = np.concatenate([np.clip(rgb, 0, 1), coverage / SAMPLES**2], axis=-1)
    return np.floor(255 * rgba + 0.5).astype(np.uint8)


@kernel
def _render_rows(motion: Motion, view: np.ndarray, intrinsics: tuple, out: np.ndarray, start: int, stop: int) -> None:
    fx, fy, cx, cy = intrinsics
    for row in range(start, stop):
        for column in range(out.shape[1]):
            for sample in range(SAMPLES * SAMPLES):
                x = (column + (sample % SAMPLES + 0.5) / SAMPLES - cx) / fx
                y = (row + (sample // SAMPLES + 0.5) / SAMPLES - cy) / fy
                length = math.sqrt(x * x + y * y + 1)
                dx = (view[0, 0] * x + view[0, 1] * y + view[0, 2]) / length
                dy = (view[1, 0] * x + view[1, 1] * y + view[1, 2]) / length
                dz = (view[2, 0] * x + view[2, 1] * y + view[2, 2]) / length
                distance, shape = first_hit(motion, view[0, 3], view[1, 3], view[2, 3], dx, dy, dz)
                if shape != NO_OBJECT:
                    px, py, pz = view[0, 3] + distance * dx, view[1, 3] + distance * dy, view[2, 3] + distance * dz
                    red, green, blue = _shade(motion, shape, px, py, pz, dx, dy, dz)
                    out[row, column, 0] += red
                    out[row, column, 1] += green
                    out[row, column, 2] += blue
                    out[row, column, 3] += 1.0


@kernel
def first_hit(motion: Motion, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> tuple[float, int]:
    """Return the distance along a unit ray to the first surface and its row in `OBJECTS`, or `NO_OBJECT`."""
    nearest, shape = _MISS, NO_OBJECT
    top = (GROUND_Z - oz) / dz if dz < 0 else -1.0
    on_top = top > 0 and math.hypot(ox + top * dx, oy + top * dy) < GROUND_RADIUS - GROUND_ROUNDING
    if on_top:  # the disc is flat here, and marching grazing rays takes longest
        nearest, shape = top, GROUND
    for index in range(len(OBJECTS)):
        if index == GROUND and on_top:
            continue
        s, end = _through_sphere(motion, index, 0.0, ox, oy, oz, dx, dy, dz)
        end = min(end, nearest)
        steps = 0
        while s < end and steps < MAX_STEPS:
            gap = _distance(motion, index, ox + s * dx, oy + s * dy, oz + s * dz)
            if gap < HIT:
                nearest, shape = s, index
                break
            s += gap
            steps += 1
    return nearest, shape


@kernel
def _through_sphere(
    motion: Motion, index: int, margin: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float]:
    """Return the distances at which a ray enters and leaves an object's bounding sphere plus a margin, or 1, 0."""
    x = ox - motion.centers[index, 0]
    y = oy - motion.centers[index, 1]
    z = oz - motion.centers[index, 2]
    radius = motion.radii[index] + margin
    along = -(x * dx + y * dy + z * dz)
    inside = radius * radius - (x * x + y * y + z * z - along * along)
    if inside <= 0:
        return 1.0, 0.0
    half = math.sqrt(inside)
    return max(along - half, 0.0), along + half


@kernel
def _to_rest(motion: Motion, index: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Map a world position to the object at rest, the inverse of `motion.world_positions`."""
    x, y, z = x - motion.offsets[index, 0], y - motion.offsets[index, 1], z - motion.offsets[index, 2]
    m = motion.inverses[index]
    u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z
    v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
    w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
    if motion.warps[index, 0] == 0 and motion.warps[index, 1] == 0 and motion.warps[index, 2] == 0:
        return u, v, w
    u -= motion.warps[index, 1] * w * w
    v -= motion.warps[index, 2] * w * w
    cos, sin = math.cos(motion.warps[index, 0] * w), math.sin(motion.warps[index, 0] * w)
    return cos * u + sin * v, cos * v - sin * u, w


@kernel
def _distance(motion: Motion, index: int, x: float, y: float, z: float) -> float:
    u, v, w = _to_rest(motion, index, x, y, z)
    return motion.shrinks[index] * distance_at_rest(index, u, v, w)


@kernel
def _normal(motion: Motion, index: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    h = 1e-4
    nx = _distance(motion, index, x + h, y, z) - _distance(motion, index, x - h, y, z)
    ny = _distance(motion, index, x, y + h, z) - _distance(motion, index, x, y - h, z)
    nz = _distance(motion, index, x, y, z + h) - _distance(motion, index, x, y, z - h)
    length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    return nx / length, ny / length, nz / length


@kernel
def _shade(
    motion: Motion, index: int, x: float, y: float, z: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float]:
    """Return the linear RGB that a surface point sends back along the ray."""
    u, v, w = _to_rest(motion, index, x, y, z)
    albedo = _PALETTE_LINEAR[color_at_rest(index, u, v, w)]
    nx, ny, nz = _normal(motion, index, x, y, z)
    facing = nx * LIGHT[0] + ny * LIGHT[1] + nz * LIGHT[2]
    light = 0.0
    if facing > 0:
        lx, ly, lz = x + SURFACE_OFFSET * nx, y + SURFACE_OFFSET * ny, z + SURFACE_OFFSET * nz
        light = _light_arriving(motion, lx, ly, lz)
    open_sky = _openness(motion, x, y, z, nx, ny, nz)
    sky = 0.5 + 0.5 * nz
    hx, hy, hz = LIGHT[0] - dx, LIGHT[1] - dy, LIGHT[2] - dz
    half = max(nx * hx + ny * hy + nz * hz, 0.0) / math.sqrt(hx * hx + hy * hy + hz * hz)
    shine = GLOSS * light * half**40 if index != GROUND else 0.0
    key = light * max(facing, 0.0)
    red = albedo[0] * (key * LIGHT_COLOR[0] + open_sky * (sky * SKY_COLOR[0] + (1 - sky) * BOUNCE_COLOR[0])) + shine
    green = albedo[1] * (key * LIGHT_COLOR[1] + open_sky * (sky * SKY_COLOR[1] + (1 - sky) * BOUNCE_COLOR[1])) + shine
    blue = albedo[2] * (key * LIGHT_COLOR[2] + open_sky * (sky * SKY_COLOR[2] + (1 - sky) * BOUNCE_COLOR[2])) + shine
    return red, green, blue


@kernel
def _light_arriving(motion: Motion, x: float, y: float, z: float) -> float:
    """Return 1 in light to 0 in shadow, from the narrowest gap along the shadow ray relative to its distance."""
    arriving = 1.0
    for index in range(len(OBJECTS)):
        if index == GROUND:  # it is below the light and all other objects
            continue
        s, end = _through_sphere(motion, index, PENUMBRA_REACH, x, y, z, LIGHT[0], LIGHT[1], LIGHT[2])
        s = max(s, SURFACE_OFFSET)
        steps = 0
        while s < end and arriving > 0.01 and steps < MAX_STEPS:
            gap = _distance(motion, index, x + s * LIGHT[0], y + s * LIGHT[1], z + s * LIGHT[2])
            arriving = min(arriving, max(PENUMBRA * gap / s, 0.0))
            s += max(gap, 0.01)
            steps += 1
    return arriving * arriving * (3 - 2 * arriving)


@kernel
def _openness(motion: Motion, x: float, y: float, z: float, nx: float, ny: float, nz: float) -> float:
    """Return ambient occlusion: 1 under the open sky, less in corners, from distances to surfaces along the normal."""
    closed, weight = 0.0, 1.0
    for step in OCCLUSION_STEPS:
        px, py, pz = x + step * nx, y + step * ny, z + step * nz
        gap = step
        for index in range(len(OBJECTS)):
            to_center = math.sqrt(
                (px - motion.centers[index, 0]) ** 2
                + (py - motion.centers[index, 1]) ** 2
                + (pz - motion.centers[index, 2]) ** 2
            )
            if to_center - motion.radii[index] < gap:
                gap = min(gap, _distance(motion, index, px, py, pz))
        closed += weight * (step - max(gap, 0.0))
        weight *= 0.6
    return max(1 - 2.4 * closed, 0.15)
