"""The table of allowed operators is exactly what exporters emit, or did, and what docs/contract.md lists."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.onnx.model import element_name
from msdgs_serve.scene.onnx.operators import OPERATORS, Operator
from tests.support.hostile_scenes import beside_the_scene
from tests.support.sound_scenes import sound_scenes

CONTRACT = Path(__file__).parents[2] / "docs" / "contract.md"
EXAMPLE = Path(__file__).parents[2] / "examples" / "toys.onnx"

pytestmark = pytest.mark.xdist_group("sound scenes")  # one worker makes them


def scenes() -> dict[str, bytes]:
    return {**sound_scenes(), "example": EXAMPLE.read_bytes()}


@pytest.mark.slow
def test_graphs_that_are_written_again_compute_the_same_bits():
    for name, contents in scenes().items():
        session = DeformationSession(f"{name}.onnx", contents=contents)
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        plain = onnxruntime.InferenceSession(contents, options)
        outputs = [output.name for output in plain.get_outputs()]
        moving = session.scene.moving_count
        for t in np.linspace(*session.scene.metadata.time_range, 3):
            want = dict(zip(outputs, plain.run(None, {"t": np.array([t], np.float32)}), strict=True))
            got = session.gaussians(float(t))
            for part, values in vars(got).items():
                place = f"{name}, {part}"
                if f"static_{part}" not in want:
                    np.testing.assert_array_equal(values, want[part], place)
                    continue
                np.testing.assert_array_equal(values[moving:], want[f"static_{part}"], place)
                if session.cost.calls <= 1:  # rows of a product may differ between calls of different lengths
                    np.testing.assert_array_equal(values[:moving], want[part], place)


def emitted() -> dict[str, dict[str, set[Any]]]:
    """Return the operators of all valid scenes and their attributes."""
    found: dict[str, dict[str, set[Any]]] = {}
    for contents in scenes().values():
        for node in onnx.load_from_string(contents).graph.node:
            attributes = found.setdefault(node.op_type, {})
            for attribute in node.attribute:
                attributes.setdefault(attribute.name, set()).add(attribute.i or tuple(attribute.ints))
    return found


@pytest.mark.slow
def test_the_table_has_exactly_the_operators_of_exporters():
    found = emitted()
    assert sorted(found) == sorted(OPERATORS)
    for name, operator in OPERATORS.items():
        assert found[name].keys() == operator.attributes.keys(), name


def row(name: str, operator: Operator) -> str:
    """Return the row of an operator in docs/contract.md."""
    inputs = []
    for operand in operator.operands:
        elements = "/".join(element_name(each) for each in operand.elements)
        inputs.append(f"{elements}{' constant' if operand.constant else ''}")
    if operator.repeated:
        inputs[-1] += ", once or several times"
    attributes = []
    for attribute, values in operator.attributes.items():
        shown = [element_name(v) for v in values if isinstance(v, int)] if attribute == "to" else values
        if attribute == "perm":
            attributes.append("`perm` of three axes")
            continue
        span = f"{values[0]} to {values[-1]}" if len(values) > 2 else " or ".join(map(str, shown))
        attributes.append(f"`{attribute}` {span}")
    return f"| {'; '.join([f'`{name}`', *attributes])} | {'; '.join(inputs)} |"


def test_the_contract_lists_the_table():
    written = re.findall(r"^\| `[A-Z][A-Za-z]+`(?:;[^|]*)? \|.*$", CONTRACT.read_text(), re.MULTILINE)
    assert written == [row(name, operator) for name, operator in OPERATORS.items()]


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ("largest = Cast (t)", "(Cast) lacks the attribute `to`"),
        ("largest = Cast <to = 9> (t)", "(Cast) has to = 9, not"),
        ("largest = Cast <to = 1, saturate = 2, x = 1> (t)", "(Cast) has the unknown attribute `saturate`"),
        ("largest = Relu <alpha = 1.0> (t)", "has `f`, which a scene file may not have"),
        ("largest = Clip(t, limits, limits)", "(Clip) clips to limits of shapes [2] and [2]"),
        ("largest = Squeeze(base, second)", "(Squeeze) squeezes axes [1] of [1, 3]"),
    ],
)
def test_nodes_outside_of_the_table_are_refused(scene: Path, nodes: str, message: str):
    change = beside_the_scene(nodes, limits=np.zeros(2, np.float32))
    with pytest.raises(SceneFileInvalid) as caught:
        DeformationSession("scene.onnx", contents=change(onnx.load(scene), Path("unused")))
    assert message in str(caught.value)


def test_a_node_of_another_domain_is_refused(scene: Path):
    model = onnx.load(scene)
    model.graph.node[0].domain = "com.microsoft"
    with pytest.raises(SceneFileInvalid, match=r"is Gather of another domain, not of ONNX"):
        DeformationSession("scene.onnx", contents=model.SerializeToString())
