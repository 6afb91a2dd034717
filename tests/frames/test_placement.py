"""Frames of a scene that isn't at the origin of the user's world."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene.similarity import Similarity
from tests.support.scene_files import level_camera, write_scene
from tests.support.tolerances import assert_close

PLACE = Similarity(0.25, (4096.0, -512.0, 64.0))
OPTIONS = RenderOptions(depth=True, motion_dt=0.25, counts=True)


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_a_camera_in_the_world_sees_the_scene(tmp_path: Path, model: str):
    camera = level_camera(24)
    camera = dataclasses.replace(camera, model=model, fx=camera.fx / 5 if model != "pinhole" else camera.fx)
    plain = DeformationSession(write_scene(tmp_path / "plain.onnx"))
    placed = DeformationSession(write_scene(tmp_path / "placed.onnx", scene_to_world=PLACE))
    want = Renderer().render(plain, camera, 0.5, OPTIONS)
    got = Renderer().render(placed, PLACE.camera_to_world(camera), 0.5, OPTIONS)
    np.testing.assert_array_equal(got.rgb, want.rgb)
    np.testing.assert_array_equal(got.alpha, want.alpha)
    assert got.depth is not None
    assert want.depth is not None
    np.testing.assert_array_equal(got.depth, np.float32(PLACE.scale) * want.depth)
    assert_close(got.motion, want.motion, "motion_vector")
    assert got.camera is not None
    assert_close(got.camera.position, PLACE.to_world(camera.position), "placed")
