"""Epipolar geometry of two frames in pixels of the pinhole image, without the lens's distortion."""

from dataclasses import dataclass

import cv2
import numpy as np

SAMPLES = 1_500
"""Pixels, evenly spread over the image, that an essential matrix is fitted to."""
TRIALS, CONFIDENCE = 1_000, 0.9999
CLOSE = 0.15
"""Pixels from its epipolar line within which a point is taken to be at rest."""
MIN_POINTS = 50
USUAL_FOCAL = 1.2
"""Focal length in long sides of the image, COLMAP's first guess."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of SIMPLE_RADIAL at the working size, H×W."""

    matrix: np.ndarray  # [3, 3]
    k1: float
    shape: tuple[int, int]

    @staticmethod
    def of(intrinsics: np.ndarray, size: tuple[int, int], shape: tuple[int, ...]) -> "Lens":
        """From focal length, principal point and k1 of images of `size`, width and height."""
        scale = shape[1] / size[0]
        focal, cx, cy = intrinsics[:3] * scale
        return Lens(np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]]), float(intrinsics[3]), (shape[0], shape[1]))

    @staticmethod
    def unknown(shape: tuple[int, ...]) -> "Lens":
        """A lens without distortion."""
        return Lens.of(
            np.array([USUAL_FOCAL * max(shape), shape[1] / 2, shape[0] / 2, 0.0]), (shape[1], shape[0]), shape
        )

    def undistorted(self, flow: np.ndarray | None = None) -> np.ndarray:
        """[H, W, 2] pixels moved by the flow, [H, W, 2], if any, in the pinhole image."""
        height, width = self.shape
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        pixels = pixels if flow is None else pixels + flow
        if self.k1 == 0:
            return pixels
        moved = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self.matrix, np.array([self.k1, 0, 0, 0]), P=self.matrix)
        return moved.reshape(height, width, 2)


def fundamental_of_poses(one: np.ndarray, other: np.ndarray, lens: Lens) -> np.ndarray:
    """[3, 3] F of two poses, camera to world, so that x_other · F · x_one = 0."""
    relative = np.linalg.inv(other) @ one
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = np.linalg.inv(lens.matrix)
    return inverse.T @ cross @ relative[:3, :3] @ inverse


def robust_fundamental(starts: np.ndarray, ends: np.ndarray, lens: Lens) -> np.ndarray | None:
    """[3, 3] F of the camera motion that most of the [N, 2] points agree with, if there is one."""
    if len(starts) < MIN_POINTS:
        return None
    chosen = np.linspace(0, len(starts) - 1, min(SAMPLES, len(starts))).astype(int)
    found, _ = cv2.findEssentialMat(
        starts[chosen], ends[chosen], lens.matrix, cv2.USAC_MAGSAC, CONFIDENCE, CLOSE, TRIALS
    )
    if found is None or found.shape != (3, 3):
        return None
    inverse = np.linalg.inv(lens.matrix)
    return inverse.T @ found @ inverse


def line_distances(fundamental: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """[...] Sampson distances in pixels of pairs of [..., 2] points (Hartley and Zisserman, equation 11.9)."""
    lines = starts @ fundamental[:, :2].T + fundamental[:, 2]
    back = ends @ fundamental[:2] + fundamental[2]
    algebraic = (ends * lines[..., :2]).sum(axis=-1) + lines[..., 2]
    gradient = (lines[..., :2] ** 2).sum(axis=-1) + (back[..., :2] ** 2).sum(axis=-1)
    return np.abs(algebraic) / np.sqrt(np.maximum(gradient, 1e-18))
