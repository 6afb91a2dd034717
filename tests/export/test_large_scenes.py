"""Imports that hold no more than the arrays of the scene: files read in parts, and scene files written from arrays."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from msdgs_export.cli.to_onnx import main
from msdgs_export.importers import command, scene
from msdgs_export.importers.scene import digest, pose_differences, static_scene
from msdgs_export.importers.splats import base, compressed_ply, ply
from msdgs_export.importers.splats.compressed_ply import CHUNK
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.jobs.write import properties, set_properties
from msdgs_export.options import ExportOptions
from msdgs_serve.scene.gaussians import Gaussians
from tests.support.splat_files import FORMATS, inria_columns, ply_bytes, some_gaussians, write_splats

FEW = 7
"""Gaussians per part."""


@pytest.mark.parametrize("kind", FORMATS)
def test_parts_make_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str):
    file = write_splats(tmp_path, kind, some_gaussians(CHUNK + FEW, 0 if kind == "splat" else 2))
    whole = read_splats(file).to_arrays()
    for module in (base, ply, compressed_ply):  # chunks of compressed files aren't split
        monkeypatch.setattr(module, "ROWS", CHUNK if kind == "compressed ply" else FEW)
    in_parts = read_splats(file).to_arrays()
    assert whole.keys() == in_parts.keys()
    for name, array in whole.items():
        np.testing.assert_array_equal(in_parts[name], array, strict=True)


def test_gaussians_that_cannot_be_drawn_are_left_out_of_each_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    columns = {name: values.copy() for name, values in inria_columns(some_gaussians(40, 1)).items()}
    bad = [0, 6, 7, *range(14, 21), 39]  # ends of parts, and one as a whole
    columns["x"][bad] = np.nan
    file = tmp_path / "a.ply"
    file.write_bytes(ply_bytes(columns))
    whole = read_splats(file)
    monkeypatch.setattr(base, "ROWS", FEW)
    monkeypatch.setattr(ply, "ROWS", FEW)
    found = read_splats(file)
    assert (len(found), found.dropped) == (40 - len(bad), len(bad))
    for name, array in vars(whole.gaussians).items():
        np.testing.assert_array_equal(getattr(found.gaussians, name), array, strict=True)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("packs", [False, True])
def test_a_file_written_from_arrays_has_the_bytes_of_protobuf(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, degree: int, packs: bool
):
    """With `packs`, of a scene with too many values to be stored in fewer bits."""
    file, out = write_splats(tmp_path, "ply", some_gaussians(40, degree)), tmp_path / "scene.onnx"
    monkeypatch.setattr(command, "MAX_VALUES", 40)
    assert main(ExportOptions(file, out, keep=() if packs else ("float32",))) == 0
    expected = static_scene(read_splats(file), digest(file))
    measured = properties(onnx.load(out))["measured_error"]
    set_properties(expected, measured_error=measured)
    assert out.read_bytes() == expected.SerializeToString()
    assert {name: measured[name] for name in ("means", "quats", "scales", "times")} == {
        "means": 0, "quats": 0, "scales": 0, "times": 1
    }  # fmt: skip


def test_a_difference_is_found_in_any_part(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(scene, "ROWS", FEW)
    g, bounds = some_gaussians(40, 0), [(-1, -1, -1), (1, 1, 1)]
    for row in (0, 6, 7, 39):
        for name, array in {"means": g.means, "quats": g.quats, "scales": g.scales}.items():
            changed = array.copy()
            changed[row, 0] += 0.25
            found = pose_differences(replace(g, **{name: changed}), g, bounds)
            assert [each for each, difference in found.items() if difference] == [name]
    assert set(pose_differences(g, g, bounds).values()) == {0.0}
    none = Gaussians(*(array[:0] for array in vars(g).values()))
    assert set(pose_differences(none, none, bounds).values()) == {0.0}
