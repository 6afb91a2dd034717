"""`.ksplat`, the format of mkkellogg's viewer: gaussforge makes a PLY of it."""

import importlib.util
import tempfile
from pathlib import Path

from export.importers.errors import ImportFailed
from export.importers.splats.base import Splats
from export.importers.splats.ply import read_ply


def read_ksplat(file: Path) -> Splats:
    """The Gaussians of a `.ksplat` file of any compression level.

    Raises `ImportFailed` for a damaged file, or if gaussforge isn't installed.
    """
    if importlib.util.find_spec("gaussforge") is None:
        raise ImportFailed(file, "needs gaussforge to be read: pip install '.[ksplat]'")
    import gaussforge  # native code, which crashes on damaged files

    made = gaussforge.GaussForge().convert(file.read_bytes(), "ksplat", "ply")
    if "error" in made:
        raise ImportFailed(file, made["error"].removeprefix("ksplat read failed: "))
    with tempfile.NamedTemporaryFile(suffix=".ply") as ply:
        ply.write(made["data"])
        ply.flush()
        try:
            return read_ply(Path(ply.name))
        except ImportFailed as error:
            raise ImportFailed(file, f"is damaged: {error.problem}") from None
