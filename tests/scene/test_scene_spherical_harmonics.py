"""Spherical harmonics against their definition and gsplat's reference."""

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics

from msdgs_serve.scene.spherical_harmonics import SH_DEGREES, rgb_to_sh_dc, sh_basis, sh_coefficients, sh_to_rgb
from tests.support import reference
from tests.support.tolerances import assert_close


def directions(count: int = 200) -> np.ndarray:
    """Return random directions and those along the axes."""
    random = np.random.default_rng(0).normal(size=(count, 3))
    return np.concatenate([random / np.linalg.norm(random, axis=1, keepdims=True), np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("degree", range(4))
def test_basis_agrees_with_definition(degree: int):
    got = sh_basis(directions(), degree)
    assert_close(got, reference.sh_basis(directions(), degree), "sh_basis")


def test_basis_in_float32():
    got = sh_basis(directions().astype(np.float32), 3)
    assert got.dtype == np.float32
    assert_close(got, reference.sh_basis(directions(), 3), "sh_basis.float32")


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
