"""The frame that a scene is trained in: near the origin, with cameras about four units from what they show.

Rates, the near plane, bounds and initial points are made for such a scene, as those of D-NeRF are, and float32 loses
details of a scene that is far from the origin. A scene that is about like that keeps its own frame.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from msdgs_serve.scene import Camera
from msdgs_serve.scene.similarity import MAX_SCALE, MIN_SCALE, Similarity

DISTANCE = 4.0
"""Of cameras from what they show in a normalized scene, scene units."""
KEPT_DISTANCES = (DISTANCE / 2, DISTANCE * 2)
KEPT_OFFSET = 0.5
"""A scene keeps its frame if its distance is in this range, and its center this fraction of it from the origin."""
MIN_CONVERGENCE = 1e-3
"""Smallest eigenvalue, a mean squared sine, below which optical axes are treated as parallel: about 2°."""
MIN_IN_FRONT = 0.8
"""Fraction of the cameras that must have the point that they look at in front of them."""
ROUNDS = 10
"""Of reweighted least squares, after which a few cameras that look elsewhere hardly count."""
MIN_SEEN = 0.5
"""Fraction of the cameras that must see points for these to count."""
OUTWARD_DISTANCE = 12.0
"""Of what cameras show that don't look at one point, in radii of their positions, if nothing else tells. A room whose
walls are 6 radii away trains to 26.3 dB with 12, 25.5 with 6, 23.7 with 24 and 20.0 with 4."""
MAX_DEPTH_RATIO = 30.0
"""Between depths of points and of what the cameras look at, above which points are taken to have other units, such as
millimeters for meters. Wide backgrounds have less."""
MIN_SPREAD = 0.01
"""Radius of nine tenths of the points, as a fraction of their depth, below which they are taken to have other units."""
ONE_PLACE = 1e-9
"""Spread of positions, as a fraction of the largest coordinate or of `DISTANCE`, below which they are one place."""
MAX_POINTS = 20_000
"""About as many points are looked for in each image."""
DIGITS = 3
"""Significant digits of scale and offset."""


class Subject(NamedTuple):
    """What the cameras of a scene show, in the frame of the cameras."""

    center: np.ndarray  # [3]
    distance: float  # typical distance of the cameras from it; 0 if nothing tells
    is_looked_at: bool  # whether the cameras look at its center


def find_subject(cameras: Sequence[Camera], points: np.ndarray | None) -> Subject:
    """Find what `cameras`, one or more, show: around the point that they look at, else the middle of the sparse
    `points`, [M, 3], that they see, else the middle of the cameras."""
    positions = np.array([camera.position for camera in cameras])
    axes = np.array([camera.camera_to_world[:3, 2] for camera in cameras])
    depths = [] if points is None else seen_depths(cameras, points)
    has_points = len(depths) >= MIN_SEEN * len(cameras)
    target = _looked_at(positions, axes)
    if target is not None:
        distances = depths if has_points else np.linalg.norm(positions - target, axis=1)
        return Subject(target, float(np.median(distances)), True)
    if points is not None and has_points:
        return Subject(np.median(points, axis=0), float(np.median(depths)), False)
    middle = np.median(positions, axis=0)
    if are_at_one_place(cameras):
        return Subject(middle, 0.0, False)
    radius = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    return Subject(middle, OUTWARD_DISTANCE * radius, False)


def normalization(subject: Subject) -> Similarity:
    """The frame to train in: scale, offset or both are those of the files where these are about right."""
    center, distance, _ = subject
    keeps_scale = not distance or KEPT_DISTANCES[0] <= distance <= KEPT_DISTANCES[1]
    scale = 1.0 if keeps_scale else float(np.clip(_rounded(distance / DISTANCE), MIN_SCALE, MAX_SCALE))
    if np.linalg.norm(center) <= KEPT_OFFSET * (distance or DISTANCE):
        return Similarity(scale)
    step = 10.0 ** (np.floor(np.log10(scale)) + 1 - DIGITS)
    x, y, z = (float(f"{round(value / step) * step:.15g}") for value in center)
    return Similarity(scale, (x, y, z))


def seen_depths(cameras: Sequence[Camera], points: np.ndarray) -> list[float]:
    """The median depth of the points, [M, 3], or evenly chosen ones, in the image of each camera that sees any."""
    depths, points = [], points[:: max(1, len(points) // MAX_POINTS)]
    for camera in cameras:
        visible = camera.visible_depths(points)
        if visible.any():
            depths.append(float(np.median(visible[visible > 0])))
    return depths


def other_units(cameras: Sequence[Camera], points: np.ndarray) -> str | None:
    """What tells that points, which cameras see, have other units than the poses; None if nothing does."""
    subject = find_subject(cameras, None)
    if not subject.is_looked_at:
        return None
    depth = float(np.median(seen_depths(cameras, points)))
    if not 1 / MAX_DEPTH_RATIO < depth / subject.distance < MAX_DEPTH_RATIO:
        return f"the points are {depth:.3g} from the cameras, which look at what is {subject.distance:.3g} from them"
    radius = float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))
    if len(points) > 1 and radius < MIN_SPREAD * depth:
        return f"the points are within {radius:.3g} of each other, and {depth:.3g} from the cameras"
    return None


def are_at_one_place(cameras: Sequence[Camera]) -> bool:
    """Whether the positions of cameras are the same up to rounding."""
    positions = np.array([camera.position for camera in cameras])
    return bool(np.ptp(positions, axis=0).max() <= ONE_PLACE * max(np.abs(positions).max(), DISTANCE))


def are_parallel(cameras: Sequence[Camera]) -> bool:
    """Whether all optical axes have one direction, so that nothing tells how far away is what they show."""
    axes = np.array([camera.camera_to_world[:3, 2] for camera in cameras])
    return bool(np.linalg.eigvalsh(_across(axes).mean(axis=0))[0] < MIN_CONVERGENCE)


def _looked_at(positions: np.ndarray, axes: np.ndarray) -> np.ndarray | None:
    """[3] the point nearest to all optical axes, with robust weights; None if they don't look at one."""
    across = _across(axes)
    weights, point = np.ones(len(positions)), np.zeros(3)
    origin = np.median(positions, axis=0)  # in float64 coordinates far away would lose the sums' last digits
    local = positions - origin
    for _ in range(ROUNDS):
        system = np.einsum("c,cij->ij", weights, across) / weights.sum()
        if np.linalg.eigvalsh(system)[0] < MIN_CONVERGENCE:
            return None
        point = np.linalg.solve(system, np.einsum("c,cij,cj->i", weights, across, local) / weights.sum())
        misses = np.linalg.norm(np.einsum("cij,cj->ci", across, point - local), axis=1)
        weights = 1 / (misses + np.median(misses) + 1e-9 * np.abs(local).max() + 1e-300)
    in_front = ((point - local) * axes).sum(axis=1) > 0
    return point + origin if in_front.mean() >= MIN_IN_FRONT else None


def _across(axes: np.ndarray) -> np.ndarray:
    """[C, 3, 3] projections onto the planes normal to axes, [C, 3]."""
    return np.eye(3) - axes[:, :, None] * axes[:, None, :]


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
