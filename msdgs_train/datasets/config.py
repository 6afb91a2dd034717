"""Settings of the data."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from msdgs_train.datasets.common.backdrop import Color
from msdgs_train.datasets.common.scene_data import SceneData
from msdgs_train.datasets.common.times import EXPECTED, is_time_from
from msdgs_train.settings import Checked, optional

Background = Literal["auto", "white", "black", "random"]

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class DataConfig(Checked):
    """Images and background."""

    size: Annotated[int | None, optional("PIXELS")] = None
    """Width of the images in pixels, height in proportion; their own if not given."""
    llffhold: int = 0
    """N: the first training image and every N-th after it are held out for testing, and those halfway between for
    validation, in place of the dataset's splits; if it names none, these are of all images. 0: the dataset's splits."""
    time_from: Annotated[str | None, optional("{names,index,none,REGEX}")] = None
    """Times of the images: `names` takes the number, date or clock in the files' names that varies with time; `index`
    their order; `none` is a scene that stands still; a regular expression has the time as its group, such as
    'frame_(\\d+)'. The dataset's own times if not given; for COLMAP those of `times.json`, or else `names`."""
    masks: bool = True
    """Whether pixels that a dataset's masks hide (black in the mask) are left out of the loss and of evaluations."""
    background: Background = "auto"
    """Color behind the scene. auto: if most pixels at the borders of opaque images have one color, that color, else
    white; random: another one each step, white in evaluation."""
    scene_half_size: Annotated[float | None, optional("LENGTH")] = None
    """Half the side of the cube around its center that holds the scene, in the dataset's units; from points or cameras
    if not given."""

    def __post_init__(self) -> None:
        self.require(
            ("size",), "a whole number above 0, or not given", lambda v: v is None or (type(v) is int and v > 0)
        )
        self.require_positive_or_none("scene_half_size")
        self.require(("llffhold",), "0, or an integer of 3 or more", lambda v: type(v) is int and (v == 0 or v > 2))
        self.require(("time_from",), EXPECTED, is_time_from)
        self.require(("masks",), "true or false", lambda v: type(v) is bool)
        self.require(("background",), f"one of {[*get_args(Background)]}", lambda v: v in get_args(Background))

    def evaluation_background(self, scene: SceneData) -> Color:
        """RGB in [0, 1] behind held-out images of a scene; stored in the model."""
        if self.background == "auto":
            return scene.backdrop or WHITE
        return BLACK if self.background == "black" else WHITE
