"""HyperNeRF layout: times, splits, copies and points."""

from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import load_scene
from tests.train.datasets.layouts import HYPERNERF_IDS, HYPERNERF_SCENE, LENSES, hypernerf_json, write_hypernerf


def test_the_key_of_nerfies_is_read(tmp_path: Path):
    files = hypernerf_json(LENSES["barrel"])
    for id_ in HYPERNERF_IDS:
        files[f"camera/{id_}.json"]["tangential"] = files[f"camera/{id_}.json"].pop("tangential_distortion")
    distortion = load_scene(write_hypernerf(tmp_path, files=files)).splits["train"][0].distortion
    assert distortion is not None
    assert distortion._asdict() == {key: getattr(LENSES["barrel"], key) for key in distortion._fields}


def test_splits_times_and_pixels(tmp_path: Path):
    scene = load_scene(write_hypernerf(tmp_path))
    assert {split: [frame.name for frame in frames] for split, frames in scene.splits.items()} == {
        "train": ["000000", "000002"],
        "val": [],
        "test": ["000001", "000003"],
    }
    assert [frame.t for frame in scene.splits["train"]] == [0.0, 10 / 15]
    assert [frame.t for frame in scene.splits["test"]] == [5 / 15, 1.0]
    assert scene.time_range == (0.0, 1.0)
    assert (scene.splits["test"][0].load_rgba()[..., :3] == 1).all()


def test_warp_ids_are_used_without_time_ids(tmp_path: Path):
    files = hypernerf_json()
    files["metadata.json"] = {id_: {"warp_id": 3 * k + 3, "camera_id": 0} for k, id_ in enumerate(HYPERNERF_IDS)}
    scene = load_scene(write_hypernerf(tmp_path, files=files))
    assert [frame.t for frame in scene.splits["test"]] == [0.5, 1.0]
    assert scene.time_range == (0.25, 1.0)


def test_the_smallest_copy_that_is_wide_enough_is_read(tmp_path: Path):
    write_hypernerf(tmp_path, LENSES["pinhole"], 2, 4, 16)
    for size, reduction in ((None, 2), (160, 2), (81, 2), (80, 4), (21, 4), (20, 16), (7, 16)):
        frame = load_scene(tmp_path, size).splits["train"][0]
        assert frame.image_path.parent.name == f"{reduction}x"
        assert frame.load_rgba().shape[1] == (size or 160)
    with pytest.raises(InvalidInput, match="`size` must be"):
        load_scene(tmp_path, 161)


def test_points_move_with_the_cameras(tmp_path: Path):
    write_hypernerf(tmp_path)
    assert load_scene(tmp_path).points is None
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    np.save(tmp_path / "points.npy", points)
    scene = load_scene(tmp_path)
    assert scene.points is not None
    assert (scene.points == (points.astype(np.float64) - HYPERNERF_SCENE["center"]) * HYPERNERF_SCENE["scale"]).all()
    assert scene.point_colors is None
    assert scene.scene_half_size <= np.abs(scene.points).max()
