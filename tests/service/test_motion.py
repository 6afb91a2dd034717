"""Motion vectors: the displacement in pixels, over a time, of the surface seen at each pixel."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_serve.client import Client, Orbit
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.camera import orbit
from tests.support.images import decode
from tests.support.scene_files import UP, level_camera, write_scene
from tests.support.scenes import pixel_of
from tests.support.service import serving
from tests.support.tolerances import assert_close

SIZE = 96
ORBIT = {"type": "orbit", "azimuth": 40, "elevation": 10, "distance": 5, "fov_y": 40}
FRAME = {"camera": ORBIT, "width": SIZE, "height": SIZE, "t": 0.1, "channels": ["motion"], "dt": 0.2}


@pytest.mark.parametrize(("t", "dt"), [(0.1, 0.2), (0.9, -0.3), (0.0, 1.0)])
def test_motion_of_the_ball_is_that_of_its_center(scene: Path, t: float, dt: float):
    camera = Camera.from_fov(orbit(np.zeros(3), 5.0, 40, 10, UP), SIZE, SIZE, 40.0)
    session = DeformationSession(scene)
    image = Renderer().render(session, camera, t, RenderOptions(motion_dt=dt))
    assert image.motion is not None
    column, row = np.floor(pixel_of(camera, [0, 0, 2 * t - 1])).astype(int)
    moved = pixel_of(camera, [0, 0, 2 * (t + dt) - 1]) - pixel_of(camera, [0, 0, 2 * t - 1])
    assert_close(image.motion[row, column], moved, "motion_vector")
    resting = pixel_of(camera, [0, 0, 0])
    assert_close(image.motion[int(resting[1]), int(resting[0])], np.zeros(2), "motion_vector")
    assert (image.motion[image.alpha == 0] == 0).all()


def test_a_frame_warped_by_its_motion_is_the_later_frame(scene: Path):
    """Compare the vectors of all pixels that the moving ball covers well with its known translation."""
    camera = level_camera(SIZE)
    session = DeformationSession(scene)
    now = Renderer().render(session, camera, 0.0, RenderOptions("transparent", motion_dt=0.1))
    later = Renderer().render(session, camera, 0.1, RenderOptions("transparent"))
    assert now.motion is not None
    rows, columns = np.nonzero((now.alpha > 0.5) & (now.rgb[..., 1] > now.rgb[..., 0]))
    ends = np.stack([columns, rows], axis=1) + now.motion[rows, columns]
    whole = np.round(ends).astype(int)
    np.testing.assert_allclose(later.alpha[whole[:, 1], whole[:, 0]], now.alpha[rows, columns], atol=0.2)
    expected = pixel_of(camera, [0, 0, -0.8]) - pixel_of(camera, [0, 0, -1])
    errors = np.linalg.norm(now.motion[rows, columns] - expected, axis=1)
    assert np.median(errors) < 0.25


@pytest.mark.parametrize(
    ("changes", "motion", "scene"),
    [
        (True, True, {}),
        (True, True, {"plan": "keyframes:5", "layers": ()}),
        (True, True, {"changing": ("opacities",)}),
        (True, False, {"plan": "frames:3", "layers": ()}),
        (False, False, {"moving": 0}),
        (False, False, {"moving": 0, "plan": "frames:1"}),
        (False, False, {"time_range": (0.5, 0.5)}),
    ],
)
def test_the_description_says_whether_there_is_motion(
    tmp_path: Path, changes: bool, motion: bool, scene: dict[str, Any]
):
    write_scene(tmp_path / "balls.onnx", **scene)
    with serving(tmp_path) as client:
        described = client.get("/scenes/balls").json()
    assert (described["changes"], described["motion"]) == (changes, motion)


def test_behind_the_camera_nothing_moves_and_nothing_breaks(scene: Path):
    inside = Camera.from_fov(orbit(np.zeros(3), 0.05, 0, 80, UP), SIZE, SIZE, 90.0)
    image = Renderer().render(DeformationSession(scene), inside, 0.0, RenderOptions(motion_dt=1.0))
    assert image.motion is not None
    assert np.isfinite(image.motion).all()


def test_there_is_no_motion_between_switched_frames(tmp_path: Path):
    session = DeformationSession(write_scene(tmp_path / "scene.onnx", plan="frames:2"))
    assert Renderer().render(session, level_camera(SIZE), 0.1).motion is None
    with pytest.raises(InvalidInput, match="switches from frame to frame") as error:
        Renderer().render(session, level_camera(SIZE), 0.1, RenderOptions(motion_dt=0.2))
    assert error.value.field == "dt"


def test_motion_over_http(scene: Path):
    with serving(scene) as http:
        motion = decode(http.post("/render", json={**FRAME, "format": "npy"}).content, "npy")[0]
        assert motion.shape == (SIZE, SIZE, 2)
        pixels, spec = decode(http.post("/render", json={**FRAME, "format": "exr"}).content, "exr")
        assert spec.channelnames == ("forward.u", "forward.v")
        np.testing.assert_array_equal(pixels, motion)
        earlier = decode(http.post("/render", json={**FRAME, "dt": -0.1, "format": "exr"}).content, "exr")[1]
        assert earlier.channelnames == ("backward.u", "backward.v")
        drawn, _ = decode(http.post("/render", json=FRAME).content, "png")
        assert (drawn[np.abs(motion).max(axis=2) < 1e-6] == 0).all()
        assert drawn.max() > 200
        with Client(str(http.base_url)) as client:
            camera = Orbit(40, 10, distance=5, fov_y=40)
            frame = client.render(camera, 0.1, width=SIZE, height=SIZE, channels=("rgb", "motion"), dt=0.2)
        np.testing.assert_array_equal(frame.motion, motion)  # pyright: ignore[reportArgumentType]
