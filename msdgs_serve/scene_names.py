"""Names and files of scenes that a store can serve."""

import logging
from pathlib import Path

from msdgs_serve.scene import InvalidInput
from msdgs_serve.scene.foreign import START_BYTES, foreign_file

SUFFIX = ".onnx"
MAX_NAME_BYTES = 200
"""Limit in UTF-8, so that a name with prefix and suffix is a valid file name on any file system."""

logger = logging.getLogger("msdgs_serve")


def is_servable_name(name: str) -> bool:
    """Whether a name is printable, without separators, and not hidden as temporary files are."""
    if not (name and name[0] != "." and name.isprintable() and "\\" not in name):
        return False
    return len(name.encode()) <= MAX_NAME_BYTES


def checked(path: Path) -> Path:
    """A path of a scene or of a folder of scenes. Raises `InvalidInput` for what can't be served."""
    if path.is_dir():
        for file in path.iterdir():
            if file.suffix != SUFFIX and file.suffix.lower() == SUFFIX:
                logger.warning("%s is not served, as its name doesn't end with %s in small letters", file, SUFFIX)
        return path
    if not path.is_file():
        raise InvalidInput("paths", f"{SUFFIX} files and folders of them", f"{path}, which does not exist")
    if path.suffix != SUFFIX:
        with path.open("rb") as file:
            other = foreign_file(file.read(START_BYTES), str(path))
        in_capitals = ", not in small letters" if path.suffix.lower() == SUFFIX else ""
        hint = f", which {other}" if other else in_capitals
        raise InvalidInput("paths", f"{SUFFIX} files and folders of them", f"{path}{hint}")
    if not is_servable_name(path.stem):
        raise InvalidInput("paths", "files with printable, unhidden names", repr(path.name))
    return path
