"""The benchmark of many scenes: its rows, its table and its continuation from the CSV file."""

import csv
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.cli import main as cli
from msdgs_train.comparison import bench
from msdgs_train.comparison.bench import (
    COLUMNS,
    KEY,
    append_row,
    key_of,
    make_bench_runs,
    read_rows,
    read_scenes,
    rows_of,
)
from msdgs_train.comparison.bench_report import as_markdown, paired_gain
from msdgs_train.systems.registry import preset
from tests.support.training_scene import write_scene

SCENES = """
[small]
folder = "one"
size = 12
short = true
[held_out]
folder = "one"
size = 12
llffhold = 4
splits = ["val"]
[elsewhere]
folder = "two"
size = 12
"""


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "bench.toml").write_text(SCENES)
    monkeypatch.setattr(bench.read_scenes, "__kwdefaults__", {"names": (), "file": tmp_path / "bench.toml"})
    write_scene(tmp_path / "one")
    return tmp_path


def row(scene: str, system: str, seed: int, images: list[float]) -> bench.Row:
    values = {"scene": scene, "system": system, "seed": str(seed), "minutes": "5", "threads": "2", "date": "2026-01-01"}
    mean = f"{np.mean(images):.4f}"
    scores = {"val_psnr": "20", "test_psnr": mean, "test_images": " ".join(f"{v:.2f}" for v in images)}
    return dict.fromkeys(COLUMNS, "") | values | scores


def test_scenes_are_of_the_short_form_or_all(data: Path) -> None:
    assert [scene.name for scene in read_scenes(data, short=True)] == ["small"]
    assert [scene.name for scene in read_scenes(data, short=True, names=["held_out"])] == ["held_out"]
    with pytest.raises(InvalidInput, match="`scenes` must be of small, held_out, elsewhere, got nowhere"):
        read_scenes(data, short=True, names=["nowhere"])
    with pytest.raises(InvalidInput, match="datasets named two"):
        read_scenes(data, short=False)


def test_shipped_scenes_have_a_short_form_of_eight() -> None:
    with pytest.raises(InvalidInput, match="toybench_slow"):
        read_scenes(Path("nowhere"), short=True, file=bench.SCENES)
    assert bench.SCENES.read_text().count("short = true") == 8


@pytest.mark.usefixtures("in_threads", "no_curve")
def test_the_same_command_goes_on_from_its_rows(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    systems = data / "systems.toml"
    systems.write_text('[tiny]\npreset = "static"\ninit_num_pts = 60\nmax_gaussians = 90\nsteps = 4\n')
    command = ["bench", str(systems), "--data", str(data), "--out", str(data / "out"), "--minutes=1e-9", "--threads=1"]
    command += ["--time=cpu"]
    assert cli.main(command) == 0
    (first,) = read_rows(data / "out" / "bench.csv")
    shown = [first[name] for name in ("scene", "system", "optimizer_steps", "time")]
    assert shown == ["small", "tiny", "2", "cpu"]
    assert float(first["test_psnr"]) > 0
    assert len(first["val_images"].split()) > 0
    assert cli.main(command) == 0
    assert read_rows(data / "out" / "bench.csv") == [first]
    assert cli.main([*command, f"--csv={data / 'out' / 'bench.csv'}", f"--out={data / 'other'}"]) == 0
    assert (data / "other" / "bench.md").exists()
    assert "tiny, small, seed 0" in capsys.readouterr().out
    systems.write_text(systems.read_text() + "sh_degree = 0\n")
    assert cli.main(command) == 0
    assert [r["settings"] == first["settings"] for r in read_rows(data / "out" / "bench.csv")] == [True, False]


@pytest.mark.parametrize("option", ["--jobs=0", "--minutes=0"])
def test_no_job_and_no_time_are_refused(option: str, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "static", "--data", str(data), "--out", str(data / "no"), option]) == cli.EXIT_INVALID
    assert option[2:6] in capsys.readouterr().err
    assert not (data / "no").exists()


def test_runs_are_of_each_scene_at_its_size(data: Path) -> None:
    scenes = [*read_scenes(data, short=True), bench.BenchScene("held_out", data / "one", 12, 4, ("val",))]
    runs = make_bench_runs({"a": preset("static"), "b": preset("static")}, scenes, (0, 1), data / "out")
    assert [(run.seed, run.scene, run.system) for run in runs[:4]] == [
        (0, "small", "a"), (0, "small", "b"), (0, "held_out", "a"), (0, "held_out", "b"),
    ]  # fmt: skip
    assert [run.config.data.llffhold for run in runs[:4]] == [0, 0, 4, 4]
    assert len({run.folder for run in runs}) == 8
    other_times = replace(scenes[0], time_from="index")
    (timed,) = make_bench_runs({"a": preset("static")}, [other_times], (0,), data / "out")
    assert (timed.config.data.time_from, timed.folder) == ("index", runs[0].folder)  # as of other settings of scenes
    slower = make_bench_runs({"a": preset("static").updated(threads=7)}, scenes, (0,), data / "out")
    assert not {run.folder for run in slower} & {run.folder for run in runs}


def test_the_table_has_means_over_scenes_that_all_have_and_gains_of_seeds_that_both_have() -> None:
    rows = [
        row("s1", "a", 0, [20.0, 30.0]), row("s1", "a", 1, [22.0, 32.0]), row("s1", "b", 0, [23.0, 33.0]),
        row("s2", "a", 0, [10.0, 10.0]),
    ]  # fmt: skip
    table = as_markdown(rows, ["a", "b"])
    assert "| s1 | 20.00 ± 0.00 | 20.00 | 26.00 ± 1.41 | 28.00 |" in table
    assert "| s2 | 20.00 | – | 10.00 | – |" in table
    assert "| mean | 20.00 | 20.00 | 26.00 | 28.00 |" in table
    assert "| s1 | +3.00 (+3.00 to +3.00) |" in table
    assert "| mean | +3.00 (+3.00 to +3.00) |" in table


def test_gains_are_over_the_first_system_of_the_command_whichever_run_ended_first(data: Path) -> None:
    runs = make_bench_runs({"a": preset("static"), "b": preset("static")}, read_scenes(data, short=True), (0, 1), data)
    csv_file = data / "bench.csv"
    for run in reversed(runs):
        images = [20.0, 30.0] if run.system == "a" else [23.0, 33.0]
        append_row(csv_file, row(run.scene, run.system, run.seed, images) | dict(zip(KEY, key_of(run), strict=True)))
    rows = rows_of(runs, csv_file)
    assert [(each["seed"], each["system"]) for each in rows] == [("0", "a"), ("0", "b"), ("1", "a"), ("1", "b")]
    for some in (rows, rows[1:]):
        table = as_markdown(some, ["a", "b"])
        assert "Gain over a" in table
        assert "| small | +3.00 (+3.00 to +3.00) |" in table


def test_an_interval_covers_the_mean_gain() -> None:
    generator = np.random.default_rng(1)
    mean, low, high = paired_gain([generator.normal(0.5, 0.2, 40)])
    assert low < mean < high
    assert mean == pytest.approx(0.5, abs=0.15)
    assert 0.05 < high - low < 0.25


def test_rows_of_several_benchmarks_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "new" / "bench.csv"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda seed: append_row(path, row("s", "a", seed, [1.0])), range(40)))
    assert sorted(int(found["seed"]) for found in read_rows(path)) == list(range(40))


def test_a_csv_file_of_other_columns_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    append_row(path, row("s", "a", 0, [1.0]))
    with path.open(newline="") as file:
        assert len(list(csv.reader(file))) == 2
    path.write_text("scene,system\n")
    with pytest.raises(InvalidInput, match="columns"):
        read_rows(path)
