"""Settings of the curriculum."""

from dataclasses import dataclass
from typing import Any

from msdgs_train.settings import Checked


@dataclass(frozen=True)
class CurriculumConfig(Checked):
    """The images of each phase of a run."""

    static_fraction: float = 0.1
    """The first fraction of the run trains on all images without deformation, until static parts have converged
    (warm_up of Deformable-3D-Gaussians, the coarse stage of 4DGaussians)."""
    static_window_fraction: float = 0.025
    """The next fraction is still without deformation, on the first time window, in which moving objects take shape."""
    window_start_widths: tuple[float, ...] = (0.03,)
    """Half width at which the time window, centered in the scene's time, begins to grow, as a fraction of that time.
    With more than one, it shrinks to the next and grows again, in as many steps; from then on all images of the window
    train everything."""
    window_full_fraction: float = 0.75
    """The fraction of the run after which all times take part; 0: from the start."""
    new_frames_motion_only: bool = True
    """While the window first grows, half of the steps, on newly admitted images, train motion alone."""
    outside_frames_static_only: bool = True
    """While it first grows, a quarter of the steps, on images outside, train static parts alone."""

    def __post_init__(self) -> None:
        self.require_fractions("static_fraction", "static_window_fraction", "window_full_fraction")
        self.require(("window_start_widths",), "one number or more, in [0, 0.5] each", _are_widths)
        object.__setattr__(self, "window_start_widths", tuple(self.window_start_widths))


def _are_widths(values: Any) -> bool:
    numbers = isinstance(values, list | tuple) and all(type(v) in (int, float) and 0 <= v <= 0.5 for v in values)
    return numbers and len(values) > 0
