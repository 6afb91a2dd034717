"""Shapes that an operator can't take are refused by the service, before onnxruntime sees the file."""

from pathlib import Path

import numpy as np
import onnx
import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.onnx.cost import CallCost, GraphLimits
from tests.support.hostile_scenes import beside_the_scene
from tests.support.scene_files import write_scene


def floats(*shape: int) -> np.ndarray:
    return np.ones(shape, np.float32)


def whole(*values: int) -> np.ndarray:
    return np.array(values, np.int64)


WRONG: dict[str, tuple[str, dict[str, np.ndarray], str]] = {
    "Gemm of other lengths": (
        "Gemm(a, b, c)", {"a": floats(2, 3), "b": floats(4, 5), "c": floats(5)}, "can't multiply [2, 3] by [4, 5]",
    ),
    "Gemm of other lengths, transposed": (
        "Gemm <transB = 1> (a, b, c)", {"a": floats(2, 3), "b": floats(3, 5), "c": floats(5)},
        "can't multiply [2, 3] by [5, 3]",
    ),
    "Gemm of a stack": (
        "Gemm(a, b, c)", {"a": floats(2, 2, 3), "b": floats(3, 5), "c": floats(5)}, "can't multiply [2, 2, 3]",
    ),
    "Gemm with a summand that enlarges the product": (
        "Gemm(a, b, c)", {"a": floats(1, 3), "b": floats(3, 5), "c": floats(4, 5)}, "can't add [4, 5] to [1, 5]",
    ),
    "MatMul of other lengths": (
        "MatMul(a, b)", {"a": floats(2, 3), "b": floats(4, 5)}, "can't multiply [2, 3] by [4, 5]",
    ),
    "MatMul of a list": ("MatMul(a, b)", {"a": floats(3), "b": floats(3, 5)}, "can't multiply [3] by [3, 5]"),
    "Add of other lengths": ("Add(a, b)", {"a": floats(2, 3), "b": floats(2, 4)}, "can't broadcast"),
    "ScatterND to the row after the last": (
        "ScatterND(a, rows, b)", {"a": floats(3, 2), "rows": whole(1, 3)[:, None], "b": floats(2, 2)},
        "replaces rows 1 to 3 of 3",
    ),
    "ScatterND to a row before the first": (
        "ScatterND(a, rows, b)", {"a": floats(3, 2), "rows": whole(-1)[:, None], "b": floats(1, 2)},
        "replaces rows -1 to -1 of 3",
    ),
    "ScatterND of rows of another length": (
        "ScatterND(a, rows, b)", {"a": floats(3, 2), "rows": whole(1)[:, None], "b": floats(1, 4)},
        "replaces rows [1, 1] of [3, 2] by [1, 4]",
    ),
    "Clip to several limits": ("Clip(a, b, b)", {"a": floats(3), "b": floats(3)}, "clips to limits of shapes [3]"),
    "Concat of other lengths": (
        "Concat <axis = 0> (a, b)", {"a": floats(2, 3), "b": floats(2, 4)}, "can't concatenate [2, 3] and [2, 4]",
    ),
    "Split into less than all": (
        "Split(a, parts)", {"a": floats(3, 2), "parts": whole(2)}, "splits [3, 2] into 1 parts of [2]",
    ),
    "Split into a negative length": (
        "Split(a, parts)", {"a": floats(3, 2), "parts": whole(-3)}, "splits [3, 2] into 1 parts of [-3]",
    ),
    "Transpose of other axes": ("Transpose <perm = [0, 2, 1]> (a)", {"a": floats(2, 3)}, "orders 3 axes of [2, 3]"),
    "Reshape to more elements": ("Reshape(a, to)", {"a": floats(2, 3), "to": whole(7)}, "can't reshape [2, 3] to [7]"),
    "Reshape to no length": ("Reshape(a, to)", {"a": floats(2, 3), "to": whole(0, 6)}, "lengths must be above 0"),
    "Squeeze of a length above 1": ("Squeeze(a, axes)", {"a": floats(2, 1), "axes": whole(0)}, "squeezes axes [0]"),
    "Unsqueeze at one axis twice": ("Unsqueeze(a, axes)", {"a": floats(2), "axes": whole(0, 0)}, "duplicate axes"),
    "Gather along an axis that isn't there": (
        "Gather <axis = 2> (a, rows)", {"a": floats(2, 3), "rows": whole(0)}, "has no axis 2 among 2",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_shapes_that_do_not_fit_are_refused(tmp_path: Path, what: str):
    call, constants, message = WRONG[what]
    sound = onnx.load(write_scene(tmp_path / "sound.onnx"))
    contents = beside_the_scene(f"largest = {call}", **constants)(sound, tmp_path)
    with pytest.raises(SceneFileInvalid) as caught:
        DeformationSession("scene.onnx", contents=contents)
    assert message in str(caught.value)


def test_a_frame_costs_as_much_as_all_of_its_calls():
    cost, limits = CallCost(memory_bytes=1, operations=5), GraphLimits(operations=14, call_operations=5)
    assert cost.problem(limits, calls=2) is None
    assert "brings a frame to 15 operations; the limit is 14" in (cost.problem(limits, calls=3) or "")
