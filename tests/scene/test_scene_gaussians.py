"""Gaussians, their rotations and their spherical harmonics: laws, references, and invalid arrays refused by name."""

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics

from msdgs_serve.scene import Gaussians, InvalidInput
from msdgs_serve.scene.quaternion import from_matrix, normalize, to_matrix
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES, sh_coefficients
from tests.support import reference
from tests.support.scenes import FIELDS, random_scene, unit_quats
from tests.support.tolerances import assert_close


def changed(field: str, value: object) -> Gaussians:
    """Return five valid Gaussians with one array replaced."""
    gaussians, _ = random_scene(0, 5)
    return Gaussians(**{**{name: getattr(gaussians, name) for name in FIELDS}, field: value})


def poisoned(field: str, value: object) -> Gaussians:
    """Return five Gaussians, the third with `value` in one array."""
    array = getattr(random_scene(0, 5)[0], field).copy()
    array[2] = value
    return changed(field, array)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [0, 1, 5])
def test_valid_ones_pass(count: int, degree: int):
    gaussians, _ = random_scene(0, count, sh_degree=degree)
    assert gaussians.validate() is gaussians
    assert len(gaussians) == count
    assert gaussians.sh_degree == degree


@pytest.mark.parametrize(
    ("field", "poison", "problem"),
    [
        *((field, value, "NaN or infinite") for field in FIELDS for value in (np.nan, np.inf, -np.inf)),
        *(("quats", value, None) for value in (0.0, [2.0, 0, 0, 0])),
        *(("scales", value, None) for value in (0.0, -1.0)),
        *(("opacities", value, None) for value in (-0.01, 1.01)),
    ],
)
def test_poison_is_refused_by_name(field: str, poison: object, problem: str | None):
    with pytest.raises(InvalidInput, match=problem) as error:
        poisoned(field, poison).validate()
    assert error.value.field == f"gaussians.{field}"


WRONG_SHAPES = {
    "means": ((5, 2), (15,)),
    "quats": ((4, 4), (5, 3)),
    "scales": ((5,),),
    "opacities": ((5, 1), (6,)),
    "sh": ((5, 3), (5, 5, 3), (5, 16, 4), (4, 16, 3)),
}


@pytest.mark.parametrize(
    ("field", "shape"), [(field, shape) for field, shapes in WRONG_SHAPES.items() for shape in shapes]
)
def test_wrong_shapes_are_refused_by_name(field: str, shape: tuple[int, ...]):
    with pytest.raises(InvalidInput, match="shape") as error:
        changed(field, np.full(shape, 0.5, np.float32)).validate()
    assert error.value.field.startswith("gaussians.")


def rotations() -> np.ndarray:
    """Return random rotations [N, 4] and those near a division by zero: identity, half turns, almost half turns."""
    half_turns = np.eye(4)[1:]
    near_half_turns = half_turns + np.array([1e-9, 0, 1e-10, 0])
    tiny = np.array([[1, 1e-9, 0, 0], [1, 0, -1e-16, 1e-16]])
    quats = np.concatenate(
        [unit_quats(np.random.default_rng(0), 200), np.eye(4)[:1], half_turns, near_half_turns, tiny]
    )
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def test_matrices_agree_with_rodrigues():
    quats = rotations()
    assert_close(to_matrix(quats), np.stack([reference.quaternion_matrix(q) for q in quats]), "rotation")


def test_from_matrix_inverts_to_matrix():
    quats = rotations()
    back = from_matrix(to_matrix(quats))
    assert (back[:, 0] >= 0).all()
    assert_close(np.abs((back * quats).sum(axis=1)), np.ones(len(quats)), "rotation")
    assert_close(to_matrix(back), to_matrix(quats), "rotation")


@pytest.mark.parametrize("shape", [(), (3,), (2, 5), (0,)])
def test_leading_axes_are_kept(shape: tuple[int, ...]):
    quats = np.broadcast_to([0.6, 0.8, 0.0, 0.0], (*shape, 4))
    assert to_matrix(quats).shape == (*shape, 3, 3)
    assert from_matrix(to_matrix(quats)).shape == (*shape, 4)
    assert normalize(quats).shape == (*shape, 4)


@pytest.mark.parametrize("size", [1e-7, 1e-3, 1.0, 1e3, 1e30])
def test_normalize_at_any_size(size: float):
    direction = np.array([1, -2, 3, -4], np.float32)
    quat = normalize(direction * np.float32(size))
    assert_close(quat, direction / np.sqrt(30), "float32.relative")
    assert quat.dtype == np.float32


@pytest.mark.parametrize("poison", [np.zeros(4), np.full(4, 1e-9), [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]])
def test_no_direction_is_refused(poison: object):
    quats = np.tile([1.0, 0, 0, 0], (3, 1))
    quats[1] = poison
    with pytest.raises(InvalidInput, match="quats"):
        normalize(quats)


def directions(count: int = 200) -> np.ndarray:
    """Return random directions and those along the axes."""
    random = np.random.default_rng(0).normal(size=(count, 3))
    return np.concatenate([random / np.linalg.norm(random, axis=1, keepdims=True), np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("degree", range(4))
def test_the_definition_of_harmonics_agrees_with_gsplat(degree: int):
    sh = np.random.default_rng(1).normal(size=(len(directions()), sh_coefficients(degree), 3))
    want = _spherical_harmonics(degree, torch.from_numpy(directions()), torch.from_numpy(sh)).numpy()
    got = np.einsum("nk,nkc->nc", reference.sh_basis(directions(), degree), sh)
    assert_close(got, want, "sh_basis.gsplat")


def test_counts_of_coefficients():
    assert {sh_coefficients(degree): degree for degree in range(4)} == SH_DEGREES
