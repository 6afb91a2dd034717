"""Each preset can be exported, and the service poses what the model poses."""

from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_train.datasets import load_scene
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.systems.registry import preset, systems
from tests.support.models import export_scene
from tests.support.tolerances import tolerance
from tests.support.training_scene import shrunk, write_scene


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "scene")


@pytest.mark.parametrize("name", systems())
def test_each_preset_exports(name: str, data: Path, tmp_path: Path) -> None:
    trainer = Trainer(shrunk(preset(name)), load_scene(data))
    for _ in range(12):
        trainer.step()
    trainer.system.save(tmp_path / "model.pt", 12)
    exported = export_scene(tmp_path / "model.pt", tmp_path / "scene.onnx", times=5)
    drawn, posed = DeformationSession(exported.path).gaussians(0.37), load_model(tmp_path / "model.pt").model.pose(0.37)
    for field in ("means", "quats", "scales"):
        want = getattr(posed, field).detach().numpy()
        np.testing.assert_allclose(getattr(drawn, field), want, rtol=0, atol=tolerance("export.relative"))
