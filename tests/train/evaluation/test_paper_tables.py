"""The published numbers of benchmarks/paper agree with each other, and its systems can be read."""

import dataclasses
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.paper.__main__ import Paper
from benchmarks.paper.page import Results, sections
from benchmarks.paper.tables import Method, PaperBudget, Trained, find_scenes, read_systems, read_table, runs_of
from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.comparison.rows import COLUMNS
from msdgs_train.comparison.scenes import Scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.schedule import Schedule
from msdgs_train.layers.base import SceneBounds
from msdgs_train.layers.hash4d import Hash4DConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.parameters import LearningRate
from msdgs_train.layers.parts import from_plain
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.layers.registry import LAYERS
from msdgs_train.systems.registry import preset
from msdgs_train.volumes.hexplane import HexPlaneConfig
from tests.support.processes import ROOT
from tests.support.tolerances import assert_close

FOLDER = ROOT / "benchmarks" / "paper"
NO_PLANES = ("HyperNeRF", "msdgs-plane")  # table 3 doesn't have them
TABLES = ("table1", "table2", "table3", "table4", "table5", "figure7")


def contents(name: str) -> dict[str, Any]:
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))


def numbers(table: str) -> dict[str, dict[str, list[float]]]:
    """By row and scene."""
    return {method["name"]: method.get("numbers", {}) for method in contents(table)["methods"]}


def test_means_are_those_of_the_scenes() -> None:
    for row in numbers("table1").values():
        if row:
            scenes = [row[scene] for scene in contents("table1")["scenes"]]
            psnr, *others = np.mean(scenes, axis=0)
            assert_close(psnr, row["mean"][0], "published.psnr")
            assert_close(others, row["mean"][1:], "published.ssim_lpips")


def test_rows_of_several_tables_are_the_same() -> None:
    one, four, five, seven = map(numbers, ("table1", "table4", "table5", "figure7"))
    for name in ("DeformGS", "4DGS"):
        assert four[name]["mean"] == one[name]["mean"]
    assert five["ours full"] == seven["K=10"] == {"mean": one["Ours(MLP)"]["mean"]}
    assert four["Ours(k=2)"] == seven["K=2"]


def test_gains_are_those_of_the_text() -> None:
    """Section 4.3: +2.59 dB over the MLP baseline, +4.41 dB over the plane baseline."""
    means = {name: row["mean"][0] for name, row in numbers("table1").items() if row}
    gains = [means[m["name"]] - means[m["baseline"]] for m in contents("table1")["methods"] if "baseline" in m]
    assert [f"{gain:.2f}" for gain in gains] == ["4.41", "2.59"]


@pytest.mark.parametrize("name", TABLES)
def test_every_number_has_a_scene_and_every_row_a_system(name: str) -> None:
    table, known = contents(name), contents("systems")
    names = [method["name"] for method in table["methods"]]
    assert len(set(names)) == len(names)
    for method in table["methods"]:
        assert method["system"] in known
        assert method.get("baseline", names[0]) in names
        row = method.get("numbers", {})
        assert set(row) <= {*table["scenes"], "mean"}
        assert {len(values) for values in row.values()} <= {len(table["metrics"])}


DATASETS = {"D-NeRF": "table1", "Neu3D": "table2", "HyperNeRF": "table3"}


def trained(system: str, dataset: str, scene: str = "", *, small: bool = False) -> Trained:
    """What the benchmark trains for a system of systems.toml."""
    table = dataclasses.replace(read_table(DATASETS[dataset]), methods=[Method(system, system)])
    return read_systems(table, [Scene(scene, Path(scene), {})], PaperBudget(), small=small)[system]


def published(system: str, dataset: str, scene: str) -> TrainConfig:
    """The settings of a row on a scene."""
    return trained(system, dataset, scene).configs[scene]


def rates(config: TrainConfig, step: int) -> dict[str, float]:
    """Of means and of the first layer, in a step counted from 0."""
    o, layer, schedule = config.optimizer, config.model.layers[0], Schedule.from_config(config)
    assert isinstance(layer, MLPConfig | PlaneConfig | Hash4DConfig)
    until = layer.lr_until if isinstance(layer, Hash4DConfig) else 1.0
    found = {
        "means": LearningRate(o.means_lr_init, o.means_lr_final, until=o.means_lr_until_fraction),
        "network": LearningRate(layer.lr_init, layer.lr_final, True, until),
    }
    if not isinstance(layer, MLPConfig):
        found["grids"] = LearningRate(layer.grid_lr_init, layer.grid_lr_final, True, until)
    return {name: schedule.rate(lr, step) for name, lr in found.items()}


@pytest.mark.parametrize("name", TABLES)
def test_every_row_has_settings_for_every_scene(name: str) -> None:
    table = contents(name)
    for method in table["methods"]:
        for scene in table["scenes"]:
            row = trained(method["system"], table["dataset"], scene)
            Schedule.from_config(row.configs[scene])
            assert any(recipe.source for recipe in row.recipes.values())


def test_published_settings_are_of_known_rows_and_scenes() -> None:
    tables = [contents(name) for name in TABLES]
    scenes = {table["dataset"]: {*table["scenes"], "Lego"} for table in tables}
    names = {(method["system"], table["dataset"]) for table in tables for method in table["methods"]}
    used = {(published(name, dataset, "").run.system, dataset) for name, dataset in names}
    found = contents("published")
    assert {(name, dataset) for name, of in found.items() for dataset in of} == used
    keys = {"source", "steps", "in_steps", "settings", "layer", "differs"}
    for datasets in found.values():
        for dataset, entry in datasets.items():
            assert set(entry) <= keys | {"like", "scenes"}
            assert set(entry.get("scenes", {})) <= scenes[dataset]
            assert all(set(of) <= keys for of in entry.get("scenes", {}).values())


IMAGES = {"Bouncingballs": 150, "Hellwarrior": 100, "Hook": 100, "Jumpingjacks": 200}
IMAGES |= {"Lego": 50, "Mutant": 150, "Standup": 150, "Trex": 200}


@pytest.mark.parametrize("scene", IMAGES)
def test_planes_of_dnerf_have_the_published_times(scene: str) -> None:
    """The rule that dnerf_slim.yaml states, and half the number of images in arguments/dnerf of 4DGaussians."""
    own = published("hexplane", "D-NeRF", scene).own
    assert isinstance(own, HexPlaneConfig)
    assert (own.times, own.first_times) == (int(0.24 * IMAGES[scene]), int(0.12 * IMAGES[scene]))
    (layer,) = published("4dgs", "D-NeRF", scene).model.layers
    assert isinstance(layer, PlaneConfig)
    assert layer.time_resolution == IMAGES[scene] // 2


@pytest.mark.parametrize(
    ("dataset", "system"),
    [(d, s) for d in ("Neu3D", "HyperNeRF") for s in ("deformgs", "msdgs-mlp", "msdgs-plane") if (d, s) != NO_PLANES],
)
def test_the_loop_of_deformable_3d_gaussians_for_real_scenes(dataset: str, system: str) -> None:
    config = published(system, dataset, "")
    schedule = Schedule.from_config(config)
    assert schedule.num_steps == 20_000
    assert [schedule.deforms(step) for step in (2_998, 2_999)] == [False, True]
    assert [step for step in range(1, 20_001) if schedule.refines_at(step)] == list(range(600, 15_000, 100))
    assert [step for step in range(1, 20_001) if schedule.resets_at(step)] == [3_000, 6_000, 9_000, 12_000]
    noise = [schedule.time_noise(step) for step in (2_998, 5_000, 10_000, 19_999)]
    assert_close(noise, [0.0, 0.075, 0.05, 0.1 / 20_000], "published.rate")
    for step in (0, 5_000, 20_000):
        want = {"means": 8e-4 * 0.01 ** (step / 30_000), "network": 8e-4 * 0.002 ** (step / 40_000)}
        if system == "msdgs-plane":
            want["grids"] = 8e-3 * 0.01 ** (step / 40_000)
        got = rates(config, step)
        assert_close([got[name] for name in want], [*want.values()], "published.rate.relative")
    for layer in config.model.layers:
        assert isinstance(layer, PlaneConfig | MLPConfig)
        if isinstance(layer, MLPConfig):
            assert (layer.time_network, layer.time_frequencies) == (False, 10)
    assert published(system, "D-NeRF", "Hook").curriculum.time_noise == 0


@pytest.mark.parametrize(
    ("dataset", "scene", "batch_size", "multires", "times"),
    [
        ("HyperNeRF", "Broom", 2, (1, 2, 4), 100),
        ("HyperNeRF", "3DPrinter", 2, (1, 2, 4), 100),
        ("HyperNeRF", "Chicken", 2, (1, 2, 4), 80),
        ("HyperNeRF", "Peel Banana", 2, (1, 2, 4), 250),
        ("Neu3D", "Coffee Martini", 4, (1, 2), 150),
        ("Neu3D", "Cook Spinach", 2, (1, 2), 150),
        ("Neu3D", "Flame Salmon", 4, (1, 2), 150),
    ],
)
def test_4dgaussians_on_real_scenes(
    dataset: str, scene: str, batch_size: int, multires: tuple[int, ...], times: int
) -> None:
    config = published("4dgs", dataset, scene)
    schedule, model = Schedule.from_config(config), config.model
    assert (schedule.num_steps, schedule.restart_step, config.run.batch_size) == (17_000, 3_000, batch_size)
    rounds = [step for step in range(1, 17_001) if schedule.refines_at(step)]
    assert rounds == [*range(600, 3_001, 100), *range(3_600, 13_000, 100)]
    assert not any(schedule.resets_at(step) for step in range(1, 17_001))
    (layer,) = model.layers
    assert isinstance(layer, PlaneConfig)
    assert (layer.features, layer.width, layer.multires, layer.time_resolution) == (16, 128, multires, times)
    assert (model.opacity_head, model.sh_head) == (dataset == "Neu3D",) * 2
    for step in (0, 3_000, 10_000, 16_999):
        part = (step if step < 3_000 else step - 3_000) / 20_000
        want = {"means": 8e-4 * 0.01**part, "network": 8e-4 * 0.1**part, "grids": 8e-3 * 0.1**part}
        got = rates(config, step)
        assert_close([got[name] for name in want], [*want.values()], "published.rate.relative")


@pytest.mark.parametrize(
    ("dataset", "scene", "steps", "warm_up", "bound", "finest", "every", "noise", "decays"),
    [  # decays in steps: means, network and grids
        ("D-NeRF", "Hook", 50_000, 3_000, None, (32, 32, 16), (100, 3_000), 1e-2 / 3.2, (35_000, 45_000)),
        ("HyperNeRF", "Broom", 30_000, 1, 0.8, (256, 256, 64), (100, 3_000), 1e-2 / 1.6, (30_000, 30_000)),
        ("HyperNeRF", "3DPrinter", 40_000, 1_000, 1.0, (512, 512, 32), (100, 3_000), 1e-2 / 2, (35_000, 40_000)),
        ("HyperNeRF", "Chicken", 40_000, 1_000, 1.6, (512, 512, 32), (100, 1_000), 1e-2 / 3.2, (25_000, 25_000)),
        ("HyperNeRF", "Peel Banana", 30_000, 1, 1.0, (256, 256, 256), (100, 1_000), 1e-2 / 2, (25_000, 30_000)),
        ("Neu3D", "Coffee Martini", 50_000, 3_000, 30.0, (64, 64, 128), (400, 6_000), None, (35_000, 45_000)),
        ("Neu3D", "Flame Salmon", 50_000, 3_000, 30.0, (64, 64, 128), (400, 6_000), None, (35_000, 45_000)),
        ("Neu3D", "Sear Steak", 20_000, 3_000, 30.0, (512, 512, 128), (400, 6_000), 5e-3 / 60, (35_000, 45_000)),
    ],
)
def test_grid4d_by_scene(
    dataset: str,
    scene: str,
    steps: int,
    warm_up: int,
    bound: float | None,
    finest: tuple[int, ...],
    every: tuple[int, int],
    noise: float | None,
    decays: tuple[int, int],
) -> None:
    config = published("grid4d", dataset, scene)
    schedule, (layer,) = Schedule.from_config(config), config.model.layers
    assert isinstance(layer, Hash4DConfig)
    assert (schedule.num_steps, schedule.deform_start_step) == (steps, warm_up - 1)
    assert (config.data.scene_half_size, layer.finest) == (bound, finest)
    assert (schedule.refine_every, schedule.reset_every) == every
    assert (layer.depth, layer.displaced < 1) == (int(dataset == "HyperNeRF"), dataset == "D-NeRF")
    assert (config.loss.ssim_lambda == 0) == (layer.temporal_weight == 0) == (noise is None)
    if noise:
        assert_close(layer.temporal_noise, noise, "published.rate.relative")
    for step in (0, 10_000, steps):
        means, network = (min(step / of, 1) for of in decays)
        grid = 1.6e-3 if scene == "Peel Banana" else 8e-3
        want = {
            "means": 8e-4 * 0.01**means,
            "network": (8e-4 * 0.002**network if dataset == "D-NeRF" else 1.6e-4 * 0.01**network),
            "grids": grid * 0.01**network,
        }
        got = rates(config, step)
        assert_close([got[name] for name in want], [*want.values()], "published.rate.relative")


def test_grid4d_on_lego_is_as_docs_say() -> None:
    (layer,) = published("grid4d", "D-NeRF", "Lego").model.layers
    shown = re.search("`--layers (.*)`", (ROOT / "docs" / "migration.md").read_text(encoding="utf-8"))
    assert shown is not None
    assert from_plain("layers", shown[1], LAYERS) == layer


@pytest.mark.parametrize("small", [False, True])
def test_systems_can_be_read(small: bool) -> None:
    for name in contents("systems"):
        config = trained(name, "D-NeRF", small=small).configs[""]
        assert Schedule.from_config(config).num_steps == config.run.steps


def test_systems_have_the_published_parameters() -> None:
    """Table 4, in millions; that of 4DGS includes heads of opacity and color, which are off in its own settings."""
    for method in contents("table4")["methods"]:
        model = published(method["system"], "D-NeRF", "").model
        if method["name"] == "4DGS":
            model = dataclasses.replace(model, opacity_head=True, sh_head=True)
        layers = [layer.build(SceneBounds(1.0), model.heads, None) for layer in model.layers]
        count = sum(p.numel() for layer in layers for p in layer.parameters())
        assert f"{count / 1e6:.2f}" == f"{method['parameters'][0]:.2f}", method["name"]
        assert (model.embedding_dim > 0) == (len(method["parameters"]) == 2)


def test_no_steps_are_not_as_many_as_published() -> None:
    config = preset("deformgs-faithful")
    assert PaperBudget().of(config).run.steps == config.run.steps
    with pytest.raises(InvalidInput, match="steps"):
        PaperBudget(steps=0).of(config)


def test_the_mean_gain_is_that_of_all_scenes(tmp_path: Path) -> None:
    table, budget = read_table("table1"), PaperBudget()
    scenes = [Scene(name, tmp_path, {}) for name in table.scenes]
    systems = read_systems(table, scenes, budget, small=True)

    def mean_gain(of: list[Scene]) -> str:
        psnr = {systems["Ours(MLP)"].system: "31", systems["DeformGS"].system: "30"}
        found = {"seed": "0", "val_psnr": "", "date": "2026-01-01", "machine": "any", "best_split": ""}
        rows = [
            {**dict.fromkeys(COLUMNS, ""), **found, "scene": scene.name, "system": system}
            | {"test_psnr": value, "test_images": f"{value} {value}"}
            for scene in of
            for system, value in psnr.items()
        ]
        runs = runs_of(systems, scenes, (0,), tmp_path)
        results = Results(table, systems, scenes, runs, rows, budget, True)
        gains = next(section for section in sections(results) if section.heading.startswith("Gain on test images"))
        return next(line[-1] for line in gains.lines if line[0].startswith("Ours(MLP)"))

    assert mean_gain(scenes) == "+1.00 (+1.00 to +1.00) / +2.59"
    assert mean_gain(scenes[:-1]) == "– / +2.59"


def test_the_page_says_what_wasnt_measured_and_which_runs_took_longer(tmp_path: Path) -> None:
    table, budget = read_table("table1"), PaperBudget(minutes=10, time="cpu")
    scenes = [Scene("Hook", tmp_path, {})]
    systems = read_systems(table, scenes, budget, small=True)
    found = {"scene": "Hook", "seed": "0", "date": "2026-01-01", "machine": "any", "minutes": "10", "test_psnr": "20"}
    rows = [
        {**dict.fromkeys(COLUMNS, "0"), **found, "system": systems[name].system, "seconds": seconds, "best_split": ""}
        | {"test_lpips": lpips, "val_lpips": "", "val_psnr": "", "test_images": "20"}
        for name, seconds, lpips in (("TiNeuVox", "1111", ""), ("4DGS", "612", "0.1"))
    ]

    def conditions(of: list[dict[str, str]]) -> str:
        runs = runs_of(systems, scenes, (0,), tmp_path)
        return " ".join(next(sections(Results(table, systems, scenes, runs, of, budget, True))).notes)

    assert "LPIPS wasn't measured in 1 run(s):" in conditions(rows)
    assert "1 run(s) of tineuvox small took longer than their minutes" in conditions(rows)
    assert "LPIPS wasn't measured: " in conditions(rows[:1])
    assert not re.search("LPIPS|longer", conditions(rows[1:]))


def test_scenes_that_arent_chosen_may_be_missing(tmp_path: Path) -> None:
    (tmp_path / "scenes.toml").write_text('[one]\nfolder = "one"\n[two]\nfolder = "two"\n')
    scenes = find_scenes(read_table("table1"), [tmp_path / "scenes.toml"])
    assert [scene.name for scene in scenes] == ["one", "two"]
    paper = Paper("table1", (tmp_path / "scenes.toml",), tmp_path / "out", methods=("DeformGS",), small=True)
    with pytest.raises(InvalidInput, match=r"no folder .*one, .*two"):
        paper.execute()
    (tmp_path / "one").mkdir()
    assert dataclasses.replace(paper, scenes=("one",)).execute() == EXIT_INVALID, "the run: the folder is empty"
    assert (tmp_path / "out" / "table1.md").exists()


def test_the_page_is_one_file() -> None:
    assert "http" not in Path(FOLDER / "page.html").read_text(encoding="utf-8")
