"""The table of operators: what exporters emit, no more, and docs/contract.md says the same."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.onnx.model import element_name
from msdgs_serve.scene.onnx.operators import OPERATORS, Operator
from tests.support.sound_scenes import sound_scenes

CONTRACT = Path(__file__).parents[2] / "docs" / "contract.md"
EXAMPLE = Path(__file__).parents[2] / "examples" / "toybench.onnx"
SCENES = {**sound_scenes(), "example": EXAMPLE.read_bytes()}


@pytest.mark.parametrize("name", SCENES)
def test_the_graph_that_is_written_again_computes_the_same_bits(name: str):
    session = DeformationSession(f"{name}.onnx", contents=SCENES[name])
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    plain = onnxruntime.InferenceSession(SCENES[name], options)
    outputs = [output.name for output in plain.get_outputs()]
    moving = session.scene.moving_count
    for t in np.linspace(*session.scene.metadata.time_range, 3):
        want = dict(zip(outputs, plain.run(None, {"t": np.array([t], np.float32)}), strict=True))
        got = session.gaussians(float(t))
        for part in ("means", "quats", "scales"):
            np.testing.assert_array_equal(getattr(got, part)[moving:], want[f"static_{part}"])
            if session.cost.calls <= 1:  # rows of a product may differ between calls of different lengths
                np.testing.assert_array_equal(getattr(got, part)[:moving], want[part])
        np.testing.assert_array_equal(got.sh, want["sh"])
        np.testing.assert_array_equal(got.opacities, want["opacities"])


def emitted() -> dict[str, dict[str, set[Any]]]:
    """Operators of all sound scenes and their attributes."""
    found: dict[str, dict[str, set[Any]]] = {}
    for contents in SCENES.values():
        for node in onnx.load_from_string(contents).graph.node:
            attributes = found.setdefault(node.op_type, {})
            for attribute in node.attribute:
                attributes.setdefault(attribute.name, set()).add(attribute.i or tuple(attribute.ints))
    return found


def test_the_table_has_what_exporters_emit_and_no_more():
    found = emitted()
    assert sorted(found) == sorted(OPERATORS)
    for name, operator in OPERATORS.items():
        assert found[name].keys() == operator.attributes.keys(), name


def row(name: str, operator: Operator) -> str:
    """As docs/contract.md has it."""
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
