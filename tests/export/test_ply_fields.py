"""Each property of a PLY that programs in use write is applied, refused by name, or harmless; others are named."""

import re
from pathlib import Path

import numpy as np
import pytest

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats.base import LOG_SCALE_LIMIT, Splats
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.importers.splats.ply_fields import PLY
from msdgs_export.importers.splats.spacetime import Spacetime
from msdgs_serve.scene.spherical_harmonics import SH_C0
from tests.support.splat_files import compressed_ply_bytes, inria_columns, ply_bytes, some_gaussians
from tests.support.tolerances import tolerance

Columns = dict[str, np.ndarray]
COUNT = 12
RNG = np.random.default_rng(3)


def columns(sh_degree: int = 1) -> Columns:
    return inria_columns(some_gaussians(COUNT, sh_degree))


def read(folder: Path, stored: Columns) -> Splats:
    (folder / "a.ply").write_bytes(ply_bytes(stored))
    return read_splats(folder / "a.ply")


def telling(count: int = COUNT) -> np.ndarray:
    """Return values that no array holds by chance."""
    return RNG.uniform(0.1, 0.6, count)


def spacetime(motion: int = 9, omega: int = 4) -> Columns:
    """Return the properties that SpacetimeGaussians adds."""
    names = [*(f"motion_{i}" for i in range(motion)), *(f"omega_{i}" for i in range(omega))]
    return {name: telling() for name in (*names, "trbf_center", "trbf_scale")}


def named(pattern: str) -> str:
    return pattern.replace("*", "7")


INRIA = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_*", "opacity")
INRIA += ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


@pytest.mark.parametrize("pattern", INRIA)
def test_fields_of_inria_are_applied(tmp_path: Path, pattern: str):
    stored = columns()
    before = read(tmp_path, stored).to_arrays()
    stored[named(pattern)] = stored[named(pattern)] + 0.25
    after = read(tmp_path, stored).to_arrays()
    assert any(
        not np.array_equal(after[name], before[name]) for name in ("means", "quats", "scales", "opacities", "sh")
    )


@pytest.mark.parametrize("name", ["filter_3D", "scalar_filter_3D"])
def test_the_3d_filter_of_mip_splatting_is_applied(tmp_path: Path, name: str):
    g, width = some_gaussians(COUNT), telling()
    found = read(tmp_path, inria_columns(g) | {name: width}).gaussians
    squared = np.square(g.scales.astype(np.float64))
    wider = squared + np.square(width)[:, None]
    kept = np.sqrt(squared.prod(axis=1) / wider.prod(axis=1))
    np.testing.assert_allclose(found.scales, np.sqrt(wider), rtol=tolerance("splat_values"))
    np.testing.assert_allclose(found.opacities, g.opacities * kept, rtol=tolerance("splat_values"))


@pytest.mark.parametrize("width", [0.0, 1e-30, np.nan, np.inf, -0.3, 1e30])
def test_a_3d_filter_of_any_width_gives_gaussians_or_drops_them(tmp_path: Path, width: float):
    widths = np.full(COUNT, 0.1)
    widths[0] = width
    found = read(tmp_path, columns() | {"filter_3D": widths})
    assert (found.dropped, len(found)) == ((1, COUNT - 1) if np.isnan(width) else (0, COUNT))
    if 0 <= width < 1e-20:
        np.testing.assert_allclose(found.gaussians.scales[0], some_gaussians(COUNT).scales[0], rtol=1e-6)


@pytest.mark.parametrize("kind", ["<f4", "u1", "<u2", "<i4"])
def test_colors_stand_for_sh_of_degree_0_if_there_is_none(tmp_path: Path, kind: str):
    stored = columns(0)
    colors = RNG.integers(0, 256, (3, COUNT))
    plain = {name: values for name, values in stored.items() if not name.startswith("f_dc")}
    largest = 65535 if kind == "<u2" else 255
    types = {name: kind if name in ("red", "green", "blue") else "<f4" for name in [*plain, "red", "green", "blue"]}
    rows = np.empty(COUNT, list(types.items()))
    scaled = colors / 255 if kind == "<f4" else np.round(colors / 255 * largest)
    for name, values in (plain | dict(zip(("red", "green", "blue"), scaled, strict=True))).items():
        rows[name] = values
    ply = {"<f4": "float", "u1": "uchar", "<u2": "ushort", "<i4": "int"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {COUNT}"]
    lines += [f"property {ply[kind]} {name}" for name, kind in types.items()]
    (tmp_path / "a.ply").write_bytes("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())
    found = read_splats(tmp_path / "a.ply")
    np.testing.assert_allclose(found.gaussians.sh[:, 0] * SH_C0 + 0.5, colors.T / 255, atol=tolerance("splat_values"))
    assert found.warnings == ()


def test_colors_of_floats_that_are_bytes_are_refused(tmp_path: Path):
    plain = {name: values for name, values in columns(0).items() if not name.startswith("f_dc")}
    with pytest.raises(ImportFailed, match="`red` is up to 200; as float, colors are from 0 to 1"):
        read(tmp_path, plain | dict.fromkeys(("red", "green", "blue"), np.full(COUNT, 200.0)))


def test_values_that_look_activated_are_told(tmp_path: Path):
    stored = columns()
    stored |= {name: np.exp(stored[name]) for name in ("scale_0", "scale_1", "scale_2")}
    assert not any("logarithms and logits" in warning for warning in read(tmp_path, stored).warnings)
    stored["opacity"] = 1 / (1 + np.exp(-stored["opacity"]))
    assert any("logarithms and logits" in warning for warning in read(tmp_path, stored).warnings)


def test_sh_of_degree_4_are_named(tmp_path: Path):
    with pytest.raises(ImportFailed, match="has SH of degree 4; up to 3 can be read: write it with fewer"):
        read(tmp_path, columns(0) | {f"f_rest_{i}": telling() for i in range(72)})


@pytest.mark.parametrize("name", ["red", "green", "blue"])
def test_colors_beside_sh_change_nothing(tmp_path: Path, name: str):
    assert np.array_equal(
        read(tmp_path, columns() | {name: telling()}).gaussians.sh, read(tmp_path, columns()).gaussians.sh
    )


def test_surfels_of_2dgs_are_flat_gaussians_and_say_so(tmp_path: Path):
    stored = columns()
    del stored["scale_2"]
    found = read(tmp_path, stored)
    assert np.array_equal(found.gaussians.scales[:, :2], read(tmp_path, columns()).gaussians.scales[:, :2])
    np.testing.assert_allclose(found.gaussians.scales[:, 2], np.exp(-LOG_SCALE_LIMIT), rtol=1e-6)
    assert "2DGS" in found.warnings[0]


@pytest.mark.parametrize("name", sorted(spacetime()))
def test_fields_of_spacetime_gaussians_are_applied(tmp_path: Path, name: str):
    stored, added = columns(0), spacetime()
    found = read(tmp_path, stored | added)
    changed = read(tmp_path, stored | added | {name: added[name] + 0.25})
    assert found.motion is not None
    assert changed.motion is not None
    assert (found.motion != changed.motion).any(axis=0).sum() == 1
    assert found.warnings == ()


def test_colors_of_spacetime_gaussians_are_colors_and_quaternions_may_have_any_length(tmp_path: Path):
    stored, added = columns(0), spacetime()
    longer = stored | {f"rot_{i}": 5 * stored[f"rot_{i}"] for i in range(4)}
    longer |= added | {f"omega_{i}": 5 * added[f"omega_{i}"] for i in range(4)}
    (short, long) = (read(tmp_path, each) for each in (stored | added, longer))
    assert short.motion is not None
    assert long.motion is not None
    np.testing.assert_allclose(Spacetime.of(long.motion).omega, Spacetime.of(short.motion).omega, rtol=1e-5)
    colors = np.stack([stored[f"f_dc_{i}"] for i in range(3)], axis=1)
    np.testing.assert_allclose(short.gaussians.sh[:, 0] * SH_C0 + 0.5, colors, atol=tolerance("splat_values"))
    with_sh = read(tmp_path, columns(1) | added).gaussians.sh
    assert np.array_equal(with_sh, some_gaussians(COUNT, 1).sh)


@pytest.mark.parametrize(("motion", "omega"), [(3, 4), (6, 0), (0, 4), (0, 0)])
def test_motion_of_lower_degree_is_that_with_zeros(tmp_path: Path, motion: int, omega: int):
    found = read(tmp_path, columns(0) | spacetime(motion, omega)).motion
    assert found is not None
    parts = Spacetime.of(found)
    assert (parts.motion != 0).any(axis=0).sum() == motion
    assert (parts.omega != 0).any(axis=0).sum() == omega


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"trbf_center": None}, "no `trbf_center`"),
        ({"trbf_scale": None}, "no `trbf_scale`"),
        ({"motion_8": None}, "has 8 of `motion_…`"),
        ({"motion_9": telling()}, "has 10 of `motion_…`"),
        ({"omega_3": None}, "3 of `omega_…`"),
    ],
)
def test_a_part_of_a_motion_is_refused(tmp_path: Path, change: dict[str, np.ndarray | None], problem: str):
    stored = columns(0) | spacetime() | change
    with pytest.raises(ImportFailed, match=problem):
        read(tmp_path, {name: values for name, values in stored.items() if values is not None})


def test_motions_without_numbers_are_dropped(tmp_path: Path):
    added = spacetime()
    for row, (name, value) in enumerate({"motion_4": np.nan, "trbf_center": 1e6, "trbf_scale": np.nan}.items()):
        added[name][row] = value
    assert read(tmp_path, columns(0) | added).dropped == 3


@pytest.mark.parametrize("pattern", [name for name, use in PLY.uses.items() if use == "refused"])
@pytest.mark.parametrize("prefix", ["", "scalar_"])
def test_refused_fields_are_named_with_what_they_are(tmp_path: Path, pattern: str, prefix: str):
    with pytest.raises(ImportFailed, match=rf"a\.ply: has `{named(pattern)}`, .*plain Gaussians"):
        read(tmp_path, columns() | {prefix + named(pattern): telling()})


@pytest.mark.parametrize("pattern", [name for name, use in PLY.uses.items() if use == "harmless"])
def test_harmless_fields_change_nothing(tmp_path: Path, pattern: str):
    plain, more = read(tmp_path, columns()), read(tmp_path, columns() | {named(pattern): telling()})
    assert more.warnings == ()
    assert all(np.array_equal(array, more.to_arrays()[name]) for name, array in plain.to_arrays().items())


@pytest.mark.parametrize("name", ["filter_2D", "opacity_dyn", "scalar_Distance", "f_new_0"])
def test_unlisted_fields_are_named(tmp_path: Path, name: str):
    (warning,) = read(tmp_path, columns() | {name: telling()}).warnings
    assert f"`{name.removeprefix('scalar_')}`" in warning


def test_many_unlisted_fields_and_unlisted_elements_are_named_in_one_line(tmp_path: Path):
    contents = ply_bytes(columns() | {f"new_{i}": telling() for i in range(100)})
    other = b"element boxes 1\nproperty list uchar float corner\nelement spare 0\nproperty float a\nend_header\n"
    (tmp_path / "a.ply").write_bytes(contents.replace(b"end_header\n", other) + b"\0")
    (warning,) = read_splats(tmp_path / "a.ply").warnings
    assert re.search(r"`new_0`, .* and 93 more: ", warning)


PACKED = {"packed_position": "means", "packed_rotation": "quats", "packed_scale": "scales", "packed_color": "sh"}


@pytest.mark.parametrize("name", PACKED)
def test_packed_fields_are_applied(tmp_path: Path, name: str):
    contents = bytearray(compressed_ply_bytes(some_gaussians(COUNT, 0)))
    (tmp_path / "a.ply").write_bytes(contents)
    before = read_splats(tmp_path / "a.ply").to_arrays()
    contents[-16 * COUNT + 4 * list(PACKED).index(name) + 3] ^= 16
    (tmp_path / "a.ply").write_bytes(contents)
    after = read_splats(tmp_path / "a.ply")
    assert not np.array_equal(after.to_arrays()[PACKED[name]][0], before[PACKED[name]][0])
    assert after.warnings == ()


@pytest.mark.parametrize("place", range(18))
def test_ranges_of_packed_fields_are_applied(tmp_path: Path, place: int):
    contents = compressed_ply_bytes(some_gaussians(COUNT, 0))
    start = contents.index(b"end_header\n") + len(b"end_header\n")
    numbers = np.frombuffer(contents, "<f4", 18, start).copy()
    numbers[place] += 0.5
    (tmp_path / "a.ply").write_bytes(contents)
    before = read_splats(tmp_path / "a.ply").to_arrays()
    (tmp_path / "a.ply").write_bytes(contents[:start] + numbers.tobytes() + contents[start + numbers.nbytes :])
    after = read_splats(tmp_path / "a.ply").to_arrays()
    assert not np.array_equal(
        after[("means", "scales", "sh")[place // 6]], before[("means", "scales", "sh")[place // 6]]
    )
