"""Models of matched views by COLMAP's mappers, and their refinement. Part of the process of `sfm_process`."""

import shutil
from pathlib import Path

import pycolmap

from msdgs_train.capture.sfm_matching import geometry_options, only_fixed, tolerance_of
from msdgs_train.capture.sfm_process import PosesJob
from msdgs_train.capture.sfm_report import report
from msdgs_train.capture.sfm_static import write_static

Models = tuple[list[pycolmap.Reconstruction], str]
"""The models, the largest first, and the mapper that made them."""

STATIC = "static.db"
MAX_EXTRA_PARAMETER = 0.5
"""Of the distortion; models with more are wrong ones of few images."""
FOCALS = (0.3, 6.0)
"""Focal lengths in long sides of the image: views of 118° to 10°."""
MIN_MODEL = 3
"""Images of the smallest model."""
ENOUGH = 0.95
"""Part of the images in one model below which the global mapper is tried, too. With fixed cameras only it always is:
the incremental one is often wrong where each camera has one view."""
REFINEMENTS, ITERATIONS = 3, 30
"""Of a model, and of the bundle adjustment in each."""
GROWTH, GLOBAL_REFINEMENTS = 1.3, 2
"""Of a model between two adjustments of all, and of these. COLMAP's 1.1 and 5 take 1.6 times as long for 48 frames, and
more for longer clips; poses after `refined` are as good."""
LOSS_SCALE = 0.25
"""Of Cauchy's loss, in tolerances: points at rest are ten times closer, and some that move are still among them."""
MIN_ANGLE = 1.5
"""Degrees between the rays of a point that is kept, as COLMAP has it."""


def mapped(job: PosesJob, database: Path) -> Models:
    """The models of the views.

    Of moving cameras, the matches are those on what stands still, of a database `STATIC` beside the given one, and if
    these don't suffice, all. The mapper is the incremental one, or the global one if that makes a larger model.
    """
    total, scratch = sum(len(camera.names) for camera in job.cameras), database.parent / "models"
    static = database.with_name(STATIC)
    models, method = [], ""
    if not (only_fixed(job) or job.all_matches):
        report("what stands still", 0, total)
        write_static(database, static, job.cameras, geometry_options(job, database))
        models, method = _mapped_by(job, static, scratch, total)
    if not models or _size(models[0])[0] < ENOUGH * total:
        others, by = _mapped_by(job, database, scratch, total, try_global=only_fixed(job))
        if others and (not models or _size(others[0]) > _size(models[0])):
            models, method = others, by
    report("mapping", total, total)
    return models, method


def _mapped_by(job: PosesJob, database: Path, scratch: Path, total: int, *, try_global: bool = False) -> Models:
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
    """The model with points of all matches that agree with its poses, and poses, lens and points adjusted to them."""
    tolerance, scratch = tolerance_of(database), database.parent / "points"
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
    options = _incremental_options(job, tolerance_of(database))
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
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GROWTH
    options.ba_global_max_refinements, options.ba_global_max_num_iterations = GLOBAL_REFINEMENTS, ITERATIONS
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
