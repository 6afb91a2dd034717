"""A client of the service that returns NumPy arrays. Needs httpx: `pip install 'msdgs[client]'`.

    with Client("http://localhost:8000") as client:
        frame = client.render(Orbit(azimuth=30, elevation=20), t=0.5, width=400, height=400)
        frame.rgb, frame.alpha, frame.depth

ClientError         also a value that can't be sent, such as NaN, or an answer of something else than the service
├── Problem         an answer with an error, or a redirect: `status`, `detail` and `errors` by field
└── Unreachable     there was no whole answer
"""

import base64
import io
import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TypeVar
from urllib.parse import quote

import httpx
import numpy as np
import numpy.typing as npt

Channel = Literal["rgb", "alpha", "depth", "motion", "gaussians"]
Format = Literal["png", "jpeg", "webp", "exr", "npy"]
Color = tuple[float, float, float]
Background = Color | Literal["auto", "scene", "transparent"]
FloatArray = npt.NDArray[np.floating]
Real = float | np.floating | np.integer
Whole = int | np.integer
Time = Real | Sequence[Real] | npt.NDArray[Any]
Vector = Sequence[Real] | npt.NDArray[Any]
Body = TypeVar("Body", str, bytes)
Content = TypeVar("Content")

DEFAULT_CHANNELS: tuple[Channel, ...] = ("rgb", "alpha", "depth")
WIDTHS: dict[Channel, int] = {"rgb": 3, "alpha": 1, "depth": 1, "motion": 2, "gaussians": 1}
DEFAULT_SECONDS = 60.0
TRIES = 4
OVERLOADED, DELETED = 503, 204


class ClientError(Exception):
    """Base of the errors that this module raises."""


class Unreachable(ClientError):
    """There was no answer, or no whole one: the connection failed or timed out."""


class Problem(ClientError):
    """The service answered with an error (RFC 9457), or something before it with an error or a redirect."""

    def __init__(self, status: int, detail: str, errors: Sequence[Mapping[str, str]] = ()) -> None:
        super().__init__(f"{status}: {detail}")
        self.status = status
        self.detail = detail
        self.errors = {each["field"]: each["message"] for each in errors}


@dataclass(frozen=True)
class Orbit:
    """A camera on a sphere around `target`. Angles in degrees; the scene has defaults for None."""

    azimuth: Real
    elevation: Real
    distance: Real | None = None
    target: Vector | None = None  # [3] world
    up: Vector | None = None  # [3] world
    fov_y: Real | None = None  # vertical, degrees
    type: str = field(default="orbit", init=False)


@dataclass(frozen=True)
class LookAt:
    """A camera at `eye` that looks at `target`."""

    eye: Vector  # [3] world
    target: Vector | None = None
    up: Vector | None = None
    fov_y: Real | None = None
    type: str = field(default="look_at", init=False)


@dataclass(frozen=True)
class Matrix:
    """A pose and intrinsics: `fov_y` in degrees, or `fx` and optionally `fy`, `cx`, `cy` in pixels.

    `fx` is in pixels per world unit if orthographic. `distortion` is k1 to k4 of a fisheye camera, as in OpenCV.
    """

    camera_to_world: npt.ArrayLike  # [4, 4]
    axes: Literal["opencv", "opengl"] = "opencv"
    fov_y: Real | None = None
    fx: Real | None = None
    fy: Real | None = None
    cx: Real | None = None
    cy: Real | None = None
    model: Literal["pinhole", "orthographic", "fisheye"] = "pinhole"
    distortion: Vector | None = None
    type: str = field(default="matrix", init=False)

    def __post_init__(self) -> None:
        if isinstance(self.distortion, np.ndarray):  # OpenCV's are a row or a column
            object.__setattr__(self, "distortion", self.distortion.ravel())


@dataclass(frozen=True)
class SceneCamera:
    """A camera that is stored in the scene, by `name` or `index`."""

    name: str | None = None
    index: Whole | None = None
    type: str = field(default="scene", init=False)


Camera = Orbit | LookAt | Matrix | SceneCamera


@dataclass(frozen=True)
class Shutter:
    """Motion blur from `t + open` to `t + close`."""

    open: Real
    close: Real
    samples: Whole = 8


@dataclass(frozen=True)
class Frame:
    """A rendered frame as float32 arrays; channels that were not requested are None.

    Of a list of T times, each array has T as its first dimension.
    """

    rgb: FloatArray | None  # [H, W, 3] sRGB-encoded; premultiplied by alpha if the background is transparent
    alpha: FloatArray | None  # [H, W] coverage by Gaussians, also where a background is behind them
    depth: FloatArray | None  # [H, W] along the camera's axis, world units, infinite where nothing was drawn
    motion: FloatArray | None  # [H, W, 2] displacement until t + dt, pixels to the right and down
    gaussians: FloatArray | None  # [H, W] number of Gaussians that contribute to each pixel
    plan: str  # how the scene's motion is computed
    milliseconds: dict[str, float]  # by stage: queue, pose, draw, encode


class Client:
    """A connection to a service. Safe to use from several threads."""

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        api_key: str | None = None,
        seconds: float = DEFAULT_SECONDS,
        tries: int = TRIES,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        """`seconds` is the time limit of a call. While the service is overloaded, a call but `render_many` is tried up
        to `tries` times, 1 or more, after the seconds that the service asks for. Raises `ClientError` for a URL or key
        that can't be sent."""
        headers = {} if api_key is None else {"Authorization": f"Bearer {api_key}"}
        try:
            self._http = httpx.Client(base_url=url, headers=headers, timeout=seconds, transport=transport)
        except httpx.InvalidURL as error:
            raise ClientError(f"{url}: {error}") from error
        except UnicodeEncodeError:
            raise ClientError("the key has characters beyond ASCII") from None
        self._tries = max(tries, 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def render(
        self,
        camera: Camera,
        t: Time,
        *,
        scene: str | None = None,
        width: Whole | None = None,
        height: Whole | None = None,
        region: Sequence[Whole] | None = None,
        channels: Sequence[Channel] = DEFAULT_CHANNELS,
        background: Background = "auto",
        shutter: Shutter | None = None,
        dt: Real | None = None,
        steps: Real | None = None,
    ) -> Frame:
        """Return a frame as arrays, for a list of times with all of them. The channel `motion` needs `dt`, in scene
        time; `steps` is the number of the scene's layers that are applied; `region` is the part of the image that is
        returned: x, y, width and height in pixels. Raises `ClientError`."""
        body = request_body(
            camera, t, scene=scene, width=width, height=height, region=region, channels=channels,
            background=background, shutter=shutter, dt=dt, steps=steps, format="npy",
        )  # fmt: skip
        response = self._call("POST", "/render", json=body)
        return _read(response, lambda file: _frame(_array(file), channels, response.headers), response.content)

    def render_file(self, camera: Camera, t: Time, *, format: Format = "png", **options: Any) -> bytes:
        """Return a frame as an image file; `options` are those of `request_body`."""
        response = self._call("POST", "/render", json=request_body(camera, t, format=format, **options))
        if not response.headers.get("Content-Type", "").startswith(("image/", "application/x-npy")):
            raise _foreign(response)
        return response.content

    def render_many(self, bodies: Iterable[Mapping[str, Any]]) -> Iterator[tuple[int, bytes | Problem]]:
        """Yield index and file of many frames as they are ready; bodies are those of `request_body`.

        A frame that fails yields a `Problem`; the others are drawn.
        """
        frames = [_plain(body, f"frames.{number}") for number, body in enumerate(bodies)]
        with self._connected(), self._http.stream("POST", "/render/batch", json={"frames": frames}) as response:
            if not response.is_success:
                response.read()
                raise _problem(response)
            for text in response.iter_lines():
                yield _read(response, _frame_of_batch, text)

    def scenes(self) -> list[str]:
        """Return the names of the scenes that are served."""
        response = self._call("GET", "/scenes")
        return _read(response, lambda text: [scene["name"] for scene in json.loads(text)["scenes"]], response.content)

    def scene(self, name: str) -> dict[str, Any]:
        """Return the description of a scene: time range, cameras, plan, measured error."""
        response = self._call("GET", f"/scenes/{quote(name, safe='')}")
        return _read(response, _object, response.content)

    def add_scene(self, name: str, file: Path, *, replace: bool = False) -> str:
        """Add a scene file, if the service allows uploads, and return its SHA-256. Raises `OSError` if it can't be
        read."""
        query = {"name": name, "replace": str(replace).lower()}
        response = self._call("POST", "/scenes", params=query, content=file.read_bytes())
        return _read(response, lambda text: json.loads(text)["sha256"], response.content)

    def delete_scene(self, name: str) -> None:
        """Delete a scene, if the service allows uploads."""
        response = self._call("DELETE", f"/scenes/{quote(name, safe='')}")
        if response.status_code != DELETED:
            raise _foreign(response)

    def ready(self) -> bool:
        """Whether the service is ready to render frames."""
        try:
            return self._http.get("/ready").is_success
        except httpx.RequestError:
            return False

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """Raise `Unreachable` if the connection fails."""
        try:
            yield
        except httpx.RequestError as error:
            raise Unreachable(f"{self._http.base_url}: {error or type(error).__name__}") from error

    def _call(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        for number in range(self._tries):
            with self._connected():
                response = self._http.request(method, path, **arguments)
            wait = response.headers.get("Retry-After", "")
            if response.status_code != OVERLOADED or not wait.isdecimal() or number == self._tries - 1:
                break  # a proxy may state a date instead of seconds
            time.sleep(int(wait))
        if not response.is_success:  # redirects aren't followed: a POST would lose its body
            raise _problem(response)
        return response


def request_body(
    camera: Camera,
    t: Time,
    *,
    scene: str | None = None,
    width: Whole | None = None,
    height: Whole | None = None,
    region: Sequence[Whole] | None = None,
    format: Format = "png",
    quality: Whole | None = None,
    channels: Sequence[Channel] | None = None,
    background: Background = "auto",
    shutter: Shutter | None = None,
    dt: Real | None = None,
    steps: Real | None = None,
) -> dict[str, Any]:
    """Return the JSON body of `POST /render`; None is left out. Raises `ClientError` for what JSON can't hold."""
    values = {
        "scene": scene, "camera": camera, "t": t, "width": width, "height": height, "region": region,
        "format": format, "quality": quality, "channels": channels, "background": background, "dt": dt, "steps": steps,
        "shutter": shutter,
    }  # fmt: skip
    return _plain(_given(values), "")


def _given(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _plain(value: Any, at: str) -> Any:
    """Return a value as JSON holds it: numbers and arrays of NumPy as Python's."""
    if value is None:
        return None
    if isinstance(value, Camera | Shutter):
        value = _given({each.name: getattr(value, each.name) for each in fields(value)})
    if isinstance(value, Mapping):
        return {name: _plain(each, f"{at}.{name}".lstrip(".")) for name, each in value.items()}
    if isinstance(value, list | tuple | range):
        return [_plain(each, f"{at}.{number}") for number, each in enumerate(value)]
    return _plain_text(value, at) if isinstance(value, str) else _plain_numbers(value, at)


def _plain_text(text: str, at: str) -> str:
    try:
        return text.encode().decode()
    except UnicodeEncodeError:
        raise ClientError(f"`{at}` must be text that UTF-8 can hold, got {text!a}") from None


def _plain_numbers(value: Any, at: str) -> Any:
    """Return a number, or those of an array or a tensor; an array of texts too."""
    try:
        array = np.asarray(value)
        if np.ma.is_masked(value):
            raise TypeError
        if array.dtype.kind not in "biuU":
            if array.dtype.kind not in "fO":  # O: such as Python's fractions
                raise TypeError
            with np.errstate(over="ignore"):
                array = array.astype(np.float64)
            if not np.isfinite(array).all():
                raise TypeError
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last: of tensors
        got = value if isinstance(value, float | np.floating) else f"another {type(value).__name__}"
        raise ClientError(f"`{at}` must be a finite number or an array of them, got {got}") from None
    return array.tolist()


def _frame(pixels: np.ndarray, channels: Sequence[Channel], headers: httpx.Headers) -> Frame:
    edges = np.cumsum([WIDTHS[channel] for channel in channels])[:-1]
    parts = dict(zip(channels, np.split(pixels, edges, axis=-1), strict=True))
    found = {name: part if WIDTHS[name] > 1 else part[..., 0] for name, part in parts.items()}
    durations = re.findall(r'([\w-]+)[^,]*?; *dur="?(\d+\.?\d*)', headers.get("Server-Timing", ""))
    milliseconds = {name: float(duration) for name, duration in durations}
    drawn = {name: found.get(name) for name in WIDTHS}
    return Frame(**drawn, plan=headers.get("Msdgs-Plan", ""), milliseconds=milliseconds)


def _frame_of_batch(text: str) -> tuple[int, bytes | Problem]:
    line = json.loads(text)
    if "data" in line:
        return line["index"], base64.b64decode(line["data"])
    problem = line["problem"]
    return line["index"], Problem(line["status"], problem["detail"], problem["errors"])


def _array(file: bytes) -> np.ndarray:
    return np.lib.format.read_array(io.BytesIO(file), allow_pickle=False)


def _read(response: httpx.Response, read: Callable[[Body], Content], body: Body) -> Content:
    """Read the body of an answer, or a part of it. Raises `ClientError` if it isn't the service's."""
    try:
        return read(body)
    except (ValueError, LookupError, TypeError):
        raise _foreign(response) from None


def _object(text: bytes) -> dict[str, Any]:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise TypeError
    return value


def _foreign(response: httpx.Response) -> ClientError:
    kind = response.headers.get("Content-Type", "without a type")
    return ClientError(f"{response.url}: not an answer of the service, but {kind}")


def _problem(response: httpx.Response) -> Problem:
    try:
        problem = response.json()
        return Problem(response.status_code, problem["detail"], problem["errors"])
    except (ValueError, KeyError, TypeError):  # an answer of a proxy in between
        place = f" to {response.headers['Location']}" if response.has_redirect_location else ""
        return Problem(response.status_code, response.reason_phrase + place)
