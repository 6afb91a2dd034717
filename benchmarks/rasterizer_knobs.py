"""What each constant of the rasterizer costs and buys: error against float64, and time, one changed at a time."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from benchmarks.drawers import psnr
from benchmarks.frame_times import Times
from benchmarks.splat_scenes import object_camera, object_scene
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, compositing, rasterize
from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.exponential import exp2_polynomial
from msdgs_serve.rasterizer.projection import RED, ROOT_A, ROOT_B, ROOT_C, ROOT_SCALE, Splats, X, Y, project
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from msdgs_serve.rasterizer.view import TILE
from msdgs_serve.scene import Camera, Gaussians
from tests.support.reference import render

WITHOUT_THRESHOLDS = GSPLAT._replace(alpha_min=1e-6, transmittance_min=0.0)
FLOAT16 = {"all numbers": int(X), "all but the place": int(ROOT_A), "color and depth": int(RED)}
"""The first column of a record that is rounded."""
BLACK = np.zeros(3, np.float32)


class Knob(NamedTuple):
    """One way to draw."""

    name: str
    value: str
    draw: Callable[[Gaussians, Camera], np.ndarray]  # to rgb [H, W, 3]


def knobs() -> list[Knob]:
    """The first is how frames are drawn."""
    thresholds = {
        "α ≥": ("alpha_min", (0.25 / 255, 0.5 / 255, 2 / 255, 4 / 255)),
        "T >": ("transmittance_min", (0.0, 1e-5, 1e-3, 1e-2)),
    }
    found = [Knob("as it is", "", _with_options(GSPLAT))]
    for name, (field, values) in thresholds.items():
        for value in values:
            text = f"{value * 255:.2g}/255" if field == "alpha_min" else f"{value:g}"
            found.append(Knob(name, text, _with_options(GSPLAT._replace(**{field: value}))))
    found += [Knob("degree of 2^x", str(degree), _with_degree(degree)) for degree in (3, 4, 6, 7)]
    found += [Knob("degree of harmonics", str(degree), _with_harmonics(degree)) for degree in (2, 1, 0)]
    found.append(Knob("bounds", "3σ square", _with_3_sigma))
    found += [Knob("records in float16", name, _with_float16(first)) for name, first in FLOAT16.items()]
    return found


def _with_options(options: RasterizerOptions) -> Callable:
    return lambda gaussians, camera: rasterize(gaussians, camera, options=options).rgb


def _with_degree(degree: int) -> Callable:
    def draw(gaussians: Gaussians, camera: Camera) -> np.ndarray:
        with polynomial_of(degree):
            return rasterize(gaussians, camera).rgb

    return draw


@contextmanager
def polynomial_of(degree: int) -> Iterator[None]:
    """The compositing with 2^x of another degree."""
    with mock.patch.object(compositing, "exp2_polynomial", return_value=exp2_polynomial(degree)):
        yield


def _with_harmonics(degree: int) -> Callable:
    def draw(gaussians: Gaussians, camera: Camera) -> np.ndarray:
        return rasterize(shorter(gaussians, degree), camera).rgb

    return draw


def shorter(gaussians: Gaussians, degree: int) -> Gaussians:
    """Without harmonics above a degree."""
    return replace(gaussians, sh=np.ascontiguousarray(gaussians.sh[:, : (degree + 1) ** 2]))


def _with_float16(first: int) -> Callable:
    def draw(gaussians: Gaussians, camera: Camera) -> np.ndarray:
        splats = project(gaussians, camera, GSPLAT)
        drawn = with_float16_records(splats, first)
        tiles = bin_into_tiles(splats, camera.width, camera.height)
        return composite(drawn, tiles, camera.width, camera.height, BLACK, GSPLAT).rgb

    return draw


def with_float16_records(splats: Splats, first: int) -> Splats:
    """Records as float16 would hold them, from a column on."""
    records = splats.records.copy()
    records[:, first:] = records[:, first:].astype(np.float16)
    return splats._replace(records=records)


def _with_3_sigma(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    splats = with_3_sigma_squares(project(gaussians, camera, GSPLAT), camera)
    tiles = bin_into_tiles(splats, camera.width, camera.height)
    return composite(splats, tiles, camera.width, camera.height, BLACK, GSPLAT).rgb


def with_3_sigma_squares(splats: Splats, camera: Camera) -> Splats:
    """Tiles by the square of half a side of 3 times the largest standard deviation, as INRIA's code has it."""
    a, b, c = (splats.records[:, [ROOT_A, ROOT_B, ROOT_C]] / np.float32(ROOT_SCALE)).T
    drawn = a > 0
    a, b, c = (np.where(drawn, x, 1) for x in (a, b, c))
    smallest = 0.5 * (a * a + b * b + c * c)  # of the inverse covariance's eigenvalues, without cancellation:
    smallest = (a * c) ** 2 / (smallest + np.sqrt(np.maximum(smallest**2 - (a * c) ** 2, 0)))
    radius = np.ceil(3 / np.sqrt(smallest))
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    x, y = splats.records[:, X], splats.records[:, Y]
    sides = [
        (np.floor((x - radius) / TILE), columns),
        (np.floor((x + radius) / TILE) + 1, columns),
        (np.floor((y - radius) / TILE), rows),
        (np.floor((y + radius) / TILE) + 1, rows),
    ]
    rectangles = np.stack([np.clip(side, 0, most) for side, most in sides], axis=1).astype(np.uint16)
    return splats._replace(rectangles=np.where(drawn[:, None], rectangles, 0).astype(np.uint16))


def as_float64(gaussians: Gaussians) -> Gaussians:
    g = gaussians
    return Gaussians(*(array.astype(np.float64) for array in (g.means, g.quats, g.scales, g.opacities, g.sh)))


def oracle_agreement(seed: int) -> float:
    """Largest difference between our float64 and the slow obvious renderer of the tests, on a small scene."""
    scene, camera = as_float64(object_scene(1000, seed)), object_camera(96, 80)
    ours = rasterize(scene, camera, options=GSPLAT).rgb
    return float(np.abs(ours - render(scene, camera).rgb).max())


class KnobRuns:
    """Draws one scene with each knob in turn. Times are those of the processor, all threads together: waiting for
    other programs would hide what a knob costs."""

    def __init__(self, gaussians: Gaussians, camera: Camera) -> None:
        self._scene, self._knobs, self._times = (gaussians, camera), knobs(), Times(time.process_time)
        self._rng = np.random.default_rng(0)
        exact = as_float64(gaussians)
        self._exact = rasterize(exact, camera).rgb
        self._limitless = rasterize(exact, camera, options=WITHOUT_THRESHOLDS).rgb
        self._images = [knob.draw(*self._scene) for knob in self._knobs]

    def draw_all(self) -> None:
        """One turn, in an order of its own."""
        for k in self._rng.permutation(len(self._knobs)):
            self._times.time(str(k), self._knobs[k].draw, *self._scene)

    def rows(self) -> list[dict[str, Any]]:
        """Errors in dB against float64 with the same constants as usual, and against float64 without thresholds."""
        milliseconds = self._times.milliseconds()
        usual = milliseconds["0"]["min"]
        return [
            {
                "knob": knob.name,
                "value": knob.value,
                "milliseconds": milliseconds[str(k)],
                "of_usual": milliseconds[str(k)]["min"] / usual,
                "psnr": psnr(image, self._exact),
                "worst": float(np.abs(image - self._exact).max()),
                "psnr_without_thresholds": psnr(image, self._limitless),
            }
            for k, (knob, image) in enumerate(zip(self._knobs, self._images, strict=True))
        ]
