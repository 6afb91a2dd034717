"""The rules of pruning: each proposes what a scene could do without, and rendered frames decide how much of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from export.layers import HEADS
from export.pruning.mask import NetworkMask, PruningMask
from export.pruning.statistics import PruningStatistics

HALVINGS = 7
"""Of the interval in which the number of Gaussians to leave out is searched for: to 1 in 128."""

MAX_MEAN_MOTION = 1.0
"""Pixels. What moves the visible Gaussians by more than this on average is needed, and isn't tried."""

VISIBLE_MOTION = 2.0
"""Pixels. What moves further stays in motion however faint it is in the frames: from elsewhere it may not be."""

MAX_OPERATIONS = 2e13
"""Operations of layers that trials without some of them may take, in each pruning: minutes of two cores. Beyond it the
rule leaves in what it has not tried; a scene of the paper's size would be posed anew for half an hour."""

Rule = Callable[[PruningStatistics, PruningMask, float], PruningMask]
"""Leaves out of a mask what it can while the worst deciding frame stays at so many dB or more."""


@dataclass(frozen=True)
class RuleKind:
    """One rule as users see it."""

    what: str  # that it leaves out, in words
    error_budget: float  # of the squared error allowed, that may be used up when this rule is done
    apply: Rule


def modulation(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Scale modulation where it is 1, or as good as."""
    if not mask.network.modulated:
        return mask
    return _if_allowed(statistics, mask, _network(mask, modulated=False), min_db)


def heads(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Heads of all layers that change nothing: positions, scales or rotations."""
    for name in sorted(mask.network.heads, key=lambda name: HEADS.index(name), reverse=True):
        mask = _if_allowed(statistics, mask, _network(mask, heads=mask.network.heads - {name}), min_db)
    return mask


def layers(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Whole layers whose weighted step is invisible: as many of the last ones as can go together, then single ones."""
    work = MAX_OPERATIONS

    def tried(left: tuple[int, ...]) -> PruningMask:
        nonlocal work
        smaller = _network(mask, layers=left)
        work -= statistics.operations(smaller.network)
        return _if_allowed(statistics, mask, smaller, min_db) if work >= 0 else mask

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
    """Gaussians that add nothing to any frame, those that add least first."""
    order = _ascending(statistics.peaks * statistics.amounts, mask.kept)

    def without(ids: np.ndarray) -> PruningMask:
        return mask.without(kept=_cleared(mask.kept, ids))

    return _as_many_as_allowed(statistics, mask, order, without, min_db)


def static(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Motion of Gaussians that don't move visibly, those that move least first."""
    motion = statistics.motion(mask.network)
    order = _ascending(motion * statistics.peaks, mask.moves & (motion < VISIBLE_MOTION))

    def without(ids: np.ndarray) -> PruningMask:
        return mask.without(moves=_cleared(mask.moves, ids))

    return _as_many_as_allowed(statistics, mask, order, without, min_db)


def sh(statistics: PruningStatistics, mask: PruningMask, min_db: float) -> PruningMask:
    """Upper sh of the spherical harmonics that change no colour visibly."""
    for degree in range(mask.sh_degree):
        lower = mask.without(sh_degree=degree)
        if statistics.worst_db(lower, min_db) >= min_db:
            return lower
    return mask


RULES = {
    "heads": RuleKind("heads that change nothing", 0.05, heads),
    "modulation": RuleKind("scale modulation that is 1", 0.1, modulation),
    "layers": RuleKind("layers whose weighted step is invisible", 0.2, layers),
    "invisible": RuleKind("Gaussians that never contribute", 0.45, invisible),
    "static": RuleKind("motion of Gaussians that never move visibly", 0.9, static),
    "sh": RuleKind("SH sh that change nothing", 1.0, sh),
}
"""In the order in which they are applied."""


def _network(mask: PruningMask, **changes: object) -> PruningMask:
    return mask.without(network=replace(mask.network, **changes))


def _if_allowed(statistics: PruningStatistics, mask: PruningMask, smaller: PruningMask, min_db: float) -> PruningMask:
    if not mask.moves.any() or _changes_too_much(statistics, mask.network, smaller.network):
        return mask
    return smaller if statistics.worst_db(smaller, min_db) >= min_db else mask


def _changes_too_much(statistics: PruningStatistics, network: NetworkMask, smaller: NetworkMask) -> bool:
    """Whether a few Gaussians at a few times tell that frames of the smaller network are another scene."""
    return statistics.change(network, smaller) > MAX_MEAN_MOTION


def _ascending(amounts: np.ndarray, among: np.ndarray) -> np.ndarray:
    """The ids of `among`, [N] bool, those of the least amount first."""
    ids = np.flatnonzero(among)
    return ids[np.argsort(amounts[ids], kind="stable")]


def _cleared(flags: np.ndarray, ids: np.ndarray) -> np.ndarray:
    flags = flags.copy()
    flags[ids] = False
    return flags


def _as_many_as_allowed(
    statistics: PruningStatistics,
    mask: PruningMask,
    order: np.ndarray,
    without: Callable[[np.ndarray], PruningMask],
    min_db: float,
) -> PruningMask:
    """Leave out as many of `order`, from its start, as the frames allow: all, or what halving an interval finds."""
    if not len(order):
        return mask
    everything = without(order)
    if statistics.worst_db(everything, min_db) >= min_db:
        return everything
    low, high = 0, len(order)  # `low` of them may go, `high` may not
    for _ in range(HALVINGS):
        middle = (low + high) // 2
        if middle == low:
            break
        low, high = (middle, high) if statistics.worst_db(without(order[:middle]), min_db) >= min_db else (low, middle)
    return without(order[:low])
