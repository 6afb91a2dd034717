"""Until when photographs show what follows each shared motion: what has got lost is hidden behind something else."""

import torch
from torch import Tensor

from msdgs_train.datasets import Frame
from msdgs_train.model import DynamicGaussians, carried
from msdgs_train.rasterization import rasterize

MOST_FRAMES = 240
"""That are looked at, spread over the times."""
LOST = 0.25
"""Of how much of it is seen before, on average: what is seen less from some time on, until the end, is lost."""
LAST = 0.45
"""Parts of the range from its middle: what a few photographs at the end don't show is hidden to them alone."""


def seen_until(model: DynamicGaussians, frames: list[Frame], time_range: tuple[float, float]) -> Tensor:
    """[2, B] how far from the middle of the time range, in [0, 0.5] of its length, Gaussians of each motion are seen,
    back in time and on; 0.5 where they are seen to the end."""
    first, last = time_range
    length = (last - first) or 1.0
    frames = sorted(frames, key=lambda frame: frame.t)
    frames = frames[:: -(-len(frames) // MOST_FRAMES)]
    places = torch.tensor([(frame.t - first) / length - 0.5 for frame in frames])
    seen = torch.stack([_seen(model, frame) for frame in frames])
    return torch.stack([_until(-places.flip(0), seen.flip(0)), _until(places, seen)])


def _seen(model: DynamicGaussians, frame: Frame) -> Tensor:
    """[B] the pixels that the Gaussians of each motion fill in a photograph: what their colours add to it."""
    with torch.no_grad():
        posed = model.pose(frame.t)
        followed, bases = carried(model.gaussians), model.bases
    assert followed is not None
    assert bases is not None
    sh = posed.sh.requires_grad_()
    rgb, _, _ = rasterize(*posed[:4], sh, frame.camera, sh.new_zeros(3))
    (grads,) = torch.autograd.grad(rgb.sum(), sh)
    pixels = grads[:, 0].abs().sum(dim=1, keepdim=True) * followed.basis_weights
    return sh.new_zeros(len(bases.pivots)).index_add(0, followed.basis_ids.flatten(), pixels.flatten())


def _until(places: Tensor, seen: Tensor) -> Tensor:
    """[B] of places [F], ascending, and what is seen there [F, B]."""
    until = torch.full((seen.shape[1],), 0.5)
    for k in reversed(range(1, len(places))):
        if 0 < places[k] < LAST:
            until[seen[k:].mean(dim=0) < LOST * seen[:k].mean(dim=0)] = places[k - 1].clamp_min(0)
    return until
