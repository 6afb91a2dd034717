"""Settings of the refinement of poses."""

from dataclasses import dataclass

from msdgs_train.settings import Checked


@dataclass(frozen=True)
class PoseConfig(Checked):
    """Refinement of the poses of training cameras, after the static phase."""

    pose_opt: bool = False
    """Whether poses of training images are refined, which helps if they are off by half a pixel. Models don't contain
    the corrections, and held-out images keep their poses."""
    pose_opt_lr_init: float = 2e-5
    """Learning rate of rotations, in radians, and of translations, in units of the cameras' distance from the scene,
    until all times take part."""
    pose_opt_lr_final: float = 2e-7
    """Learning rate of rotations and translations at the last step, to which it decays exponentially."""

    def __post_init__(self) -> None:
        self.require_positive("pose_opt_lr_init", "pose_opt_lr_final")
        self.require(("pose_opt",), "true or false", lambda v: type(v) is bool)
