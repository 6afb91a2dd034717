"""Quaternions, wxyz. A unit quaternion and its negative are the same rotation."""

import numpy as np

from msdgs_serve.scene.errors import InvalidInput

MIN_NORM = 1e-8
"""Below this norm a quaternion has no direction."""


def normalize(quats: np.ndarray) -> np.ndarray:
    """Scale wxyz quaternions, shape (*, 4), to unit length. Raises `InvalidInput` if a norm is below 1e-8."""
    quats = np.asarray(quats)
    # divided by the largest entry first: 1e-30 squared is 0, 1e30 squared is infinite in float32
    largest = np.abs(quats).max(axis=-1, keepdims=True, initial=0.0)
    if not (largest >= MIN_NORM).all() or not np.isfinite(largest).all():
        raise InvalidInput("quats", f"finite, of norm {MIN_NORM} or more", float(np.min(largest)))
    quats = quats / largest
    return quats / np.linalg.norm(quats, axis=-1, keepdims=True)


def to_matrix(quats: np.ndarray) -> np.ndarray:
    """Return rotation matrices, shape (*, 3, 3), of unit wxyz quaternions, shape (*, 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quats), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(matrices: np.ndarray) -> np.ndarray:
    """Return unit wxyz quaternions, shape (*, 4), w >= 0, of rotation matrices, shape (*, 3, 3).

    The largest component is computed from the diagonal and the others are divided by it, which avoids divisions by
    numbers near zero.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(np.asarray(matrices), (-2, -1), (0, 1))
    # row k: 4 q_k times (w, x, y, z)
    rows = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    candidates = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    quats = normalize(np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :])
    return np.where(quats[..., :1] < 0, -quats, quats)
