"""Rotation matrices of quaternions, and quaternions that have no direction."""

import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_serve.scene.quaternion import from_matrix, normalize, to_matrix
from tests.support.reference import quaternion_matrix
from tests.support.scenes import unit_quats
from tests.support.tolerances import assert_close


def samples() -> np.ndarray:
    """Return random rotations [N, 4] and those near a division by zero: identity, half turns, almost half turns."""
    half_turns = np.eye(4)[1:]
    near_half_turns = half_turns + np.array([1e-9, 0, 1e-10, 0])
    tiny = np.array([[1, 1e-9, 0, 0], [1, 0, -1e-16, 1e-16]])
    quats = np.concatenate(
        [unit_quats(np.random.default_rng(0), 200), np.eye(4)[:1], half_turns, near_half_turns, tiny]
    )
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def test_matrices_are_rotations():
    matrices = to_matrix(samples())
    assert_close(matrices @ np.swapaxes(matrices, -1, -2), np.broadcast_to(np.eye(3), matrices.shape), "rotation")
    assert_close(np.linalg.det(matrices), np.ones(len(matrices)), "rotation")


def test_matrices_agree_with_rodrigues():
    quats = samples()
    assert_close(to_matrix(quats), np.stack([quaternion_matrix(q) for q in quats]), "rotation")


def test_quarter_turn_around_z_takes_x_to_y():
    quat = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    assert_close(to_matrix(quat) @ [1, 0, 0], [0, 1, 0], "rotation")


def test_from_matrix_inverts_to_matrix():
    quats = samples()
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
