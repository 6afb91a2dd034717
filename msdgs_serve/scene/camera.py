"""Cameras in OpenCV axes: x right, y down, z forward; pixel centers at half-integers."""

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from msdgs_serve.scene.errors import InvalidInput

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Multiply a camera-to-world matrix by it from the right to flip the camera's y and z axes."""

MAX_PIXELS_PER_SIDE = 16384
MAX_SKEW = 2e-3
"""Of products of axes; those of three decimals are off by up to 2 √3 × 5e-4."""

CameraModel = Literal["pinhole", "orthographic", "fisheye"]
"""Projection of a point (x, y, z) in camera axes. Pinhole: fx x / z + cx. Orthographic: fx x + cx, with fx in pixels
per scene unit. Fisheye: fx rho(theta) x / r + cx, with r the distance from the axis, theta the angle to it, and rho =
theta (1 + k1 theta² + k2 theta⁴ + k3 theta⁶ + k4 theta⁸), as in OpenCV. Only points in front of the camera are
drawn."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels and a pose. The principal point (cx, cy) may lie anywhere."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    camera_to_world: np.ndarray  # [4, 4] float64, rigid
    model: CameraModel = "pinhole"
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # k1 to k4 of a fisheye camera

    def __post_init__(self) -> None:
        self._convert_numbers()
        for name in ("fx", "fy"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidInput(f"camera.{name}", "finite and above 0 pixels", getattr(self, name))
        for name in ("cx", "cy"):
            if not math.isfinite(getattr(self, name)):
                raise InvalidInput(f"camera.{name}", "finite", getattr(self, name))
        for name in ("width", "height"):
            value = getattr(self, name)
            if not (type(value) is int and 1 <= value <= MAX_PIXELS_PER_SIDE):
                raise InvalidInput(f"camera.{name}", f"an integer in [1, {MAX_PIXELS_PER_SIDE}]", value)
        object.__setattr__(self, "camera_to_world", _rigid(self.camera_to_world))
        if self.model not in get_args(CameraModel):
            raise InvalidInput("camera.model", f"one of {', '.join(get_args(CameraModel))}", self.model)
        if len(self.distortion) != 4 or not all(math.isfinite(k) for k in self.distortion):
            raise InvalidInput("camera.distortion", "4 finite numbers", self.distortion)
        if any(self.distortion) and self.model != "fisheye":
            raise InvalidInput("camera.distortion", "0 unless camera.model is fisheye", self.distortion)

    def _convert_numbers(self) -> None:
        """Convert NumPy's numbers to Python's: kernels are compiled for one type. Distortion has any shape, as those of
        OpenCV."""
        for name in ("fx", "fy", "cx", "cy"):
            try:
                object.__setattr__(self, name, float(getattr(self, name)))
            except (TypeError, ValueError):
                raise InvalidInput(f"camera.{name}", "a number", repr(getattr(self, name))) from None
        for name in ("width", "height"):
            if isinstance(getattr(self, name), np.integer):
                object.__setattr__(self, name, int(getattr(self, name)))
        try:
            distortion = tuple(np.asarray(self.distortion, np.float64).ravel().tolist())
        except (TypeError, ValueError):
            raise InvalidInput("camera.distortion", "4 finite numbers", repr(self.distortion)) from None
        object.__setattr__(self, "distortion", distortion)

    @property
    def world_to_camera(self) -> np.ndarray:
        """[4, 4] float64, the inverse of `camera_to_world`."""
        rotation, position = self.camera_to_world[:3, :3], self.camera_to_world[:3, 3]
        inverse = np.eye(4)
        inverse[:3, :3] = rotation.T
        inverse[:3, 3] = -rotation.T @ position
        return inverse

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points [N, 3]. Return pixels [N, 2] and depths along the axis [N] in scene units.

        Pixels are undefined for depths of 0 or less.
        """
        world_to_camera = self.world_to_camera
        seen = np.asarray(points, np.float64) @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        plane, depths = seen[:, :2], seen[:, 2]
        if self.model == "pinhole":
            plane = plane / np.where(depths > 0, depths, 1)[:, None]
        elif self.model == "fisheye":
            radii = np.hypot(plane[:, 0], plane[:, 1])
            theta = np.arctan2(radii, depths)
            powers = theta[:, None] ** (2, 4, 6, 8)
            stretch = theta * (1 + powers @ np.array(self.distortion)) / np.where(radii > 0, radii, 1)
            plane = plane * np.where(radii > 0, stretch, 1)[:, None]
        return plane * (self.fx, self.fy) + (self.cx, self.cy), depths

    def visible_depths(self, points: np.ndarray) -> np.ndarray:
        """Depths along the axis [N] of world points [N, 3] in scene units; 0 for points that aren't in the image.

        What hides a point isn't known.
        """
        pixels, depths = self.project(points)
        inside = (pixels >= 0) & (pixels < (self.width, self.height))
        return np.where(inside.all(axis=1), np.maximum(depths, 0), 0)

    @property
    def position(self) -> np.ndarray:
        """[3] center of projection in world space; for an orthographic camera, a point on its axis."""
        return self.camera_to_world[:3, 3]

    def resized(self, width: int, height: int) -> "Camera":
        """Return a camera with the same view and another image size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def of_size(self, width: int, height: int) -> "Camera":
        """Return a camera with the same vertical view and shape of pixels, and another image size: an image of other
        proportions shows more or less at its sides."""
        scale, across = height / self.height, width / self.width
        if min(abs(width - self.width * scale), abs(height - self.height * across)) < 1:
            return self.resized(width, height)
        cx = width / 2 + (self.cx - self.width / 2) * scale
        return replace(
            self, fx=self.fx * scale, fy=self.fy * scale, cx=cx, cy=self.cy * scale, width=width, height=height
        )

    @classmethod
    def from_fov(cls, camera_to_world: np.ndarray, width: int, height: int, fov_y: float) -> "Camera":
        """Return a camera with square pixels and centered principal point; `fov_y` is vertical, in degrees."""
        if not 0 < fov_y < 180:
            raise InvalidInput("camera.fov_y", "in (0, 180) degrees", fov_y)
        focal = 0.5 * height / math.tan(0.5 * math.radians(fov_y))
        return cls(focal, focal, width / 2, height / 2, width, height, camera_to_world)

    @classmethod
    def from_look_at(
        cls, eye: np.ndarray, target: np.ndarray, up: np.ndarray, width: int, height: int, fov_y: float
    ) -> "Camera":
        """Return a camera at `eye` that looks at `target`, with the world direction `up` upwards in the image."""
        return cls.from_fov(look_at(eye, target, up), width, height, fov_y)

    @classmethod
    def from_opengl(
        cls, camera_to_world: np.ndarray, width: int, height: int, *, fx: float, fy: float, cx: float, cy: float
    ) -> "Camera":
        """Return a camera from a pose in OpenGL axes (x right, y up, z backward), as in NeRF, Blender and D-NeRF."""
        return cls(fx, fy, cx, cy, width, height, np.asarray(camera_to_world, float) @ OPENGL_TO_OPENCV)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix, [4, 4], of a camera at `eye` looking at `target`."""
    eye, target, up = (_vector(v, name) for v, name in ((eye, "eye"), (target, "target"), (up, "up")))
    forward = target - eye
    right = _cross(forward, up)
    if np.linalg.norm(forward) < 1e-12:
        raise InvalidInput("camera.target", "apart from camera.eye", target.tolist())
    if np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up) or not up.any():
        raise InvalidInput("camera.up", "a direction other than the line of sight", up.tolist())
    forward = forward / np.linalg.norm(forward)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, _cross(forward, right), forward, eye], axis=1)
    return pose


def orbit(target: np.ndarray, distance: float, azimuth: float, elevation: float, up: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix, [4, 4], of a camera on a sphere around `target`.

    Angles in degrees: azimuth around `up`, elevation above the horizon in (-90, 90).
    """
    if not (math.isfinite(distance) and distance > 0):
        raise InvalidInput("camera.distance", "finite and above 0", distance)
    if not math.isfinite(azimuth):
        raise InvalidInput("camera.azimuth", "finite", azimuth)
    if not -90 < elevation < 90:
        raise InvalidInput("camera.elevation", "in (-90, 90) degrees", elevation)
    up = _vector(up, "up")
    if not up.any():
        raise InvalidInput("camera.up", "a direction", up.tolist())
    up = up / np.linalg.norm(up)
    # azimuth 0 is the world axis most perpendicular to `up`, made exactly perpendicular
    level = np.eye(3)[np.argmin(np.abs(up))]
    level = level - up * (level @ up)
    level = level / np.linalg.norm(level)
    a, e = math.radians(azimuth), math.radians(elevation)
    outward = math.cos(e) * (math.cos(a) * level + math.sin(a) * _cross(up, level)) + math.sin(e) * up
    target = _vector(target, "target")
    return look_at(target + distance * outward, target, up)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors [3]; takes 5 µs, `np.cross` 40 µs."""
    return a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]


def _vector(value: np.ndarray, name: str) -> np.ndarray:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InvalidInput(f"camera.{name}", "3 finite numbers", value)
    return vector


def _rigid(matrix: np.ndarray) -> np.ndarray:
    """Return a rigid pose as float64, read-only; rounding of rotations to three decimals is tolerated."""
    matrix = np.array(matrix, dtype=np.float64)
    field = "camera.camera_to_world"
    if matrix.shape != (4, 4):
        raise InvalidInput(field, "a 4×4 matrix", f"shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InvalidInput(field, "finite", "NaN or infinity")
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > MAX_SKEW or np.linalg.det(rotation) < 0:
        raise InvalidInput(field, "a rotation and a position, without scale or mirroring", rotation.tolist())
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        by_columns = ", not its last column" if np.abs(matrix[:, 3] - [0, 0, 0, 1]).max() <= 1e-6 else ""
        raise InvalidInput(field, f"a matrix whose last row is 0 0 0 1{by_columns}", matrix[3].tolist())
    matrix.flags.writeable = False
    return matrix
