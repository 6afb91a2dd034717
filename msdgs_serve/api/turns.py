"""Whose turn it is: clients one after the other, single frames between those of batches and films."""

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")

PART_INTERVAL = 4
"""While both wait, one in so many turns is of a batch or a film; the others are of single frames."""


class Turns(Generic[Item]):
    """Work in line. Not safe to use from several threads."""

    def __init__(self) -> None:
        self._singles: dict[str, deque[Item]] = {}  # by client, whose turn comes first first; none is empty
        self._parts: dict[str, deque[Item]] = {}
        self._singles_in_a_row = 0

    def add(self, item: Item, client: str, *, part: bool) -> None:
        """Behind what the client has in line. `part`: of a batch or a film."""
        lines = self._parts if part else self._singles
        lines.setdefault(client, deque()).append(item)

    def remove(self, item: Item) -> None:
        """Whoever waited for it is gone. Nothing happens where it isn't in line."""
        for lines in (self._singles, self._parts):
            for client, line in lines.items():
                if item in line:
                    line.remove(item)
                    if not line:
                        del lines[client]
                    return

    def next(self) -> Item | None:
        """What is done now, out of the line; None where nothing waits."""
        if not (self._singles or self._parts):
            return None
        is_part = not self._singles or (bool(self._parts) and self._singles_in_a_row >= PART_INTERVAL - 1)
        self._singles_in_a_row = 0 if is_part else self._singles_in_a_row + 1
        lines = self._parts if is_part else self._singles
        client = next(iter(lines))
        line = lines.pop(client)
        item = line.popleft()
        if line:
            lines[client] = line  # its next turn is after everybody else's
        return item
