"""`msdgs-train compare`: the matrix, its runs, resuming, the table and the plots."""

import contextlib
import dataclasses
import json
import multiprocessing
import os
import signal
import subprocess
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_train.cli import main as cli
from msdgs_train.comparison import pools
from msdgs_train.comparison.matrix import Budget, Run, make_runs, read_systems
from msdgs_train.comparison.pools import Processes, RunEnd, processes
from msdgs_train.comparison.report import BESIDE, as_markdown, draw_layers, draw_time, save_figure, table
from msdgs_train.comparison.results import CurvePoint, Result
from msdgs_train.comparison.runner import train_all
from msdgs_train.comparison.scenes import Scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.run import RunResult, fit
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.systems.registry import preset
from tests.support.processes import ROOT, program, wait_for
from tests.support.training_scene import write_scene

pytestmark = pytest.mark.slow

BUDGET = Budget(steps=6, init_num_pts=60, max_gaussians=90)
SYSTEMS = """
[static]
preset = "static"

[k1]
preset = "msdgs-small"
layers = ["mlp:width=16"]
embedding_dim = 4

["k2 w=1"]
preset = "msdgs-small"
layers = ["mlp:width=16", "mlp:width=16,lr_init=1e-3"]
weights = false
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "scene", train=3, test=1)


@pytest.fixture
def systems_file(tmp_path: Path) -> Path:
    path = tmp_path / "systems.toml"
    path.write_text(SYSTEMS)
    return path


def scene(folder: str | Path) -> Scene:
    return Scene(Path(folder).name, Path(folder), {})


def test_a_system_is_a_preset_with_changes_under_the_budget(systems_file: Path) -> None:
    systems = read_systems(["deformgs", str(systems_file)], BUDGET)
    assert list(systems) == ["deformgs", "static", "k1", "k2 w=1"]
    assert systems["deformgs"] == BUDGET.of(preset("deformgs"))
    assert systems["static"].model.layers == ()
    layers = (MLPConfig(width=16), MLPConfig(width=16, lr_init=1e-3))
    assert systems["k2 w=1"].model == dataclasses.replace(preset("msdgs-small").model, layers=layers, weights=False)
    timed = read_systems(["static"], dataclasses.replace(BUDGET, time_from="index"))
    assert timed["static"].data.time_from == "index"
    for config in systems.values():
        counts = (config.density.init_num_pts, config.density.max_gaussians)
        assert (config.run.steps, *counts, config.run.threads) == (6, 60, 90, 1)


def test_the_ablation_can_be_compared() -> None:
    file = ROOT / "benchmarks" / "training" / "ablation.toml"
    systems = read_systems([str(file)], Budget(steps=6, init_num_pts=4000, max_gaussians=5000))
    assert len({json.dumps(config.to_dict()) for config in systems.values()}) == len(systems) > 10


def test_the_matrix_has_every_cell_once_seed_by_seed(systems_file: Path, tmp_path: Path) -> None:
    systems = read_systems([str(systems_file)], BUDGET)
    runs = make_runs(systems, [scene("a/one"), scene("b/two")], [3, 5], tmp_path)
    assert len({run.folder for run in runs}) == len(runs) == 12
    assert {(run.system, run.scene, run.seed) for run in runs[:6]} == {
        (system, scene, 3) for system in systems for scene in ("one", "two")
    }
    assert all(run.config.run.seed == run.seed for run in runs)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ("[a]\npreset = 'mine'", r"preset.*mine"),
        ("[a]\nstpes = 3", r"system `a`.*stpes"),
        ("[a]\nlayers = ['mlp:hight=3']", r"system `a`.*hight"),
        ("[a]\nlayers = ['mlp:width=0']", r"system `a`.*width"),
        ("[a]\nlayers = ['mlp:width=wide']", r"system `a`.*width"),
        ("[a]\nlayers = 'mlp'", r"system `a`.*layers"),
        ("[a]\nsize = 99.5", r"system `a`.*size"),
        ("[a]\neps2d_init = '0.3'", r"system `a`.*eps2d_init"),
        ("[a.model]\nsh_dgree = 1", r"system `a`.*sh_dgree"),
        ("[a]\nsh_degree_fraction = 'long'", r"system `a`.*sh_degree_fraction"),
        ("[a]\nsteps = 8000", r"system `a`: `config\.steps` must be not given: --steps sets it .*8000"),
        ("[a]\nseed = 1", r"system `a`.*--seeds"),
        ("[a]\nthreads = 1", r"system `a`.*--threads"),
        ("[a]\npreset = 'static'\ntime_noise = 0.5", r"system `a`.*time_noise.*there are no layers"),
        ("[a]\neval_every = 5", r"system `a`.*eval_every"),
        ("a = 3", r"`a`"),
        ("['../up']\nsteps = 3", r"up"),
        ("[a", r"TOML"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, contents: str, message: str) -> None:
    (tmp_path / "systems.toml").write_text(contents)
    with pytest.raises(InvalidInput, match=message):
        read_systems([str(tmp_path / "systems.toml")], BUDGET)


def test_with_minutes_a_system_has_its_own_steps(tmp_path: Path) -> None:
    (tmp_path / "systems.toml").write_text("[a]\nsteps = 8000")
    assert read_systems([str(tmp_path / "systems.toml")], Budget(minutes=5))["a"].run.steps == 8000


def test_neither_a_preset_nor_a_file(tmp_path: Path) -> None:
    for source in ("hexplane", str(tmp_path / "none.toml")):
        with pytest.raises(InvalidInput, match="config"):
            read_systems([source], BUDGET)


def test_names_may_not_repeat(systems_file: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"system.*static"):
        read_systems([str(systems_file), str(systems_file)], BUDGET)
    systems = read_systems(["static"], BUDGET)
    with pytest.raises(InvalidInput, match=r"seed.*none"):
        make_runs(systems, [scene("a/one")], [], tmp_path)
    with pytest.raises(InvalidInput, match=r"seed.*twice"):
        make_runs(systems, [scene("a/one")], [0, 0], tmp_path)


def made_result(system: str, layers: int, seed: int, psnr: float, kind: str = "mlp") -> Result:
    config = preset("msdgs-small").updated(seed=seed, layers=(kind,) * layers)
    run = Run(system, "toy", seed, Path("toy"), Path("out") / f"{system}{seed}", config, "digest")
    curve = [CurvePoint(10 * i, i * 1.5, psnr - 3 + i) for i in range(1, 4)]
    return Result(
        run=run, split="test", psnr=psnr, ssim=0.9, deformation_parameters=1000 * layers, gaussians=300,
        modulation_parameters=50, seconds=60.0, skipped=0, frame_ms=4.0, curve=curve,
    )  # fmt: skip


RESULTS = [
    made_result("k1", 1, 0, 20.0),
    made_result("k1", 1, 1, 22.0),
    made_result("k2", 2, 0, 30.0),
    made_result("k4", 4, 0, 31.0),
]


def test_the_table_has_a_row_for_each_system_and_scene() -> None:
    rows = table(RESULTS)
    assert rows[0] == [
        "k1", "toy", "2", "21.00 ± 1.41", "0.9000 ± 0.0000", "1,000", "1,050 ± 0", "300 ± 0", "60 ± 0", "4.0 ± 0.0"
    ]  # fmt: skip
    assert [row[0] for row in rows] == ["k1", "k2", "k4"]
    text = as_markdown(RESULTS)
    assert "| k2 | toy | 1 | 30.00 | 0.9000 | 2,000 | 2,050 | 300 | 60 | 4.0 |" in text
    assert "held-out images of `test`;" in text
    config = RESULTS[0].run.config.updated(minutes=2, time="cpu")
    timed = dataclasses.replace(RESULTS[0], run=dataclasses.replace(RESULTS[0].run, config=config))
    text = as_markdown([timed, dataclasses.replace(RESULTS[1], split="val")])
    assert "2 minutes of CPU time per run" in text
    assert "held-out images of `test` or `val`;" in text


def test_the_plots_show_errors() -> None:
    (axes,) = draw_time(RESULTS).axes
    assert [line.get_label() for line in axes.get_lines()] == ["k1", "k2", "k4"]
    x, y = map(np.asarray, axes.get_lines()[1].get_data())
    assert x.tolist() == [1.5, 3.0, 4.5]
    assert y.tolist() == pytest.approx([10 ** (-psnr / 20) for psnr in (28, 29, 30)])
    (axes,) = draw_layers([*RESULTS, made_result("wide", 2, 0, 28.0, "mlp:width=200")]).axes
    lines = [container[0].get_data() for container in axes.containers]
    aside = BESIDE / 2  # bars of the same K don't overlap
    assert [list(x) for x, _ in lines] == [[1 - aside, 2 - aside, 4 - aside], [2 + aside]]
    assert lines[0][1][1] == pytest.approx(10 ** (-30 / 20))


@pytest.mark.parametrize("psnr", [20.0, 22.438109931601858, 34.72395823374006])
def test_a_single_run_can_be_drawn(psnr: float, tmp_path: Path) -> None:
    result = made_result("one", 1, 0, psnr)
    result = dataclasses.replace(result, curve=[CurvePoint(1, 2.0, psnr)])
    for draw in (draw_time, draw_layers):
        save_figure(draw([result]), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000


def test_each_scene_has_a_panel_and_each_system_a_style() -> None:
    systems = [f"s{i}" for i in range(12)]
    here = [made_result(name, 1, 0, 20.0 + i) for i, name in enumerate(systems)]
    there = [dataclasses.replace(r, run=dataclasses.replace(r.run, scene="other"), psnr=10.0) for r in here[5:]]
    figure = draw_time([*here, *there])
    assert [axes.get_title() for axes in figure.axes] == ["toy", "other"]
    looks = [
        {str(line.get_label()): (line.get_color(), line.get_linestyle()) for line in a.get_lines()} for a in figure.axes
    ]
    assert list(looks[0]) == systems
    assert len(set(looks[0].values())) == 12
    assert looks[1] == {name: looks[0][name] for name in systems[5:]}
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == systems
    panels = draw_layers([*RESULTS, *there]).axes
    assert [len(axes.containers) for axes in panels] == [1, 1]


def arguments(systems_file: Path, data: Path, out: Path, *more: str) -> list[str]:
    options = ["--steps", "6", "--init-num-pts", "60", "--max-gaussians", "90", "--jobs", "1", *more]
    return ["compare", str(systems_file), "--data", str(data), "--out", str(out), *options]


@pytest.mark.usefixtures("in_threads", "no_curve")
def test_from_nothing_to_the_table_and_not_again(
    systems_file: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = arguments(systems_file, data, tmp_path / "out", "--seeds", "0", "1")
    assert cli.main(command) == 0
    numbers = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert numbers["missing"] == 0
    assert [(run["system"], run["seed"]) for run in numbers["runs"]] == [
        (system, seed) for seed in (0, 1) for system in ("static", "k1", "k2 w=1")
    ]
    for run in numbers["runs"]:
        assert run["frame_ms"] > 0
        assert run["curve"][-1]["psnr"] == run["psnr"]
        assert [point["step"] for point in run["curve"]] == [1, 2, 3, 4, 5, 6]
        assert (run["deformation_parameters"] == 0) == (run["system"] == "static")
        assert (run["modulation_parameters"] == 0) == (run["system"] == "static")
    for name in ("comparison.md", "time.png", "layers.png"):
        assert (tmp_path / "out" / name).stat().st_size > 100
    assert (tmp_path / "out" / "comparison.md").read_text() in capsys.readouterr().out
    assert cli.main(command) == 0
    assert "finished" not in capsys.readouterr().out
    (tmp_path / "out" / "comparison.csv").unlink()  # rows are measured again, and nothing is trained
    assert cli.main(command) == 0
    assert capsys.readouterr().out.count("was finished") == 6
    for option, message in (("--size=12", "other settings: size"), ("--jobs=0", "`jobs` must be 1 or more")):
        assert cli.main([*command, option]) == cli.EXIT_INVALID
        assert message in capsys.readouterr().err
    other = write_scene(tmp_path / "other" / data.name, train=5)
    assert cli.main(arguments(systems_file, other, tmp_path / "out", "--seeds", "0", "1")) == cli.EXIT_INVALID
    assert f"{other}, which differs in number of images" in capsys.readouterr().err
    shared = ["--csv", str(tmp_path / "out" / "comparison.csv")]
    command = arguments(systems_file, other, tmp_path / "out2", "--seeds", "0", *shared)
    assert cli.main(command) == cli.EXIT_INVALID
    assert "that of another dataset named" in capsys.readouterr().err


@pytest.mark.usefixtures("in_threads")
def test_a_run_that_fails_is_reported_and_the_others_continue(
    systems_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails_once(config: TrainConfig, data: Path, run: Path, **options: Any) -> RunResult:
        if data.name == "unevaluated" and config.run.system == "static":
            raise ZeroDivisionError("of a plugin")
        return fit(config, data, run, **options)

    monkeypatch.setattr(pools, "fit", fails_once)
    ended: list[tuple[str, RunEnd]] = []
    (write_scene(tmp_path / "unevaluated", train=2, test=0) / "transforms_val.json").unlink()
    scenes = [scene(tmp_path / "nowhere"), scene(tmp_path / "unevaluated")]
    runs = make_runs(read_systems([str(systems_file)], BUDGET), scenes, [0], tmp_path / "out")
    assert train_all(runs, processes(1), lambda run, how: ended.append((run.system, how)))
    assert [system for system, _ in ended] == ["static", "k1", "k2 w=1"] * 2
    assert all(how.status == "failed" for _, how in ended)
    messages = (*["nowhere"] * 3, "ZeroDivisionError", *["held-out images"] * 2)
    assert all(message in how.message for message, (_, how) in zip(messages, ended, strict=True))


def test_a_killed_process_is_named(tmp_path: Path) -> None:
    (run,) = make_runs({"mine": preset("static")}, [scene(tmp_path)], [0], tmp_path)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as executor:
        pool = Processes(1, executor, context.Event())
        killed: Any = executor.submit(os._exit, 1)
        pool._going[killed] = run
        with pytest.raises(MsdgsError, match=r"mine.*was killed.*--jobs"):
            list(pool.finished())


def test_an_error_while_others_train_stops_them(tmp_path: Path) -> None:
    runs = make_runs({"mine": preset("static")}, [scene(tmp_path)], [0], tmp_path / "out")
    pool = MagicMock(jobs=1)
    pool.finished.side_effect = MsdgsError("no more memory")
    pool.__len__.return_value = 1
    with pytest.raises(MsdgsError):
        train_all(runs, contextlib.nullcontext(pool), lambda *_: None)
    pool.stop.assert_called_once()


@contextlib.contextmanager
def begun(systems_file: Path, data: Path, out: Path) -> Iterator[subprocess.Popen[str]]:
    """A comparison in a subprocess, after its first run has started."""
    command = arguments(systems_file, data, out, "--seeds", "0", "--steps", "100000")
    with program("msdgs_train", *command) as process:
        wait_for(lambda: process.poll() is not None or (out / "static" / "scene_0" / "config.json").exists(), 300)
        yield process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_saves_and_the_same_command_goes_on(
    systems_file: Path, data: Path, tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "out"
    with begun(systems_file, data, out) as process:
        process.send_signal(number)
        output = process.communicate(timeout=600)[0]
    assert process.returncode == cli.EXIT_INTERRUPTED, output
    assert "static, scene, seed 0: interrupted" in output
    assert "the same command continues" in output
    assert (out / "static" / "scene_0" / "checkpoint.pt").exists()
    assert not (out / "k1").exists()


def test_where_the_command_is_killed_its_runs_save_and_end(systems_file: Path, data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with begun(systems_file, data, out) as process:
        process.kill()
        process.communicate(timeout=600)  # end of file when the last writing process has ended
    assert (out / "static" / "scene_0" / "checkpoint.pt").exists()
