"""Scene files of imported Gaussians: metadata, and the check of a file before it replaces an old one."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from msdgs_export.bake import Baked, Moving
from msdgs_export.importers.placement import placement
from msdgs_export.importers.splats.base import ROWS, UNUSABLE, Splats
from msdgs_export.jobs.packing import stored_anew
from msdgs_export.jobs.write import properties, set_properties, storage_differences, write_measured
from msdgs_export.measure.poses import half_diagonal
from msdgs_export.plans.base import BASELINE
from msdgs_export.plans.registry import build
from msdgs_serve import __version__
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import CONTRACT, MOVING_OUTPUTS, BakedScene, SceneCamera, SceneMetadata
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from msdgs_serve.writing import replacing

WITHIN = (0.01, 0.99)
"""Quantiles of the centers along each axis that make the bounds, since strays of a trained scene are often far away."""

UP = np.array([0.0, -1.0, 0.0])
"""Up axis of files that don't name one: COLMAP's, which INRIA's trainer and most others use."""

CAMERAS, SIZE, FOV_Y, ELEVATION = 6, 800, 50.0, 15.0
"""Number, pixels and degrees of starting cameras on a circle, since the files hold none."""

DISTANCE = 2.2
"""Distance of these cameras from the middle, in half diagonals of the bounds."""


def static_scene(source: Splats, sha256: str) -> onnx.ModelProto:
    """The scene file of one set of Gaussians, in which nothing moves."""
    return build(BASELINE, Baked(static_baked(source, sha256), Moving.none(), ()))


def static_baked(source: Splats, sha256: str) -> BakedScene:
    """The constants of this scene file."""
    place = placement([source.gaussians], source.offset)
    g = source.gaussians.scaled(1 / place.scale)
    metadata = metadata_of(g.means, g.sh_degree, sha256, source.antialiasing, source.dropped, source.up, place)
    return BakedScene(metadata, 0, g.means, g.quats, g.scales, g.opacities, g.sh).validate("the imported scene")


def metadata_of(
    means: np.ndarray,
    sh_degree: int,
    sha256: str,
    antialiasing: str = "dilate",
    dropped: int = 0,
    up: np.ndarray | None = None,
    place: Similarity = IDENTITY,
) -> SceneMetadata:
    """Metadata for formats without any: bounds and cameras from the centers, these upright, black background; `place`
    is that of the centers in the files' world."""
    low, high = (tuple(float(v) for v in np.quantile(means, part, axis=0)) for part in WITHIN)
    left_out = ()
    if dropped:
        what = f"Gaussians with {UNUSABLE}"
        left_out = ({"rule": "unusable", "what": what, "count": dropped, "of": dropped + len(means)},)
    return SceneMetadata(
        contract=CONTRACT,
        layers=(),
        plan=BASELINE,
        time_range=(0.0, 1.0),
        bounds=(low, high),
        sh_degree=sh_degree,
        delta_space="raw",
        background=(0.0, 0.0, 0.0),
        antialiasing=antialiasing,
        cameras=cameras_around(np.array(low), np.array(high), UP if up is None else up),
        left_out=left_out,
        measured_error={},
        package_version=__version__,
        checkpoint_sha256=sha256,
        scene_to_world=place,
    )


def cameras_around(low: np.ndarray, high: np.ndarray, up: np.ndarray) -> tuple[SceneCamera, ...]:
    """Cameras on a circle around the middle of a box, with `up` [3] upwards."""
    middle, reach = (low + high) / 2, max(half_diagonal((low, high)), 1e-3)
    poses = [orbit(middle, DISTANCE * reach, 360 * i / CAMERAS, ELEVATION, up) for i in range(CAMERAS)]
    return tuple(
        SceneCamera(f"around {i}", 0.0, Camera.from_fov(pose, SIZE, SIZE, FOV_Y)) for i, pose in enumerate(poses)
    )


def write_imported(
    output: Path,
    contents: onnx.ModelProto,
    expected: Callable[[float], Gaussians],
    times: Sequence[float],
    on_time: Callable[[], object] = lambda: None,
    rows: Callable[[float], slice] = lambda t: slice(None),
    min_psnr: float | None = None,
) -> BakedScene:
    """Write a scene file that is compared with the imported files at some times, or in its place the same with packed
    arrays, of which frames have at least `min_psnr` dB.

    `rows` are the rows of the scene that `expected` returns. The largest differences are stored in the metadata: of
    means relative to the half diagonal of the bounds or, further out, to the largest coordinate; of entries of rotation
    matrices; of scales relative to a Gaussian's largest; of opacities and SH that change. Raises `SceneFileInvalid`.
    """

    def measured(session: DeformationSession) -> dict[str, Any]:
        worst = dict.fromkeys(session.scene.posed_outputs, 0.0)
        for t in times:
            for name, error in _differences(session, expected(t), t, rows(t)).items():
                worst[name] = max(worst[name], error)
            on_time()
        storage = {} if packed is None else {"storage": storage_differences(output, packed, session)}
        return {**against_files(worst, len(times)), **storage}

    found = None if min_psnr is None else stored_anew(contents, min_psnr)
    packed = found and found[0]
    return write_measured(output, contents, measured, packed)


def note_left_out(file: Path, lost: Sequence[dict[str, Any]]) -> None:
    """Prepend entries to `left_out` of a scene file."""
    changed_metadata(file, left_out=[*lost, *properties(onnx.load(file))["left_out"]])


def changed_metadata(file: Path, **changes: Any) -> None:
    """Change metadata of a scene file."""
    contents = onnx.load(file)
    set_properties(contents, **changes)
    with replacing(file) as temporary:
        temporary.write_bytes(contents.SerializeToString())


def against_files(worst: dict[str, float], times: int) -> dict[str, Any]:
    """What `measured_error` says of the largest differences from the imported files at some times."""
    return {**worst, "against": "the files that were imported", "times": times}


def _differences(session: DeformationSession, expected: Gaussians, t: float, rows: slice) -> dict[str, float]:
    got, metadata = session.gaussians(t), session.scene.metadata
    got = Gaussians(**{name: array[rows] for name, array in vars(got).items()})
    expected = expected.scaled(1 / metadata.scene_to_world.scale)
    changes = {name: np.abs(getattr(got, name) - getattr(expected, name)) for name in session.scene.changing}
    worst = pose_differences(got, expected, metadata.bounds)
    return worst | {name: float(values.max(initial=0)) for name, values in changes.items()}


def pose_differences(got: Gaussians, expected: Gaussians, bounds: object) -> dict[str, float]:
    """The largest differences of means, quaternions and scales, as `write_imported` stores them; of some Gaussians at
    a time, as those in float64 would take most of the memory."""
    size = half_diagonal(bounds)
    worst: dict[str, float] = dict.fromkeys(MOVING_OUTPUTS, 0.0)
    for start in range(0, len(expected), ROWS):
        rows = slice(start, start + ROWS)
        means, quats, scales = (getattr(expected, name)[rows] for name in MOVING_OUTPUTS)
        far = np.maximum(np.abs(means.astype(np.float64)).max(axis=1), size)
        rotated = to_matrix(got.quats[rows].astype(np.float64)) - to_matrix(quats.astype(np.float64))
        largest = scales.max(axis=1).astype(np.float64)
        found = {
            "means": np.abs(got.means[rows] - means).max(axis=1) / far,
            "quats": np.abs(rotated),
            "scales": np.abs(got.scales[rows] - scales).max(axis=1) / largest,
        }
        worst = {name: max(worst[name], float(values.max())) for name, values in found.items()}
    return worst


def digest(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder by name."""
    if path.is_file():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    total = hashlib.sha256()
    for file in sorted(each for each in path.iterdir() if each.is_file()):
        total.update(file.name.encode() + b"\0" + bytes.fromhex(digest(file)))
    return total.hexdigest()
