"""Hostile scene files are refused before any library reads them, and the error names the reason."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto

from msdgs_serve import deformation
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.onnx import GraphLimits, ModelInvalid, read_model
from tests.support.hostile_scenes import ATTACKS, POISON, Attack, field, poisoned, varint, with_graph
from tests.support.scene_files import write_scene


@pytest.fixture
def sound(tmp_path: Path) -> onnx.ModelProto:
    return onnx.load(write_scene(tmp_path / "sound.onnx"))


@pytest.fixture
def unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail a test in which onnxruntime is given a file."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("onnxruntime was given a file")

    monkeypatch.setattr(deformation.ort, "InferenceSession", refuse)


@pytest.mark.usefixtures("unseen")
@pytest.mark.parametrize("attack", ATTACKS, ids=str)
def test_attacks_are_refused_by_name_before_onnxruntime_sees_them(
    tmp_path: Path, sound: onnx.ModelProto, attack: Attack
):
    (tmp_path / "secret").write_bytes(b"s" * 24)
    with pytest.raises(SceneFileInvalid) as caught:
        DeformationSession("scene.onnx", contents=attack.on(sound, tmp_path / "secret"))
    assert attack.message in str(caught.value)


@pytest.mark.usefixtures("unseen")
@pytest.mark.parametrize("what", POISON)
def test_poisoned_metadata_is_refused_by_its_field(sound: onnx.ModelProto, what: str):
    with pytest.raises(SceneFileInvalid) as caught:
        DeformationSession("scene.onnx", contents=poisoned(sound, what))
    assert caught.value.field == POISON[what][0]
    assert len(str(caught.value)) < 500


def with_more(content: bytes) -> Callable[[onnx.ModelProto], bytes]:
    """Append bytes to those of the model."""
    return lambda model: model.SerializeToString() + content


def with_more_in_the_graph(content: bytes) -> Callable[[onnx.ModelProto], bytes]:
    """Append bytes to those of the graph."""
    return lambda model: with_graph(model, model.graph.SerializeToString() + content)


def with_empty_constant(*lengths: int) -> Callable[[onnx.ModelProto], bytes]:
    """Append a float32 constant with these dimensions and no values."""
    dims = b"".join(field(1, length) for length in lengths)
    return with_more_in_the_graph(field(5, dims + field(2, 1) + field(8, b"x")))


def with_listed(element: int, content: bytes, count: int = 1) -> Callable[[onnx.ModelProto], bytes]:
    """Append a constant of so many numbers with this content."""
    return with_more_in_the_graph(field(5, field(1, count) + field(2, element) + field(8, b"x") + content))


def with_numbers(*numbers: int) -> bytes:
    """Return `int32_data` of a constant."""
    return field(5, b"".join(map(varint, numbers)))


WIRE_TRICKS = {
    "a field that ONNX doesn't have": with_more(field(99, b"x")),
    "a second graph": with_more(field(7, b"")),
    "a second version": with_more(field(1, 10)),
    "a second name": with_more_in_the_graph(field(2, b"b") + field(2, b"c")),
    "a number in one byte more": lambda model: model.SerializeToString().replace(b"\x08\x0a", b"\x08\x8a\x00", 1),
    "a number of 71 bits": with_more(varint(5 << 3) + b"\xff" * 10 + b"\x01"),
    "a length beyond the end": with_more(varint(7 << 3 | 2) + varint(2**60)),
    "a length of 2⁶³": with_more(varint(7 << 3 | 2) + varint(2**63)),
    "a group": with_more(varint(6 << 3 | 3) + varint(6 << 3 | 4)),
    "a text for a number": lambda model: field(1, b"\x0a") + model.SerializeToString()[2:],
    "training": with_more(field(20, b"")),
    "sparse constants": with_more_in_the_graph(field(15, b"")),
    "metadata that aren't UTF-8": with_more(field(14, field(1, b"plan") + field(2, b"\xff"))),
    "a name that isn't UTF-8": with_more_in_the_graph(field(5, field(8, b"\xff"))),
    "a name with a line break": with_more_in_the_graph(field(5, field(8, b"a\nb"))),
    "a name of 10,000 letters": with_more_in_the_graph(field(5, field(8, b"a" * 10_000))),
    "10,000 nodes": with_more_in_the_graph(field(1, b"") * 10_000),
    "an empty array of huge lengths": with_empty_constant(0, 2**40, 2**40),
    "a negative length": with_empty_constant(2**64 - 1),
    "a constant in bytes and in a list": with_listed(TensorProto.UINT8, with_numbers(7) + field(9, b"7")),
    "two lists of a constant": with_listed(TensorProto.FLOAT, field(4, bytes(4)) + field(4, bytes(4))),
    "floats in a list of integers": with_listed(TensorProto.FLOAT, with_numbers(7)),
    "integers in a list of floats": with_listed(TensorProto.INT32, field(4, bytes(4))),
    "a number of a list beyond uint8": with_listed(TensorProto.UINT8, with_numbers(256)),
    "a negative number of a list of uint8": with_listed(TensorProto.UINT8, with_numbers(2**64 - 1)),
    "a list that ends within a number": with_listed(TensorProto.UINT8, field(5, b"\x80")),
    "a number of a list in one byte more": with_listed(TensorProto.UINT8, field(5, b"\x87\x00")),
    "a list of floats that ends within one": with_listed(TensorProto.FLOAT, field(4, bytes(3))),
    "INT64 in a list of int32": with_listed(TensorProto.INT64, with_numbers(7)),
    "lists of 262,145 bytes": with_more_in_the_graph(
        b"".join(
            field(5, field(1, n) + field(2, TensorProto.UINT8) + field(8, b"x%d" % n) + field(5, b"\x01" * n))
            for n in (131_072, 131_073)
        )
    ),
    "a list that isn't packed": with_listed(TensorProto.UINT8, field(5, 7)),
    "lengths whose product is zero in 64 bits": with_empty_constant(2**32, 2**32),
}


@pytest.mark.parametrize("what", WIRE_TRICKS)
def test_each_value_has_one_encoding(sound: onnx.ModelProto, what: str):
    with pytest.raises(ModelInvalid):
        read_model(WIRE_TRICKS[what](sound))


@pytest.mark.parametrize(
    ("element", "content", "want"),
    [
        (TensorProto.UINT8, with_numbers(0, 255), [0, 255]),
        (TensorProto.INT8, with_numbers(127, 2**64 - 128), [127, -128]),
        (TensorProto.INT16, with_numbers(2**15 - 1, 2**64 - 2**15), [2**15 - 1, -(2**15)]),
        (TensorProto.INT32, with_numbers(2**31 - 1, 2**64 - 2**31), [2**31 - 1, -(2**31)]),
        (TensorProto.FLOAT, field(4, np.array([0.1, -3], "<f4").tobytes()), np.array([0.1, -3], np.float32)),
    ],
)
def test_lists_of_numbers_are_read(sound: onnx.ModelProto, element: int, content: bytes, want: list):
    model = read_model(with_listed(element, content, 2)(sound))
    np.testing.assert_array_equal(model.constants["x"].array(), want)


def test_limits_of_cost_are_those_given(tmp_path: Path):
    contents = write_scene(tmp_path / "sound.onnx").read_bytes()
    cost = DeformationSession("sound.onnx", contents=contents).cost
    assert cost.memory_bytes > 0
    assert cost.operations > 0
    exact = GraphLimits(2, cost.memory_bytes, cost.operations, cost.operations)
    assert DeformationSession("sound.onnx", contents=contents, limits=exact).cost.memory_bytes == cost.memory_bytes
    for less, word in (
        (GraphLimits(gaussians=1), "2 Gaussians; the limit is 1"),
        (GraphLimits(memory_bytes=cost.memory_bytes - 1), "MiB of values"),
        (GraphLimits(operations=cost.operations - 1), "brings a frame"),
        (GraphLimits(call_operations=cost.operations - 1), "brings a call"),
    ):
        with pytest.raises(SceneFileInvalid, match=word):
            DeformationSession("sound.onnx", contents=contents, limits=less)
