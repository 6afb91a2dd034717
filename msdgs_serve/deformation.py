"""A scene file in onnxruntime: time and ids in, posed Gaussians out."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from msdgs_serve.scene.baked import CONSTANT_OUTPUTS, MOVING_OUTPUTS, OPTIONAL_INPUT, BakedScene
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_serve.scene.onnx import GraphLimits
from msdgs_serve.scene.scene_file import CHUNK, SceneFile, read_scene_file
from msdgs_serve.threads import run_parallel, sharing_cores, thread_count

_SIZES = {"means": 3, "quats": 4, "scales": 3}
_MAX_DETAILS = 500


class DeformationSession:
    """One scene file, loaded and checked; may be asked from several threads at once, though not from inside the pool.

    The file's graph deforms the Gaussians it is asked for in one go. If it runs layers on them, the loop over chunks of
    them is here: each chunk is one single-threaded onnxruntime call, and the process-wide pool runs the chunks. The
    chunks don't depend on the number of threads, so neither do the results. Other graphs, of stored poses or of control
    nodes, compute all Gaussians whatever they are asked for, and are called once, on threads of onnxruntime's own: 1.6
    times as fast on two cores, the same bits.

    onnxruntime never gets the file: `read_scene_file` checks it and writes the graph again.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        chunk: int | None = None,
        contents: bytes | None = None,
        limits: GraphLimits | None = None,
    ) -> None:
        """`contents` are the file's, where they came by another way and `path` is but its name. `chunk` is how many
        Gaussians a call takes, by default what suits the file's graph. `limits` are those of the graph's cost.

        Raises `SceneFileInvalid` naming the field where the file isn't a whole, finite `msdgs/1` scene.
        """
        if chunk is not None and chunk < 1:
            raise InvalidInput("chunk", "1 or more", chunk)
        self.path = Path(path)
        self._file = self.path.name
        contents = self._read() if contents is None else contents
        self.sha256 = hashlib.sha256(contents).hexdigest()
        scene_file = read_scene_file(contents, self._file, limits or GraphLimits())
        del contents  # a copy of all that is large is in `scene_file`
        self.cost = scene_file.cost
        self._steps = scene_file.steps
        self._chunk = chunk or (max(scene_file.moving_count, 1) if scene_file.poses_all else CHUNK)
        self.scene = self._read_scene(scene_file)
        self._session = self._open(scene_file.graph, thread_count() if scene_file.poses_all else 1)
        for t in self.scene.metadata.time_range:
            self._check_sample(t)

    @property
    def most_steps(self) -> int:
        """How many deformation layers can be applied one after the other; 0 where the scene's plan doesn't run them."""
        return 0 if self._steps is None else len(self.scene.metadata.layers)

    def check_steps(self, steps: float | None) -> None:
        """Raise `InvalidInput` where the scene can't be posed after so many layers."""
        if steps is None:
            return
        if not self.most_steps:
            plan = self.scene.metadata.plan
            raise InvalidInput("steps", f"left out: the plan {plan} doesn't run layers one by one", steps)
        if not 0 <= steps <= self.most_steps:
            raise InvalidInput("steps", f"in [0, {self.most_steps}], the scene's layers", steps)

    def pose(
        self, t: float, ids: npt.ArrayLike | None = None, steps: float | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Means [M, 3], unit wxyz quaternions [M, 4] and scales [M, 3] of the moving Gaussians `ids`, [M], or of all.

        After `steps` of the scene's layers, of the last one a part where that is no whole number; or after all.

        Raises `InvalidInput` for a time outside the scene's range, an id that isn't there or steps that it can't make,
        and `SceneFileInvalid` where the deformation overflows.
        """
        t = self._checked_time(t)
        self.check_steps(steps)
        every = np.arange(self.scene.moving_count) if ids is None else self._checked_ids(ids)
        posed = {name: np.empty((len(every), _SIZES[name]), np.float32) for name in MOVING_OUTPUTS}

        def run(start: int, stop: int) -> None:
            outputs = self._run(t, every[start:stop], steps)
            for name, output in zip(MOVING_OUTPUTS, outputs, strict=True):
                expected = posed[name][start:stop]
                if output.shape != expected.shape:
                    raise SceneFileInvalid(self._file, name, f"has shape {output.shape}, not {expected.shape}")
                expected[:] = output

        with sharing_cores():
            run_parallel(run, [(i, min(i + self._chunk, len(every))) for i in range(0, len(every), self._chunk)])
        self._check_finite(t, posed)
        return posed["means"], posed["quats"], posed["scales"]

    def gaussians(self, t: float, steps: float | None = None) -> Gaussians:
        """All Gaussians at time `t`, moving and static, ready to draw; moving ones as `pose` has them."""
        return self.scene.gaussians(*self.pose(t, steps=steps))

    @contextmanager
    def answering_for(self, t: float) -> Iterator[None]:
        """Turn `InvalidInput` about this scene's Gaussians at `t` into `SceneFileInvalid`: only the first and the last
        time are looked at when a file is loaded."""
        try:
            yield
        except InvalidInput as error:
            if not error.field.startswith("gaussians."):
                raise
            name = error.field.removeprefix("gaussians.")
            raise SceneFileInvalid(self._file, name, f"can't be used at t = {t}: {error}") from error

    def _checked_time(self, t: float) -> float:
        t0, t1 = self.scene.metadata.time_range
        if not t0 <= t <= t1:
            raise InvalidInput("t", f"in the scene's range [{t0}, {t1}]", t)
        return t

    def _checked_ids(self, ids: npt.ArrayLike) -> npt.NDArray[np.int64]:
        array = np.asarray(ids)
        if array.ndim != 1 or not (array.size == 0 or np.issubdtype(array.dtype, np.integer)):
            raise InvalidInput("ids", "a list of integers", f"{array.dtype} of shape {array.shape}")
        if array.size and not (array.min() >= 0 and array.max() < self.scene.moving_count):
            got = f"{array.min()} to {array.max()}"
            raise InvalidInput("ids", f"in [0, {self.scene.moving_count}), the moving Gaussians", got)
        return array.astype(np.int64)

    def _check_finite(self, t: float, posed: dict[str, FloatArray]) -> None:
        for name, array in posed.items():
            if not np.isfinite(array).all():
                bad = int(np.count_nonzero(~np.isfinite(array).all(axis=1)))
                raise SceneFileInvalid(self._file, name, f"is NaN or infinite for {bad:,} Gaussians at t = {t}")

    def _read(self) -> bytes:
        try:
            return self.path.read_bytes()
        except OSError as error:
            raise SceneFileInvalid(self._file, "file", f"can't be read: {error.strerror or error}") from error

    def _read_scene(self, scene_file: SceneFile) -> BakedScene:
        arrays = dict(scene_file.constants)
        if scene_file.constant_graph is not None:
            session = self._open(scene_file.constant_graph, 1)
            arrays |= zip(scene_file.computed, self._call(session, scene_file.computed, {}), strict=True)
        ordered = [arrays[name] for name in CONSTANT_OUTPUTS]
        return BakedScene(scene_file.metadata, scene_file.moving_count, *ordered).validate(self._file)

    def _open(self, model: bytes, threads: int) -> ort.InferenceSession:
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4  # its errors are raised as well, its warnings are about how graphs are written
        try:
            return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no base below it
            raise self._refused("is refused", error) from error

    def _check_sample(self, t: float) -> None:
        sample = slice(min(self.scene.moving_count, 64))
        posed = self.pose(t, np.arange(sample.stop))
        with self.answering_for(t):
            Gaussians(*posed, self.scene.opacities[sample], self.scene.sh[sample]).validate()

    def _run(self, t: float, ids: npt.NDArray[np.int64], steps: float | None = None) -> list[FloatArray]:
        inputs = {"t": np.array([t], np.float32), "ids": ids}
        if self._steps is not None:
            inputs[OPTIONAL_INPUT] = np.array([self._steps if steps is None else steps], np.float32)
        return self._call(self._session, MOVING_OUTPUTS, inputs)

    def _call(
        self, session: ort.InferenceSession, outputs: Sequence[str], inputs: dict[str, np.ndarray]
    ) -> list[FloatArray]:
        try:
            arrays = session.run(list(outputs), inputs)
        except Exception as error:
            raise self._refused("can't be run", error) from error
        return [np.asarray(array) for array in arrays]

    def _refused(self, what: str, error: Exception) -> SceneFileInvalid:
        return SceneFileInvalid(self._file, "file", f"{what} by onnxruntime", str(error)[:_MAX_DETAILS])
