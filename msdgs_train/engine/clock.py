"""The clock of a run of given minutes: how far each optimizer step advances the schedule."""

SMOOTHING = 0.9  # of the time of an image: a moving average over about 10 steps
MAX_HELD_OUT_SHARE = 0.25  # of the time of a run, kept for its last evaluation: images of a volume may take minutes
MAX_EVALUATION_SHARE = 0.03  # of the time so far: after more, no evaluation begins until the last
MAX_ONE_EVALUATION = 0.1  # of the time of a run: longer ones don't begin; held-out images are faster than training ones


class Clock:
    """Lays a schedule out over the time that is left, whatever a step costs in each phase.

    Steps without deformation are faster. If the factor is known, they are the fraction of all optimizer steps that the
    schedule gives them; the same fraction of the time would be up to five times as many.
    """

    def __init__(
        self, num_steps: int, limit: float, held_out: int, step: int, static_steps: int = 0, deforming_cost: float = 1.0
    ) -> None:
        """A clock for `num_steps` of the schedule, of which `step` are done.

        Args:
            limit: seconds of the whole run, evaluations and saving included.
            held_out: images of the last evaluation; each takes about as long as a training image. If they take more
                than `MAX_HELD_OUT_SHARE` of the time, the run takes longer than its limit.
            static_steps: the first steps, without deformation.
            deforming_cost: time of each of the others, in static steps.
        """
        self._num_steps, self._limit, self._held_out = num_steps, limit, held_out
        self._static_steps, self._deforming_cost = static_steps, deforming_cost
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
        kept = min(self._held_out_seconds(), MAX_HELD_OUT_SHARE * self._limit)
        left = self._limit - kept - seconds
        ends = left <= step_seconds
        if ends:
            self._position = self._num_steps
        else:
            self._position += min(self._steps_left() * step_seconds / left, self._num_steps - self._position)
        return max(int(self._position) - step, 0)

    def allows_evaluation(self, seconds: float, spent: float) -> bool:
        """Whether held-out images may be evaluated before the last step, `seconds` after the run began, of which
        earlier evaluations took `spent`."""
        return spent <= MAX_EVALUATION_SHARE * seconds and self._held_out_seconds() <= MAX_ONE_EVALUATION * self._limit

    def _held_out_seconds(self) -> float:
        return self._held_out * (self._image_seconds or 0.0)

    def _steps_left(self) -> float:
        """Cost of the remaining steps, in units of a step of the present phase."""
        left = self._num_steps - self._position
        static = self._static_steps - self._position
        return left if static <= 0 else static + self._deforming_cost * (left - static)
