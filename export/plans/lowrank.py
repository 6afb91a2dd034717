"""Plan `lowrank:r`: a pose is its mean over time plus r coefficients of the Gaussian times r functions of time.

A function of time has all ten numbers of a pose, so a frame is one product [M, r + 10] × [r + 10, 10]. The functions
are the singular vectors of all trajectories, with positions, scales and rotations weighted to be displacements in scene
units: no other r functions have a smaller squared error. Scales are linear, since logarithms fall without bound when a
Gaussian vanishes: on *toybench* 99 % of the errors are a quarter smaller. Quaternions are multiplied by their weight,
which normalization removes again.
"""

from collections.abc import Iterator

import numpy as np
import onnx
from scipy.linalg import eigh

from export.jobs.bake import Baked
from export.layers.graph import GraphBuilder
from export.plans.base import Plan, PlanSpec
from export.plans.scene_graph import activated, finished, new_graph
from export.trajectories.adaptive import CHUNK, adaptive_knots, worst
from export.trajectories.poses import POSE, QUATS
from export.trajectories.sampling import Ids, Samples, Trajectories
from export.trajectories.splines import along_time, design, fitting, samples_for, time_weights
from export.trajectories.stored import at_time

KNOTS = 131
"""Number of control points of each function of time."""

RANKS = (1, 2, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)

OWN_TERMS = 1_000
"""Cost of a Gaussian with poses of its own, in time and bytes, in terms of one Gaussian."""

SAMPLED = 4_096
"""Number of Gaussians by which r is chosen."""


def lowrank(baked: Baked, spec: PlanSpec, trajectories: Trajectories) -> onnx.ModelProto:
    """The scene with `spec.count` terms, or with the cheapest number within `spec.max_pixels`."""
    fit = _Fit(trajectories)
    first_guess = fit.functions(np.arange(trajectories.count))
    rank = spec.count or RANKS[len(RANKS) // 2]
    outliers = worst(trajectories, fit.errors(np.arange(trajectories.count), first_guess[:, :rank]), None)
    functions = fit.functions(np.setdiff1d(np.arange(trajectories.count), outliers))
    if spec.max_pixels:
        rank = _cheapest(trajectories, fit, functions, spec.max_pixels)
    functions = functions[:, :rank]
    errors = fit.errors(np.arange(trajectories.count), functions)
    chosen = worst(trajectories, errors, spec.max_pixels)
    most = spec.max_pixels or np.delete(errors, chosen).max(initial=0) / trajectories.pixel
    own, own_errors = adaptive_knots(trajectories, chosen, most)
    errors[chosen] = own_errors
    graph, time_range = new_graph(baked), baked.scene.metadata.time_range
    pose = _product(graph, fit.table(functions), fit.basis(functions), time_range)
    if len(own):
        places = graph.constant("own.places", chosen[own.order][:, None])
        pose = graph.node("ScatterND", [pose, places, at_time(graph, own, time_range)], "own.merged")
    activated(graph, graph.node("Gather", [pose, "ids"], "ids.pose"))
    return finished(graph, baked, str(spec), trajectories.error_bound(errors, len(own)))


def _cheapest(trajectories: Trajectories, fit: "_Fit", functions: np.ndarray, pixels: float) -> int:
    ids = np.arange(0, trajectories.count, -(-trajectories.count // SAMPLED))

    def terms(rank: int) -> float:
        return rank + OWN_TERMS * float((fit.errors(ids, functions[:, :rank]) > pixels * trajectories.pixel).mean())

    return min((rank for rank in RANKS if rank <= functions.shape[1]), key=terms)


def _product(graph: GraphBuilder, table: np.ndarray, basis: np.ndarray, time_range: tuple[float, float]) -> str:
    """[N, 10] a table of coefficients and mean poses, times the functions at `t` stacked on an identity."""
    rank = basis.shape[1]
    cells, weights = time_weights(graph, "terms.clock", time_range, [KNOTS])
    near = graph.node("Add", [cells, graph.constant("terms.neighbours", np.arange(4, dtype=np.int64))], "terms.near")
    control = graph.node("Gather", [graph.constant("terms.control", basis.reshape(KNOTS, -1)), near], "terms.points")
    shape = graph.constant("terms.shape", np.array([rank, POSE], np.int64))
    functions = graph.node("Reshape", [graph.node("MatMul", [weights, control], "terms.flat"), shape], "terms.now")
    identity = graph.constant("terms.mean", np.eye(POSE, dtype=np.float32))
    factors = graph.node("Concat", [functions, identity], "terms.factors", axis=0)
    return graph.node("MatMul", [graph.constant("coefficients", table), factors], "terms.pose")


class _Fit:
    """Trajectories as rows of a matrix, [N, 131 · 10] control points in pixels, relative to the mean pose."""

    def __init__(self, trajectories: Trajectories) -> None:
        self._trajectories = trajectories
        times = samples_for(KNOTS)
        self._times = times
        self._fitting = fitting(KNOTS, times).astype(np.float32)
        self._design = design(KNOTS, times).astype(np.float32)

    def functions(self, ids: Ids) -> np.ndarray:
        """[131 · 10, R] right singular vectors, the most important first; at most one per Gaussian."""
        size = KNOTS * POSE
        if len(ids) < size:
            matrix = np.concatenate([np.zeros((1, size), np.float32), *(self._rows(rows)[0] for rows in _chunks(ids))])
            return np.linalg.svd(matrix, full_matrices=False)[2][: RANKS[-1]].T
        gram = np.zeros((size, size))
        for rows in _chunks(ids):
            matrix, _, _ = self._rows(rows)
            gram += matrix.T @ matrix
        return eigh(gram, subset_by_index=(size - RANKS[-1], size - 1))[1][:, ::-1].astype(np.float32)

    def errors(self, ids: Ids, functions: np.ndarray) -> np.ndarray:
        """[M] largest errors of the Gaussians with these functions, scene units."""
        errors = np.empty(len(ids))
        done = 0
        for rows in _chunks(ids):
            matrix, means, samples = self._rows(rows)
            rebuilt = ((matrix @ functions) @ functions.T).reshape(len(rows), KNOTS, POSE) + means[:, None]
            got = along_time(self._design, rebuilt) / self._units(rows)
            got[..., QUATS] /= np.maximum(np.linalg.norm(got[..., QUATS], axis=-1, keepdims=True), 1e-8)
            errors[done : done + len(rows)] = self._trajectories.distances(rows, got - samples)
            done += len(rows)
        return errors

    def table(self, functions: np.ndarray) -> np.ndarray:
        """[N, r + 10] coefficients and mean poses, the quaternions times their weights."""
        table = np.empty((self._trajectories.count, functions.shape[1] + POSE), np.float32)
        for rows in _chunks(np.arange(self._trajectories.count)):
            matrix, means, _ = self._rows(rows)
            table[rows] = np.concatenate([matrix @ functions, means * self._in_scene()], axis=1)
        return table

    def basis(self, functions: np.ndarray) -> np.ndarray:
        """[131, r, 10] control points of the functions, means and scales in scene units."""
        return (functions.T.reshape(-1, KNOTS, POSE) * self._in_scene()).transpose(1, 0, 2).astype(np.float32)

    def _rows(self, ids: Ids) -> tuple[np.ndarray, np.ndarray, Samples]:
        samples = self._trajectories.on_grid(self._times, ids)
        control = along_time(self._fitting, samples) * self._units(ids)
        means = control.mean(axis=1)
        return (control - means[:, None]).reshape(len(ids), -1), means, samples

    def _units(self, ids: Ids) -> np.ndarray:
        """[M, 1, 10] factors from poses to displacements in pixels."""
        units = np.full((len(ids), 1, POSE), 1 / self._trajectories.pixel, np.float32)
        units[..., QUATS] *= self._trajectories.rotation_weights[ids, None, None]
        return units

    def _in_scene(self) -> np.ndarray:
        """[10] factors of the values in the graph: quaternions stay in pixels."""
        return np.array([self._trajectories.pixel] * 6 + [1.0] * 4, np.float32)


def _chunks(ids: Ids) -> Iterator[Ids]:
    for start in range(0, len(ids), CHUNK):
        yield ids[start : start + CHUNK]


LOWRANK = Plan(
    "lowrank",
    f"lowrank:r, r functions of time, 1 to {RANKS[-1]}",
    "#3ca951",
    lambda baked, spec, sample: lowrank(baked, spec, sample()),
    candidates=lambda layers: ["lowrank:0.5", "lowrank:0.1"],
    counts=range(1, RANKS[-1] + 1),
    fitted=True,
)
