"""LPIPS and ꟻLIP: metrics that other packages compute, where these are at hand. Nothing is ever downloaded."""

import importlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

Metric = Callable[[Tensor, Tensor], float]
"""Of a rendering and its image, both [H, W, 3] in [0, 1]; 0 where they are equal, lower is better."""


class Unavailable(Exception):
    """A metric can't be computed here; the message says what is missing."""


class PerceptualMetrics(NamedTuple):
    """Those that can be computed, and why the others can't."""

    metrics: dict[str, Metric]
    unavailable: dict[str, str]


def perceptual_metrics() -> PerceptualMetrics:
    """`lpips` and `flip`, each either ready or with the reason why not."""
    found = PerceptualMetrics({}, {})
    for name, load in (("lpips", _load_lpips), ("flip", _load_flip)):
        try:
            found.metrics[name] = load()
        except Unavailable as error:
            found.unavailable[name] = str(error)
    return found


def _load_flip() -> Metric:
    """NVIDIA's LDR-ꟻLIP, mean over the pixels, at its default of 67 pixels per degree."""
    try:
        evaluator: Any = importlib.import_module("flip_evaluator")
    except ImportError:
        raise Unavailable("flip-evaluator isn't installed: pip install flip-evaluator") from None

    def metric(rgb: Tensor, target: Tensor) -> float:
        return float(evaluator.evaluate(target.numpy(), rgb.numpy(), "LDR", applyMagma=False)[1])

    return metric


def _load_lpips() -> Metric:
    """LPIPS with VGG-16, through the lpips package or else torchmetrics, on images scaled to [−1, 1].

    This is how LPIPS is defined. The scripts of 3D Gaussian Splatting feed it [0, 1], so that theirs come out lower.
    """
    weights = _vgg_weights()
    try:
        network: Any = _lpips_network()
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise Unavailable(f"{weights} can't be used: {error}") from None

    @torch.no_grad()
    def metric(rgb: Tensor, target: Tensor) -> float:
        return float(network(*(2 * image.permute(2, 0, 1)[None] - 1 for image in (rgb, target))))

    return metric


def _vgg_weights() -> Path:
    try:
        models: Any = importlib.import_module("torchvision.models")
    except ImportError:
        raise Unavailable("torchvision isn't installed, which LPIPS takes its network from") from None
    name = models.VGG16_Weights.IMAGENET1K_V1.url.rsplit("/", 1)[-1]
    path = Path(torch.hub.get_dir()) / "checkpoints" / name
    if not path.is_file():
        raise Unavailable(f"its weights aren't on this machine: no {name} in torch's hub folder (TORCH_HOME)")
    return path


def _lpips_network() -> Any:
    try:
        return importlib.import_module("lpips").LPIPS(net="vgg", verbose=False).eval()
    except ImportError:
        pass
    try:
        return importlib.import_module("torchmetrics.image.lpip").LearnedPerceptualImagePatchSimilarity(net_type="vgg")
    except ImportError:
        raise Unavailable("neither lpips nor torchmetrics is installed") from None
