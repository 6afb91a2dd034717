"""Folders of splat files: which are frames of one sequence, in which order, and what to give instead of others."""

from pathlib import Path

import pytest

from msdgs_export.importers.detect import detect_format, frame_files
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.sequence import read_sequence
from tests.support.splat_files import some_gaussians, write_splats

POINTS = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"


@pytest.mark.parametrize(
    "names",
    [
        ("inria_native_9080.ply", "playbot_4.ply"),
        ("one.spz", "three.spz", "two.spz"),
        ("frame_1.ply", "frame_2.spz"),
        ("frame_1_near.ply", "frame_2_far.ply"),
        ("take1_frame1.ply", "take2_frame2.ply"),
        ("frame_1.ply", "frame_2.ply", "ground.ply"),
        ("a.PLY", "a.ply"),
    ],
)
def test_splat_files_of_other_names_are_no_sequence(tmp_path: Path, names: tuple[str, ...]):
    for name in names:
        (tmp_path / name).write_bytes(POINTS)
    for read in (detect_format, read_sequence):
        with pytest.raises(ImportFailed, match=rf"{names[0]} and .* differ in more than a number"):
            read(tmp_path)


@pytest.mark.parametrize(
    "names",
    [
        ("frame_9.ply", "frame_010.PLY", "frame_11.ply"),
        ("1.spz", "2.spz"),
        ("lod3_frame2.compressed.ply", "lod3_frame10.compressed.ply"),
        ("frame2_lod3.sog", "frame10_lod3.sog"),
        ("t_0.05.ply", "t_0.10.ply", "t_1.00.ply"),
        ("v1.0002.ply", "v1.0010.ply"),
    ],
)
def test_frames_are_in_the_order_of_the_number_that_differs(tmp_path: Path, names: tuple[str, ...]):
    for name in (*names, "notes_1.txt", ".hidden.ply"):
        (tmp_path / name).touch()
    assert [file.name for file in frame_files(tmp_path)] == list(names)
    assert detect_format(tmp_path) == "sequence"


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        (("time_0.0.ply", "time_0.05.ply", "time_0.1.ply"), "0.0 and 0.05 may be decimals .* as many digits each"),
        (("v1.9.ply", "v1.10.ply"), "1.10 and 1.9 may be decimals"),
        (("f_1.ply", "f_2.ply", "f_01.ply", "f_02.ply"), "f_01.ply and f_1.ply have the same number"),
    ],
)
def test_frames_without_a_clear_order_are_refused(tmp_path: Path, names: tuple[str, ...], problem: str):
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(ImportFailed, match=problem):
        frame_files(tmp_path)


def test_uneven_numbers_of_frames_are_told(tmp_path: Path):
    for number in (0, 1, 2, 10):
        write_splats(tmp_path, "ply", some_gaussians()).rename(tmp_path / f"frame_{number:04}.ply")
    assert any("unevenly spaced" in warning for warning in read_sequence(tmp_path).warnings)
    (tmp_path / "frame_0010.ply").rename(tmp_path / "frame_0003.ply")
    assert not read_sequence(tmp_path).warnings


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        (
            "point_cloud/iteration_30000/point_cloud.ply",
            r"the folder of a training; point_cloud/iteration_30000/.* read",
        ),
        ("splatfacto/2026-01-01/config.yml", r"ns-export gaussian-splat --load-config .*config\.yml"),
        ("scene.glb", "glTF, which is written but not read"),
    ],
)
def test_what_to_give_instead_is_said(tmp_path: Path, name: str, problem: str):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).touch()
    with pytest.raises(ImportFailed, match=problem):
        detect_format(tmp_path / name if name.endswith(".glb") else tmp_path)
