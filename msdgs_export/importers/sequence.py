"""A folder of numbered splat files, one per frame, to a moving scene.

If the n-th Gaussian of a frame is the n-th of the next, frames are blended: they are points of a cubic spline, plan
`keyframes`. Otherwise frames are switched: the scene holds the Gaussians of all frames, and a graph shows those of the
frame nearest in time. Opacities are constants of such a scene, so Gaussians of other frames are moved far below it and
scaled down to the smallest size, plan `frames`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto
from scipy.spatial import KDTree

from msdgs_export.bake import Baked, Moving
from msdgs_export.importers.detect import frame_files
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.placement import placement
from msdgs_export.importers.scene import UP, metadata_of
from msdgs_export.importers.splats.base import Splats
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.measure.poses import half_diagonal
from msdgs_export.plans.scene_graph import activated, changing_output, finished, new_graph
from msdgs_export.trajectories.poses import POSE
from msdgs_export.trajectories.sampling import give_one_sign
from msdgs_export.trajectories.splines import design
from msdgs_export.trajectories.stored import GriddedPoses, StoredPoses, of_ids
from msdgs_serve.scene.baked import APPEARANCE, MOVING_OUTPUTS, BakedScene
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.metadata import SceneMetadata
from msdgs_serve.scene.similarity import Similarity
from msdgs_train.gaussians.scale_space import MIN_SCALE

CONSTANT = 0.02
"""Opacities and SH coefficients that differ by no more between frames are those of the first: two steps of 8 bits."""

APART = 3.0
"""Largest growth of the distance to the nearest neighbor in the next frame, for 90 % of the Gaussians."""

SAMPLED = 5_000

PARKED_AT = 1e6
"""Half diagonals of the scene's bounds below its middle."""

MAX_GAUSSIANS = 1 << 26
"""Gaussians of all frames together."""

LEAST_UNEVEN = 1.01
"""Ratio of the largest and the smallest difference of the numbers of frames."""

UNEVEN = "the numbers in the names of its frames are unevenly spaced, but frames get evenly spaced times"


@dataclass(frozen=True)
class Frames:
    """Frames at evenly spread times from 0 to 1."""

    gaussians: tuple[Gaussians, ...]
    dropped: int
    antialiasing: str
    blended: bool
    up: np.ndarray | None = None  # [3] unit, if a file says so
    warnings: tuple[str, ...] = ()  # of the files, each once
    offset: np.ndarray | None = None  # [3] float64, of the Gaussians' origin in the files, if they are far from its own

    def times(self) -> list[float]:
        """The times of the frames."""
        return np.linspace(0, 1, len(self.gaussians)).tolist()

    @cached_property
    def changing(self) -> tuple[str, ...]:
        """Those of opacities and SH that depend on time if frames are blended."""
        return tuple(name for name in APPEARANCE if self._differ(name, CONSTANT).any())

    @cached_property
    def parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the Gaussians that move or change, and of those that are the same in all frames."""
        moves = np.any([self._differ(name) for name in MOVING_OUTPUTS], axis=0)
        moves = np.any([moves, *(self._differ(name, CONSTANT) for name in self.changing)], axis=0)
        return np.flatnonzero(moves), np.flatnonzero(~moves)

    def _differ(self, name: str, most: float = 0.0) -> np.ndarray:
        """[N] whether an array of a Gaussian differs by more than `most` from that of the first frame."""
        first, *rest = (getattr(frame, name) for frame in self.gaussians)
        columns = tuple(range(1, first.ndim))
        return np.any([(np.abs(array - first) > most).any(axis=columns) for array in rest], axis=0)


def read_sequence(folder: Path, how: str | None = None, on_frame: Callable[[], object] = lambda: None) -> Frames:
    """Read all numbered files of a folder. `how`: `blend`, `switch`, or None to decide by their contents.

    Raises `ImportFailed` if a file can't be read, there is only one, or frames that don't correspond are to be blended.
    """
    numbers = frame_files(folder)
    files = list(numbers)
    if len(files) < 2:
        raise ImportFailed(folder, "holds no two or more numbered .ply, .sog, .spz, .splat or .ksplat files")
    read: list[Splats] = []
    for file in files:
        read.append(read_splats(file))
        if read[-1].motion is not None:
            raise ImportFailed(folder, f"{file.name} has Gaussians that move by themselves, and is a scene alone")
        if sum(map(len, read)) > MAX_GAUSSIANS:
            raise ImportFailed(
                folder, f"has more than {MAX_GAUSSIANS:,} Gaussians in {len(read)} of {len(files)} frames"
            )
        on_frame()
    modes, degrees = {each.antialiasing for each in read}, {each.gaussians.sh_degree for each in read}
    if len(modes) > 1 or len(degrees) > 1:
        found = f"anti-aliasing {sorted(modes)} and SH of degrees {sorted(degrees)}"
        raise ImportFailed(folder, f"its frames differ in properties of the whole scene: {found}")
    ups = {tuple(each.up.tolist()): each.up for each in read if each.up is not None}
    if len(ups) > 1:
        raise ImportFailed(folder, f"its frames say that different directions are up: {sorted(ups)}")
    offset = next((each.offset for each in read if each.offset is not None), None)
    origin = np.zeros(3) if offset is None else offset
    frames, dropped = tuple(each.around(origin) for each in read), sum(each.dropped for each in read)
    problem = None if how == "switch" else _why_not_blended(frames, any(each.dropped for each in read))
    if how == "blend" and problem:
        raise ImportFailed(folder, f"can't be blended: {problem}")
    steps = np.diff(list(numbers.values()))
    uneven = [UNEVEN] if steps.max() > LEAST_UNEVEN * steps.min() else []
    warnings = tuple(dict.fromkeys([*(warning for each in read for warning in each.warnings), *uneven]))
    blended = problem is None and how != "switch"
    return Frames(frames, dropped, read[0].antialiasing, blended, next(iter(ups.values()), None), warnings, offset)


def sequence_scene(sequence: Frames, sha256: str) -> onnx.ModelProto:
    """The scene file of a sequence."""
    place = placement(sequence.gaussians, sequence.offset)
    sequence = replace(sequence, gaussians=tuple(frame.scaled(1 / place.scale) for frame in sequence.gaussians))
    return (_blended if sequence.blended else _switched)(sequence, sha256, place)


def posed(sequence: Frames, number: int) -> Gaussians:
    """The Gaussians of one frame in the order of the scene, without those of other frames if they are switched."""
    g = sequence.gaussians[number]
    return _rows(g, np.concatenate(sequence.parts)) if sequence.blended else g


def shown_rows(sequence: Frames, number: int) -> slice:
    """The rows of the scene that belong to one frame."""
    if sequence.blended:
        return slice(None)
    start = sum(map(len, sequence.gaussians[:number]))
    return slice(start, start + len(sequence.gaussians[number]))


def of_the_moment(gaussians: Gaussians, metadata: SceneMetadata) -> Gaussians:
    """The Gaussians of the frame that is shown, without those of other frames if the scene is switched."""
    if not metadata.is_switched:
        return gaussians
    return _rows(gaussians, np.flatnonzero((gaussians.scales > MIN_SCALE).any(axis=1)))


def _rows(gaussians: Gaussians, ids: np.ndarray) -> Gaussians:
    return Gaussians(**{name: array[ids] for name, array in vars(gaussians).items()})


def _why_not_blended(frames: tuple[Gaussians, ...], dropped: bool) -> str | None:
    first = frames[0]
    if dropped:
        return "some of its Gaussians can't be drawn, so the n-th Gaussians of two frames may differ"
    for number, frame in enumerate(frames[1:], start=1):
        if len(frame) != len(first):
            return f"frame 0 has {len(first):,} Gaussians, frame {number} {len(frame):,}"
    for number in range(len(frames) - 1):
        if not _neighbors_stay(frames[number].means, frames[number + 1].means):
            return f"the n-th Gaussian of frame {number} isn't the n-th of the next"
    return None


def _neighbors_stay(now: np.ndarray, later: np.ndarray) -> bool:
    """Whether neighbors stay neighbors in the next frame, which they don't if Gaussians are reordered."""
    if len(now) < 2:
        return True
    chosen = np.unique(np.linspace(0, len(now) - 1, min(len(now), SAMPLED)).astype(int))
    distances, found = (np.asarray(each) for each in KDTree(now).query(now[chosen], k=2))
    nearest, own = found[:, 1], distances[:, 1]
    size = float(np.linalg.norm(now.max(axis=0) - now.min(axis=0)))
    then = np.linalg.norm(later[chosen] - later[nearest], axis=1)
    return float(np.quantile(then / np.maximum(own, 1e-3 * size), 0.9)) <= APART


def _blended(sequence: Frames, sha256: str, place: Similarity) -> onnx.ModelProto:
    frames = sequence.gaussians
    moving, static = sequence.parts
    first, count = frames[0], len(frames)
    means = np.concatenate([f.means for f in frames])
    metadata = metadata_of(means, first.sh_degree, sha256, sequence.antialiasing, up=sequence.up, place=place)
    changing, order = sequence.changing, np.concatenate([moving, static])
    stored = {name: getattr(first, name)[static if name in changing else order] for name in APPEARANCE}
    scene = BakedScene(
        replace(metadata, plan=f"keyframes:{count + 2}"),
        len(moving),
        first.means[static],
        first.quats[static],
        first.scales[static],
        **stored,
        changing=changing,
    ).validate("the imported sequence")
    poses = np.stack([_columns(f, changing)[moving] for f in frames], axis=1)
    give_one_sign(poses)
    control = np.einsum("nt,mtc->mnc", _through(count).astype(np.float32), poses)
    quats = first.quats[moving]
    baked = Baked(scene, Moving(first.means[moving], first.scales[moving], quats, quats), ())
    graph = new_graph(baked)
    posed = of_ids(graph, GriddedPoses(((np.arange(len(control)), StoredPoses.of(control)),)), metadata.time_range)
    if changing:
        widths = {"opacities": 1, "sh": first.sh[0].size}
        names = [f"ids.{name}" for name in changing]
        posed, *_ = graph.split(posed, ["ids.pose", *names], [POSE, *(widths[name] for name in changing)])
    activated(graph, posed)
    for name in changing:
        rows = f"ids.{name}"
        if name == "opacities":  # splines overshoot
            limits = [graph.constant(f"{rows}.{n}", np.array(v, np.float32)) for n, v in (("min", 0), ("max", 1))]
            rows = graph.node("Clip", [rows, *limits], f"{rows}.inside")
        changing_output(graph, scene, name, rows)
    return finished(graph, baked, f"keyframes:{count + 2}")


def _columns(frame: Gaussians, changing: tuple[str, ...]) -> np.ndarray:
    """[N, 10 or more] what depends on time."""
    appearance = (getattr(frame, name).reshape(len(frame), -1) for name in changing)
    return np.concatenate([frame.means, frame.scales, frame.quats, *appearance], axis=1)


def _through(count: int) -> np.ndarray:
    """[n + 2, n] from n evenly spread points to control points of the natural cubic spline with a knot at each."""
    rows = design(count + 2, count)
    ends = np.zeros((2, count + 2))
    # second derivatives at the ends of a clamped spline with equal intervals, times a constant
    ends[0, :3] = (2, -3, 1) if count > 2 else (1, -2, 1)
    ends[1, -3:] = (1, -3, 2) if count > 2 else (1, -2, 1)
    return np.linalg.inv(np.concatenate([rows, ends]))[:, :count]


def _switched(sequence: Frames, sha256: str, place: Similarity) -> onnx.ModelProto:
    frames = sequence.gaussians
    means, quats, scales, opacities, sh = (
        np.concatenate([getattr(frame, name) for frame in frames])
        for name in ("means", "quats", "scales", "opacities", "sh")
    )
    metadata = metadata_of(
        means, frames[0].sh_degree, sha256, sequence.antialiasing, sequence.dropped, sequence.up, place
    )
    plan = f"frames:{len(frames)}"
    empty = np.empty((0, 3), np.float32)
    scene = BakedScene(
        replace(metadata, plan=plan), len(means), empty, np.empty((0, 4), np.float32), empty, opacities, sh
    ).validate("the imported sequence")
    baked = Baked(scene, Moving(means, scales, quats, quats), ())
    graph = new_graph(baked)
    low, high = np.array(metadata.bounds)
    parked = (low + high) / 2 - PARKED_AT * max(half_diagonal(metadata.bounds), 1e-3) * (
        UP if sequence.up is None else sequence.up
    )

    half = graph.constant("frames.half", np.array([0.5], np.float32))
    last = graph.constant("frames.last", np.array([len(frames) - 1], np.float32))
    at = graph.node("Add", [graph.node("Mul", ["t", last], "frames.place"), half], "frames.rounded")
    number = graph.node("Cast", [graph.node("Floor", [at], "frames.floor")], "frames.now", to=TensorProto.INT64)
    of = np.repeat(np.arange(len(frames)), [len(frame) for frame in frames])
    own = graph.node("Gather", [graph.constant("frames.of", of), "ids"], "ids.frame")
    column = graph.constant("frames.column", np.array([1], np.int64))
    shown = graph.node("Unsqueeze", [graph.node("Equal", [own, number], "ids.is_now"), column], "ids.shown")
    away = graph.constant("frames.away", parked.astype(np.float32)[None])
    least = graph.constant("frames.least", np.array([[MIN_SCALE]], np.float32))
    stored = {"means": means, "scales": scales, "quats": quats}
    of_ids = {n: graph.node("Gather", [graph.constant(f"frames.{n}", a), "ids"], f"ids.{n}") for n, a in stored.items()}
    graph.node("Where", [shown, of_ids["means"], away], "means")
    graph.node("Where", [shown, of_ids["scales"], least], "scales")
    graph.node("Identity", [of_ids["quats"]], "quats")
    return finished(graph, baked, plan)
