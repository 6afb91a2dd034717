"""Leaving out what a scene does not need, as rendered frames decide."""

from export.trim.cut import Cut, TrimmedModel, whole
from export.trim.decide import LeftOut, trim, trimmed_model
from export.trim.evidence import Evidence
from export.trim.rules import RULES

__all__ = ["RULES", "Cut", "Evidence", "LeftOut", "TrimmedModel", "trim", "trimmed_model", "whole"]
