"""The model of cameras that all stand still, of one lens if that suffices. Part of the process of `sfm_process`.

With one view for each camera, its own focal length and distortion hide errors of its pose.
"""

from dataclasses import replace
from pathlib import Path

import pycolmap

from msdgs_train.capture.sfm_mapping import Models, mapped, refined
from msdgs_train.capture.sfm_matching import extract, match
from msdgs_train.capture.sfm_process import CameraViews, PosesJob

ONE_LENS = 1.04
"""Reprojection error of a model with one lens, relative to that with several, up to which it is one. Of equal lenses
it is 1.00 to 1.01, and 1.09 to 1.16 where every second focal length is 10 % longer."""


def of_fixed_cameras(job: PosesJob, database: Path, found: Models) -> Models:
    """The models with the largest one refined, of those `found` with a lens for each camera, or with one for all."""
    models, method = found
    own = [refined(models[0], job, database)] if models else []
    shared_job = _with_one_lens(job, database)
    if shared_job is not None:
        scratch = database.with_name("one_lens.db")
        scratch.unlink(missing_ok=True)
        extract(shared_job, scratch)
        match(shared_job, scratch, shared_job.pairs)
        others, by = mapped(shared_job, scratch)
        if others:
            others[0] = refined(others[0], shared_job, scratch)
            own.append(refined(_with_lenses(others[0], database), job, database))
            if _suffices(others[0], max(own, key=_quality)):
                return others, by
        scratch.unlink()
    return ([max(own, key=_quality), *models[1:]] if own else []), method


def _with_one_lens(job: PosesJob, database: Path) -> PosesJob | None:
    """The job with the views as those of one camera; None if they differ in size, or there is one."""
    with pycolmap.Database.open(database) as opened:
        sizes = {(camera.width, camera.height) for camera in opened.read_all_cameras()}
    if len(sizes) > 1 or len(job.cameras) == 1:
        return None
    names = tuple(name for camera in job.cameras for name in camera.names)
    return replace(job, cameras=(CameraViews(job.cameras[0].folder, names, frames=()),))


def _with_lenses(shared: pycolmap.Reconstruction, database: Path) -> pycolmap.Reconstruction:
    """The poses, and for each camera of the database the shared lens to begin with."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
    for image_id in shared.reg_image_ids():
        view = shared.image(image_id)
        image = images[view.name]
        camera = cameras[image.camera_id]
        camera.params = list(shared.camera(view.camera_id).params)
        model.add_camera_with_trivial_rig(camera)
        copy = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(copy, view.cam_from_world())
    return model


def _suffices(shared: pycolmap.Reconstruction, own: pycolmap.Reconstruction) -> bool:
    errors = [model.compute_mean_reprojection_error() for model in (shared, own)]
    return _quality(shared)[:2] >= _quality(own)[:2] and errors[0] <= ONE_LENS * errors[1]


def _quality(model: pycolmap.Reconstruction) -> tuple[int, bool, float]:
    """Images, whether they see points, which a refinement may remove, and the smallness of the error."""
    return model.num_reg_images(), model.num_points3D() > 0, -model.compute_mean_reprojection_error()
