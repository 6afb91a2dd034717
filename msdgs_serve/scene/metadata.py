"""Metadata of a scene file (`CONTRACTS`): the `metadata_props`, checked on reading."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any

import numpy as np

from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import SceneFileInvalid
from msdgs_serve.scene.plain_json import parse
from msdgs_serve.scene.similarity import IDENTITY, Similarity

CONTRACTS = CONTRACT, CHANGING_CONTRACT = "msdgs/1", "msdgs/2"
"""The second has opacities or SH that depend on time. Files that have neither are of the first."""
MAX_NUMBER = 1e9
"""Limit of times, coordinates and pixels: beyond any sensible value, within single precision."""
MIN_FOCAL = 1e-3
"""Limit of focal lengths in pixels, as in requests: far below it, angles of view round to 180 degrees."""
MAX_LIST = 1000
"""Limit of the length of lists, such as layers and cameras."""
MAX_WORD = 100
"""Limit of characters in a text that may become an HTTP header."""


@dataclass(frozen=True)
class SceneCamera:
    """A camera that is stored in the scene, with its time."""

    name: str
    t: float
    camera: Camera

    def to_plain(self) -> dict[str, Any]:
        """Return the camera as JSON values, as the file stores it."""
        c = self.camera
        intrinsics = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": int(c.width), "height": int(c.height)}
        return {"name": self.name, "t": self.t, **intrinsics, "camera_to_world": c.camera_to_world.tolist()}

    @classmethod
    def from_plain(cls, value: Mapping[str, Any]) -> "SceneCamera":
        """Return the camera from the values of `to_plain`. Raises ValueError or KeyError."""
        rows = _list(value["camera_to_world"])
        camera = Camera(
            *(_focal(value[key]) for key in ("fx", "fy")),
            *(_number(value[key]) for key in ("cx", "cy")),
            width=value["width"],
            height=value["height"],
            camera_to_world=np.array([_numbers(row, 4) for row in rows]),
        )
        return cls(_text(value["name"]), _number(value["t"]), camera)


@dataclass(frozen=True)
class SceneMetadata:
    """`metadata_props` of a scene file. Each value is JSON under the field's name; only fields with a default may be
    missing."""

    contract: str
    layers: tuple[str, ...]  # kinds of the deformation layers, in order; empty if nothing moves
    plan: str  # how the deformation is computed, e.g. "network"
    time_range: tuple[float, float]  # t0 <= t1
    bounds: tuple[tuple[float, ...], tuple[float, ...]]  # two opposite corners, scene units
    sh_degree: int  # 0 to 3
    delta_space: str  # space in which deltas were added in training, e.g. "raw"
    background: tuple[float, float, float]  # sRGB in [0, 1], as trained
    antialiasing: str  # "dilate": `eps2d` added to projected covariances; "mip": also scales opacities
    cameras: tuple[SceneCamera, ...]
    left_out: tuple[Any, ...]  # parts of the model that the export pruned
    measured_error: dict[str, Any]  # of the plan against the model
    package_version: str
    checkpoint_sha256: str  # of the model file
    eps2d: float = 0.3  # px², as trained
    duration: float | None = None  # of the time range, seconds; None: unknown
    scene_to_world: Similarity = IDENTITY  # from the frame of graph, bounds and cameras to the user's world

    @property
    def is_switched(self) -> bool:
        """Whether the scene switches from stored frame to frame, so that no Gaussian moves."""
        return self.plan.startswith("frames:")

    def to_properties(self) -> dict[str, str]:
        """Return the `metadata_props` of a file."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values["cameras"] = [camera.to_plain() for camera in self.cameras]
        values["scene_to_world"] = self.scene_to_world.to_plain()
        if self.duration is None:
            del values["duration"]
        if self.scene_to_world.is_identity:
            del values["scene_to_world"]
        return {name: json.dumps(value, allow_nan=False) for name, value in values.items()}

    def in_world(self) -> "SceneMetadata":
        """The same with bounds and cameras in the user's world."""
        place = self.scene_to_world
        low, high = (tuple(place.to_world(np.array(corner)).tolist()) for corner in self.bounds)
        cameras = (replace(each, camera=place.camera_to_world(each.camera)) for each in self.cameras)
        return replace(self, bounds=(low, high), cameras=tuple(cameras), scene_to_world=IDENTITY)

    @classmethod
    def from_properties(cls, properties: Mapping[str, str], file: str) -> "SceneMetadata":
        """Read and check `metadata_props`. Raises `SceneFileInvalid` naming `file` and the field."""
        values = {}
        optional = {field.name for field in fields(cls) if field.default is not MISSING}
        for name, reader in _READERS.items():
            if name not in properties:
                if name in optional:
                    continue
                raise SceneFileInvalid(file, name, "is missing from the metadata")
            try:
                values[name] = reader(parse(properties[name]))
            except KeyError as error:
                raise SceneFileInvalid(file, name, f"lacks {error}") from error
            except (ValueError, TypeError) as error:
                raise SceneFileInvalid(file, name, f"can't be used: {error}") from error
        return cls(**values)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{_shown(value)} isn't a number")
    if abs(value) > MAX_NUMBER:
        raise ValueError(f"{value} isn't within ±{MAX_NUMBER:g}")
    return float(value)


def _focal(value: Any) -> float:
    if (number := _number(value)) < MIN_FOCAL:
        raise ValueError(f"{value} isn't a focal length of at least {MIN_FOCAL:g} pixels")
    return number


def _numbers(value: Any, count: int) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"{_shown(value)} isn't a list of {count} numbers")
    return tuple(_number(v) for v in value)


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"{_shown(value)} isn't a non-empty text")
    return value


def _word(value: Any) -> str:
    """Read a text that may become an HTTP header."""
    if not (_text(value).isascii() and len(value) <= MAX_WORD):
        raise ValueError(f"{_shown(value)} isn't at most {MAX_WORD} printable ASCII characters")
    return value


def _words(value: Any) -> tuple[str, ...]:
    return tuple(_word(v) for v in _list(value))


def _list(value: Any) -> tuple[Any, ...]:
    if not isinstance(value, list) or len(value) > MAX_LIST:
        raise ValueError(f"{_shown(value)} isn't a list of at most {MAX_LIST:,}")
    return tuple(value)


def _mapping(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{_shown(value)} isn't an object")
    return value


def _shown(value: Any) -> str:
    """Return the beginning of a value for a message."""
    text = repr(value)
    return text if len(text) <= MAX_WORD else f"{text[:MAX_WORD]}…"


def _one_of(*known: str) -> Callable[[Any], str]:
    def read(value: Any) -> str:
        if value not in known:
            raise ValueError(f"{_shown(value)} is unknown; known values: {', '.join(known)}")
        return value

    return read


def _time_range(value: Any) -> tuple[float, ...]:
    t0, t1 = _numbers(value, 2)
    if t0 > t1:
        raise ValueError(f"it begins at {t0}, after its end at {t1}")
    return t0, t1


def _bounds(value: Any) -> tuple[tuple[float, ...], ...]:
    corners = _list(value)
    if len(corners) != 2:
        raise ValueError(f"{_shown(value)} isn't two corners")
    low, high = (_numbers(corner, 3) for corner in corners)
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"the corner {low} isn't below {high}")
    return low, high


def _sh_degree(value: Any) -> int:
    if type(value) is not int or not 0 <= value <= 3:
        raise ValueError(f"{_shown(value)} isn't 0, 1, 2 or 3")
    return value


def _background(value: Any) -> tuple[float, ...]:
    rgb = _numbers(value, 3)
    if not all(0 <= v <= 1 for v in rgb):
        raise ValueError(f"{rgb} isn't within [0, 1]")
    return rgb


def _cameras(value: Any) -> tuple[SceneCamera, ...]:
    return tuple(SceneCamera.from_plain(_mapping(camera)) for camera in _list(value))


def _eps2d(value: Any) -> float:
    if (number := _number(value)) < 0:
        raise ValueError(f"{value} is below 0")
    return number


def _duration(value: Any) -> float:
    if (number := _number(value)) <= 0:
        raise ValueError(f"{value} isn't above 0")
    return number


def _scene_to_world(value: Any) -> Similarity:
    values = _mapping(value)
    x, y, z = _numbers(values["offset"], 3)
    return Similarity(_number(values["scale"]), (x, y, z))


def _sha256(value: Any) -> str:
    if not re.fullmatch("[0-9a-f]{64}", _text(value)):
        raise ValueError(f"{_shown(value)} isn't a SHA-256 in lower-case hexadecimal")
    return value


_READERS: dict[str, Callable[[Any], Any]] = {
    "contract": _one_of(*CONTRACTS),
    "layers": _words,
    "plan": _word,
    "time_range": _time_range,
    "bounds": _bounds,
    "sh_degree": _sh_degree,
    "delta_space": _word,
    "background": _background,
    "antialiasing": _one_of("dilate", "mip"),
    "cameras": _cameras,
    "left_out": _list,
    "measured_error": _mapping,
    "package_version": _word,
    "checkpoint_sha256": _sha256,
    "eps2d": _eps2d,
    "duration": _duration,
    "scene_to_world": _scene_to_world,
}
