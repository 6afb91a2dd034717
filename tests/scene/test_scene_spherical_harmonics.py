"""Spherical harmonics against their definition, their laws, and gsplat's reference."""

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics
from numpy.polynomial import Legendre

from msdgs_serve.scene.spherical_harmonics import SH_DEGREES, rgb_to_sh_dc, sh_basis, sh_coefficients, sh_to_rgb
from tests.support import reference
from tests.support.tolerances import assert_close


def directions(count: int = 200) -> np.ndarray:
    """Random ones, and along the axes."""
    random = np.random.default_rng(0).normal(size=(count, 3))
    return np.concatenate([random / np.linalg.norm(random, axis=1, keepdims=True), np.eye(3), -np.eye(3)])


def sphere_rule() -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights that integrate polynomials up to degree 7 over the sphere exactly."""
    z, z_weights = np.polynomial.legendre.leggauss(8)
    around = 2 * np.pi * np.arange(16) / 16
    z, around = (grid.ravel() for grid in np.meshgrid(z, around, indexing="ij"))
    ring = np.sqrt(1 - z * z)
    return np.column_stack([ring * np.cos(around), ring * np.sin(around), z]), np.repeat(z_weights, 16) * 2 * np.pi / 16


@pytest.mark.parametrize("degree", range(4))
def test_basis_agrees_with_definition(degree: int):
    got = sh_basis(directions(), degree)
    assert_close(got, reference.sh_basis(directions(), degree), "sh_basis")


def test_basis_in_float32():
    got = sh_basis(directions().astype(np.float32), 3)
    assert got.dtype == np.float32
    assert_close(got, reference.sh_basis(directions(), 3), "sh_basis.float32")


def test_basis_is_orthonormal():
    points, weights = sphere_rule()
    basis = sh_basis(points, 3)
    assert_close(basis.T @ (weights[:, None] * basis), np.eye(16), "sh_basis")


@pytest.mark.parametrize("band", range(4))
def test_addition_theorem(band: int):
    """Summed over one band, products at two directions depend on the angle between them alone."""
    one, other = directions(), directions()[::-1]
    columns = slice(band**2, (band + 1) ** 2)
    got = (sh_basis(one, 3)[:, columns] * sh_basis(other, 3)[:, columns]).sum(axis=1)
    want = (2 * band + 1) / (4 * np.pi) * Legendre.basis(band)((one * other).sum(axis=1))
    assert_close(got, want, "sh_basis")


@pytest.mark.parametrize("degree", range(4))
def test_colors_agree_with_gsplat(degree: int):
    sh = np.random.default_rng(1).normal(size=(len(directions()), sh_coefficients(degree), 3))
    want = _spherical_harmonics(degree, torch.from_numpy(directions()), torch.from_numpy(sh)).numpy()
    assert_close(sh_to_rgb(sh, directions()), np.maximum(want + 0.5, 0), "sh_basis.gsplat")


def test_colors_are_clamped_below_and_not_above():
    sh = np.array([[[-10.0, 0.0, 10.0]]])
    rgb = sh_to_rgb(sh, np.array([[0.0, 0.0, 1.0]]))[0]
    assert rgb[0] == 0
    assert rgb[1] == 0.5
    assert rgb[2] > 3


def test_constant_coefficient_gives_its_color_everywhere():
    rgb = np.array([0.1, 0.5, 0.9])
    sh = np.zeros((16, 3))
    sh[0] = rgb_to_sh_dc(rgb)
    got = sh_to_rgb(np.broadcast_to(sh, (len(directions()), 16, 3)), directions())
    assert_close(got, np.broadcast_to(rgb, got.shape), "sh_basis")


def test_counts_of_coefficients():
    assert {sh_coefficients(degree): degree for degree in range(4)} == SH_DEGREES
