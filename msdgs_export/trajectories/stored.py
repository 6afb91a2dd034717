"""Spline control points of poses in 8 or 16 bits, and the part of a graph that blends four of them per Gaussian."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from onnx import TensorProto

from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.trajectories.splines import time_weights


@dataclass(frozen=True)
class StoredPoses:
    """Control points [M, n, 10] as integers; each column of each Gaussian has its own range. More columns are of
    opacities and SH.

    In 16 bits the resolution is 1/65,534 of the range of a Gaussian's motion; that of float16 is 1/2,048 of the largest
    value.
    """

    points: npt.NDArray[np.int16] | npt.NDArray[np.uint8]  # [M, n, 10]
    steps: npt.NDArray[np.float32]  # [M, 10]
    middles: npt.NDArray[np.float32]  # [M, 10] the value of the integer 0

    @classmethod
    def of(cls, control: np.ndarray, bits: int = 16) -> "StoredPoses":
        """Rounded from control points, [M, n, 10], to 8 or 16 bits."""
        most = 2 ** (bits - 1) - 1
        low, high = control.min(axis=1), control.max(axis=1)
        middles = ((low + high) / 2).astype(np.float32)
        steps = np.maximum(np.maximum(high - middles, middles - low) / most, 1e-30).astype(np.float32)
        points = np.round((control - middles[:, None]) / steps[:, None]).clip(-most, most)
        if bits == 8:  # unsigned: graphs cast no int8
            return cls((points + most).astype(np.uint8), steps, middles - most * steps)
        return cls(points.astype(np.int16), steps, middles)

    def control(self) -> np.ndarray:
        """[M, n, 10] the control points as a graph reads them."""
        return self.points * self.steps[:, None] + self.middles[:, None]


@dataclass(frozen=True)
class GriddedPoses:
    """Poses of H Gaussians, each on one of several grids of times."""

    grids: tuple[tuple[npt.NDArray[np.int64], StoredPoses], ...]  # indices among the H, and their poses

    def __len__(self) -> int:
        return sum(len(rows) for rows, _ in self.grids)

    @property
    def order(self) -> npt.NDArray[np.int64]:
        """[H] indices of the Gaussians in the order of the grids."""
        return np.concatenate([np.empty(0, np.int64), *(rows for rows, _ in self.grids)])


def at_time(graph: GraphBuilder, poses: GriddedPoses, time_range: tuple[float, float]) -> str:
    """[H, 10] poses of all Gaussians at `t`, in their `order`.

    The next four control points of each grid are read in one piece and blended in one product. Doing this for all
    Gaussians once per frame takes a quarter of the time of looking up the rows of the given ids.
    """
    counts = [stored.points.shape[1] for _, stored in poses.grids]
    cells, weights = time_weights(graph, "poses.clock", time_range, counts)
    neighbors = graph.constant("poses.neighbours", np.arange(4, dtype=np.int64))
    shape = graph.constant("poses.shape", np.array([-1, poses.grids[0][1].points.shape[2]], np.int64))
    parts = []
    for g, (_, stored) in enumerate(poses.grids):
        name, which = f"poses.grid{g}", graph.constant(f"poses.grid{g}.which", np.array([g], np.int64))
        times = graph.node("Add", [graph.node("Gather", [cells, which], f"{name}.cell"), neighbors], f"{name}.times")
        points = stored.points.transpose(1, 0, 2).reshape(counts[g], -1)
        near = graph.node("Gather", [graph.constant(f"{name}.points", points), times], f"{name}.near")
        near = graph.node("Cast", [near], f"{name}.float", to=TensorProto.FLOAT)  # [4, M · 10]
        blended = graph.node(
            "MatMul", [graph.node("Gather", [weights, which], f"{name}.weights"), near], f"{name}.blended"
        )
        parts.append(graph.node("Reshape", [blended, shape], f"{name}.pose"))
    blended = graph.node("Concat", parts, "poses.blended", axis=0)
    steps = graph.constant("poses.steps", np.concatenate([stored.steps for _, stored in poses.grids]))
    middles = graph.constant("poses.middles", np.concatenate([stored.middles for _, stored in poses.grids]))
    return graph.node("Add", [graph.node("Mul", [blended, steps], "poses.scaled"), middles], "poses.raw")


def of_ids(graph: GraphBuilder, poses: GriddedPoses, time_range: tuple[float, float]) -> str:
    """[M, 10] poses of `ids` at `t`."""
    places = np.empty(len(poses), np.int64)
    places[poses.order] = np.arange(len(poses))
    rows = graph.node("Gather", [graph.constant("poses.places", places), "ids"], "poses.rows")
    return graph.node("Gather", [at_time(graph, poses, time_range), rows], "poses.of_ids")
