"""A scene file in onnxruntime: time and ids in, posed Gaussians out."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from msdgs_serve.scene.baked import (
    CONSTANT_OUTPUTS,
    INPUTS,
    MOVING_OUTPUTS,
    OPTIONAL_INPUT,
    BakedScene,
    SceneMetadata,
)
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_serve.scene.onnx_constants import Malformed, read_constants
from msdgs_serve.threads import run_parallel, sharing_cores, thread_count

CHUNK = 2048
"""Gaussians a call where layers run. The widest activation of a call is CHUNK × width, whatever the scene's size."""

_SIZES = {"means": 3, "quats": 4, "scales": 3}
_INPUT_TYPES = {"t": "tensor(float)", "ids": "tensor(int64)", OPTIONAL_INPUT: "tensor(float)"}


class DeformationSession:
    """One scene file, loaded and checked; may be asked from several threads at once, though not from inside the pool.

    The file's graph deforms the Gaussians it is asked for in one go. Where it runs layers the loop over chunks of them
    is here: each chunk is one single-threaded onnxruntime call, and the process-wide pool runs the chunks. The chunks
    don't depend on the number of threads, so neither do the results. Other graphs blend what is stored of all Gaussians
    whatever they are asked for, and are called once, on threads of onnxruntime's own: 1.6 times as fast on two cores,
    the same bits.
    """

    def __init__(self, path: str | Path, *, chunk: int | None = None, contents: bytes | None = None) -> None:
        """`contents` are the file's, where they came by another way and `path` is but its name. `chunk` is how many
        Gaussians a call takes, by default what suits the file's graph.

        Raises `SceneFileInvalid` naming the field where the file isn't a whole, finite `msdgs/1` scene.
        """
        if chunk is not None and chunk < 1:
            raise InvalidInput("chunk", "1 or more", chunk)
        self.path = Path(path)
        self._chunk = chunk
        self._file = self.path.name
        contents = self._read() if contents is None else contents
        default_ids, runs_layers = self._check_constants(contents)
        self._session = self._open(contents, 1 if runs_layers else thread_count())
        try:
            properties = self._session.get_modelmeta().custom_metadata_map
            metadata = SceneMetadata.from_properties(properties, self._file)
            self._check_interface()
        except UnicodeDecodeError as error:
            raise SceneFileInvalid(self._file, "file", f"has text that isn't UTF-8: {error}") from error
        self.scene = self._read_scene(metadata, default_ids)
        for t in metadata.time_range:
            self._check_sample(t)

    @property
    def most_steps(self) -> int:
        """How many deformation layers can be applied one after the other; 0 where the scene's plan doesn't run them."""
        return len(self.scene.metadata.layers) if self._has_steps else 0

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
            outputs = self._run(MOVING_OUTPUTS, t, every[start:stop], steps)
            for name, output in zip(MOVING_OUTPUTS, outputs, strict=True):
                expected = posed[name][start:stop]
                if output.shape != expected.shape:
                    raise SceneFileInvalid(self._file, name, f"has shape {output.shape}, not {expected.shape}")
                expected[:] = output

        chunk = self._chunk or (CHUNK if self._has_steps else max(len(every), 1))
        with sharing_cores():
            run_parallel(run, [(i, min(i + chunk, len(every))) for i in range(0, len(every), chunk)])
        self._check_finite(t, posed)
        return posed["means"], posed["quats"], posed["scales"]

    def gaussians(self, t: float, steps: float | None = None) -> Gaussians:
        """All Gaussians at time `t`, moving and static, ready to draw; moving ones as `pose` has them."""
        return self.scene.gaussians(*self.pose(t, steps=steps))

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
            contents = self.path.read_bytes()
        except OSError as error:
            raise SceneFileInvalid(self._file, "file", f"can't be read: {error.strerror or error}") from error
        if not contents:
            raise SceneFileInvalid(self._file, "file", "is empty")
        return contents

    def _check_constants(self, contents: bytes) -> tuple[int, bool]:
        """Check every constant in the file; returns the number of ids in the default of `ids`, and whether `steps` has
        one."""
        try:
            constants = read_constants(contents)
        except Malformed as error:
            raise SceneFileInvalid(self._file, "file", f"isn't a whole ONNX model: {error}") from error
        default_ids, has_steps = None, False
        for constant in constants:
            if constant.external:
                raise SceneFileInvalid(self._file, constant.name, "lies in another file; a scene must be one file")
            if constant.bad_values:
                problem = f"holds {constant.bad_values:,} values that are NaN or infinite"
                raise SceneFileInvalid(self._file, constant.name, problem)
            has_steps |= constant.name == OPTIONAL_INPUT
            if constant.name == "ids" and len(constant.shape) == 1:
                default_ids = constant.shape[0]
        if default_ids is None:
            raise SceneFileInvalid(self._file, "ids", "has no default of all moving Gaussians")
        return default_ids, has_steps

    def _open(self, contents: bytes, threads: int) -> ort.InferenceSession:
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3  # its warnings are about how graphs are written, not about scenes
        try:
            return ort.InferenceSession(contents, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no base below it
            raise SceneFileInvalid(self._file, "file", f"is refused by onnxruntime: {error}") from error

    def _check_interface(self) -> None:
        inputs = {i.name: i for i in [*self._session.get_inputs(), *self._session.get_overridable_initializers()]}
        for name in INPUTS:
            if name not in inputs:
                raise SceneFileInvalid(self._file, name, "is missing from the inputs")
            if inputs[name].type != _INPUT_TYPES[name]:
                raise SceneFileInvalid(self._file, name, f"is {inputs[name].type}, not {_INPUT_TYPES[name]}")
        self._has_steps = OPTIONAL_INPUT in inputs
        if self._has_steps:
            self._check_steps_input(inputs[OPTIONAL_INPUT])
        unknown = sorted(set(inputs) - {*INPUTS, OPTIONAL_INPUT})
        if unknown:
            raise SceneFileInvalid(self._file, unknown[0], "isn't an input of this contract")
        outputs = {o.name: o for o in self._session.get_outputs()}
        for name in (*MOVING_OUTPUTS, *CONSTANT_OUTPUTS):
            if name not in outputs:
                raise SceneFileInvalid(self._file, name, "is missing from the outputs")
            if outputs[name].type != "tensor(float)":
                raise SceneFileInvalid(self._file, name, f"is {outputs[name].type}, not tensor(float)")

    def _check_steps_input(self, steps: ort.NodeArg) -> None:
        if steps.type != _INPUT_TYPES[OPTIONAL_INPUT]:
            raise SceneFileInvalid(self._file, OPTIONAL_INPUT, f"is {steps.type}, not {_INPUT_TYPES[OPTIONAL_INPUT]}")
        if OPTIONAL_INPUT in [i.name for i in self._session.get_inputs()]:
            raise SceneFileInvalid(self._file, OPTIONAL_INPUT, "has no default of all layers")

    def _read_scene(self, metadata: SceneMetadata, moving_count: int) -> BakedScene:
        arrays = self._run(CONSTANT_OUTPUTS, metadata.time_range[0], np.empty(0, np.int64))
        return BakedScene(metadata, moving_count, *arrays).validate(self._file)

    def _check_sample(self, t: float) -> None:
        sample = slice(min(self.scene.moving_count, 64))
        posed = self.pose(t, np.arange(sample.stop))
        try:
            Gaussians(*posed, self.scene.opacities[sample], self.scene.sh[sample]).validate()
        except InvalidInput as error:
            name = error.field.removeprefix("gaussians.")
            raise SceneFileInvalid(self._file, name, f"can't be used at t = {t}: {error}") from error

    def _run(
        self, outputs: tuple[str, ...], t: float, ids: npt.NDArray[np.int64], steps: float | None = None
    ) -> list[FloatArray]:
        inputs = {"t": np.array([t], np.float32), "ids": ids}
        if steps is not None:
            inputs[OPTIONAL_INPUT] = np.array([steps], np.float32)
        try:
            arrays = self._session.run(outputs, inputs)
        except Exception as error:
            raise SceneFileInvalid(self._file, "file", f"can't be run by onnxruntime: {error}") from error
        return [np.asarray(array) for array in arrays]
