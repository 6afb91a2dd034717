"""The stability report of models whose result is known, and every row of the suite."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from export.measure.amplification import growth, spectral_norm
from export.measure.frames import PoseRenderer, compare
from export.measure.poses import posed
from export.measure.stability import assess
from export.precision.formats import FLOAT32, FORMATS, in_format
from export.precision.report import PlanUnsafe
from export.stability import UNSTABLE, main
from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.layers.deformation import DeformationLayer, LayerStep
from tests.export import stability_extreme, stability_stiff
from tests.export.stability_rows import FAILS, Row
from tests.export.stability_suite import TABLE
from tests.support.models import SCENE, export_scene, random_model, saved
from tests.support.processes import ROOT
from tests.support.tolerances import assert_close, tolerance

pytestmark = pytest.mark.slow


def assert_none_fails(rows: list[Row]):
    assert rows
    assert [row for row in rows if row.verdict.startswith(FAILS)] == []


@pytest.mark.parametrize("case", stability_stiff.CASES)
def test_a_stiff_model_is_exact_enough_or_refused(case: str):
    assert_none_fails(stability_stiff.rows_of(case))


@pytest.mark.parametrize("group", stability_extreme.GROUPS, ids=lambda group: group.__name__)
def test_an_extreme_case_holds_or_is_refused(group):
    assert_none_fails([*group()])


def test_products_of_jacobians_are_those_of_differences():
    assert_none_fails([*stability_stiff.jacobian_rows()])


class Linear(DeformationLayer):
    """x → x + w A x."""

    def __init__(self, matrix: torch.Tensor, weight: float) -> None:
        super().__init__()
        self.matrix = torch.nn.Parameter(matrix)
        self.weight = weight

    def forward(self, means: torch.Tensor, t: torch.Tensor) -> LayerStep:
        weight = torch.full((len(means), 1), self.weight, dtype=means.dtype)
        return LayerStep(means @ self.matrix.T, means, means.new_zeros(len(means), 4), weight)


def test_growth_of_linear_layers_is_a_power_of_their_matrix():
    matrix = torch.tensor([[1.0, 2.0, 0.0], [0.0, -0.5, 0.0], [0.25, 0.0, 3.0]], dtype=torch.double)
    chain = MultiStepDeformation(Linear(matrix, 0.5) for _ in range(4))
    single = MultiStepDeformation(Linear(matrix.float(), 0.5) for _ in range(4))
    found = growth(chain, single, torch.rand(7, 3, dtype=torch.double), 0.0)
    step = np.eye(3) + 0.5 * matrix.numpy()
    powers = [np.linalg.norm(np.linalg.matrix_power(step, k), 2) for k in (1, 2, 3, 4)]
    assert_close(found.after, np.repeat(np.array(powers)[:, None], 7, axis=1), "stability.spectral_norm.relative")
    assert_close(found.amplification, np.full(7, max(powers)), "stability.spectral_norm.relative")


def test_spectral_norms():
    matrices = (
        torch.randn(500, 3, 3, dtype=torch.double) * torch.logspace(-100, 100, 500, dtype=torch.double)[:, None, None]
    )
    matrices[0], matrices[1], matrices[2] = 0, torch.eye(3), -5 * torch.eye(3)
    want = torch.linalg.matrix_norm(matrices[3:], ord=2)
    got = spectral_norm(matrices)
    assert got[:3].tolist() == [0, 1, 5]
    assert_close(got[3:], want, "stability.spectral_norm.relative")
    matrices[0, 1, 1], matrices[1, 0, 0] = torch.inf, torch.nan
    assert spectral_norm(matrices)[:2].tolist() == [torch.inf, torch.inf]


@pytest.mark.parametrize("kind", ["mlp", "plane"])
def test_formats_are_ordered_as_their_digits(kind: str):
    model = random_model(40, layers=(kind, kind))
    gaps = {gap.name: gap.near_worst for gap in assess(model, SCENE, times=3, formats=FORMATS).formats}
    assert gaps["float64 encoding"] <= gaps["float32"] < gaps["float16"] < gaps["bfloat16"]
    assert gaps["float16"] <= gaps["float16 throughout"]


def test_bfloat16_rounds_what_a_product_reads_and_makes():
    model = random_model(10, layers=("mlp",))
    number_format = next(f for f in FORMATS if f.name == "bfloat16")
    posed, layer = in_format(model, number_format).pose(0.4), model.deformation.layers[0]

    def rounded(x: torch.Tensor) -> torch.Tensor:
        return x.bfloat16().float()

    def product(weight: torch.Tensor, x: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        return rounded(torch.addmm(rounded(bias), rounded(x), rounded(weight).T))

    def parameters(name: str) -> tuple[torch.Tensor, torch.Tensor]:
        return layer.get_parameter(f"{name}.weight"), layer.get_parameter(f"{name}.bias")

    def encoded(x: torch.Tensor, frequencies: int) -> torch.Tensor:
        phases = torch.cat([x * 2.0**k for k in range(frequencies)], dim=1)
        return torch.cat([x, phases.sin(), phases.cos()], dim=1)

    with torch.no_grad():
        time = encoded(torch.full((1, 1), 0.4), 6)
        for name, activation in (("time_hidden", torch.relu), ("time_output", torch.nn.Identity())):
            weight, bias = parameters(name)
            time = activation(product(weight, time, bias))
        weight, bias = parameters("first")
        xyz = 63
        at_time = rounded(torch.addmv(rounded(bias), rounded(weight[:, xyz:]), rounded(time[0])))
        hidden = product(weight[:, :xyz], encoded(model.gaussians.means, 10), at_time).relu()
        for i in range(2):
            hidden = product(*_swapped(parameters(f"trunk.{i}"), hidden)).relu()
        heads = product(*_swapped(parameters("heads"), hidden))
        want = model.gaussians.means + heads[:, -1:].sigmoid() * heads[:, :3]
    assert_close(posed.means.detach(), want, "float32.relative")


def _swapped(
    parameters: tuple[torch.Tensor, torch.Tensor], x: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return parameters[0], x, parameters[1]


def test_the_model_is_not_changed():
    model = random_model(20)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    assess(model, SCENE, times=2, formats=FORMATS[:2])
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
    gap = report.formats[0]
    assert gap.psnr_without_worst >= gap.psnr
    exact, view = posed(in_format(model, FLOAT32).double(), report.worst.t), PoseRenderer(SCENE)
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


def test_bounds_that_hold_a_gaussian_back_are_counted():
    model = random_model(9, layers=("mlp",), scale_space="linear")
    with torch.no_grad():
        model.gaussians.log_scales[:2] = 30.0
        model.gaussians.raw_quats[0] = 0
        model.get_parameter("modulation.output.bias").fill_(50.0)
        model.get_parameter("deformation.layers.0.heads.bias")[3:6] = -100.0
    limits = assess(model, SCENE, times=2).limits
    assert limits["canonical scales at e^±20"] == 2
    assert limits["quaternions without a direction"] == 1
    assert limits["modulation of scales at e^±2"] == 9
    assert limits["scales at e^±20, most at one time"] >= 7


def test_an_unsafe_plan_is_refused_and_an_old_file_stays(tmp_path: Path):
    model = stability_stiff.CASES["K = 16"]()
    output = tmp_path / "scene.onnx"
    output.write_bytes(b"an older scene")
    with pytest.raises(PlanUnsafe, match=r"`network`.*float32.*dB.*`lowrank` or `keyframes`"):
        export_scene(saved(tmp_path, model), output)
    assert output.read_bytes() == b"an older scene"
    report = assess(model, SCENE, times=3)
    assert [report.refusal(plan) is None for plan in ("prefix:3", "int8", "lowrank:8", "keyframes:20")] == [
        False,
        False,
        True,
        True,
    ]


def test_the_command_prints_writes_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = saved(tmp_path, random_model(30))
    assert main(path, tmp_path / "out.json", tmp_path / "out.png", times=3) == 0
    shown = capsys.readouterr().out
    for text in ("2 (mlp)", "bfloat16", "predicted", "largest errors", "stable: "):
        assert text in shown
    report = json.loads((tmp_path / "out.json").read_text())
    assert report["stable"] is True
    assert report["formats"][0]["psnr"] >= tolerance("stability.accepted_db")
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_flags_a_model_that_overflows(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    model = stability_stiff.stiff(stability_stiff.steps_times(64), **stability_stiff.layers(16))
    code = main(saved(tmp_path, model), tmp_path / "out.json", tmp_path / "out.png", times=2)
    assert code == UNSTABLE
    assert "unstable in float32" in capsys.readouterr().out
    assert "lowrank" in json.loads((tmp_path / "out.json").read_text())["verdict"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"times": 1}, "`times`"), ({"min_psnr": -1.0}, "`min_psnr`"), ({"min_psnr": float("nan")}, "`min_psnr`")],
)
def test_the_command_refuses_settings_that_make_no_sense(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], settings: dict[str, float], message: str
):
    assert main(saved(tmp_path, random_model(5)), **settings) == 1  # type: ignore[arg-type]
    assert message in capsys.readouterr().err


def test_the_command_runs_from_any_folder(tmp_path: Path):
    command = [sys.executable, str(ROOT / "export" / "stability.py"), "nowhere.pt"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 1
    assert "nowhere.pt: no such file" in done.stderr


def test_the_stored_table_has_every_case_and_none_that_fails():
    with TABLE.open(encoding="utf-8", newline="") as file:
        rows = [Row(**row) for row in csv.DictReader(file)]
    cases = [row.case for row in rows]
    assert all(any(case.startswith(name) for case in cases) for name in stability_stiff.CASES)
    assert_none_fails(rows)
