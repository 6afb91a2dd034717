"""The placement of a scene in the user's world: laws of the two frames, and its place in the metadata."""

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest

from msdgs_serve.framing import framing, scene_framing
from msdgs_serve.scene import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.metadata import SceneCamera, SceneMetadata
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from tests.support.scene_files import metadata
from tests.support.scenes import random_camera
from tests.support.tolerances import assert_close

PLACES = {
    "far": Similarity(1.0, (500_123.4, 5_200_456.7, 812.3)),
    "millimetres": Similarity(1000.0, (0.0, 0.0, 0.0)),
    "microscope": Similarity(1e-6, (1e-4, -2e-4, 0.0)),
    "both": Similarity(0.05, (-30.0, 7.0, 1.0)),
}


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("model", ["pinhole", "orthographic", "fisheye"])
def test_a_camera_sees_the_same_in_both_frames(place: Similarity, model: Any):
    rng = np.random.default_rng(0)
    camera = dataclasses.replace(random_camera(rng, 53, 37), model=model)
    points = rng.uniform(-1, 1, (50, 3))
    pixels, depths = camera.project(points)
    in_world = place.camera_to_world(camera)
    placed, distances = in_world.project(place.to_world(points))
    assert_close(placed, pixels, "pixel.placed")
    assert_close(distances / place.scale, depths, "placed")
    back = place.camera_to_scene(in_world)
    assert_close(back.camera_to_world, camera.camera_to_world, "placed")
    assert_close((back.fx, back.fy), (camera.fx, camera.fy), "placed")
    assert_close(place.to_scene(place.to_world(points)), points, "placed")


def test_without_a_placement_a_camera_stays_the_same():
    camera = random_camera(np.random.default_rng(0), 53, 37)
    assert IDENTITY.camera_to_world(camera) is camera
    assert IDENTITY.camera_to_scene(camera) is camera


@pytest.mark.parametrize(
    ("scale", "offset", "field"),
    [
        *((scale, (0.0, 0.0, 0.0), "scale") for scale in (0.0, -1.0, math.nan, math.inf, 1e-12, 1e12)),
        *((1.0, offset, "offset") for offset in ((0.0, math.nan, 0.0), (math.inf, 0.0, 0.0), (1.0, 2.0))),
    ],
)
def test_what_is_no_placement_is_refused(scale: float, offset: tuple[float, float, float], field: str):
    with pytest.raises(InvalidInput, match=field):
        Similarity(scale, offset)


def test_metadata_keep_it_and_show_the_world():
    place = PLACES["both"]
    camera = random_camera(np.random.default_rng(1), 53, 37)
    scene = metadata(cameras=(SceneCamera("first", 0.0, camera),), scene_to_world=place)
    stored = scene.to_properties()
    assert json.loads(stored["scene_to_world"]) == {"scale": 0.05, "offset": [-30.0, 7.0, 1.0]}
    assert SceneMetadata.from_properties(stored, "a.onnx").scene_to_world == place
    assert "scene_to_world" not in metadata().to_properties()
    world = scene.in_world()
    assert_close(world.cameras[0].camera.position, place.to_world(camera.position), "placed")
    assert_close(np.array(world.bounds), place.to_world(np.array(scene.bounds)), "placed")
    own, shown = scene_framing(scene), framing(scene)
    assert_close(shown.target, place.to_world(own.target), "placed")
    assert_close(shown.distance, place.scale * own.distance, "placed")
    assert_close(shown.up, own.up, "placed")


@pytest.mark.parametrize(
    "value",
    [[], {"scale": 1}, {"offset": [0, 0, 0]}, {"scale": 0, "offset": [0, 0, 0]}, {"scale": 1, "offset": [0, 0]}],
)
def test_metadata_that_hold_none_are_refused(value: Any):
    properties = metadata().to_properties() | {"scene_to_world": json.dumps(value)}
    with pytest.raises(SceneFileInvalid, match="scene_to_world"):
        SceneMetadata.from_properties(properties, "a.onnx")
