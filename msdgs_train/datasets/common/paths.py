"""Files that a dataset names, found although other systems spell their names differently.

Backslashes are separators. Where the exact name doesn't exist, one that differs in letter case or in the Unicode form
of its letters is read, if it is the only one: Windows and macOS don't tell these apart.
"""

import difflib
import os
import unicodedata
from pathlib import Path, PurePosixPath, PureWindowsPath


def posix(name: str) -> PurePosixPath:
    """The path that a file names, whatever its separators."""
    return PurePosixPath(name.replace("\\", "/"))


def find_file(folder: Path, name: str | PurePosixPath, endings: tuple[str, ...] = ()) -> Path | None:
    """Find the file that `name`, relative to `folder` or absolute, means, with one of `endings` added if there is none
    of that name; None if there is none."""
    path = posix(str(name))
    if not path.name:
        return None
    parent = _find_folder(folder, path.parent)
    if parent is None:
        return None
    names = [path.name, *(path.name + ending for ending in endings)]
    exact = (parent / each for each in names)
    similar = (parent / known for each in names if (known := _similar(parent, each)))
    return next((found for found in (*exact, *similar) if found.is_file()), None)


def not_found(folder: Path, name: str | PurePosixPath) -> str:
    """Why `find_file` found nothing, and what is there instead; the end of a message about `name`."""
    path = posix(str(name))
    if path.is_absolute() or PureWindowsPath(str(path)).drive:
        here = next((tail for tail in _tails(path) if find_file(folder, tail)), None)
        hint = f": {here} is in {folder}" if here else ""
        return f"there is no such file; give paths relative to {folder}{hint}"
    parent = _find_folder(folder, path.parent)
    if parent is None:
        return f"there is no such file: there is no folder {folder / path.parent}"
    close = difflib.get_close_matches(path.name, _names(parent), 1)
    return "there is no such file" + (f"; there is {close[0]!a} in {parent}" if close else "")


def _find_folder(folder: Path, path: PurePosixPath) -> Path | None:
    if (folder / path).is_dir():
        return folder / path
    for part in path.parts:
        known = part if (folder / part).is_dir() else _similar(folder, part)
        if known is None:
            return None
        folder = folder / known
    return folder


def _tails(path: PurePosixPath) -> list[PurePosixPath]:
    """The path without its first parts, the longest first."""
    return [PurePosixPath(*path.parts[first:]) for first in range(1, len(path.parts))]


def _similar(folder: Path, name: str) -> str | None:
    """The only name in the folder that differs from `name` in nothing but letter case and Unicode form."""
    found = [known for known in _names(folder) if _folded(known) == _folded(name)]
    same_letters = [known for known in found if _composed(known) == _composed(name)]
    found = same_letters or found
    return found[0] if len(found) == 1 else None


def _composed(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def _folded(name: str) -> str:
    return name.lower() if name.isascii() else _composed(_composed(name).casefold())


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []
