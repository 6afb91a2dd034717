"""SIFT features of a capture's views, and their matches. Part of the process of `sfm_process`."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import pycolmap

from msdgs_train.capture.sfm_process import PosesJob
from msdgs_train.capture.sfm_report import report

T = TypeVar("T")

CAMERA_MODEL = "SIMPLE_RADIAL"
BACKGROUND_PEAK = 0.002
"""Least contrast of features of a background, a third of COLMAP's: a median of frames has little noise, and there is
but one view of each camera."""
MAX_FEATURES, BACKGROUND_FEATURES = 2000, 8192
"""Of an image, and of a background; the largest ones. With 4,000, the centers of 48 frames of 1024 pixels are off by
0.02 % of their extent instead of 0.04 % (median), in twice the time."""
BATCH = 16
"""Images, or hundreds of pairs, between two reports of progress."""
TOLERANCE, MIN_TOLERANCE = 1 / 700, 1.0
"""Pixels of error that a match and a point may have: per pixel of the long side, and at least. COLMAP's are four
pixels, which in a small image is the motion of an object between two frames."""
MANY, MIN_TOLERANCE_OF_MANY = 50, 0.5
"""Images that are so many that motion between neighbors is small, and their least tolerance: with one pixel, 300 frames
of 320 pixels before a large moving poster are off by up to 2.8°, with half a pixel by 0.13°. Few images have too few
matches for it."""


def extract(job: PosesJob, database: Path) -> None:
    """Write the cameras and SIFT features of the images that the model is made of."""
    _extract(job, database, [camera.names for camera in job.cameras])


def extract_others(job: PosesJob, database: Path) -> None:
    """Write the features of the other images."""
    _extract(job, database, [camera.others for camera in job.cameras])


def _extract(job: PosesJob, database: Path, names_of_cameras: Sequence[Sequence[str]]) -> None:
    total, done = sum(map(len, names_of_cameras)), 0
    for camera, all_names in zip(job.cameras, names_of_cameras, strict=True):
        options = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
        reader = pycolmap.ImageReaderOptions(camera_model=CAMERA_MODEL)
        options.sift.max_num_features = MAX_FEATURES
        if camera.frames is not None:
            options.sift.max_num_features, options.sift.peak_threshold = BACKGROUND_FEATURES, BACKGROUND_PEAK
        reader.existing_camera_id = _camera_of(database, camera.names)
        for names in _batches(all_names, BATCH):
            report("features", done, total)
            mode = pycolmap.CameraMode.SINGLE
            pycolmap.extract_features(database, Path(camera.folder), list(names), mode, reader, options)
            if reader.existing_camera_id < 0:
                reader.existing_camera_id = _camera_of(database, camera.names)
            done += len(names)
    report("features", total, total)


def match(job: PosesJob, database: Path, all_pairs: Sequence[tuple[str, str]]) -> None:
    """Match pairs of images and write their two-view geometries."""
    options = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    options.guided_matching = only_fixed(job)
    geometry = geometry_options(job, database)
    chosen = Path(job.workspace) / "pairs.txt"
    done = 0
    for pairs in _batches(all_pairs, 100):
        report("matching", done, len(all_pairs))
        chosen.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions(match_list_path=chosen)
        pycolmap.match_image_pairs(database, options, pairing, geometry)
        done += len(pairs)
    chosen.unlink(missing_ok=True)
    report("matching", done, done)


def geometry_options(job: PosesJob, database: Path) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.ransac.max_error = tolerance_of(database)
    return options


def tolerance_of(database: Path) -> float:
    with pycolmap.Database.open(database) as opened:
        sides = [max(camera.width, camera.height) for camera in opened.read_all_cameras()]
        least = MIN_TOLERANCE if opened.num_images() < MANY else MIN_TOLERANCE_OF_MANY
    return max(least, TOLERANCE * max(sides))


def only_fixed(job: PosesJob) -> bool:
    return all(camera.frames is not None for camera in job.cameras)


def _camera_of(database: Path, names: Sequence[str]) -> int:
    """The camera of the first of these images that could be read; -1 if none could."""
    with pycolmap.Database.open(database) as opened:
        images = (opened.read_image_with_name(name) for name in names)
        return next((image.camera_id for image in images if image is not None), -1)


def _batches(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    return (items[first : first + size] for first in range(0, len(items), size))
