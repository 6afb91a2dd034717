"""The clock of a run of given minutes: how far each optimizer step advances the schedule."""

SMOOTHING = 0.9  # of the time of an image: a moving average over about 10 steps


class Clock:
    """Lays a schedule out over the time that is left, whatever a step costs in each phase."""

    def __init__(self, num_steps: int, limit: float, held_out: int, step: int) -> None:
        """A clock for `num_steps` of the schedule, of which `step` are done.

        Args:
            limit: seconds of the whole run, evaluations and saving included.
            held_out: images of the last evaluation; each takes about as long as a training image.
        """
        self._num_steps, self._limit, self._held_out = num_steps, limit, held_out
        self._position = float(step)
        self._image_seconds: float | None = None

    def advance(self, step: int, step_seconds: float, images: float, seconds: float) -> int:
        """Steps of the schedule that the next optimizer step stands for, 0 or more.

        Args:
            step: steps of the schedule that are done.
            step_seconds: time of the last optimizer step.
            images: that take as long to evaluate.
            seconds: time since the run began.
        """
        last = step_seconds / images
        mean = last if self._image_seconds is None else self._image_seconds
        self._image_seconds = SMOOTHING * mean + (1 - SMOOTHING) * last
        left = self._limit - self._held_out * self._image_seconds - seconds
        ends = left <= step_seconds
        self._position += (self._num_steps - self._position) * (1.0 if ends else step_seconds / left)
        return max(int(self._position) - step, 0)
