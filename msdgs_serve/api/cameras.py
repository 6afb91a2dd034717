"""Resolve the camera of a request, with the scene's defaults."""

import math
from collections.abc import Sequence

import numpy as np

from msdgs_serve.api.schemas import LookAtCamera, MatrixCamera, OrbitCamera, RenderRequest, SceneCamera
from msdgs_serve.framing import Framing
from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.baked import SceneCamera as StoredCamera
from msdgs_serve.scene.camera import MAX_PIXELS_PER_SIDE, OPENGL_TO_OPENCV, orbit
from msdgs_serve.store import ServedScene


def resolve_camera(request: RenderRequest, served: ServedScene) -> Camera:
    """Return the camera and image size of a request. Raises `InvalidInput` naming the field."""
    spec = request.camera
    if isinstance(spec, SceneCamera):
        camera = _pick(spec, served.metadata.cameras).camera
        return camera.of_size(*_size(request, camera.width, camera.height))
    scene = served.framing
    if isinstance(spec, MatrixCamera):
        return _matrix_camera(spec, request, scene)
    width, height = _size(request, scene.width, scene.height)
    target = scene.target if spec.target is None else np.array(spec.target)
    up = scene.up if spec.up is None else np.array(spec.up)
    fov_y = scene.fov_y if spec.fov_y is None else spec.fov_y
    if isinstance(spec, LookAtCamera):
        return Camera.from_look_at(np.array(spec.eye), target, up, width, height, fov_y)
    assert isinstance(spec, OrbitCamera)
    distance = scene.distance if spec.distance is None else spec.distance
    return Camera.from_fov(orbit(target, distance, spec.azimuth, spec.elevation, up), width, height, fov_y)


def _matrix_camera(spec: MatrixCamera, request: RenderRequest, scene: Framing) -> Camera:
    if (spec.fx is None) == (spec.fov_y is None):
        raise InvalidInput("camera.fov_y", "given, or camera.fx", "both" if spec.fx else "neither")
    in_pixels = next((name for name in ("fx", "cx", "cy") if getattr(spec, name) is not None), None)
    if in_pixels and (request.width is None or request.height is None):
        missing = "width" if request.width is None else "height"
        raise InvalidInput(missing, f"given together with camera.{in_pixels}, which is in pixels", "nothing")
    if spec.fx is None and spec.fy is not None:
        raise InvalidInput("camera.fy", "left out without camera.fx", spec.fy)
    width, height = _size(request, scene.width, scene.height)
    fx = spec.fx or 0.5 * height / math.tan(0.5 * math.radians(spec.fov_y or 0))
    fy = spec.fy or fx
    cx = width / 2 if spec.cx is None else spec.cx
    cy = height / 2 if spec.cy is None else spec.cy
    pose = np.array(spec.camera_to_world, dtype=np.float64)
    if spec.axes == "opengl":
        pose = pose @ OPENGL_TO_OPENCV
    if spec.model != "pinhole" and spec.fx is None:
        raise InvalidInput("camera.fov_y", "replaced by camera.fx unless camera.model is pinhole", spec.fov_y)
    return Camera(fx, fy, cx, cy, width, height, pose, spec.model, spec.distortion)


def _size(request: RenderRequest, width: int, height: int) -> tuple[int, int]:
    """Return the requested width and height; a missing one follows from the proportions of the given default."""
    if request.width is not None and request.height is not None:
        return request.width, request.height
    if request.width is not None:
        return request.width, _side("height", request.width * height / width)
    if request.height is not None:
        return _side("width", request.height * width / height), request.height
    return width, height


def _side(name: str, pixels: float) -> int:
    if round(pixels) > MAX_PIXELS_PER_SIDE:
        raise InvalidInput(name, f"at most {MAX_PIXELS_PER_SIDE}", f"{round(pixels)} by the camera's aspect ratio")
    return max(1, round(pixels))


def _pick(spec: SceneCamera, cameras: Sequence[StoredCamera]) -> StoredCamera:
    if spec.name is not None and spec.index is not None:
        raise InvalidInput("camera.index", "left out if camera.name is given", spec.index)
    if spec.name is not None:
        named = [camera for camera in cameras if camera.name == spec.name]
        if not named:
            raise InvalidInput("camera.name", "the name of a camera of the scene", repr(spec.name))
        return named[0]
    index = spec.index or 0
    if index >= len(cameras):
        raise InvalidInput("camera.index", f"below {len(cameras)}, the number of the scene's cameras", index)
    return cameras[index]
