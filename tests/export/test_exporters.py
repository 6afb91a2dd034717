"""Files for other viewers hold the scene when read back, and keep the rules of their format."""

import json
import math
import os
import struct
from io import StringIO
from pathlib import Path

import numpy as np
import onnx
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from msdgs_export.exporters import gltf
from msdgs_export.exporters.command import LOSSLESS, LOSSY, convert
from msdgs_export.exporters.gltf import EXTENSION, read_gltf, write_gltf
from msdgs_export.exporters.ply import write_ply
from msdgs_export.exporters.round_trip import ConversionFailed, visionary_of
from msdgs_export.exporters.usd import read_usd
from msdgs_export.importers.sequence import Frames, read_sequence, sequence_scene
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.options import ConvertOptions
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging.image import srgb_to_linear
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_serve.scene.spherical_harmonics import SH_C0
from msdgs_serve.writing import WriteFailed
from msdgs_train.gaussians.model_file import SceneInfo
from tests.support.conversions import QUIET, run, scene_file
from tests.support.file_sizes import largest_file
from tests.support.models import SCENE
from tests.support.splat_files import inria_columns, ply_bytes, some_gaussians
from tests.support.tolerances import tolerance


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_holds_one_time(tmp_path: Path, degree: int):
    scene = scene_file(tmp_path, sh_degree=degree)
    run(scene, tmp_path / "a.ply", t=0.4)
    expected, got = DeformationSession(scene).gaussians(0.4), read_splats(tmp_path / "a.ply").gaussians
    for name in ("means", "quats", "scales", "opacities", "sh"):
        scale = max(1.0, float(np.abs(getattr(expected, name)).max()))
        assert np.abs(getattr(got, name) - getattr(expected, name)).max() <= tolerance("splat_values") * scale
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode().split("property float ")
    names = [line.split()[0] for line in header[1:]]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert len(names) == 14 + 3 * (degree + 1) ** 2


def test_a_sequence_covers_the_scenes_time(tmp_path: Path):
    scene = scene_file(tmp_path)
    run(scene, tmp_path / "frames", frames=11)
    files = sorted((tmp_path / "frames").iterdir())
    assert [file.name for file in files] == [f"scene_{i:02}.ply" for i in range(11)]
    last = DeformationSession(scene).gaussians(1.0)
    assert np.abs(read_splats(files[-1]).gaussians.means - last.means).max() < tolerance("splat_values")
    with pytest.raises(InvalidInput, match=r"a folder without PLY files"):
        run(scene, tmp_path / "frames", frames=3)


def test_a_folder_may_have_a_dot_in_its_name(tmp_path: Path):
    scene, out = scene_file(tmp_path), tmp_path / "frames.v2"
    with pytest.raises(InvalidInput, match=r"a folder \(of a name with a dot: an existing one\)"):
        run(scene, out, frames=2)
    out.mkdir()
    run(scene, out, frames=2)
    assert len(list(out.iterdir())) == 2


def test_an_interrupted_sequence_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene, written = scene_file(tmp_path), []

    def write_two(file: Path, gaussians: Gaussians, antialiasing: str) -> None:
        if len(written) == 2:
            raise KeyboardInterrupt
        write_ply(file, gaussians, antialiasing)
        written.append(file)

    with monkeypatch.context() as patch:
        patch.setattr("msdgs_export.exporters.command.write_ply", write_two)
        with pytest.raises(KeyboardInterrupt):
            run(scene, tmp_path / "frames", frames=4)
    assert len(written) == 2
    assert not (tmp_path / "frames").exists()
    run(scene, tmp_path / "frames", frames=4)
    assert len(list((tmp_path / "frames").iterdir())) == 4


def test_of_switched_frames_only_the_one_that_is_shown_is_written(tmp_path: Path):
    folder, scene = tmp_path / "frames", tmp_path / "scene.onnx"
    folder.mkdir()
    frames = [some_gaussians(count, sh_degree=0) for count in (120, 80, 200)]
    for number, frame in enumerate(frames):
        (folder / f"frame_{number}.ply").write_bytes(ply_bytes(inria_columns(frame)))
    scene.write_bytes(sequence_scene(read_sequence(folder), "0" * 64).SerializeToString())
    assert DeformationSession(scene).scene.metadata.plan == "frames:3"
    for name, read in (("a.ply", read_splats), ("a.spz", read_splats), ("a.glb", None)):
        run(scene, tmp_path / name, t=0.5)
        got = read(tmp_path / name).gaussians if read else read_gltf(tmp_path / name)
        assert len(got) == 80
        assert np.abs(got.means - frames[1].means).max() < tolerance("spz_position")
    with pytest.raises(InvalidInput, match="USD would blend them"):
        run(scene, tmp_path / "a.usdc")


@pytest.mark.parametrize("antialiasing", ["dilate", "mip"])
def test_spz_keeps_what_eight_bits_can(tmp_path: Path, antialiasing: str):
    scene = scene_file(tmp_path, sh_degree=2)
    contents = onnx.load(scene)
    for entry in contents.metadata_props:
        if entry.key == "antialiasing":
            entry.value = f'"{antialiasing}"'
    onnx.save(contents, scene)
    for name in ("a.spz", "a.ply"):
        run(scene, tmp_path / name)  # compares images, and refuses less than 45 dB
    assert read_splats(tmp_path / "a.ply").antialiasing == antialiasing
    read = read_splats(tmp_path / "a.spz")
    assert read.antialiasing == antialiasing
    expected = DeformationSession(scene).gaussians(0.0)
    assert np.abs(read.gaussians.means - expected.means).max() < tolerance("splat_values")
    turned = np.abs(to_matrix(read.gaussians.quats) - to_matrix(expected.quats))
    assert turned.max() < tolerance("spz_rotation")


@pytest.mark.parametrize(("eps2d", "said"), [(0.1, "draw it blurrier"), (0.3, ""), (0.5, "draw it sharper")])
def test_differences_of_other_renderers_are_printed(tmp_path: Path, eps2d: float, said: str):
    printed = StringIO()
    scene = scene_file(tmp_path, eps2d=eps2d)
    convert(ConvertOptions(scene, tmp_path / "a.ply", 0.0), Console(file=printed, soft_wrap=True))
    assert ("draw it" in printed.getvalue()) == bool(said)
    assert said in printed.getvalue()


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_gltf_holds_one_time(tmp_path: Path, degree: int):
    scene = scene_file(tmp_path, sh_degree=degree)
    run(scene, tmp_path / "a.glb", t=0.4)
    assert_same(read_gltf(tmp_path / "a.glb"), DeformationSession(scene).gaussians(0.4))
    contents = (tmp_path / "a.glb").read_bytes()
    magic, version, size, text = struct.unpack_from("<4sIII", contents)
    assert (magic, version, size) == (b"glTF", 2, len(contents))
    document = json.loads(contents[20 : 20 + text])
    (primitive,) = document["meshes"][0]["primitives"]
    attributes = {name.removeprefix("KHR_gaussian_splatting:") for name in primitive["attributes"]}
    assert {"POSITION", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"} <= attributes
    assert sum(name.startswith("SH_DEGREE") for name in attributes) == (degree + 1) ** 2
    assert document["extensionsUsed"] == list(primitive["extensions"]) == ["KHR_gaussian_splatting"]
    assert {"mode": 0, "kernel": "ellipse"}.items() <= {**primitive, **primitive["extensions"][EXTENSION]}.items()
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    assert (20 + text) % 4 == 0
    color = document["accessors"][primitive["attributes"]["COLOR_0"]]
    start = 28 + text + document["bufferViews"][color["bufferView"]]["byteOffset"]
    linear = np.frombuffer(contents, "<u2", 4 * color["count"], start).reshape(-1, 4) / 65535
    g = DeformationSession(scene).gaussians(0.4)
    encoded = np.column_stack([g.sh[:, 0] * SH_C0 + 0.5, g.opacities]).clip(0, 1)
    assert np.abs(linear[:, :3] - srgb_to_linear(encoded[:, :3])).max() < 1 / 65535
    assert np.abs(linear[:, 3] - encoded[:, 3]).max() < 1 / 65535


def test_what_gltf_cannot_hold_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(InvalidInput, match="`scene` must be of one or more Gaussians for glTF, got 0"):
        write_gltf(tmp_path / "a.glb", some_gaussians(0, 0))
    write_gltf(tmp_path / "a.glb", some_gaussians(20, 0))
    monkeypatch.setattr(gltf, "MAX_BYTES", (tmp_path / "a.glb").stat().st_size - 1)
    with pytest.raises(InvalidInput, match="`scene` must be at most"):
        write_gltf(tmp_path / "b.glb", some_gaussians(20, 0))
    assert not (tmp_path / "b.glb").exists()


def assert_same(got: Gaussians, expected: Gaussians) -> None:
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(got, name), getattr(expected, name), atol=tolerance("splat_values"))


@pytest.mark.parametrize("ending", ["usdc", "usda"])
def test_usd_has_a_sample_a_frame(tmp_path: Path, ending: str):
    usd = pytest.importorskip("pxr.Usd")
    scene, out = scene_file(tmp_path, sh_degree=1), tmp_path / f"a.{ending}"
    run(scene, out, frames=5)
    stage = usd.Stage.Open(str(out))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetMetadata("upAxis")) == (0, 4, "Y")
    assert prim.GetAttribute("positions").GetTimeSamples() == [0, 1, 2, 3, 4]
    assert len(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()) == 300 * 4
    session, shown = DeformationSession(scene), read_usd(out)
    for frame in range(5):
        assert_same(shown(frame), session.gaussians(frame / 4))
    first = session.gaussians(0.0)
    turned = prim.GetAttribute("orientations").Get(0)[0]  # rotated by 180° about x, as OpenCV's y points down
    assert turned.GetReal() == pytest.approx(float(first.quats[0, 0]))
    assert turned.GetImaginary()[1] == pytest.approx(-float(first.quats[0, 2]))
    run(scene, tmp_path / f"still.{ending}", t=0.4)
    still = usd.Stage.Open(str(tmp_path / f"still.{ending}"))
    assert still.GetDefaultPrim().GetAttribute("positions").GetTimeSamples() == []
    assert_same(read_usd(tmp_path / f"still.{ending}")(0), session.gaussians(0.4))


@pytest.mark.parametrize(("info", "up"), [(SCENE, [0, -1, 0]), (SceneInfo(bounds=SCENE.bounds), [0, 0, 1])])
def test_up_is_y_by_what_a_file_says(tmp_path: Path, info: SceneInfo, up: list[int]):
    scene = scene_file(tmp_path, info=info)
    expected = DeformationSession(scene).gaussians(0.4)
    run(scene, tmp_path / "a.glb", t=0.4)
    contents = (tmp_path / "a.glb").read_bytes()
    text, first = struct.unpack_from("<I", contents, 12)[0], expected.means[0] * (1, -1, -1)  # as glTF holds it
    (node,) = json.loads(contents[20 : 20 + text])["nodes"]
    height = tolerance("splat_values")
    assert Rotation.from_quat(node["rotation"]).apply(first)[1] == pytest.approx(expected.means[0] @ up, abs=height)
    assert_same(read_gltf(tmp_path / "a.glb"), expected)
    geom, gf = pytest.importorskip("pxr.UsdGeom"), pytest.importorskip("pxr.Gf")
    run(scene, tmp_path / "a.usda", t=0.4)
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(tmp_path / "a.usda"))
    to_world = geom.XformCache().GetLocalToWorldTransform(stage.GetDefaultPrim())
    assert to_world.Transform(gf.Vec3d(*first.tolist()))[1] == pytest.approx(expected.means[0] @ up, abs=height)
    assert_same(read_usd(tmp_path / "a.usda")(0), expected)


def test_a_failed_conversion_keeps_the_old_file(tmp_path: Path):
    scene, out = scene_file(tmp_path), tmp_path / "a.spz"
    out.write_text("old")
    with pytest.raises(ConversionFailed, match=r"99.5 dB were asked for"):
        run(scene, out, min_psnr=99.5)
    assert out.read_text() == "old"
    assert LOSSLESS > LOSSY >= 45


SUFFIXES = (".ply", ".spz", ".glb", ".usdc", ".usda", ".onnx", ".visionary.onnx")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_on_a_full_disk_the_file_is_named_and_the_old_one_stays(tmp_path: Path, suffix: str):
    scene, out = scene_file(tmp_path), tmp_path / f"out{suffix}"
    out.write_bytes(b"old")
    with pytest.raises(WriteFailed, match=f"^{out}: can't be written: "), largest_file(2000):
        run(scene, out)
    assert out.read_bytes() == b"old"
    assert sorted(os.listdir(tmp_path)) == [out.name, scene.name]


def test_on_a_full_disk_no_frame_of_a_sequence_stays(tmp_path: Path):
    scene, out = scene_file(tmp_path), tmp_path / "frames"
    with pytest.raises(WriteFailed, match=f"^{out}: can't be written: "), largest_file(2000):
        run(scene, out, frames=2)
    assert not out.exists()


def test_frames_that_were_moved_go_back_if_others_cannot_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene, out, replace = scene_file(tmp_path), tmp_path / "new" / "frames", os.replace

    def interrupted(source: Path, target: Path) -> None:
        if target.name.endswith("_1.ply") and target.parent == out:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(scene, out, frames=3)
    assert os.listdir(tmp_path) == [scene.name]


@pytest.mark.parametrize("of", ["network", "sequence"])
def test_opacities_and_colors_that_change_are_those_of_each_time(tmp_path: Path, of: str):
    scene = tmp_path / "scene.onnx"
    if of == "network":
        scene_file(tmp_path, sh_degree=1, opacity_head=True, sh_head=True)
    else:
        frames = tuple(some_gaussians(300, seed=seed) for seed in (0, 1, 2))
        scene.write_bytes(sequence_scene(Frames(frames, 0, "dilate", True), "0" * 64).SerializeToString())
    session = DeformationSession(scene)
    assert session.scene.changing == ("opacities", "sh")
    early, late = session.gaussians(0.4), session.gaussians(1.0)
    assert np.abs(late.opacities - early.opacities).max() > 0.001
    for name, read in (("a.ply", lambda file: read_splats(file).gaussians), ("a.glb", read_gltf)):
        run(scene, tmp_path / name, t=0.4)
        assert_same(read(tmp_path / name), early)
    run(scene, tmp_path / "a.spz", t=0.4)  # compares images
    run(scene, tmp_path / "a.visionary.onnx")
    shown = visionary_of(tmp_path / "a.visionary.onnx")
    for t in (0.0, 0.4, 1.0):
        got, expected = shown(t), session.gaussians(t)
        assert np.abs(got.opacities - expected.opacities).max() <= tolerance("splat_values")
        assert np.abs(got.sh[:, :4] - expected.sh).max() <= tolerance("visionary.sh")
    usd = pytest.importorskip("pxr.Usd")
    run(scene, tmp_path / "a.usdc", frames=5)
    for frame in range(5):
        assert_same(read_usd(tmp_path / "a.usdc")(frame), session.gaussians(frame / 4))
    assert (
        len(usd.Stage.Open(str(tmp_path / "a.usdc")).GetDefaultPrim().GetAttribute("opacities").GetTimeSamples()) == 5
    )


@pytest.mark.parametrize(
    ("plan", "out", "message"),
    [
        ("network", "a.mp4", r"msdgs-render"),
        ("network", "a.obj", r"or named .ply, .spz, .glb, .usdc, .usda, .usd, .onnx or .visionary.onnx"),
    ],
)
def test_what_cannot_be_written_is_refused_with_an_alternative(tmp_path: Path, plan: str, out: str, message: str):
    with pytest.raises(InvalidInput, match=message):
        run(scene_file(tmp_path, plan), tmp_path / out)


def test_an_option_without_effect_and_a_missing_folder_are_refused(tmp_path: Path):
    scene = scene_file(tmp_path, "network")
    with pytest.raises(InvalidInput, match=r"`t` must be left out for a file that holds all times, got 0\.5"):
        run(scene, tmp_path / "b.onnx", 0.5)
    for out, t in (("a.ply", None), ("b.onnx", None), ("a.usdc", 0.5)):
        with pytest.raises(InvalidInput, match="`frames` must be left out but for a folder of PLY files and OpenUSD"):
            run(scene, tmp_path / out, t, frames=9)
    with pytest.raises(InvalidInput, match="`out` must be in a folder that exists"):
        run(scene, tmp_path / "nowhere" / "a.ply")
    for min_psnr in (math.nan, -5.0, 101.0):
        with pytest.raises(InvalidInput, match="`min_psnr` must be a PSNR in dB"):
            convert(ConvertOptions(scene, tmp_path / "a.spz", min_psnr=min_psnr), QUIET)
    assert not (tmp_path / "a.spz").exists()


@pytest.mark.parametrize("name", ["a.compressed.ply", "A.Compressed.PLY", "new.folder.compressed.ply"])
def test_a_compressed_ply_is_not_written(tmp_path: Path, name: str):
    with pytest.raises(InvalidInput, match=r"`out` must be without \.compressed: .* compressed PLY isn't written"):
        convert(ConvertOptions(tmp_path / "scene.onnx", tmp_path / name), QUIET)
