"""Settings of density control."""

from dataclasses import dataclass
from typing import Annotated, Literal

from torch import Tensor

from msdgs_train.settings import Checked, optional

GAUSSIANS_PER_PIXEL, FEWEST, MOST = 0.45, 18_000, 100_000
"""The upper bound of the number of Gaussians if none is given. A bound of 72,000 instead of 18,000 gains 0.1 to 0.5 dB
on `val` images of four scenes, 320 to 400 pixels wide, in as many steps."""


@dataclass(frozen=True)
class DensityConfig(Checked):
    """The number of Gaussians, and when and where they are added and removed."""

    init_num_pts: int = 8_000
    """Gaussians at the start: the dataset's sparse points, at most so many, or random in a cube around the origin."""
    init_min_views: float = 0.0
    """Random Gaussians start where at least this fraction of the cameras sees them."""
    init_gray: Annotated[float | None, optional("GRAY")] = None
    """Random Gaussians start with this gray, 0 to 1; with random colors if not given."""
    max_gaussians: Annotated[int | None, optional("INT")] = 10_000
    """Upper bound of the number of Gaussians; those with the largest gradients are densified first. If not
    given: 0.45 per pixel of a training image, but 18,000 to 100,000."""
    density_strategy: Literal["gradient", "mcmc"] = "gradient"
    """gradient clones and splits by gradients of the projected means, and prunes; mcmc relocates low-opacity Gaussians
    and grows by 5 % a round up to --max-gaussians."""
    refine_start_fraction: float = 500 / 16_000
    """Density control begins after this fraction of the run."""
    refine_every_fraction: float = 100 / 16_000
    """Fraction of the run between rounds of density control; 0 switches it off."""
    refine_stop_fraction: float = 0.7
    """Density control ends after this fraction of the run."""
    grow_grad2d: float = 4e-4
    """gradient: Gaussians whose projected means have gradients of a larger mean norm, in normalized device coordinates,
    are densified."""
    absolute_gradients: bool = False
    """gradient: sum the absolute values of the pixels' gradients of a projected mean (AbsGS), so that those of opposite
    sides of a large Gaussian don't cancel; --grow-grad2d is then about twice as large."""
    grow_scale3d: float = 0.01
    """gradient: of these, Gaussians larger than this fraction of the scene's scale are split, smaller ones cloned."""
    prune_opa: float = 0.005
    """Gaussians of a lower opacity are removed, or relocated."""
    prune_unseen_passes: float = 0.0
    """gradient: Gaussians that no image shows in so many passes over the cameras are removed, and those outside an
    image whose border is empty all around; 0: never."""
    prune_subpixel: float = 0.0
    """gradient: Gaussians whose largest standard deviation is below this fraction of a pixel are removed; the blur of
    the rasterizer (--eps2d) still shows them, as dots, which may become opaque and multiply in dark images. 0: never.
    """
    prune_scale3d: float = 0.1
    """gradient: Gaussians larger than this fraction of the scene's scale are removed after a reset of opacities."""
    reset_every_fraction: float = 0.0
    """gradient: opacities are reset to at most 0.01 after each such fraction of the run, while density control lasts;
    0: never."""
    noise_lr: float = 5e5
    """mcmc: factor of the noise added to means, whose size follows from their learning rate and covariance."""
    opacity_reg: Annotated[float | None, optional("FLOAT")] = None
    """Weight of the mean opacity, which makes Gaussians that aren't needed transparent, so that they are removed; with
    gradient until density control ends, but with one image per time not in the time window, static or growing, when it
    may take fast objects. 0.01 with mcmc and 0 with gradient if not given."""
    scale_reg: Annotated[float | None, optional("FLOAT")] = None
    """Weight of the mean scale in scene units, as --opacity-reg."""

    def __post_init__(self) -> None:
        self.require_counts("init_num_pts")
        self.require_fractions("refine_start_fraction", "refine_every_fraction", "refine_stop_fraction")
        self.require_fractions("reset_every_fraction", "prune_opa", "init_min_views")
        self.require_fractions(*(["init_gray"] if self.init_gray is not None else []))
        self.require_positive("grow_grad2d", "grow_scale3d", "prune_scale3d")
        self.require_weights("noise_lr", "prune_unseen_passes", "prune_subpixel")
        self.require_weights(*(n for n in ("opacity_reg", "scale_reg") if getattr(self, n) is not None))
        few = "a whole number of init_num_pts or more, or None"
        self.require(("max_gaussians",), few, lambda v: v is None or (type(v) is int and v >= self.init_num_pts))
        self.require(("density_strategy",), "gradient or mcmc", lambda v: v in ("gradient", "mcmc"))

    def bound(self, pixels: int) -> int:
        """`max_gaussians`, or what it is with images of so many pixels."""
        if self.max_gaussians is not None:
            return self.max_gaussians
        return max(self.init_num_pts, min(max(round(GAUSSIANS_PER_PIXEL * pixels), FEWEST), MOST))

    def regularizers(self, opacities: Tensor, scales: Tensor, *, pruning: bool) -> dict[str, Tensor]:
        """Weighted terms of the loss, by name, of [N] opacities and [N, 3] scales of posed Gaussians; `pruning` as
        `Schedule.prunes_hidden`."""
        mcmc = self.density_strategy == "mcmc"
        if not (mcmc or pruning):
            return {}
        default = 1e-2 if mcmc else 0.0
        weights = (default if weight is None else weight for weight in (self.opacity_reg, self.scale_reg))
        means = (("opacity", opacities), ("scale", scales))
        return {name: w * values.mean() for w, (name, values) in zip(weights, means, strict=True) if w}
