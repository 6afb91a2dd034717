"""Captures of clips of known truth, from where quality breaks to where it is good: the limits of
`msdgs_train.capture.verdict` come from here.

    python -m benchmarks.capture.verdicts [--only TEXT] [--out verdicts.csv]

Cameras move on arcs of 2° to 40°, turn on the spot, or stand still, some beside a large moving poster; then few frames.
Each row has the figures of a capture, the largest rotation error in degrees, the centers'
errors in percent of their extent after alignment, and the verdict.
"""

import argparse
import csv
import json
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.capture.capture_truth import errors_of
from benchmarks.measuring import machine
from msdgs_serve.writing import scratch_folder
from msdgs_train.capture.job import CaptureJob, CaptureOptions
from msdgs_train.capture.masked_poses import POSES
from msdgs_train.capture.recordings import WORK
from msdgs_train.capture.sparse_model import GEOMETRY, Summary
from tests.support.camera_moves import arc, pan, tripod
from tests.support.clips import clip_of_poses

FRAMES = 24
FIGURES = (
    "registered",
    "parallax",
    "baseline",
    "reprojection_error",
    "beyond_rotation",
    "agreement",
    "seen",
    "moving",
)


@dataclass(frozen=True)
class Case:
    """A clip."""

    name: str
    poses: list[np.ndarray]
    poster: bool = False


CASES = [
    *(Case(f"arc {degrees}°", arc(degrees, FRAMES)) for degrees in (2, 5, 10, 20, 40)),
    *(Case(f"arc {degrees}°, poster", arc(degrees, FRAMES), poster=True) for degrees in (10, 40)),
    Case("pan 40°", pan(40, FRAMES)),
    Case("pan 40°, poster", pan(40, FRAMES), poster=True),
    Case("tripod", tripod(FRAMES)),
    *(Case(f"arc 40°, {count} frames", arc(40, count)) for count in (6, 8, 12)),
]


def main() -> None:
    """Capture the cases and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--width", type=int, default=256, help="of the clips, pixels")
    parser.add_argument("--threads", type=int, default=1, help="of COLMAP; with one the figures repeat")
    parser.add_argument("--out", type=Path, help="CSV file to write")
    arguments = parser.parse_args()
    print(machine())
    rows = []
    for case in CASES:
        if arguments.only in case.name:
            rows.append(captured(case, arguments.width, arguments.threads))
            print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if arguments.out:
        with arguments.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def captured(case: Case, width: int, threads: int) -> dict[str, object]:
    """Capture a case, and return its row."""
    with scratch_folder() as folder:
        clip = clip_of_poses(folder / "clip.mp4", case.poses, width=width, poster=case.poster)
        data = folder / "data"
        watch = lambda name, is_kept: nullcontext(lambda stage, done, total: None)  # noqa: E731
        verdict = CaptureJob([clip.file], data, CaptureOptions(), threads=threads, watch=watch).run().verdict
        report = json.loads((data / "capture.json").read_text(encoding="utf-8"))
        row = {"clip": case.name, "frames": len(case.poses)} | {name: round(report[name], 3) for name in FIGURES}
        return row | _errors(data, clip.camera_to_world) | {"verdict": verdict.text.replace("\n", " / ")}


def _errors(data: Path, truth: np.ndarray) -> dict[str, object]:
    """The largest errors of the last poses that were found."""
    found = data / WORK / POSES / GEOMETRY
    model = Summary.load(found) if found.is_file() else None
    if model is None or len(model.names) < 3:
        return {"rotation": "", "centers": ""}
    rows = [int(str(name).split(".")[0]) for name in model.names]
    with np.errstate(divide="ignore"):  # the true centers of a pan have no extent
        errors = errors_of(model.camera_to_world, truth[rows])
    return {"rotation": f"{errors.rotations.max():.2f}", "centers": f"{errors.centers.max():.1f}"}


if __name__ == "__main__":
    main()
