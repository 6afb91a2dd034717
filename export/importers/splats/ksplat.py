"""`.ksplat`, the format of mkkellogg's viewer, converted to PLY by gaussforge in a process with bounded memory."""

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

from export.importers.errors import ImportFailed
from export.importers.splats.base import Splats
from export.importers.splats.ply import read_ply
from msdgs_serve.scene.errors import InvalidInput

MEMORY, MEMORY_PER_BYTE = 1 << 30, 32
"""Address space of that process: a constant, and per byte of the file. A Gaussian of 24 bytes becomes one of 68."""

SECONDS = 120.0

_PROGRAM = Path(__file__).with_name("ksplat_process.py")


def read_ksplat(file: Path) -> Splats:
    """Read a `.ksplat` file of any compression level. Raises `ImportFailed` for a damaged file, and `InvalidInput` if
    gaussforge isn't installed."""
    if importlib.util.find_spec("gaussforge") is None:
        raise InvalidInput("input", "another format, or pip install '.[ksplat]' to read .ksplat", str(file))
    with tempfile.TemporaryDirectory(prefix="msdgs-ksplat-") as folder:
        ply = Path(folder) / "made.ply"
        memory = MEMORY + MEMORY_PER_BYTE * file.stat().st_size
        command = [sys.executable, "-I", str(_PROGRAM), str(file), str(ply), str(memory)]
        try:
            done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=SECONDS, check=False)
        except subprocess.TimeoutExpired:
            raise ImportFailed(file, f"is damaged: its reader didn't end within {SECONDS:.0f} s") from None
        if done.returncode < 0:
            raise ImportFailed(file, f"is damaged: its reader died of signal {-done.returncode}")
        if done.returncode:
            problem = done.stderr.strip().rpartition("\n")[2]
            raise ImportFailed(file, problem.removeprefix("ksplat read failed: "))
        try:
            return read_ply(ply)
        except ImportFailed as error:
            raise ImportFailed(file, f"is damaged: {str(error).removeprefix(f'{ply}: ')}") from None
