"""Splats inside a zip, as Luma hands them out, or a gzip."""

import gzip
import io
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from msdgs_export.importers.detect import detect_format, frame_files
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats import formats
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.importers.splats.unpack import MIN_LIMIT
from tests.support.splat_files import FORMATS, inria_columns, ply_bytes, some_gaussians, write_splats

G = some_gaussians(20)
PLY = ply_bytes(inria_columns(G))


def zip_of(entries: Mapping[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    contents = io.BytesIO()
    with zipfile.ZipFile(contents, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return contents.getvalue()


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unpack in this process, which is faster."""
    monkeypatch.setattr(formats, "read_guarded", lambda read, *arguments: read(*arguments))


MORE = {
    "readme.txt": b"hello",
    "__MACOSX/._a.ply": b"Mac OS X",
    "preview/photo.jpg": b"\xff\xd8",
    ".hidden.ply": b"ply",
}


@pytest.mark.parametrize("name", ["a.ply", "gs_capture/point_cloud.ply", "deep/er/A.PLY", "é/Γ.ply"])
@pytest.mark.parametrize("outer", ["capture.zip", "capture", "capture.ply"])
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.usefixtures("here")
def test_a_zip_with_one_ply_is_that_ply(tmp_path: Path, name: str, outer: str, method: int):
    (tmp_path / outer).write_bytes(zip_of({"gs_capture/": b""} | MORE | {name: PLY}, method))
    assert detect_format(tmp_path / outer) == "ply"
    assert np.array_equal(read_splats(tmp_path / outer).gaussians.means, G.means)
    assert np.array_equal(read_splats(tmp_path / outer, "ply").gaussians.means, G.means)


@pytest.mark.parametrize("kind", sorted(FORMATS.keys() - {"sog"}))
@pytest.mark.usefixtures("here")
def test_a_zip_may_hold_a_splat_of_any_format(tmp_path: Path, kind: str):
    g = some_gaussians(20, 0)
    name, contents = FORMATS[kind]
    (tmp_path / "a.zip").write_bytes(zip_of({f"scene/{name}": contents(g)}))
    assert len(read_splats(tmp_path / "a.zip")) == 20


@pytest.mark.parametrize("name", ["a.ply.gz", "a.gz", "a.ply", "a"])
@pytest.mark.usefixtures("here")
def test_a_gzip_of_a_ply_is_that_ply(tmp_path: Path, name: str):
    (tmp_path / name).write_bytes(gzip.compress(PLY))
    assert detect_format(tmp_path / name) == "ply"
    assert np.array_equal(read_splats(tmp_path / name).gaussians.means, G.means)


@pytest.mark.usefixtures("here")
def test_a_gzip_of_another_splat_is_known_by_its_name(tmp_path: Path):
    (tmp_path / "a.splat.gz").write_bytes(gzip.compress(FORMATS["splat"][1](some_gaussians(20, 0))))
    assert detect_format(tmp_path / "a.splat.gz") == "splat"
    assert len(read_splats(tmp_path / "a.splat.gz")) == 20


def test_gzips_of_numbered_files_are_a_sequence(tmp_path: Path):
    for number in (2, 10):
        (tmp_path / f"frame_{number}.ply.gz").write_bytes(gzip.compress(PLY))
    assert [file.name for file in frame_files(tmp_path)] == ["frame_2.ply.gz", "frame_10.ply.gz"]


@pytest.mark.slow
def test_an_archive_is_unpacked_in_a_process_of_its_own_and_keeps_all_that_was_read(tmp_path: Path):
    moving = {name: np.linspace(0, 1, 20) for name in ("unknown", "motion_0", "motion_1", "motion_2")}
    moving |= {"trbf_center": np.zeros(20), "trbf_scale": np.zeros(20)}
    commented = ply_bytes(inria_columns(G) | moving)
    commented = commented.replace(b"element", b"comment Vertical Axis: z\ncomment antialiased 1\nelement", 1)
    (tmp_path / "a.zip").write_bytes(zip_of({"a.ply": commented}))
    (tmp_path / "a.ply").write_bytes(commented)
    packed, plain = read_splats(tmp_path / "a.zip").to_arrays(), read_splats(tmp_path / "a.ply").to_arrays()
    assert packed.keys() == plain.keys() >= {"up", "motion"}
    assert all(np.array_equal(array, packed[name]) for name, array in plain.items())


BOMB = PLY + bytes(2 * MIN_LIMIT)


@pytest.mark.parametrize(
    ("contents", "problem"),
    [
        (zip_of({"a.ply": PLY, "b/c.ply": PLY}), r"holds 2 splats: a\.ply, b/c\.ply; unpack it"),
        (zip_of({f"{i}.splat": b"" for i in range(9)}), r"holds 9 splats: 0\.splat, .* and 5 more"),
        (zip_of({"a.ply": BOMB}), r"unpacks to more than 4,194,304 bytes"),
        (gzip.compress(BOMB), r"unpacks to more than 4,194,304 bytes"),
        (zip_of({"in/a.ply": PLY[:300]}), r"in it, a\.ply: isn't a whole PLY file"),
        (
            zip_of({"a.ply": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"}),
            r"in it, a\.ply: is a Git LFS",
        ),
        (zip_of({"photo.jpg": b"\xff\xd8"}), r"has no known format"),
        (zip_of({}), r"has no known format"),
        (zip_of({"a.ply": PLY})[:-30], r"isn't a whole zip: it is cut off"),
        (gzip.compress(PLY)[:-20], r"isn't a whole archive"),
        (gzip.compress(PLY)[:8], r"isn't a whole gzip file"),
        (b"7z\xbc\xaf\x27\x1c" + bytes(40), r"is a 7z archive: unpack it first"),
        (b"Rar!\x1a\x07\x01" + bytes(40), r"is a RAR archive"),
        (b"\x28\xb5\x2f\xfd" + bytes(40), r"is a Zstandard archive"),
    ],
    ids=range(14),
)
@pytest.mark.usefixtures("here")
def test_other_archives_are_refused_in_words_of_ours(tmp_path: Path, contents: bytes, problem: str):
    (tmp_path / "a.zip").write_bytes(contents)
    with pytest.raises(ImportFailed, match=problem):
        read_splats(tmp_path / "a.zip", detect_format(tmp_path / "a.zip"))


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (
            lambda c, d: c.__setitem__(slice(d + 10, d + 12), b"\x09\0"),
            r"its a\.ply is packed by method 9; unpack it first",
        ),
        (lambda c, d: c.__setitem__(d + 8, 1), r"its a\.ply is encrypted"),
        (lambda c, d: c.__setitem__(60, c[60] ^ 255), r"isn't a whole archive"),
    ],
)
@pytest.mark.usefixtures("here")
def test_faults_of_a_zip_are_told_in_words_of_ours(
    tmp_path: Path, damage: Callable[[bytearray, int], None], problem: str
):
    contents = bytearray(zip_of({"a.ply": PLY}))
    damage(contents, contents.rindex(b"PK\x01\x02"))
    (tmp_path / "a.zip").write_bytes(contents)
    with pytest.raises(ImportFailed, match=problem):
        read_splats(tmp_path / "a.zip")


@pytest.mark.usefixtures("here")
def test_zstandard_is_needed_by_spz_4_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    assert len(read_splats(write_splats(tmp_path, "spz 3, bare", G)).gaussians) == len(G)
    with pytest.raises(ImportFailed, match=r"SPZ version 4, which needs zstandard: pip install 'msdgs\[export\]'"):
        read_splats(write_splats(tmp_path, "spz 4", G))
