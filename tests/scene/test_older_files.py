"""Scene files of the first exporter, with layers and plans that are gone, give the frames that they gave.

`older/` holds files of 20 Gaussians, and in frames.npz, by name, their frames at `TIMES` at half the size of their own
cameras, [T, 24, 32, 3] in float32."""

from dataclasses import replace

import numpy as np
import pytest

from msdgs_export.exporters.visionary import visionary_model
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import InvalidInput
from tests.support.sound_scenes import OLDER
from tests.support.tolerances import assert_close

TIMES = 0.37, 1.0


@pytest.mark.parametrize("name", sorted(path.stem for path in OLDER.glob("*.onnx")))
def test_frames_are_unchanged(name: str):
    session = DeformationSession(OLDER / f"{name}.onnx")
    metadata = session.scene.metadata
    own = metadata.cameras[0].camera
    halves = {key: getattr(own, key) / 2 for key in ("fx", "fy", "cx", "cy")}
    camera = replace(own, **halves, width=own.width // 2, height=own.height // 2)
    frames = [rasterize(session.gaussians(t), camera, background=metadata.background).rgb for t in TIMES]
    want = np.load(OLDER / "frames.npz")[name]
    assert np.ptp(want) > 0.1
    assert np.abs(want[0] - want[1]).max() > 0.01  # something moves
    assert_close(np.stack(frames), want, "served_frame")


def test_all_files_have_frames():
    assert sorted(np.load(OLDER / "frames.npz")) == sorted(path.stem for path in OLDER.glob("*.onnx"))


def test_products_in_8_bits_are_refused_for_visionary():
    with pytest.raises(InvalidInput, match=r"--plan compact:65"):
        visionary_model(OLDER / "int8.onnx")
