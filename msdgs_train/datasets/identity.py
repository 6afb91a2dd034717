"""What tells a dataset from others, for a run that continues on the one that it was started with.

It doesn't depend on the folder: a copy of a dataset is the same dataset.
"""

import hashlib
import json
import math
import os
import unicodedata
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_train.datasets.common.distortion import Distortion
from msdgs_train.datasets.common.readers import DatasetInvalid
from msdgs_train.datasets.common.scene_data import SPLITS, Frame, SceneData

PARTS = {
    "images": "number of images",
    "names": "names of images or splits",
    "times": "times",
    "cameras": "cameras",
    "files": "contents of images",
    "masks": "masks",
}
"""The parts of an identity, and what differs for people where one does."""

TAIL = 1 << 14
"""Bytes at the end of a file that stand for its contents, with its size: a PNG ends with a checksum of its pixels, and
a change of a JPEG moves all that follows."""

DECIMALS, DIFFERENCE_DECIMALS = 7, 10
"""Decimals of values relative to a power of ten above them, and of differences relative to one above what was
subtracted: the last of 16 digits of what is computed depend on the machine, and few values may be at an edge."""

SMALLEST = 1e-9  # in place of 0
SLACK = 1e-3
"""Keeps 1 and what is computed as 1 below the same power of ten."""


def identity(scene: SceneData) -> dict[str, Any]:
    """Return the number of images and digests of the other parts. Raises `DatasetInvalid` for a missing image."""
    splits = [(split, frame) for split in SPLITS for frame in scene.splits.get(split, ())]
    frames = [frame for _, frame in splits]
    files = dict.fromkeys(file for frame in frames for file in frame.files)
    masked = [(index, file) for index, frame in enumerate(frames) if (file := frame.mask_path)]
    masks = {file: _contents(file) for file in {file for _, file in masked}}
    return {
        "images": len(frames),
        "names": _digest([[split, unicodedata.normalize("NFC", frame.name)] for split, frame in splits]),
        "times": _digest(_rounded([frame.t for frame in frames])),
        "cameras": _digest(list(_cameras(frames))),
        "files": _digest([_contents(file) for file in files]),
        "masks": _digest([[index, masks[file]] for index, file in masked]),
    }


def differences(stored: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """Return the parts in which two identities differ, in words."""
    return [words for part, words in PARTS.items() if part in stored and stored[part] != found[part]]


def _cameras(frames: list[Frame]) -> Iterator[Any]:
    """Rounded numbers of all cameras; positions relative to the first, which may be far from the origin."""
    cameras = [frame.camera for frame in frames]
    positions = np.array([camera.camera_to_world[:3, 3] for camera in cameras])
    yield _rounded([(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) for camera in cameras])
    yield _rounded([camera.camera_to_world[:3, :3] for camera in cameras])
    yield _rounded(positions[0])
    yield _rounded(positions - positions[0], of=positions)
    yield _rounded([(*frame.camera.distortion, *(frame.distortion or Distortion())) for frame in frames])


def _rounded(values: Any, of: Any = 0.0) -> list[Any]:
    """Numbers, or differences of the numbers `of`, in units of a power of ten, as whole numbers after this power."""
    power = max(_power_above(values) - DECIMALS, _power_above(of) - DIFFERENCE_DECIMALS)
    return [power, (np.array(values, np.float64) / 10.0**power).round().astype(np.int64).tolist()]


def _power_above(values: Any) -> int:
    """The exponent of a power of ten that no number is above; a very small one if all are 0."""
    return math.ceil(math.log10(max(np.abs(values).max(initial=0), SMALLEST)) - SLACK)


def _contents(file: Path) -> list[Any]:
    try:
        with file.open("rb") as opened:
            size = opened.seek(0, os.SEEK_END)
            opened.seek(max(0, size - TAIL))
            return [size, hashlib.sha256(opened.read()).hexdigest()]
    except OSError as error:
        raise DatasetInvalid(file, "image", f"can't be read: {error.strerror}") from None


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]
