"""Times for images that another program took from a video: each is found in the video by its content.

Images follow one another in the video as their names do. They may be smaller, encoded again, and undistorted, which
crops them: the crop that fits best is the same for all. An image of a wide angle that was undistorted may get the time
of the neighboring frame.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from msdgs_serve.scene import InvalidInput
from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.image_source import ENDINGS, read_image
from msdgs_train.capture.pictures import fitted
from msdgs_train.capture.video_source import VideoSource
from msdgs_train.datasets.colmap.loader import IMAGES, SPARSE
from msdgs_train.datasets.common.images import EXTENSIONS
from msdgs_train.datasets.common.name_fields import natural_order
from msdgs_train.datasets.common.paths import find_file
from msdgs_train.datasets.common.readers import read_json
from msdgs_train.datasets.common.times_file import write_times
from msdgs_train.datasets.common.transforms import entries_of, file_path
from msdgs_train.datasets.nerfstudio import TRANSFORMS_FILE

STORED, COMPARED = 96, 48
"""Pixels of the long side of a frame in memory, and of pictures that are compared."""
CROPS = (1.0, 0.97, 0.94, 0.91, 0.88, 0.85, 0.82, 1.03, 1.06)
"""Parts of a frame's sides that an image may show; above 1, the image has borders."""
CROP_GAIN = 0.005
"""Correlation that a crop must gain to be believed."""
MIN_CORRELATION = 0.9
"""Of an image with its frame; those of another video have less."""


def times_from(video: Path, folder: Path) -> dict[str, float]:
    """Write `times.json` of a dataset in nerfstudio's or COLMAP's layout, whose images are from `video`.

    Returns the seconds after the video's first frame, by the images' paths relative to the folder. Raises
    `CaptureFailed` if one isn't in the video, `DatasetInvalid`, `InvalidInput` and `WriteFailed`.
    """
    files = dataset_images(folder)
    source = VideoSource(video, STORED)
    seconds, frames = [], []
    for picture in source.pictures():
        seconds.append(picture.time)
        frames.append(picture.grey)
    if len(files) > len(frames):
        raise CaptureFailed(folder, f"has {len(files)} images, but {video.name} only {len(frames)} frames")
    matched, correlations = match([_grey(file) for file in files], frames)
    names = [Path(os.path.relpath(file, folder)).as_posix() for file in files]
    worst = int(correlations.argmin())
    if correlations[worst] < MIN_CORRELATION:
        raise CaptureFailed(
            folder / names[worst],
            f"isn't a frame of {video.name}, or the images are in another order: the most similar frame there, at "
            f"{seconds[matched[worst]]:.2f} s, has a correlation of {correlations[worst]:.2f} with it, but "
            f"{MIN_CORRELATION} is required. Give the video that the images were taken from",
        )
    times = {name: round(seconds[frame], 6) for name, frame in zip(names, matched, strict=True)}
    write_times(folder, times)
    return times


def dataset_images(folder: Path) -> list[Path]:
    """The images of a dataset in nerfstudio's or COLMAP's layout, in the natural order of their names."""
    transforms = folder / TRANSFORMS_FILE
    if transforms.is_file():
        entries = entries_of(read_json(transforms))
        if any("time" in entry.values for entry in entries):
            raise CaptureFailed(transforms, "has times of its own: remove `time` from its frames to replace them")
        found = [(entry, find_file(folder, file_path(entry), EXTENSIONS)) for entry in entries]
        for entry, file in found:
            if file is None:
                raise entry.invalid("file_path", f"names {file_path(entry)}, but there is no such file")
        files = {file for _, file in found if file is not None}
    elif (folder / SPARSE).is_dir():
        shown = (file for file in (folder / IMAGES).rglob("*") if not file.name.startswith("."))
        files = {file for file in shown if file.suffix.lower() in ENDINGS}
    else:
        raise InvalidInput("folder", f"a dataset with {TRANSFORMS_FILE} or {SPARSE}", folder)
    if not files:
        raise CaptureFailed(folder / IMAGES, "has no images in it")
    return sorted(files, key=lambda file: natural_order(file.as_posix()))


def match(images: Sequence[np.ndarray], frames: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The frame of each image, int [N] and increasing, and their correlations [N], from uint8 [H, W] pictures."""
    height, width = frames[0].shape
    scale = min(1.0, COMPARED / max(height, width))
    size = max(2, round(width * scale)), max(2, round(height * scale))
    known = np.array([_normalized(_cropped(image, 1.0, size)) for image in images])
    best: tuple[np.ndarray, np.ndarray] | None = None
    for crop in CROPS:
        correlations = known @ np.array([_normalized(_cropped(frame, crop, size)) for frame in frames]).T
        order = _increasing(correlations)
        found = correlations[np.arange(len(images)), order]
        if best is None or found.mean() > best[1].mean() + CROP_GAIN:
            best = order, found
    assert best is not None
    return best


def _increasing(correlations: np.ndarray) -> np.ndarray:
    """The increasing columns of [N, M], one a row, whose sum is largest."""
    rows, columns = correlations.shape
    sums, chosen = correlations[0].astype(np.float64), np.zeros((rows, columns), np.int32)
    for row in range(1, rows):
        largest = np.maximum.accumulate(sums)
        is_new = np.concatenate([[True], sums[1:] > largest[:-1]])
        before = np.maximum.accumulate(np.where(is_new, np.arange(columns), 0))
        chosen[row, 1:] = before[:-1]
        sums = np.concatenate([[-np.inf], largest[:-1]]) + correlations[row]
    order = [int(sums.argmax())]
    for row in range(rows - 1, 0, -1):
        order.append(int(chosen[row, order[-1]]))
    return np.array(order[::-1])


def _grey(file: Path) -> np.ndarray:
    import cv2

    pixels = read_image(file)
    height, width, _ = pixels.shape
    return cv2.cvtColor(
        cv2.resize(pixels, fitted(width, height, STORED), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY
    )


def _cropped(grey: np.ndarray, crop: float, size: tuple[int, int]) -> np.ndarray:
    """The middle of uint8 [H, W], this part of its sides, as float32 of another size (width, height)."""
    import cv2

    if crop == 1:
        return cv2.resize(grey.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    (height, width), (new_width, new_height) = grey.shape, size
    across, down = crop * width / new_width, crop * height / new_height
    corner = (1 - crop) / 2 * width + across / 2 - 0.5, (1 - crop) / 2 * height + down / 2 - 0.5
    matrix = np.array([[across, 0, corner[0]], [0, down, corner[1]]])
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.3 * across)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(smooth, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _normalized(values: np.ndarray) -> np.ndarray:
    """Flattened, with mean 0 and norm 1 as weighted by a window, since undistortion changes the middle least; zeros for
    a picture of one color."""
    y, x = (np.linspace(-1, 1, length) for length in values.shape)
    window = np.exp(-2 * (y[:, None] ** 2 + x**2))
    centered = (np.sqrt(window) * (values - np.average(values, weights=window))).ravel()
    return centered / max(float(np.linalg.norm(centered)), 1e-6)
