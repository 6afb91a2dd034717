"""PLY files as other programs leave them: names, elements, comments and ranges of any spelling; Git LFS pointers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from msdgs_export.importers.detect import detect_format
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats.base import LOG_SCALE_LIMIT
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.importers.splats.ply import read_ply
from tests.support.splat_files import (
    FORMATS,
    compressed_ply_bytes,
    inria_columns,
    ply_bytes,
    some_gaussians,
    write_sog,
    write_splats,
)

G = some_gaussians(20)
FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4d7a" * 16 + b"\nsize 132735\n"


def same(file: Path, contents: bytes) -> None:
    """Assert that the contents are read as `G` without a warning."""
    file.write_bytes(contents)
    found = read_ply(file)
    assert np.array_equal(found.gaussians.means, G.means)
    np.testing.assert_allclose(found.gaussians.sh, G.sh, rtol=1e-6)
    assert (found.dropped, found.warnings) == (0, ())


@pytest.mark.parametrize("prefix", ["scalar_", "Scalar_", "scalar_scalar_"])
@pytest.mark.parametrize("plain", [("x", "y", "z"), (), ("x", "y", "z", "opacity", "rot_0")])
def test_the_prefix_of_cloudcompare_is_no_part_of_a_name(tmp_path: Path, prefix: str, plain: tuple[str, ...]):
    columns = {name if name in plain else prefix + name: values for name, values in inria_columns(G).items()}
    same(tmp_path / "a.ply", ply_bytes(columns))


def test_a_name_without_the_prefix_counts_before_one_with_it(tmp_path: Path):
    columns = {"scalar_opacity": np.zeros(20)} | inria_columns(G) | {"scalar_x": np.zeros(20)}
    same(tmp_path / "a.ply", ply_bytes(columns))


FACE = b"element face %d\nproperty list uchar int vertex_indices\n"
LISTS = b"element strip %d\nproperty list ushort float a\nproperty short b\nproperty list uint uchar c\n"


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("place", ["before", "after"])
@pytest.mark.parametrize("rows", [0, 2])
@pytest.mark.parametrize("element", [FACE, LISTS], ids=["face", "lists"])
def test_other_elements_may_stand_before_and_after(tmp_path: Path, form: str, place: str, rows: int, element: bytes):
    order = ">" if form == "binary_big_endian" else "<"
    header, _, body = ply_bytes(inria_columns(G), form).partition(b"end_header\n")
    if element is FACE:
        row, text = b"\x03" + np.arange(3, dtype=f"{order}i4").tobytes(), b"3 0 1 2\n"
    else:
        row = (
            np.array(2, f"{order}u2").tobytes()
            + np.ones(2, f"{order}f4").tobytes()
            + np.ones(1, f"{order}i2").tobytes()
        )
        row, text = row + np.array(5, f"{order}u4").tobytes() + b"12345", b"2 1 1 7 5 1 2 3 4 5\n"
    other, extra = element % rows, rows * (text if form == "ascii" else row)
    if place == "before":
        contents = header.replace(b"element vertex", other + b"element vertex") + b"end_header\n" + extra + body
    else:
        contents = header + other + b"end_header\n" + body + extra
    (tmp_path / "a.ply").write_bytes(contents)
    found = read_ply(tmp_path / "a.ply")
    assert np.array_equal(found.gaussians.means, G.means)
    assert [("strip" in warning) for warning in found.warnings] == [True] * (element is LISTS and rows > 0)


def test_a_list_beyond_the_end_is_a_cut_off_file(tmp_path: Path):
    header, _, body = ply_bytes(inria_columns(G)).partition(b"end_header\n")
    before = header.replace(b"element vertex", b"element face 2\nproperty list uint int i\nelement vertex")
    for row in (b"\xff\xff\xff\xff", b"\x04\0\0\0"):
        (tmp_path / "a.ply").write_bytes(before + b"end_header\n" + row + bytes(8) + body[:-8])
        with pytest.raises(ImportFailed, match=r"a\.ply: is cut off: "):
            read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("comment", ["by Γιώργος", "von Jörg, 20 °C", "東京"])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-16-be"])
@pytest.mark.parametrize("keyword", [b"comment ", b"obj_info "])
def test_comments_may_have_any_encoding(tmp_path: Path, comment: str, encoding: str, keyword: bytes):
    line = keyword + comment.encode(encoding, "replace").replace(b"\n", b"") + b"\n"
    same(tmp_path / "a.ply", ply_bytes(inria_columns(G)).replace(b"element", line + b"element", 1))


@pytest.mark.parametrize("form", FORMS)
def test_lines_of_a_header_may_end_as_on_windows_and_have_spaces(tmp_path: Path, form: str):
    header, end, body = ply_bytes(inria_columns(G), form).partition(b"end_header\n")
    same(tmp_path / "a.ply", (header + end).replace(b"\n", b" \r\n").replace(b"ply ", b"ply", 1) + body)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda c: c.replace(b"float z", b"float x"), "has the property `x` of `vertex` twice"),
        (lambda c: c.replace(b"float z", b"quad z"), "has a header line that can't be read: 'property quad z'"),
        (lambda c: c.replace(b"float z", b"list float int z"), "has a list whose length isn't an integer"),
        (lambda c: c.replace(b"float z", b"list uchar int z"), "has lists in `vertex`"),
        (
            lambda c: c.replace(b"vertex 20", b"vertex 2e1"),
            "has a header line that can't be read: 'element vertex 2e1'",
        ),
        (lambda c: c.replace(b"binary_little", b"binary_middle"), "has no header line `format` with one of ascii"),
        (lambda c: c.replace(b"end_header", b"end"), "isn't a whole PLY file: its header has no end"),
        (lambda c: c.replace(b"element vertex", b"element edge"), "has no element `vertex`, only edge"),
        (lambda c: c[:-1], "is cut off: 20 rows of `vertex` needs"),
    ],
)
def test_faults_are_told_in_words_of_ours(tmp_path: Path, change: Callable[[bytes], bytes], problem: str):
    (tmp_path / "a.ply").write_bytes(change(ply_bytes(inria_columns(G))))
    with pytest.raises(ImportFailed) as error:
        read_ply(tmp_path / "a.ply")
    assert problem in str(error.value)


@pytest.mark.parametrize("row", [b"1 2 3\n", b"a b c\n", b"1,2\n"])
def test_rows_of_text_that_are_no_numbers_are_told_in_words_of_ours(tmp_path: Path, row: bytes):
    (tmp_path / "a.ply").write_bytes(ply_bytes(inria_columns(G), "ascii", count=21) + row + bytes(200))
    with pytest.raises(ImportFailed, match=r"has a row of `vertex` that isn't 23 numbers"):
        read_ply(tmp_path / "a.ply")


NUMBERS = {"min_scale_x": 6, "min_scale_y": 7, "max_scale_x": 9, "min_x": 0, "max_y": 4, "min_r": 12}


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [-np.inf, np.inf, np.nan])
def test_infinite_ranges_of_a_compressed_ply_give_flat_gaussians_or_drop_them(tmp_path: Path, name: str, value: float):
    """Warnings are errors here, so that none of NumPy's reaches a user."""
    g = some_gaussians(300, 0)
    contents = compressed_ply_bytes(g)
    start = contents.index(b"end_header\n") + len(b"end_header\n")
    ranges = np.frombuffer(contents, "<f4", 36, start).copy()
    ranges[18 + NUMBERS[name]] = value  # of the second chunk, 44 Gaussians
    (tmp_path / "a.ply").write_bytes(contents[:start] + ranges.tobytes() + contents[start + ranges.nbytes :])
    found = read_ply(tmp_path / "a.ply")
    if "scale" in name and not np.isnan(value):
        assert 0 < found.dropped < 10  # where 0 is multiplied by infinity
        extreme = np.exp(np.sign(value) * LOG_SCALE_LIMIT)
        np.testing.assert_allclose(found.gaussians.scales[256:, "xyz".index(name[-1])], extreme, rtol=1e-6)
    else:
        assert found.dropped == 44
    assert len(found) + found.dropped == 300


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("pointer", [POINTER, POINTER.replace(b"\n", b"\r\n"), b"\xef\xbb\xbf" + POINTER])
def test_a_pointer_of_git_lfs_is_called_one(tmp_path: Path, kind: str, pointer: bytes):
    file = tmp_path / FORMATS[kind][0]
    file.write_bytes(pointer)
    for read in (detect_format, read_splats, lambda file: read_splats(file, file.suffix[1:])):
        with pytest.raises(ImportFailed, match=r"is a Git LFS pointer, .*`git lfs pull`"):
            read(file)


@pytest.mark.parametrize("name", ["meta.json", "quats.webp"])
def test_a_pointer_of_git_lfs_in_a_sog_folder_is_called_one(tmp_path: Path, name: str):
    folder = write_sog(tmp_path / "sog", some_gaussians(20, 0))
    (folder / name).write_bytes(POINTER)
    with pytest.raises(ImportFailed, match=rf"{name}: is a Git LFS pointer"):
        read_splats(folder)


def test_a_text_of_that_size_is_no_pointer(tmp_path: Path):
    file = write_splats(tmp_path, "ply", G)
    file.write_bytes(file.read_bytes().replace(b"element", b"comment version https://git-lfs.github.com\nelement", 1))
    assert len(read_splats(file)) == 20
