"""Tile-based, exact and deterministic Gaussian splatting on a CPU; call `rasterize`."""

from msdgs_serve.rasterizer.frame_sequence import FrameSequence
from msdgs_serve.rasterizer.rasterize import Rendering, rasterize
from msdgs_serve.rasterizer.tiles import TooManyPairs
from msdgs_serve.rasterizer.view import GSPLAT, INRIA, RasterizerOptions, as_trained

__all__ = [
    "GSPLAT",
    "INRIA",
    "FrameSequence",
    "RasterizerOptions",
    "Rendering",
    "TooManyPairs",
    "as_trained",
    "rasterize",
]
