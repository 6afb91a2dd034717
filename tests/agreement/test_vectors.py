"""Vectors of published programs name the commit of the program and the command that made them."""

from importlib.util import find_spec

import numpy as np
import pytest

from tests.support.processes import ROOT

ORIGINS = {
    "agreement/deformgs": ("ac423728df780ee57a82025a6d7c4c7312fdf9bb", "tests.agreement.deformgs"),
    "agreement/fourdgs": ("843d5ac636c37e4b611242287754f3d4ed150144", "tests.agreement.fourdgs"),
    "agreement/grid4d": ("c9a93fb7d399d332c27e585ac05f9d6cfa31f250", "tests.agreement.grid4d"),
    "train/scgs/vectors": ("26cd57d09598b2f5d951029808a5ac9f0ff4f626", "tests.support.scgs_reference"),
    "train/volumes/hexplane": (
        "fc99b61da94fc406702d9e080ca5e37f5d7dcfad",
        "tests.support.volume_references hexplane",
    ),
    "train/volumes/tineuvox": (
        "d1f3adb6749420d10ecc074806f06459f189acbd",
        "tests.support.volume_references tineuvox",
    ),
}
"""By file in tests: commit, and module with its first argument."""


def test_all_vectors_have_an_origin() -> None:
    tests = ROOT / "tests"
    files = [file for folder in ("agreement", "train") for file in (tests / folder).rglob("*.npz")]
    assert {str(file.relative_to(tests).with_suffix("")) for file in files} == ORIGINS.keys()


@pytest.mark.parametrize(("name", "origin"), ORIGINS.items(), ids=ORIGINS)
def test_vectors_name_their_commit_and_command(name: str, origin: tuple[str, str]) -> None:
    commit, module = origin
    file = ROOT / "tests" / f"{name}.npz"
    with np.load(file) as stored:
        assert (str(stored["commit"]), str(stored["command"])) == (commit, f"python -m {module} CHECKOUT")
    assert find_spec(module.split()[0])
    assert file.stat().st_size < 100_000
