"""Training on a GPU, with gsplat as the renderer; skipped where torch finds none."""

from pathlib import Path
from types import SimpleNamespace

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


def drawn(device: str, weights: Tensor) -> dict[str, np.ndarray]:
    """Image, alpha, and gradients of a weighted sum of both."""
    arrays = {name: getattr(GAUSSIANS, name) for name in FIELDS}
    tensors = {name: torch.tensor(array, device=device, requires_grad=True) for name, array in arrays.items()}
    parameters = PosedGaussians(**tensors)
    posed = parameters._replace(quats=torch.nn.functional.normalize(parameters.quats, dim=1))
    rgb, alpha, info = rasterize(*posed, CAMERA, torch.tensor([0.2, 0.6, 0.9], device=device))
    values = torch.cat([rgb, alpha[:, :, None]], dim=2)
    grads = torch.autograd.grad((values * weights.to(device)).sum(), parameters)
    assert info.means2d_grads is not None
    named = dict(zip(FIELDS, grads, strict=True))
    named |= {"means2d": info.means2d_grads, "rgb": rgb, "alpha": alpha}
    return {name: tensor.detach().cpu().numpy() for name, tensor in named.items()}


@needs_gpu
def test_gpu_and_cpu_draw_the_same_image_and_gradients() -> None:
    weights = torch.randn(CAMERA.height, CAMERA.width, 4, generator=torch.Generator().manual_seed(0))
    on_cpu, on_gpu = drawn("cpu", weights), drawn("cuda", weights)
    for name in ("rgb", "alpha"):
        assert_close(on_gpu.pop(name), on_cpu.pop(name), "cuda.pixel")
    for name, expected in on_cpu.items():
        error = np.abs(on_gpu[name] - expected).max() / np.abs(expected).max()
        assert error < tolerance("cuda.gradient"), name


CONFIGS = {name: small_config(model=model, alpha_weight=0.1) for name, model in MODELS.items()}
CONFIGS |= {f"{name}, mcmc": config.updated(density_strategy="mcmc") for name, config in CONFIGS.items()}
CONFIGS["default"] = shrunk(preset(DEFAULT)).updated(batch_size=2, ema_fraction=0.25, checkpoint_every=0)


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
