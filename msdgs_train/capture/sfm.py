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
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pycolmap

from msdgs_train.capture.rotation import Pair, beyond_rotation
from msdgs_train.capture.sfm_process import CameraViews, PosesJob, UndistortedJob
from msdgs_train.capture.sfm_static import write_static
from msdgs_train.capture.sparse_model import GEOMETRY, Summary

T = TypeVar("T")

CAMERA_MODEL = "SIMPLE_RADIAL"
MAX_EXTRA_PARAMETER = 0.5
"""Of the distortion; models with more are wrong ones of few images."""
BACKGROUND_PEAK = 0.002
"""Least contrast of features of a background, a third of COLMAP's: a median of frames has little noise, and there is
but one view of each camera."""
FOCALS = (0.3, 6.0)
"""Focal lengths in long sides of the image: views of 118° to 10°."""
MIN_MODEL = 3
"""Images of the smallest model."""
MIN_MATCHES = 30
"""Of a pair of images that tells whether the camera only turned."""
ENOUGH = 0.95
"""Part of the images in one model below which the global mapper is tried, too. With fixed cameras only it always is:
the incremental one is often wrong where each camera has one view."""
BATCH = 16
"""Images, or hundreds of pairs, between two reports of progress."""
WARNINGS_ONLY = 2
TOLERANCE = 1 / 700
"""Pixels of error, per pixel of the long side, that a match and a point may have; at least one. COLMAP's are four
pixels, which in a small image is the motion of an object between two frames."""
REFINEMENTS, ITERATIONS = 3, 30
"""Of a model, and of the bundle adjustment in each."""
LOSS_SCALE = 0.25
"""Of Cauchy's loss, in tolerances: points at rest are ten times closer, and some that move are still among them."""
MIN_ANGLE = 1.5
"""Degrees between the rays of a point that is kept, as COLMAP has it."""


def main() -> None:
    """Do the job of the first line of the standard input."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    pycolmap.logging.minloglevel = WARNINGS_ONLY
    job: dict[str, Any] = json.loads(sys.stdin.readline())
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    if job["kind"] == "poses":
        cameras = tuple(CameraViews(**{**camera, "names": tuple(camera["names"])}) for camera in job["cameras"])
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
    match(job, database)
    static = workspace / "static.db"
    models, method = mapped(job, database, static)
    largest = models[0] if models else pycolmap.Reconstruction()
    if models and not _only_fixed(job):
        largest = refined(largest, job, database)
    _color(largest, job.cameras)
    _spread_to_frames(largest, job.cameras)
    sparse = workspace / "sparse"
    shutil.rmtree(sparse, ignore_errors=True)
    sparse.mkdir()
    largest.write(sparse)
    sizes = [model.num_reg_images() for model in models]
    turned = _beyond_rotation(static if static.exists() else database)
    summary(largest, method, sizes[1:], turned).save(workspace / GEOMETRY)
    for each in (database, static):
        each.unlink(missing_ok=True)


def extract(job: PosesJob, database: Path) -> None:
    """Write the cameras and SIFT features of all views."""
    total, done = sum(len(camera.names) for camera in job.cameras), 0
    for camera in job.cameras:
        options = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
        reader = pycolmap.ImageReaderOptions(camera_model=CAMERA_MODEL)
        if camera.frames is not None:
            options.sift.peak_threshold = BACKGROUND_PEAK
        for names in _batches(camera.names, BATCH):
            report("features", done, total)
            mode = pycolmap.CameraMode.SINGLE
            pycolmap.extract_features(database, Path(camera.folder), list(names), mode, reader, options)
            if reader.existing_camera_id < 0:
                reader.existing_camera_id = _camera_of(database, names[0])
            done += len(names)
    report("features", total, total)


def match(job: PosesJob, database: Path) -> None:
    """Match the pairs and write their two-view geometries."""
    options = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    options.guided_matching = _only_fixed(job)
    geometry = _geometry_options(job, database)
    chosen = Path(job.workspace) / "pairs.txt"
    done = 0
    for pairs in _batches(job.pairs, 100):
        report("matching", done, len(job.pairs))
        chosen.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions(match_list_path=chosen)
        pycolmap.match_image_pairs(database, options, pairing, geometry)
        done += len(pairs)
    chosen.unlink(missing_ok=True)
    report("matching", done, done)


def mapped(job: PosesJob, database: Path, static: Path) -> tuple[list[pycolmap.Reconstruction], str]:
    """The models, the largest first, and the mapper that made them.

    Of moving cameras, the matches are those on what stands still, of a database that is written to `static`, and if
    these don't suffice, all. The mapper is the incremental one, or the global one if that makes a larger model.
    """
    total, scratch = sum(len(camera.names) for camera in job.cameras), database.parent / "models"
    models, method = [], ""
    if not (_only_fixed(job) or job.all_matches):
        report("what stands still", 0, total)
        write_static(database, static, job.cameras, _geometry_options(job, database))
        models, method = _mapped_by(job, static, scratch, total)
    if not models or _size(models[0])[0] < ENOUGH * total:
        others, by = _mapped_by(job, database, scratch, total, try_global=_only_fixed(job))
        if others and (not models or _size(others[0]) > _size(models[0])):
            models, method = others, by
    report("mapping", total, total)
    return models, method


def _mapped_by(
    job: PosesJob, database: Path, scratch: Path, total: int, *, try_global: bool = False
) -> tuple[list[pycolmap.Reconstruction], str]:
    """The models of the incremental mapper, or those of the global one if its largest is larger."""
    models, method = _incremental(job, database, scratch, total), "incremental"
    size = _size(models[0])[0] if models else 0
    if total > 1 and (size < ENOUGH * total or try_global):
        report("mapping again", 0, total)
        of_global = _global(job, database, scratch)
        if of_global and (not models or _size(of_global[0]) > _size(models[0])):
            models, method = of_global, "global"
    shutil.rmtree(scratch, ignore_errors=True)
    return models, method


def refined(model: pycolmap.Reconstruction, job: PosesJob, database: Path) -> pycolmap.Reconstruction:
    """The model with points of all matches that agree with its poses, and poses, lens and points adjusted to them.

    Not for fixed cameras only: each has one view, and its own lens is free to follow a few points more.
    """
    tolerance, scratch = _tolerance(database), database.parent / "points"
    options = _incremental_options(job, tolerance)
    adjustment = pycolmap.BundleAdjustmentOptions(print_summary=False)
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = LOSS_SCALE * tolerance
    adjustment.ceres.solver_options.max_num_iterations = ITERATIONS
    adjustment.ceres.solver_options.num_threads = job.threads
    for number in range(REFINEMENTS):
        report("refining", number, REFINEMENTS)
        scratch.mkdir(exist_ok=True)
        model = pycolmap.triangulate_points(model, database, Path(job.cameras[0].folder), scratch, options=options)
        pycolmap.bundle_adjustment(model, adjustment)
    pycolmap.ObservationManager(model).filter_all_points3D(tolerance, MIN_ANGLE)
    shutil.rmtree(scratch, ignore_errors=True)
    return model


def _incremental(job: PosesJob, database: Path, scratch: Path, total: int) -> list[pycolmap.Reconstruction]:
    options = _incremental_options(job, _tolerance(database))
    added = 0

    def count() -> None:
        nonlocal added
        added = min(added + 1, total)
        report("mapping", added, total)

    scratch.mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(
        database, scratch, scratch, options, initial_image_pair_callback=count, next_image_callback=count
    )
    return _sorted(models)


def _incremental_options(job: PosesJob, tolerance: float) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads, random_seed=job.seed, min_model_size=MIN_MODEL, extract_colors=False
    )
    options.max_extra_param = MAX_EXTRA_PARAMETER
    options.mapper.random_seed = options.triangulation.random_seed = job.seed
    options.mapper.num_threads = job.threads
    options.mapper.init_max_error = options.mapper.filter_max_reproj_error = tolerance
    options.mapper.abs_pose_max_error = 3 * tolerance
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = tolerance
    return options


def _global(job: PosesJob, database: Path, scratch: Path) -> list[pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions(num_threads=job.threads, random_seed=job.seed, min_model_size=MIN_MODEL)
    options.mapper.random_seed = job.seed
    options.mapper.num_threads = job.threads
    options.mapper.rotation_averaging.random_seed = job.seed
    options.mapper.global_positioning.random_seed = job.seed
    options.mapper.retriangulation.random_seed = job.seed
    options.mapper.bundle_adjustment.ceres.solver_options.num_threads = job.threads
    return _sorted(pycolmap.global_mapping(database, scratch, scratch, options))


def _sorted(models: dict[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    for model in models.values():
        _drop_impossible(model)
    return sorted((model for model in models.values() if model.num_reg_images() > 1), key=_size, reverse=True)


def _size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    """Images and observations."""
    return model.num_reg_images(), model.compute_num_observations()


def _drop_impossible(model: pycolmap.Reconstruction) -> None:
    """Take the poses of images whose camera no lens has: the mapper lets a single view of a camera end there."""
    for image_id in list(model.reg_image_ids()):
        image = model.image(image_id)
        camera = model.camera(image.camera_id)
        focal = camera.mean_focal_length() / max(camera.width, camera.height)
        if not (FOCALS[0] < focal < FOCALS[1] and abs(camera.params[-1]) < MAX_EXTRA_PARAMETER):
            model.deregister_frame(image.frame_id)


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


def summary(model: pycolmap.Reconstruction, method: str, others: list[int], beyond_rotation: float) -> Summary:
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


def _beyond_rotation(database: Path) -> float:
    """Displacement that no rotation of the camera explains, of matches of pairs of one camera's images, in pixels."""
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        pairs, long_side = [], 1
        for key, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            one, other = pycolmap.pair_id_to_image_pair(key)
            camera = cameras[images[one].camera_id]
            if images[one].camera_id != images[other].camera_id or len(geometry.inlier_matches) < MIN_MATCHES:
                continue
            long_side = max(camera.width, camera.height)
            middle = np.array([camera.width, camera.height]) / 2
            places = [
                (opened.read_keypoints(image)[rows, :2] - middle) / long_side
                for image, rows in zip((one, other), geometry.inlier_matches.T, strict=True)
            ]
            pairs.append(Pair(*places))
    return long_side * beyond_rotation(pairs)


def _only_fixed(job: PosesJob) -> bool:
    return all(camera.frames is not None for camera in job.cameras)


def _geometry_options(job: PosesJob, database: Path) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.ransac.max_error = _tolerance(database)
    return options


def _tolerance(database: Path) -> float:
    with pycolmap.Database.open(database) as opened:
        return max(1.0, TOLERANCE * max(max(camera.width, camera.height) for camera in opened.read_all_cameras()))


def _camera_of(database: Path, name: str) -> int:
    with pycolmap.Database.open(database) as opened:
        image = opened.read_image_with_name(name)
    return image.camera_id if image is not None else -1


def _batches(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    return (items[first : first + size] for first in range(0, len(items), size))


def report(stage: str, done: int, total: int) -> None:
    """Write a line of progress."""
    _reports.write(json.dumps([stage, done, total]) + "\n")
    _reports.flush()


def _exit_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    _reports = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # libraries print there
    main()
