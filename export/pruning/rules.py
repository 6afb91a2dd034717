"""The rules of trimming: each proposes what a scene could do without, and rendered frames decide how much of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from export.pruning.mask import HEADS, Cut, Network
from export.pruning.statistics import Evidence

HALVINGS = 7
"""Of the interval in which the number of Gaussians to leave out is searched for: to 1 in 128."""

HOPELESS = 1.0
"""Pixels. What moves the visible Gaussians by more than this on average is needed, and isn't tried."""

VISIBLE_MOTION = 2.0
"""Pixels. What moves further stays in motion however faint it is in the frames: from elsewhere it may not be."""

WORK = 2e13
"""Operations of layers that trials without some of them may take, in each trimming: minutes of two cores. Beyond it the
rule leaves in what it has not tried; a scene of the paper's size would be posed anew for half an hour."""

Rule = Callable[[Evidence, Cut, float], Cut]
"""Leaves out of a cut what it can while the worst deciding frame stays at so many dB or more."""


@dataclass(frozen=True)
class RuleKind:
    """One rule as users see it."""

    what: str  # that it leaves out, in words
    share: float  # of the squared error allowed, that may be used up when this rule is done
    apply: Rule


def modulation(evidence: Evidence, cut: Cut, enough: float) -> Cut:
    """Scale modulation where it is 1, or as good as."""
    if not cut.network.modulated:
        return cut
    return _if_enough(evidence, cut, _network(cut, modulated=False), enough)


def heads(evidence: Evidence, cut: Cut, enough: float) -> Cut:
    """Heads of all layers that change nothing: positions, scales or rotations."""
    for name in sorted(cut.network.heads, key=lambda name: HEADS.index(name), reverse=True):
        cut = _if_enough(evidence, cut, _network(cut, heads=cut.network.heads - {name}), enough)
    return cut


def layers(evidence: Evidence, cut: Cut, enough: float) -> Cut:
    """Whole layers whose weighted step is invisible: as many of the last ones as can go together, then single ones."""
    work = WORK

    def tried(left: tuple[int, ...]) -> Cut:
        nonlocal work
        smaller = _network(cut, layers=left)
        work -= evidence.operations(smaller.network)
        return _if_enough(evidence, cut, smaller, enough) if work >= 0 else cut

    last = len(cut.network.layers) - 1
    while last > 0:
        smaller = tried(cut.network.layers[:-last])
        last = min(last // 2, len(smaller.network.layers) - 1)
        cut = smaller
    for k in reversed(cut.network.layers):
        if len(cut.network.layers) > 1:
            cut = tried(tuple(layer for layer in cut.network.layers if layer != k))
    return cut


def unseen(evidence: Evidence, cut: Cut, enough: float) -> Cut:
    """Gaussians that add nothing to any frame, those that add least first."""
    order = _least(evidence.peaks * evidence.amounts, cut.kept)

    def without(ids: np.ndarray) -> Cut:
        return cut.without(kept=_cleared(cut.kept, ids))

    return _as_many(evidence, cut, order, without, enough)


def still(evidence: Evidence, cut: Cut, enough: float) -> Cut:
    """Motion of Gaussians that don't move visibly, those that move least first."""
    motion = evidence.motion(cut.network)
    order = _least(motion * evidence.peaks, cut.moves & (motion < VISIBLE_MOTION))

    def without(ids: np.ndarray) -> Cut:
        return cut.without(moves=_cleared(cut.moves, ids))

    return _as_many(evidence, cut, order, without, enough)


def bands(evidence: Evidence, cut: Cut, enough: float) -> Cut:
    """Upper bands of the spherical harmonics that change no color visibly."""
    for degree in range(cut.sh_degree):
        lower = cut.without(sh_degree=degree)
        if evidence.worst_db(lower, enough) >= enough:
            return lower
    return cut


RULES = {
    "heads": RuleKind("heads that change nothing", 0.05, heads),
    "modulation": RuleKind("scale modulation that is 1", 0.1, modulation),
    "layers": RuleKind("layers whose weighted step is invisible", 0.2, layers),
    "unseen": RuleKind("Gaussians that never contribute", 0.45, unseen),
    "still": RuleKind("motion of Gaussians that never move visibly", 0.9, still),
    "bands": RuleKind("SH bands that change nothing", 1.0, bands),
}
"""In the order in which they are applied."""


def _network(cut: Cut, **changes: object) -> Cut:
    return cut.without(network=replace(cut.network, **changes))


def _if_enough(evidence: Evidence, cut: Cut, smaller: Cut, enough: float) -> Cut:
    if not cut.moves.any() or _hopeless(evidence, cut.network, smaller.network):
        return cut
    return smaller if evidence.worst_db(smaller, enough) >= enough else cut


def _hopeless(evidence: Evidence, network: Network, smaller: Network) -> bool:
    """Whether a few Gaussians at a few times tell that frames of the smaller network are another scene."""
    return evidence.change(network, smaller) > HOPELESS


def _least(amounts: np.ndarray, among: np.ndarray) -> np.ndarray:
    """The ids of `among`, [N] bool, those of the least amount first."""
    ids = np.flatnonzero(among)
    return ids[np.argsort(amounts[ids], kind="stable")]


def _cleared(flags: np.ndarray, ids: np.ndarray) -> np.ndarray:
    flags = flags.copy()
    flags[ids] = False
    return flags


def _as_many(
    evidence: Evidence, cut: Cut, order: np.ndarray, without: Callable[[np.ndarray], Cut], enough: float
) -> Cut:
    """Leave out as many of `order`, from its start, as the frames allow: all, or what halving an interval finds."""
    if not len(order):
        return cut
    everything = without(order)
    if evidence.worst_db(everything, enough) >= enough:
        return everything
    low, high = 0, len(order)  # `low` of them may go, `high` may not
    for _ in range(HALVINGS):
        middle = (low + high) // 2
        if middle == low:
            break
        low, high = (middle, high) if evidence.worst_db(without(order[:middle]), enough) >= enough else (low, middle)
    return without(order[:low])
