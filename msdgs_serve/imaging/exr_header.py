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
    and (1, 1) at the lower right. `msdgs:camera_to_world` has OpenCV axes.
    """
    world_to_camera = camera.world_to_camera
    to_ndc = np.array(
        [
            [camera.fx / camera.width, 0, camera.cx / camera.width, 0],
            [0, camera.fy / camera.height, camera.cy / camera.height, 0],
            [0, 0, 1, 0],
            [0, 0, 1, 0],  # the divisor is the depth
        ]
    )
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return {
        "worldtocamera": ("matrix", _rows(TO_LEFT_HANDED @ world_to_camera)),
        "worldtoNDC": ("matrix", _rows(to_ndc @ world_to_camera)),
        "msdgs:camera_to_world": ("matrix", _rows(camera.camera_to_world)),
        "msdgs:intrinsics": ("float[4]", intrinsics),
        "msdgs:time": ("float", float(t)),
    }


def _rows(matrix: np.ndarray) -> tuple[float, ...]:
    """Return the transposed matrix in row-major order."""
    return tuple(matrix.T.ravel().tolist())
