"""SC-GS on a tiny scene: both stages, resumed, saved, exported and rendered by the service."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import load_scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.schedule import Schedule, require_same_phase
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.supports.scgs import SCGSConfig, SCGSSupport
from msdgs_train.systems.registry import preset
from msdgs_train.systems.scgs.system import SCGS
from tests.support.models import export_scene
from tests.support.tolerances import assert_close, tolerance
from tests.support.training_scene import MLP, assert_same_bits, trained

STAGE, CHOICE, STEPS, NODES = 10, 6, 24, 12


def small_config(**changes: object) -> TrainConfig:
    """Ten steps for nodes, which are chosen after six, then fourteen."""
    published = preset("sc-gs")
    model = replace(published.model, sh_degree=1, support=SCGSConfig(num_nodes=NODES), layers=(MLP,))
    values = {
        "model": model, "steps": STEPS, "threads": 1, "init_num_pts": 60, "max_gaussians": 90, "checkpoint_every": 0,
        "node_stage_fraction": STAGE / STEPS, "node_choice_fraction": CHOICE / STAGE,
        "node_refine_every_fraction": 2 / STAGE, "refine_start_fraction": 0.1, "refine_every_fraction": 3 / 14,
        "refine_stop_fraction": 0.8, "densify_nodes_fraction": 0.5, "grow_grad2d": 1e-5, "log_every": 1,
    }  # fmt: skip
    return published.updated(**{**values, **changes})


def system_of(trainer: Trainer) -> SCGS:
    assert isinstance(trainer.system, SCGS)
    return trainer.system


def test_the_preset_has_the_published_number_of_parameters():
    model = preset("sc-gs").model
    network = model.layers[0].build(None, model.heads, model.support.num_nodes)  # pyright: ignore
    parameters = [p for part in (network, model.support.build()) for p in part.parameters()]
    published, fixed = (sum(p.numel() for p in parameters if p.requires_grad in which) for which in ((0, 1), (0,)))
    per_gaussian = sum(attribute.columns for attribute in model.attributes().values())
    assert (published, fixed, per_gaussian) == (529_964, 3 * 512, 8)


def test_nodes_are_chosen_among_gaussians_of_one_size_which_new_ones_follow(data: Path):
    trainer = trained(small_config(), load_scene(data), CHOICE)
    system = system_of(trainer)
    scales = system.model.pose(0.5).scales
    assert torch.equal(scales, scales[:1, :1].expand_as(scales))
    assert len(system.model.gaussians) > NODES, "density control took no part"
    trainer.step()
    assert not system.is_second
    assert len(system.model.gaussians) == NODES
    for _ in range(CHOICE + 1, STAGE):
        trainer.step()
    reached = system.model.gaussians.means.detach().clone()
    trainer.step()
    assert system.is_second
    assert len(system.model.gaussians) == 60
    assert torch.equal(system.support.nodes, reached)
    rates = {group["name"]: group["lr"] for group in trainer.optimizer.param_groups}
    assert rates["layers.0.network"] == MLP.lr_init  # from the start again
    states = [
        trainer.optimizer.state[p] for p in (system.model.gaussians.means, *system.model.deformation.parameters())
    ]
    assert [int(state["step"]) for state in states[:2]] == [
        1,
        STAGE + 1 - 3,
    ]  # three steps are before motion is trained
    before = {name: value.clone() for name, value in system.model.state_dict().items()}
    for _ in range(STAGE + 1, STEPS):
        trainer.step()
    after = system.model.state_dict()
    for name in ("support.node_hypers", "support.log_radii", "deformation.layers.0.heads.weight"):
        assert before[name].shape != after[name].shape or not torch.equal(before[name], after[name]), name


@pytest.mark.parametrize("stop", [4, CHOICE + 1, STAGE, 19])
def test_resuming_changes_no_bit(data: Path, tmp_path: Path, stop: int):
    scene = load_scene(data)
    trainer = trained(small_config(), scene, stop)
    trainer.save_checkpoint(tmp_path / "checkpoint.pt", 0.0)
    resumed = Trainer(trainer.config, scene)
    resumed.load_checkpoint(tmp_path / "checkpoint.pt")
    torch.manual_seed(stop)
    for each in (trainer, resumed):
        for _ in range(3):
            each.step()
        each.save_checkpoint(tmp_path / "after.pt", 0.0)
    assert_same_bits(trainer.system.model.state_dict(), resumed.system.model.state_dict())
    moments = [
        {f"{name}.{moment}": trainer_.optimizer.state[p][moment] for name, p in trainer_.system.model.named_parameters()
         if p in trainer_.optimizer.state for moment in ("exp_avg", "exp_avg_sq")}
        for trainer_ in (trainer, resumed)
    ]  # fmt: skip
    assert_same_bits(*moments)


@pytest.mark.parametrize(("stop", "steps"), [(9, 20), (6, 30), (CHOICE, 20), (12, 30), (18, 30)])
def test_a_run_is_not_resumed_with_steps_that_move_it_past_a_stage(data: Path, stop: int, steps: int):
    trainer = Trainer(small_config(), load_scene(data))
    other, milestones = Schedule.from_config(small_config(steps=steps)), trainer.system.milestones
    assert milestones(STEPS) == [CHOICE, STAGE, STAGE + 1, STAGE + 7]
    require_same_phase(trainer.schedule, other, range(4, 5), milestones)
    with pytest.raises(InvalidInput, match=r"config\.steps"):
        require_same_phase(trainer.schedule, other, range(stop, stop + 1), milestones)


def test_a_trained_model_is_evaluated_saved_exported_and_rendered(data: Path, tmp_path: Path):
    trainer = trained(small_config(), load_scene(data), STEPS)
    (first, *_) = trainer.evaluate("test")
    trainer.system.save(tmp_path / "model.pt", STEPS)
    loaded = load_model(tmp_path / "model.pt")
    support = loaded.model.support
    assert isinstance(support, SCGSSupport)
    assert support.config.num_nodes == len(support.nodes)
    again = loaded.render(first.frame.camera, first.frame.t)
    assert torch.equal(again.clamp(0, 1), first.rgb)
    exported = export_scene(tmp_path / "model.pt", tmp_path / "scene.onnx", times=4)
    for name in ("means", "quats", "scales"):
        assert exported.measured_error[name] <= tolerance("export.relative")
    image = Renderer().render(DeformationSession(exported.path), first.frame.camera, first.frame.t)
    assert_close(image.rgb, first.rgb.numpy(), "scgs.rendered")


def test_nodes_that_no_gaussian_follows_are_removed_and_busy_ones_divided(data: Path):
    trainer = trained(small_config(), load_scene(data), STAGE + 1)
    system = system_of(trainer)
    rows = system.support.rows()
    far = rows._replace(nodes=torch.cat([rows.nodes, torch.full((1, 3), 50.0)]))
    far = far._replace(**{n: torch.cat([v, v[:1]]) for n, v in rows._asdict().items() if n != "nodes"})
    before = system.support.parameter_groups()[0].params
    system.support.set_rows(far)
    system._replace_nodes(trainer.optimizer, before, None)
    trainer.step()
    system.density.gradients = torch.ones(system.size)  # pyright: ignore
    system.density.counts = torch.ones(system.size)  # pyright: ignore
    system._densify_nodes(trainer.optimizer)
    assert float(system.support.nodes.max()) < 50
    assert len(system.support.nodes) > len(rows.nodes)
    trainer.step()


def test_other_supports_are_refused(data: Path):
    with pytest.raises(InvalidInput, match=r"model\.support.*scgs.*gaussians"):
        Trainer(preset("deformgs").updated(system="sc-gs", own=preset("sc-gs").own), load_scene(data))


def test_another_restart_than_that_of_its_stages_is_refused(data: Path):
    with pytest.raises(InvalidInput, match=r"config\.restart_at_motion.*stage"):
        Trainer(small_config(restart_at_motion=True), load_scene(data))
