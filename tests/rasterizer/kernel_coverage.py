"""Run the kernels' tests without the compiler and measure line coverage.

python -m tests.rasterizer.kernel_coverage

Kernels are then plain Python on NumPy arrays of 16. Code that builds LLVM needs the compiler and isn't counted. The
exit status is 1 if a test fails or coverage is below the bound in tests/support/tolerances.py.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from coverage import Coverage

from tests.support.processes import ROOT
from tests.support.tolerances import tolerance

FILES = (
    "test_vectors.py",
    "test_rasterizer_oracle.py",
    "test_rasterizer_gsplat.py",
    "test_gradients.py",
    "test_frame_sequence.py",
    "test_culling.py",
)
NAMES = (
    "operations or memory or powers or behind or opacity or 6-1-53 or 12-15-53 or harmonics or none_and or camera "
    "or 40-21-20 or folds or equal_depths or few_blocks"
)
"""The tests that are small enough for plain Python."""

BUILDS_CODE = ("def .*builder: Any", "@lower_builtin", "@type_callable", "@register_model")


def kernel_files() -> list[Path]:
    """The rasterizer's files with kernels, and those with the operations that kernels are written in."""
    folder = ROOT / "msdgs_serve" / "rasterizer"
    return [path for path in sorted(folder.rglob("*.py")) if "@kernel" in path.read_text()] + [
        folder / "simd" / name for name in ("vectors.py", "memory.py", "squares.py")
    ]


def main() -> int:
    """Restart with the compiler off: it can't be switched off later."""
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
        return subprocess.call([sys.executable, "-m", "tests.rasterizer.kernel_coverage"], cwd=ROOT, env=environment)
    with tempfile.TemporaryDirectory() as folder:
        coverage = Coverage(
            data_file=Path(folder, "coverage"), include=list(map(str, kernel_files())), config_file=False
        )
        for pattern in BUILDS_CODE:
            coverage.exclude(pattern)
        with coverage.collect():
            # NumPy warns of infinities in empty pixels, compiled code doesn't
            options = ["-n", "0", "-q", "-p", "no:cacheprovider", "-W", "ignore::RuntimeWarning", "-k", NAMES]
            status = pytest.main([*options, *(str(Path(__file__).with_name(name)) for name in FILES)])
        percent = coverage.report(show_missing=True)
    print(f"{percent:.1f} % of the kernels' lines")
    return int(status != 0 or percent < tolerance("kernel_coverage"))


if __name__ == "__main__":
    sys.exit(main())
