"""Settings of the curriculum."""

from dataclasses import dataclass

from msdgs_train.settings import Checked, Flag

HALVED_WIDTH = 320
"""Narrower images always have their full size, in pixels."""


@dataclass(frozen=True)
class CurriculumConfig(Checked):
    """The images of each phase of a run."""

    static_fraction: float = 0.1
    """The first fraction of the run trains on all images without deformation, until static parts have converged."""
    static_window_fraction: float = 0.025
    """The next fraction is still without deformation, on the first time window, in which moving objects take shape."""
    window_start_width: float = 0.03
    """Half width at which the time window, centered in the scene's time, begins to grow, as a fraction of that time."""
    window_full_fraction: float = 0.75
    """The fraction of the run after which all times take part alike; 0: from the start. Until then half of the images
    are the newest of the window."""
    half_resolution_fraction: float = 0.0
    """The first fraction of the run trains on images of half the width and height if they are 320 pixels wide or more:
    its steps are faster and add fewer Gaussians."""
    restart_at_motion: Flag = False
    """Adam, its learning rates and the steps that density control counts start again when motion begins."""
    time_noise: float = 0.0
    """Standard deviation of the noise on the times of training images at the start, in distances between them."""
    time_noise_fraction: float = 0.5
    """Fraction of the run after which that noise has fallen to 0."""

    def __post_init__(self) -> None:
        self.require_fractions("static_fraction", "static_window_fraction", "window_full_fraction")
        self.require_fractions("half_resolution_fraction", "time_noise_fraction")
        self.require_weights("time_noise")
        self.require(("restart_at_motion",), "true or false", lambda v: type(v) is bool)
        self.require(("window_start_width",), "in [0, 0.5)", lambda v: type(v) in (int, float) and 0 <= v < 0.5)
