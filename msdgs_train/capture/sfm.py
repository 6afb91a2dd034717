"""The process of `sfm_process`: SIFT features, matching and mapping with pycolmap.

It reads a job as a line of JSON from its standard input, writes lines of stage, done and total to its standard output,
and ends when its input does, as it then has lost its parent.
"""

import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from msdgs_train.capture.sfm_agreement import agreement, motion_beyond_rotation
from msdgs_train.capture.sfm_fixed import of_fixed_cameras
from msdgs_train.capture.sfm_mapping import STATIC, mapped, refined
from msdgs_train.capture.sfm_matching import extract, match, only_fixed
from msdgs_train.capture.sfm_process import CameraViews, PosesJob, UndistortedJob
from msdgs_train.capture.sfm_registration import register_others
from msdgs_train.capture.sfm_report import start_reports
from msdgs_train.capture.sparse_model import GEOMETRY, Summary

WARNINGS_ONLY = 2


def main() -> None:
    """Do the job of the first line of the standard input."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    pycolmap.logging.minloglevel = WARNINGS_ONLY
    job: dict[str, Any] = json.loads(sys.stdin.readline())
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    if job["kind"] == "poses":
        cameras = tuple(CameraViews(**camera) for camera in job["cameras"])
        find(PosesJob(**{**job, "cameras": cameras}))
    else:
        write_undistorted(UndistortedJob(**job))


def find(job: PosesJob) -> None:
    """Write the largest model to `sparse` and what is needed of it to `geometry.npz` in the workspace.

    Without any model, the file is written without images.
    """
    workspace = Path(job.workspace)
    database = workspace / "database.db"
    database.unlink(missing_ok=True)
    pycolmap.set_random_seed(job.seed)
    extract(job, database)
    match(job, database, job.pairs)
    models, method = mapped(job, database)
    if only_fixed(job):
        models, method = of_fixed_cameras(job, database, (models, method))
    elif models:
        models[0] = refined(models[0], job, database)
    largest = models[0] if models else pycolmap.Reconstruction()
    static = workspace / STATIC
    turned = motion_beyond_rotation(largest, job.pairs, static if static.exists() else database)
    agreeing = agreement(largest, database)
    _color(largest, job.cameras)
    register_others(largest, job, database)
    largest.update_point_3d_errors()
    _spread_to_frames(largest, job.cameras)
    sparse = workspace / "sparse"
    shutil.rmtree(sparse, ignore_errors=True)
    sparse.mkdir()
    largest.write(sparse)
    sizes = [model.num_reg_images() for model in models]
    summary(largest, method, sizes[1:], turned, agreeing).save(workspace / GEOMETRY)
    for each in workspace.glob("*.db"):
        each.unlink()


def _color(model: pycolmap.Reconstruction, cameras: Sequence[CameraViews]) -> None:
    """Give the points the colors of the images that see them."""
    folders = {name: camera.folder for camera in cameras for name in camera.names}
    for image_id in model.reg_image_ids():
        model.extract_colors_for_image(image_id, folders[model.image(image_id).name])


def _spread_to_frames(model: pycolmap.Reconstruction, cameras: Sequence[CameraViews]) -> None:
    """Replace the view of each fixed camera by its frames, all with its pose."""
    for camera in cameras:
        image = model.find_image_with_name(camera.names[0])
        if camera.frames is None or image is None or not image.has_pose:
            continue
        image.name = camera.frames[0]
        for name in camera.frames[1:]:
            number = max(model.images) + 1
            copy = pycolmap.Image(name=name, camera_id=image.camera_id, image_id=number)
            model.add_image_with_trivial_frame(copy, image.cam_from_world())


def summary(
    model: pycolmap.Reconstruction, method: str, others: list[int], beyond_rotation: float, agreement: float
) -> Summary:
    """What `sparse_model` keeps of a model."""
    images = sorted((model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name)
    ids = sorted(model.points3D)
    rows = {point_id: row for row, point_id in enumerate(ids)}
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    seen: list[tuple[int, int]] = []
    for index, image in enumerate(images):
        poses[index, :3] = image.cam_from_world().inverse().matrix()
        seen += [(index, rows[point.point3D_id]) for point in image.get_observation_points2D()]
    cameras = [model.camera(image.camera_id) for image in images]
    points = [model.point3D(point_id) for point_id in ids]
    return Summary(
        names=np.array([image.name for image in images], dtype=str),
        camera_to_world=poses,
        intrinsics=np.array([camera.params for camera in cameras], float).reshape(-1, 4),
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        colors=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        observations=np.array(seen, np.int64).reshape(-1, 2),
        error=model.compute_mean_reprojection_error() if points else 0.0,
        method=method,
        others=tuple(others),
        beyond_rotation=beyond_rotation,
        agreement=agreement,
    )


def write_undistorted(job: UndistortedJob) -> None:
    """Write a model with pinhole cameras whose images have no black borders, and observations moved accordingly."""
    model = pycolmap.Reconstruction(job.model)
    options = pycolmap.UndistortCameraOptions(blank_pixels=0.0)
    pinholes = {key: pycolmap.undistort_camera(options, camera) for key, camera in model.cameras.items()}
    for image in model.images.values():
        camera, pinhole = model.camera(image.camera_id), pinholes[image.camera_id]
        for point in image.points2D:
            local = camera.cam_from_img(point.xy)
            if local is not None:
                point.xy = pinhole.img_from_cam(np.append(local, 1.0))
    for key, pinhole in pinholes.items():
        camera = model.camera(key)
        camera.model, camera.params = pinhole.model, list(pinhole.params)
        camera.width, camera.height = pinhole.width, pinhole.height
    Path(job.out).mkdir(parents=True, exist_ok=True)
    model.write(job.out)


def _exit_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    start_reports()
    main()
