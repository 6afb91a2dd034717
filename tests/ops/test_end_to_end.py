"""From a trained model to a frame over HTTP: the service renders what the trainer renders."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_serve.scene import Gaussians
from msdgs_train.evaluation.layer_strip import camera_of
from msdgs_train.rendering.rasterize import rasterize
from tests.support.images import decode, linear_to_srgb
from tests.support.models import CAMERA, SCENE, export_scene, random_model, saved
from tests.support.reference import render
from tests.support.service import serving
from tests.support.tolerances import tolerance

TIMES = (0.0, 0.37, 1.0)


@pytest.mark.slow
def test_the_service_draws_what_the_trainer_draws(tmp_path: Path) -> None:
    model, camera = random_model(), camera_of(CAMERA, CAMERA["width"])
    scene = export_scene(saved(tmp_path, model), tmp_path / "scene.onnx").path
    body = {
        "camera": {"type": "matrix", **{k: CAMERA[k] for k in ("camera_to_world", "fx", "fy", "cx", "cy")}},
        "width": camera.width,
        "height": camera.height,
        "background": "scene",
    }
    with serving(scene) as client:
        for t in TIMES:
            with torch.no_grad():
                posed = model.pose(t)
                expected = rasterize(*posed, camera, torch.tensor(SCENE.background))[0].numpy()
            oracle = render(Gaussians(*(part.numpy() for part in posed)), camera, SCENE.background)
            allowed = (tolerance("served_frame") + oracle.slack * max(oracle.color_range, 1.0))[..., None]
            assert (oracle.slack == 0).mean() > 0.9
            assert np.ptp(expected) > 0.2
            exr = client.post("/render", json={**body, "t": t, "format": "exr"}).raise_for_status().content
            png = client.post("/render", json={**body, "t": t, "format": "png"}).raise_for_status().content
            floats = linear_to_srgb(decode(exr, "exr")[0][..., :3])
            assert (np.abs(floats - expected) <= allowed).all()
            bytes_ = decode(png, "png")[0][..., :3].astype(int)
            assert (np.abs(bytes_ - 255 * expected.clip(0, 1)) <= np.maximum(1, 255 * allowed)).all()
