"""Scenes of the benchmark: seeded ones, and splat files."""

from pathlib import Path

import numpy as np

from benchmarks.browser.pages import Scene
from benchmarks.rasterizer.scenes import object_scene
from msdgs_export.exporters.ply import write_ply
from msdgs_export.importers.polynomial import polynomial_scene
from msdgs_export.importers.scene import static_scene
from msdgs_export.importers.splats.base import Splats
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.importers.splats.ply import read_ply
from msdgs_serve.deformation import DeformationSession
from tests.support.splat_files import inria_columns, ply_bytes

CHECKSUM = "0" * 64


def static(folder: Path, count: int, seed: int = 0) -> Scene:
    """A seeded object with SH of degree 3, and its splats as PLY."""
    gaussians = object_scene(count, seed)
    write_ply(folder / "object.ply", gaussians)
    contents = static_scene(Splats(gaussians), CHECKSUM).SerializeToString()
    return _scene(folder / "object.onnx", contents, folder / "object.ply")


def imported(folder: Path, splats: Path) -> Scene:
    """A splat file of any format."""
    contents = static_scene(read_splats(splats), CHECKSUM).SerializeToString()
    return _scene(folder / f"{splats.stem}.onnx", contents)


def fading(folder: Path, count: int, seed: int = 0) -> Scene:
    """A seeded object whose splats move, turn and fade by the equations of SpacetimeGaussians."""
    rng = np.random.default_rng(seed)
    columns = inria_columns(object_scene(count, seed))
    columns = {name: values for name, values in columns.items() if not name.startswith("f_rest_")}
    columns["opacity"] = columns["opacity"].clip(-10, 10)
    columns |= {f"motion_{i}": rng.normal(0, 0.2, count) for i in range(9)}
    columns |= {f"omega_{i}": rng.normal(0, 1, count) for i in range(4)}
    columns |= {"trbf_center": rng.uniform(0, 1, count), "trbf_scale": rng.uniform(-2, 1, count)}
    (folder / "fading.ply").write_bytes(ply_bytes(columns))
    return _scene(
        folder / "fading.onnx", polynomial_scene(read_ply(folder / "fading.ply"), CHECKSUM).SerializeToString()
    )


def copied(folder: Path, scene: Path) -> Scene:
    """A scene file."""
    return _scene(folder / scene.name, scene.read_bytes())


def _scene(file: Path, contents: bytes, splats: Path | None = None) -> Scene:
    file.write_bytes(contents)
    return Scene(file, DeformationSession(file), splats)
