"""The moving region, and PSNR in it."""

import json
import math
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV
from msdgs_train.datasets import Frame
from msdgs_train.datasets.common.images import write_png
from msdgs_train.engine import run as fit_module
from msdgs_train.engine.run import fit
from msdgs_train.evaluation import evaluate as evaluation_module
from msdgs_train.evaluation.evaluate import evaluate_run
from msdgs_train.evaluation.metrics import masked_psnr
from msdgs_train.evaluation.moving_region import moving_region, travels
from msdgs_train.gaussians.model import PosedGaussians
from msdgs_train.gaussians.model_file import LoadedModel
from tests.support.scenes import front_camera, gaussians_of
from tests.support.training_scene import SIZE, small_config


def test_psnr_inside_a_mask_has_a_known_answer() -> None:
    rgb, target = torch.full((10, 10, 3), 0.5), torch.full((10, 10, 3), 0.5)
    mask = np.zeros((10, 10), bool)
    mask[2:4, 3:8] = True
    rgb[torch.from_numpy(mask)] += 0.1
    rgb[9, 9] += 0.4
    assert masked_psnr(rgb, target, mask) == pytest.approx(20, abs=1e-4)
    assert masked_psnr(rgb, target, np.zeros((10, 10), bool)) is None


def test_a_centre_travels_by_pixels() -> None:
    """At depth 4 and a focal length of 40 a pixel is 0.1 wide; motion behind the camera doesn't count."""
    camera = front_camera(focal=40.0)
    there = torch.tensor([[0.0, 0, 4], [0.0, 0, 4], [0.0, 0, 4], [0.0, 0, -4], [0.0, 0, 4]])
    moved = there + torch.tensor([[0.09, 0, 0], [0.11, 0, 0], [0, -0.11, 0], [9.0, 0, 0], [0, 0, 1]])
    assert travels([there, moved], camera).tolist() == [False, True, True, False, False]


class _Moving:
    """Two distant Gaussians, the second of which moves to the right, 1 scene unit per unit of time."""

    rasterizer = GSPLAT

    def pose(self, t: float) -> Any:
        g = gaussians_of([[-1.0, 0, 4], [0.3 + t, 0, 4]], scales=0.2, opacities=0.9, rgb=[[0.1] * 3, [0.8, 0.1, 0.1]])
        arrays = (g.means, g.quats, g.scales, g.opacities, g.sh)
        return PosedGaussians(*(torch.from_numpy(np.asarray(array, np.float32)) for array in arrays))


def test_the_models_region_is_where_gaussians_that_move_are_seen() -> None:
    camera, white = front_camera(), (1.0, 1.0, 1.0)
    loaded = LoadedModel(_Moving(), types.SimpleNamespace(background=white), 0)  # type: ignore[arg-type]
    frames = [Frame(str(t), camera, t, Path("none")) for t in (0.0, 1.0)]
    scene = types.SimpleNamespace(splits={"train": [], "test": frames}, time_range=(0.0, 1.0))
    region = moving_region(scene, "test", [loaded])  # type: ignore[arg-type]
    assert region.source == "model"
    masks = [region.mask(frame) for frame in frames]
    for mask, t in zip(masks, (0.0, 1.0), strict=True):
        moving = gaussians_of([[0.3 + t, 0, 4]], scales=0.2, opacities=0.9, rgb=[[0.8, 0.1, 0.1]])
        alone = rasterize(moving, camera, background=white).rgb
        np.testing.assert_array_equal(mask, (1 - alone).max(axis=-1) > 0.1)
        assert 10 < mask.sum() < 200
    assert not (masks[0] & masks[1]).all()
    assert not masks[0][:, :25].any(), "the static Gaussian is at the left"


def _write_fixed_camera(folder: Path) -> Path:
    """A camera that is fixed up to rounding: grey, with a black square that moves 6 pixels to the right per image."""
    matrix = OPENGL_TO_OPENCV.copy()
    for split, times in (("train", (0.0, 0.5, 1.0)), ("test", (0.25, 0.75))):
        (folder / split).mkdir(parents=True)
        frames = []
        for t in times:
            pixels = np.full((SIZE, SIZE, 3), 128, np.uint8)
            pixels[10:14, round(20 * t) : round(20 * t) + 4] = 0
            name = f"{split}/r_{100 * t:03.0f}"
            write_png(folder / f"{name}.png", pixels)
            matrix[0, 3] = -1e-9 * t
            frames.append({"file_path": f"./{name}", "time": t, "transform_matrix": matrix.tolist()})
        contents = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(contents))
    return folder


def test_with_fixed_cameras_the_region_is_that_of_the_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The region is the square. The rendering is the background alone: a known error inside, none outside."""
    monkeypatch.setattr(fit_module, "draw_curve", lambda run: None)
    data, run = _write_fixed_camera(tmp_path / "fixed"), tmp_path / "run"
    fit(small_config(steps=2), data, run)
    grey = torch.full((SIZE, SIZE, 3), 128 / 255)
    monkeypatch.setattr(evaluation_module.EvaluatedModel, "render", lambda self, frame: grey)
    evaluation = evaluate_run(run)
    assert evaluation.region_source == "images"
    for frame, mask, scores in zip(evaluation.frames, evaluation.masks, evaluation.models[0].images, strict=True):
        square = np.zeros((SIZE, SIZE), bool)
        square[10:14, round(20 * frame.t) : round(20 * frame.t) + 4] = True
        np.testing.assert_array_equal(mask, square)
        inside = -20 * math.log10(128 / 255)
        assert scores.moving_psnr == pytest.approx(inside, abs=1e-4)
        assert scores.psnr == pytest.approx(inside + 10 * math.log10(SIZE**2 / 16), abs=1e-4)
