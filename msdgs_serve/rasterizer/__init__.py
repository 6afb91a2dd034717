"""Gaussian splats on a CPU: tile-based, exact, deterministic. `rasterize` is the entrance."""

from msdgs_serve.rasterizer.rasterize import Rendering, rasterize
from msdgs_serve.rasterizer.view import GSPLAT, INRIA, RasterizerOptions

__all__ = ["GSPLAT", "INRIA", "RasterizerOptions", "Rendering", "rasterize"]
