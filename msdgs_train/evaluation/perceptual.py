"""LPIPS and ꟻLIP: metrics of other packages, if these are installed. Nothing is downloaded."""

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
    """Load `lpips` and `flip`, each as a metric or with the reason why it is unavailable."""
    found = PerceptualMetrics({}, {})
    loaders = {"lpips": _load_lpips} | ({"flip": _load_flip} if with_flip else {})
    for name, load in loaders.items():
        try:
            found.metrics[name] = load()
        except Unavailable as error:
            found.unavailable[name] = str(error)
    return found


def _load_flip() -> Metric:
    """NVIDIA's LDR-ꟻLIP, mean over the pixels, at its default of 67 pixels per degree."""
    evaluator = _module("flip_evaluator", "flip-evaluator")
    return lambda rgb, target: float(evaluator.evaluate(target.numpy(), rgb.numpy(), "LDR", applyMagma=False)[1])


def _load_lpips() -> Metric:
    """LPIPS with VGG-16, on images scaled to [−1, 1].

    This is the definition of LPIPS. The scripts of 3D Gaussian Splatting pass [0, 1], which gives lower values.
    """
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
        return float(network(*(2 * image.permute(2, 0, 1)[None] - 1 for image in (rgb, target))))

    return metric


def _module(name: str, package: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise Unavailable(f"{package} isn't installed: pip install {package}") from None
    except (OSError, RuntimeError) as error:  # a build for another version of torch
        raise Unavailable(f"{package} can't be used: {error}") from None
