"""Camera paths, with a time for each camera: nerfstudio's files, or a full turn around the scene."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.camera import MAX_PIXELS_PER_SIDE, orbit
from msdgs_serve.scene.fields import FieldTable

DEFAULT_FPS = 24.0
MAX_RADIANS = 3.15  # of fields of view: if all are below, they may not be in degrees
MIN_FPS, MAX_FPS = 0.01, 240.0
MAX_NUMBER = 1e9
"""Limit of all numbers in a path, within which single precision neither overflows nor underflows."""

FIELDS = FieldTable(
    "Camera paths",
    {
        **dict.fromkeys(("camera_path", "camera_to_world", "fov", "render_time", "scene"), "applied"),
        **dict.fromkeys(("render_width", "render_height", "fps", "seconds"), "applied"),
        **dict.fromkeys(("camera_type", "crop"), "refused"),
        **dict.fromkeys(
            ("keyframes", "default_fov", "default_transition_sec", "is_cycle", "smoothness_value"), "harmless"
        ),
        "aspect": "harmless",
    },
)
"""What is done with each field of nerfstudio's files and their cameras. Its viewer makes `camera_path` of `keyframes`
and the fields beside them, and its renderer doesn't read these either."""
OF_CAMERAS = ("camera_to_world", "fov", "render_time", "scene")
OF_BOTH = ("camera_type", "crop", "aspect")
"""Fields of each camera, and those of the file and of its cameras; others are of the file."""


@dataclass(frozen=True)
class CameraPath:
    """Cameras and times of the frames of a video."""

    frames: tuple[tuple[Camera, float], ...]  # camera and scene time
    fps: float
    warnings: tuple[str, ...] = ()  # what a user should know about the file

    def __post_init__(self) -> None:
        if not self.frames:
            raise InvalidInput("path", "a path of at least one frame", 0)
        check_fps(self.fps)


def check_fps(fps: float) -> None:
    """Raise `InvalidInput` if a video can't have this number of frames per second."""
    if not MIN_FPS <= fps <= MAX_FPS:
        raise InvalidInput("fps", f"in [{MIN_FPS:g}, {MAX_FPS:g}]", fps)


def orbit_path(
    target: np.ndarray,
    distance: float,
    elevation: float,
    up: np.ndarray,
    fov_y: float,
    size: tuple[int, int],
    count: int,
    time_range: tuple[float, float],
) -> list[tuple[Camera, float]]:
    """Return `count` cameras on a circle around `target`, at times from first to last. Angles in degrees."""
    times = even_times(count, time_range)
    poses = [orbit(target, distance, 360 * number / count, elevation, up) for number in range(count)]
    return [(Camera.from_fov(pose, *size, fov_y), t) for pose, t in zip(poses, times, strict=True)]


def even_times(count: int, time_range: tuple[float, float]) -> list[float]:
    """Return `count` evenly spaced times from the first to the last."""
    return np.linspace(*time_range, count).tolist()


def read_nerfstudio(
    document: Mapping[str, Any], time_range: tuple[float, float], size: tuple[int, int] | None = None
) -> CameraPath:
    """Read a path from the contents of nerfstudio's camera_path.json, whose cameras have OpenGL axes.

    A camera's time is its `render_time`, a fraction of the scene's time range; without one, times are evenly spaced
    over the path. `size` replaces the size in the file. Raises `InvalidInput` naming the key.
    """
    cameras = _cameras(document)
    _refuse_kinds(document, "")
    width, height = size or (_integer(document, "render_width"), _integer(document, "render_height"))
    even = even_times(len(cameras), time_range)
    frames = []
    for number, each in enumerate(cameras):
        name = f"camera_path.{number}"
        if not isinstance(each, Mapping):
            raise InvalidInput(name, "an object", type(each).__name__)
        _refuse_kinds(each, f"{name}.")
        pose = _matrix(each.get("camera_to_world"), f"{name}.camera_to_world")
        (fov_y,) = _numbers([each.get("fov")], 1, f"{name}.fov")
        if not 0 < fov_y < 180:
            raise InvalidInput(f"{name}.fov", "in (0, 180) degrees", fov_y)
        focal = 0.5 * height / math.tan(0.5 * math.radians(fov_y))
        try:
            camera = Camera.from_opengl(pose, width, height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)
        except InvalidInput as error:
            raise error.renamed(error.field.replace("camera", name, 1)) from None
        frames.append((camera, _time(each, even[number], time_range, name)))
    return CameraPath(tuple(frames), _fps(document, len(frames)), _warnings(document, cameras))


def _refuse_kinds(fields: Mapping[str, Any], at: str) -> None:
    kind = fields.get("camera_type") or "perspective"
    if kind != "perspective":
        raise InvalidInput(f"{at}camera_type", "perspective", kind if isinstance(kind, str) else type(kind).__name__)
    if fields.get("crop") is not None:
        raise InvalidInput(f"{at}crop", "left out: scenes are drawn whole. Switch the viewer's crop off", "a crop")


def _cameras(document: Mapping[str, Any]) -> Sequence[Any]:
    cameras = document.get("camera_path")
    if "frames" in document and cameras is None:
        raise InvalidInput("camera_path", "a list of cameras, as nerfstudio's viewer saves", "a dataset's `frames`")
    if not isinstance(cameras, Sequence) or isinstance(cameras, str):
        raise InvalidInput("camera_path", "a list of cameras", type(cameras).__name__)
    if not cameras:
        expected = (
            "a list of one camera or more, which nerfstudio's viewer writes if its path has two keyframes or more"
        )
        raise InvalidInput("camera_path", expected, "an empty list")
    return cameras


def _warnings(document: Mapping[str, Any], cameras: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    of_file = [name for name in document if name in OF_CAMERAS or FIELDS.use(name) is None]
    of_cameras = dict.fromkeys(name for each in cameras for name in each if name not in OF_CAMERAS + OF_BOTH)
    shown = ", ".join([f"`{name}`" for name in of_file] + [f"`{name}` of cameras" for name in of_cameras])
    warnings = [f"not read, as no known field of a camera path: {shown}"] if shown else []
    if all(each["fov"] < MAX_RADIANS for each in cameras):
        warnings.append(f"each `fov` is below {MAX_RADIANS}, as angles in radians are; it is read in degrees")
    return tuple(warnings)


def read_path_file(path: Path, time_range: tuple[float, float], size: tuple[int, int] | None = None) -> CameraPath:
    """Read a path from a JSON file in nerfstudio's format. Raises `InvalidInput`."""
    return read_nerfstudio(_document(path), time_range, size)


def read_scene_names(path: Path) -> list[str]:
    """Return the `scene` of each camera of a path in a JSON file. Raises `InvalidInput` naming the key."""
    cameras = _cameras(_document(path))
    return [_scene_name(each, f"camera_path.{number}") for number, each in enumerate(cameras)]


def _scene_name(camera: Any, at: str) -> str:
    name = camera.get("scene") if isinstance(camera, dict) else None
    if not isinstance(name, str) or not name.endswith(".onnx"):
        raise InvalidInput(f"{at}.scene", "a scene file (.onnx), relative to the path's folder", name)
    return name


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise InvalidInput("path", "a readable JSON file", f"{path}: {error.strerror}") from None
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise InvalidInput(
            "path", "a JSON file of nerfstudio's camera path", f"{path}, which is none from {place} on"
        ) from None
    except (ValueError, RecursionError):
        raise InvalidInput("path", "a JSON file", f"{path}, which is none") from None
    if not isinstance(document, dict):
        raise InvalidInput("path", "a JSON object in nerfstudio's format", f"{path}: {type(document).__name__}")
    return document


def _time(camera: Mapping[str, Any], even: float, time_range: tuple[float, float], name: str) -> float:
    if camera.get("render_time") is None:
        return even
    (fraction,) = _numbers([camera["render_time"]], 1, f"{name}.render_time")
    if not 0 <= fraction <= 1:
        raise InvalidInput(f"{name}.render_time", "in [0, 1]", fraction)
    first, last = time_range
    return float(min(first + fraction * (last - first), last))


def _fps(document: Mapping[str, Any], count: int) -> float:
    """The path's `fps`, or so many that its frames last its `seconds`."""
    if document.get("fps") is not None:
        return float(_numbers([document["fps"]], 1, "fps")[0])
    if document.get("seconds") is None:
        return DEFAULT_FPS
    (seconds,) = _numbers([document["seconds"]], 1, "seconds")
    if not count / MAX_FPS <= seconds <= count / MIN_FPS:
        raise InvalidInput("seconds", f"in [{count / MAX_FPS:.4g}, {count / MIN_FPS:.4g}] for {count} cameras", seconds)
    return float(count / seconds)


def _integer(document: Mapping[str, Any], name: str) -> int:
    value = document.get(name)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MAX_PIXELS_PER_SIDE:
        got = value if isinstance(value, float) else type(value).__name__
        raise InvalidInput(name, f"an integer number of pixels in [1, {MAX_PIXELS_PER_SIDE}]", got)
    return value


def _matrix(value: Any, name: str) -> np.ndarray:
    """[4, 4] of 16 numbers by rows, or of four rows."""
    return _numbers(joined_rows(value), 16, name).reshape(4, 4)


def joined_rows(value: Any) -> Any:
    """The numbers of four rows, one after the other; other values as they are."""
    is_nested = isinstance(value, Sequence) and len(value) == 4 and all(isinstance(row, list) for row in value)
    return [number for row in value for number in row] if is_nested else value


def _numbers(value: Any, count: int, name: str) -> np.ndarray:
    good = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == count
    if not good or any(isinstance(each, bool) or not isinstance(each, int | float) for each in value):
        got = f"{len(value)} values" if isinstance(value, Sequence) and count > 1 else "another value"
        raise InvalidInput(name, f"{count} numbers" if count > 1 else "a number", got)
    numbers: list[float] = list(value)
    if not all(-MAX_NUMBER <= each <= MAX_NUMBER for each in numbers):
        raise InvalidInput(name, f"finite and at most {MAX_NUMBER:g}", "NaN, infinity or more")
    return np.array(numbers, dtype=np.float64)
