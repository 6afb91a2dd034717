"""Settings of the loss."""

from dataclasses import dataclass

from msdgs_train.settings import Checked


@dataclass(frozen=True)
class LossConfig(Checked):
    """Weights of the loss between a rendering and its image."""

    ssim_lambda: float = 0.2
    """Weight of 1 − SSIM; L1 has the rest (equation 13, where λ is that of L1)."""
    mse_fraction: float = 0.0
    """This fraction of the loss is MSE instead, which emphasizes large errors: those of motion."""
    pooled_l1_weight: float = 0.0
    """Weight of L1 of images pooled over 8 to 32 pixels, added for samples that train motion alone: pooling gives a
    gradient at displacements larger than the object."""

    def __post_init__(self) -> None:
        self.require_fractions("ssim_lambda", "mse_fraction")
        self.require_weights("pooled_l1_weight")
