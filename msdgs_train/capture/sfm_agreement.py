"""How well a model explains the matches it was made of. Part of the process of `sfm_process`."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from msdgs_train.capture.rotation import Pair, beyond_rotation

MIN_MATCHES = 30
"""Of a pair of images that tells whether the camera only turned."""
FOUND_AGAIN = 3
"""Images in which a feature is found again, if it counts."""


def motion_beyond_rotation(model: pycolmap.Reconstruction, names: Sequence[tuple[str, str]], database: Path) -> float:
    """Pixels of the motion between images of one camera that no rotation explains.

    It is that of the model's points, in pairs of images of these names, or without those, of the matches of a database.
    """
    pairs = [*_pairs_of_model(model, names)] or [*_pairs_of_matches(database)]
    with pycolmap.Database.open(database) as opened:
        sizes = [max(camera.width, camera.height) for camera in opened.read_all_cameras()]
    return max(sizes) * beyond_rotation(pairs)


def agreement(model: pycolmap.Reconstruction, database: Path) -> float:
    """Observations of the model's points, relative to the features of its images that are found again in several ones.

    It may be above 1, as points are completed by features that were found again less often. It says nothing of fixed
    cameras, with one view each.
    """
    names = {model.image(image_id).name for image_id in model.reg_image_ids()}
    with pycolmap.Database.open(database) as opened:
        ids = [image.image_id for image in opened.read_all_images() if image.name in names]
        found = {image_id: np.zeros(opened.num_keypoints_for_image(image_id), int) for image_id in ids}
        for key, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            matches = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
            pair = pycolmap.pair_id_to_image_pair(key)
            if found.keys() >= set(pair):
                for image_id, features in zip(pair, matches.T, strict=True):
                    found[image_id][features] += 1
    again = sum(int((each >= FOUND_AGAIN).sum()) for each in found.values())
    return model.compute_num_observations() / max(again, 1)


def _pairs_of_model(model: pycolmap.Reconstruction, names: Sequence[tuple[str, str]]) -> Iterator[Pair]:
    images = {model.image(image_id).name: model.image(image_id) for image_id in model.reg_image_ids()}
    seen = {
        name: {point.point3D_id: point.xy for point in image.get_observation_points2D()}
        for name, image in images.items()
    }
    for one, other in names:
        if one in images and other in images and images[one].camera_id == images[other].camera_id:
            shared = seen[one].keys() & seen[other].keys()
            if len(shared) >= MIN_MATCHES:
                camera = model.camera(images[one].camera_id)
                yield _pair(camera, *(np.array([seen[name][point] for point in shared]) for name in (one, other)))


def _pairs_of_matches(database: Path) -> Iterator[Pair]:
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        for key, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            one, other = pycolmap.pair_id_to_image_pair(key)
            same = images[one].camera_id == images[other].camera_id
            if same and len(geometry.inlier_matches) >= MIN_MATCHES:
                matched = zip((one, other), geometry.inlier_matches.T, strict=True)
                places = [opened.read_keypoints(image_id)[features, :2] for image_id, features in matched]
                yield _pair(cameras[images[one].camera_id], *places)


def _pair(camera: pycolmap.Camera, *places: np.ndarray) -> Pair:
    middle = np.array([camera.width, camera.height]) / 2
    return Pair(*((each - middle) / max(camera.width, camera.height) for each in places))
