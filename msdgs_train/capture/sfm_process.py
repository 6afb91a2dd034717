"""Structure from motion in a process of its own, which can be stopped at any time and whose crash is an error here.

OpenCV and pycolmap bring libraries of the same names, so that one process that uses both may crash: pycolmap is
imported in that process only.
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.progress import Progress

PROGRAM = "msdgs_train.capture.sfm"
LAST_LINES = 3


@dataclass(frozen=True)
class CameraViews:
    """The images of one camera. All share its intrinsics."""

    folder: str
    """Absolute path of the folder that the names are relative to."""
    names: tuple[str, ...]
    frames: tuple[str, ...] | None = None
    """Names of all frames of a fixed camera, which get the pose of its only view."""
    others: tuple[str, ...] = ()
    """Images that are registered to the finished model of the named ones."""


@dataclass(frozen=True)
class PosesJob:
    """What `sfm.find` is to do. Paths are absolute."""

    workspace: str
    cameras: tuple[CameraViews, ...]
    pairs: tuple[tuple[str, str], ...]
    """Of the model's images, which are matched."""
    other_pairs: tuple[tuple[str, str], ...]
    """Of another image and one of the model, which are matched."""
    seed: int
    threads: int
    """-1: all processors."""
    all_matches: bool = False
    """Map with all matches from the start, also those on what moves."""
    kind: Literal["poses"] = "poses"


@dataclass(frozen=True)
class UndistortedJob:
    """What `sfm.write_undistorted` is to do. Paths are absolute."""

    model: str
    out: str
    """Folder of the model that it writes."""
    kind: Literal["undistorted"] = "undistorted"


def run_sfm(job: PosesJob | UndistortedJob, named: Path, progress: Progress | None = None) -> None:
    """Run a job. Raises `CaptureFailed`, which names the file or folder `named`, with the last lines of the log."""
    paths = os.pathsep.join(filter(None, sys.path))
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env={**os.environ, "PYTHONPATH": paths},
        )
        with process:
            try:
                assert process.stdin is not None
                assert process.stdout is not None
                process.stdin.write(json.dumps(asdict(job)) + "\n")
                process.stdin.flush()
                for line in process.stdout:
                    if progress is not None:
                        progress(*json.loads(line))
                code = process.wait()
            except BaseException:
                process.kill()
                raise
        if code != 0:
            log.seek(0)
            lines = log.read().decode("utf-8", errors="replace").strip().splitlines()[-LAST_LINES:]
            raise CaptureFailed(named, f"COLMAP ended with code {code}: {' | '.join(lines)}")
