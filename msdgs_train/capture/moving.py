"""Where the frames of a capture show something that moves.

Of a moving camera, dense optical flow between a frame and its neighbours is compared with the epipolar geometry of the
pair: a point at rest moves along its epipolar line. Of a fixed camera, frames are compared with their background.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from msdgs_train.capture.epipolar import Lens, fundamental_of_poses, line_distances, robust_fundamental
from msdgs_train.capture.fixed_cameras import background
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.image_files import read_color, read_gray, write_image
from msdgs_train.capture.poses import Poses
from msdgs_train.capture.progress import Progress

WORKING_SIZE = 384
"""Long side in pixels at which flow is computed; distances below are in these pixels."""
GAPS = (1, 2)
"""Frames between the two of a pair, before and after."""
ROUND_TRIP = 1.5
"""Flow there and back must return to within this; where it doesn't, as behind an edge, a pair says nothing."""
NOISE = 0.2
"""Least noise of the distances to epipolar lines."""
AT_REST = 0.2
"""Distance to an epipolar line that it explains."""
SURE, LIKELY = 4.0, 2.0
"""Distance in units of the noise at which a pixel surely moves, and at which it does beside one that surely does."""
FIT_SHARE = 0.9
"""Poses' epipolar geometry is taken if it explains this part of the pixels that one fitted to the flow explains: the
first poses may follow what moves."""
CHANGED, NOISES = 14.0, 4.0
"""Least change of a color, in 8 bits and in units of the noise, from the background of a fixed camera."""
CONTRAST, CONTRAST_WINDOW = 2.0, 15
"""Least standard deviation in 8 bits, over so many pixels: the flow of a plain wall means nothing, and it has no
features."""
SMALLEST = 0.001
"""Part of the image of the smallest region that is kept, and of the largest hole that is closed."""


class _Shot(NamedTuple):
    """A frame at the working size."""

    gray: np.ndarray
    camera_to_world: np.ndarray | None


def find_moving(
    images: Path,
    frames: FrameSet,
    poses: Poses,
    out: Path,
    *,
    progress: Progress | None = None,
) -> dict[str, float]:
    """Write a mask of each frame's name and size to the folder `out`, white where something moves.

    Returns the part of each frame that is white. `progress` is called with the stage, what is done and the total.
    """
    shares: dict[str, float] = {}
    for camera in range(len(frames.cameras)):
        names = [frame.name for frame in frames.frames if frame.camera == camera]
        found = _changed(images, names) if poses.fixed[camera] else _against_epipolar_lines(images, names, poses)
        for name, mask in found:
            write_image(out / name, mask)
            shares[name] = float(np.mean(mask > 0))
            if progress is not None:
                progress("what moves", len(shares), len(frames.frames))
    return shares


def _changed(images: Path, names: list[str]) -> Iterator[tuple[str, np.ndarray]]:
    """Masks of the frames of a fixed camera."""
    behind = cv2.GaussianBlur(background([images / name for name in names]), (5, 5), 0)
    for name in names:
        image = cv2.GaussianBlur(read_color(images / name), (5, 5), 0)
        change = cv2.absdiff(image, behind).max(axis=2).astype(np.float32)
        noise = max(1.48 * float(np.median(change)), CHANGED / NOISES)
        yield name, cleaned(change / (NOISES * noise), 1.0, 0.6)


def _against_epipolar_lines(images: Path, names: list[str], poses: Poses) -> Iterator[tuple[str, np.ndarray]]:
    """Masks of the frames of a moving camera. They are read once, and pairs of them are evaluated for both."""
    rows = {name: row for row, name in enumerate(poses.registered)}
    lens = None
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    shots: dict[int, _Shot] = {}
    evidence: dict[int, list[np.ndarray]] = {}
    size = (0, 0)
    for index in range(len(names) + GAPS[-1]):
        if index < len(names):
            gray = read_gray(images / names[index])
            size = gray.shape[1], gray.shape[0]
            row = rows.get(names[index])
            pose = None if row is None else poses.summary.camera_to_world[row]
            shots[index] = _Shot(_reduced(gray), pose)
            if row is not None and lens is None:
                lens = Lens.of(poses.summary.intrinsics[row], size, shots[index].gray.shape)
            evidence[index] = []
            for gap in GAPS:
                if index - gap in shots:
                    there, back = _pair(shots[index - gap], shots[index], lens, flow)
                    evidence[index - gap].append(there)
                    evidence[index].append(back)
        complete = index - GAPS[-1]
        if complete >= 0:
            gray = shots.pop(complete).gray
            score = _combined(evidence.pop(complete), gray.shape)
            mask = np.where(_has_contrast(gray), cleaned(score, SURE, LIKELY), np.uint8(0))
            yield names[complete], cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)


def _reduced(gray: np.ndarray) -> np.ndarray:
    scale = min(WORKING_SIZE / max(gray.shape), 1.0)
    return gray if scale == 1 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _pair(one: _Shot, other: _Shot, lens: Lens | None, flow: cv2.DISOpticalFlow) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] distances of both frames' pixels to epipolar lines in units of the noise; NaN where the flow is unsure."""
    there, back = (
        flow.calc(first, second, np.zeros((*first.shape, 2), np.float32))
        for first, second in ((one.gray, other.gray), (other.gray, one.gray))
    )
    sure = _returns(there, back)
    poses = one.camera_to_world, other.camera_to_world
    best, explained = None, 0.0
    for each in filter(None, (lens, Lens.unknown(one.gray.shape))):
        starts, ends, returns = each.undistorted(), each.undistorted(there), each.undistorted(back)
        geometries = [(robust_fundamental(starts[sure], ends[sure], each), FIT_SHARE)]
        if poses[0] is not None and poses[1] is not None and each is lens:
            geometries.append((fundamental_of_poses(poses[0], poses[1], each), 1.0))
        for geometry, weight in geometries:
            if geometry is None:
                continue
            forward = line_distances(geometry, starts, ends)
            share = weight * float(np.mean(forward[sure] < AT_REST))
            if share > explained:
                best, explained = (forward, line_distances(geometry.T, starts, returns)), share
    if best is None:
        nothing = np.full(one.gray.shape, np.nan)
        return nothing, nothing
    noise = max(1.48 * float(np.median(best[0][sure])), NOISE)
    return np.where(sure, best[0] / noise, np.nan), np.where(_returns(back, there), best[1] / noise, np.nan)


def _returns(there: np.ndarray, back: np.ndarray) -> np.ndarray:
    """[H, W] bool: whether flow to the other frame and back ends where it began."""
    height, width = there.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    x, y = x + there[..., 0], y + there[..., 1]
    returned = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e6, 1e6))
    return np.linalg.norm(there + returned, axis=2) < ROUND_TRIP


def _has_contrast(gray: np.ndarray) -> np.ndarray:
    """[H, W] bool, true for pixels whose neighbourhood isn't plain."""
    values = gray.astype(np.float64)
    window = (CONTRAST_WINDOW, CONTRAST_WINDOW)
    variance = cv2.blur(values * values, window) - cv2.blur(values, window) ** 2
    return variance > CONTRAST**2


def _combined(evidence: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """[H, W] what most of the pairs say about a frame's pixels; 0 where none says anything."""
    if not evidence:
        return np.zeros(shape)
    stack = np.stack(evidence)
    counts = np.isfinite(stack).sum(axis=0)
    ordered = np.sort(np.where(np.isfinite(stack), stack, np.inf), axis=0)
    middle = np.take_along_axis(ordered, np.maximum(counts // 2, 0)[None].clip(max=len(stack) - 1), axis=0)[0]
    return np.where(counts > 0, middle, 0.0)


def cleaned(score: np.ndarray, sure: float, likely: float) -> np.ndarray:
    """[H, W] uint8, 255 in regions of likely pixels that have sure ones, without specks and small holes."""
    smooth = cv2.medianBlur(np.minimum(score, 1e3).astype(np.float32), 5)
    mask = (smooth > likely).astype(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _disc(5))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(3))
    smallest = SMALLEST * mask.size
    kept = _components(
        mask, lambda labels, area: (area >= smallest) & (_most_per_label(smooth, labels, len(area)) > sure)
    )
    solid = 1 - _components(1 - kept, lambda labels, area: area >= smallest)
    return 255 * cv2.dilate(solid, _disc(5))


def _components(mask: np.ndarray, keep: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """The mask's connected regions that are kept by their labels and areas."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    kept = np.zeros(count, np.uint8)
    kept[1:] = keep(labels, stats[:, cv2.CC_STAT_AREA])[1:]
    return np.take(kept, np.asarray(labels, np.intp))


def _most_per_label(score: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """[count] the score that a tenth of each label's pixels exceeds."""
    order = np.argsort(labels, axis=None, kind="stable")
    ends = np.cumsum(np.bincount(labels.ravel(), minlength=count))
    values = np.split(score.ravel()[order], ends[:-1])
    return np.array([np.quantile(each, 0.9) if len(each) else 0.0 for each in values])


def _disc(diameter: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter))
