"""Draw the pictures of docs/your_scene.md: three ways to move a camera, from above, and what it sees.

python -m benchmarks.capture.how_to_film docs/images
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from msdgs_serve.writing import replacing
from tests.support.camera_moves import TARGET, arc, pan, tripod
from tests.support.clips import FIELD_OF_VIEW, views_of_poses

MOVES = {
    "arc": ("walk around it", "#2f855a", arc(60, 9)),
    "pan": ("turn on the spot", "#c53030", pan(60, 9)),
    "tripod": ("stand still", "#c53030", tripod(9)),
}
SEEN = (0, 4, 8)
"""Poses whose frames are shown."""
WIDTH = 240
"""Of a frame, pixels."""
DPI = 100


def main() -> None:
    """Write a WebP for each move."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of the pictures")
    out = parser.parse_args().out
    for name, (title, color, poses) in MOVES.items():
        figure = Figure(figsize=(9.6, 2.3), dpi=DPI, layout="constrained")
        above, *frames = figure.subplots(1, 4, width_ratios=(1, 1.1, 1.1, 1.1))
        draw_above(above, title, color, poses)
        views = views_of_poses(poses, WIDTH)
        for place, index in zip(frames, SEEN, strict=True):
            place.imshow(views[index][0])
            place.set(xticks=[], yticks=[])
            place.set_title(f"frame {index + 1} of {len(poses)}", fontsize=9)
        with replacing(out / f"film_{name}.webp") as temporary:
            figure.savefig(temporary, format="webp", bbox_inches="tight", pad_inches=0.05, pil_kwargs={"quality": 80})


def draw_above(place: Axes, title: str, color: str, poses: list[np.ndarray]) -> None:
    """Draw the subject, and cameras with their fields of view, from above."""
    place.add_patch(Circle((TARGET[0], TARGET[1]), 0.55, color="#cbd5e0"))
    for pose in poses:
        center, forward = pose[:2, 3], pose[:2, 2] / np.linalg.norm(pose[:2, 2])
        side = np.array([-forward[1], forward[0]]) * np.tan(FIELD_OF_VIEW / 2)
        for length, alpha in ((0.3, 0.9), (1.5, 0.06)):
            corners = [center, center + length * (forward + side), center + length * (forward - side)]
            place.add_patch(Polygon(corners, color=color, alpha=alpha, linewidth=0))
    path = np.array([pose[:2, 3] for pose in poses])
    place.plot(*path.T, color=color, linewidth=1)
    place.set(xlim=(-1.9, 1.9), ylim=(-2.4, 1.1), aspect="equal")
    place.set_title(title, fontsize=10, color=color, weight="bold")
    place.axis("off")


if __name__ == "__main__":
    main()
