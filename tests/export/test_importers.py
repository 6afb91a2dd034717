"""Import of splat files of other programs, and errors that name the faults of invalid ones."""

import gzip
import json
import os
import struct
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from msdgs_export.cli.export import export_or_import
from msdgs_export.exporters.spz import write_spz
from msdgs_export.importers import command
from msdgs_export.importers.detect import detect_format
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.sequence import read_sequence
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.options import ExportOptions
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import to_matrix
from tests.support import reference
from tests.support.images import psnr
from tests.support.splat_files import (
    FORMATS,
    compressed_ply_bytes,
    drawn,
    inria_columns,
    ply_bytes,
    sog_bytes,
    some_gaussians,
    write_sog,
    write_splats,
    zipped,
)
from tests.support.tolerances import tolerance

QUIET = Console(quiet=True)

REAL = os.environ.get("MSDGS_SPLATS")
"""A folder with real files, if there is one."""


POINTS = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"


def write(folder: Path, name: str, contents: bytes) -> Path:
    (folder / name).write_bytes(contents)
    return folder / name


@pytest.mark.parametrize("kind", FORMATS)
def test_each_format_shows_what_was_put_into_it(tmp_path: Path, kind: str):
    g = some_gaussians(sh_degree=0 if kind == "splat" else 2)
    file = write_splats(tmp_path, kind, g)
    assert detect_format(file) == file.suffix[1:]
    read = read_splats(file)
    assert read.dropped == 0
    assert len(read) == len(g)
    quantity = "splat_file_db" if kind in ("ply", "text ply") else "quantised_splat_file_db"
    assert psnr(drawn(read.gaussians).clip(0, 1), drawn(g).clip(0, 1)) >= tolerance(quantity)


def test_an_spz_with_unconverted_axes_can_be_read(tmp_path: Path):
    g = some_gaussians(30, 3)
    write_spz(tmp_path / "a.spz", g, "dilate")
    plain, unturned = (read_splats(tmp_path / "a.spz", kind).gaussians for kind in ("spz", "spz:unturned"))
    np.testing.assert_array_equal(unturned.means, plain.means * np.array([1, -1, -1], np.float32))
    half_turn = np.diag([1, -1, -1])  # of the axes; a Gaussian doesn't change if its own axes flip
    np.testing.assert_allclose(to_matrix(unturned.quats), half_turn @ to_matrix(plain.quats) @ half_turn, atol=1e-6)
    seen = np.random.default_rng(0).normal(size=(30, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    colors = [
        np.einsum("nc,ncd->nd", reference.sh_basis(way, 3), each.sh)
        for way, each in ((seen, plain), (seen @ half_turn, unturned))
    ]
    np.testing.assert_allclose(colors[0], colors[1], atol=1e-5)


@pytest.mark.parametrize("kind", sorted(FORMATS.keys() - {"text ply"}))  # a last number with fewer digits is valid, too
def test_a_cut_off_file_is_refused_by_name(tmp_path: Path, kind: str):
    file = write_splats(tmp_path, kind, some_gaussians(sh_degree=0))
    whole = file.read_bytes()
    for keep in (0, 3, 20, len(whole) // 2 + 1, len(whole) - 1):
        file.write_bytes(whole[:keep])
        with pytest.raises(ImportFailed, match=file.name):
            read_splats(file)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_properties_of_a_ply_may_come_in_any_order_and_number_form(tmp_path: Path, degree: int, form: str):
    g = some_gaussians(40, degree)
    columns = inria_columns(g)
    names = list(np.random.default_rng(degree).permutation(list(columns)))
    shuffled = {"nx": np.zeros(40)} | {name: columns[name] for name in names} | {"extra": np.full(40, np.nan)}
    read = read_splats(write(tmp_path, "a.ply", ply_bytes(shuffled, form))).gaussians
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(read, name), getattr(g, name), rtol=tolerance("splat_values"), atol=1e-6)


def test_quaternions_of_any_length_and_infinite_logits_are_usable_and_broken_gaussians_are_counted(tmp_path: Path):
    g = some_gaussians(6, 0)
    columns = {name: values.copy() for name, values in inria_columns(g).items()}
    for i in range(4):
        columns[f"rot_{i}"] *= 7
    columns["opacity"][:2] = (np.inf, -np.inf)
    columns["x"][2], columns["scale_1"][3], columns["f_dc_0"][4] = np.nan, np.nan, np.inf
    read = read_splats(write(tmp_path, "a.ply", ply_bytes(columns)))
    assert (len(read), read.dropped) == (3, 3)
    assert read.gaussians.opacities[:2].tolist() == [1, 0]
    np.testing.assert_allclose(read.gaussians.quats[0], g.quats[0], atol=tolerance("splat_values"))


def test_more_data_than_the_header_says_is_left_alone(tmp_path: Path):
    g = some_gaussians(5, 0)
    file = write(tmp_path, "a.ply", ply_bytes(inria_columns(g)) + b"more")
    assert len(read_splats(file)) == 5


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_header_with_too_high_a_count_takes_no_memory(tmp_path: Path, form: str):
    file = write(tmp_path, "a.ply", ply_bytes(inria_columns(some_gaussians(5, 0)), form, count=10**12))
    tracemalloc.start()
    with pytest.raises(ImportFailed, match=r"cut off: 1,000,000,000,000 rows"):
        read_splats(file)
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()
    bomb = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 2**32 - 1, 3, 12, 0, 0) + bytes(100_000))
    with pytest.raises(ImportFailed, match=r"cut off: 4,294,967,295 Gaussians"):
        read_splats(write(tmp_path, "a.spz", bomb))


@pytest.mark.parametrize(
    ("name", "contents", "message"),
    [
        ("a.ply", POINTS, r"no property `f_dc_0`"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n", r"no element `vertex`"),
        ("a.spz", struct.pack("<4sIIBBBB", b"NGSP", 9, 1, 0, 12, 0, 0), r"SPZ version 9"),
        ("a.spz", struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 4, 12, 0, 0), r"SH of degree 4"),
        pytest.param(
            "a.ksplat", bytes(5000), r"a.ksplat: is .ksplat version 0.0; version 0.1 can be read", id="ksplat"
        ),
        ("a.onnx", b"scene", r"is a scene file already"),
        ("a.txt", b"nothing of ours", r"--format names it, one of model, ply"),
    ],
)
def test_unreadable_files_name_the_reason(tmp_path: Path, name: str, contents: bytes, message: str):
    file = write(tmp_path, name, contents)
    with pytest.raises(ImportFailed, match=message):
        read_splats(file, detect_format(file))


def test_a_sog_reads_no_files_outside_of_its_folder(tmp_path: Path):
    folder = write_sog(tmp_path / "sog", some_gaussians(20, 0))
    meta = (folder / "meta.json").read_text()
    (folder / "meta.json").write_text(meta.replace('"quats.webp"', '"../sog/quats.webp"'))
    with pytest.raises(ImportFailed, match=r"`quats.files` must be a list of 1 names of files beside it"):
        read_splats(folder)


@pytest.mark.parametrize(
    ("said", "read"), [({"model": "antialiased"}, "mip"), ({"antialias": True}, "mip"), ({"model": "2dgs"}, "dilate")]
)
def test_a_sog_may_be_anti_aliased(tmp_path: Path, said: dict[str, Any], read: str):
    meta = write_sog(tmp_path / "sog", some_gaussians(20, 0)) / "meta.json"
    meta.write_text(json.dumps(json.loads(meta.read_text()) | said))
    assert read_splats(tmp_path / "sog").antialiasing == read


@pytest.mark.parametrize(
    ("comments", "read"),
    [
        (["Exported from Brush", "SplatRenderMode: mip"], "mip"),
        (["antialiased 1"], "mip"),
        (["antialiased 0"], "dilate"),
        (["antialiased 1", "SplatRenderMode: default"], "dilate"),
        ([], "dilate"),
    ],
)
@pytest.mark.parametrize("is_compressed", [False, True])
def test_a_ply_may_be_anti_aliased(tmp_path: Path, is_compressed: bool, comments: list[str], read: str):
    g = some_gaussians(20, 0)
    contents = compressed_ply_bytes(g) if is_compressed else ply_bytes(inria_columns(g))
    header = "".join(f"comment {comment}\n" for comment in comments)
    (tmp_path / "a.ply").write_bytes(contents.replace(b"element", header.encode() + b"element", 1))
    assert read_splats(tmp_path / "a.ply").antialiasing == read


def test_a_sog_named_by_its_meta_json_is_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its limits and its digest are those of all its files."""
    folder, read = write_sog(tmp_path / "sog", some_gaussians(20, 0)), list[Path]()
    monkeypatch.setattr(command, "read_splats", lambda path, *more: read.append(path) or read_splats(path, *more))
    digests = set()
    for path in (folder, folder / "meta.json"):
        export_or_import(ExportOptions(path, tmp_path / "scene.onnx"), QUIET)
        digests.add(DeformationSession(tmp_path / "scene.onnx").scene.metadata.checkpoint_sha256)
    assert read == [folder, folder]
    assert len(digests) == 1


@pytest.mark.parametrize("ending", [".sog", ".zip"])
@pytest.mark.parametrize("damage", [{0: 0}, {6: 255}, {9: 8, 46: 255}], ids=["magic", "version", "a name's encoding"])
def test_a_zip_whose_directory_is_damaged_is_refused_unnamed(tmp_path: Path, ending: str, damage: dict[int, int]):
    contents = bytearray(sog_bytes(some_gaussians(20, 0)))
    directory = contents.index(b"PK\x01\x02")
    for at, value in damage.items():
        contents[directory + at] = value
    file = write(tmp_path, f"a{ending}", bytes(contents))
    with pytest.raises(ImportFailed, match=r"a\..*: isn't a whole zip"):
        read_splats(file)


def test_a_sog_is_stored_or_deflated(tmp_path: Path):
    folder = write_sog(tmp_path / "sog", some_gaussians(20, 0))
    file = write(tmp_path, "a.sog", zipped(folder, zipfile.ZIP_LZMA))
    with pytest.raises(ImportFailed, match=r"its meta.json is packed by a method that SOG doesn't use: 14"):
        read_splats(file)


def test_a_static_scene_is_the_file_and_can_be_drawn_without_saying_from_where(tmp_path: Path):
    file = write_splats(tmp_path, "ply", some_gaussians())
    session = scene_of(file, "ply")
    assert session.scene.metadata.measured_error["means"] == 0
    view = framing(session.scene.metadata)
    camera = Camera.from_fov(orbit(view.target, view.distance, 0, 10, view.up), 48, 48, view.fov_y)
    image = Renderer().render(session, camera, 0.5)
    assert image.alpha.max() > 0.5
    assert np.array_equal(session.gaussians(0.5).means, read_splats(file).gaussians.means)


def moving_frames(count: int) -> list[Gaussians]:
    """Return frames of a rigid motion in which the last ten Gaussians are static."""
    first, frames = some_gaussians(200, 0), []
    for i in range(count):
        means = first.means.copy()
        means[:-10] += np.array([0.05 * i, 0.02 * i * i, 0], np.float32)
        frames.append(Gaussians(means, first.quats, first.scales, first.opacities, first.sh))
    return frames


def write_frames(folder: Path, frames: list[Gaussians]) -> Path:
    folder.mkdir()
    for i, frame in enumerate(frames):
        write(folder, f"frame_{i * 2 + 1}.ply", ply_bytes(inria_columns(frame)))
    return folder


def scene_of(folder: Path, file_format: str = "sequence") -> DeformationSession:
    output = folder.parent / "scene.onnx"
    export_or_import(ExportOptions(folder, output, file_format, keep=("float32",)), QUIET)
    return DeformationSession(output)


@pytest.mark.parametrize(
    "option", [{"max_mb": 5.0}, {"for_web": True}, {"plan": "network"}, {"quick": True}, {"keep": ("static",)}]
)
def test_options_of_trained_models_are_refused_for_splats(tmp_path: Path, option: dict[str, Any]):
    splats = write(tmp_path, "a.ply", ply_bytes(inria_columns(some_gaussians(20, 0))))
    (name,) = option
    with pytest.raises(InvalidInput, match=f"`{name}` must be left out"):
        export_or_import(ExportOptions(splats, **option), QUIET)
    assert not splats.with_suffix(".onnx").exists()


@pytest.mark.parametrize("count", [2, 3, 4, 11])
def test_frames_that_correspond_are_blended(tmp_path: Path, count: int):
    session = scene_of(write_frames(tmp_path / "f", moving_frames(count)))
    assert session.scene.metadata.plan == f"keyframes:{count + 2}"
    assert session.scene.static_count == 10
    assert session.scene.metadata.measured_error["means"] <= tolerance("stored_frame")
    early, late = (session.gaussians(t).means[0] for t in (0.0, 1 / (count - 1)))
    between = session.gaussians(0.5 / (count - 1)).means[0]
    assert np.linalg.norm(between - (early + late) / 2) < 0.5 * np.linalg.norm(late - early)


@pytest.mark.parametrize("changing", [("opacities",), ("sh",), ("opacities", "sh")])
def test_frames_whose_gaussians_fade_and_change_color_are_blended(tmp_path: Path, changing: tuple[str, ...]):
    frames, rng = moving_frames(4), np.random.default_rng(0)
    for i, frame in enumerate(frames):
        fading = frame.opacities.copy()
        fading[95:195] *= np.float32((1e-6, 1, 0.4, 1e-6)[i])  # some move, others change in their place
        sh = frame.sh.copy()
        sh[100:195] += rng.normal(0, 0.3, (95, 1, 3)).astype(np.float32)
        frames[i] = replace(frame, **{n: v for n, v in {"opacities": fading, "sh": sh}.items() if n in changing})
    folder = write_frames(tmp_path / "f", frames)
    session = scene_of(folder)
    scene = session.scene
    assert (scene.metadata.contract, scene.metadata.plan, scene.changing) == ("msdgs/2", "keyframes:6", changing)
    assert (scene.moving_count, scene.static_count) == (195, 5)
    assert max(scene.metadata.measured_error[name] for name in scene.posed_outputs) <= tolerance("stored_frame")
    for i, frame in enumerate(frames):
        got = drawn(session.gaussians(i / 3)).clip(0, 1)
        assert psnr(got, drawn(frame).clip(0, 1)) >= tolerance("splat_file_db")
    for t in np.linspace(0, 1, 31).tolist():
        session.gaussians(t).validate()


def test_a_color_that_changes_by_less_than_two_steps_is_constant(tmp_path: Path):
    frames = [replace(f, sh=f.sh + np.float32(0.005 * i)) for i, f in enumerate(moving_frames(3))]
    scene = scene_of(write_frames(tmp_path / "f", frames)).scene
    assert (scene.metadata.contract, scene.changing, scene.static_count) == ("msdgs/1", (), 10)


def shuffled(frames: list[Gaussians]) -> list[Gaussians]:
    mixed = []
    for i, f in enumerate(frames):
        order = np.random.default_rng(i).permutation(len(f))
        mixed.append(Gaussians(f.means[order], f.quats[order], f.scales[order], f.opacities[order], f.sh[order]))
    return mixed


@pytest.mark.parametrize("change", ["order", "count", "one opacity and color, another order"])
def test_frames_that_do_not_correspond_are_switched(tmp_path: Path, change: str):
    frames = moving_frames(4)
    if change == "count":
        frames[1] = some_gaussians(120, 0)
    else:
        if change != "order":
            alike = (np.full(200, 0.5, np.float32), np.zeros((200, 1, 3), np.float32))
            frames = [Gaussians(f.means, f.quats, f.scales, *alike) for f in frames]
        frames = shuffled(frames)
    folder = write_frames(tmp_path / "f", frames)
    session = scene_of(folder)
    assert session.scene.metadata.plan == "frames:4"
    for t, frame in ((0.0, 0), (0.15, 0), (0.2, 1), (1 / 3, 1), (1.0, 3)):
        assert psnr(drawn(session.gaussians(t)).clip(0, 1), drawn(frames[frame]).clip(0, 1)) >= tolerance(
            "splat_file_db"
        )
    with pytest.raises(ImportFailed, match=r"can't be blended"):
        read_sequence(folder, "blend")


def test_a_sequence_that_corresponds_can_be_switched_on_request(tmp_path: Path):
    session = scene_of(write_frames(tmp_path / "f", moving_frames(3)), "sequence:switch")
    assert session.scene.metadata.plan == "frames:3"


@pytest.mark.skipif(REAL is None, reason="MSDGS_SPLATS names no folder of real files")
def test_real_files_agree_with_what_another_program_made_of_them(tmp_path: Path):
    real = Path(REAL or "")
    pairs = [("guitar.compressed.ply", "guitar.derived_v4.spz"), ("playbot_sog/3_0", "playbot_lod3.inria.ply")]
    for first, second in pairs:
        a, b = (read_splats(real / name).gaussians for name in (first, second))
        assert len(a) == len(b)
        assert np.abs(a.means - b.means).max() < tolerance("spz_position")
        rotation_error = np.abs(to_matrix(a.quats) - to_matrix(b.quats)).max()
        assert rotation_error < tolerance("spz_rotation")
        assert np.abs(a.opacities - b.opacities).max() < tolerance("splat_values")
    file = write(tmp_path, "a.sog", zipped(real / "playbot_sog/6_0"))
    assert np.array_equal(read_splats(file).gaussians.sh, read_splats(real / "playbot_sog/6_0").gaussians.sh)
