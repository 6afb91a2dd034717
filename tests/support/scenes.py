"""Gaussians and cameras for the tests: random ones by seed, and adversarial ones by name."""

import functools
from collections.abc import Callable

import numpy as np

from msdgs_serve.rasterizer import GSPLAT, INRIA, rasterize
from msdgs_serve.scene import Camera, Gaussians
from msdgs_serve.scene.camera import look_at

Scene = tuple[Gaussians, Camera]

draw = functools.partial(rasterize, depth=True)
"""The channels that are drawn by default."""

OPTIONS = {
    "gsplat": GSPLAT,
    "inria": INRIA,
    "sharp": GSPLAT._replace(eps2d=0.15),
    "others": GSPLAT._replace(eps2d=1.5, alpha_min=0.01, transmittance_min=0.01),
}
"""Options of the rasterizer by name."""

FIELDS = ("means", "quats", "scales", "opacities", "sh")
IDENTITY_ROTATION = (1.0, 0.0, 0.0, 0.0)


def unit_quats(rng: np.random.Generator, count: int) -> np.ndarray:
    """[count, 4] rotations, evenly distributed."""
    quats = rng.normal(size=(count, 4))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def random_gaussians(
    rng: np.random.Generator, count: int, *, sh_degree: int = 3, scales: tuple[float, float] = (0.01, 0.3)
) -> Gaussians:
    """In the cube [-1.3, 1.3]³, sizes log-uniform, float64."""
    sh = rng.normal(size=(count, (sh_degree + 1) ** 2, 3)) * 0.15
    sh[:, 0] = rng.uniform(-1.5, 1.5, size=(count, 3))
    return Gaussians(
        means=rng.uniform(-1.3, 1.3, size=(count, 3)),
        quats=unit_quats(rng, count),
        scales=np.exp(rng.uniform(*np.log(scales), size=(count, 3))),
        opacities=rng.uniform(0.02, 1.0, size=count),
        sh=sh,
    )


def random_camera(rng: np.random.Generator, width: int, height: int) -> Camera:
    """Outside the cube, looking into it; pixels not square, principal point not in the centre."""
    eye = rng.normal(size=3)
    eye *= 4 / np.linalg.norm(eye)
    pose = look_at(eye, rng.uniform(-0.3, 0.3, size=3), rng.normal(size=3))
    focal = 1.3 * max(width, height) * rng.uniform(0.8, 1.2, size=2)
    center = np.array([width, height]) * rng.uniform(0.35, 0.65, size=2)
    return Camera(focal[0], focal[1], center[0], center[1], width, height, pose)


def pixel_of(camera: Camera, point: object) -> np.ndarray:
    """The pixel [2] of a world point before a pinhole camera."""
    x, y, z = (camera.world_to_camera @ [*np.asarray(point, float), 1.0])[:3]
    assert z > 0, "behind the camera"
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def random_scene(seed: int, count: int, width: int = 53, height: int = 37, *, sh_degree: int = 3) -> Scene:
    """float32, as in the service. The default size is no multiple of the tile's."""
    rng = np.random.default_rng(seed)
    return as_dtype(random_gaussians(rng, count, sh_degree=sh_degree), np.float32), random_camera(rng, width, height)


def as_dtype(gaussians: Gaussians, dtype: type) -> Gaussians:
    """The same numbers, rounded to `dtype`."""
    return Gaussians(**{name: getattr(gaussians, name).astype(dtype) for name in FIELDS})


def select(gaussians: Gaussians, index: np.ndarray | slice) -> Gaussians:
    """The Gaussians at `index`, in that order."""
    return Gaussians(**{name: getattr(gaussians, name)[index] for name in FIELDS})


def joined(*parts: Gaussians) -> Gaussians:
    """All Gaussians of several sets, in order."""
    return Gaussians(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in FIELDS})


def front_camera(width: int = 53, height: int = 37, focal: float = 40.0) -> Camera:
    """At the origin, looking along +z: depths are the z of the means, exactly."""
    return Camera(focal, focal, width / 2, height / 2, width, height, np.eye(4))


def gaussians_of(
    means: object,
    *,
    scales: object = 0.1,
    opacities: object = 0.7,
    rgb: object = None,
    quats: object = IDENTITY_ROTATION,
    dtype: type = np.float32,
) -> Gaussians:
    """Gaussians of degree 0 from lists; colors differ by index unless `rgb` is given."""
    means = np.asarray(means, float).reshape(-1, 3)
    count = len(means)
    if rgb is None:
        rgb = np.random.default_rng(count).uniform(0.05, 0.95, size=(count, 3))
    sh = (np.broadcast_to(np.asarray(rgb, float), (count, 3)) - 0.5) * np.sqrt(4 * np.pi)
    scales = np.asarray(scales, float)
    return as_dtype(
        Gaussians(
            means=means,
            quats=np.broadcast_to(np.asarray(quats, float), (count, 4)),
            scales=np.broadcast_to(scales[:, None] if scales.ndim == 1 else scales, (count, 3)),
            opacities=np.broadcast_to(np.asarray(opacities, float), (count,)),
            sh=sh[:, None, :],
        ),
        dtype,
    )


def equal_depths() -> Scene:
    """Ties: forty splats at exactly z = 2, and pairs of identical ones that differ in color only."""
    rng = np.random.default_rng(0)
    means = np.column_stack([rng.uniform(-1.2, 1.2, size=(40, 2)), np.full(40, 2.0)])
    return gaussians_of(np.concatenate([means, means[:10]]), scales=0.25), front_camera()


def behind_camera() -> Scene:
    """Half of the splats behind the eye, some exactly level with it; those in front must be drawn alone."""
    rng = np.random.default_rng(1)
    means = rng.uniform(-1, 1, size=(60, 3)) * [1, 1, 3]
    means[:5, 2] = 0.0
    return gaussians_of(means, scales=0.15), front_camera()


def near_plane() -> Scene:
    """Large splats with centers just before, on and behind the near plane, which they all cross."""
    z = np.array([0.005, 0.01, np.nextafter(np.float32(0.01), np.float32(1)), 0.011, 0.02, 0.1])
    means = np.column_stack([np.linspace(-0.002, 0.002, 6), np.linspace(0.002, -0.002, 6), z])
    return gaussians_of(means, scales=0.5, opacities=0.3), front_camera()


def off_axis_89() -> Scene:
    """Splats at 89° off the axis, on all sides: their Jacobian is clamped, or they would fill the image."""
    angle, around = np.radians(89), np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.full(8, np.cos(angle))])
    return gaussians_of(np.concatenate([2 * ring, [[0, 0, 3]]]), scales=0.4), front_camera()


def inside_splat() -> Scene:
    """The eye is inside of several large splats, with small ones behind."""
    means = [[0, 0, 0.05], [0.1, 0, 0.3], [0, -0.2, 0.5], [0, 0, -0.2], [0.3, 0.3, 2]]
    return gaussians_of(means, scales=[0.8, 1.0, 1.5, 2.0, 0.1], opacities=[0.3, 0.4, 0.4, 0.9, 0.9]), front_camera()


def needles() -> Scene:
    """Aspect 1,000 and more, in all directions, far longer than the image."""
    rng = np.random.default_rng(2)
    count = 30
    means = np.column_stack([rng.uniform(-1, 1, size=(count, 2)), rng.uniform(2, 4, count)])
    scales = np.column_stack([rng.uniform(1, 5, count), np.full(count, 1e-3), np.full(count, 2e-3)])
    return gaussians_of(means, scales=scales, quats=unit_quats(rng, count)), front_camera()


def huge() -> Scene:
    """Each covers the whole image, some are a thousand times as large."""
    means = np.column_stack([np.linspace(-1, 1, 6), np.linspace(1, -1, 6), np.linspace(2, 8, 6)])
    return gaussians_of(means, scales=[1, 3, 10, 30, 100, 1000], opacities=0.2), front_camera()


def subpixel() -> Scene:
    """Far smaller than a pixel: only the dilation of the covariance makes them visible."""
    rng = np.random.default_rng(3)
    means = np.column_stack([rng.uniform(-1, 1, size=(200, 2)), rng.uniform(1.5, 3, 200)])
    return gaussians_of(means, scales=10 ** rng.uniform(-12, -4, 200)), front_camera()


def opacity_extremes() -> Scene:
    """Opacity 0, 1, and just above and below what one step of an 8-bit image can show."""
    rng = np.random.default_rng(4)
    opacities = np.repeat([0.0, 1e-30, 0.0039, 0.00394, 0.5, 0.999, 1.0], 10)
    means = np.column_stack([rng.uniform(-1, 1, size=(70, 2)), rng.uniform(1.5, 3, 70)])
    return gaussians_of(means, scales=0.2, opacities=opacities), front_camera()


def crowd() -> Scene:
    """A thousand splats behind one another on one pixel, so transparent that hundreds are blended."""
    depths = np.linspace(2, 6, 1000)
    rng = np.random.default_rng(5)
    opacities = rng.uniform(0.004, 0.02, 1000)
    means = np.column_stack([0.01 * depths, 0.01 * depths, depths])
    return gaussians_of(means, scales=0.02, opacities=opacities), front_camera(19, 17)


def needles_of_a_million() -> Scene:
    """Aspect 1e6 : 1, in all directions; some far longer than the image, some thinner than float32 resolves."""
    rng = np.random.default_rng(8)
    count = 33
    means = np.column_stack([rng.uniform(-1, 1, size=(count, 2)), rng.uniform(2, 4, count)])
    lengths = np.exp(rng.uniform(np.log(0.1), np.log(100), count))
    scales = lengths[:, None] * [1, 1e-6, 1e-6]
    return gaussians_of(means, scales=scales, quats=unit_quats(rng, count)), front_camera()


def unbounded_splats() -> Scene:
    """Over the whole frame, round and flat, up to e²⁰ scene units, with small ones before and behind them."""
    rng = np.random.default_rng(9)
    log_scales = np.linspace(0, 20, 21)
    scales = np.exp(np.column_stack([log_scales, log_scales, np.where(np.arange(21) % 2, log_scales, -3)]))
    means = np.column_stack([rng.uniform(-1, 1, size=(21, 2)), np.linspace(2, 8, 21)])
    huge = gaussians_of(means, scales=scales, opacities=0.15, quats=unit_quats(rng, 21))
    return joined(huge, gaussians_of(means[::2] * [0.5, 0.5, 1] - [0, 0, 0.1], scales=0.1)), front_camera()


def ten_thousand_on_a_pixel() -> Scene:
    """One pixel's list is as long as the scene; most of it is behind the end of the transmittance."""
    depths = np.linspace(2, 6, 10_000)
    means = np.column_stack([0.01 * depths, 0.01 * depths, depths])
    opacities = np.random.default_rng(10).uniform(0.004, 0.02, 10_000)
    return gaussians_of(means, scales=0.005 * depths, opacities=opacities), front_camera(17, 9)


def at_the_camera() -> Scene:
    """Centres exactly at the eye, beside it in its plane, and a step before it; one splat beyond."""
    means = [[0, 0, 0], [0, 0, 0], [0.3, 0, 0], [0, -0.3, 0], [0, 0, 1e-30], [0, 0, 0.02], [0.2, 0.1, 2]]
    return gaussians_of(means, scales=[0.5, 1e-6, 0.5, 0.5, 0.5, 0.01, 0.1], opacities=0.6), front_camera()


def through_the_near_plane() -> Scene:
    """Discs and needles along the axis, which extend from behind the eye to far in front of it."""
    rng = np.random.default_rng(11)
    means = np.column_stack([rng.uniform(-0.3, 0.3, size=(17, 2)), np.geomspace(0.0101, 1.0, 17)])
    return gaussians_of(means, scales=[[0.02, 0.05, 2.0]] * 17, opacities=0.4), front_camera()


def principal_point_outside() -> Scene:
    """The optical axis leaves the image: only a side view of the scene is seen."""
    gaussians, camera = random_scene(6, 150)
    return gaussians, Camera(camera.fx, camera.fy, -9.25, camera.height + 4.5, 53, 37, camera.camera_to_world)


def oblong_pixels() -> Scene:
    """Pixels four times as wide as high."""
    gaussians, camera = random_scene(7, 150)
    return gaussians, Camera(15.0, 60.0, camera.cx, camera.cy, 53, 37, camera.camera_to_world)


ADVERSARIAL: dict[str, Callable[[], Scene]] = {
    scene.__name__: scene
    for scene in (
        equal_depths, behind_camera, near_plane, off_axis_89, inside_splat, needles, huge, subpixel, opacity_extremes,
        crowd, needles_of_a_million, unbounded_splats, ten_thousand_on_a_pixel, at_the_camera, through_the_near_plane,
        principal_point_outside, oblong_pixels,
    )
}  # fmt: skip
