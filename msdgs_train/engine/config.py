"""Training configuration: groups of settings, each defined beside the code that reads it."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, get_args

import tyro

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets.config import DataConfig
from msdgs_train.density.config import DensityConfig
from msdgs_train.engine.curriculum_config import CurriculumConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.plugins import load_plugins
from msdgs_train.layers.precision import Precision
from msdgs_train.losses.config import LossConfig
from msdgs_train.poses.config import PoseConfig
from msdgs_train.settings import OWN_SETTINGS, Checked, SystemConfig, optional, require_seed


@dataclass(frozen=True)
class RunConfig(Checked):
    """System and length of a run."""

    system: tyro.conf.Suppress[str] = ""
    """The registered system that builds and trains the model; Gaussians, if it has no name."""
    steps: int = 16_000
    """Optimizer steps; with --minutes, steps of the schedule."""
    batch_size: int = 1
    """Images per step, rendered in parallel; gradients are averaged over them."""
    seed: int = 0
    """Seed of all random numbers of the run."""
    threads: int = 2
    """CPU threads of torch: the same seed and threads give the same bits. Kernels use all cores, or MSDGS_THREADS;
    their bits don't depend on it."""
    device: Literal["cpu", "cuda"] = "cpu"
    """cuda: all of a step is on the GPU, rendered by gsplat (msdgs[cuda]); the bits differ from run to run."""
    image_memory: float = 2.0
    """GiB of decoded images that stay in memory, as 8-bit RGBA; others are read again whenever they are drawn."""
    gpu_precision: Precision = "float32"
    """cuda: of the matrix products of MLP trunks in training; encodings, heads and evaluations are in float32."""
    gpu_image_memory: float = 8.0
    """cuda: GiB of training images that stay on the GPU, as 8-bit RGBA; others are copied whenever they are drawn."""
    minutes: Annotated[float | None, optional("MINUTES")] = None
    """Length of the run instead of --steps. Each phase gets its fraction of the time; in loops without a growing
    window, steps before motion are instead the same fraction of optimizer steps as with --steps. Evaluation and saving
    count, compiling kernels doesn't; a last evaluation of more than a quarter of the time, as of volumes, makes the run
    longer. The same seed no longer gives the same bits."""
    time: Literal["wall", "cpu"] = "wall"
    """What --minutes and reports count: time that passes, or the CPU time of all threads, which other work on the
    machine hardly changes."""

    def __post_init__(self) -> None:
        self.require_counts("steps", "batch_size", "threads")
        require_seed("config.seed", self.seed)
        self.require_positive_or_none("minutes")
        self.require(("time",), "wall or cpu", lambda v: v in ("wall", "cpu"))
        self.require(("device",), "cpu or cuda", lambda v: v in ("cpu", "cuda"))
        self.require(("gpu_precision",), "float32, tf32 or bf16", lambda v: v in get_args(Precision))
        self.require_weights("image_memory", "gpu_image_memory")


@dataclass(frozen=True)
class OptimizerConfig(Checked):
    """Adam, learning rates of the canonical Gaussians, and the average that is evaluated; layers have their own
    rates."""

    means_lr_init: float = 8e-4
    """Learning rate of means, in scene units; Adam moves a mean by about this much a step."""
    means_lr_final: float = 8e-6
    """Learning rate of means at the last step, to which it decays exponentially."""
    means_lr_until_fraction: float = 1.0
    """Fraction of the run after which the rate of means has reached its last value."""
    sh_dc_lr: float = 2.5e-3
    """Learning rate of colors; constant, as those below."""
    sh_rest_lr: float = 1.25e-4
    """Learning rate of the bands of spherical harmonics above 0."""
    opacities_lr: float = 5e-2
    """Learning rate of opacities, before the sigmoid."""
    scales_lr: float = 5e-3
    """Learning rate of logarithms of scales."""
    quats_lr: float = 1e-3
    """Learning rate of quaternions."""
    adam_beta2: float = 0.999
    """Decay of Adam's mean of squared gradients."""
    adam_eps: float = 1e-15
    """Added to the root of that mean. Adam's usual one, 1e-8, is as large as the gradients of small Gaussians."""
    gradient_clip: Annotated[float | None, optional("FLOAT")] = 1.0
    """Largest norm of the joint gradient of networks and grids, whose typical norms are 0.05 to 0.6; published loops
    have no limit."""
    sh_degree_fraction: float = 0.125
    """Fraction of the run after which the degree of the spherical harmonics in use rises by one; 0: all from the
    start."""
    eps2d_init: Annotated[float | None, optional("PX²")] = None
    """Dilation of projected covariances, px², until all times take part; the model's own eps2d if not given."""
    ema_fraction: float = 0.0
    """The model that is evaluated and saved is an exponential average over about this last fraction of the run, once
    all times take part and density control has ended, which reduces mini-batch noise; 0: the last step's."""

    def __post_init__(self) -> None:
        self.require_positive("adam_eps", "means_lr_until_fraction", *(n for n in self.names() if "_lr" in n))
        self.require_fractions("means_lr_until_fraction", "sh_degree_fraction", "ema_fraction")
        self.require(("adam_beta2",), "in [0, 1)", lambda v: type(v) in (int, float) and 0 <= v < 1)
        self.require_positive_or_none("gradient_clip")
        self.require_weights(*(["eps2d_init"] if self.eps2d_init is not None else []))


@dataclass(frozen=True)
class LoggingConfig(Checked):
    """Intervals of logging, evaluation and checkpoints."""

    log_every: int = 20
    """Steps between lines in metrics.jsonl."""
    eval_every: int = 1_000
    """Steps between evaluations of held-out images; with --minutes fewer, so that they take about 3 % of the time; 0:
    only at the end."""
    checkpoint_every: int = 1_000
    """Steps between checkpoints; 0: only at the end."""

    def __post_init__(self) -> None:
        self.require_counts("log_every")
        self.require_counts("eval_every", "checkpoint_every", least=0)


@dataclass(frozen=True)
class TrainConfig:
    """All settings of a run. Names are unique over the groups, so that `updated` and the command line need no group."""

    run: RunConfig = RunConfig()
    data: DataConfig = DataConfig()
    curriculum: CurriculumConfig = CurriculumConfig()
    density: DensityConfig = DensityConfig()
    loss: LossConfig = LossConfig()
    poses: PoseConfig = PoseConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    logging: LoggingConfig = LoggingConfig()
    model: ModelConfig = ModelConfig()
    own: SystemConfig = SystemConfig()

    def updated(self, **settings: Any) -> "TrainConfig":
        """Return a copy with other values of some settings, of any group; `model` and `own` may be whole, too.

        Raises `InvalidInput` naming a setting that is unknown or out of range.
        """
        groups: dict[str, dict[str, Any]] = {"model": {}}
        config = self
        if "model" in settings:
            whole = settings.pop("model")
            whole = whole if isinstance(whole, ModelConfig) else ModelConfig.from_dict(whole)
            config = dataclasses.replace(config, model=whole)
        if "own" in settings:
            config = dataclasses.replace(config, own=settings.pop("own"))
        for name, value in settings.items():
            groups.setdefault(config._group_of(name), {})[name] = value
        model = groups.pop("model")
        changed: dict[str, Any] = {n: dataclasses.replace(getattr(config, n), **v) for n, v in groups.items()}
        if model:
            changed["model"] = ModelConfig.from_dict({**config.model.to_dict(), **model})
        return dataclasses.replace(config, **changed)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as plain values: a worker process loads plugins before it needs their classes."""
        return TrainConfig.from_dict, (self.to_dict(),)

    def to_dict(self) -> dict[str, Any]:
        """Plain values by group, ready for JSON."""
        groups = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "model"}
        return {name: dataclasses.asdict(group) for name, group in groups.items()} | {"model": self.model.to_dict()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "TrainConfig":
        """The inverse of `to_dict`. Raises `InvalidInput` naming a setting that is unknown or out of range, or a system
        that isn't registered, if there are settings of its own."""
        config, names = cls(), {item.name for item in fields(cls)}
        unknown = sorted(set(values) - names)
        if unknown:
            raise InvalidInput("config", f"made of the groups {', '.join(sorted(names))}", f"`{unknown[0]}`")
        if values.get("own"):
            config = config.updated(own=_own_type(values.get("run", {}).get("system"))())
        settings = {name: value for group, part in values.items() if group != "model" for name, value in part.items()}
        return config.updated(model=ModelConfig.from_dict(values.get("model", {})), **settings)

    def _group_of(self, name: str) -> str:
        for item in fields(self):
            if any(field.name == name for field in fields(getattr(self, item.name))):
                return item.name
        raise InvalidInput("config", "made of known settings", f"`{name}`")

    def require_unique_names(self) -> None:
        """Raise `InvalidInput` if a system's own setting has a name of another group."""
        for name in self.own.names():
            if (group := self._group_of(name)) != "own":
                raise InvalidInput(
                    f"config.{name}", f"of another name: the group {group} has it", type(self.own).__name__
                )


def _own_type(system: Any) -> type[SystemConfig]:
    if system not in OWN_SETTINGS:
        load_plugins()
    if system not in OWN_SETTINGS:
        known = ", ".join(OWN_SETTINGS)
        raise InvalidInput("config.system", f"one of {known}; others come with --plugin MODULE", system)
    return OWN_SETTINGS[system]


RESUMABLE_CHANGES = frozenset({
    "steps", "threads", "device", "gpu_precision", "image_memory", "gpu_image_memory", "minutes", "log_every",
    "eval_every", "checkpoint_every",
})  # fmt: skip
"""Settings that may change when a run is resumed. All others have affected the model already."""


def check_resumable(stored: TrainConfig, wanted: TrainConfig) -> None:
    """Raise `InvalidInput` naming the first setting that a resumed run may not change."""
    for name, before, now in differences(stored, wanted):
        if name not in RESUMABLE_CHANGES:
            raise InvalidInput(f"config.{name}", f"{before}, as when the run was started", now)


def differences(one: TrainConfig, other: TrainConfig) -> Iterator[tuple[str, Any, Any]]:
    """Name and both plain values of each setting in which two configurations differ."""
    groups = other.to_dict()
    for group, settings in one.to_dict().items():
        for name, value in settings.items():
            if value != groups[group][name]:
                yield name, value, groups[group][name]
