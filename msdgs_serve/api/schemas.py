"""JSON schemas of requests and responses. Field descriptions are the documentation at /docs."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

from msdgs_serve.api.camera_paths import MAX_TIMES, NerfstudioPath
from msdgs_serve.api.numbers import (
    Color,
    Direction,
    Distance,
    Elevation,
    FieldOfView,
    Focal,
    FramesPerSecond,
    Index,
    LaxIndex,
    LaxNumber,
    LaxPixels,
    LaxQuality,
    LaxSteps,
    LeastPixel,
    List,
    Name,
    Number,
    Pixels,
    Quality,
    Row,
    Samples,
    Steps,
    Vector,
)
from msdgs_serve.imaging import Channel, ImageFormat
from msdgs_serve.scene.camera import CameraModel
from msdgs_serve.video import VideoFormat

MAX_BATCH = 1000


class Strict(BaseModel):
    """A model that rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class MatrixCamera(Strict):
    """A pose and intrinsics. Give either `fov_y` or `fx`; pixels refer to the request's `width` × `height`."""

    type: Literal["matrix"]
    camera_to_world: tuple[Row, Row, Row, Row] = Field(
        description="4×4 by rows: rotation and position, without scale",
        examples=[[[0, 0, -1, 4], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]],
    )
    axes: Literal["opencv", "opengl"] = Field(
        default="opencv",
        description="camera axes: `opencv` x right, y down, z forward; `opengl` x right, y up, z backward "
        "(NeRF, Blender, D-NeRF)",
    )
    fov_y: FieldOfView | None = Field(default=None, description="vertical field of view, degrees")
    fx: Focal | None = Field(default=None, description="focal length, pixels")
    fy: Focal | None = Field(default=None, description="default: `fx`")
    cx: Number | None = Field(
        default=None, description="principal point, pixels from the left edge; default: the center"
    )
    cy: Number | None = Field(
        default=None, description="principal point, pixels from the top edge; default: the center"
    )
    model: CameraModel = Field(
        default="pinhole",
        description="`orthographic`: `fx` is in pixels per world unit; `fisheye`: as in OpenCV",
    )
    distortion: tuple[Number, Number, Number, Number] = Field(
        default=(0.0, 0.0, 0.0, 0.0), description="k1 to k4 of a `fisheye` camera"
    )


class LookAtCamera(Strict):
    """A camera at `eye` that looks at `target`."""

    type: Literal["look_at"]
    eye: Vector = Field(description="position of the camera, world", examples=[[4, 0, 1]])
    target: Vector | None = Field(
        default=None, description="point that it looks at, world; default: the scene's", examples=[[0, 0, 0]]
    )
    up: Direction | None = Field(
        default=None, description="direction that is up in the image, world; default: the scene's",
        examples=[[0, 0, 1]],
    )  # fmt: skip
    fov_y: FieldOfView | None = Field(
        default=None, description="vertical field of view, degrees; default: that of the scene's first camera"
    )


class OrbitCamera(Strict):
    """A camera on a sphere around `target`, looking at it."""

    type: Literal["orbit"]
    azimuth: Number = Field(description="degrees around `up`")
    elevation: Elevation = Field(description="degrees above the horizon of `target`")
    distance: Distance | None = Field(
        default=None, description="world units; default: the median of the scene's cameras"
    )
    target: Vector | None = Field(default=None, description="world; default: the scene's", examples=[[0, 0, 0]])
    up: Direction | None = Field(default=None, description="world; default: the scene's", examples=[[0, 0, 1]])
    fov_y: FieldOfView | None = Field(
        default=None, description="vertical field of view, degrees; default: that of the scene's first camera"
    )


class SceneCamera(Strict):
    """A camera that is stored in the scene; `GET /scenes/{name}` lists them."""

    type: Literal["scene"]
    name: Name | None = Field(default=None, description="give either `name` or `index`", examples=["view_0"])
    index: Index | None = Field(default=None, description="from 0")


CameraSpec = Annotated[OrbitCamera | LookAtCamera | MatrixCamera | SceneCamera, Field(discriminator="type")]


def _kind_of_background(value: Any) -> str:
    return "name" if value is None or isinstance(value, str) else "color"


Background = Annotated[
    Annotated[Literal["auto", "scene", "transparent"] | None, Tag("name")] | Annotated[Color, Tag("color")],
    Discriminator(_kind_of_background),
]
VideoBackground = Annotated[
    Annotated[Literal["scene"], Tag("name")] | Annotated[Color, Tag("color")], Discriminator(_kind_of_background)
]


def _kind_of_time(value: Any) -> str:
    return "list" if isinstance(value, list | tuple) else "one"


Times = Annotated[
    Annotated[Number, Tag("one")] | Annotated[list[Number], Field(min_length=1, max_length=MAX_TIMES), Tag("list")],
    Discriminator(_kind_of_time),
]
Channels = Annotated[list[Channel], Field(min_length=1, max_length=8)]


class ShutterSpec(Strict):
    """Motion blur: the mean of `samples` frames at evenly spaced times from `t + open` to `t + close`."""

    open: Number = Field(description="scene time, relative to `t`", examples=[-0.01])
    close: Number = Field(description="scene time, relative to `t`; after `open`", examples=[0.01])
    samples: Samples = Field(
        default=8, description="number of frames, averaged in linear light; limited by the service"
    )


class RenderRequest(Strict):
    """A frame to render."""

    scene: Name | None = Field(default=None, description="name of the scene; optional if only one is served")
    camera: CameraSpec
    t: Times = Field(
        description="time within the scene's `time_range`; for `npy` also a list of times, for one array [T, H, W, C]",
        examples=[0.5],
    )
    width: Pixels | None = Field(
        default=None,
        description="pixels. Width and height default to those of the scene's camera that is used, else of its first "
        "camera; if one is given, the other follows from the aspect ratio",
    )
    height: Pixels | None = Field(default=None, description="pixels; see `width`")
    region: tuple[LeastPixel, LeastPixel, Pixels, Pixels] | None = Field(
        default=None,
        description="x, y, width and height of the part of the image to render, in pixels from its upper left corner; "
        "default: all. Its pixels are exactly those of the whole image, and only they count for limits. `exr` stores "
        "it as the data window. In 8-bit formats `depth` needs `depth_range`; `motion` and `gaussians` need `exr` or "
        "`npy`",
        examples=[[256, 0, 128, 128]],
    )
    format: ImageFormat = Field(
        default="png",
        description="`png`: 8-bit sRGB. `jpeg`, `webp`: the same, lossy. `exr`: 32-bit float scene-linear Rec.709 "
        "R G B A, premultiplied, and depth Z along the camera axis in world units, infinite in empty pixels. `npy`: "
        "a NumPy array [H, W, C], float32, as rendered: sRGB-encoded color, premultiplied if transparent",
    )
    channels: Channels | None = Field(
        default=None,
        description="`rgb`, `alpha`, `depth`, `motion`, `gaussians`, in the order of the file. Default for `exr` and "
        "`npy`: the first three. Other formats hold a single channel as an image: depth is brighter the nearer it is, "
        "the hue of motion is its direction. Motion is in pixels to the right and down, in `exr` as forward.u and "
        "forward.v. `gaussians` is the number of Gaussians that contribute to a pixel",
    )
    depth_range: tuple[Number, Number] | None = Field(
        default=None,
        description="depths drawn brightest and darkest in an image of depth; default: those of the frame",
        examples=[[1, 9]],
    )
    dt: Number | None = Field(
        default=None,
        description="scene time; `motion` is the displacement until `t + dt`, and needs it",
        examples=[0.1],
    )
    shutter: ShutterSpec | None = Field(default=None, description="motion blur; default: none")
    steps: Steps | None = Field(
        default=None,
        description="number of the scene's deformation layers to apply: 0 for none, 1.5 for the first and half of the "
        "second. Default: all. For scenes with `steps`, see `GET /scenes/{name}`",
    )
    quality: Quality | None = Field(default=None, description="for `jpeg` and `webp` only; default 90")
    background: Background = Field(
        default="auto",
        description="`scene`: the background color of training. `transparent` or null: none, and the frame "
        "has an alpha channel (not in `jpeg`). `[r, g, b]`: sRGB-encoded, 0 to 1. `auto`: `transparent` for `exr` "
        "and `npy`, `scene` for the others. Opaque frames: no alpha; 1 in `exr`, coverage in `npy`",
    )


class RenderQuery(BaseModel):
    """The query of `GET /render`. Lists are comma-separated."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: Name | None = Field(default=None, description="optional if only one is served")
    t: LaxNumber | None = Field(default=None, description="default: the scene's first time")
    dt: LaxNumber | None = Field(default=None, description="scene time; `motion` needs it")
    steps: LaxSteps | None = Field(default=None, description="as in `POST /render`")
    width: LaxPixels | None = Field(default=None, description="pixels")
    height: LaxPixels | None = Field(default=None, description="pixels")
    region: List | None = Field(default=None, description="as in `POST /render`", examples=["256,0,128,128"])
    format: ImageFormat = Field(default="png", description="as in `POST /render`")
    quality: LaxQuality | None = Field(default=None, description="quality of `jpeg` and `webp`")
    channels: List | None = Field(default=None, examples=["depth"])
    depth_range: List | None = Field(default=None, description="as in `POST /render`", examples=["1,9"])
    background: List | None = Field(default=None, description="`scene`, `transparent` or `r,g,b`", examples=["1,1,1"])
    camera: Name | None = Field(default=None, description="name of a camera of the scene")
    index: LaxIndex | None = Field(default=None, description="index of a camera of the scene")
    azimuth: LaxNumber | None = Field(default=None, description="degrees; default 30")
    elevation: LaxNumber | None = Field(default=None, description="degrees; default 20")
    distance: LaxNumber | None = Field(default=None, description="world units")
    eye: List | None = Field(default=None, examples=["4,0,1"])
    target: List | None = Field(default=None, examples=["0,0,0"])
    up: List | None = Field(default=None, examples=["0,0,1"])
    fov_y: LaxNumber | None = Field(default=None, description="vertical field of view, degrees")


class BatchRequest(Strict):
    """Frames to render, each with a response of its own."""

    frames: Annotated[list[dict[str, Any]], Field(min_length=1, max_length=MAX_BATCH)] = Field(
        description="bodies of `POST /render`, each with a single `t`",
        examples=[[{"camera": {"type": "orbit", "azimuth": 30, "elevation": 20}, "t": 0.0}]],
    )


class BatchItem(BaseModel):
    """A line of the response to a batch, sent when its frame is ready."""

    index: int = Field(description="index in `frames`, from 0")
    status: int = Field(description="status that `POST /render` would return")
    media_type: str | None = Field(default=None, description="media type of `data`")
    data: str | None = Field(default=None, description="the image file in base64")
    problem: dict[str, Any] | None = Field(default=None, description="the problem, if the frame failed")


class FilmFrame(Strict):
    """A frame of a video."""

    camera: CameraSpec
    t: Number = Field(description="time, within the scene's `time_range`", examples=[0.5])


class VideoRequest(Strict):
    """A video to render: give `frames`, or a `path` in nerfstudio's format."""

    scene: Name | None = Field(default=None, description="optional if only one is served")
    frames: Annotated[list[FilmFrame], Field(min_length=1, max_length=MAX_TIMES)] | None = Field(
        default=None, description="camera and time of each frame"
    )
    path: NerfstudioPath | None = Field(default=None, description="nerfstudio camera path, instead of `frames`")
    width: Pixels | None = Field(default=None, description="pixels; default: the path's, else the first camera's")
    height: Pixels | None = Field(default=None, description="pixels; required with `width`")
    fps: FramesPerSecond | None = Field(default=None, description="frames per second; default: the path's, else 24")
    format: VideoFormat = Field(default="mp4", description="`mp4`: H.264, odd: 4:4:4. `webm`: VP9. `webp`: animated")
    background: VideoBackground = Field(default="scene", description="`scene`, or sRGB-encoded, 0 to 1")


class SceneEntry(BaseModel):
    """A scene in the list of scenes."""

    name: str
    loaded: bool = Field(description="whether it is in memory; the first request for a scene loads it")
    problem: bool = Field(description="whether its current file is invalid; an earlier version may be served")
    reason: str | None = Field(description="why it is invalid")


class SceneList(BaseModel):
    """All scenes, sorted by name."""

    scenes: list[SceneEntry]


class SceneAdded(BaseModel):
    """A scene that was added."""

    name: str
    sha256: str = Field(description="SHA-256 of its file")


class GaussianCounts(BaseModel):
    """Numbers of Gaussians."""

    moving: int
    static: int
    total: int


class SceneView(BaseModel):
    """The scene's default view; OpenCV axes."""

    target: tuple[float, float, float] = Field(description="point that the camera looks at, world")
    distance: float = Field(description="distance from the target, world units")
    up: tuple[float, float, float] = Field(description="up direction, world, of length 1")
    fov_y: float = Field(description="vertical field of view, degrees")
    width: int = Field(description="pixels")
    height: int = Field(description="pixels")


class GraphLimit(BaseModel):
    """Limits of a scene's cost."""

    gaussians: int
    memory_bytes: int
    operations: float


class GraphCost(BaseModel):
    """Upper bounds of the cost of posing, which are known from the file and hold at all times."""

    memory_bytes: int = Field(description="memory of the values of one call of the graph and of all poses")
    operations: int = Field(description="operations to pose all moving Gaussians once")
    calls: int = Field(description="calls of the graph to pose all moving Gaussians once")
    limits: GraphLimit


class Placement(BaseModel):
    """x_world = scale · x + offset, of a point x in the frame of the scene file's graph."""

    scale: float
    offset: list[float]


class SceneDetail(SceneEntry):
    """Description of a scene."""

    contract: str
    plan: str = Field(description="how the deformation is computed")
    layers: list[str] = Field(description="kinds of the deformation layers, in order")
    steps: int = Field(description="number of layers that can be applied one by one; 0 if the plan doesn't run layers")
    gaussians: GaussianCounts
    changes: bool = Field(description="whether frames depend on the time; false in a static scene")
    motion: bool = Field(description="whether Gaussians move, so that the channel `motion` shows something")
    sh_degree: int
    time_range: tuple[float, float]
    duration: float | None = Field(description="of the time range, seconds, if the scene says so")
    bounds: tuple[list[float], list[float]] = Field(description="two corners of a box, world")
    scene_to_world: Placement = Field(description="of the file's positions in the world that cameras are in")
    background: tuple[float, float, float] = Field(description="sRGB-encoded")
    antialiasing: str
    eps2d: float = Field(description="px² added to the diagonal of projected covariances")
    delta_space: str
    view: SceneView
    cameras: list[dict[str, Any]] = Field(description="fx, fy, cx, cy, width, height in pixels; OpenCV axes")
    measured_error: dict[str, Any] = Field(description="error of the plan against the model")
    report: bool = Field(description="whether `GET /scenes/{name}/report` returns a report")
    left_out: list[Any] = Field(description="parts of the trained model that the exporter pruned")
    package_version: str
    checkpoint_sha256: str
    sha256: str = Field(description="SHA-256 of the scene's file")
    cost: GraphCost


class Live(BaseModel):
    """The process is alive."""

    status: Literal["ok"] = "ok"
    version: str


class Ready(BaseModel):
    """Scenes are loaded and kernels compiled."""

    status: Literal["ready"] = "ready"
