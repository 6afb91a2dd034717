"""Pruning: removal of parts of a scene that rendered frames don't need."""

from msdgs_export.pruning.decide import prune
from msdgs_export.pruning.mask import PrunedModel, PruningMask, full_mask, pruned
from msdgs_export.pruning.rules import RULES
from msdgs_export.pruning.statistics import PruningStatistics

__all__ = ["RULES", "PrunedModel", "PruningMask", "PruningStatistics", "full_mask", "prune", "pruned"]
