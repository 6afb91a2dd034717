"""The stability report of models whose result is known, and every row of the suite."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_export.cli.stability import UNSTABLE, main
from msdgs_export.measure.frames import PoseRenderer, compare
from msdgs_export.measure.poses import in_float64
from msdgs_export.precision.assess import assess
from msdgs_export.precision.report import PlanUnsafe
from msdgs_serve.process import EXIT_INVALID
from tests.export import stability_extreme, stability_rows, stability_stiff
from tests.export.stability_rows import FAILS, Row
from tests.export.stability_suite import TABLE
from tests.support.models import NODES, SCENE, export_scene, random_model, saved
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow


def assert_none_fails(rows: list[Row]):
    assert rows
    assert [row for row in rows if row.verdict.startswith(FAILS)] == []


@pytest.mark.parametrize("case", stability_stiff.CASES)
def test_an_ill_conditioned_model_is_accurate_or_refused(case: str):
    assert_none_fails(stability_stiff.rows_of(case))


@pytest.mark.parametrize("group", stability_extreme.GROUPS, ids=lambda group: group.__name__)
def test_an_extreme_case_holds_or_is_refused(group):
    assert_none_fails([*group()])


def test_products_of_jacobians_are_those_of_differences():
    assert_none_fails([*stability_stiff.jacobian_rows()])


def test_the_model_is_not_changed():
    model = random_model(20)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    assess(model, SCENE, times=2)
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())


def test_the_worst_gaussians_are_named_with_what_they_do_to_the_image():
    model = random_model(1200, sh_degree=0)
    worst = 77
    with torch.no_grad():  # canonical and delta cancel all but the last digits: see test_export
        heads = model.get_submodule("deformation.layers.1.heads")
        heads.get_parameter("weight").mul_(1e-4)
        heads.get_parameter("bias")[6:10] = torch.tensor([-2.0, 0, 0, 0])
        heads.get_parameter("bias")[-1] = 0
        first = model.get_submodule("deformation.layers.0.heads")
        first.get_parameter("weight").mul_(1e-4)
        first.get_parameter("bias").zero_()
        model.gaussians.raw_quats[:] = torch.tensor([0.0, 1.0, 0.0, 0.0])
        model.gaussians.raw_quats[worst] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    report = assess(model, SCENE, times=3)
    assert report.worst is not None
    assert report.worst.ids[0] == worst
    assert report.float32 is not None
    assert report.float32.psnr_without_worst >= report.float32.psnr
    exact, view = in_float64(model)(report.worst.t), PoseRenderer(SCENE)
    others = np.ones(1200, bool)
    others[report.worst.ids] = False
    images = [(view.draw(exact, c, keep=others), view.draw(exact, c)) for c in view.cameras]
    assert report.worst.drawn_psnr in [compare(*pair).psnr for pair in images]


@pytest.mark.parametrize(("count", "layers"), [(0, ("mlp",)), (5, ())])
def test_static_models_are_stable(count: int, layers: tuple[str, ...]):
    report = assess(random_model(count, layers=layers), SCENE)
    assert report.stable
    assert report.refusal("network") is None
    assert "nothing moves" in report.verdict


@pytest.mark.parametrize("on_nodes", [False, True])
def test_poses_that_are_nan_in_float64_are_counted(on_nodes: bool):
    model = random_model(20, **({"support": NODES, "embedding_dim": 0} if on_nodes else {}))
    with torch.no_grad():
        model.get_parameter("deformation.layers.0.heads.bias")[3] = torch.nan
    assert assess(model, SCENE, times=2).broken == ["40 poses are NaN or infinite even in float64"]


def test_bounds_that_hold_a_gaussian_back_are_counted():
    model = random_model(9, layers=("mlp",), scale_space="linear")
    with torch.no_grad():
        model.gaussians.log_scales[:2] = 30.0
        model.gaussians.raw_quats[0] = 0
        model.get_parameter("modulation.output.bias").fill_(50.0)
        model.get_parameter("deformation.layers.0.heads.bias")[3:6] = -1e9
    limits = assess(model, SCENE, times=2).limits
    assert limits["canonical scales at e^±20"] == 2
    assert limits["quaternions without a direction"] == 1
    assert limits["modulation of scales at e^±2"] == 9
    assert limits["scales at e^±20, most at one time"] >= 7


def test_an_unsafe_plan_is_refused_and_an_old_file_stays(tmp_path: Path):
    model = stability_stiff.CASES["K = 16"]()
    output = tmp_path / "scene.onnx"
    output.write_bytes(b"an older scene")
    with pytest.raises(PlanUnsafe, match=r"`network`.*float32.*dB.*`compact:d"):
        export_scene(saved(tmp_path, model), output)
    assert output.read_bytes() == b"an older scene"
    report = assess(model, SCENE, times=3)
    assert all(report.refusal(plan) for plan in ("prefix:3", "network"))
    assert not any(report.refusal(plan) for plan in ("compact:50", "compact:70"))


def test_the_command_prints_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = saved(tmp_path, random_model(30))
    assert main(path, tmp_path / "out.json", times=3) == 0
    shown = capsys.readouterr().out
    for text in ("2 (mlp)", "float32", "predicted", "largest errors", "stable: "):
        assert text in shown
    report = json.loads((tmp_path / "out.json").read_text())
    assert report["stable"] is True
    assert report["float32"]["psnr"] >= tolerance("stability.accepted_db")


def test_the_command_flags_a_model_that_overflows(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    model = stability_rows.changed(stability_stiff.steps_times(64), **stability_stiff.layers(16))
    code = main(saved(tmp_path, model), tmp_path / "out.json", times=2)
    assert code == UNSTABLE
    assert "unstable in float32" in capsys.readouterr().out
    assert "compact" in json.loads((tmp_path / "out.json").read_text())["verdict"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"times": 1}, "`times`"),
        ({"min_psnr": -1.0}, "`min_psnr`"),
        ({"min_psnr": float("nan")}, "`min_psnr`"),
        ({"json": Path()}, "`json` must be a file, not a folder"),
    ],
)
def test_the_command_refuses_invalid_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], settings: dict[str, Any], message: str
):
    assert main(saved(tmp_path, random_model(5)), **settings) == EXIT_INVALID  # type: ignore[arg-type]
    assert message in capsys.readouterr().err


def test_the_stored_table_has_every_case_and_none_that_fails():
    with TABLE.open(encoding="utf-8", newline="") as file:
        rows = [Row(**row) for row in csv.DictReader(file)]
    cases = [row.case for row in rows]
    assert all(any(case.startswith(name) for case in cases) for name in stability_stiff.CASES)
    assert_none_fails(rows)
