"""The order of the images, and the parameters that each of them updates.

First all images train a static scene. Then motion is tracked from the middle of the scene's time in a window that
grows in both directions. While it grows, of four samples

- one is drawn uniformly from all images of the window, and updates everything;
- two are drawn from the newest ones, at its border, and update motion alone: canonical Gaussians that learned from so
  few images as often would overfit them and lose their textures;
- one is drawn from those outside, and updates static parts alone, where they are visible: otherwise the few
  images in the middle of time would be explained by any geometry that their few cameras can't tell from the true one.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from msdgs_train.datasets import Frame
from msdgs_train.engine.schedule import Schedule

Update = Literal["all", "motion", "static"]

NEW_FRAME_BORDER = 0.01
"""Images within this fraction of the time range of the window's border are new frames."""
MIN_NEW_FRAME_DISTANCE = 0.7
"""New frames are at least this fraction of the half width from the middle; the outermost image always is one."""


class TrainingSample(NamedTuple):
    """One image of one step."""

    frame: Frame
    t: float  # of the Gaussians: the image's, or the nearest within the window
    update: Update  # which parameters learn from it


class WindowCurriculum:
    """A time window that grows from the middle. `_order` holds the indices that remain in a pass over its images."""

    def __init__(self, schedule: Schedule, frames: list[Frame], time_range: tuple[float, float]) -> None:
        self._schedule, self._frames, self._time_range = schedule, frames, time_range
        self._config = schedule.config.curriculum
        self.distances = distances_from_middle(time_range, frames)
        self._order = torch.empty(0, dtype=torch.int64)

    def state(self) -> Tensor:
        return self._order

    def load_state(self, state: Tensor) -> None:
        self._order = state

    def next(self, number: int, step: int, generator: torch.Generator) -> TrainingSample:
        window = self._schedule.window(step)
        grows = window < 0.5
        if (
            self._config.outside_frames_static_only
            and grows
            and number % 4 == 0
            and len(outside := torch.nonzero(self.distances > window)[:, 0])
        ):
            return self._sample(self._drawn(outside, generator), window, "static")
        if grows and number % 2 == 1 and step >= self._schedule.deform_start_step:
            new = self._new_frames(window)
            update = "motion" if self._config.new_frames_motion_only else "all"
            return self._sample(self._drawn(new, generator), window, update)
        self._order = self._order[self.distances[self._order] <= window]
        if not len(self._order):
            inside = torch.nonzero(self.distances <= window)[:, 0]
            self._order = inside[torch.randperm(len(inside), generator=generator)]
        chosen, self._order = self._order[0], self._order[1:]
        return self._sample(int(chosen), window, "all")

    def _new_frames(self, window: float) -> Tensor:
        outermost = float(self.distances[self.distances <= window].max())
        border = min(outermost, max(window - NEW_FRAME_BORDER, MIN_NEW_FRAME_DISTANCE * window))
        return torch.nonzero((self.distances <= window) & (self.distances >= border))[:, 0]

    def _drawn(self, ids: Tensor, generator: torch.Generator) -> int:
        return int(ids[torch.randint(len(ids), (), generator=generator)])

    def _sample(self, chosen: int, window: float, update: Update) -> TrainingSample:
        frame = self._frames[chosen]
        first, last = self._time_range
        middle, reach = (first + last) / 2, window * (last - first)
        t = min(max(frame.t, middle - reach), middle + reach) if update == "static" else frame.t
        return TrainingSample(frame, t, update)


def distances_from_middle(time_range: tuple[float, float], frames: list[Frame]) -> Tensor:
    """[F] in [0, 0.5], as fractions of the time range; the nearest is set to 0 so that no window is empty."""
    first, last = time_range
    middle, length = (first + last) / 2, (last - first) or 1.0
    distances = torch.tensor([min(abs(frame.t - middle) / length, 0.5) for frame in frames], dtype=torch.float64)
    distances[distances.argmin()] = 0
    return distances
