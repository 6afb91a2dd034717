"""How sharp a picture is, whatever its exposure and noise.

The variance of the Laplacian, the usual measure, takes noise for detail and is proportional to the square of contrast.
Here the energy of gradients at a fine scale, in the direction in which it is least, as motion blurs in one, and less
what the picture's noise contributes, is divided by the variance of the picture at a coarse scale.
`python -m benchmarks.capture.sharpness` compares both against blurred copies.
"""

from functools import cache

import numpy as np

from msdgs_train.capture.pictures import fitted

FINE = 0.8
"""Standard deviation in pixels of the Gaussian before gradients are taken."""
COARSE = 64
"""Pixels along the long side of the picture whose variance is the measure of contrast."""
USABLE = (8, 247)
"""Gray values, means over some pixels, at which noise isn't cut off."""


def sharpness(grey: np.ndarray) -> float:
    """Return a number that is larger for a sharper picture of the same subject, from uint8 [H, W]."""
    values = grey.astype(np.float32)
    energy = np.linalg.eigvalsh(_structure(values))[0]
    detail = max(float(energy) - noise_variance(values) * _noise_gain(), 0.0)
    return detail / max(float(thumbnail(grey).var()), 1.0)


def noise_variance(values: np.ndarray) -> float:
    """Variance of white noise in float32 [H, W]: the median response to a mask that smooth pictures don't excite.

    Immerkær, Fast noise variance estimation, 1996, with the median in place of the mean, as edges respond too.
    """
    import cv2

    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = np.abs(cv2.filter2D(values, -1, mask))
    mean = cv2.blur(values, (5, 5))
    usable = response[(mean > USABLE[0]) & (mean < USABLE[1])]
    return float((np.median(usable) / 0.6745 / 6) ** 2) if usable.size else 0.0


def thumbnail(grey: np.ndarray, side: int = COARSE) -> np.ndarray:
    """Reduce uint8 [H, W] to float32 with a long side of at most `side` pixels, each the mean over its area."""
    import cv2

    height, width = grey.shape
    return cv2.resize(grey.astype(np.float32), fitted(width, height, side), interpolation=cv2.INTER_AREA)


def _structure(values: np.ndarray) -> np.ndarray:
    """Mean structure tensor [2, 2] of float32 [H, W], smoothed at the fine scale."""
    import cv2

    smooth = cv2.GaussianBlur(values, (0, 0), FINE)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *axis, ksize=1).ravel() for axis in ((1, 0), (0, 1)))
    return np.array([[x @ x, x @ y], [x @ y, y @ y]]) / values.size


@cache
def _noise_gain() -> float:
    """What smoothed white noise of variance 1 adds to the energy in each direction."""
    impulse = np.zeros((31, 31), np.float32)
    impulse[15, 15] = 1
    return float(_structure(impulse)[0, 0] * impulse.size)
