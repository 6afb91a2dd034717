"""Settings of the data."""

from dataclasses import dataclass
from typing import Literal

from msdgs_train.settings import Checked

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


@dataclass(frozen=True)
class DataConfig(Checked):
    """How images are read."""

    size: int | None = None
    """Width in pixels to train at, the height in proportion; the images' own if not given."""
    background: Literal["white", "black", "random"] = "white"
    """What is behind the scene. With random every step draws a color, and evaluation is on white."""
    scene_half_size: float | None = None
    """Half the side of the cube around the origin that holds the scene, scene units; what the dataset suggests if not
    given."""

    def __post_init__(self) -> None:
        self.require_positive_or_none("size", "scene_half_size")
        self.require(("background",), f"one of {[*BACKGROUNDS, 'random']}", lambda v: v in {*BACKGROUNDS, "random"})

    @property
    def evaluation_background(self) -> tuple[float, float, float]:
        """RGB in [0, 1] that held-out images are evaluated on, and that the model is saved with."""
        return BACKGROUNDS.get(self.background, BACKGROUNDS["white"])
