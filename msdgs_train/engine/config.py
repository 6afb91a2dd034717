"""Everything that shapes a training run, in one frozen dataclass that is checked when it is built."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.config import ModelConfig

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}

SMALL_MODEL = ModelConfig(sh_degree=2, width=96, depth=2, xyz_frequencies=4, time_width=64)


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a run; the defaults suit a small scene, 200 pixels wide, on two cores in half an hour."""

    steps: int = 16_000
    """Optimiser steps."""
    batch_size: int = 1
    """Images a step, rendered side by side on `threads`; what they teach of each parameter is averaged. On two
    cores four take 2.7 times the time of one; whether a run learns more a minute by four has not been measured."""
    size: int | None = None
    """Width in pixels to train at; the images' own width if not given."""
    seed: int = 0
    """Of the initial Gaussians, the order of the images, random backgrounds and splits."""
    threads: int = 2
    """Threads that images of one step are shared among; with one image a step, threads that torch uses, and
    then the same seed gives the same bits for the same number of threads."""
    max_minutes: float | None = None
    """Stop, evaluate and save after so many minutes in all, resumed parts included, even if steps are left."""
    background: Literal["white", "black", "random"] = "white"
    """What is behind the scene. With `random` every step draws a color, and evaluation is on white."""

    model: ModelConfig = field(default_factory=lambda: SMALL_MODEL)
    """The multi-step deformation: number of layers, their sizes, the modulation."""

    init_num_pts: int = 8_000
    """Gaussians at the start: the dataset's sparse points, at most so many, or random in a cube around the origin."""
    scene_half_size: float | None = None
    """Half the side of that cube in scene units; what the dataset suggests if not given."""
    static_fraction: float = 0.1
    """The first part of the run is trained on all images without deformation: what stands still is in place. Half
    as much costs the demo, of 2,500 steps, 0.5 dB."""
    reseed_fraction: float = 0.25
    """After that, Gaussians are added at random, this part of `max_gaussians`: where something only passes, none are
    left. Until then there are at most `max_gaussians` less twice as many."""
    static_window_fraction: float = 0.025
    """The next part of the run is still without deformation, but on images of the middle of the scene's time, in
    which what moves takes shape."""
    window_start_widths: tuple[float, ...] = (0.03,)
    """These are up to the first part of the scene's time away from its middle. What moves is sharp there, and is then
    followed outwards, image by image. With more than one part the window shrinks to the next and grows again,
    in as many steps: what was blurred where motions weren't known well gets sharp in the middle, and is followed anew
    along motions nearly right, by images that all teach everything."""
    window_full_fraction: float = 0.75
    """The part of the run after which all times take part; 0: from the start, and nothing is sown or settles."""
    new_frames_motion_only: bool = True
    """Half of the steps while the window first grows, of its outermost images, teach motion alone; else
    everything."""
    outside_frames_static_only: bool = True
    """A quarter of the steps while it first grows, of images outside, teach what stands still; else there are
    none."""
    eps2d_init: float | None = None
    """What is added to projected covariances, px², until all times take part, when `model.eps2d` takes its place; the
    same from the start if not given."""
    ema_steps: int = 0
    """The model that is judged, shown and saved is an exponential mean over about the last so many steps, once all
    times take part and density control has ended: each step fits its images a little at the cost of the others,
    the mean suits them all. 0: the model is as the last step left it."""
    sh_degree_interval: int = 2000
    """The degree of the spherical harmonics in use goes up by one each so many steps."""
    l1_weight: float = 0.8
    """λ in L = λ L1 + (1 − λ) D-SSIM (equation 13)."""
    mse_fraction: float = 0.0
    """This part of L is squared errors instead, which ask most where most is wrong: where it moves, not all over the
    ground."""
    pooled_l1_weight: float = 0.0
    """Of L1 of images averaged over blocks of 8 to 32 pixels, added where images teach motion alone: what is
    out of place by more than its own size is found again."""
    rigidity_weight: float = 0.0
    """Of the mean relative change of distances between Gaussians, added to the loss; 0: none."""
    motion_smoothness_weight: float = 0.2
    """Of the mean size of second differences along time of motion bases."""
    arap_weight: float = 0.1
    """Of how far neighbouring motions are from being one, on average: a part of the distance between them."""
    time_smoothness_weight: float = 1e-2
    """Of the mean squared second difference along time of the grids of plane layers."""
    plane_tv_weight: float = 1e-4
    """Of the mean squared first difference along space."""
    plane_smoothness_weight: float = 0.0
    """Of the mean squared second difference along space, which 4DGS has instead."""
    l1_time_planes_weight: float = 0.0
    """Of the mean distance of the planes over time from 1, where they change nothing; 4DGS has it."""

    means_lr_init: float = 8e-4
    """Learning rate of the canonical centres, in scene units; Adam moves a centre by about this much a step."""
    means_lr_final: float = 8e-6
    """At the last step; in between it decays exponentially."""
    deform_lr_init: float = 2e-3
    """Learning rate of the deformation layers."""
    deform_lr_final: float = 2e-5
    """At the last step."""
    spline_lr_init: float = 6e-4
    """Learning rate of motion bases, alike for shifts, turns and stretches; as long as all times don't take part it
    stays, and a step at the time of an image that teaches motion alone is eight times as long."""
    spline_lr_final: float = 6e-5
    """At the last step."""
    skinning_lr_init: float = 2e-2
    """Learning rate of how much each Gaussian follows each motion; it stays and falls as that of the motions."""
    skinning_lr_final: float = 2e-3
    """At the last step."""
    grid_lr_init: float = 1e-2
    """Learning rate of the grids of plane layers; it falls as that of the other parts of the layers."""
    grid_lr_final: float = 1e-3
    """At the last step."""
    modulation_lr_init: float = 8e-4
    """Learning rate of the modulation network and the embeddings that it reads."""
    modulation_lr_final: float = 1.6e-6
    """At the last step."""
    sh_dc_lr: float = 2.5e-3
    """Learning rate of the colors; this and those below stay the same."""
    sh_rest_lr: float = 1.25e-4
    """Of how colors change with the direction of view."""
    opacities_lr: float = 5e-2
    """Of the opacities, before the sigmoid."""
    scales_lr: float = 5e-3
    """Of the logarithms of the scales."""
    quats_lr: float = 1e-3
    """Of the quaternions."""

    density_strategy: Literal["gradient", "mcmc"] = "gradient"
    """Density control: `gradient` clones and splits where the image pulls hardest on the Gaussians, and prunes;
    `mcmc` moves faint ones beside opaque ones, and grows by 5 % a round up to `max_gaussians`."""
    refine_every: int = 100
    """Steps between rounds of density control; 0 switches it off."""
    refine_start: int = 500
    """The first step of density control."""
    refine_stop_fraction: float = 0.7
    """Density control ends after this part of the run."""
    grow_grad2d: float = 4e-4
    """Mean gradient norm in a projected centre, in normalised device coordinates, from which one is densified. This and
    what follows, but for `max_gaussians` and `prune_opa`, is of `gradient`."""
    grow_scale3d: float = 0.01
    """One with a larger standard deviation than this part of the scene's extent is split, a smaller one is cloned."""
    max_gaussians: int = 10_000
    """There are never more; the strongest gradients come first."""
    prune_opa: float = 0.005
    """Fainter Gaussians are removed, or moved."""
    prune_scale3d: float = 0.1
    """Ones larger than this part of the scene's extent are removed, once opacities have been reset."""
    reset_every: int = 0
    """All opacities are cut to 0.01 each so many steps, while densification lasts; 0 switches it off."""
    noise_lr: float = 5e5
    """How far faint Gaussians wander a step, in learning rates of the means times their covariance."""
    opacity_reg: float = 1e-2
    """Of the mean opacity, added to the loss; what isn't needed fades and is moved."""
    scale_reg: float = 1e-2
    """Of the mean scale in scene units, added to the loss."""

    log_every: int = 20
    """Steps between lines in metrics.jsonl."""
    eval_every: int = 1000
    """Steps between evaluations of the held-out images; 0 leaves only the one at the end."""
    checkpoint_every: int = 1000
    """Steps between checkpoints; 0 leaves only the one at the end."""

    def __post_init__(self) -> None:
        for name in (
            "steps",
            "batch_size",
            "threads",
            "init_num_pts",
            "sh_degree_interval",
            "max_gaussians",
            "log_every",
        ):
            self._require(name, "a whole number above 0", lambda v: v >= 1)
        counts = ("refine_every", "refine_start", "reset_every", "eval_every", "checkpoint_every", "seed")
        for name in ("ema_steps", *counts):
            self._require(name, "0 or above", lambda v: v >= 0)
        parts = ("static_fraction", "static_window_fraction", "window_full_fraction", "refine_stop_fraction")
        for name in ("l1_weight", "mse_fraction", "prune_opa", *parts):
            self._require(name, "in [0, 1]", lambda v: 0 <= v <= 1)
        for item in dataclasses.fields(self):
            if "_lr" in item.name:
                self._require(item.name, "a finite learning rate above 0", lambda v: 0 < v < math.inf)
        self._require("reseed_fraction", "in [0, 0.5]", lambda v: 0 <= v <= 0.5)
        self._require("window_start_widths", "one number or more, in [0, 0.5] each", _are_window_starts)
        object.__setattr__(self, "window_start_widths", tuple(self.window_start_widths))
        more = (
            "pooled_l1_weight",
            "motion_smoothness_weight",
            "arap_weight",
            "plane_smoothness_weight",
            "l1_time_planes_weight",
            "noise_lr",
            "opacity_reg",
            "scale_reg",
        )
        for name in ("rigidity_weight", "time_smoothness_weight", "plane_tv_weight", *more):
            self._require(name, "finite and 0 or above", lambda v: 0 <= v < math.inf)
        for name in ("grow_grad2d", "grow_scale3d", "prune_scale3d"):
            self._require(name, "finite and above 0", lambda v: 0 < v < math.inf)
        self._require("eps2d_init", "finite and 0 or above, or left out", lambda v: v is None or 0 <= v < math.inf)
        for name in ("size", "scene_half_size", "max_minutes"):
            self._require(name, "above 0, or left out", lambda v: v is None or 0 < v < math.inf)
        self._require("max_gaussians", "init_num_pts or more", lambda v: v >= self.init_num_pts)
        self._require("density_strategy", "gradient or mcmc", lambda v: v in ("gradient", "mcmc"))
        self._require("background", f"one of {[*BACKGROUNDS, 'random']}", lambda v: v in {*BACKGROUNDS, "random"})

    def _require(self, name: str, expected: str, holds: Any) -> None:
        value = getattr(self, name)
        if not holds(value):
            raise InvalidInput(f"config.{name}", expected, value)

    @property
    def static_steps(self) -> int:
        """Steps on all images, without deformation."""
        return round(self.static_fraction * self.steps)

    @property
    def deform_start_step(self) -> int:
        """Steps before the deformation takes part."""
        settling = self.static_window_fraction if self.window_full_fraction else 0.0
        return round((self.static_fraction + settling) * self.steps)

    @property
    def num_reseeded(self) -> int:
        """Gaussians that are added at random after the warm-up."""
        follows = self.static_steps and self.window_full_fraction and self.model.layers
        return int(self.reseed_fraction * self.max_gaussians) if follows else 0

    def most_gaussians(self, step: int) -> int:
        """How many there may be after this step, counted from 1."""
        return self.max_gaussians - 2 * self.num_reseeded if step <= self.static_steps else self.max_gaussians

    @property
    def refine_stop(self) -> int:
        """The last step of density control."""
        return round(self.refine_stop_fraction * self.steps)

    @property
    def full_window_step(self) -> int:
        """Steps after which all times take part."""
        return round(self.window_full_fraction * self.steps)

    def eps2d_at(self, step: int) -> float:
        """What is added to projected covariances in this step, counted from 1, px²."""
        return self.model.eps2d if self.eps2d_init is None or step > self.full_window_step else self.eps2d_init

    def averages_at(self, step: int) -> bool:
        """Whether the model after this step, counted from 1, is part of the mean."""
        return self.ema_steps > 0 and step > max(self.deform_start_step, self.full_window_step, self.refine_stop)

    def refines_at(self, step: int) -> bool:
        """Whether a round of density control is due after this step, counted from 1."""
        return self.refine_every > 0 and self.refine_start <= step <= self.refine_stop and step % self.refine_every == 0

    @property
    def evaluation_background(self) -> tuple[float, float, float]:
        """RGB in [0, 1] that held-out images are judged on, and that the model is saved with."""
        return BACKGROUNDS.get(self.background, BACKGROUNDS["white"])

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "TrainConfig":
        """The inverse of `to_dict`. Raises `InvalidInput` naming a setting that is unknown or out of range."""
        unknown = sorted(set(values) - {item.name for item in dataclasses.fields(cls)})
        if unknown:
            raise InvalidInput("config", "made of known settings", f"`{unknown[0]}`")
        model = values.get("model", {})
        strange = sorted(set(model) - {item.name for item in dataclasses.fields(ModelConfig)})
        if strange:
            raise InvalidInput("config.model", "made of known settings", f"`{strange[0]}`")
        return cls(**{**values, "model": ModelConfig(**model)})


def _are_window_starts(values: Any) -> bool:
    numbers = isinstance(values, list | tuple) and all(type(v) in (int, float) and 0 <= v <= 0.5 for v in values)
    return numbers and len(values) > 0


RESUMABLE_CHANGES = frozenset({"steps", "threads", "max_minutes", "log_every", "eval_every", "checkpoint_every"})
"""Settings that may change when a run is resumed. All others shape what has been trained already."""


def check_resumable(stored: TrainConfig, wanted: TrainConfig) -> None:
    """Raise `InvalidInput` naming the first setting that a resumed run may not change."""
    for name, value in stored.to_dict().items():
        if name not in RESUMABLE_CHANGES and wanted.to_dict()[name] != value:
            raise InvalidInput(f"config.{name}", f"{value}, as when the run began", wanted.to_dict()[name])
