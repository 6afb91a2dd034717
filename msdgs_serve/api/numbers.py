"""Types of numbers and names in requests, with their limits."""

from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticCustomError

from msdgs_serve.camera_path import MAX_FPS, MIN_FPS
from msdgs_serve.scene.camera import MAX_PIXELS_PER_SIDE
from msdgs_serve.scene_names import MAX_NAME_BYTES


def _whole(value: object) -> object:
    """An integer of a whole number with a decimal point, which JSON doesn't tell apart; other values as they are."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


# limits beyond any sensible value, within which single precision neither overflows nor underflows
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e9, le=1e9)]
Distance = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-6, le=1e9)]
Focal = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-3, le=1e8)]
FieldOfView = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.01, le=179.0)]
Elevation = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-89.9, le=89.9)]
FramesPerSecond = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=MIN_FPS, le=MAX_FPS)]
Pixels = Annotated[int, BeforeValidator(_whole), Field(strict=True, ge=1, le=MAX_PIXELS_PER_SIDE)]
LeastPixel = Annotated[int, BeforeValidator(_whole), Field(strict=True, ge=0, lt=MAX_PIXELS_PER_SIDE)]
Index = Annotated[int, BeforeValidator(_whole), Field(strict=True, ge=0, le=1_000_000)]
Samples = Annotated[int, BeforeValidator(_whole), Field(strict=True, ge=1, le=10_000)]
Quality = Annotated[int, BeforeValidator(_whole), Field(strict=True, ge=1, le=100)]
Unit = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1)]
Steps = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1000)]

# query parameters, which are strings
LaxNumber = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]
LaxPixels = Annotated[int, Field(ge=1, le=MAX_PIXELS_PER_SIDE)]
LaxIndex = Annotated[int, Field(ge=0, le=1_000_000)]
LaxQuality = Annotated[int, Field(ge=1, le=100)]
LaxSteps = Annotated[float, Field(allow_inf_nan=False, ge=0, le=1000)]
List = Annotated[str, Field(max_length=100)]

Vector = tuple[Number, Number, Number]
Row = tuple[Number, Number, Number, Number]
Color = tuple[Unit, Unit, Unit]


def _not_tiny(vector: Vector) -> Vector:
    if sum(x * x for x in vector) < 1e-12:
        raise PydanticCustomError("too_small", "must be longer than 1e-6")
    return vector


def _fits_a_file_name(name: str) -> str:
    if len(name.encode()) > MAX_NAME_BYTES:
        raise PydanticCustomError("name", "must be at most {most} bytes in UTF-8", {"most": MAX_NAME_BYTES})
    return name


Direction = Annotated[Vector, AfterValidator(_not_tiny)]
Name = Annotated[str, Field(min_length=1, max_length=MAX_NAME_BYTES), AfterValidator(_fits_a_file_name)]
