"""The steps of a GPU on a CPU: torch's operations, results that stay on the device, resident images."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.datasets.cache import ImageCache
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.masked_adam import MaskedAdam
from msdgs_train.engine.meters import (
    MAX_SKIPPED_IN_A_ROW,
    SMOOTHING,
    DeviceMeter,
    Observed,
    StepMeter,
    TrainingDiverged,
)
from msdgs_train.engine.run import fit
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers import arrays
from msdgs_train.systems.registry import preset, systems
from msdgs_train.systems.scgs import losses
from msdgs_train.systems.scgs.settings import SCGSSettings
from msdgs_train.systems.targets import Target, TrainingImages
from tests.support.tolerances import assert_close, tolerance
from tests.support.training_scene import (
    MODELS,
    SIZE,
    VOLUMES,
    StopAfter,
    shrunk,
    small_config,
    splatting,
    trained,
    training_image,
)
from tests.support.without_kernels import NoReads, switch_kernels_off

ALL_PARTS = {
    "nodes": {"model": MODELS["mixed on nodes"], "alpha_weight": 0.1, "prune_unseen_passes": 1.0, "pose_opt": True},
    "gaussians": {
        "model": dataclasses.replace(MODELS["mixed on gaussians"], scale_space="linear"),
        "absolute_gradients": True,
        "batch_size": 2,
        "mse_fraction": 0.5,
    },
    "mcmc": {"model": MODELS["mlp"], "density_strategy": "mcmc"},
}
IMAGE_BYTES = 4 * SIZE * SIZE
MARCHED = (
    ("volumes/samples.py", "nonzero"),
    ("volumes/march.py", "nonzero"),
    ("volumes/march.py", "_local_scalar_dense"),
)
TINEUVOX = (*MARCHED, ("volumes/tineuvox.py", "_local_scalar_dense"))
ROTATIONS = (("scgs/losses.py", "_linalg_svd"),)
READ = {
    "hexplane-slim": (*MARCHED, ("volumes/hexplane.py", "nonzero")), "tineuvox-s": TINEUVOX, "tineuvox-b": TINEUVOX,
    "sc-gs": ROTATIONS, "sc-gs-small": ROTATIONS,
}  # fmt: skip
"""Files and operations that make the CPU wait in a step of these presets, as docs/training.md says."""
STEPS, EARLY, LATE = 40, 5, 25
"""Of a run of a preset, and before a step that is looked at: in its first stage or without motion, and after that."""


def config_of(name: str, **changes: object) -> TrainConfig:
    return small_config(**{**ALL_PARTS[name], "static_fraction": 0.0, "window_full_fraction": 0.0, **changes})


def after_a_step(config: TrainConfig, scene: SceneData) -> Trainer:
    """With layers that deform at once."""
    trainer, generator = Trainer(config, scene), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in splatting(trainer).model.deformation.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    trainer.step()
    return trainer


def assert_same_gradients(got: Trainer, wanted: Trainer) -> None:
    """Of the last step, with what density control accumulates."""
    found = []
    for trainer in (got, wanted):
        named = {n: p.grad for n, p in trainer.system.model.named_parameters() if p.grad is not None}
        found.append(named | dict(enumerate(trainer.system.state().get("density", ()))))
    assert len(found[1]) > 5
    assert found[0].keys() == found[1].keys()
    largest = max(float(tensor.abs().max()) for tensor in found[1].values())
    for name, other in found[1].items():  # those of quaternions of round Gaussians are 0 but for rounding
        size = max(float(other.abs().max()), 1e-6 * largest)
        assert float((found[0][name] - other).abs().max()) <= tolerance("gradient.float32") * size, name


@pytest.mark.parametrize("name", ALL_PARTS)
def test_gradients_are_those_of_the_kernels(name: str, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also the loss, and what density control accumulates."""
    scene, config = load_scene(data), config_of(name)
    wanted = after_a_step(config, scene)
    switch_kernels_off(monkeypatch)
    got = after_a_step(config, scene)
    assert_same_gradients(got, wanted)
    results = [trainer._result() for trainer in (got, wanted)]
    assert_close(results[0].loss, results[1].loss, "float32.relative")
    assert results[0][3:] == results[1][3:]


def small_preset(name: str) -> TrainConfig:
    """A preset without density control, whose motion or second stage begins after 10 steps."""
    config = preset(name)
    values: dict[str, Any] = {"steps": STEPS, "threads": 1, "log_every": 1000}
    if name in VOLUMES:
        return config.updated(rays=64, **values, **VOLUMES[name])
    config = shrunk(config)
    values |= {"refine_every_fraction": 0.0, "reset_every_fraction": 0.0}
    if isinstance(config.own, SCGSSettings):
        values |= {"node_stage_fraction": 10 / STEPS, "node_choice_fraction": 1.0}
        values |= {"node_warm_up_fraction": 0.1, "warm_up_fraction": 0.1}
        values |= {"node_refine_every_fraction": 0.0, "node_reset_every_fraction": 0.0}
    elif config.model.layers:
        values |= {"static_fraction": 10 / STEPS}
    if config.curriculum.window_full_fraction:  # the window grows in each step
        values |= {"window_full_fraction": 1.0}
    model = dataclasses.replace(config.model, alpha_max=GSPLAT.alpha_max)
    return config.updated(model=model, **values)


def checkpoint_of(config: TrainConfig, scene: SceneData, path: Path, steps: int) -> Path:
    """After so many steps with kernels, with layers that deform at once."""
    trainer, generator = trained(config, scene, steps), torch.Generator().manual_seed(0)
    model = trainer.system.model
    if isinstance(model, DynamicGaussians):
        with torch.no_grad():
            for parameter in model.deformation.parameters():
                parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    trainer.save_checkpoint(path, 0.0)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("steps", [EARLY, LATE])
@pytest.mark.parametrize("name", systems())
def test_a_step_of_each_preset_is_that_of_the_kernels(
    name: str, steps: int, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And reads nothing from the device, but what `READ` names."""
    monkeypatch.setattr(losses, "RIGID_SAMPLES", 8)  # of 20 nodes
    config, scene = small_preset(name), load_scene(data)
    checkpoint = checkpoint_of(config, scene, tmp_path / "checkpoint.pt", steps)
    trainers = []
    for has_kernels in (True, False):
        if not has_kernels:
            switch_kernels_off(monkeypatch)
        trainer = Trainer(config, scene)
        trainer.load_checkpoint(checkpoint)
        trainer.step()
        trainers.append(trainer)
    wanted, got = trainers
    assert_same_gradients(got, wanted)
    frame = scene.splits["train"][1]  # the order of the images is on the CPU in any case
    monkeypatch.setattr(got._curriculum, "next", lambda *_: frame)
    got.step()
    with NoReads(*READ.get(name, ())):
        for _ in range(2):
            got.step()


@pytest.mark.parametrize("name", ALL_PARTS)
def test_a_step_reads_nothing_from_the_device(name: str, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between rounds of density control and reads of the results."""
    switch_kernels_off(monkeypatch)
    trainer = Trainer(config_of(name, refine_every_fraction=0.0, log_every=1000, steps=60), load_scene(data))
    frame = trainer.scene.splits["train"][1]  # the order of the images is on the CPU in any case
    monkeypatch.setattr(trainer._curriculum, "next", lambda *_: frame)
    trainer.step()
    with NoReads():
        for _ in range(3):
            result = trainer.step()
    assert math.isnan(result.loss)
    for read in (lambda: bool(torch.ones(())), lambda: torch.ones(3)[torch.ones(3, dtype=torch.bool)]):
        with pytest.raises(AssertionError, match="wait for the device"), NoReads():
            read()


def test_a_run_resumes_and_reports(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    switch_kernels_off(monkeypatch)
    config = config_of("gaussians", gpu_precision="bf16", log_every=6)
    stopped = fit(config, data, tmp_path / "run", observer=StopAfter(9))
    assert stopped.status == "interrupted"
    finished = fit(config.updated(gpu_precision="tf32"), data, tmp_path / "run", resume=True)
    assert (finished.step, finished.metrics["test"].psnr > 8) == (24, True)
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert sum('"kind": "train"' in line and "NaN" not in line for line in lines) == 4


def test_meters_agree_and_broken_steps_change_nothing() -> None:
    """Of fused Adam, which then leaves moments and its count of steps as they are."""
    generator = torch.Generator().manual_seed(0)
    models = [nn.Linear(3, 2), nn.Linear(3, 2)]
    models[1].load_state_dict(models[0].state_dict())
    meters, optimizers = (
        (StepMeter(), DeviceMeter("cpu")),
        [torch.optim.Adam(m.parameters(), fused=True) for m in models],
    )
    kept = []
    for step in range(1, 12):
        broken = step in (3, 4, 9)
        grads = [torch.randn(p.shape, generator=generator) for p in models[0].parameters()]
        losses = torch.rand(2, generator=generator)
        if broken:
            (grads[0] if step == 3 else losses)[0] = torch.nan
        else:
            kept.append(float(losses.double().mean()))
        for model, meter, optimizer in zip(models, meters, optimizers, strict=True):
            for parameter, grad in zip(model.parameters(), grads, strict=True):
                parameter.grad = grad.clone()
            observed = Observed(list(losses), list(losses / 2))
            if meter.accept(step, observed, grads, optimizer):
                optimizer.step()
            meter.read()
        counts = [(meter.skipped, meter.skipped_in_a_row) for meter in meters]
        assert counts[0] == counts[1] == (sum(k <= step for k in (3, 4, 9)), {3: 1, 4: 2, 9: 1}.get(step, 0))
        assert_close(np.array(meters[1].averages), np.array(meters[0].averages), "float32.relative")
    weights = SMOOTHING ** np.arange(len(kept))[::-1]
    average = np.average(kept, weights=weights)
    assert_close(np.array(meters[0].averages), np.array([average, average / 2]), "float32.relative")
    for one, other in zip(*(o.state_dict()["state"].values() for o in optimizers), strict=True):
        assert all(torch.equal(one[name], other[name]) for name in one)
    assert all(map(torch.equal, models[0].parameters(), models[1].parameters()))


@pytest.mark.parametrize("broken", [(), (1, 4)], ids=["sound", "broken"])
def test_entries_without_a_gradient_stay_on_a_device_too(
    broken: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the bits that they had; the others become what they become on a CPU, where broken steps aren't taken."""
    numbers = torch.Generator().manual_seed(0)
    start, optimizers = torch.randn(6, 7, generator=numbers), []
    parameters = [nn.Parameter(start.clone()) for _ in range(2)]
    grads = [torch.randn(6, 7, generator=numbers) * (torch.rand(6, 7, generator=numbers) < 0.4) for _ in range(7)]
    for has_kernels, parameter in zip((True, False), parameters, strict=True):
        monkeypatch.setattr(arrays, "has_kernels", lambda tensor, has_kernels=has_kernels: has_kernels)
        optimizer = MaskedAdam([{"params": [parameter], "lr": 0.1, "skips_zero": True}], fused=True)
        for step, grad in enumerate(grads, start=1):
            if has_kernels and step in broken:
                continue
            parameter.grad = grad.clone()
            if not has_kernels:
                optimizer.found_inf = torch.tensor(float(step in broken))  # type: ignore[attr-defined]
                parameter.grad[0, 0] = torch.nan if step in broken else grad[0, 0]
            optimizer.step()
        optimizers.append(optimizer)
    want, got = (o.state[p] for o, p in zip(optimizers, parameters, strict=True))
    assert float(got["step"]) == float(want["step"]) == len(grads) - len(broken)
    for one, other in ((parameters[1], parameters[0]), *((got[n], want[n]) for n in ("exp_avg", "exp_avg_sq"))):
        error = float((one - other).detach().abs().max() / other.detach().abs().max())
        assert error <= tolerance("float32.relative")
    still = torch.stack([grad == 0 for step, grad in enumerate(grads, start=1) if step not in broken]).all(dim=0)
    assert still.any()
    assert torch.equal(parameters[1].detach()[still], start[still])


def test_divergence_is_noticed_when_results_are_read() -> None:
    meter, optimizer = DeviceMeter("cpu"), torch.optim.Adam([torch.zeros(1, requires_grad=True)], fused=True)
    broken = Observed([torch.tensor(torch.nan)], [torch.tensor(0.0)])
    for step in range(MAX_SKIPPED_IN_A_ROW):
        meter.read()
        meter.check(step)
        assert meter.accept(step, broken, [torch.zeros(1)], optimizer)
    meter.read()
    assert meter.averages is None
    with pytest.raises(TrainingDiverged, match="up to step 20"):
        meter.check(MAX_SKIPPED_IN_A_ROW)


@pytest.mark.parametrize("free", [0, 3 * IMAGE_BYTES // 2, 100 * IMAGE_BYTES])
def test_images_stay_on_the_device_while_there_is_room(free: int, data: Path) -> None:
    frames = load_scene(data).splits["train"][:3]
    images = TrainingImages(ImageCache(), "cpu", free)
    drawn = [[images.image(frame, is_halved=halved) for frame in frames for halved in (False, True)] for _ in range(2)]
    kept = [one is other for one, other in zip(*drawn, strict=True)]
    assert kept == {0: [False] * 6, 3 * IMAGE_BYTES // 2: [True, True, False, True, False, False]}.get(free, [True] * 6)
    for one, other in zip(*drawn, strict=True):
        assert torch.equal(one.rgba, other.rgba)
        assert one.facts == other.facts
    assert drawn[0][1].rgba.shape == (SIZE // 2, SIZE // 2, 4)


def test_a_target_is_the_same_without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (7, 9, 4), np.uint8)
    image, background = training_image(rgba, rgba[..., 0] > 90), torch.tensor([0.2, 0.5, 0.7])
    wanted = Target.over(image, background)
    monkeypatch.setattr(arrays, "has_kernels", lambda tensor: False)
    got = Target.over(image, background)
    assert_close(got.rgb.numpy(), wanted.rgb.numpy(), "float32.relative")
    assert torch.equal(got.alpha, wanted.alpha)
    assert (got.mask is wanted.mask, got.facts) == (True, wanted.facts)


def test_settings_of_the_gpu_are_checked() -> None:
    with pytest.raises(InvalidInput, match="gpu_precision"):
        small_config(gpu_precision="half")
    with pytest.raises(InvalidInput, match="gpu_image_memory"):
        small_config(gpu_image_memory=-1.0)
