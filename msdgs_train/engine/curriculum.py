"""Which image comes next, and what it may teach.

First all images teach a scene that stands still: what does stand still is in place before anything moves. Then
what moves is followed from the middle of the scene's time outwards, in a window that grows image by image,
once or more. While it grows for the first time, of four lessons

- one draws from all images of the window alike, and teaches everything;
- two draw from its outermost ones, which are new, and teach motion alone. Were the Gaussians to learn from these few as
  often, they would take on what explains only them, and lose their textures;
- one draws from those outside, and teaches what stands still alone, where that is what they see. Else a few images
  in the middle of time would be explained by whatever geometry their few cameras can't tell from the true one.

Where it grows again motions are nearly right: all its images teach everything.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from msdgs_train.datasets import Frame
from msdgs_train.engine.config import TrainConfig

Subject = Literal["everything", "motion", "stillness"]

NEW = 0.01
"""Parts of the scene's time from the window's border inwards: images that teach motion."""
MIDDLE = 0.7
"""Of the window; they are at least this far out, and there is always one."""


class TrainingSample(NamedTuple):
    """One image of one step."""

    frame: Frame
    t: float  # of the Gaussians: the image's, or the nearest within the window
    subject: Subject


class Curriculum:
    """The order of the images. `order`, indices, is what is left of a pass over those of the window."""

    def __init__(self, config: TrainConfig, frames: list[Frame], time_range: tuple[float, float]) -> None:
        self._config, self._frames, self._time_range = config, frames, time_range
        self.distances = distances_from_middle(time_range, frames)
        self.order = torch.empty(0, dtype=torch.int64)

    def window(self, step: int) -> float:
        """How far from the middle of the scene's time images are taken in: 0.5 is all of it."""
        c = self._config
        if c.window_full_fraction == 0 or not c.model.layers or step < c.static_steps:
            return 0.5
        grown = self._growth(step)
        if grown >= len(c.window_start_widths):
            return 0.5
        start = c.window_start_widths[int(grown)]
        return start + (0.5 - start) * (grown % 1)

    def is_first_pass(self, step: int) -> bool:
        """Whether times that the window takes in now have never been in it."""
        return self._growth(step) <= 1

    def _growth(self, step: int) -> float:
        """How many times the window has grown to all times."""
        c = self._config
        done = max(step - c.deform_start_step, 0) / max(c.full_window_step - c.deform_start_step, 1e-9)
        return done * len(c.window_start_widths)

    def next(self, number: int, generator: torch.Generator) -> TrainingSample:
        """The lesson of this number, counted from 0: a step takes as many as images."""
        step = number // self._config.batch_size
        window = self.window(step)
        follows = window < 0.5 and self.is_first_pass(step)
        if (
            self._config.outside_frames_static_only
            and follows
            and number % 4 == 0
            and len(outside := torch.nonzero(self.distances > window)[:, 0])
        ):
            return self._lesson(self._drawn(outside, generator), window, "stillness")
        if follows and number % 2 == 1 and step >= self._config.deform_start_step:
            border = min(float(self.distances[self.distances <= window].max()), max(window - NEW, MIDDLE * window))
            new = torch.nonzero((self.distances <= window) & (self.distances >= border))[:, 0]
            subject = "motion" if self._config.new_frames_motion_only else "everything"
            return self._lesson(self._drawn(new, generator), window, subject)
        self.order = self.order[self.distances[self.order] <= window]
        if not len(self.order):
            inside = torch.nonzero(self.distances <= window)[:, 0]
            self.order = inside[torch.randperm(len(inside), generator=generator)]
        chosen, self.order = self.order[0], self.order[1:]
        return self._lesson(int(chosen), window, "everything")

    def _drawn(self, ids: Tensor, generator: torch.Generator) -> int:
        return int(ids[torch.randint(len(ids), (), generator=generator)])

    def _lesson(self, chosen: int, window: float, subject: Subject) -> TrainingSample:
        frame = self._frames[chosen]
        first, last = self._time_range
        middle, reach = (first + last) / 2, window * (last - first)
        t = min(max(frame.t, middle - reach), middle + reach) if subject == "stillness" else frame.t
        return TrainingSample(frame, t, subject)


def distances_from_middle(time_range: tuple[float, float], frames: list[Frame]) -> Tensor:
    """[F] in [0, 0.5], as parts of the time range; the nearest is set to 0 so that no window is empty."""
    first, last = time_range
    middle, length = (first + last) / 2, (last - first) or 1.0
    distances = torch.tensor([min(abs(frame.t - middle) / length, 0.5) for frame in frames], dtype=torch.float64)
    distances[distances.argmin()] = 0
    return distances
