"""A scene that isn't at the origin of the user's world is described, asked for and drawn in that world."""

from pathlib import Path

import numpy as np

from msdgs_serve.scene.similarity import Similarity
from tests.support.images import decode
from tests.support.scene_files import metadata, write_scene
from tests.support.service import serving
from tests.support.tolerances import assert_close

PLACE = Similarity(0.25, (4096.0, -512.0, 64.0))
SIZE = {"width": 32, "height": 24, "format": "npy", "channels": ["rgb", "depth"], "t": 0.5}


def test_cameras_and_depths_are_in_the_users_world(tmp_path: Path):
    write_scene(tmp_path / "plain.onnx")
    write_scene(tmp_path / "placed.onnx", scene_to_world=PLACE)
    own = metadata().cameras[0].camera.camera_to_world.copy()
    world = own.copy()
    world[:3, 3] = PLACE.to_world(own[:3, 3])
    with serving(tmp_path, max_batch=8) as client:
        detail = client.get("/scenes/placed").json()
        assert detail["scene_to_world"] == PLACE.to_plain()
        assert_close(np.array(detail["cameras"][0]["camera_to_world"]), world, "placed")
        assert_close(np.array(detail["bounds"]), PLACE.to_world(np.array([[-1.0] * 3, [1.0] * 3])), "placed")
        plain = client.get("/scenes/plain").json()
        assert plain["scene_to_world"] == Similarity().to_plain()
        assert_close(np.array(detail["view"]["target"]), PLACE.to_world(plain["view"]["target"]), "placed")
        assert_close(detail["view"]["distance"], PLACE.scale * plain["view"]["distance"], "placed")

        def frame(scene: str, camera: dict) -> np.ndarray:
            response = client.post("/render", json={"scene": scene, "camera": camera, **SIZE})
            assert response.status_code == 200, response.text
            return decode(response.content, "npy")[0]

        for of_plain, of_placed in (
            ({"type": "scene", "index": 0}, {"type": "scene", "index": 0}),
            ({"type": "orbit", "azimuth": 30, "elevation": 20},) * 2,
            (
                {"type": "matrix", "camera_to_world": own.tolist(), "fov_y": 40},
                {"type": "matrix", "camera_to_world": world.tolist(), "fov_y": 40},
            ),
        ):
            want, got = frame("plain", of_plain), frame("placed", of_placed)
            assert_close(got[..., :3], want[..., :3], "served_frame")
            seen = np.isfinite(want[..., 3])
            assert seen.any()
            assert_close(got[seen][:, 3], PLACE.scale * want[seen][:, 3], "served_frame")
