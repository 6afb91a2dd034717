"""Attributes of EXR files for camera and time: OpenEXR's standard ones and our own."""

from typing import Any

import numpy as np

from msdgs_serve.scene import Camera

TypedAttributes = dict[str, tuple[str, Any]]

TO_LEFT_HANDED = np.diag([1.0, -1.0, 1.0, 1.0])
"""To OpenEXR's camera space (x right, y up, z forward) from ours, which has y down."""


def camera_attributes(camera: Camera, t: float) -> TypedAttributes:
    """Return OpenEXR's `worldToCamera` and `worldToNDC`, under OpenImageIO's names, and our attributes.

    OpenEXR uses row vectors, so that all matrices are transposed. NDC is (0, 0) at the upper left corner of the image
    and (1, 1) at the lower right; no matrix leads there from a fisheye camera. `msdgs:camera_to_world` has OpenCV axes.
    """
    world_to_camera = camera.world_to_camera
    attributes: TypedAttributes = {
        "worldtocamera": ("matrix", _rows(TO_LEFT_HANDED @ world_to_camera)),
        "msdgs:camera_to_world": ("matrix", _rows(camera.camera_to_world)),
        "msdgs:camera_model": ("string", camera.model),
        "msdgs:intrinsics": ("float[4]", (camera.fx, camera.fy, camera.cx, camera.cy)),
        "msdgs:distortion": ("float[4]", camera.distortion),
        "msdgs:time": ("float", float(t)),
    }
    if camera.model != "fisheye":
        attributes["worldtoNDC"] = ("matrix", _rows(_to_ndc(camera) @ world_to_camera))
    return attributes


def _to_ndc(camera: Camera) -> np.ndarray:
    """Return the matrix from camera axes, OpenCV's, to NDC. Its z is the depth if orthographic, else 1 / depth."""
    fx, cx = camera.fx / camera.width, camera.cx / camera.width
    fy, cy = camera.fy / camera.height, camera.cy / camera.height
    if camera.model == "orthographic":
        return np.array([[fx, 0, 0, cx], [0, fy, 0, cy], [0, 0, 1, 0], [0, 0, 0, 1]])
    return np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 0, 1], [0, 0, 1, 0]])  # the divisor is the depth


def _rows(matrix: np.ndarray) -> tuple[float, ...]:
    """Return the transposed matrix in row-major order."""
    return tuple(matrix.T.ravel().tolist())
