"""LPIPS and ꟻLIP: metrics of other packages, if these are installed. Nothing is downloaded.

LPIPS has two conventions: `lpips` is its definition, the distance of images scaled to [−1, 1] (Zhang et al. 2018);
`lpips_01` is what the scripts of 3D Gaussian Splatting and of systems after it report, the same network on images left
in [0, 1], which gives lower values for most renderings.
"""

import importlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

Metric = Callable[[Tensor, Tensor], float]
"""Error of a rendering against its image, both [H, W, 3] in [0, 1]; 0 for equal images."""


class Unavailable(Exception):
    """A metric can't be computed here; the message says what is missing."""


class PerceptualMetrics(NamedTuple):
    """The available metrics, and the reasons why others are unavailable."""

    metrics: dict[str, Metric]
    unavailable: dict[str, str]


def perceptual_metrics(*, with_flip: bool = True) -> PerceptualMetrics:
    """Load `lpips` with `lpips_01`, and `flip`, or the reason why they are unavailable."""
    found = PerceptualMetrics({}, {})
    loaders = {("lpips", "lpips_01"): _load_lpips} | ({("flip",): _load_flip} if with_flip else {})
    for names, load in loaders.items():
        try:
            found.metrics.update(load())
        except Unavailable as error:
            found.unavailable.update(dict.fromkeys(names, str(error)))
    return found


def _load_flip() -> dict[str, Metric]:
    """NVIDIA's LDR-ꟻLIP, mean over the pixels, at its default of 67 pixels per degree."""
    evaluator = _module("flip_evaluator", "flip-evaluator")

    def metric(rgb: Tensor, target: Tensor) -> float:
        return float(evaluator.evaluate(target.numpy(), rgb.numpy(), "LDR", applyMagma=False)[1])

    return {"flip": metric}


def _load_lpips() -> dict[str, Metric]:
    """LPIPS with VGG-16, in both conventions."""
    models = _module("torchvision.models", "torchvision")
    name = models.VGG16_Weights.IMAGENET1K_V1.url.rsplit("/", 1)[-1]
    weights = Path(torch.hub.get_dir()) / "checkpoints" / name
    if not weights.is_file():
        raise Unavailable(f"its weights aren't on this machine: no {name} in torch's hub folder (TORCH_HOME)")
    lpips = _module("torchmetrics.image.lpip", "torchmetrics")
    try:
        network = lpips.LearnedPerceptualImagePatchSimilarity(net_type="vgg")
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise Unavailable(f"{weights} can't be used: {error}") from None

    @torch.no_grad()
    def metric(rgb: Tensor, target: Tensor) -> float:
        return float(network(*(image.permute(2, 0, 1)[None] for image in (rgb, target))))

    return {"lpips": lambda rgb, target: metric(2 * rgb - 1, 2 * target - 1), "lpips_01": metric}


def _module(name: str, package: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise Unavailable(f"{package} isn't installed: pip install {package}") from None
    except (OSError, RuntimeError) as error:  # a build for another version of torch
        raise Unavailable(f"{package} can't be used: {error}") from None
