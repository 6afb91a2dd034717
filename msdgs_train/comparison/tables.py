"""Systems and scenes are tables of TOML files."""

import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from msdgs_serve.scene.errors import InvalidInput


def read_tables(field: str, path: Path) -> dict[str, Mapping[str, Any]]:
    """Return the tables of a TOML file by their names. Raises `InvalidInput` naming `field` and the file."""
    try:
        contents = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInput(field, "a readable file", f"{path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidInput(field, "a TOML file", f"{path}: {error}") from error
    for name, table in contents.items():
        if not isinstance(table, dict) or not re.fullmatch(r"\w[\w .+=-]*", name):
            raise InvalidInput(field, "tables named with letters, digits, spaces and .+=-", f"{path}: `{name}`")
    return contents


def require_unique(kind: str, given: Iterable[str]) -> None:
    """Raise `InvalidInput` if no name is given, or one twice."""
    names = list(given)
    if not names:
        raise InvalidInput(kind, "given, one or more", "none")
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InvalidInput(kind, "named once", f"`{name}` twice")
