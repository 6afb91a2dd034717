"""Drawings of a capture's report, as SVG: the path of the cameras over the points, and parallax a frame."""

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.sparse_model import Summary

MOST_POINTS = 6000
OUTLIERS, MARGIN = 3.0, 1.15
"""Percent of the points that may lie outside at each side, and the side of what is drawn in extents of the others."""
COLORS = ("#d1495b", "#00798c", "#edae49", "#66a182", "#2e4057", "#8d5a97")
"""Of cameras, in their order, again from the first."""


def draw_path(model: Summary, cameras: np.ndarray) -> list[str]:
    """Draw points and cameras from above and from the side; `cameras` is the camera of each image, [N]."""
    axes_to_view = _level(model)
    points, centers = model.points @ axes_to_view.T, model.centers @ axes_to_view.T
    forward = model.camera_to_world[:, :3, 2] @ axes_to_view.T
    low, high = np.percentile(points, OUTLIERS, axis=0), np.percentile(points, 100 - OUTLIERS, axis=0)
    low, high = np.minimum(low, centers.min(axis=0)), np.maximum(high, centers.max(axis=0))
    reach, middle = MARGIN * 0.5 * float((high - low).max()), 0.5 * (low + high)
    chosen = np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]
    drawings = []
    for title, rows in {"from above": (0, 1), "from the side": (1, 2)}.items():
        figure = Figure(figsize=(4.5, 4.6), layout="constrained")
        place, axes = figure.subplots(), list(rows)
        place.scatter(*points[chosen][:, axes].T, s=2, c=model.colors[chosen] / 255, linewidths=0, rasterized=True)
        for camera in np.unique(cameras):
            own, color = cameras == camera, COLORS[camera % len(COLORS)]
            place.plot(*centers[own][:, axes].T, "-", color=color, linewidth=1)
            directions = forward[own][:, axes]
            place.quiver(*centers[own][:, axes].T, *directions.T, color=color, angles="xy", width=0.004, scale=16)
        limits = [(middle[axis] - reach, middle[axis] + reach) for axis in axes]
        place.set(title=title, xlim=limits[0], ylim=limits[1], aspect="equal", xticks=[], yticks=[])
        place.spines[:].set_color("#cccccc")
        drawings.append(_svg(figure))
    return drawings


def draw_parallax(frames: FrameSet, parallax: dict[str, float]) -> str:
    """Draw each frame's parallax in degrees over its time in seconds, and the frames without poses below."""
    figure = Figure(figsize=(9, 2.4), layout="constrained")
    place = figure.subplots()
    for camera in range(len(frames.cameras)):
        own = [frame for frame in frames.frames if frame.camera == camera]
        found = [(frame.time, parallax[frame.name]) for frame in own if frame.name in parallax]
        place.plot(*np.array(found).reshape(-1, 2).T, ".-", color=COLORS[camera % len(COLORS)], linewidth=1)
    missing = [frame.time for frame in frames.frames if frame.name not in parallax]
    place.plot(missing, np.zeros(len(missing)), "x", color="black", label="no pose")
    for cut in frames.cuts:
        place.axvline(cut, color="grey", linestyle=":", label="cut")
    if missing or frames.cuts:
        place.legend(*_once(place), frameon=False)
    place.set(xlabel="seconds", ylabel="parallax in degrees", ylim=(0, None))
    place.spines[["top", "right"]].set_visible(False)
    return _svg(figure)


def _level(model: Summary) -> np.ndarray:
    """[3, 3] rows: two level axes, the first along the cameras' extent, and up, the mean of the cameras'."""
    up = -model.camera_to_world[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    level = np.eye(3) - np.outer(up, up)
    offsets = (model.centers - model.centers.mean(axis=0)) @ level
    right = level @ np.linalg.svd(offsets, full_matrices=False)[2][0]
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _once(place: Axes) -> tuple[list, list[str]]:
    """Handles and labels of a legend, each label once."""
    handles, labels = place.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))
    return list(named.values()), list(named)


def _svg(figure: Figure) -> str:
    """The figure as an element of a page, without a date or other properties."""
    file = io.StringIO()
    nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
    figure.savefig(file, format="svg", dpi=150, metadata=nothing)
    text = file.getvalue()
    return text[text.index("<svg") :]
