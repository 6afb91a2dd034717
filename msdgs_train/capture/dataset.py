"""The dataset of a capture: undistorted images, a COLMAP model of pinhole cameras, and times.

```
DATA/images/00012.png            DATA/sparse/0/{cameras,images,points3D}.bin
DATA/motion_masks/00012.png      DATA/times.json
```

White pixels of `motion_masks` move. COLMAP's folder `masks` has another meaning: its black pixels don't count in the
loss, and what moves must count.
"""

import shutil
from pathlib import Path

import cv2
import numpy as np

from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.image_files import read_color, read_gray, write_image
from msdgs_train.capture.poses import Poses
from msdgs_train.capture.progress import Progress
from msdgs_train.capture.sfm_process import UndistortedJob, run_sfm
from msdgs_train.datasets.colmap.binary import read_cameras, read_images
from msdgs_train.datasets.colmap.loader import IMAGES, SPARSE
from msdgs_train.datasets.colmap.model import ModelCamera
from msdgs_train.datasets.common.times_file import write_times

MOTION_MASKS = "motion_masks"

Maps = tuple[np.ndarray, np.ndarray]


def write_dataset(
    images: Path,
    frames: FrameSet,
    poses: Poses,
    masks: Path | None,
    out: Path,
    *,
    progress: Progress | None = None,
) -> None:
    """Write the frames that have a pose, and their masks, to the folder `out`; it loses what such a call wrote before.

    `images` and `masks` are the folders of the frames and of masks of the same names, white where something moves.
    `progress` is called with the stage, what is done and the total. Raises `CaptureFailed` if no frame has a pose.
    """
    if not poses.registered:
        raise CaptureFailed(images, "no frame has a pose, so that there is nothing to write")
    for folder in (IMAGES, SPARSE, MOTION_MASKS):
        shutil.rmtree(out / folder, ignore_errors=True)
    model = out.absolute() / SPARSE / "0"
    run_sfm(UndistortedJob(str(poses.model.absolute()), str(model)), images)
    lenses, pinholes = dict(read_cameras(poses.model / "cameras.bin")), dict(read_cameras(model / "cameras.bin"))
    maps = {key: undistortion(lenses[key], pinhole) for key, pinhole in pinholes.items()}
    stored = sorted(read_images(model / "images.bin"), key=lambda image: image.name)
    for done, image in enumerate(stored):
        if progress is not None:
            progress("undistorting", done, len(stored))
        horizontal, vertical = maps[image.camera_id]
        color = cv2.remap(
            read_color(images / image.name), horizontal, vertical, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE
        )
        write_image(out / IMAGES / image.name, color)
        if masks is not None:
            mask = cv2.remap(read_gray(masks / image.name), horizontal, vertical, cv2.INTER_NEAREST)
            write_image(out / MOTION_MASKS / image.name, mask)
    times = {frame.name: frame.time for frame in frames.frames}
    write_times(out, {f"{IMAGES}/{image.name}": times[image.name] for image in stored})
    if progress is not None:
        progress("undistorting", len(stored), len(stored))


def undistortion(lens: ModelCamera, pinhole: ModelCamera) -> Maps:
    """[H, W] float32 column and row in the distorted image of each pixel of the pinhole image, as `cv2.remap` takes."""
    values = pinhole.values
    x = (np.arange(pinhole.width) + 0.5 - values["cx"]) / values["fx"]
    y = (np.arange(pinhole.height) + 0.5 - values["cy"]) / values["fy"]
    x, y = np.meshgrid(x, y)
    focal, cx, cy, k1 = (lens.values[key] for key in ("f", "cx", "cy", "k1"))
    radial = focal * (1 + k1 * (x * x + y * y))
    return (radial * x + cx - 0.5).astype(np.float32), (radial * y + cy - 0.5).astype(np.float32)
