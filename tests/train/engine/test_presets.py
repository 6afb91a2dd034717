"""Settings and presets: invalid values, published sizes, and training of each preset."""

import dataclasses
import json
import pickle
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.fit import parse_fit
from msdgs_train.datasets import load_scene
from msdgs_train.engine.config import TrainConfig, check_resumable
from msdgs_train.engine.schedule import Schedule
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.gaussians.modulation import EMBEDDINGS
from msdgs_train.settings import SystemConfig
from msdgs_train.supports.base import SupportConfig
from msdgs_train.supports.gaussians import GaussiansConfig
from msdgs_train.supports.nodes import NodesConfig
from msdgs_train.supports.scgs import SCGSConfig
from msdgs_train.systems import registry
from msdgs_train.systems.registry import DEFAULT, preset, register_system, systems
from tests.support.models import export_scene
from tests.support.processes import ROOT
from tests.support.tolerances import tolerance
from tests.support.training_scene import GAUSSIANS, shrunk, small_config, splatting, trained

pytestmark = pytest.mark.slow


def sizes(config: ModelConfig, count: int = 3) -> tuple[int, int]:
    """Numbers of parameters of the deformation, and of the modulation with its embeddings."""
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
        ("sc-gs", 522_280 + 1_028),
        ("grid4d", 13_224_948),
        ("grid4d-small", 1_210_094),
        ("static", 0),
    ],
)
def test_published_numbers_of_parameters(name: str, deformation: int) -> None:
    assert sizes(preset(name).model)[0] == deformation


def test_published_schedules() -> None:
    for name in ("deformgs", "4dgs"):
        schedule = Schedule.from_config(preset(name))
        assert schedule.sh_degree_interval == 1_000
        assert (schedule.refine_start, schedule.refine_every, schedule.refine_stop) == (500, 100, 15_000)
        assert (schedule.static_steps, schedule.reset_every) == (3_000, 3_000)


def test_published_schedule_of_grid4d() -> None:
    config = preset("grid4d")
    schedule = Schedule.from_config(config)
    assert (schedule.num_steps, schedule.static_steps, schedule.full_window_step) == (50_000, 2_999, 0)
    assert (schedule.refine_start, schedule.refine_every, schedule.refine_stop) == (501, 100, 14_999)
    assert (schedule.sh_degree_interval, schedule.reset_every) == (1_000, 3_000)
    (layer,) = DynamicGaussians(config.model, CanonicalGaussians.random_in_cube(3, 1.0, 3, 0)).deformation
    for group, final in zip(layer.parameter_groups(), (8e-5, 1.6e-6), strict=True):
        assert group.lr.at(45_000, 50_000, 0) == pytest.approx(final)
        assert group.lr.at(44_000, 50_000, 0) > final


def test_table_4() -> None:
    """Its rows, in millions; N follows from the modulation's published size."""
    paper = [preset(f"msdgs-{kind}").model for kind in ("mlp", "plane")]
    two = [dataclasses.replace(config, layers=config.layers[:2]) for config in paper]
    assert [in_millions(sizes(config)[0]) for config in two] == [0.47, 0.26]
    assert in_millions(sizes(preset("deformgs").model)[0]) == 0.52
    with_all_heads = dataclasses.replace(preset("4dgs").model, opacity_head=True, sh_head=True)
    assert in_millions(sizes(with_all_heads)[0]) == 3.38
    assert [in_millions(sizes(two[i], n)[1]) for i, n in ((0, 106_500), (1, 52_800))] == [3.41, 1.69]


PUBLISHED = ("Deformable-3D-Gaussians", "4DGaussians", "HexPlane", "TiNeuVox")


def test_the_engine_names_no_system() -> None:
    """Neither registered nor published ones; `static` is a phase, too."""
    names = {*systems(), *PUBLISHED} - {"static"}
    for file in (ROOT / "msdgs_train" / "engine").glob("*.py"):
        text = file.read_text(encoding="utf-8").lower()
        assert not [name for name in names if name.lower() in text], file.name


def test_settings_without_a_system_train_gaussians(data: Path) -> None:
    config = small_config()
    assert config.run.system == ""
    splatting(Trainer(config, load_scene(data)))


def test_a_config_names_its_system() -> None:
    assert [entry.config.run.system for entry in systems().values()] == list(systems())
    assert next(iter(systems())) == DEFAULT


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(InvalidInput, match=r"msdgs-nodes.*4dgs.*msdgs-mlp.*--plugin.*nerf"):
        preset("nerf")


@pytest.mark.parametrize("name", GAUSSIANS)
def test_each_preset_trains(name: str, data: Path) -> None:
    """The deformation is unchanged in the static phase, and all of its parts are trained afterwards."""
    trainer = Trainer(shrunk(preset(name)), load_scene(data))
    deformation = splatting(trainer).model.deformation
    before = {n: p.detach().clone() for n, p in deformation.named_parameters()}
    for step in range(12):
        assert trainer.step().skipped == 0
        unchanged = {n for n, p in deformation.named_parameters() if torch.equal(before[n], p)}
        assert trainer.schedule.deforms(step) or unchanged == before.keys()
    assert not unchanged
    for advance in (0, 1):  # a slow schedule, as of --minutes
        trainer.step(advance)
    assert trainer.step_count == step + 2


@pytest.mark.parametrize("support", [GaussiansConfig(), NodesConfig(num_nodes=5), SCGSConfig(num_nodes=5)])
def test_without_layers_any_support_trains_a_static_scene(support: SupportConfig, data: Path, tmp_path: Path) -> None:
    config = small_config(steps=9, model=ModelConfig(sh_degree=1, support=support, layers=()), ema_fraction=0.1)
    trainer = trained(config, load_scene(data), 9)
    trainer.system.save(tmp_path / "model.pt", 9)
    (first, *_) = trainer.evaluate("test")
    assert torch.equal(load_model(tmp_path / "model.pt").render(first.frame.camera, 0.9).clamp(0, 1), first.rgb)
    exported = export_scene(tmp_path / "model.pt", tmp_path / "scene.onnx", times=2)
    for name in ("means", "quats", "scales"):
        assert exported.measured_error[name] <= tolerance("export.relative")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("steps", 0), ("seed", -1), ("seed", 2**31),
        ("init_gray", 1.5), ("time_noise", -1.0), ("time_noise_fraction", 2.0),
        ("ssim_lambda", 1.5), ("ssim_lambda", float("nan")), ("means_lr_init", 0.0),
        ("adam_beta2", 1.0), ("adam_eps", 0.0), ("gradient_clip", 0.0), ("means_lr_until_fraction", 0.0),
        ("mse_fraction", 1.1), ("alpha_weight", -1.0), ("prune_unseen_passes", -1.0),
        ("prune_subpixel", -0.1),
        ("init_min_views", 1.1), ("ema_fraction", -0.1),
        ("max_gaussians", 10), ("background", "green"), ("minutes", 0.0), ("refine_every_fraction", -0.1),
        ("quats_lr", float("inf")), ("size", 0), ("density_strategy", "none"), ("noise_lr", -1.0),
        ("time_from", "name"),
        *(("eps2d_init", eps2d) for eps2d in (-0.1, float("nan"), float("inf"))),
        *(("window_start_width", start) for start in (0.5, -0.1, float("nan"), "0.1", True)),
    ],
)  # fmt: skip
def test_settings_out_of_range_are_named(field: str, value: object) -> None:
    with pytest.raises(InvalidInput, match=f"`config.{field}`"):
        TrainConfig().updated(**{field: value})


@dataclass(frozen=True)
class OwnConfig(SystemConfig):
    stage_steps: tuple[int, ...] = (1, 2)
    elastic_weight: float = 0.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "stage_steps", tuple(self.stage_steps))
        self.require_weights("elastic_weight")


def test_a_system_may_have_settings_of_its_own(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    register_system("own", "with settings of its own", small_config(own=OwnConfig(), steps=1))
    config = preset("own").updated(elastic_weight=0.25, stage_steps=[3])
    assert config.own == OwnConfig((3,), 0.25)
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert pickle.loads(pickle.dumps(config)) == config
    with pytest.raises(InvalidInput, match=r"`config\.elastic_weight`"):
        config.updated(elastic_weight=-1.0)
    with pytest.raises(InvalidInput, match=r"`config\.elastic_weight` must be 0\.25, as when the run was started"):
        check_resumable(config, config.updated(elastic_weight=0.5))
    with pytest.raises(SystemExit):
        parse_fit(["--preset", "own", "--help"])
    assert "--elastic-weight" in capsys.readouterr().out
    fit = parse_fit([str(data), str(tmp_path / "run"), "--preset", "own", "--elastic-weight", "0.75", "--eval-every=0"])
    assert fit.execute() == 0
    assert parse_fit([str(data), str(tmp_path / "run"), "--resume"]).config.own == OwnConfig(elastic_weight=0.75)


def test_own_settings_have_names_of_their_own() -> None:
    @dataclass(frozen=True)
    class Taken(SystemConfig):
        steps: int = 5

    with pytest.raises(InvalidInput, match=r"`config\.steps` must be of another name: the group run has it, got Taken"):
        register_system("taken", "", small_config(own=Taken()))


def test_settings_survive_json_and_unknown_ones_are_refused() -> None:
    config = small_config(background="random", size=24, window_start_width=0.1)
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    for strange in ({"color": 1}, {"run": {"color": 1}}):
        with pytest.raises(InvalidInput, match="`color`"):
            TrainConfig.from_dict(strange)
    with pytest.raises(InvalidInput, match="`color`"):
        config.updated(color=1)
