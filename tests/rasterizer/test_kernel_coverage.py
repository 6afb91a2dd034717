"""The kernels are plain Python too, and the tests reach nearly all of their lines."""

import subprocess
import sys

import pytest

from tests.support.processes import ROOT


@pytest.mark.slow
def test_kernels_run_without_the_compiler():
    command = [sys.executable, "-m", "tests.rasterizer.kernel_coverage"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
