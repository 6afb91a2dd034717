"""Upper bounds of the cost of a graph call, computed from shapes only."""

from dataclasses import dataclass

PRODUCT = 1000
"""Operations that the overhead of one matrix product in a stack counts as."""


@dataclass(frozen=True)
class GraphLimits:
    """Limits of a scene's cost. A frame poses all moving Gaussians, in one or several calls."""

    gaussians: int = 40_000_000
    """Moving and static Gaussians; the default is what fits into 2 GiB, the largest ONNX file."""

    memory_bytes: int = 2 << 30
    """Values of one call and the outputs of all calls of a frame. Calls may run in parallel, one per thread."""

    operations: float = 1e13
    """Operations per frame: the default takes two cores about four minutes, ten times as long as a network of the
    paper's size with 100,000 moving Gaussians. Cancelled renders end between calls."""

    call_operations: float = 2e11
    """Operations per call, which can't be interrupted: a few seconds."""


UNLIMITED = GraphLimits(*[2**62] * 4)
"""No limits, to compare costs."""


@dataclass(frozen=True)
class CallCost:
    """Upper bounds of one call: memory of the values of all nodes, none of them freed before the end, plus the outputs
    of all calls of a frame; and operations."""

    memory_bytes: int = 0
    operations: int = 0

    def plus(self, memory_bytes: int, operations: int) -> "CallCost":
        """Return the cost with one more node."""
        return CallCost(self.memory_bytes + memory_bytes, self.operations + operations)

    def problem(self, limits: GraphLimits, calls: int) -> str | None:
        """Return the message of the first exceeded limit, for `calls` per frame, or None."""
        frame = self.operations * calls
        if self.memory_bytes > limits.memory_bytes:
            taken, allowed = self.memory_bytes / 2**20, limits.memory_bytes / 2**20
            return f"brings a frame to {taken:,.0f} MiB of values; the limit is {allowed:,.0f} MiB"
        if self.operations > limits.call_operations:
            taken, allowed = self.operations, limits.call_operations
            return f"brings a call to {taken:.2g} operations; the limit is {allowed:.2g}"
        if frame > limits.operations:
            return f"brings a frame to {frame:.2g} operations; the limit is {limits.operations:.2g}"
        return None
