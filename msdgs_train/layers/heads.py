"""What a layer predicts. Without torch, so that settings are read and `--help` is printed at once."""

from typing import NamedTuple


class Heads(NamedTuple):
    """What a layer predicts besides deltas of means, scales and quaternions."""

    weight: bool = True  # without it every step counts in full, w = 1
    opacity: bool = False
    sh: int = 0  # coefficients (degree + 1)² a channel; 0: none

    @property
    def sizes(self) -> tuple[int, ...]:
        """Columns of: means, scales, quats, opacity, sh, weight before its sigmoid. 0 for what isn't there."""
        return (3, 3, 4, int(self.opacity), 3 * self.sh, int(self.weight))


PAPER_HEADS = Heads()
