"""Videos of known truth: the synthetic toys and a large moving poster in a textured room.

World axes are those of the synthetic scene, z up. A clip's time runs from 0 to 1 of the toys' motion. The room and the
poster are planes with images on them, so that each pixel's surface is known exactly.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import orbit
from msdgs_train.datasets.synthetic.motion import GROUND_THICKNESS, GROUND_Z, Motion, motion_at
from msdgs_train.datasets.synthetic.rendering import NO_OBJECT, first_hit, render
from msdgs_train.datasets.synthetic.shapes import FRAME

ROOM = np.array([[-2.6, -3.2, GROUND_Z - GROUND_THICKNESS], [2.6, 2.3, 2.6]])
"""Opposite corners of the room; all cameras are in it."""
FIELD_OF_VIEW = 0.9  # radians, across the width
TARGET = np.array([0.0, 0.3, 0.0])
UP = np.array([0.0, 0.0, 1.0])
POSTER_SIZE = (1.8, 1.3)  # scene units
TEXELS = 0.3  # texels of the walls per scene unit and pixel of focal length: about one a pixel
REPEATABLE = {"x264-params": "asm=0"}
"""Options of libx264, whose assembly gives other videos from run to run and by CPU."""
SAMPLE_RATE = 16_000
CLAP = 0.03  # seconds


@dataclass(frozen=True)
class Clip:
    """A video and the truth about its frames."""

    file: Path
    cameras: list[Camera]
    times: np.ndarray  # [N] seconds since the video's start
    moving: np.ndarray  # [N, H, W] bool: a toy that moves, or the poster
    offset: float = 0.0  # seconds by which it starts after the first video

    @property
    def camera_to_world(self) -> np.ndarray:
        """[N, 4, 4], OpenCV axes."""
        return np.stack([camera.camera_to_world for camera in self.cameras])


def moving_camera_clip(
    file: Path,
    *,
    width: int = 256,
    frames: int = 24,
    rate: float = 12.0,
    arc: float = 45.0,
    poster: bool = True,
    seed: int = 0,
) -> Clip:
    """Write a video of a camera that moves along an arc in degrees around the toys, with the poster behind them."""
    parts = np.linspace(0, 1, frames)
    azimuths = -90 + 0.5 * arc * np.cos(math.pi * parts)
    elevations = 17 + 7 * np.sin(5 * parts)
    distances = 2.35 + 0.2 * np.sin(4 * parts)
    poses = [_pose(*view) for view in zip(distances, azimuths, elevations, strict=True)]
    return clip_of_poses(file, poses, width=width, rate=rate, poster=poster, seed=seed)


def clip_of_poses(
    file: Path,
    poses: Sequence[np.ndarray],
    *,
    width: int = 256,
    rate: float = 12.0,
    poster: bool = False,
    seed: int = 0,
) -> Clip:
    """Write a video of a camera that has these poses, camera to world, one after the other."""
    return _written(file, poses, width, views_of_poses(poses, width, poster=poster, seed=seed), rate)


def views_of_poses(
    poses: Sequence[np.ndarray], width: int, *, poster: bool = False, seed: int = 0
) -> list[tuple[np.ndarray, np.ndarray]]:
    """What a camera of these poses sees while time runs from 0 to 1: images, [H, W, 3] uint8, and where they move,
    [H, W] bool."""
    textures, times = _Textures(width, seed), np.linspace(0, 1, len(poses))
    return [_shot(_camera(pose, width), t, textures, poster) for pose, t in zip(poses, times, strict=True)]


def fixed_camera_clips(
    folder: Path, *, width: int = 256, frames: int = 24, rate: float = 12.0, offsets: tuple[float, ...], seed: int = 0
) -> list[Clip]:
    """Write a video with sound for each offset in seconds, of cameras that stand around the toys."""
    textures, random = _Textures(width, seed), np.random.default_rng(seed)
    length = frames / rate + max(offsets)
    sound = _claps(length, random)
    clips = []
    for index, offset in enumerate(offsets):
        azimuth = -90 + 18 * (index - (len(offsets) - 1) / 2)
        pose = _pose(2.3 + 0.15 * (index % 2), azimuth, 14 + 9 * (index % 3))
        times = [(offset + frame / rate) / length for frame in range(frames)]
        views = [_shot(_camera(pose, width), t, textures, poster=False) for t in times]
        heard = sound[round(offset * SAMPLE_RATE) :][: round(frames / rate * SAMPLE_RATE)]
        heard = heard + 0.01 * random.standard_normal(len(heard))
        file = folder / f"cam{index + 1}.mp4"
        clips.append(_written(file, [pose] * frames, width, views, rate, heard, offset))
    return clips


def write_video(file: Path, images: list[np.ndarray], rate: float, sound: np.ndarray | None = None) -> None:
    """Write [H, W, 3] uint8 images as H.264, and [S] float sound in [-1, 1] at `SAMPLE_RATE` as AAC."""
    with av.open(str(file), "w") as container:
        height, width = images[0].shape[:2]
        options = {"crf": "18", "preset": "veryfast", **REPEATABLE}
        video = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000), options=options)
        video.width, video.height, video.pix_fmt = width, height, "yuv420p"
        audio = None if sound is None else container.add_stream("aac", rate=SAMPLE_RATE, layout="mono")
        for image in images:
            container.mux(video.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(video.encode())
        if sound is not None and audio is not None:
            heard = av.AudioFrame.from_ndarray(sound.astype(np.float32)[None], format="fltp", layout="mono")
            heard.sample_rate = SAMPLE_RATE
            container.mux(audio.encode(heard))
            container.mux(audio.encode())


def _written(
    file: Path,
    poses: Sequence[np.ndarray],
    width: int,
    views: list[tuple[np.ndarray, np.ndarray]],
    rate: float,
    sound: np.ndarray | None = None,
    offset: float = 0.0,
) -> Clip:
    images, moving = zip(*views, strict=True)
    write_video(file, list(images), rate, sound)
    cameras = [_camera(pose, width) for pose in poses]
    return Clip(file, cameras, np.arange(len(images)) / rate, np.stack(moving), offset)


def _pose(distance: float, azimuth: float, elevation: float) -> np.ndarray:
    return orbit(TARGET, float(distance), float(azimuth), float(elevation), UP)


def _camera(pose: np.ndarray, width: int) -> Camera:
    height = width * 3 // 4
    focal = 0.5 * width / math.tan(0.5 * FIELD_OF_VIEW)
    return Camera(focal, focal, width / 2, height / 2, width, height, pose)


class _Textures:
    """Images on the room's six faces and on the poster, sharp at the size of the video."""

    def __init__(self, width: int, seed: int) -> None:
        random = np.random.default_rng(seed)
        self.scale = TEXELS * 0.5 * width / math.tan(0.5 * FIELD_OF_VIEW)
        sizes = ROOM[1] - ROOM[0]
        self.faces = [
            [_collage(np.delete(sizes, axis) * self.scale, random, contrast=0.9) for _ in range(2)] for axis in range(3)
        ]
        self.poster = _collage(np.array(POSTER_SIZE) * self.scale, random, contrast=0.4)


def _collage(size: np.ndarray, random: np.random.Generator, contrast: float) -> np.ndarray:
    """[H, W, 3] float32 in [0, 1] that covers `size`, [2], width and height: rectangles of many sizes and grain."""
    shape = (math.ceil(size[1]) + 1, math.ceil(size[0]) + 1)
    image = np.full((*shape, 3), 0.5, np.float32)
    for side in np.geomspace(0.3 * min(shape), 4, 500):
        x, y = random.uniform(0, shape[1]), random.uniform(0, shape[0])
        w, h = side * random.uniform(0.4, 1.6, 2)
        box = np.array(cv2.boxPoints(((x, y), (w, h), random.uniform(0, 90))), np.int32)
        color = 0.5 + contrast * random.uniform(-0.5, 0.5, 3)
        cv2.fillConvexPoly(image, box, color.tolist(), cv2.LINE_AA)
    grain = cv2.GaussianBlur(random.standard_normal(shape).astype(np.float32), (0, 0), 1.5)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.7) + 0.15 * contrast * grain[..., None], 0, 1)


def _shot(camera: Camera, t: float, textures: _Textures, poster: bool) -> tuple[np.ndarray, np.ndarray]:
    """The image, [H, W, 3] uint8, and where it moves, [H, W] bool."""
    origin, rays = camera.camera_to_world[:3, 3], _rays(camera)
    image, moving = _room(origin, rays, textures), np.zeros(rays.shape[:2], bool)
    if poster:
        on_poster, color = _poster(origin, rays, t, textures)
        image[on_poster] = color
        moving |= on_poster
    toys = render(camera, t).astype(np.float32) / 255
    image += toys[..., 3:] * (toys[..., :3] - image)
    objects = np.empty(rays.shape[:2], np.int64)
    _first_objects(motion_at(t), origin, np.ascontiguousarray(rays), objects)
    moving = np.where(objects == NO_OBJECT, moving, objects > FRAME)
    return np.floor(255 * image + 0.5).astype(np.uint8), moving


def _rays(camera: Camera) -> np.ndarray:
    """[H, W, 3] directions in the world, of length 1."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = local @ camera.camera_to_world[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _room(origin: np.ndarray, rays: np.ndarray, textures: _Textures) -> np.ndarray:
    """[H, W, 3] colors of the faces at which the rays leave the room."""
    with np.errstate(divide="ignore"):
        reach = (np.where(rays > 0, ROOM[1], ROOM[0]) - origin) / rays  # [H, W, 3]
    axes = reach.argmin(axis=-1)
    hits = origin + reach.min(axis=-1, keepdims=True) * rays - ROOM[0]
    image = np.empty(rays.shape, np.float32)
    for axis in range(3):
        for side in range(2):
            here = (axes == axis) & ((rays[..., axis] > 0) == bool(side))
            image[here] = _sampled(textures.faces[axis][side], np.delete(hits[here], axis, axis=1), textures.scale)
    return image


def _poster(origin: np.ndarray, rays: np.ndarray, t: float, textures: _Textures) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays hit the poster, [H, W] bool, and its colors there."""
    turn = 0.25 * math.sin(2.2 * math.pi * t)
    right, up = np.array([math.cos(turn), math.sin(turn), 0.0]), UP
    center = np.array([0.35 * math.sin(4 * math.pi * t), 1.45, 0.55 + 0.2 * math.sin(5 * math.pi * t)])
    normal = np.cross(right, up)
    reach = ((center - origin) @ normal) / (rays @ normal)
    hits = origin + reach[..., None] * rays - center
    place = np.stack([hits @ right, -hits @ up], axis=-1) + np.array(POSTER_SIZE) / 2
    on_poster = (reach > 0) & (place >= 0).all(axis=-1) & (place <= POSTER_SIZE).all(axis=-1)
    return on_poster, _sampled(textures.poster, place[on_poster], textures.scale)


def _sampled(texture: np.ndarray, places: np.ndarray, scale: float) -> np.ndarray:
    """[N, 3] bilinear colors at places in scene units."""
    x, y = np.ascontiguousarray((places * scale).T, np.float32)
    height, width = texture.shape[:2]
    x, y = np.clip(x, 0, width - 1.001), np.clip(y, 0, height - 1.001)
    i, j = y.astype(int), x.astype(int)
    u, v = (x - j)[:, None], (y - i)[:, None]
    top = texture[i, j] * (1 - u) + texture[i, j + 1] * u
    return (1 - v) * top + v * (texture[i + 1, j] * (1 - u) + texture[i + 1, j + 1] * u)


@kernel
def _first_objects(motion: Motion, origin: np.ndarray, rays: np.ndarray, out: np.ndarray) -> None:
    """Write the row of the object that each ray hits first, or `NO_OBJECT`, to [H, W]."""
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            dx, dy, dz = rays[i, j, 0], rays[i, j, 1], rays[i, j, 2]
            out[i, j] = first_hit(motion, origin[0], origin[1], origin[2], dx, dy, dz)[1]


def _claps(length: float, random: np.random.Generator) -> np.ndarray:
    """[S] sound of short bursts of noise at irregular times."""
    sound = np.zeros(math.ceil(length * SAMPLE_RATE))
    burst = round(CLAP * SAMPLE_RATE)
    for start in np.cumsum(random.uniform(0.1, 0.5, math.ceil(5 * length))):
        first = round(start * SAMPLE_RATE)
        if first + burst <= len(sound):
            sound[first : first + burst] = 0.6 * random.uniform(-1, 1, burst) * np.linspace(1, 0, burst)
    return sound
