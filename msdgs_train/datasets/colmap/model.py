"""The contents of COLMAP's sparse models, binary or text."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_serve.scene.fields import FieldTable
from msdgs_train.datasets.common.readers import DatasetInvalid

PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""Supported camera models and their parameters, in the order of the file."""

MODEL_NAMES = (
    *PARAMETERS,
    *("OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    *("RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM"),
    "EQUIRECTANGULAR",
)
"""Indexed by the model number in binary files."""

COLUMNS = (
    "WIDTH",
    "HEIGHT",
    "QW",
    "QX",
    "QY",
    "QZ",
    "TX",
    "TY",
    "TZ",
    "CAMERA_ID",
    "NAME",
    "X",
    "Y",
    "Z",
    "R",
    "G",
    "B",
)

COLMAP_FIELDS = FieldTable(
    "COLMAP",
    {
        **dict.fromkeys((*PARAMETERS, *COLUMNS, "masks/"), "applied"),
        **dict.fromkeys(MODEL_NAMES[len(PARAMETERS) :], "refused"),
        **dict.fromkeys(("IMAGE_ID", "POINTS2D[]", "POINT3D_ID", "ERROR", "TRACK[]"), "harmless"),
    },
)
"""Camera models and the columns of the three files."""


class ModelCamera(NamedTuple):
    """Intrinsics that images share."""

    width: int
    height: int
    values: dict[str, float]  # by the names in `PARAMETERS`; all but k and p in pixels


class ModelImage(NamedTuple):
    """An image and its pose: x_camera = R(qvec) · x_world + tvec, in OpenCV axes."""

    name: str  # path relative to the folder of images
    camera_id: int
    qvec: np.ndarray  # [4] float64, wxyz, not normalized
    tvec: np.ndarray  # [3] float64


def parameter_names(file: Path, field: str, model: str) -> tuple[str, ...]:
    """Return the parameters of a camera model. Raises `DatasetInvalid` naming file and field if it is unsupported."""
    if model not in PARAMETERS:
        problem = f"is {model}, but only {', '.join(PARAMETERS)} are supported: undistort the images with COLMAP"
        raise DatasetInvalid(file, field, problem)
    return PARAMETERS[model]


def make_camera(
    file: Path, field: str, model: str, width: int, height: int, parameters: tuple[float, ...]
) -> ModelCamera:
    """Build a camera. Raises `DatasetInvalid` naming file and field if the parameters don't fit its model."""
    keys = parameter_names(file, field, model)
    if len(parameters) != len(keys):
        raise DatasetInvalid(file, field, f"must have {len(keys)} parameters for {model}, got {len(parameters)}")
    values = dict(zip(keys, parameters, strict=True))
    for key, value in values.items():
        if not math.isfinite(value):
            raise DatasetInvalid(file, f"{field}.{key}", f"must be finite, got {value}")
    return ModelCamera(width, height, values)
