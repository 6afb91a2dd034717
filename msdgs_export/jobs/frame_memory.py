"""Memory of one frame of a scene file, measured in a process that loads only the service's modules.

`frame_memory` runs this module as that process, which gets a request as its argument and prints bytes.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import as_trained, rasterize
from msdgs_serve.scene.metadata import SceneCamera

if TYPE_CHECKING:
    from msdgs_export.progress import Track

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
RESET_PEAK = "5"
EAGER = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "0", "MALLOC_ARENA_MAX": "1"}
"""Makes glibc return freed memory at once; otherwise a file would reuse memory of the one before."""


def frame_memory(paths: Sequence[Path], view: SceneCamera, track: Track) -> list[int | None]:
    """Peak bytes of loading each file and drawing one of its frames, above the memory of the process before."""
    request = json.dumps({"paths": [str(path.resolve()) for path in paths], "view": view.to_plain()})
    command = [sys.executable, "-m", "msdgs_export.jobs.frame_memory", request]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    on_file, found = track("memory of a frame", len(paths) + 1), list[int | None]()
    with subprocess.Popen(
        command, cwd=Path(__file__).resolve().parents[2], env=os.environ | EAGER, **streams
    ) as process:
        for line in process.stdout or ():
            found.append(json.loads(line))
            on_file()
    return found[1:] if process.returncode == 0 else [None] * len(paths)


def main() -> None:
    """Print a number per line: one per file, after one that doesn't count, as it includes libraries and kernels."""
    request: dict[str, Any] = json.loads(sys.argv[1])
    for path in [*request["paths"][:1], *request["paths"]]:
        print(json.dumps(_peak(path, SceneCamera.from_plain(request["view"]))), flush=True)


def _peak(path: str, view: SceneCamera) -> int | None:
    gc.collect()
    try:
        CLEAR.write_text(RESET_PEAK)
        before = _status("VmRSS")
        _draw(path, view)
        return max(0, _status("VmHWM") - before)
    except (OSError, KeyError):  # not Linux
        return None


def _draw(path: str, view: SceneCamera) -> None:
    session = DeformationSession(path)
    rasterize(session.gaussians(view.t), view.camera, options=as_trained(session.scene.metadata))


def _status(name: str) -> int:
    """Bytes in a line of the process's status."""
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
    return 1024 * int(lines[name].split()[0])


if __name__ == "__main__":
    main()
