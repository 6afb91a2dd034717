"""The order of the images.

First all images train a static scene. Then motion is tracked from the middle of the scene's time in a window that
grows in both directions. While it grows, half of the images are drawn from the newest ones, at its border.
"""

import torch
from torch import Tensor

from msdgs_train.datasets import Frame
from msdgs_train.engine.schedule import Schedule

NEW_FRAME_BORDER = 0.01
"""Images within this fraction of the time range of the window's border are new frames."""
MIN_NEW_FRAME_DISTANCE = 0.7
"""New frames are at least this fraction of the half width from the middle; the outermost image always is one."""
SAME_DISTANCE = 1e-6
"""Distances from the middle that differ by less are the same: those of the two middle times of an even number do by
rounding."""


class WindowCurriculum:
    """A time window that grows from the middle. `order` holds the indices that remain in a pass over its images."""

    def __init__(self, schedule: Schedule, frames: list[Frame], time_range: tuple[float, float]) -> None:
        self._schedule, self._frames = schedule, frames
        self.distances = distances_from_middle(time_range, frames)
        self.order = torch.empty(0, dtype=torch.int64)

    def next(self, number: int, step: int, generator: torch.Generator) -> Frame:
        window = self._schedule.window(step)
        if number % 2 == 1 and self._schedule.deforms(step) and self._schedule.is_windowed(step):
            new = self._new_frames(window)
            return self._frames[int(new[torch.randint(len(new), (), generator=generator)])]
        self.order = self.order[self.distances[self.order] <= window]
        if not len(self.order):
            inside = torch.nonzero(self.distances <= window)[:, 0]
            self.order = inside[torch.randperm(len(inside), generator=generator)]
        chosen, self.order = self.order[0], self.order[1:]
        return self._frames[int(chosen)]

    def _new_frames(self, window: float) -> Tensor:
        outermost = float(self.distances[self.distances <= window].max())
        border = min(outermost, max(window - NEW_FRAME_BORDER, MIN_NEW_FRAME_DISTANCE * window))
        return torch.nonzero((self.distances <= window) & (self.distances >= border))[:, 0]


def distances_from_middle(time_range: tuple[float, float], frames: list[Frame]) -> Tensor:
    """[F] in [0, 0.5], as fractions of the time range; those of the nearest times are 0: every window has images of all
    cameras."""
    first, last = time_range
    middle, length = (first + last) / 2, (last - first) or 1.0
    distances = torch.tensor([min(abs(frame.t - middle) / length, 0.5) for frame in frames], dtype=torch.float64)
    distances[distances <= distances.min() + SAME_DISTANCE] = 0
    return distances
