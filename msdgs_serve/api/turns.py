"""Round-robin order of work: clients in turn, single frames between parts of batches and videos."""

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")

PART_INTERVAL = 4
"""While both wait, one in so many items is part of a batch or video; the others are single frames."""


class Turns(Generic[Item]):
    """Waiting work. Not safe to use from several threads."""

    def __init__(self) -> None:
        self._singles: dict[str, deque[Item]] = {}  # by client, in order of turns; no queue is empty
        self._parts: dict[str, deque[Item]] = {}
        self._singles_in_a_row = 0

    def __len__(self) -> int:
        return sum(map(len, self._singles.values())) + sum(map(len, self._parts.values()))

    def add(self, item: Item, client: str, *, part: bool) -> None:
        """Append an item to the client's queue. `part`: it belongs to a batch or a video."""
        queues = self._parts if part else self._singles
        queues.setdefault(client, deque()).append(item)

    def remove(self, item: Item) -> None:
        """Remove an item whose client is gone, if it still waits."""
        for queues in (self._singles, self._parts):
            for client, queue in queues.items():
                if item in queue:
                    queue.remove(item)
                    if not queue:
                        del queues[client]
                    return

    def next(self) -> Item | None:
        """Remove and return the next item, or None if nothing waits."""
        if not (self._singles or self._parts):
            return None
        is_part = not self._singles or (bool(self._parts) and self._singles_in_a_row >= PART_INTERVAL - 1)
        self._singles_in_a_row = 0 if is_part else self._singles_in_a_row + 1
        queues = self._parts if is_part else self._singles
        client = next(iter(queues))
        queue = queues.pop(client)
        item = queue.popleft()
        if queue:
            queues[client] = queue  # to the end of the round
        return item
