"""What an EXR file says of its camera and its time, by OpenEXR's standard attributes and our own."""

from typing import Any

import numpy as np

from msdgs_serve.scene import Camera

TypedAttributes = dict[str, tuple[str, Any]]

TO_LEFT_HANDED = np.diag([1.0, -1.0, 1.0, 1.0])
"""OpenEXR's camera space: x right, y up, z forward; ours has y down."""


def camera_attributes(camera: Camera, t: float) -> TypedAttributes:
    """OpenEXR's `worldToCamera` and `worldToNDC`, under the names that OpenImageIO has for them, and ours.

    OpenEXR multiplies row vectors from the left, so that matrices are transposed. NDC is (0, 0) at the upper left
    corner of the image and (1, 1) at the lower right. `msdgs:camera_to_world` has OpenCV axes; it is transposed too.
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
    """For row vectors."""
    return tuple(matrix.T.ravel().tolist())
