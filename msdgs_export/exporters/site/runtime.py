"""The files of onnxruntime-web that a site holds: of a folder, or fetched by npm and kept in the user's cache."""

import json
import os
import shutil
import subprocess
from pathlib import Path

from rich.console import Console

from msdgs_serve.browser import RUNTIME, RUNTIME_FILES, runtime_files
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.writing import temporary_folder

LOCK = ("package.json", "package-lock.json")
"""Files beside this module that name the version and the hashes of what npm fetches."""
HERE = Path(__file__).parent
VERSION: str = json.loads((HERE / LOCK[0]).read_text())["dependencies"][RUNTIME]
SHOWN_LINES = 3
"""Of npm's messages, in an error."""


class RuntimeMissing(MsdgsError):
    """The files of onnxruntime-web are neither given nor kept, and npm can't fetch them."""

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"{RUNTIME} {VERSION}, which poses the scene in browsers, can't be fetched: {reason}. Where npm works, run "
            f"`npm install --ignore-scripts --prefix DIR {RUNTIME}@{VERSION}`, then give "
            f"--onnxruntime-web DIR/node_modules/{RUNTIME}"
        )


def site_runtime(folder: Path | None, console: Console) -> dict[str, bytes]:
    """The contents of the files by name, as `runtime_files` has them.

    `folder` holds them; by default the user's cache, which npm fills the first time. Raises `InvalidInput` if a file is
    missing there, `RuntimeMissing` and `WriteFailed`.
    """
    if folder is not None:
        return runtime_files(folder)
    kept = cache_folder()
    if not kept.is_dir():
        with console.status(f"npm fetches {RUNTIME} {VERSION}"):
            _fetch(kept)
    return runtime_files(kept)


def cache_folder() -> Path:
    """The folder of this version in the user's cache."""
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "msdgs" / f"{RUNTIME}-{VERSION}"


def _fetch(kept: Path) -> None:
    npm = shutil.which("npm")
    if npm is None:
        raise RuntimeMissing("there is no npm")
    kept.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(kept.parent, kept) as folder:
        for name in LOCK:
            shutil.copy(HERE / name, folder)
        command = [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
        if done.returncode:
            told = "; ".join(done.stderr.strip().splitlines()[:SHOWN_LINES])
            raise RuntimeMissing(f"`npm ci` says: {told}")
        fetched = folder / RUNTIME
        fetched.mkdir()
        for name in RUNTIME_FILES:
            shutil.move(folder / "node_modules" / RUNTIME / "dist" / name, fetched)
        fetched.rename(kept)
