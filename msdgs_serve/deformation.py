"""Run scene files in onnxruntime: from a time to posed Gaussians."""

import hashlib
import os
import stat
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from msdgs_serve.scene.baked import APPEARANCE, OPTIONAL_INPUT, BakedScene, appearance_problem, constant_outputs
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_serve.scene.onnx import GraphLimits
from msdgs_serve.scene.scene_file import CHUNK, SceneFile, read_scene_file
from msdgs_serve.threads import run_parallel, sharing_cores, thread_count

_MAX_DETAILS = 500
ROUNDING = 1e-9  # of a sum of times beyond an end, as a fraction of the time range


class DeformationSession:
    """One scene file, loaded and checked. Safe to use from several threads, but not from inside the thread pool.

    A graph that runs layers on Gaussians is called for chunks of them: each chunk is one single-threaded onnxruntime
    call, and the process-wide pool runs the chunks. Chunks and results don't depend on the number of threads. Other
    graphs, of stored poses or of control nodes, compute all Gaussians in any case and are called once, on onnxruntime's
    own threads: 1.6 times as fast on two cores, with the same bits.

    onnxruntime never reads the file itself: `read_scene_file` checks it and writes a new graph.
    """

    def __init__(self, path: str | Path, *, contents: bytes | None = None, limits: GraphLimits | None = None) -> None:
        """Load a scene file.

        Args:
            path: the file, or its name in messages if `contents` are given.
            contents: of the file, if they are in memory already.
            limits: of the graph's cost.

        Raises `SceneFileInvalid` naming the field if the file isn't a complete, finite scene.
        """
        self.path = Path(path)
        stored = self._read() if contents is None else memoryview(contents).toreadonly()
        with ThreadPoolExecutor(1) as beside:  # a second of the two that a file of 1 GB takes
            digest = beside.submit(hashlib.sha256, stored)
            scene_file = read_scene_file(stored, self.path.name, limits or GraphLimits())
            self.sha256 = digest.result().hexdigest()
        constants = scene_file.aligned_constants(stored)
        del stored
        self.cost = scene_file.cost
        self._steps, self._outputs, self._selected = scene_file.steps, scene_file.outputs, scene_file.selected
        self._takes_ids, self._posed = scene_file.takes_ids, scene_file.posed
        self._chunk = max(scene_file.moving_count, 1) if scene_file.poses_all else CHUNK
        self.scene = self._read_scene(scene_file, constants)
        self._session = self._open(scene_file.graph, thread_count() if scene_file.poses_all else 1)
        for t in self.scene.metadata.time_range:
            self._check_sample(t)

    @property
    def max_steps(self) -> int:
        """Number of deformation layers that `pose` can apply one by one; 0 if the scene's plan doesn't run layers."""
        return 0 if self._steps is None else len(self.scene.metadata.layers)

    def check_time(self, t: float, field: str = "t") -> None:
        """Raise `InvalidInput` if a time is outside the scene's range; `field` is `t`, or what was added to `t`."""
        t0, t1 = self.scene.metadata.time_range
        if not t0 <= t <= t1:
            expected = f"in the scene's range [{t0}, {t1}]"
            raise InvalidInput(field, expected if field == "t" else f"such that t + {field} is {expected}", t)

    def later(self, t: float, by: float) -> float:
        """Return `t + by`; an end of the scene's range if it is beyond by rounding alone."""
        t0, t1 = self.scene.metadata.time_range
        end = min(max(t + by, t0), t1)
        return end if abs(t + by - end) <= ROUNDING * (t1 - t0) else t + by

    def check_steps(self, steps: float | None) -> None:
        """Raise `InvalidInput` if the scene can't be posed after `steps` layers."""
        if steps is None:
            return
        if not self.max_steps:
            plan = self.scene.metadata.plan
            raise InvalidInput("steps", f"left out, as the plan {plan} runs no layers", steps)
        if not 0 <= steps <= self.max_steps:
            raise InvalidInput("steps", f"in [0, {self.max_steps}], the scene's layers", steps)

    def pose(self, t: float, ids: npt.ArrayLike | None = None, steps: float | None = None) -> tuple[FloatArray, ...]:
        """Return means [M, 3], unit wxyz quaternions [M, 4] and scales [M, 3] of the moving Gaussians `ids`, [M], or
        all, and if they depend on time, opacities [M] and SH [M, C, 3].

        `steps` is the number of layers to apply, with a fraction of the last one if it isn't an integer; None for all.

        Raises `InvalidInput` for a time outside the scene's range and for invalid ids or steps, and `SceneFileInvalid`
        if the deformation overflows.
        """
        self.check_time(t)
        self.check_steps(steps)
        ids = None if ids is None else self._checked_ids(ids)
        with sharing_cores():
            posed = self._pose_selected(t, ids, steps) if self._selected else self._pose_all(t, ids, steps)
        self._check_values(t, posed)
        return tuple(posed.values())

    def gaussians(self, t: float, steps: float | None = None) -> Gaussians:
        """Return all Gaussians at time `t`, the posed moving ones and the static ones."""
        return self.scene.gaussians(*self.pose(t, steps=steps))

    @contextmanager
    def as_scene_file_error(self, t: float) -> Iterator[None]:
        """Turn `InvalidInput` about this scene's Gaussians at `t` into `SceneFileInvalid`: loading checks the first and
        the last time only."""
        try:
            yield
        except InvalidInput as error:
            if not error.field.startswith("gaussians."):
                raise
            name = error.field.removeprefix("gaussians.")
            raise SceneFileInvalid(self.path.name, name, f"can't be used at t = {t}: {error}") from error

    def _pose_selected(self, t: float, ids: npt.NDArray[np.int64] | None, steps: float | None) -> dict[str, FloatArray]:
        """Poses by a graph that selects the ids, chunk by chunk."""
        every = np.arange(self.scene.moving_count) if ids is None else ids
        posed = {name: np.empty((len(every), *row), np.float32) for name, row in self._posed.items()}

        def run(start: int, stop: int) -> None:
            outputs = self._run(t, every[start:stop], steps)
            for name, output in zip(posed, outputs, strict=True):
                expected = posed[name][start:stop]
                if output.shape != expected.shape:
                    raise SceneFileInvalid(self.path.name, name, f"has shape {output.shape}, not {expected.shape}")
                expected[:] = output

        run_parallel(run, [(i, min(i + self._chunk, len(every))) for i in range(0, len(every), self._chunk)])
        return posed

    def _pose_all(self, t: float, ids: npt.NDArray[np.int64] | None, steps: float | None) -> dict[str, FloatArray]:
        """Poses by a graph of all Gaussians, one per row, and of more rows if it needs a multiple of some length."""
        if ids is not None and not len(ids):
            return {name: np.empty((0, *row), np.float32) for name, row in self._posed.items()}
        rows = slice(self.scene.moving_count) if ids is None else ids
        outputs = dict(zip(self._posed, self._run(t, np.arange(0), steps), strict=True))
        for name, output in outputs.items():
            count, row = self.scene.moving_count, self._posed[name]
            if output.shape[1:] != tuple(row) or len(output) < count:
                raise SceneFileInvalid(self.path.name, name, f"has shape {output.shape}, not {(count, *row)}")
        return {name: output[rows] for name, output in outputs.items()}

    def _checked_ids(self, ids: npt.ArrayLike) -> npt.NDArray[np.int64]:
        array = np.asarray(ids)
        if array.ndim != 1 or not (array.size == 0 or np.issubdtype(array.dtype, np.integer)):
            raise InvalidInput("ids", "a list of integers", f"{array.dtype} of shape {array.shape}")
        if array.size and not (array.min() >= 0 and array.max() < self.scene.moving_count):
            got = f"{array.min()} to {array.max()}"
            raise InvalidInput("ids", f"in [0, {self.scene.moving_count}), the moving Gaussians", got)
        return array.astype(np.int64)

    def _check_values(self, t: float, posed: dict[str, FloatArray]) -> None:
        for name, array in posed.items():
            if name in APPEARANCE:
                if problem := appearance_problem(name, array):
                    raise SceneFileInvalid(self.path.name, name, f"{problem} at t = {t}")
            elif not np.isfinite(array).all():
                bad = int(np.count_nonzero(~np.isfinite(array).all(axis=1)))
                raise SceneFileInvalid(self.path.name, name, f"is NaN or infinite for {bad:,} Gaussians at t = {t}")

    def _read(self) -> memoryview:
        try:
            with self.path.open("rb") as file:
                status = os.fstat(file.fileno())
                if not stat.S_ISREG(status.st_mode):  # a pipe, whose size isn't known
                    return memoryview(bytearray(file.read()))
                contents = np.empty(status.st_size, np.uint8).data
                return contents[: file.readinto(contents)]
        except OSError as error:
            raise SceneFileInvalid(self.path.name, "file", f"can't be read: {error.strerror or error}") from error

    def _read_scene(self, scene_file: SceneFile, constants: dict[str, np.ndarray]) -> BakedScene:
        arrays = dict(constants)
        if scene_file.constant_graph is not None:
            session = self._open(scene_file.constant_graph, 1)
            arrays |= zip(scene_file.computed, self._call(session, scene_file.computed, {}), strict=True)
        ordered = [arrays[name] for name in constant_outputs(scene_file.changing)]
        scene = BakedScene(scene_file.metadata, scene_file.moving_count, *ordered, changing=scene_file.changing)
        return scene.validate(self.path.name)

    def _open(self, model: bytes, threads: int) -> ort.InferenceSession:
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # products of files with QDQ nodes in float32: in 8 bits they saturate on CPUs without VNNI, and differ
        options.add_session_config_entry("session.disable_quant_qdq", "1")
        options.log_severity_level = 4  # errors are raised as exceptions; warnings are about the style of graphs
        try:
            return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no common base class
            raise self._runtime_error("is rejected", error) from error

    def _check_sample(self, t: float) -> None:
        sample = slice(min(self.scene.moving_count, 64))
        posed = dict(zip(self._posed, self.pose(t, np.arange(sample.stop)), strict=True))
        constant = {name: getattr(self.scene, name)[sample] for name in APPEARANCE}
        with self.as_scene_file_error(t):
            Gaussians(**(constant | posed)).validate()

    def _run(self, t: float, ids: npt.NDArray[np.int64], steps: float | None = None) -> list[FloatArray]:
        inputs: dict[str, np.ndarray] = {"t": np.array([t], np.float32)}
        if self._takes_ids:
            inputs["ids"] = ids
        if self._steps is not None:
            inputs[OPTIONAL_INPUT] = np.array([self._steps if steps is None else steps], np.float32)
        return self._call(self._session, self._outputs, inputs)

    def _call(
        self, session: ort.InferenceSession, outputs: Sequence[str], inputs: dict[str, np.ndarray]
    ) -> list[FloatArray]:
        try:
            arrays = session.run(list(outputs), inputs)
        except Exception as error:
            raise self._runtime_error("can't be run", error) from error
        return [np.asarray(array) for array in arrays]

    def _runtime_error(self, problem: str, error: Exception) -> SceneFileInvalid:
        return SceneFileInvalid(self.path.name, "file", f"{problem} by onnxruntime", str(error)[:_MAX_DETAILS])
