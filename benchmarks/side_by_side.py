"""Held-out images beside what one or more models make of them, with the PSNR under each image.

python benchmarks/side_by_side.py DATA runs/one_step/model.pt runs/two_steps/model.pt --size 200 --out side_by_side.png
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from msdgs_train.datasets import Frame, composite, load_scene
from msdgs_train.evaluation.metrics import quality
from msdgs_train.gaussians.model_file import LoadedModel, load_model


@dataclass(frozen=True)
class SideBySide:
    """Draw a contact sheet: a row an image, the image first, then each model's rendering."""

    data: tyro.conf.Positional[Path]
    """Folder of a dataset that `msdgs-train fit` reads."""
    models: tyro.conf.Positional[tuple[Path, ...]]
    """model.pt files, in the order of the columns."""
    out: Path = Path("side_by_side.png")
    split: str = "test"
    """train, val or test."""
    size: int | None = None
    """Width in pixels; the images' own if not given."""
    rows: int = 5
    """Images shown, evenly spread over the split."""


def main(options: SideBySide) -> None:
    """Render, judge, draw, and print each model's mean over the whole split."""
    frames = load_scene(options.data, options.size).splits[options.split]
    models = [load_model(path) for path in options.models]
    shown = {round(row) for row in np.linspace(0, len(frames) - 1, min(options.rows, len(frames)))}
    figure = Figure(figsize=(2.4 * (1 + len(models)), 2.6 * len(shown)), layout="constrained")
    axes = iter(figure.subplots(len(shown), 1 + len(models), squeeze=False).flat)
    psnrs: list[list[float]] = [[] for _ in models]
    for index, frame in enumerate(frames):
        truth = torch.from_numpy(composite(frame.load_rgba(), models[0].scene.background))
        images = [render(model, frame) for model in models]
        for column, rgb in enumerate(images):
            psnrs[column].append(quality(rgb, truth).psnr)
        if index in shown:
            titles = [f"image, t = {frame.t:.2f}"]
            titles += [f"{name(model)}, {values[-1]:.1f} dB" for model, values in zip(models, psnrs, strict=True)]
            for image, title in zip([truth, *images], titles, strict=True):
                axis = next(axes)
                axis.imshow(image.numpy())
                axis.set_title(title, fontsize=9)
                axis.axis("off")
    figure.savefig(options.out, dpi=110)
    for model, values in zip(models, psnrs, strict=True):
        print(f"{name(model)}: {np.mean(values):.2f} dB over {len(frames)} {options.split} images")
    print(f"wrote {options.out}")


def name(model: LoadedModel) -> str:
    """How a column is called."""
    kinds = model.model.config.layers
    return f"K = {len(kinds)} ({', '.join(sorted(set(kinds)))})"


def render(model: LoadedModel, frame: Frame) -> torch.Tensor:
    """The model seen from the frame's camera at its time, [H, W, 3] in [0, 1]."""
    return model.render(frame.camera, frame.t).clamp(0, 1)


if __name__ == "__main__":
    main(tyro.cli(SideBySide, description=__doc__))
