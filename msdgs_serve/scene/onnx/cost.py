"""What a call of a graph takes at most, from shapes alone: it doesn't depend on the time or on any other value."""

from dataclasses import dataclass

PRODUCT = 1000
"""Operations that beginning one matrix product of a stack counts as."""


@dataclass(frozen=True)
class GraphLimits:
    """What a scene may take at most. A frame poses all moving Gaussians, in one call or several."""

    gaussians: int = 40_000_000
    """Moving and static ones: as many as 2 GiB hold, the most that an ONNX file has."""

    memory_bytes: int = 2 << 30
    """Of one call, and of what a frame's calls return. Calls may run side by side, one on each thread."""

    operations: float = 1e13
    """Of one frame: about four minutes of two cores, and ten times a network of the paper's size with 100,000 moving
    Gaussians. Frames end between calls where nobody waits for them any longer."""

    call_operations: float = 2e11
    """Of one call, which can't be interrupted: a few seconds."""


UNLIMITED = GraphLimits(*[2**62] * 4)
"""To compare costs."""


@dataclass(frozen=True)
class CallCost:
    """Upper bounds of one call: the values of all nodes, as if none were let go before the end, and the operations.
    Memory begins with what all calls of a frame return."""

    memory_bytes: int = 0
    operations: int = 0

    def plus(self, memory_bytes: int, operations: int) -> "CallCost":
        """With one more node."""
        return CallCost(self.memory_bytes + memory_bytes, self.operations + operations)

    def problem(self, limits: GraphLimits, calls: int) -> str | None:
        """What is above its limit, where a frame makes so many calls; None if nothing is."""
        frame = self.operations * calls
        if self.memory_bytes > limits.memory_bytes:
            taken, allowed = self.memory_bytes / 2**20, limits.memory_bytes / 2**20
            return f"takes a frame to {taken:,.0f} MiB of values; allowed are {allowed:,.0f} MiB"
        if self.operations > limits.call_operations:
            return f"takes a call to {self.operations:.2g} operations; allowed are {limits.call_operations:.2g}"
        if frame > limits.operations:
            return f"takes a frame to {frame:.2g} operations; allowed are {limits.operations:.2g}"
        return None
