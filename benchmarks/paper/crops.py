"""Renderings of held-out images side by side, cut where they differ most."""

import io
from collections.abc import Mapping

import numpy as np
from matplotlib.image import imsave

from msdgs_train.comparison.matrix import Run
from msdgs_train.datasets.common.images import read_rgba
from msdgs_train.engine.run_record import RENDERS

PART = 3
"""A crop has this part of the image's width and height."""


def crops(runs: Mapping[str, Run], split: str) -> dict[str, bytes]:
    """PNGs of one held-out image and of the runs' renderings of it, by name; none if no run is in its folder.

    The image is the middle one of those that all runs have rendered; the window, the one in which the renderings, or a
    single one and its image, differ most.
    """
    folders = {name: run.folder / RENDERS for name, run in runs.items() if (run.folder / RENDERS).is_dir()}
    if not folders:
        return {}
    shared = set.intersection(*({path.name for path in folder.glob(f"{split}_*.png")} for folder in folders.values()))
    if not shared:
        return {}
    file = sorted(shared)[len(shared) // 2]
    pairs = {name: read_rgba(folder / file)[..., :3] for name, folder in folders.items()}
    width = next(iter(pairs.values())).shape[1] // 2
    images = {"image": next(iter(pairs.values()))[:, :width]} | {name: pair[:, width:] for name, pair in pairs.items()}
    compared = np.stack(list(images.values())[0 if len(images) == 2 else 1 :]).astype(float)
    row, column = most_different(compared)
    height, width = (size // PART for size in compared.shape[1:3])
    return {name: _png(image[row : row + height, column : column + width]) for name, image in images.items()}


def most_different(images: np.ndarray) -> tuple[int, int]:
    """Row and column of the window in which [images, H, W, 3] differ most, by the sum of their variance."""
    sums = np.pad(images.var(axis=0).sum(axis=-1), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    height, width = (size // PART for size in images.shape[1:3])
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    row, column = np.unravel_index(inside.argmax(), inside.shape)
    return int(row), int(column)


def _png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    imsave(file, np.ascontiguousarray(pixels), format="png")
    return file.getvalue()
