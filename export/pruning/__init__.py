"""Leaving out what a scene does not need, as rendered frames decide."""

from export.pruning.decide import LeftOut, trim, trimmed_model
from export.pruning.mask import Cut, TrimmedModel, whole
from export.pruning.rules import RULES
from export.pruning.statistics import Evidence

__all__ = ["RULES", "Cut", "Evidence", "LeftOut", "TrimmedModel", "trim", "trimmed_model", "whole"]
