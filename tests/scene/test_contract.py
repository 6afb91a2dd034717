"""Contract `msdgs/1`: a scene file that violates it is refused, and the error names the field."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from msdgs_export.bake import bake
from msdgs_export.plans.registry import build
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import CONSTANT_OUTPUTS, MOVING_OUTPUTS, SceneMetadata
from msdgs_serve.scene.errors import SceneFileInvalid
from tests.support.models import SCENE, random_model

FIELDS = tuple(SceneMetadata.__dataclass_fields__)
OPTIONAL = ("eps2d", "duration", "scene_to_world")
SCENE_BYTES = build("network", bake(random_model(20), SCENE, "0" * 64)).SerializeToString()
STATIC_BYTES = build("network", bake(random_model(20, layers=()), SCENE, "0" * 64)).SerializeToString()
FLOATS = [
    (name, contents)
    for contents in (SCENE_BYTES, STATIC_BYTES)
    for c in onnx.load_from_string(contents).graph.initializer
    if c.data_type == TensorProto.FLOAT and c.raw_data and (name := c.name)
]

Change = Callable[[onnx.ModelProto], object]


def refusal(path: Path, change: Change, contents: bytes = SCENE_BYTES) -> SceneFileInvalid:
    """Return the error with which the changed file is refused."""
    model = onnx.load_from_string(contents)
    change(model)
    path.write_bytes(model.SerializeToString())
    with pytest.raises(SceneFileInvalid) as caught:
        DeformationSession(path)
    assert path.name in str(caught.value)
    return caught.value


def properties(model: onnx.ModelProto) -> dict[str, str]:
    return {p.key: p.value for p in model.metadata_props}


def constant(model: onnx.ModelProto, name: str) -> onnx.TensorProto:
    return next(c for c in model.graph.initializer if c.name == name)


def replace_constant(model: onnx.ModelProto, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    tensor = constant(model, name)
    values = change(numpy_helper.to_array(tensor).copy())
    tensor.CopyFrom(numpy_helper.from_array(values, name))
    for output in model.graph.output:
        if output.name == name:
            element = helper.np_dtype_to_tensor_dtype(values.dtype)
            output.CopyFrom(helper.make_tensor_value_info(name, element, values.shape))


def with_first(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values.flat[0] = value
        return values

    return change


def test_metadata_reads_what_it_writes():
    metadata = SceneMetadata.from_properties(properties(onnx.load_from_string(SCENE_BYTES)), "scene.onnx")
    again = SceneMetadata.from_properties(metadata.to_properties(), "scene.onnx")
    assert again.to_properties() == metadata.to_properties()
    assert all(json.loads(value) is not None for value in metadata.to_properties().values())


@pytest.mark.parametrize("field", [field for field in FIELDS if field not in OPTIONAL])
def test_a_missing_field_is_named(tmp_path: Path, field: str):
    def remove(model: onnx.ModelProto) -> None:
        kept = {key: value for key, value in properties(model).items() if key != field}
        assert field not in kept
        del model.metadata_props[:]
        helper.set_model_props(model, kept)

    error = refusal(tmp_path / "scene.onnx", remove)
    assert error.field == field
    assert "missing" in str(error)


UNUSABLE = {
    "contract": ['"msdgs/3"'],
    "layers": ['["mlp", 3]'],
    "time_range": ["[1, 0]", "[0, NaN]", "[0, 0.5, 1]"],
    "bounds": ["[[0, 0, 0]]", "[[1, 0, 0], [0, 1, 1]]"],
    "sh_degree": ["4", "true"],
    "background": ["[0, 0, 2]"],
    "antialiasing": ['"none"'],
    "cameras": ["[{}]", "[1]"],
    "checkpoint_sha256": ['"abc"'],
    "eps2d": ["-0.1", "true", "Infinity"],
    "duration": ["0", "true", "1e10"],
}


@pytest.mark.parametrize(
    ("field", "value"),
    [(field, value) for field in FIELDS for value in ("{not json", "null", *UNUSABLE.get(field, ()))],
)
def test_a_field_that_cannot_be_used_is_named(tmp_path: Path, field: str, value: str):
    def change(model: onnx.ModelProto) -> None:
        helper.set_model_props(model, properties(model) | {field: value})

    assert refusal(tmp_path / "scene.onnx", change).field == field


@pytest.mark.parametrize(
    ("part", "value"),
    [("fx", "1"), ("fy", 1e-9), ("cx", None), ("width", 0), ("height", 1.5), ("camera_to_world", [[1]]), ("t", "now")],
)
def test_a_camera_that_cannot_be_used_is_refused(tmp_path: Path, part: str, value: Any):
    def change(model: onnx.ModelProto) -> None:
        cameras = json.loads(properties(model)["cameras"])
        cameras[1][part] = value
        helper.set_model_props(model, properties(model) | {"cameras": json.dumps(cameras)})

    assert refusal(tmp_path / "scene.onnx", change).field == "cameras"


def without_output(name: str) -> Change:
    return lambda model: model.graph.output.remove(next(o for o in model.graph.output if o.name == name))


def without_default(name: str) -> Change:
    return lambda model: model.graph.initializer.remove(constant(model, name))


ANOTHER_INPUT = helper.make_tensor_value_info("speed", TensorProto.FLOAT, [1])


def with_integer_steps(model: onnx.ModelProto) -> None:
    given = next(i for i in model.graph.input if i.name == "steps")
    given.type.tensor_type.elem_type = TensorProto.INT64
    replace_constant(model, "steps", lambda steps: steps.astype(np.int64))
    for node in model.graph.node:
        node.input[:] = ["as_before" if name == "steps" else name for name in node.input]
    model.graph.node.insert(0, helper.make_node("Cast", ["steps"], ["as_before"], to=TensorProto.FLOAT))


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        *((without_output(name), name, "missing") for name in (*MOVING_OUTPUTS, *CONSTANT_OUTPUTS)),
        (without_default("ids"), "ids", ""),
        (lambda model: model.graph.input.remove(next(i for i in model.graph.input if i.name == "ids")), "ids", ""),
        (without_default("steps"), "steps", "has no default"),
        (with_integer_steps, "steps", "is int64, not float32"),
        (lambda model: model.graph.input.append(ANOTHER_INPUT), "speed", ""),
        (lambda m: replace_constant(m, "layer1.trunk0.weight", lambda v: v[:, 1:]), "layer1.trunk0.out", ""),
        *(
            (lambda m, n=n: replace_constant(m, "ids", lambda _: np.arange(n, dtype=np.int64)), "opacities", "")
            for n in (0, 19, 21)
        ),
    ],
)
def test_a_graph_with_other_ports_or_shapes_is_refused_by_name(
    tmp_path: Path, change: Change, field: str, message: str
):
    error = refusal(tmp_path / "scene.onnx", change)
    assert error.field == field
    assert message in str(error)


def test_t_must_be_float32(tmp_path: Path):
    def change(model: onnx.ModelProto) -> None:
        model.graph.input[0].type.tensor_type.elem_type = TensorProto.DOUBLE

    assert refusal(tmp_path / "scene.onnx", change, STATIC_BYTES).field == "t"


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
@pytest.mark.parametrize(("name", "contents"), FLOATS, ids=[name for name, _ in FLOATS])
def test_a_constant_that_is_not_finite_is_named(tmp_path: Path, name: str, contents: bytes, poison: float):
    error = refusal(tmp_path / "scene.onnx", lambda model: replace_constant(model, name, with_first(poison)), contents)
    assert error.field == name
    assert "1 values that are NaN or infinite" in str(error)


@pytest.mark.parametrize("name", CONSTANT_OUTPUTS)
@pytest.mark.parametrize(
    "change",
    [lambda v: np.concatenate([v, v]), lambda v: v[..., None], lambda v: v[1:], lambda v: v.astype(np.float64)],
    ids=["twice", "another dimension", "one less", "float64"],
)
def test_shapes_that_disagree_are_refused(tmp_path: Path, name: str, change: Callable[[np.ndarray], np.ndarray]):
    error = refusal(tmp_path / "scene.onnx", lambda model: replace_constant(model, name, change), STATIC_BYTES)
    # a wrong number of static means makes the other arrays wrong, which are checked first
    assert error.field == name or (name == "static_means" and error.field in CONSTANT_OUTPUTS)


@pytest.mark.parametrize(
    ("name", "value"), [("opacities", 1.5), ("opacities", -0.1), ("static_scales", 0.0), ("static_quats", 3.0)]
)
def test_values_that_no_gaussian_has_are_refused(tmp_path: Path, name: str, value: float):
    error = refusal(
        tmp_path / "scene.onnx", lambda model: replace_constant(model, name, with_first(value)), STATIC_BYTES
    )
    assert error.field == name


@pytest.mark.parametrize(
    ("names", "output"),
    [(["canonical_means", "layer1.heads.bias"], "means"), (["canonical_log_scales", "log_scales.max"], "scales")],
)
def test_a_deformation_that_overflows_is_refused(tmp_path: Path, names: list[str], output: str):
    def change(model: onnx.ModelProto) -> None:
        for name in names:
            replace_constant(model, name, lambda v: np.full_like(v, 3e38))

    assert refusal(tmp_path / "scene.onnx", change).field == output


CUT_OFF = [SCENE_BYTES[: int(part * len(SCENE_BYTES))] for part in (0.0, 0.001, 0.1, 0.5, 0.99, 0.9999)]
FOREIGN = [b"hello", b"\x00" * 1000, b"\xff" * 1000, b"PK\x03\x04", np.arange(999).tobytes()]


@pytest.mark.parametrize("contents", [*CUT_OFF, *FOREIGN], ids=range(11))
def test_files_cut_off_and_of_other_programs_are_refused(tmp_path: Path, contents: bytes):
    (tmp_path / "scene.onnx").write_bytes(contents)
    with pytest.raises(SceneFileInvalid, match=r"`file` (can't be read as a scene|is empty|is a zip|is a text)"):
        DeformationSession(tmp_path / "scene.onnx")


@pytest.mark.parametrize("name", ["missing.onnx", "."])
def test_paths_of_no_file_are_refused(tmp_path: Path, name: str):
    with pytest.raises(SceneFileInvalid, match="can't be read"):
        DeformationSession(tmp_path / name)
