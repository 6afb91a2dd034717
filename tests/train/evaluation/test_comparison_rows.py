"""Comparisons of many scenes: the scenes of TOML files, rows of runs, continuing from them, gains with intervals."""

import csv
import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.cli import main as cli
from msdgs_train.comparison.best import best_as_markdown, best_evaluation
from msdgs_train.comparison.gains import paired_gain, scenes_as_markdown
from msdgs_train.comparison.matrix import Budget, Run, make_runs
from msdgs_train.comparison.report import write_comparison
from msdgs_train.comparison.rows import (
    BEST,
    COLUMNS,
    DATASET,
    KEY,
    Row,
    append_row,
    key_of,
    key_of_row,
    read_rows,
    rows_of,
)
from msdgs_train.comparison.scenes import Scene, read_scenes
from msdgs_train.engine.config import TrainConfig
from msdgs_train.systems.registry import preset
from tests.support.processes import ROOT
from tests.support.training_scene import write_scene

SCENES = """
[small]
folder = "one"
size = 12
[held_out]
folder = "one"
size = 12
llffhold = 4
splits = ["val"]
[timed]
folder = "one"
time_from = "index"
"""


@pytest.fixture
def data(tmp_path: Path) -> Path:
    (tmp_path / "scenes.toml").write_text(SCENES)
    write_scene(tmp_path / "one")
    return tmp_path


def row(scene: str, system: str, seed: int, images: list[float]) -> Row:
    values = {"scene": scene, "system": system, "seed": str(seed), "minutes": "5", "threads": "2", "date": "2026-01-01"}
    mean = f"{np.mean(images):.4f}"
    scores = {"val_psnr": "20", "test_psnr": mean, "test_images": " ".join(f"{v:.2f}" for v in images)}
    return dict.fromkeys(COLUMNS, "") | values | scores


def test_scenes_are_folders_and_tables_of_files(data: Path) -> None:
    scenes = read_scenes([data / "one", data / "scenes.toml"])
    assert [scene.name for scene in scenes] == ["one", "small", "held_out", "timed"]
    assert {scene.folder for scene in scenes} == {data / "one"}
    assert [dict(scene.settings) for scene in scenes] == [
        {}, {"size": 12}, {"size": 12, "llffhold": 4}, {"time_from": "index"}
    ]  # fmt: skip
    assert [scene.splits for scene in scenes[1:3]] == [("val", "test"), ("val",)]
    assert [scene.name for scene in read_scenes([data / "scenes.toml"], ["held_out"])] == ["held_out"]


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ("[a]\nsize = 12", "scenes with a folder"),
        ("[a]\nfolder = 'one'\nsise = 12", "scene `a`: sise"),
        ("[a]\nfolder = 'one'\nsize = 'wide'", "scene `a`.*size"),
        ("[a]\nfolder = 'one'\nllffhold = 1", "scene `a`.*llffhold"),
        ("[a]\nfolder = 'one'\nsplits = ['train']", "splits of val, test"),
        ("[a]\nfolder = 'one'\nsplits = []", "splits of val, test"),
        ("[a]\nfolder = 'nowhere'", "no folder .*nowhere"),
        ("[one]\nfolder = 'one'", "`one` twice"),
        ("[a", "a TOML file"),
        ("a = 1", "`a`"),
    ],
)
def test_what_is_no_scene_is_named(data: Path, contents: str, message: str) -> None:
    (data / "scenes.toml").write_text(contents)
    with pytest.raises(InvalidInput, match=message):
        read_scenes([data / "one", data / "scenes.toml"])


def test_scenes_of_other_names_and_missing_folders_are_refused(data: Path) -> None:
    with pytest.raises(InvalidInput, match="`scenes` must be of small, held_out, timed, got nowhere"):
        read_scenes([data / "scenes.toml"], ["nowhere"])
    with pytest.raises(InvalidInput, match=r"no folder .*none"):
        read_scenes([data / "none"])


@pytest.mark.parametrize(("name", "count"), [("scenes", 9), ("more_scenes", 5), ("k_steps", 4), ("captures", 5)])
def test_scenes_of_the_benchmarks_can_be_read(name: str, count: int, tmp_path: Path) -> None:
    file = tmp_path / "benchmarks" / "training" / "scenes.toml"
    file.parent.mkdir(parents=True)
    file.write_text((ROOT / "benchmarks" / "training" / f"{name}.toml").read_text())
    with pytest.raises(InvalidInput, match="no folder") as refused:
        read_scenes([file])
    for folder in str(refused.value.got).removeprefix("no folder ").split(", "):
        assert Path(folder).parent == tmp_path / "data"
        Path(folder).mkdir(parents=True)
    assert len(read_scenes([file])) == count


@pytest.mark.parametrize(("name", "count"), [("bench", 27), ("k_steps", 285)])
def test_published_rows_can_be_read(name: str, count: int) -> None:
    rows = read_rows(ROOT / "docs" / "data" / f"{name}.csv")
    assert len({key_of_row(each) for each in rows}) == len(rows) == count
    text = scenes_as_markdown(rows, list(dict.fromkeys(each["system"] for each in rows)))
    assert all(each["scene"] in text for each in rows)


@pytest.mark.usefixtures("in_threads", "no_curve")
def test_the_same_command_goes_on_from_its_rows(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    systems = data / "systems.toml"
    systems.write_text('[tiny]\npreset = "static"\ninit_num_pts = 60\nmax_gaussians = 90\n')
    out, rows = data / "out", data / "rows.csv"
    command = ["compare", str(systems), "--data", str(data / "scenes.toml"), "--scenes", "small", "--seeds", "0"]
    command += ["--steps=4", "--minutes=1e-9", "--time=cpu", "--jobs=1", f"--csv={rows}"]
    assert cli.main([*command, f"--out={out}"]) == 0
    (first,) = read_rows(rows)
    shown = [first[name] for name in ("scene", "system", "optimizer_steps", "time")]
    assert shown == ["small", "tiny", "2", "cpu"]
    assert float(first["test_psnr"]) > 0
    assert len(first["val_images"].split()) > 0
    assert (first["parameters"], first["modulation_parameters"]) == ("0", "0")
    assert (first["best_split"], first["best_step"].isdigit()) == ("val", True)
    assert float(first["best_psnr"]) >= float(first["val_psnr"]) - 1e-3
    assert f"| tiny | small | val | {float(first['val_psnr']):.2f} |" in (out / "comparison.md").read_text()
    assert cli.main([*command, f"--out={out}"]) == 0
    assert read_rows(rows) == [first]
    assert cli.main([*command, f"--out={data / 'other'}"]) == 0
    assert [path.name for path in (data / "other").iterdir()] == ["comparison.md"]  # nothing was trained
    assert capsys.readouterr().out.count("tiny, small, seed 0") == 1
    systems.write_text(systems.read_text() + "sh_degree = 0\n")
    assert cli.main([*command, f"--out={out}"]) == cli.EXIT_INVALID
    assert "other settings: sh_degree" in capsys.readouterr().err
    assert cli.main([*command, f"--out={data / 'third'}"]) == 0
    assert [each["settings"] == first["settings"] for each in read_rows(rows)] == [True, False]


@pytest.mark.parametrize("option", ["--jobs=0", "--minutes=0"])
def test_no_job_and_no_time_are_refused(option: str, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["compare", "static", "--data", str(data / "one"), "--out", str(data / "no"), option]
    assert cli.main(command) == cli.EXIT_INVALID
    assert option[2:6] in capsys.readouterr().err
    assert not (data / "no").exists()


def make(data: Path, budget: Budget, *names: str, seeds: tuple[int, ...] = (0,)) -> list[Run]:
    systems = {name: budget.of(preset("static")) for name in ("a", "b")}
    return make_runs(systems, read_scenes([data / "scenes.toml"], names), seeds, data / "out")


def test_runs_are_of_each_scene_at_its_size(data: Path) -> None:
    runs = make(data, Budget(minutes=5, size=50), seeds=(0, 1))
    assert [(run.seed, run.scene, run.system) for run in runs[:4]] == [
        (0, "small", "a"), (0, "small", "b"), (0, "held_out", "a"), (0, "held_out", "b"),
    ]  # fmt: skip
    assert [run.config.data.llffhold for run in runs[:4]] == [0, 0, 4, 4]
    assert [run.config.data.size for run in runs[:6]] == [12, 12, 12, 12, 50, 50]
    assert [run.config.data.time_from for run in runs[2:6]] == [None, None, "index", "index"]
    assert [run.splits for run in runs[:3]] == [("val", "test"), ("val", "test"), ("val",)]
    assert len({run.folder for run in runs}) == 12


def test_a_row_is_of_the_budget_and_of_all_settings(data: Path) -> None:
    budget = Budget(minutes=5, threads=2, time="cpu")
    (known, *_) = make(data, budget)
    assert key_of(known)[:6] == ("small", "a", "0", "5", "cpu", "2")
    changes = ({"minutes": 6.0}, {"threads": 1}, {"time": "wall"}, {"size": 9}, {"steps": 7}, {"max_gaussians": 9000})
    changed = [make(data, dataclasses.replace(budget, **change))[0] for change in changes]
    assert len({key_of(run) for run in [known, *changed]}) == 1 + len(changes)
    assert [run.settings == known.settings for run in changed] == [True, True, True, False, False, False]
    assert make(data, dataclasses.replace(budget, device="cuda"))[0].settings != known.settings


def test_a_new_setting_leaves_rows_as_they_are(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless it is set: one at its default is one that an earlier version had not."""
    (before, *_) = make(data, Budget())
    to_dict = TrainConfig.to_dict

    def extended(config: TrainConfig) -> dict[str, Any]:
        values = to_dict(config)
        values["loss"]["new_weight"] = 0.5 if config.run.steps == 7 else 0.0
        return values

    (seven, *_) = make(data, Budget(steps=7))
    monkeypatch.setattr(TrainConfig, "to_dict", extended)
    assert make(data, Budget())[0].settings == before.settings
    assert make(data, Budget(steps=7))[0].settings != seven.settings


def test_a_new_setting_of_a_system_leaves_its_rows_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    to_dict, scene = TrainConfig.to_dict, Scene("toys", tmp_path, {})

    def settings(**changes: Any) -> str:
        (run,) = make_runs({"a": preset("hexplane-slim").updated(**changes)}, [scene], [0], tmp_path / "out")
        return run.settings

    def extended(config: TrainConfig) -> dict[str, Any]:
        values = to_dict(config)
        return values | {"own": values["own"] | {"new_weight": 0.5 if config.run.steps == 7 else 0.0}}

    before, seven = settings(), settings(steps=7)
    assert settings(rays=64) != before
    monkeypatch.setattr(TrainConfig, "to_dict", extended)
    assert settings() == before
    assert settings(steps=7) != seven


def test_a_row_is_of_the_scenes_own_settings(tmp_path: Path) -> None:
    (tmp_path / "toys").mkdir()
    rows = ["", "size = 9", "llffhold = 4", 'time_from = "index"', 'splits = ["val"]']

    def settings(row: str) -> str:
        (tmp_path / "scenes.toml").write_text(f'[toys]\nfolder = "toys"\n{row}\n')
        (run,) = make_runs({"a": preset("static")}, read_scenes([tmp_path / "scenes.toml"]), [0], tmp_path / "out")
        return run.settings

    assert len({settings(row) for row in rows}) == len(rows)
    assert settings(rows[1]) == settings(rows[1])


def test_the_length_of_a_run_is_steps_or_minutes() -> None:
    config = preset("msdgs-nodes")
    assert Budget().of(config).run.steps == 3000
    timed = Budget(minutes=5).of(config)
    assert (timed.run.steps, timed.run.minutes) == (config.run.steps, 5)
    assert timed.logging.eval_every == config.run.steps // 10


def test_the_table_has_means_over_scenes_that_all_have_and_gains_of_seeds_that_both_have() -> None:
    rows = [
        row("s1", "a", 0, [20.0, 30.0]), row("s1", "a", 1, [22.0, 32.0]), row("s1", "b", 0, [23.0, 33.0]),
        row("s2", "a", 0, [10.0, 10.0]),
    ]  # fmt: skip
    table = scenes_as_markdown(rows, ["a", "b"])
    assert "| s1 | 20.00 ± 0.00 | 20.00 | 26.00 ± 1.41 | 28.00 |" in table
    assert "| s2 | 20.00 | – | 10.00 | – |" in table
    assert "| mean | 20.00 | 20.00 | 26.00 | 28.00 |" in table
    assert "| s1 | +3.00 (+3.00 to +3.00) |" in table
    assert "| mean | +3.00 (+3.00 to +3.00) |" in table
    assert "5 minutes per run on 2 thread(s)" in table
    by_steps = [each | {"minutes": "", "optimizer_steps": "3000"} for each in rows]
    assert "3,000 steps per run on 2 thread(s)" in scenes_as_markdown(by_steps, ["a", "b"])


def test_gains_are_over_the_first_system_of_the_command_whichever_run_ended_first(data: Path) -> None:
    runs = make(data, Budget(), "small", seeds=(0, 1))
    csv_file = data / "rows.csv"
    for run in reversed(runs):
        images = [20.0, 30.0] if run.system == "a" else [23.0, 33.0]
        append_row(csv_file, row(run.scene, run.system, run.seed, images) | dict(zip(KEY, key_of(run), strict=True)))
    rows = [each | {"optimizer_steps": "3000"} for each in rows_of(runs, csv_file)]
    assert [(each["seed"], each["system"]) for each in rows] == [("0", "a"), ("0", "b"), ("1", "a"), ("1", "b")]
    for some in (rows, rows[1:]):
        (path,) = write_comparison(data / "out", [], some, ["a", "b"], missing=len(rows) - len(some))
        text = path.read_text()
        assert "Gain over a" in text
        assert "| small | +3.00 (+3.00 to +3.00) |" in text
        assert ("1 runs are not finished" in text) == (some is not rows)


def test_the_best_evaluation_is_beside_the_last() -> None:
    best = [
        {"best_split": "val", "best_step": step, "best_psnr": psnr} for step, psnr in (("3000", "21"), ("5000", "23"))
    ]
    rows = [row("s1", "a", seed, [30.0]) | of_seed for seed, of_seed in enumerate(best)]
    rows += [row("s1", "b", 0, [30.0]), row("s2", "a", 0, [30.0]) | best[0] | {"best_split": "test"}]
    assert best_evaluation(rows, "s1", "a") == ["val", "20.00 ± 0.00", "22.00 ± 1.41", "4,000 ± 1,414"]
    assert best_evaluation(rows, "s2", "b") is None
    text = best_as_markdown(rows, ["a", "b"])
    assert "| a | s2 | test | 30.00 | 21.00 | 3,000 |" in text
    assert "| b | s1 | – | – | – | – |" in text


def test_an_interval_covers_the_mean_gain() -> None:
    generator = np.random.default_rng(1)
    mean, low, high = paired_gain([generator.normal(0.5, 0.2, 40)])
    assert low < mean < high
    assert mean == pytest.approx(0.5, abs=0.15)
    assert 0.05 < high - low < 0.25


def test_rows_of_several_comparisons_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "new" / "rows.csv"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda seed: append_row(path, row("s", "a", seed, [1.0])), range(40)))
    assert sorted(int(found["seed"]) for found in read_rows(path)) == list(range(40))
    append_row(path, row("s", "a", 7, [2.0]))
    assert len(read_rows(path)) == 40, "a run that has a row"


@pytest.mark.parametrize("later", [(DATASET,), (*BEST, DATASET)])
def test_rows_of_earlier_versions_are_read_and_kept(tmp_path: Path, later: tuple[str, ...]) -> None:
    path, old = tmp_path / "rows.csv", row("s", "a", 0, [1.0])
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [name for name in COLUMNS if name not in later], extrasaction="ignore")
        writer.writeheader()
        writer.writerow(old)
    assert read_rows(path) == [old]
    new = row("s", "a", 1, [2.0]) | dict.fromkeys(later, "9")
    append_row(path, new)
    assert read_rows(path) == [old, new]
    assert path.read_text().splitlines()[0] == ",".join(COLUMNS)


def test_a_csv_file_of_other_columns_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    append_row(path, row("s", "a", 0, [1.0]))
    with path.open(newline="") as file:
        assert len(list(csv.reader(file))) == 2
    path.write_text("scene,system\n")
    with pytest.raises(InvalidInput, match="columns"):
        read_rows(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda line: line[:-9], "complete lines; remove those that aren't, got line 3 of"),
        (lambda line: line + b",1", "complete lines; remove those that aren't, got line 3 of"),
        (lambda line: line.replace(b",20,", b",abc,"), "numbers in the column val_psnr, got 'abc' in line 3 of"),
        (lambda line: line.replace(b"1.00", b"1,00"), "complete lines"),
        (lambda line: line.replace(b"2026", b"\xff\xfe"), "UTF-8"),
    ],
    ids=["cut", "longer", "no number", "comma", "no text"],
)
def test_a_damaged_csv_file_is_refused_by_line(damage: Callable[[bytes], bytes], message: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    for seed in range(3):
        append_row(path, row("s", "a", seed, [1.0, 2.0]))
    assert len(read_rows(path)) == 3
    lines = path.read_bytes().splitlines(keepends=True)
    lines[2] = damage(lines[2].rstrip()) + b"\n"
    path.write_bytes(b"".join(lines))
    with pytest.raises(InvalidInput, match=message):
        read_rows(path)
