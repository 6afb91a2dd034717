"""Scene files that were made to do harm are refused by name, before any library sees them."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from msdgs_serve import deformation
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.onnx import GraphLimits, ModelInvalid, read_model
from tests.support.hostile_scenes import ATTACKS, POISON, field, poisoned, varint, with_graph
from tests.support.scene_files import write_scene

NAMED = {
    "file_read_by_a_truncated_location": "external_data",
    "location_of_33_bits": "data_location",
    "file_read_inside_a_function": "functions",
    "constant_node_in_another_file": "`t`, which a scene file may not have",
    "loop_that_never_ends_in_the_middle": "`g`, which a scene file may not have",
    "six_gigabytes_by_expand": "the operator Expand",
    "six_gigabytes_by_tile": "the operator Tile",
    "six_gigabytes_by_constantofshape": "the operator ConstantOfShape",
    "six_gigabytes_by_range": "the operator Range",
    "six_gigabytes_by_resize": "the operator Resize",
    "six_gigabytes_by_broadcasting": "`vast` (Add) brings a frame to 6,104 MiB of values; the limit is 2,048 MiB",
    "a_quadrillion_operations": "(MatMul) brings a call to 2.1e+11 operations; the limit is 2e+11",
    "whole_numbers_divided_by_zero": "`quotient` (Div) reads int64, not float32",
    "a_shape_that_depends_on_time": "`largest` (Reshape) reads `whole`, which must be a constant of the file",
    "another_domain": "com.microsoft",
}


@pytest.fixture
def sound(tmp_path: Path) -> onnx.ModelProto:
    return onnx.load(write_scene(tmp_path / "sound.onnx"))


@pytest.fixture
def unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """No library gets anything."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("onnxruntime was given a file")

    monkeypatch.setattr(deformation.ort, "InferenceSession", refuse)


@pytest.mark.usefixtures("unseen")
@pytest.mark.parametrize("name", ATTACKS)
def test_attacks_are_refused_by_name_before_onnxruntime_sees_them(tmp_path: Path, sound: onnx.ModelProto, name: str):
    secret = tmp_path / "secret"
    secret.write_bytes(b"s" * 24)
    contents = ATTACKS[name](sound, secret)
    with pytest.raises(SceneFileInvalid) as caught:
        DeformationSession("scene.onnx", contents=contents)
    assert NAMED[name] in str(caught.value)


@pytest.mark.parametrize("name", ["file_read_by_a_truncated_location", "file_read_inside_a_function"])
def test_onnxruntime_itself_hands_out_other_files(tmp_path: Path, sound: onnx.ModelProto, name: str):
    """What the reader is for: with this library alone the bytes of the file are rendered as positions."""
    (tmp_path / "secret").write_bytes(b"root:x:0:0:root:/root:/bin")
    (tmp_path / "attack.onnx").write_bytes(ATTACKS[name](sound, Path("secret")))
    session = onnxruntime.InferenceSession(tmp_path / "attack.onnx")
    means = np.asarray(session.run(["means"], {"t": np.zeros(1, np.float32)})[0])
    assert bytes(means[0].astype(np.uint8)) == b"roo"


@pytest.mark.usefixtures("unseen")
@pytest.mark.parametrize("what", POISON)
def test_poisoned_metadata_is_refused_by_its_field(sound: onnx.ModelProto, what: str):
    with pytest.raises(SceneFileInvalid) as caught:
        DeformationSession("scene.onnx", contents=poisoned(sound, what))
    assert caught.value.field == POISON[what][0]
    assert len(str(caught.value)) < 500


def graph_of(model: onnx.ModelProto) -> bytes:
    return model.graph.SerializeToString()


WIRE_TRICKS = {
    "a field that ONNX doesn't have": lambda m: m.SerializeToString() + field(99, b"x"),
    "a second graph": lambda m: m.SerializeToString() + field(7, b""),
    "a second version": lambda m: m.SerializeToString() + field(1, 10),
    "a second name": lambda m: with_graph(m, graph_of(m) + field(2, b"b") + field(2, b"c")),
    "a number in one byte more": lambda m: m.SerializeToString().replace(b"\x08\x0a", b"\x08\x8a\x00", 1),
    "a number of 71 bits": lambda m: m.SerializeToString() + varint(5 << 3) + b"\xff" * 10 + b"\x01",
    "a length beyond the end": lambda m: m.SerializeToString() + varint(7 << 3 | 2) + varint(2**60),
    "a length of 2⁶³": lambda m: m.SerializeToString() + varint(7 << 3 | 2) + varint(2**63),
    "a group": lambda m: m.SerializeToString() + varint(6 << 3 | 3) + varint(6 << 3 | 4),
    "a text for a number": lambda m: field(1, b"\x0a") + m.SerializeToString()[2:],
    "training": lambda m: m.SerializeToString() + field(20, b""),
    "sparse constants": lambda m: with_graph(m, graph_of(m) + field(15, b"")),
    "a name that isn't UTF-8": lambda m: with_graph(m, graph_of(m) + field(5, field(8, b"\xff"))),
    "a name with a line break": lambda m: with_graph(m, graph_of(m) + field(5, field(8, b"a\nb"))),
    "a name without end": lambda m: with_graph(m, graph_of(m) + field(5, field(8, b"a" * 10_000))),
    "more nodes than anybody needs": lambda m: with_graph(m, graph_of(m) + field(1, b"") * 10_000),
    "an empty array of huge lengths": lambda m: with_graph(
        m, graph_of(m) + field(5, field(1, 0) + field(1, 2**40) + field(1, 2**40) + field(2, 1) + field(8, b"x"))
    ),
    "a negative length": lambda m: with_graph(
        m, graph_of(m) + field(5, field(1, 2**64 - 1) + field(2, 1) + field(8, b"x"))
    ),
    "lengths whose product is zero in 64 bits": lambda m: with_graph(
        m, graph_of(m) + field(5, field(1, 2**32) + field(1, 2**32) + field(2, 1) + field(8, b"x"))
    ),
}


@pytest.mark.parametrize("what", WIRE_TRICKS)
def test_each_value_has_one_spelling(sound: onnx.ModelProto, what: str):
    with pytest.raises(ModelInvalid):
        read_model(WIRE_TRICKS[what](sound))


def test_a_number_in_one_byte_more_is_the_same_to_others(sound: onnx.ModelProto):
    contents = WIRE_TRICKS["a number in one byte more"](sound)
    assert contents != sound.SerializeToString()
    assert onnx.load_from_string(contents) == sound


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
