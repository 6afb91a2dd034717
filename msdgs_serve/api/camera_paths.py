"""JSON schema of nerfstudio's camera paths in requests; `msdgs_serve.camera_path` reads and checks them."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, Field

from msdgs_serve.api.numbers import FieldOfView, FramesPerSecond, Number, Pixels, Unit
from msdgs_serve.camera_path import joined_rows

MAX_TIMES = 1000


class PathCamera(BaseModel, extra="allow"):
    """A camera of nerfstudio's camera_path.json, in OpenGL axes; other keys are named in the header Msdgs-Warning."""

    camera_to_world: Annotated[list[Number], BeforeValidator(joined_rows), Field(min_length=16, max_length=16)] = Field(
        description="4×4 by rows, or as four rows", examples=[[0, 0, 1, 4, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1]]
    )
    fov: FieldOfView = Field(description="vertical, degrees")
    camera_type: Literal["perspective"] | None = Field(default=None, description="no other can be drawn")
    crop: Any = Field(default=None, description="must be null: scenes are drawn whole")
    render_time: Unit | None = Field(default=None, description="fraction of the time range; default: evenly spaced")


class NerfstudioPath(BaseModel, extra="allow"):
    """The contents of nerfstudio's camera_path.json; the header Msdgs-Warning names keys that nothing reads."""

    camera_path: Annotated[list[PathCamera], Field(max_length=MAX_TIMES)] = Field(description="one or more")
    camera_type: Literal["perspective"] = Field(default="perspective", description="no other can be drawn")
    render_width: Pixels | None = Field(default=None, description="pixels; required if the request has no size")
    render_height: Pixels | None = Field(default=None, description="pixels; see `render_width`")
    fps: FramesPerSecond | None = Field(default=None, description="frames per second")
    seconds: Number | None = Field(default=None, description="duration, if there is no `fps`")
    crop: Any = Field(default=None, description="must be null: scenes are drawn whole")
