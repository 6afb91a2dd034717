"""Each field of the tables of SPZ, SOG, .ksplat and .splat, set to a value that shows what is done with it."""

import gzip
import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_export.importers.detect import detect_format
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats import ksplat, sog, splat, spz_container
from msdgs_export.importers.splats.base import Splats, as_float32
from msdgs_export.importers.splats.ksplat import read_ksplat
from msdgs_export.importers.splats.sog import read_sog
from msdgs_export.importers.splats.splat import read_splat
from msdgs_export.importers.splats.spz import read_spz
from msdgs_serve.scene.spherical_harmonics import SH_C0
from tests.support.splat_files import (
    assert_same,
    ksplat_bytes,
    some_gaussians,
    splat_bytes,
    spz3_bytes,
    spz4_bytes,
    spz_extensions,
    spz_levels_bytes,
    write_sog,
)

TABLES = (spz_container.FIELDS, sog.FIELDS, ksplat.FIELDS, splat.FIELDS)
COUNT = 12
GAUSSIANS = some_gaussians(COUNT, sh_degree=1)
GAUSSIANS = replace(GAUSSIANS, opacities=as_float32(np.round(127 * GAUSSIANS.opacities) * 2 / 255))  # bytes, and halves
SPZ = gzip.decompress(spz3_bytes(GAUSSIANS))
SPZ4 = spz4_bytes(SPZ)
KSPLAT = ksplat_bytes(GAUSSIANS, level=2)
SPLAT = splat_bytes(some_gaussians(COUNT, sh_degree=0))

Expected = str | Callable[[Splats], Splats]
"""What comes of a changed file: an error that matches, or what it makes of the result of the sound file."""


def same(sound: Splats) -> Splats:
    return sound


def but(**changes: Callable[[np.ndarray], Any]) -> Callable[[Splats], Splats]:
    """Return the sound result with changed arrays."""

    def changed(sound: Splats) -> Splats:
        arrays = {name: np.asarray(change(getattr(sound.gaussians, name).copy())) for name, change in changes.items()}
        return replace(sound, gaussians=replace(sound.gaussians, **arrays))

    return changed


def first(value: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return a change of the array's first row, or of the first SH coefficients in it."""

    def changed(array: np.ndarray) -> np.ndarray:
        array.reshape(COUNT, -1)[0, : np.size(value)] = value
        return array

    return changed


def mip(sound: Splats) -> Splats:
    return replace(sound, antialiasing="mip")


def rows(count: int) -> Callable[[Splats], Splats]:
    names = ("means", "quats", "scales", "opacities", "sh")
    return but(**dict.fromkeys(names, lambda array: array[:count]))


def patched(contents: bytes, at: int, layout: str, *values: float) -> bytes:
    changed = bytearray(contents)
    struct.pack_into(layout, changed, at, *values)
    return bytes(changed)


def spz_part(number: int, layout: str, *values: int) -> bytes:
    """Return an SPZ whose part, of positions, opacities, colors, scales, rotations and SH, begins with values."""
    return patched(SPZ, 16 + COUNT * sum((9, 1, 3, 3, 4)[:number]), layout, *values)


def with_extensions(extensions: dict[int, bytes]) -> bytes:
    return patched(SPZ, 14, "B", 2) + spz_extensions(extensions)


LEVELS = spz_levels_bytes(GAUSSIANS)
TREE = len(LEVELS) - 6 * (COUNT + 3)
RIGHT_DOWN_FRONT = {0xADBE0003: struct.pack("<I", 6)}
TURNED = but(
    means=lambda means: means * (1, -1, -1),
    quats=lambda quats: quats * (1, 1, -1, -1),
    sh=lambda sh: sh * np.array([1, -1, -1, 1])[:, None],
)
"""The arrays as they are stored, in the axes of SPZ."""

SPZ_CASES: dict[str, Sequence[tuple[bytes, Expected]]] = {
    "version": [(patched(SPZ, 4, "<I", v), rf"is SPZ version {v}; versions 2, 3 and 4 can be read") for v in (0, 1, 5)],
    "numPoints": [
        (patched(SPZ, 8, "<I", 13), "cut off: 13 Gaussians"),
        (patched(SPZ4, 8, "<I", 0), "holds no Gaussians"),
    ],
    "shDegree": [(patched(SPZ, 12, "B", 0), but(sh=lambda sh: sh[:, :1]))],
    "fractionalBits": [(patched(SPZ, 13, "B", SPZ[13] - 1), but(means=lambda means: 2 * means))],
    "flag 0x01": [(patched(SPZ, 14, "B", 1), mip), (patched(SPZ4, 14, "B", 1), mip)],
    "flag 0x02": [
        (with_extensions(RIGHT_DOWN_FRONT), TURNED),
        (with_extensions({})[:-1], "cut off"),
        (with_extensions(RIGHT_DOWN_FRONT)[:-3], "cut off: extension 0xADBE0003"),
        (patched(LEVELS, 14, "B", 0x82), "flag 0x80 for levels of detail together with flag 0x02"),
    ],
    "flag 0x80": [
        (LEVELS, same),
        (gzip.compress(LEVELS), same),
        (patched(SPZ, 14, "B", 0x80), "cut off: the tree of levels of detail"),
        (patched(SPZ4, 14, "B", 0x80), "flag 0x80 for levels of detail in version 4"),
    ],
    "flag *": [(patched(SPZ, 14, "B", bit), rf"has flag 0x{bit:02X}, which") for bit in (4, 8, 16, 32, 64)]
    + [(patched(SPZ4, 14, "B", 0x0D), "has flag 0x04, flag 0x08, which")],
    "reserved": [(patched(SPZ, 15, "B", 7), same), (patched(SPZ4, 31, "B", 7), same)],
    "numStreams": [(patched(SPZ4, 15, "B", 5), "has 5 streams; SH of degree 1 needs 6")],
    "tocByteOffset": [
        (spz4_bytes(SPZ, {0xADBE0002: bytes(12)}), same),
        (patched(SPZ4, 16, "<I", 16), "the table of streams"),
    ],
    "positions": [(spz_part(0, "3B", 0, 0, 0), but(means=first(0)))],
    "alphas": [(spz_part(1, "B", 255), but(opacities=first(1)))],
    "colors": [(spz_part(2, "3B", 0, 0, 0), but(sh=first([-0.5 / 0.15] * 3)))],
    "scales": [(spz_part(3, "3B", 160, 160, 160), but(scales=first([1, 1, 1])))],
    "rotations": [(spz_part(4, "<I", 3 << 30), but(quats=first([1, 0, 0, 0])))],
    "sh": [
        (SPZ[: -9 * COUNT] + bytes([128]) * 9 * COUNT, but(sh=lambda sh: np.pad(sh[:, :1], ((0, 0), (0, 3), (0, 0)))))
    ],
    "childCounts": [(patched(LEVELS, TREE, "<H", n), "aren't one whole tree") for n in (0, 1, 3)],
    "childStarts": [
        (patched(LEVELS, TREE + 2 * (COUNT + 3), "<I", start), "aren't one whole tree")
        for start in (2, COUNT + 3, 65_536)
    ],
    "extension 0xADBE0002": [(with_extensions({0xADBE0002: struct.pack("<3f", -1, 1, 2)}), same)],
    "extension 0xADBE0003": [
        (spz4_bytes(SPZ, RIGHT_DOWN_FRONT), TURNED),
        (spz4_bytes(SPZ, {0x12340001: b"more", **RIGHT_DOWN_FRONT}), TURNED),
        (spz4_bytes(SPZ, {0xADBE0003: struct.pack("<I", 4)}), same),
        (spz4_bytes(SPZ, {0xADBE0003: struct.pack("<I", 0)}), same),
        (spz4_bytes(SPZ, {0xADBE0003: struct.pack("<I", 17)}), "states coordinate system 17; 1 to 16 are defined"),
        (spz4_bytes(SPZ, {0xADBE0003: b"\4"}), "cut off: extension 0xADBE0003"),
    ],
}

HEAD, DATA = 4096, 4096 + 1024
CENTERS = np.repeat(np.frombuffer(KSPLAT, "<f4", 12, DATA + 8).reshape(4, 3), (4, 4, 1, 3), axis=0)
LOW, HIGH = struct.unpack_from("<2f", KSPLAT, 36)


def rescaled(low: float, high: float) -> Callable[[Splats], Splats]:
    """Return the sound result with SH whose range is another."""

    def change(sh: np.ndarray) -> np.ndarray:
        sh[:, 1:] = low + (sh[:, 1:] - LOW) / (HIGH - LOW) * (high - low)
        return sh

    return but(sh=change)


KSPLAT_CASES: dict[str, Sequence[tuple[bytes, Expected]]] = {
    "versionMajor": [(patched(KSPLAT, 0, "B", 1), "is .ksplat version 1.1; version 0.1 can be read")],
    "versionMinor": [(patched(KSPLAT, 1, "B", 2), "is .ksplat version 0.2; version 0.1 can be read")],
    "maxSectionCount": [
        (patched(KSPLAT, 4, "<I", 1000), "the headers of 1,000 sections"),
        (patched(KSPLAT, 4, "<I", 0), "states 12 Gaussians; its 0 sections have 0"),
    ],
    "sectionCount": [(patched(KSPLAT, 8, "<I", 0), same)],
    "maxSplatCount": [(patched(KSPLAT, 12, "<I", 99), same)],
    "splatCount": [(patched(KSPLAT, 16, "<I", 11), "states 11 Gaussians; its 1 sections have 12")],
    "compressionLevel": [(patched(KSPLAT, 20, "<H", 3), "has compression level 3; 0, 1 and 2 are defined")],
    "sceneCenter": [(patched(KSPLAT, 24, "<3f", 7, 8, 9), same)],
    "minSphericalHarmonicsCoeff": [
        (patched(KSPLAT, 36, "<f", -3), rescaled(-3, HIGH)),
        (patched(KSPLAT, 36, "<f", 0), rescaled(-1.5, HIGH)),
    ],
    "maxSphericalHarmonicsCoeff": [
        (patched(KSPLAT, 40, "<f", 3), rescaled(LOW, 3)),
        (patched(KSPLAT, 40, "<f", 0), rescaled(LOW, 1.5)),
    ],
    "section splatCount": [
        (patched(patched(KSPLAT, 16, "<I", 11), HEAD, "<I", 11), rows(11)),
        (patched(KSPLAT, HEAD, "<I", 13), "13 Gaussians, room for 12"),
    ],
    "section maxSplatCount": [(patched(KSPLAT, HEAD + 4, "<I", 13), "cut off: section 0")],
    "section bucketSize": [(patched(KSPLAT, HEAD + 8, "<I", 1), "of which 4 are filled with 6")],
    "section bucketCount": [(patched(KSPLAT, HEAD + 12, "<I", 3), "12 Gaussians and 3 buckets, of which 4")],
    "section bucketBlockSize": [(patched(KSPLAT, HEAD + 16, "<f", 0), but(means=lambda means: CENTERS))],
    "section bucketStorageSizeBytes": [(patched(KSPLAT, HEAD + 20, "<H", 16), "buckets of 16 bytes instead of 12")],
    "section compressionScaleRange": [
        (patched(KSPLAT, HEAD + 24, "<I", 15_000), but(means=lambda means: 2 * means - CENTERS + 2))
    ],
    "section storageSizeBytes": [(patched(KSPLAT, HEAD + 28, "<I", 0), same)],
    "section fullBucketCount": [(patched(KSPLAT, HEAD + 32, "<I", 1), "of which 3 are filled with 8")],
    "section partiallyFilledBucketCount": [(patched(KSPLAT, HEAD + 36, "<I", 1), "of which 3 are filled with 9")],
    "section sphericalHarmonicsDegree": [
        (patched(KSPLAT, HEAD + 40, "<H", 3), "SH of degree 3; 0, 1 and 2 are defined")
    ],
}

SPLAT_CASES: dict[str, Sequence[tuple[bytes, Expected]]] = {
    "position": [(patched(SPLAT, 0, "<3f", 7, 8, 9), but(means=first([7, 8, 9])))],
    "scale": [(patched(SPLAT, 12, "<3f", 1, 2, 3), but(scales=first([1, 2, 3])))],
    "color": [(patched(SPLAT, 24, "3B", 255, 0, 255), but(sh=first(np.array([0.5, -0.5, 0.5]) / SH_C0)))],
    "opacity": [(patched(SPLAT, 27, "B", 255), but(opacities=first(1)))],
    "rotation": [(patched(SPLAT, 28, "4B", 128, 128, 128, 0), but(quats=first([0, 0, 0, -1])))],
}


def without_sh(sh: np.ndarray) -> np.ndarray:
    sh[:, 1:] = 0
    return sh


ZEROS = [0.0] * 256
SOG_CASES: dict[str, Sequence[tuple[Any, Expected]]] = {
    "version": [(v, rf"is SOG of version {v}; version 2 can be read") for v in (1, 3)]
    + [(None, "is SOG of version 1; version 2 can be read")],
    "count": [(11, rows(11))],
    "antialias": [(True, mip), ("yes", "`antialias` must be true or false")],
    "model": [("antialiased", mip)],
    "asset": [({"generator": "splat-transform v3.7.0"}, same)],
    "extras": [({"version": 7}, same)],
    "means.mins": [([0, 0, 0], but(means=lambda means: np.expm1(np.log1p(2) * unit(means))))],
    "means.maxs": [([0, 0, 0], but(means=lambda means: -np.expm1(np.log1p(2) * (1 - unit(means)))))],
    "scales.codebook": [(ZEROS, but(scales=np.ones_like))],
    "sh0.codebook": [(ZEROS, but(sh=lambda sh: sh * [[0], [1], [1], [1]]))],
    "shN.codebook": [(ZEROS, but(sh=without_sh))],
    "shN.count": [(1, "of a palette of 1")],
    "shN.bands": [(2, "its texture shN_centroids.webp has .* pixels for")],
    **{
        f"{part}.files": [(["gone.webp"] * count, "lacks gone.webp"), ("a.webp", rf"`{part}.files` must be a list")]
        for part, count in {"means": 2, "scales": 1, "quats": 1, "sh0": 1, "shN": 2}.items()
    },
}


def unit(means: np.ndarray) -> np.ndarray:
    """Positions of the sound SOG, from −2 to 2 and stored as logarithms, as fractions of the range."""
    return (np.sign(means) * np.log1p(np.abs(means)) / np.log1p(2) + 1) / 2


def read_changed_sog(folder: Path, field: str, value: Any) -> Splats:
    meta = json.loads((folder / "meta.json").read_text())
    part, _, name = field.rpartition(".")
    (meta[part] if part else meta)[name] = value
    (folder / "meta.json").write_text(json.dumps(meta))
    return read_sog(folder)


def results(tmp_path: Path, name: str, field: str) -> tuple[Splats, list[tuple[Callable[[], Splats], Expected]]]:
    """Return the sound result of a format, and a reader and what is expected of each file with a changed field."""
    if name == "SOG":
        far = GAUSSIANS.means.copy()
        far[:2] = (-2, -2, -2), (2, 2, 2)
        sound, *folders = (
            write_sog(tmp_path / str(i), replace(GAUSSIANS, means=far)) for i in range(1 + len(SOG_CASES[field]))
        )
        values = zip(folders, SOG_CASES[field], strict=True)
        return read_sog(sound), [(partial(read_changed_sog, f, field, value), want) for f, (value, want) in values]
    read, contents, cases = {
        "SPZ": (read_spz, SPZ, SPZ_CASES),
        ".ksplat": (read_ksplat, KSPLAT, KSPLAT_CASES),
        ".splat": (read_splat, SPLAT, SPLAT_CASES),
    }[name]

    def result(contents: bytes) -> Splats:
        (tmp_path / "a").write_bytes(contents)
        return read(tmp_path / "a")

    return result(contents), [(partial(result, changed), want) for changed, want in cases[field]]


@pytest.mark.parametrize(("name", "field"), [(table.format, field) for table in TABLES for field in table.uses])
def test_each_field_is_used_as_its_table_says(tmp_path: Path, name: str, field: str):
    (table,) = (table for table in TABLES if table.format == name)
    sound, changed = results(tmp_path, name, field)
    assert not sound.warnings
    for read, expected in changed:
        if isinstance(expected, str):
            assert table.uses[field] != "harmless"
            with pytest.raises(ImportFailed, match=expected):
                read()
        else:
            assert table.uses[field] != "refused"
            got, want = read(), expected(sound)
            assert_same(got.gaussians, want.gaussians)
            assert got.antialiasing == want.antialiasing
    if table.uses[field] == "applied":
        assert any(expected is not same for _, expected in changed)


@pytest.mark.parametrize(
    ("contents", "warning"),
    [
        (patched(SPZ, 15, "B", 7), "its reserved bytes aren't 0"),
        (patched(SPZ4, 20, "B", 7), "its reserved bytes aren't 0"),
        (SPZ + b"more", "its version doesn't define 4 of its bytes"),
        (gzip.compress(SPZ + b"more"), "its version doesn't define 4 of its bytes"),
        (with_extensions({0x12340001: b"more"}), "its extension 0x12340001 isn't known and is left out"),
        (gzip.compress(with_extensions({0x12340001: b""})), "its extension 0x12340001 isn't known and is left out"),
        (spz4_bytes(SPZ, {0xADBE0004: b"more"}), "its extension 0xADBE0004 isn't known and is left out"),
        (spz4_bytes(SPZ, {0xADBE0003: bytes(4)}), "its coordinate system is unspecified"),
        (spz4_bytes(SPZ, {0xADBE0003: b"\x0a\0\0\0"}), "its coordinate system RFD is read as RBU"),
    ],
    ids=lambda value: "spz" if isinstance(value, bytes) else value,
)
def test_what_an_spz_says_in_unknown_words_is_warned_about(tmp_path: Path, contents: bytes, warning: str):
    (tmp_path / "a.spz").write_bytes(contents)
    (said,) = read_spz(tmp_path / "a.spz").warnings
    assert warning in said


def test_streams_that_no_version_of_spz_has_are_warned_about(tmp_path: Path):
    table_end = 32 + 6 * 16
    (tmp_path / "a.spz").write_bytes(patched(SPZ4, 15, "B", 7)[:table_end] + bytes(16) + SPZ4[table_end:])
    assert read_spz(tmp_path / "a.spz").warnings == ("it has 7 streams, of which only the first 6 are known and read",)


def test_more_than_extensions_behind_an_spz_is_refused(tmp_path: Path):
    (tmp_path / "a.spz").write_bytes(gzip.compress(SPZ + bytes(spz_container.MAX_EXTENSIONS + 1)))
    with pytest.raises(ImportFailed, match=r"has more than 1,048,576 bytes behind its 12 Gaussians"):
        read_spz(tmp_path / "a.spz")


def test_unturned_axes_stay_though_an_extension_names_them(tmp_path: Path):
    (tmp_path / "a.spz").write_bytes(spz4_bytes(SPZ, {0xADBE0003: struct.pack("<I", 7)}))
    read = read_spz(tmp_path / "a.spz", converted=False)
    (warning,) = read.warnings
    assert "states the coordinate system LUF, which spz:unturned leaves as it is" in warning
    (tmp_path / "a.spz").write_bytes(SPZ)
    assert_same(read.gaussians, read_spz(tmp_path / "a.spz", converted=False).gaussians)


@pytest.mark.parametrize("at", [2, 100, 4000, HEAD + 60, HEAD + 1023])
def test_bytes_of_a_ksplat_that_its_version_does_not_define_are_warned_about(tmp_path: Path, at: int):
    (tmp_path / "a.ksplat").write_bytes(patched(KSPLAT, at, "B", 1))
    assert read_ksplat(tmp_path / "a.ksplat").warnings == (
        "it has bytes that version 0.1 doesn't define; they are left out",
    )


def test_sections_of_a_ksplat_may_be_empty_or_of_other_degrees(tmp_path: Path):
    g = some_gaussians(2, sh_degree=1)
    contents = ksplat_bytes(g, level=0, sections=3)  # of 1, 1 and no Gaussians
    (tmp_path / "a.ksplat").write_bytes(contents)
    assert len(read_ksplat(tmp_path / "a.ksplat")) == 2
    second, row = HEAD + 1024, 44 + 9 * 4
    (tmp_path / "a.ksplat").write_bytes(patched(contents, second + 40, "<H", 0)[: HEAD + 3 * 1024 + row + 44])
    read = read_ksplat(tmp_path / "a.ksplat").gaussians
    np.testing.assert_array_equal(read.sh[:, 1:], [g.sh[0, 1:], np.zeros((3, 3))])


@pytest.mark.parametrize(
    ("field", "value", "warning"),
    [
        ("transform", [1, 2, 3], "meta.json has `transform`, which isn't known and is left out"),
        ("scales.mins", [0, 0, 0], "meta.json has `scales.mins`, which isn't known and is left out"),
        ("shN.rotation", {}, "meta.json has `shN.rotation`, which isn't known and is left out"),
        ("model", "3dgrt", "meta.json has the unknown `model` '3dgrt', which is drawn as `default`"),
        ("model", "2dgs", "the Gaussians are 2D (`model` 2dgs) and are drawn as 3D ones that are nearly flat"),
    ],
)
def test_what_a_sog_says_in_unknown_words_is_warned_about(tmp_path: Path, field: str, value: Any, warning: str):
    folder = write_sog(tmp_path / "sog", GAUSSIANS)
    assert read_changed_sog(folder, field, value).warnings == (warning,)


@pytest.mark.parametrize("form", ["folder", "file", "zip"])
def test_a_streamed_sog_is_refused_by_name(tmp_path: Path, form: str):
    folder = write_sog(tmp_path / "sog", GAUSSIANS).parent
    (folder / "lod-meta.json").write_text('{"version": 1, "lodLevels": 1, "filenames": ["sog/meta.json"], "tree": {}}')
    if form == "zip":
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            for name in ("lod-meta.json", "sog/meta.json"):
                archive.write(folder / name, name)
    path = {"folder": folder, "file": folder / "lod-meta.json", "zip": tmp_path / "a.zip"}[form]
    assert read_sog(folder / "sog").warnings == ("it is a piece of the streamed SOG of the lod-meta.json above it",)
    with pytest.raises(ImportFailed, match=r"is a streamed SOG \(lod-meta.json\); .* splat-transform -L 0"):
        detect_format(path)
