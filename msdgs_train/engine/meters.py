"""Whether steps are finite, and the moving averages that a run reports."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from msdgs_serve.scene.errors import MsdgsError

MAX_SKIPPED_IN_A_ROW = 20
SMOOTHING = 0.98  # of the reported loss and PSNR: a moving average over about 50 steps, or over all of fewer


class TrainingDiverged(MsdgsError):
    """The loss or its gradient has not been finite for many steps in a row."""


class Observed(NamedTuple):
    """Results of the images of one step; scalars on the run's device."""

    losses: Sequence[Tensor]
    squared_errors: Sequence[Tensor]


class StepMeter:
    """Reads the results of each step at once, on a CPU."""

    def __init__(self) -> None:
        self.skipped = self.skipped_in_a_row = 0
        self.averages: tuple[float, float] | None = None  # loss, squared error
        self.weight = 0.0  # of all steps in the averages: 1 - SMOOTHING**steps

    def accept(
        self, step: int, observed: Observed, gradients: Sequence[Tensor], optimizer: torch.optim.Optimizer
    ) -> bool:
        """Whether the optimizer takes a step along these gradients: not if they or the loss aren't finite. Raises
        `TrainingDiverged` after many such steps."""
        losses = [loss.item() for loss in observed.losses]
        loss = sum(losses) / len(losses)
        if not bool(torch.isfinite(loss + get_total_norm(gradients, foreach=True))):
            self.skipped += 1
            self.skipped_in_a_row += 1
            self.check(step)
            return False
        self.skipped_in_a_row = 0
        error = sum(error.item() for error in observed.squared_errors) / len(losses)
        old, self.weight = self.averages or (loss, error), SMOOTHING * self.weight + 1 - SMOOTHING
        rate = (1 - SMOOTHING) / self.weight
        self.averages = old[0] + rate * (loss - old[0]), old[1] + rate * (error - old[1])
        return True

    def read(self) -> None:
        """Bring the numbers up to date."""

    def load(self, skipped: int, in_a_row: int, averages: tuple[float, float] | None, weight: float) -> None:
        """Continue from such numbers."""
        self.skipped, self.skipped_in_a_row, self.averages = skipped, in_a_row, averages
        self.weight = 0.0 if averages is None else weight

    def check(self, step: int) -> None:
        """Raise `TrainingDiverged` if the numbers, of steps up to this one, say so."""
        if self.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise TrainingDiverged(
                f"the loss or its gradient was not finite for {MAX_SKIPPED_IN_A_ROW} steps in a row, up to step {step}"
            )


class DeviceMeter(StepMeter):
    """Leaves the results on a device, which the CPU doesn't wait for, until they are read."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self._device = device
        self._counts = self._means = torch.empty(0)
        self.load(0, 0, None, 0.0)

    def accept(
        self, step: int, observed: Observed, gradients: Sequence[Tensor], optimizer: torch.optim.Optimizer
    ) -> bool:
        """True: fused Adam itself leaves parameters and moments as they are where `found_inf` is 1."""
        new = torch.stack([torch.stack(tuple(values)).mean() for values in observed])
        broken = ~torch.isfinite(new[0] + get_total_norm(gradients, foreach=True))
        optimizer.found_inf = broken.float()  # type: ignore[attr-defined]
        skipped, in_a_row = self._counts.unbind()
        self._counts = torch.stack([skipped + broken, (in_a_row + 1) * broken])
        old, weight = self._means[:2], SMOOTHING * self._means[2:] + 1 - SMOOTHING
        smoothed = torch.cat([old + (1 - SMOOTHING) / weight * (new - old), weight])
        self._means = torch.where(broken, self._means, smoothed)
        return True

    def read(self) -> None:
        self.skipped, self.skipped_in_a_row = map(int, self._counts.tolist())
        loss, error, self.weight = self._means.tolist()
        self.averages = (loss, error) if self.weight else None

    def load(self, skipped: int, in_a_row: int, averages: tuple[float, float] | None, weight: float) -> None:
        super().load(skipped, in_a_row, averages, weight)
        self._counts = torch.tensor([skipped, in_a_row], device=self._device)
        means = [*(averages or (0.0, 0.0)), self.weight]
        self._means = torch.tensor(means, dtype=torch.float64, device=self._device)
