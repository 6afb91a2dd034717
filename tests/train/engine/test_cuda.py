"""Training on a GPU, with gsplat as the renderer; skipped where torch finds none."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gsplat
import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import load_scene
from msdgs_train.engine.run import fit
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.model import PosedGaussians
from msdgs_train.rendering import rasterize as rasterize_module
from msdgs_train.rendering.rasterize import rasterize
from msdgs_train.systems.registry import DEFAULT, preset
from msdgs_train.viewer.snapshot import snapshot_of_training
from tests.support.scenes import FIELDS, random_scene
from tests.support.tolerances import assert_close, tolerance
from tests.support.training_scene import MODELS, StopAfter, shrunk, small_config, splatting

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")
GAUSSIANS, CAMERA = random_scene(0, 400, 96, 64)


def drawn(device: str, weights: Tensor, raw_quats: bool) -> dict[str, np.ndarray]:
    """Image, alpha, and gradients of a weighted sum of both."""
    arrays = {name: getattr(GAUSSIANS, name) for name in FIELDS}
    tensors = {name: torch.tensor(array, device=device, requires_grad=True) for name, array in arrays.items()}
    parameters = PosedGaussians(**tensors)
    units = torch.nn.functional.normalize(parameters.quats, dim=1)
    posed = parameters._replace(quats=torch.linspace(0.7, 1.3, len(units), device=device)[:, None] * units)
    rgb, alpha, info = rasterize(
        *(posed if raw_quats else posed._replace(quats=units)),
        CAMERA,
        torch.tensor([0.2, 0.6, 0.9], device=device),
        raw_quats=raw_quats,
    )
    values = torch.cat([rgb, alpha[:, :, None]], dim=2)
    grads = torch.autograd.grad((values * weights.to(device)).sum(), parameters)
    assert info.means2d_grads is not None
    named = dict(zip(FIELDS, grads, strict=True))
    named |= {"means2d": info.means2d_grads, "rgb": rgb, "alpha": alpha}
    return {name: tensor.detach().cpu().numpy() for name, tensor in named.items()}


@needs_gpu
@pytest.mark.parametrize("raw_quats", [False, True], ids=["unit", "raw"])
def test_gpu_and_cpu_draw_the_same_image_and_gradients(raw_quats: bool) -> None:
    weights = torch.randn(CAMERA.height, CAMERA.width, 4, generator=torch.Generator().manual_seed(0))
    on_cpu, on_gpu = drawn("cpu", weights, raw_quats), drawn("cuda", weights, raw_quats)
    for name in ("rgb", "alpha"):
        assert_close(on_gpu.pop(name), on_cpu.pop(name), "cuda.pixel")
    for name, expected in on_cpu.items():
        error = np.abs(on_gpu[name] - expected).max() / np.abs(expected).max()
        assert error < tolerance("cuda.gradient"), name


CONFIGS = {name: small_config(model=model, alpha_weight=0.1) for name, model in MODELS.items()}
CONFIGS |= {f"{name}, mcmc": config.updated(density_strategy="mcmc") for name, config in CONFIGS.items()}
CONFIGS["default"] = shrunk(preset(DEFAULT)).updated(batch_size=2, ema_fraction=0.25, checkpoint_every=0)


@needs_gpu
@pytest.mark.parametrize("precision", ["float32", "tf32", "bf16"])
@pytest.mark.parametrize("name", ["mixed on nodes", "mixed on gaussians"])
def test_a_step_waits_for_gsplat_alone(name: str, precision: str, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """gsplat reads the number of splats in tiles."""
    config = small_config(
        model=MODELS[name], device="cuda", gpu_precision=precision, static_fraction=0.0, refine_every_fraction=0.0,
        log_every=1000, steps=60, alpha_weight=0.1, window_full_fraction=0.0, absolute_gradients=True,
    )  # fmt: skip
    trainer, draw = Trainer(config, load_scene(data)), gsplat.rasterization

    def waiting(*arguments: Any, **options: Any) -> Any:
        torch.cuda.set_sync_debug_mode("default")
        drawn = draw(*arguments, **options)
        torch.cuda.set_sync_debug_mode("error")
        return drawn

    monkeypatch.setattr(gsplat, "rasterization", waiting)
    for _ in range(len(trainer.scene.splits["train"])):  # copies the images
        trainer.step()
    try:
        torch.cuda.set_sync_debug_mode("error")
        trainer.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert np.isfinite(trainer.evaluate("test").__next__().metrics.psnr)


@needs_gpu
@pytest.mark.parametrize("name", MODELS)
def test_gradients_of_a_step_are_those_of_the_cpu(name: str, data: Path) -> None:
    """Of layers, skinning, loss and rendering together."""
    found = []
    for device in ("cpu", "cuda"):
        config = small_config(model=MODELS[name], device=device, static_fraction=0.0, window_full_fraction=0.0)
        trainer = Trainer(config, load_scene(data))
        trainer.step()
        parameters = splatting(trainer).model.named_parameters()
        found.append({key: p.grad.cpu() for key, p in parameters if p.grad is not None})
    largest = max(float(grad.abs().max()) for grad in found[0].values())
    for key, grad in found[0].items():
        size = max(float(grad.abs().max()), 1e-3 * largest)
        assert float((found[1][key] - grad).abs().max()) <= 10 * tolerance("cuda.gradient") * size, key


@needs_gpu
@pytest.mark.slow
@pytest.mark.parametrize("devices", [("cuda", "cpu"), ("cpu", "cuda")], ids=" to ".join)
@pytest.mark.parametrize("name", CONFIGS)
def test_run_goes_on_with_another_device(
    name: str, devices: tuple[str, str], data: Path, tmp_path: Path, no_curve: None
) -> None:
    """And reaches about the PSNR of the same run on the CPU."""
    first, second = (CONFIGS[name].updated(device=device) for device in devices)
    last = second.run.steps
    stopped = fit(first, data, tmp_path / "run", observer=StopAfter(last - 4))
    assert (stopped.status, stopped.step) == ("interrupted", last - 4)
    trainer = Trainer(second, load_scene(data))
    trainer.load_checkpoint(tmp_path / "run" / "checkpoint.pt")
    trainer.step()
    assert {tensor.device.type for tensor in splatting(trainer).model.state_dict().values()} == {devices[1]}
    assert np.isfinite(snapshot_of_training(trainer).draw(CAMERA, 0.5, layers=1)).all()
    finished = fit(second, data, tmp_path / "run", resume=True)
    assert finished.step == last
    on_cpu = fit(CONFIGS[name], data, tmp_path / "on_cpu")
    assert abs(finished.metrics["test"].psnr - on_cpu.metrics["test"].psnr) < tolerance("cuda.psnr")


def test_machine_without_gpu_or_gsplat_is_named(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InvalidInput, match="torch finds no GPU"):
        fit(small_config(device="cuda"), data, tmp_path / "run")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    found = {"gsplat.cuda._backend": SimpleNamespace(_C=None)}
    monkeypatch.setattr(rasterize_module.importlib, "import_module", found.get)
    with pytest.raises(InvalidInput, match="nvcc"):
        fit(small_config(device="cuda"), data, tmp_path / "run")
    monkeypatch.setattr(rasterize_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InvalidInput, match=r"pip install 'msdgs\[cuda\]'"):
        fit(small_config(device="cuda"), data, tmp_path / "run")
    assert not (tmp_path / "run").exists()
