"""Exports of a model that isn't at the origin of the user's world: scene file, reports and other programs' files."""

import dataclasses
import importlib
import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from msdgs_export.bake import bake
from msdgs_export.exporters.command import convert
from msdgs_export.exporters.gltf import read_gltf
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.options import ConvertOptions
from msdgs_export.plans.registry import build
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.scene.similarity import Similarity
from msdgs_train.gaussians.scene_info import SceneInfo
from tests.support.models import SCENE, random_model
from tests.support.tolerances import assert_close, tolerance

PLACE = Similarity(100.0, (500_000.0, 5_200_000.0, 800.0))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    info = dataclasses.replace(SCENE, scene_to_world=PLACE.to_plain())
    return written(tmp_path_factory.mktemp("placed") / "scene.onnx", info)


def written(file: Path, info: SceneInfo) -> Path:
    baked = bake(random_model(60, noise=0.02, layers=()), info, "0" * 64)
    file.write_bytes(build("network", baked).SerializeToString())
    return file


def converted(scene: Path, out: Path) -> str:
    """Convert; return what the command prints."""
    shown = Console(file=StringIO(), width=300)
    convert(ConvertOptions(scene, out, frames=None if out.suffix else 2), shown)
    assert isinstance(shown.file, StringIO)
    return shown.file.getvalue()


def test_the_file_has_the_models_frame_and_its_place(scene: Path):
    metadata = DeformationSession(scene).scene.metadata
    assert metadata.scene_to_world == PLACE
    assert_close(metadata.cameras[0].camera.position, np.array([0.0, 0.0, -4.0]), "placed")
    assert_close(metadata.in_world().cameras[0].camera.position, PLACE.to_world(np.array([0, 0, -4])), "placed")


@pytest.mark.parametrize(
    ("name", "beside", "left"),
    [
        ("a.ply", "a.ply.placement.json", Similarity(1.0, PLACE.offset)),
        ("a.spz", "a.spz.placement.json", PLACE),
        ("frames", "frames/placement.json", Similarity(1.0, PLACE.offset)),
        ("a.visionary.onnx", "a.visionary.onnx.placement.json", PLACE),
    ],
)
def test_a_format_without_transforms_has_it_beside_its_file(
    scene: Path, tmp_path: Path, name: str, beside: str, left: Similarity
):
    assert beside in converted(scene, tmp_path / name).replace(str(tmp_path) + "/", "")
    assert Similarity.from_plain(json.loads((tmp_path / beside).read_text())) == left
    if name == "a.ply":
        own, got = DeformationSession(scene).gaussians(0.0), read_splats(tmp_path / name).gaussians
        scaled = own.scaled(PLACE.scale)
        limit = tolerance("splat_values") * float(np.abs(scaled.means).max())
        assert np.abs(got.means - scaled.means).max() <= limit
        assert np.abs(got.scales - scaled.scales).max() <= limit
        assert np.abs(got.means).max() < 1e3


@pytest.mark.parametrize("name", ["a.ply", "a.spz"])
def test_no_place_of_an_earlier_file_is_left(scene: Path, tmp_path: Path, name: str):
    out, place = tmp_path / name, tmp_path / f"{name}.placement.json"
    converted(scene, out)
    assert place.exists()
    converted(written(tmp_path / "at_origin.onnx", SCENE), out)
    assert not place.exists()


def test_gltf_has_it_in_its_node(scene: Path, tmp_path: Path):
    out = tmp_path / "a.glb"
    assert "(500000, 5200000, 800) of its positions x is in the transform of its node" in converted(scene, out)
    contents = out.read_bytes()
    node = json.loads(contents[20 : 20 + int.from_bytes(contents[12:16], "little")])["nodes"][0]
    point = read_gltf(out).means[0].astype(np.float64)
    shown = Rotation.from_quat(node["rotation"]).apply(point * (1, -1, -1)) + node["translation"]
    upright = Rotation.from_quat(node["rotation"]).apply((point + PLACE.offset) * (1, -1, -1))
    assert_close(shown, upright, "pixel.placed")
    up = framing(DeformationSession(scene).scene.metadata).up
    assert shown[1] == pytest.approx(float(up @ (point + PLACE.offset)))


def test_openusd_has_it_in_its_prim(scene: Path, tmp_path: Path):
    usd, geom = (importlib.import_module(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    converted(scene, tmp_path / "a.usda")
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetDefaultPrim()
    matrix = np.array(geom.Xformable(prim).GetLocalTransformation())
    point = np.array(prim.GetAttribute("positions").Get(0)[0], np.float64)
    shown = np.append(point, 1) @ matrix
    up = framing(DeformationSession(scene).scene.metadata).up
    assert shown[1] == pytest.approx(float(up @ (point * (1, -1, -1) + PLACE.offset)))


def test_a_scene_at_the_origin_needs_nothing(tmp_path: Path):
    file = tmp_path / "scene.onnx"
    file.write_bytes(build("network", bake(random_model(20, layers=()), SCENE, "0" * 64)).SerializeToString())
    assert "positions" not in converted(file, tmp_path / "a.ply")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "scene.onnx"]
