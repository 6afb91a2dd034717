"""benchmarks/rasterizer.py measures what it says."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.avx512.renderer import why_not
from benchmarks.rasterizer_knobs import with_3_sigma_squares
from benchmarks.splat_files import gaussians_of, records_of
from benchmarks.splat_scenes import object_scene
from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.rasterizer.projection import ROOT_A, ROOT_B, ROOT_C, X, Y, project
from tests.support.processes import ROOT
from tests.support.scenes import as_dtype, random_scene


def test_squares_of_3_sigma():
    """Against eigenvalues of the covariance."""
    gaussians, camera = random_scene(91, 200, 200, 150)
    splats = project(as_dtype(gaussians, np.float64), camera, GSPLAT)
    squares = with_3_sigma_squares(splats, camera).rectangles
    for k in np.flatnonzero(splats.extents[:, 0]):
        root = np.array([[splats.records[k, ROOT_A], splats.records[k, ROOT_B]], [0, splats.records[k, ROOT_C]]])
        deviation = np.sqrt(0.5 / np.log(2)) / np.linalg.svd(root, compute_uv=False)[-1]
        radius, mean = np.ceil(3 * deviation), splats.records[k, [X, Y]]
        first, past = np.floor((mean - radius) / 16), np.floor((mean + radius) / 16) + 1
        want = [*np.clip([first[0], past[0]], 0, 13), *np.clip([first[1], past[1]], 0, 10)]
        np.testing.assert_array_equal(squares[k], want)


def test_splat_records_keep_what_8_bits_can():
    records = records_of(object_scene(100))
    np.testing.assert_array_equal(records_of(gaussians_of(records))["rgba"], records["rgba"])


def test_the_command(tmp_path: Path):
    """Small, on one seeded scene, one file of splats and this checkout against itself."""
    records_of(object_scene(50, 1)).tofile(tmp_path / "some.splat")
    command = [sys.executable, "benchmarks/rasterizer.py", "--counts", "300", "--sizes", "64x48", "--repeats", "2"]
    command += [
        "--splats",
        str(tmp_path / "some.splat"),
        "--images",
        str(tmp_path / "images"),
        "--gradient",
        "--avx512",
    ]
    command += ["--against", ".", "--json", str(tmp_path / "all.json"), "--plot", str(tmp_path / "all.png")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "all.json").read_text())
    (row,), (real,), (checkouts,) = result["frames"], result["real"], result["checkouts"]
    assert (row["count"], row["size"], row["repeats"], real["count"]) == (300, [64, 48], 2, 50)
    assert 0 < row["milliseconds"]["total"]["min"] <= row["milliseconds"]["total"]["median"]
    assert checkouts["psnr"] is None  # the same bytes
    assert ("avx512" in result) == (why_not() is None)
    assert (tmp_path / "all.png").stat().st_size > 1000
    assert (tmp_path / "images" / "some.splat.png").exists()
