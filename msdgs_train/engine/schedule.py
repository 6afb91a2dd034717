"""The phases of a run in steps, and everything that depends on the step."""

from collections.abc import Callable
from typing import NamedTuple

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.curriculum_config import HALVED_WIDTH
from msdgs_train.layers.parameters import LearningRate

WINDOW_GROWTH = 0.95
"""Fraction of the growing phase after which the window has all times: the first and the last of them are its newest for
the rest. Of nine fixed cameras, their images gain 1 to 3 dB."""


class Phase(NamedTuple):
    """Consecutive steps of one kind."""

    name: str
    first: int
    stop: int  # the first step that isn't part of it


class Schedule(NamedTuple):
    """The schedule of a run. Steps are counted from 0 unless a method says otherwise."""

    config: TrainConfig
    num_steps: int
    static_steps: int  # all images, no deformation
    deform_start_step: int
    restart_step: int  # Adam, its rates and density control count from here; 0: from the start
    full_window_step: int  # all times take part alike
    full_resolution_step: int  # wide images have their full size
    refine_start: int  # the first step of density control, counted from 1 in its stage
    refine_every: int  # 0: no density control
    refine_stop: int  # the last step of density control, counted from 1 in its stage; 0 without it
    reset_every: int  # 0: opacities are never reset
    sh_degree_interval: int
    ema_steps: int  # 0: no average

    @classmethod
    def from_config(cls, config: TrainConfig) -> "Schedule":
        """The schedule of these settings."""
        c, steps = config.curriculum, config.run.steps
        static_window = c.static_window_fraction if c.window_full_fraction else 0.0
        refine_stop = config.density.refine_stop_fraction if config.density.refine_every_fraction else 0.0
        static_steps = round(c.static_fraction * steps)
        deform_start_step = round((c.static_fraction + static_window) * steps)
        return cls(
            config,
            steps,
            static_steps,
            deform_start_step=deform_start_step,
            restart_step=deform_start_step if c.restart_at_motion else 0,
            full_window_step=round(c.window_full_fraction * steps),
            full_resolution_step=round(c.half_resolution_fraction * steps),
            refine_start=round(config.density.refine_start_fraction * steps),
            refine_every=_interval(config.density.refine_every_fraction, steps),
            refine_stop=round(refine_stop * steps),
            reset_every=_interval(config.density.reset_every_fraction, steps),
            sh_degree_interval=_interval(config.optimizer.sh_degree_fraction, steps),
            ema_steps=_interval(config.optimizer.ema_fraction, steps),
        )

    @property
    def grows_window(self) -> bool:
        """Whether motion begins in a time window that grows."""
        return len(self.config.model.layers) > 0 and self.config.curriculum.window_full_fraction > 0

    def phases(self) -> list[Phase]:
        """The phases of at least one step, in order."""
        if not self.grows_window:
            start = min(self.deform_start_step, self.num_steps) if self.config.model.layers else self.num_steps
            found = [Phase("static, all images", 0, start), Phase("all times", start, self.num_steps)]
        else:
            grown = max(self.full_window_step, self.deform_start_step)
            found = [
                Phase("static, all images", 0, self.static_steps),
                Phase("static, first time window", self.static_steps, self.deform_start_step),
                Phase("growing time window", self.deform_start_step, grown),
                Phase("all times", grown, self.num_steps),
            ]
        return [phase for phase in found if phase.stop > phase.first]

    def in_stage(self, step: int) -> int:
        """A step counted from 1, as counted since Adam and density control have started again."""
        return step - self.restart_step if step > self.restart_step else step

    def rate(self, lr: LearningRate, step: int) -> float:
        """A learning rate in this step."""
        full = max(self.full_window_step - self.restart_step, 0)
        return lr.at(self.in_stage(step + 1) - 1, self.num_steps - self.restart_step, full)

    def time_noise(self, step: int) -> float:
        """Standard deviation of the noise on times of images, in distances between them."""
        c = self.config.curriculum
        stop = c.time_noise_fraction * self.num_steps
        return c.time_noise * (1 - step / stop) if self.deforms(step) and step < stop else 0.0

    def is_windowed(self, step: int) -> bool:
        """Whether only a part of all times takes part in this step, or its newest images more often than others."""
        stop = max(self.full_window_step, self.deform_start_step)
        return len(self.config.model.layers) > 0 and self.static_steps <= step < stop

    def window(self, step: int) -> float:
        """Half width of the time window, as a fraction of the scene's time: 0.5 is all of it."""
        if not self.is_windowed(step):
            return 0.5
        start = self.config.curriculum.window_start_width
        growth = WINDOW_GROWTH * (self.full_window_step - self.deform_start_step)
        grown = max(step - self.deform_start_step, 0) / max(growth, 1e-9)
        return start + (0.5 - start) * grown if grown < 1 else 0.5

    def halves(self, width: int, step: int) -> bool:
        """Whether an image so wide is trained at half its width and height."""
        return width >= HALVED_WIDTH and step < self.full_resolution_step

    def deforms(self, step: int) -> bool:
        """Whether the deformation takes part."""
        return step >= self.deform_start_step and len(self.config.model.layers) > 0

    def sh_degree(self, step: int) -> int:
        """Degree of the spherical harmonics in use."""
        degree = self.config.model.sh_degree
        return min(step // self.sh_degree_interval, degree) if self.sh_degree_interval else degree

    def eps2d(self, step: int) -> float:
        """Dilation of projected covariances in this step, counted from 1, px²."""
        init = self.config.optimizer.eps2d_init
        return self.config.model.eps2d if init is None or step > self.full_window_step else init

    def refines_at(self, step: int) -> bool:
        """Whether a round of density control is due after this step, counted from 1."""
        every, step = self.refine_every, self.in_stage(step)
        return every > 0 and self.refine_start <= step <= self.refine_stop and step % every == 0

    def prunes_hidden(self, step: int, *, several_per_time: bool) -> bool:
        """Whether `gradient` regularizes in this step: until density control ends, but in a time window only if it has
        several images of each time. With one, fast objects would fade."""
        return self.in_stage(step + 1) <= self.refine_stop and (several_per_time or not self.is_windowed(step))

    def resets_at(self, step: int) -> bool:
        """Whether opacities are reset after this step, counted from 1."""
        every, step = self.reset_every, self.in_stage(step)
        return every > 0 and step < self.refine_stop and step % every == 0

    def has_reset(self, step: int) -> bool:
        """Whether opacities have been reset before this step, counted from 1."""
        return 0 < self.reset_every < self.in_stage(step)

    def averages_at(self, step: int) -> bool:
        """Whether the model after this step, counted from 1, is part of the average."""
        last = max(self.deform_start_step, self.full_window_step, self.restart_step + self.refine_stop)
        return self.ema_steps > 0 and step > last


def require_same_phase(
    before: Schedule, after: Schedule, reached: range, milestones: Callable[[int], list[int]]
) -> None:
    """Raise `InvalidInput` unless a run can go on with another number of steps: layers are initialized where motion
    begins and where the time window grows, and trained bands of color stay in use.

    Args:
        reached: steps, counted from 1, of the last optimizer step; what begins at them hasn't happened yet.
        milestones: `System.milestones`.
    """
    step = reached.stop - 1

    def passed(schedule: Schedule, step: int) -> list[bool]:
        return [schedule.deforms(step), *(at <= step for at in milestones(schedule.num_steps))]

    moved = any(passed(before, edge) != passed(after, edge) for edge in (reached.start - 1, step))
    if moved or before.window(step) != after.window(step) or after.sh_degree(step) < before.sh_degree(step):
        expected = f"{before.num_steps:,}, or so near it that step {step:,} stays in its phase"
        raise InvalidInput("config.steps", expected, f"{after.num_steps:,}")


def _interval(fraction: float, steps: int) -> int:
    """Steps of a fraction of the run, one at least; 0 for 0."""
    return max(round(fraction * steps), 1) if fraction else 0
