"""What a reader does with each field of a format.

Every field that a format defines, or that programs in use write, is in a table: it is applied, or refused by name if it
would change the result, or harmless. docs/formats.md shows the tables. Fields in no table are warned about, or refused
where the format has a version.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal

FieldUse = Literal["applied", "refused", "harmless"]


@dataclass(frozen=True)
class FieldTable:
    """The fields of one format. Names may be patterns with `*`; the first that fits counts."""

    format: str
    uses: Mapping[str, FieldUse]

    def use(self, name: str) -> FieldUse | None:
        """What is done with a field; None if it is in no table."""
        return next((use for pattern, use in self.uses.items() if fnmatchcase(name, pattern)), None)

    def unlisted(self, names: Iterable[str]) -> list[str]:
        """Those of `names` that the table doesn't have, in their order."""
        return [name for name in names if self.use(name) is None]
