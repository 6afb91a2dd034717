"""Files that people give in place of a scene file, and what to do with them."""

import codecs

LFS_POINTER = "is a Git LFS pointer, the text that stands for a file not fetched yet: `git lfs pull` fetches it"
TEXT = "is a text, not a scene file: `msdgs-export model.pt` writes one"
START_BYTES = 1024
"""Of a file, by which it is known."""

SPLATS = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".ply.gz", ".zip")
MODELS = (".pt", ".pth")


def is_lfs_pointer(start: bytes) -> bool:
    """Whether a file that begins so is a pointer of Git LFS."""
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    return text.startswith(b"version http") and b"\noid sha256:" in text.replace(b"\r", b"")


def foreign_file(start: bytes, name: str) -> str | None:
    """What a file is that begins so, as the predicate of a sentence with the remedy, by its contents or otherwise its
    name; None if it may be a scene file."""
    if is_lfs_pointer(start):
        return LFS_POINTER
    if start.startswith(b"PK") and b"data.pkl" in start:
        return _to_import("a model", name)
    if start.startswith(b"PK"):
        return foreign_name(name) or f"{_to_import('a zip', name)} if it holds a splat"
    if start.startswith((b"ply\n", b"ply\r", b"NGSP", b"\x1f\x8b")):
        return _to_import("a splat", name)
    if other := foreign_name(name):
        return other
    return TEXT if _is_text(start) else None


def _is_text(start: bytes) -> bool:
    try:
        text = codecs.getincrementaldecoder("utf-8")().decode(start)  # the last character may be cut off
    except UnicodeDecodeError:
        return False
    return bool(text) and all(character.isprintable() or character in "\t\n\r\ufeff" for character in text)


def foreign_name(name: str) -> str | None:
    """As `foreign_file`, by the name alone."""
    if name.lower().endswith(MODELS):
        return _to_import("a model", name)
    return _to_import("a splat", name) if name.lower().endswith(SPLATS) else None


def _to_import(what: str, name: str) -> str:
    return f"is {what}, not a scene file: `msdgs-export {name}` turns it into one"
