"""The scene of the paper's size: larger layers compute what the smaller ones did."""

from pathlib import Path

import pytest
import torch

from benchmarks.paper_sized import grown, main, split
from msdgs_train.gaussians.model_file import load_model, save_model
from tests.support.models import SCENE, random_model
from tests.support.tolerances import assert_close

COUNT = 40


def test_the_large_model_moves_parts_as_the_small_one_does():
    small = random_model(COUNT, layers=("mlp", "mlp"))
    parts = split(small, 100, torch.Generator().manual_seed(0))
    large = grown(parts).double()
    parts.double()
    assert len(large.deformation) == 10
    for t in (0.0, 0.37, 1.0):
        with torch.no_grad():
            wanted, got = parts.pose(t), large.pose(t)
        for part in ("means", "quats", "scales"):
            assert_close(getattr(got, part).numpy(), getattr(wanted, part).numpy(), "grown_layers")


def test_a_run_that_is_stopped_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    save_model(tmp_path / "small.pt", random_model(COUNT, layers=("mlp",)), SCENE, 1)
    arguments = {"model": tmp_path / "small.pt", "output": tmp_path / "large.pt", "count": 90, "size": 64}
    saved = tmp_path / "large.fit.pt"

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("benchmarks.paper_sized._describe", stopped)
        patch.setattr("benchmarks.paper_sized.save_model", stopped)
        assert main(**arguments, minutes=0.005) == 130
    assert saved.exists()
    assert not (tmp_path / "large.pt").exists()
    assert main(**arguments, minutes=0.006) == 0
    assert "going on after" in capsys.readouterr().err
    assert not saved.exists()
    assert len(load_model(tmp_path / "large.pt").model.gaussians) == 90


def test_fewer_gaussians_than_there_are_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    save_model(tmp_path / "small.pt", random_model(COUNT), SCENE, 1)
    assert main(tmp_path / "small.pt", tmp_path / "large.pt", count=3) == 1
    assert "`count` must be 40 or more" in capsys.readouterr().err
