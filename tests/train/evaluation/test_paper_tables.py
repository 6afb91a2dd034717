"""The published numbers of benchmarks/paper agree with each other, and its systems can be read."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_train.comparison.matrix import Budget, read_system
from msdgs_train.engine.config import TrainConfig
from msdgs_train.layers.base import SceneBounds
from msdgs_train.systems.registry import systems
from tests.support.processes import ROOT
from tests.support.tolerances import assert_close

FOLDER = ROOT / "benchmarks" / "paper"
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


def config_of(name: str, variant: str) -> TrainConfig | None:
    """The settings of a system, as the benchmark reads them; None if its preset isn't registered."""
    settings = contents("systems")[name][variant]
    if isinstance(settings, str):
        return config_of(settings, variant)
    num_layers = settings.pop("num_layers", 0)
    if settings["preset"] not in systems():
        return None
    config = read_system(name, settings, Budget())
    return config.updated(layers=config.model.layers[:1] * num_layers) if num_layers else config


@pytest.mark.parametrize("variant", ["published", "small"])
def test_systems_can_be_read(variant: str) -> None:
    read = {name for name in contents("systems") if config_of(name, variant)}
    assert {"deformgs", "4dgs", "sc-gs", "msdgs-mlp", "msdgs-plane", "msdgs-mlp no weights", "msdgs-mlp K=10"} <= read


def test_systems_have_the_published_parameters() -> None:
    """Table 4, in millions; that of 4DGS includes heads of opacity and color, which are off in its own settings."""
    for method in contents("table4")["methods"]:
        config = config_of(method["system"], "published")
        assert config is not None
        model = (
            dataclasses.replace(config.model, opacity_head=True, sh_head=True)
            if method["name"] == "4DGS"
            else config.model
        )
        layers = [layer.build(SceneBounds(1.0), model.heads, None) for layer in model.layers]
        count = sum(p.numel() for layer in layers for p in layer.parameters())
        assert f"{count / 1e6:.2f}" == f"{method['parameters'][0]:.2f}", method["name"]
        assert (model.embedding_dim > 0) == (len(method["parameters"]) == 2)


def test_the_page_is_one_file() -> None:
    assert "http" not in Path(FOLDER / "page.html").read_text(encoding="utf-8")
