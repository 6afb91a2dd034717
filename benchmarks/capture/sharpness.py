"""How often an image is ranked above its blurred copy when exposure and noise differ, by two measures of sharpness."""

from itertools import product
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro

from benchmarks.measuring import machine
from msdgs_train.capture.image_source import image_files, read_image
from msdgs_train.capture.sharpness import sharpness

EXPOSURES = [(1.0, 0.0), (0.7, 2.0), (1.0, 4.0), (0.8, 8.0)]
"""Gain, and standard deviation of noise in gray values."""
BLURS = {
    "Gaussian 0.7 px": lambda image: cv2.GaussianBlur(image, (0, 0), 0.7),
    "Gaussian 2 px": lambda image: cv2.GaussianBlur(image, (0, 0), 2),
    "motion 3 px": lambda image: cv2.blur(image, (3, 1)),
    "motion 9 px": lambda image: cv2.blur(image, (9, 1)),
}


def main(folder: Annotated[Path, tyro.conf.Positional], every: int = 20, seed: int = 0) -> None:
    """Print a table: share of right ranks by each measure, and the copy's sharpness relative to the image's."""
    rng = np.random.default_rng(seed)
    images = [cv2.cvtColor(read_image(file), cv2.COLOR_RGB2GRAY) for file in image_files(folder)[::every]]
    print(f"{len(images)} images, {machine()}, seed {seed}")
    print("| blur | variance of the Laplacian | `sharpness` | relative to the image |\n|---|---|---|---|")
    for name, blur in BLURS.items():
        right, ratios = [], []
        for image, one, two in product(images, EXPOSURES, EXPOSURES):
            values = image.astype(np.float32)
            sharp, copy = _taken(values, one, rng), _taken(blur(values), two, rng)
            usual = [cv2.Laplacian(each, cv2.CV_32F).var() for each in (sharp, copy)]
            ours = [sharpness(each) for each in (sharp, copy)]
            right.append((usual[0] > usual[1], ours[0] > ours[1]))
            ratios.append(ours[1] / max(ours[0], 1e-9))
        shares = np.mean(right, axis=0)
        print(f"| {name} | {100 * shares[0]:.0f} % | {100 * shares[1]:.0f} % | {np.median(ratios):.2f} |")


def _taken(image: np.ndarray, exposure: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    gain, noise = exposure
    return np.clip(np.round(gain * image + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)


if __name__ == "__main__":
    tyro.cli(main)
