"""The rules of pruning: each proposes parts to remove, and rendered frames decide how many."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from msdgs_export.layers import GAINS, HEADS
from msdgs_export.pruning.mask import PruningMask
from msdgs_export.pruning.statistics import PruningStatistics

BISECTIONS = 7
"""Steps of the search for the number of Gaussians that can be removed: precise to 1 in 128."""

MAX_MEAN_MOTION = 1.0
"""Pixels. Parts of the network that move the visible Gaussians by more than this on average aren't tried."""

VISIBLE_MOTION = 2.0
"""Pixels. Gaussians that move further keep their motion even if it is barely visible: in other views it may be more."""

MAX_OPERATIONS = 2e13
"""Operations for trials without some of the layers, some minutes of two cores; layers not tried by then are kept. All
trials of a scene of the paper's size would take half an hour."""


@dataclass(frozen=True)
class Rule:
    """One rule."""

    what: str  # the removed parts, in words
    error_budget: float  # fraction of the allowed squared error that may be spent by this rule and those before it
    apply: Callable[[PruningStatistics, PruningMask, float], PruningMask]
    """Removes as much as possible while the worst selection frame stays at this many dB or more."""
    count: Callable[[PruningMask], int]
    """The number of these parts that are still there."""


def modulation(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Remove the modulation if its factors are close to 1."""
    return _if_allowed(statistics, mask, min_db, modulated=False) if mask.network.modulated else mask


def heads(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Remove heads of all layers, for positions, scales, rotations or shading, that change nothing."""
    for name in sorted(mask.network.heads, key=(*HEADS, GAINS).index, reverse=True):
        mask = _if_allowed(statistics, mask, min_db, heads=mask.network.heads - {name})
    return mask


def layers(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Remove layers whose weighted step is invisible: as many of the last ones as possible, then single ones."""
    work = MAX_OPERATIONS

    def tried(left: tuple[int, ...]) -> PruningMask:
        nonlocal work
        work -= statistics.operations(replace(mask.network, layers=left))
        return _if_allowed(statistics, mask, min_db, layers=left) if work >= 0 else mask

    last = len(mask.network.layers) - 1
    while last > 0:
        smaller = tried(mask.network.layers[:-last])
        last = min(last // 2, len(smaller.network.layers) - 1)
        mask = smaller
    for k in reversed(mask.network.layers):
        if len(mask.network.layers) > 1:
            mask = tried(tuple(layer for layer in mask.network.layers if layer != k))
    return mask


def invisible(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Remove Gaussians that contribute to no frame, those that contribute least first."""
    return _as_many_as_allowed(statistics, mask, "kept", statistics.peaks * statistics.amounts, mask.kept, min_db)


def static(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Remove the motion of Gaussians that don't move visibly, those that move least first."""
    motion = statistics.motion(mask.network)
    among = mask.moves & (motion < VISIBLE_MOTION)
    return _as_many_as_allowed(statistics, mask, "moves", motion * statistics.peaks, among, min_db)


def sh(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Remove upper SH bands that change no color visibly."""
    for degree in range(mask.sh_degree):
        lower = mask.without(sh_degree=degree)
        if statistics.worst_db(lower, min_db) >= min_db:
            return lower
    return mask


RULES = {
    "heads": Rule("heads that change nothing", 0.05, heads, lambda mask: len(mask.network.heads)),
    "modulation": Rule("scale modulation that is 1", 0.1, modulation, lambda mask: int(mask.network.modulated)),
    "layers": Rule("layers whose weighted step is invisible", 0.2, layers, lambda mask: len(mask.network.layers)),
    "invisible": Rule("Gaussians that never contribute", 0.45, invisible, lambda mask: int(mask.kept.sum())),
    "static": Rule("motion of Gaussians that never move visibly", 0.9, static, lambda mask: int(mask.moves.sum())),
    "sh": Rule("SH bands that change nothing", 1.0, sh, lambda mask: mask.sh_degree),
}
"""By name, in the order in which they are applied. `ExportOptions.keep` switches them off."""


def _if_allowed(statistics: PruningStatistics, mask: PruningMask, min_db: float, **changes: object) -> PruningMask:
    """The mask with a smaller network if the frames allow it; a few poses are compared before frames are rendered."""
    network = replace(mask.network, **changes)
    if not mask.moves.any() or statistics.change(mask.network, network) > MAX_MEAN_MOTION:
        return mask
    smaller = mask.without(network=network)
    return smaller if statistics.worst_db(smaller, min_db) >= min_db else mask


def _as_many_as_allowed(
    statistics: PruningStatistics, mask: PruningMask, flags: str, amounts: np.ndarray, among: np.ndarray, min_db: float
) -> PruningMask:
    """Clear the flags, "kept" or "moves", of as many Gaussians of `among`, [N] bool, as the frames allow, in the order
    of `amounts`, [N]. The number is all of them, or found by bisection."""
    ids = np.flatnonzero(among)
    order = ids[np.argsort(amounts[ids], kind="stable")]

    def without(count: int) -> PruningMask:
        left = getattr(mask, flags).copy()
        left[order[:count]] = False
        return mask.without(**{flags: left})

    def allowed(count: int) -> bool:
        return statistics.worst_db(without(count), min_db) >= min_db

    if not len(order):
        return mask
    low, high = (len(order),) * 2 if allowed(len(order)) else (0, len(order))
    for _ in range(BISECTIONS):
        middle = (low + high) // 2
        if middle == low:
            break
        low, high = (middle, high) if allowed(middle) else (low, middle)
    return without(low)
