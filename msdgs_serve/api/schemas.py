"""The JSON of requests and answers. Field descriptions are the documentation at /docs."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag

from msdgs_serve.imaging import ImageFormat
from msdgs_serve.scene.camera import MAX_PIXELS_PER_SIDE
from msdgs_serve.store import MAX_NAME_LENGTH

# Bounds far beyond any sensible value, within which single precision neither overflows nor underflows
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e9, le=1e9)]
Focal = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-3, le=1e8)]
FieldOfView = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.01, le=179.0)]
Pixels = Annotated[int, Field(strict=True, ge=1, le=MAX_PIXELS_PER_SIDE)]
Channel = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1)]
Name = Annotated[str, Field(min_length=1, max_length=MAX_NAME_LENGTH)]
Vector = tuple[Number, Number, Number]
Row = tuple[Number, Number, Number, Number]
Color = tuple[Channel, Channel, Channel]


def _not_tiny(vector: Vector) -> Vector:
    if sum(x * x for x in vector) < 1e-12:
        raise ValueError("must be longer than 1e-6")
    return vector


Direction = Annotated[Vector, AfterValidator(_not_tiny)]


class Strict(BaseModel):
    """Keys that are not known are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class MatrixCamera(Strict):
    """A pose and intrinsics. Give either `fov_y` or `fx`; pixels are those of the request's `width` × `height`."""

    type: Literal["matrix"]
    camera_to_world: tuple[Row, Row, Row, Row] = Field(description="4×4, by rows: rotation and position, no scale")
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


class LookAtCamera(Strict):
    """A camera at `eye` that sees `target` in the middle of the picture."""

    type: Literal["look_at"]
    eye: Vector = Field(description="where the camera is, world")
    target: Vector | None = Field(default=None, description="what it looks at, world; default: the middle of the scene")
    up: Direction | None = Field(
        default=None, description="which direction is up in the picture, world; default: the scene's"
    )
    fov_y: FieldOfView | None = Field(
        default=None, description="vertical, degrees; default: that of the scene's first camera"
    )


class OrbitCamera(Strict):
    """A camera on a sphere around `target`, looking at it."""

    type: Literal["orbit"]
    azimuth: Number = Field(description="degrees around `up`")
    elevation: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-89.9, le=89.9)] = Field(
        description="degrees above the horizon of `target`"
    )
    distance: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-6, le=1e9)] | None = Field(
        default=None, description="scene units; default: as far as the scene's cameras are"
    )
    target: Vector | None = Field(default=None, description="world; default: the middle of the scene")
    up: Direction | None = Field(default=None, description="world; default: the scene's")
    fov_y: FieldOfView | None = Field(
        default=None, description="vertical, degrees; default: that of the scene's first camera"
    )


class SceneCamera(Strict):
    """One of the cameras that the scene was made with; `GET /scenes/{name}` lists them."""

    type: Literal["scene"]
    name: Name | None = Field(default=None, description="give either `name` or `index`")
    index: Annotated[int, Field(strict=True, ge=0, le=1_000_000)] | None = Field(default=None, description="from 0")


CameraSpec = Annotated[MatrixCamera | LookAtCamera | OrbitCamera | SceneCamera, Field(discriminator="type")]


def _kind_of_background(value: Any) -> str:
    return "name" if value is None or isinstance(value, str) else "color"


Background = Annotated[
    Annotated[Literal["auto", "scene", "transparent"] | None, Tag("name")] | Annotated[Color, Tag("color")],
    Discriminator(_kind_of_background),
]


class RenderRequest(Strict):
    """A frame to draw."""

    scene: Name | None = Field(default=None, description="which scene; may be left out where only one is served")
    camera: CameraSpec
    t: Number = Field(description="time, within the scene's `time_range`")
    width: Pixels | None = Field(
        default=None,
        description="pixels. Default of width and height: those of the camera asked for, else of the scene's first "
        "camera; where one is given the other follows in proportion",
    )
    height: Pixels | None = Field(default=None, description="pixels; see `width`")
    format: ImageFormat = Field(
        default="png",
        description="`png`: 8-bit sRGB. `jpeg`, `webp`: the same, lossy. `exr`: 32-bit float scene-linear Rec.709 "
        "R G B A, premultiplied, and depth Z along the camera axis in scene units, infinite where nothing is",
    )
    quality: Annotated[int, Field(strict=True, ge=1, le=100)] | None = Field(
        default=None, description="for `jpeg` and `webp` only; default 90"
    )
    background: Background = Field(
        default="auto",
        description="`scene`: the colour that the scene was trained on. `transparent` or null: none, and the frame "
        "has an alpha channel (not in `jpeg`). `[r, g, b]`: sRGB-encoded, 0 to 1. `auto`: `transparent` for `exr`, "
        "`scene` for the others. An opaque frame has no alpha, or alpha 1 in `exr`",
    )


class SceneEntry(BaseModel):
    """A scene in the list."""

    name: str
    loaded: bool = Field(description="whether it is in memory; a scene is loaded by the first request for it")
    problem: bool = Field(description="whether its file, as it is now, is broken; an earlier version may be served")


class SceneList(BaseModel):
    """All scenes, by name."""

    scenes: list[SceneEntry]


class GaussianCounts(BaseModel):
    """How many Gaussians there are."""

    moving: int
    static: int
    total: int


class SceneDetail(SceneEntry):
    """A scene, from what its file says of itself."""

    contract: str
    plan: str = Field(description="how the deformation is computed")
    layers: list[str] = Field(description="kinds of the deformation steps, in order")
    gaussians: GaussianCounts
    sh_degree: int
    time_range: tuple[float, float]
    bounds: tuple[list[float], list[float]] = Field(description="two corners of a box, world")
    background: tuple[float, float, float] = Field(description="sRGB-encoded")
    antialiasing: str
    delta_space: str
    cameras: list[dict[str, Any]] = Field(description="fx, fy, cx, cy, width, height in pixels; OpenCV axes")
    measured_error: dict[str, Any] = Field(description="of the plan, against the exact network")
    left_out: list[Any] = Field(description="what the exporter took out of the trained model")
    package_version: str
    checkpoint_sha256: str


class Health(BaseModel):
    """That the service runs."""

    status: Literal["ok"] = "ok"
    version: str
