"""Splats far from the origin or in other units are imported as what they show, and asked for in their own world."""

from pathlib import Path

import numpy as np
import pytest

from msdgs_export.cli.to_onnx import main as to_onnx
from msdgs_export.options import ExportOptions
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import Gaussians
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from tests.support.images import psnr
from tests.support.splat_files import inria_columns, some_gaussians
from tests.support.tolerances import tolerance

UP = np.array([0.0, -1.0, 0.0])
GAUSSIANS = some_gaussians(120, sh_degree=0)
PLACES = {
    "survey": Similarity(1.0, (500_123.4, 5_200_456.7, 812.3)),
    "metres of a microscope": Similarity(1e-5),
    "millimetres of a town": Similarity(1e6),
    "both": Similarity(1e-3, (40.0, -7.0, 1.0)),
}


def double_ply(g: Gaussians, place: Similarity) -> bytes:
    """A PLY of doubles, of Gaussians placed in another world."""
    columns = {name: np.asarray(values, np.float64) for name, values in inria_columns(g).items()}
    means = place.to_world(g.means)
    columns |= {axis: means[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"scale_{i}": columns[f"scale_{i}"] + np.log(place.scale) for i in range(3)}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(g)}"]
    header += [f"property double {name}" for name in columns] + ["end_header", ""]
    return "\n".join(header).encode() + np.stack(list(columns.values()), axis=1).astype("<f8").tobytes()


def imported(path: Path, out: Path) -> DeformationSession:
    assert to_onnx(ExportOptions(path, out, keep=("float32",))) == 0
    return DeformationSession(out)


def drawn(session: DeformationSession, place: Similarity, t: float = 0.0) -> np.ndarray:
    """A frame of a camera that is placed like the Gaussians."""
    camera = Camera.from_fov(orbit(np.zeros(3), 6.0, 30, 20, UP), 64, 48, 40.0)
    return Renderer().render(session, place.camera_to_world(camera), t).rgb


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    folder = tmp_path_factory.mktemp("plain")
    (folder / "a.ply").write_bytes(double_ply(GAUSSIANS, IDENTITY))
    session = imported(folder / "a.ply", folder / "a.onnx")
    assert session.scene.metadata.scene_to_world == IDENTITY
    return drawn(session, IDENTITY)


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_a_splat_is_drawn_as_at_the_origin(plain: np.ndarray, tmp_path: Path, place: Similarity):
    (tmp_path / "a.ply").write_bytes(double_ply(GAUSSIANS, place))
    session = imported(tmp_path / "a.ply", tmp_path / "a.onnx")
    assert psnr(drawn(session, place), plain) > tolerance("placed_splat_db")
    view = framing(session.scene.metadata)
    assert np.linalg.norm(place.to_scene(view.target)) < 1
    assert 1 < view.distance / place.scale < 10


@pytest.mark.parametrize("moves", [True, False], ids=["blended", "switched"])
@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_frames_of_a_sequence_stay_where_they_are(tmp_path: Path, place: Similarity, moves: bool):
    folders = {}
    for name, where in (("plain", IDENTITY), ("placed", place)):
        folders[name] = tmp_path / name
        folders[name].mkdir()
        for number in range(3):
            means = GAUSSIANS.means + np.float32(0.05 * number)
            count = None if moves else 100 + number
            arrays = {key: value[:count] for key, value in (vars(GAUSSIANS) | {"means": means}).items()}
            (folders[name] / f"f_{number}.ply").write_bytes(double_ply(Gaussians(**arrays), where))
    sessions = {name: imported(folder, tmp_path / f"{name}.onnx") for name, folder in folders.items()}
    for t in (0.0, 0.5, 1.0):
        got, want = drawn(sessions["placed"], place, t), drawn(sessions["plain"], IDENTITY, t)
        assert psnr(got, want) > tolerance("placed_splat_db")
