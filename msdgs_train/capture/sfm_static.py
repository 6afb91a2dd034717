"""A copy of COLMAP's database with matches on what stands still only. Part of the process of `sfm_process`."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from msdgs_train.capture.sfm_process import CameraViews
from msdgs_train.capture.static_tracks import MatchedPair, Tracks

ROUNDS = 3
"""Of tracks that agree with the geometry, and geometry from those."""
SETTLED = 0.98
"""Part of the keypoints that a round leaves if another one isn't worth it."""


def write_static(
    database: Path, copy: Path, cameras: Sequence[CameraViews], options: pycolmap.TwoViewGeometryOptions
) -> None:
    """Write the copy. Keypoints of fixed cameras' views all stand still."""
    shutil.copyfile(database, copy)
    places = {name: (index, number) for index, camera in enumerate(cameras) for number, name in enumerate(camera.names)}
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        counts = [len(opened.read_keypoints(image.image_id)) for image in images]
    pairs = _read(database, images, places)
    tracks, left = Tracks(counts, pairs), sum(counts)
    for _ in range(ROUNDS):
        static = tracks.static(pairs)
        for row, image in enumerate(images):
            static[tracks.of_image(row)] |= cameras[places[image.name][0]].frames is not None
        pairs = [tracks.within(static, pair) for pair in pairs]
        _write(copy, pairs, images, options)
        before, left = left, int(static.sum())
        if left > SETTLED * before:
            break
        pairs = _read(copy, images, places)


def _read(database: Path, images: Sequence[pycolmap.Image], places: Mapping[str, tuple[int, int]]) -> list[MatchedPair]:
    """The matches of all pairs; `places` has the camera of each name, and the number of its frame."""
    rows = {image.image_id: row for row, image in enumerate(images)}
    pairs = []
    with pycolmap.Database.open(database) as opened:
        keys, geometries = opened.read_two_view_geometries()
        inliers = {key: np.asarray(each.inlier_matches, np.int64) for key, each in zip(keys, geometries, strict=True)}
        for key, matches in zip(*opened.read_all_matches(), strict=True):
            first, second = (rows[image] for image in pycolmap.pair_id_to_image_pair(key))
            (camera, start), (other, end) = (places[images[row].name] for row in (first, second))
            distance = abs(end - start) if camera == other else None
            matches = np.asarray(matches, np.int64).reshape(-1, 2)
            agrees = np.isin(_coded(matches), _coded(inliers.get(key, np.empty((0, 2), np.int64))))
            pairs.append(MatchedPair(first, second, distance, matches, agrees))
    return pairs


def _coded(matches: np.ndarray) -> np.ndarray:
    """[M] a number for each match."""
    return matches[:, 0] << 32 | matches[:, 1]


def _write(
    database: Path,
    pairs: Sequence[MatchedPair],
    images: Sequence[pycolmap.Image],
    options: pycolmap.TwoViewGeometryOptions,
) -> None:
    """Replace the matches and geometries of a database."""
    enough = [pair for pair in pairs if len(pair.matches) >= options.min_num_inliers]
    chosen, lines = database.with_suffix(".txt"), []
    with pycolmap.Database.open(database) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
        for pair in enough:
            first, second = images[pair.first], images[pair.second]
            opened.write_matches(first.image_id, second.image_id, pair.matches.astype(np.uint32))
            lines.append(f"{first.name} {second.name}\n")
    chosen.write_text("".join(lines), encoding="utf-8")
    pycolmap.verify_matches(database, chosen, options)
    chosen.unlink()
