"""The JSON of requests and answers. Field descriptions are the documentation at /docs."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

from msdgs_serve.api.numbers import (
    Color,
    Decibels,
    Direction,
    Distance,
    Elevation,
    FieldOfView,
    Focal,
    FramesPerSecond,
    Index,
    LaxDecibels,
    LaxIndex,
    LaxNumber,
    LaxPixels,
    LaxQuality,
    LaxSteps,
    List,
    Name,
    Number,
    Pixels,
    Quality,
    Row,
    Samples,
    Steps,
    Unit,
    Vector,
)
from msdgs_serve.imaging import Channel, ImageFormat
from msdgs_serve.scene.camera import CameraModel
from msdgs_serve.video import VideoFormat

MAX_TIMES = 1000
MAX_BATCH = 1000


class Strict(BaseModel):
    """Keys that are not known are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class MatrixCamera(Strict):
    """A pose and intrinsics. Give either `fov_y` or `fx`; pixels are those of the request's `width` × `height`."""

    type: Literal["matrix"]
    camera_to_world: tuple[Row, Row, Row, Row] = Field(
        description="4×4, by rows: rotation and position, no scale",
        examples=[[[0, 0, -1, 4], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]],
    )
    axes: Literal["opencv", "opengl"] = Field(
        default="opencv",
        description="of the camera: `opencv` x right, y down, z forward; `opengl` x right, y up, z backward "
        "(NeRF, Blender, D-NeRF)",
    )
    fov_y: FieldOfView | None = Field(default=None, description="vertical field of view, degrees")
    fx: Focal | None = Field(default=None, description="focal length, pixels")
    fy: Focal | None = Field(default=None, description="default: `fx`")
    cx: Number | None = Field(
        default=None, description="principal point, pixels from the left edge; default: the middle"
    )
    cy: Number | None = Field(
        default=None, description="principal point, pixels from the top edge; default: the middle"
    )
    model: CameraModel = Field(
        default="pinhole",
        description="`orthographic`: `fx` is in pixels a scene unit; `fisheye`: as OpenCV has it",
    )
    distortion: tuple[Number, Number, Number, Number] = Field(
        default=(0.0, 0.0, 0.0, 0.0), description="k1 to k4 of a `fisheye` camera"
    )


class LookAtCamera(Strict):
    """A camera at `eye` that sees `target` in the middle of the image."""

    type: Literal["look_at"]
    eye: Vector = Field(description="where the camera is, world", examples=[[4, 0, 1]])
    target: Vector | None = Field(
        default=None, description="what it looks at, world; default: the middle of the scene", examples=[[0, 0, 0]]
    )
    up: Direction | None = Field(
        default=None, description="which direction is up in the image, world; default: the scene's",
        examples=[[0, 0, 1]],
    )  # fmt: skip
    fov_y: FieldOfView | None = Field(
        default=None, description="vertical, degrees; default: that of the scene's first camera"
    )


class OrbitCamera(Strict):
    """A camera on a sphere around `target`, looking at it."""

    type: Literal["orbit"]
    azimuth: Number = Field(description="degrees around `up`")
    elevation: Elevation = Field(description="degrees above the horizon of `target`")
    distance: Distance | None = Field(
        default=None, description="scene units; default: as far as the scene's cameras are"
    )
    target: Vector | None = Field(
        default=None, description="world; default: the middle of the scene", examples=[[0, 0, 0]]
    )
    up: Direction | None = Field(default=None, description="world; default: the scene's", examples=[[0, 0, 1]])
    fov_y: FieldOfView | None = Field(
        default=None, description="vertical, degrees; default: that of the scene's first camera"
    )


class SceneCamera(Strict):
    """One of the cameras that the scene was made with; `GET /scenes/{name}` lists them."""

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


def _kind_of_time(value: Any) -> str:
    return "list" if isinstance(value, list | tuple) else "one"


Times = Annotated[
    Annotated[Number, Tag("one")] | Annotated[list[Number], Field(min_length=1, max_length=MAX_TIMES), Tag("list")],
    Discriminator(_kind_of_time),
]
Channels = Annotated[list[Channel], Field(min_length=1, max_length=8)]


class ShutterSpec(Strict):
    """Motion blur: light from `t + open` to `t + close`, taken at the middles of `samples` equal parts of it."""

    open: Number = Field(description="scene time, relative to `t`", examples=[-0.01])
    close: Number = Field(description="scene time, relative to `t`; after `open`", examples=[0.01])
    samples: Samples = Field(
        default=8, description="moments drawn and averaged in linear light; the service has a limit"
    )


class RenderRequest(Strict):
    """A frame to draw, or one for each time."""

    scene: Name | None = Field(default=None, description="which scene; may be left out where only one is served")
    min_psnr: Decibels | None = Field(
        default=None,
        description="takes the fastest file of the scene's model whose worst frame has at least this PSNR in dB: "
        "`walk.onnx`, or beside it `walk.….onnx`. `Msdgs-Scene`, `-Plan` and `-Error` say which it was",
        examples=[40],
    )
    camera: CameraSpec
    t: Times = Field(
        description="time, within the scene's `time_range`; or a list of them, answered with a ZIP file of one image "
        "each, or for `npy` with one array [T, H, W, C]",
        examples=[0.5],
    )
    width: Pixels | None = Field(
        default=None,
        description="pixels. Default of width and height: those of the camera asked for, else of the scene's first "
        "camera; where one is given the other follows in proportion",
    )
    height: Pixels | None = Field(default=None, description="pixels; see `width`")
    format: ImageFormat = Field(
        default="png",
        description="`png`: 8-bit sRGB. `jpeg`, `webp`: the same, lossy. `exr`: 32-bit float scene-linear Rec.709 "
        "R G B A, premultiplied, and depth Z along the camera axis in scene units, infinite where nothing is. `npy`: "
        "a NumPy array [H, W, C], float32, as rendered: sRGB-encoded color, premultiplied where transparent",
    )
    channels: Channels | None = Field(
        default=None,
        description="`rgb`, `alpha`, `depth`, `motion`, `gaussians`, in the order of the file. Default for `exr` and "
        "`npy`: the first three. The others hold a single one as an image; depth is lighter the nearer it is, the "
        "hue of motion is its direction. Motion is in pixels to the right and down, in `exr` as forward.u and "
        "forward.v. `gaussians` is how many add to each pixel: where the time goes",
    )
    depth_range: tuple[Number, Number] | None = Field(
        default=None,
        description="depths drawn white and darkest in an image of depth; default: those of the frame",
        examples=[[1, 9]],
    )
    dt: Number | None = Field(
        default=None,
        description="`motion` leads to where things are at `t + dt`; needed for it, scene time",
        examples=[0.1],
    )
    shutter: ShutterSpec | None = Field(default=None, description="motion blur; default: a single moment")
    steps: Steps | None = Field(
        default=None,
        description="after so many of the scene's deformation layers: 0 as the Gaussians are stored, 1.5 the first and "
        "half of what the second does. Default: all. For scenes with `steps`, see `GET /scenes/{name}`",
    )
    quality: Quality | None = Field(default=None, description="for `jpeg` and `webp` only; default 90")
    background: Background = Field(
        default="auto",
        description="`scene`: the color that the scene was trained on. `transparent` or null: none, and the frame "
        "has an alpha channel (not in `jpeg`). `[r, g, b]`: sRGB-encoded, 0 to 1. `auto`: `transparent` for `exr`, "
        "`scene` for the others. An opaque frame has no alpha, or alpha 1 in `exr`",
    )


class RenderQuery(BaseModel):
    """The same as a link that a browser opens. Lists are written with commas."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: Name | None = Field(default=None, description="may be left out where only one is served")
    min_psnr: LaxDecibels | None = Field(default=None, description="dB, as in `POST /render`")
    t: LaxNumber | None = Field(default=None, description="default: the scene's first time")
    steps: LaxSteps | None = Field(default=None, description="as in `POST /render`")
    width: LaxPixels | None = Field(default=None, description="pixels")
    height: LaxPixels | None = Field(default=None, description="pixels")
    format: ImageFormat = Field(default="png", description="as in `POST /render`")
    quality: LaxQuality | None = Field(default=None, description="of `jpeg` and `webp`")
    channels: List | None = Field(default=None, examples=["depth"])
    background: List | None = Field(default=None, description="`scene`, `transparent` or `r,g,b`", examples=["1,1,1"])
    camera: Name | None = Field(default=None, description="a camera of the scene, by name")
    index: LaxIndex | None = Field(default=None, description="or by number")
    azimuth: LaxNumber | None = Field(default=None, description="degrees; default 30")
    elevation: LaxNumber | None = Field(default=None, description="degrees; default 20")
    distance: LaxNumber | None = Field(default=None, description="scene units")
    eye: List | None = Field(default=None, examples=["4,0,1"])
    target: List | None = Field(default=None, examples=["0,0,0"])
    up: List | None = Field(default=None, examples=["0,0,1"])
    fov_y: LaxNumber | None = Field(default=None, description="vertical field of view, degrees")


class BatchRequest(Strict):
    """Frames to draw, each with an answer of its own."""

    frames: Annotated[list[dict[str, Any]], Field(min_length=1, max_length=MAX_BATCH)] = Field(
        description="bodies of `POST /render`, each with a single `t`",
        examples=[[{"camera": {"type": "orbit", "azimuth": 30, "elevation": 20}, "t": 0.0}]],
    )


class BatchItem(BaseModel):
    """A line of the answer to a batch; lines come as frames are ready, `index` says which one it is."""

    index: int = Field(description="in `frames`, from 0")
    status: int = Field(description="as `POST /render` would answer it")
    media_type: str | None = Field(default=None, description="of `data`")
    data: str | None = Field(default=None, description="the image file in base64")
    problem: dict[str, Any] | None = Field(default=None, description="instead, where it failed")


class FilmFrame(Strict):
    """A frame of a film."""

    camera: CameraSpec
    t: Number = Field(description="time, within the scene's `time_range`", examples=[0.5])


class PathCamera(BaseModel):
    """A camera of nerfstudio's camera_path.json, OpenGL axes; its other keys are passed over."""

    camera_to_world: Annotated[list[Number], Field(min_length=16, max_length=16)] = Field(
        description="4×4, row after row", examples=[[0, 0, 1, 4, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1]]
    )
    fov: FieldOfView = Field(description="vertical, degrees")
    render_time: Unit | None = Field(default=None, description="a part of the scene's time, which else runs evenly")


class NerfstudioPath(BaseModel):
    """The contents of nerfstudio's camera_path.json; its other keys are passed over."""

    camera_path: Annotated[list[PathCamera], Field(min_length=1, max_length=MAX_TIMES)]
    render_width: Pixels | None = Field(default=None, description="pixels; needed where the request has no size")
    render_height: Pixels | None = Field(default=None, description="pixels; see `render_width`")
    fps: FramesPerSecond | None = Field(default=None, description="frames a second")


class VideoRequest(Strict):
    """A film to draw: give `frames`, or a `path` as nerfstudio writes it."""

    scene: Name | None = Field(default=None, description="may be left out where only one is served")
    frames: Annotated[list[FilmFrame], Field(min_length=1, max_length=MAX_TIMES)] | None = Field(
        default=None, description="one camera and one time each"
    )
    path: NerfstudioPath | None = Field(default=None, description="of nerfstudio, in place of `frames`")
    width: Pixels | None = Field(default=None, description="pixels; default: the path's, else the first camera's")
    height: Pixels | None = Field(default=None, description="pixels; goes with `width`")
    fps: FramesPerSecond | None = Field(default=None, description="frames a second; default: the path's, else 24")
    format: VideoFormat = Field(default="mp4", description="`mp4`: H.264. `webm`: VP9. `webp`: animated")
    background: tuple[Unit, Unit, Unit] | Literal["scene"] = Field(default="scene", description="sRGB-encoded, 0 to 1")


class SceneEntry(BaseModel):
    """A scene in the list."""

    name: str
    loaded: bool = Field(description="whether it is in memory; a scene is loaded by the first request for it")
    problem: bool = Field(description="whether its file, as it is now, is broken; an earlier version may be served")
    reason: str | None = Field(description="why it is broken")


class SceneList(BaseModel):
    """All scenes, by name."""

    scenes: list[SceneEntry]


class SceneAdded(BaseModel):
    """A scene that was added."""

    name: str
    sha256: str = Field(description="of its file")


class GaussianCounts(BaseModel):
    """How many Gaussians there are."""

    moving: int
    static: int
    total: int


class SceneView(BaseModel):
    """How the scene is seen where a request says nothing else; OpenCV axes."""

    target: tuple[float, float, float] = Field(description="the middle of the scene, world")
    distance: float = Field(description="from there, in scene units")
    up: tuple[float, float, float] = Field(description="world, of length 1")
    fov_y: float = Field(description="vertical field of view, degrees")
    width: int = Field(description="pixels")
    height: int = Field(description="pixels")


class GraphLimit(BaseModel):
    """What a scene may take at most."""

    gaussians: int
    memory_bytes: int
    operations: float


class GraphCost(BaseModel):
    """What posing takes at most, known from the file before anything runs and the same at all times."""

    memory_bytes: int = Field(description="of the values of one call of the graph and of all poses")
    operations: int = Field(description="of posing all moving Gaussians once")
    calls: int = Field(description="of the graph, that this takes")
    limits: GraphLimit


class SceneDetail(SceneEntry):
    """A scene, from what its file says of itself."""

    contract: str
    plan: str = Field(description="how the deformation is computed")
    layers: list[str] = Field(description="kinds of the deformation steps, in order")
    steps: int = Field(description="how many of them frames can be drawn after; 0 where the plan doesn't run them")
    gaussians: GaussianCounts
    sh_degree: int
    time_range: tuple[float, float]
    bounds: tuple[list[float], list[float]] = Field(description="two corners of a box, world")
    background: tuple[float, float, float] = Field(description="sRGB-encoded")
    antialiasing: str
    eps2d: float = Field(description="px² added to the diagonal of projected covariances")
    delta_space: str
    view: SceneView
    cameras: list[dict[str, Any]] = Field(description="fx, fy, cx, cy, width, height in pixels; OpenCV axes")
    measured_error: dict[str, Any] = Field(description="of the plan, against the exact network")
    report: bool = Field(description="whether `GET /scenes/{name}/report` has something to say")
    left_out: list[Any] = Field(description="what the exporter took out of the trained model")
    package_version: str
    checkpoint_sha256: str
    sha256: str = Field(description="of the scene's file")
    cost: GraphCost


class Live(BaseModel):
    """That the process answers."""

    status: Literal["ok"] = "ok"
    version: str


class Ready(BaseModel):
    """That scenes are loaded and kernels compiled."""

    status: Literal["ready"] = "ready"
