"""Scenes of SpacetimeGaussians: the graph computes its equations at any time."""

import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from msdgs_export.cli.export import export_or_import
from msdgs_export.exporters.command import convert
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.polynomial import polynomial_scene
from msdgs_export.importers.sequence import read_sequence
from msdgs_export.importers.splats.ply import read_ply
from msdgs_export.options import ConvertOptions, ExportOptions
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.quaternion import to_matrix
from tests.support.splat_files import drawn, inria_columns, ply_bytes, some_gaussians
from tests.support.tolerances import tolerance

COUNT = 300
QUIET = Console(quiet=True)


def columns() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    found = inria_columns(some_gaussians(COUNT, 0))
    found |= {f"motion_{i}": rng.normal(0, 0.3, COUNT) for i in range(9)}
    found |= {f"omega_{i}": rng.normal(0, 2, COUNT) for i in range(4)}
    return found | {"trbf_center": rng.uniform(0, 1, COUNT), "trbf_scale": rng.uniform(-3, 1, COUNT)}


def write(folder: Path, stored: dict[str, np.ndarray]) -> Path:
    (folder / "a.ply").write_bytes(ply_bytes(stored))
    return folder / "a.ply"


def session_of(file: Path) -> DeformationSession:
    contents = polynomial_scene(read_ply(file), "0" * 64).SerializeToString()
    return DeformationSession("a.onnx", contents=contents)


@pytest.mark.parametrize("t", [0.0, 0.37, 1.0])
def test_the_scene_follows_the_published_equations(tmp_path: Path, t: float):
    stored = columns()
    found = session_of(write(tmp_path, stored)).gaussians(t)
    for i in range(COUNT):
        since = t - stored["trbf_center"][i]
        for axis, name in enumerate("xyz"):
            steps = (stored[f"motion_{3 * power + axis}"][i] * since ** (power + 1) for power in range(3))
            assert found.means[i, axis] == pytest.approx(stored[name][i] + sum(steps), abs=tolerance("stored_frame"))
        quat = np.array([stored[f"rot_{k}"][i] + stored[f"omega_{k}"][i] * since for k in range(4)])
        rotation = to_matrix(quat / np.linalg.norm(quat))
        np.testing.assert_allclose(to_matrix(found.quats[i].astype(float)), rotation, atol=tolerance("stored_frame"))
        fading = np.exp(-((since / np.exp(stored["trbf_scale"][i])) ** 2))
        opacity = fading / (1 + np.exp(-stored["opacity"][i]))
        assert found.opacities[i] == pytest.approx(opacity, abs=tolerance("stored_frame"))


@pytest.mark.slow
def test_the_imported_file_is_compared_with_the_equations_and_can_be_converted(tmp_path: Path):
    options = ExportOptions(write(tmp_path, columns()), tmp_path / "a.onnx", duration=2.0, keep=("float32",))
    export_or_import(options, QUIET)
    metadata = DeformationSession(tmp_path / "a.onnx").scene.metadata
    assert (metadata.plan, metadata.contract) == ("polynomial", "msdgs/2")
    errors = [metadata.measured_error[name] for name in ("means", "quats", "scales", "opacities")]
    assert max(errors) <= tolerance("stored_frame")
    convert(ConvertOptions(tmp_path / "a.onnx", tmp_path / "a.spz", t=0.5), QUIET)


@pytest.mark.slow
def test_all_moments_are_finite_if_quaternions_turn_through_0_and_motion_is_short(tmp_path: Path):
    stored = columns()
    for i in range(4):
        stored[f"omega_{i}"] = -2 * stored[f"rot_{i}"]
    stored["trbf_center"][:], stored["trbf_scale"][:100] = 0.0, -1e30
    session = session_of(write(tmp_path, stored))
    for t in (0.0, 0.25, 0.5, 1.0):
        assert np.isfinite(drawn(session.gaussians(t).validate())).all()


def test_a_file_that_moves_is_no_frame_of_a_sequence(tmp_path: Path):
    for number in (1, 2):
        write(tmp_path, columns()).rename(tmp_path / f"frame_{number}.ply")
    with pytest.raises(ImportFailed, match=re.escape("frame_1.ply has Gaussians that move by themselves")):
        read_sequence(tmp_path)


def test_posing_many_gaussians_takes_operations_in_proportion(tmp_path: Path):
    few, many = (some_gaussians(count, 0) for count in (3_000, 6_000))
    costs = []
    for g in (few, many):
        stored = inria_columns(g) | {"trbf_center": np.zeros(len(g)), "trbf_scale": np.zeros(len(g))}
        costs.append(session_of(write(tmp_path, stored)).cost.operations)
    assert costs[1] <= 2 * costs[0]
