"""Presets: the sizes that their papers publish, and that each one trains and can be exported."""

import dataclasses
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.main import PresetName
from msdgs_train.datasets import load_scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.systems.presets import DEFAULT, PRESETS, preset
from tests.support.models import export_scene
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow


def sizes(config: ModelConfig, count: int = 3) -> tuple[int, int]:
    """Parameters of the deformation, and of the modulation with its embeddings."""
    model = DynamicGaussians(
        config, CanonicalGaussians.random_in_cube(count, 1.0, config.sh_degree, config.embedding_dim, 0)
    )
    embeddings = model.gaussians.embeddings
    modulation = [] if model.modulation is None or embeddings is None else [*model.modulation.parameters(), embeddings]
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
    two = [dataclasses.replace(preset(f"msdgs-{kind}").model, layers=(kind, kind)) for kind in ("mlp", "plane")]
    assert [in_millions(sizes(config)[0]) for config in two] == [0.47, 0.26]
    assert in_millions(sizes(preset("deformgs").model)[0]) == 0.52
    with_all_heads = dataclasses.replace(preset("4dgs").model, opacity_head=True, sh_head=True)
    assert in_millions(sizes(with_all_heads)[0]) == 3.38
    assert [in_millions(sizes(two[i], n)[1]) for i, n in ((0, 106_500), (1, 52_800))] == [3.41, 1.69]


def test_the_default_is_what_needs_no_preset() -> None:
    assert preset(DEFAULT) == TrainConfig()


def test_the_command_line_offers_all_of_them() -> None:
    assert get_args(PresetName) == tuple(PRESETS)


def test_unknown_names_are_refused_with_those_there_are() -> None:
    with pytest.raises(InvalidInput, match=r"msdgs-mlp.*4dgs.*hexplane"):
        preset("hexplane")


def shrunk(config: TrainConfig) -> TrainConfig:
    """The same system on few Gaussians and in few steps, narrow, with half of its steps after the warm-up."""
    model = dataclasses.replace(
        config.model, layers=config.model.layers[:3], width=16, time_width=8, time_features=4, plane_features_dim=4,
        plane_resolution=6, plane_time_resolution=5, plane_width=8, embedding_dim=min(config.model.embedding_dim, 4),
    )  # fmt: skip
    return dataclasses.replace(
        config, model=model, steps=12, static_fraction=0.25, threads=2, init_num_pts=60, max_gaussians=90,
        refine_start=4, refine_every=4, sh_degree_interval=4,
    )  # fmt: skip


@pytest.mark.parametrize("name", PRESETS)
def test_each_preset_trains_and_exports(name: str, data: Path, tmp_path: Path) -> None:
    trainer = Trainer(shrunk(preset(name)), load_scene(data))
    before = {n: p.detach().clone() for n, p in trainer.model.deformation.named_parameters()}
    results = [trainer.step() for _ in range(12)]
    assert results[-1].skipped == 0
    after = dict(trainer.model.deformation.named_parameters())
    still = {n for n in before if torch.equal(before[n], after[n])}
    assert not still, "every part of the deformation learns"
    trainer.save_model(tmp_path / "model.pt")
    exported = export_scene(tmp_path / "model.pt", tmp_path / "scene.onnx", times=5)
    assert exported.metadata.delta_space == preset(name).model.delta_space
    drawn, posed = DeformationSession(exported.path).gaussians(0.37), trainer.eval_model.pose(0.37)
    for field in ("means", "quats", "scales"):
        want = getattr(posed, field).detach().numpy()
        np.testing.assert_allclose(getattr(drawn, field), want, rtol=0, atol=tolerance("export.relative"))
