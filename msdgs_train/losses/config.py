"""Settings of the loss."""

from dataclasses import dataclass

from msdgs_train.settings import Checked


@dataclass(frozen=True)
class LossConfig(Checked):
    """Weights of the loss between a rendering and its image."""

    ssim_lambda: float = 0.2
    """Weight of 1 − SSIM, by gsplat's name: 1 − λ of equation 13, whose λ is the weight of L1."""
    mse_fraction: float = 0.0
    """Fraction of the loss that is replaced by MSE, which emphasizes large errors, such as those of motion."""
    alpha_weight: float = 0.0
    """Weight of the L1 error of alpha of images with transparent pixels; without, Gaussians of the background's color
    appear as fog in other views."""

    def __post_init__(self) -> None:
        self.require_fractions("ssim_lambda", "mse_fraction")
        self.require_weights("alpha_weight")
