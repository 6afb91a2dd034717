"""Presets: the sizes that their papers publish, and that each one trains."""

import dataclasses
from pathlib import Path

import pytest
import torch

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import load_scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.modulation import EMBEDDINGS
from msdgs_train.systems.registry import DEFAULT, preset, systems
from tests.support.training_scene import shrunk, splatting

pytestmark = pytest.mark.slow


def sizes(config: ModelConfig, count: int = 3) -> tuple[int, int]:
    """Parameters of the deformation, and of the modulation with its embeddings."""
    model = DynamicGaussians(
        config, CanonicalGaussians.random_in_cube(count, 1.0, config.sh_degree, 0, config.attributes())
    )
    modulation = (
        [] if model.modulation is None else [*model.modulation.parameters(), model.gaussians.attributes[EMBEDDINGS]]
    )
    return sum(p.numel() for p in model.deformation.parameters()), sum(p.numel() for p in modulation)


def in_millions(count: float) -> float:
    return round(count / 1e6, 2)


@pytest.mark.parametrize(
    ("name", "deformation"),
    [
        ("msdgs-mlp", 10 * 235_561),
        ("msdgs-plane", 10 * 131_083),
        ("deformgs", 522_280),
        ("4dgs", 3_365_770),
        ("static", 0),
    ],
)
def test_published_numbers_of_parameters(name: str, deformation: int) -> None:
    assert sizes(preset(name).model)[0] == deformation


def test_table_4() -> None:
    """Its rows, in millions; N is what makes the modulation's share as large as it says."""
    paper = [preset(f"msdgs-{kind}").model for kind in ("mlp", "plane")]
    two = [dataclasses.replace(config, layers=config.layers[:2]) for config in paper]
    assert [in_millions(sizes(config)[0]) for config in two] == [0.47, 0.26]
    assert in_millions(sizes(preset("deformgs").model)[0]) == 0.52
    with_all_heads = dataclasses.replace(preset("4dgs").model, opacity_head=True, sh_head=True)
    assert in_millions(sizes(with_all_heads)[0]) == 3.38
    assert [in_millions(sizes(two[i], n)[1]) for i, n in ((0, 106_500), (1, 52_800))] == [3.41, 1.69]


def test_the_defaults_of_settings_are_a_preset() -> None:
    assert preset("msdgs-small") == TrainConfig()


def test_a_config_names_its_system() -> None:
    assert [entry.config.run.system for entry in systems().values()] == list(systems())
    assert next(iter(systems())) == DEFAULT


def test_unknown_names_are_refused_with_those_there_are() -> None:
    with pytest.raises(InvalidInput, match=r"msdgs-nodes.*4dgs.*msdgs-mlp.*--plugin.*hexplane"):
        preset("hexplane")


@pytest.mark.parametrize("name", systems())
def test_each_preset_trains(name: str, data: Path) -> None:
    trainer = Trainer(shrunk(preset(name)), load_scene(data))
    deformation = splatting(trainer).model.deformation
    before = {n: p.detach().clone() for n, p in deformation.named_parameters()}
    results = [trainer.step() for _ in range(12)]
    assert results[-1].skipped == 0
    unchanged = {n for n, p in deformation.named_parameters() if torch.equal(before[n], p)}
    assert not unchanged, "every part of the deformation learns"
