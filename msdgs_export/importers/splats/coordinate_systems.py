"""Conversion from the sixteen coordinate systems that SPZ names to right, down, front."""

from functools import cache

import numpy as np

from msdgs_serve.scene.quaternion import from_matrix

SYSTEMS = "LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()  # noqa: SIM905 one line, not 18
"""Where x, y and z point, in the order of their numbers from 1 on: to the left, right, up, down, front or back."""

MISNAMED = {"LFD": "LBU", "RFD": "RBU", "LBU": "LFD", "RBU": "RFD"}
"""The axes that Niantic's library means by these names, when it writes and when it reads."""

DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}


def from_system(system: str, means: np.ndarray, quats: np.ndarray, sh: np.ndarray) -> tuple[np.ndarray, ...]:
    """Convert means [N, 3], wxyz quaternions [N, 4] and SH [N, C, 3] of one of `SYSTEMS`."""
    turn, product, sh_turn = _turns(system)
    bands = sh.shape[1] - 1
    turned_sh = np.concatenate([sh[:, :1], sh_turn[:bands, :bands] @ sh[:, 1:]], axis=1)
    return means @ turn.T, quats @ product.T, turned_sh


@cache
def _turns(system: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrices of positions, [3, 3], of quaternions, [4, 4], and of SH above degree 0, [15, 15]."""
    turn = np.array([DIRECTIONS[letter] for letter in MISNAMED.get(system, system)], np.float64).T
    # An ellipsoid's own axes may point either way: the mirror image of one is one turned by −1 times the mirror.
    w, x, y, z = from_matrix(np.linalg.det(turn).round() * turn)
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return turn, product, _sh_turn(turn)


def _sh_turn(turn: np.ndarray) -> np.ndarray:
    """[15, 15] what a rotation or a mirror does to SH above degree 0: the same colors, seen from turned ways."""
    from msdgs_serve.rasterizer.harmonics import harmonics_above_0  # imports numba, which takes longer than most files

    ways = np.random.default_rng(0).normal(size=(32, 3))  # enough for 15 functions
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    before, after = (np.array([harmonics_above_0(*way) for way in each.tolist()]) for each in (ways, ways @ turn.T))
    return np.linalg.lstsq(after, before, rcond=None)[0]
