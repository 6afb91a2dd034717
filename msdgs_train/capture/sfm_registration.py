"""Poses of images that a model wasn't made of, from its points. Part of the process of `sfm_process`."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from msdgs_train.capture.sfm_matching import extract_others, match, tolerance_of
from msdgs_train.capture.sfm_process import PosesJob
from msdgs_train.capture.sfm_report import report

MIN_INLIERS, MIN_INLIER_PART = 30, 0.25
"""Least inliers of a pose, and their least share of its points; defaults of COLMAP's mapper."""


def register_others(model: pycolmap.Reconstruction, job: PosesJob, database: Path) -> None:
    """Add the other images of the job whose poses agree with points that the images matched with them see."""
    total = sum(len(camera.others) for camera in job.cameras)
    if total == 0 or model.num_points3D() == 0:
        return
    extract_others(job, database)
    match(job, database, job.other_pairs)
    partners = defaultdict(list)
    for name, key in job.other_pairs:
        partners[name].append(key)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = tolerance_of(database), job.seed
    with pycolmap.Database.open(database) as opened:
        for done, (name, keys) in enumerate(partners.items()):
            report("other frames", done, total)
            _register(model, opened, name, keys, options)
    report("other frames", total, total)


def _register(
    model: pycolmap.Reconstruction,
    database: pycolmap.Database,
    name: str,
    keys: Sequence[str],
    options: pycolmap.AbsolutePoseEstimationOptions,
) -> None:
    image = database.read_image_with_name(name)
    if image is None or not model.exists_camera(image.camera_id):
        return
    places = database.read_keypoints(image.image_id)[:, :2].astype(float)
    seen = dict(pair for key in keys for pair in _seen(model, database, image.image_id, key))
    features, points = list(seen), list(seen.values())
    if len(points) < MIN_INLIERS:
        return
    positions = np.array([model.point3D(point).xyz for point in points])
    camera = model.camera(image.camera_id)
    found = pycolmap.estimate_and_refine_absolute_pose(places[features], positions, camera, options)
    if found is None or found["num_inliers"] < max(MIN_INLIERS, MIN_INLIER_PART * len(points)):
        return
    added = pycolmap.Image(name, places, image.camera_id, image.image_id)
    model.add_image_with_trivial_frame(added, found["cam_from_world"])
    for feature, point, fits in zip(features, points, found["inlier_mask"], strict=True):
        if fits:
            model.add_observation(point, pycolmap.TrackElement(image.image_id, feature))


def _seen(
    model: pycolmap.Reconstruction, database: pycolmap.Database, image_id: int, name: str
) -> Iterator[tuple[int, int]]:
    """Features of an image of the database that match those of the named image of the model, and their points."""
    key = model.find_image_with_name(name)
    if key is None or not key.has_pose:
        return
    matches = database.read_two_view_geometry(image_id, key.image_id).inlier_matches
    for feature, other in np.asarray(matches, np.int64).reshape(-1, 2).tolist():
        point = key.point2D(other)
        if point.has_point3D():
            yield feature, point.point3D_id
