"""Captures of clips of known truth, from where quality breaks to where it is good: the limits of
`msdgs_train.capture.verdict` come from here.

    python -m benchmarks.training.verdicts [--only TEXT] [--out verdicts.csv]

Cameras move on arcs of 1° to 80°, turn on the spot, or stand still, with and without a large moving poster; then
few frames, and motion blur. Each row has the figures of a capture, the largest rotation error in degrees, the centers'
errors in percent of their extent after alignment, and the verdict.
"""

import argparse
import csv
import tempfile
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.job import CaptureJob, CaptureOptions
from msdgs_train.capture.measures import Measures
from msdgs_train.capture.sparse_model import Summary
from msdgs_train.datasets.common.images import write_png
from tests.support.camera_moves import arc, pan, tripod
from tests.support.clips import _camera, _shot, _Textures

FRAMES = 24
FIGURES = ("frames", "registered", "parallax", "baseline", "reprojection_error", "beyond_rotation", "rotation_only", "moving")


@dataclass(frozen=True)
class Case:
    """A clip."""

    name: str
    poses: list[np.ndarray]
    poster: bool = False
    exposure: int = 1
    """Moments whose mean is a frame, over the time between two frames: motion blur."""


CASES = [
    *(Case(f"arc {degrees}°", arc(degrees, FRAMES)) for degrees in (2, 5, 10, 20, 40)),
    Case("pan 40°", pan(40, FRAMES)),
    *(Case(f"arc {degrees}°, poster", arc(degrees, FRAMES), poster=True) for degrees in (10, 40)),
    Case("pan 40°, poster", pan(40, FRAMES), poster=True),
    Case("tripod", tripod(FRAMES)),
    *(Case(f"arc 40°, {count} frames", arc(40, count)) for count in (6, 8, 12)),
]


def main() -> None:
    """Run the cases and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="CSV file to write")
    arguments = parser.parse_args()
    rows = []
    for case in CASES:
        if arguments.only in case.name:
            rows.append(measured(case, arguments.width, arguments.threads))
            print(" | ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if arguments.out:
        with arguments.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def measured(case: Case, width: int, threads: int) -> dict[str, object]:
    """Capture a case, and return its row."""
    with tempfile.TemporaryDirectory() as temporary:
        recording, data = Path(temporary) / "recording", Path(temporary) / "data"
        recording.mkdir()
        textures = _Textures(width, 0)
        for index, (pose, t) in enumerate(zip(case.poses, np.linspace(0, 1, len(case.poses)), strict=True)):
            write_png(recording / f"{index:05d}.png", _shot(_camera(pose, width), t, textures, case.poster)[0])
        options = CaptureOptions(size=width)
        job = CaptureJob([recording], data, options, threads=threads, watch=lambda *_: nullcontext(lambda *_: None))
        verdict = job.run()
        report = __import__("json").loads((data / "capture.json").read_text())
        row = {"case": case.name} | {name: round(report[name], 3) for name in FIGURES}
        errors = ("", "")
        if report["registered"] > 2:
            model = Summary.load(max((data / "capture").glob("poses*/geometry.npz"), key=lambda f: f.stat().st_mtime))
            rows = [int(str(name)[:5]) for name in model.names]
            errors = pose_errors(model.camera_to_world, np.stack([case.poses[row] for row in rows]))
        return row | {"rotation": errors[0], "centers": errors[1], "verdict": verdict.text.replace("\n", " / ")}


def pose_errors(found: np.ndarray, true: np.ndarray) -> tuple[str, str]:
    a, b = found[:, :3, 3] - found[:, :3, 3].mean(0), true[:, :3, 3] - true[:, :3, 3].mean(0)
    r = found[:, :3, :3]
    # the rotation of the worlds from the cameras' rotations: centers on a line leave it open
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", true[:, :3, :3], r))
    world = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    turned = a @ world.T
    scale = (turned * b).sum() / max((turned**2).sum(), 1e-12)
    extent = max(np.linalg.norm(b[:, None] - b[None], axis=2).max(), 1e-9)
    cos = (np.einsum("nij,nij->n", true[:, :3, :3], world @ r) - 1) / 2
    return f"{np.degrees(np.arccos(np.clip(cos, -1, 1))).max():.2f}", f"{100 * np.linalg.norm(scale * turned - b, axis=1).max() / extent:.1f}"


if __name__ == "__main__":
    main()
