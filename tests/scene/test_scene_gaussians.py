"""`Gaussians.validate` refuses invalid arrays by name."""

import numpy as np
import pytest

from msdgs_serve.scene import Gaussians, InvalidInput
from tests.support.scenes import random_scene, select

FIELDS = ("means", "quats", "scales", "opacities", "sh")


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


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_not_finite_is_refused_by_name(field: str, poison: float):
    with pytest.raises(InvalidInput, match="NaN or infinite") as error:
        poisoned(field, poison).validate()
    assert error.value.field == f"gaussians.{field}"


OUT_OF_RANGE = {"quats": (0.0, [2.0, 0, 0, 0]), "scales": (0.0, -1.0), "opacities": (-0.01, 1.01)}


@pytest.mark.parametrize(
    ("field", "poison"), [(field, value) for field, values in OUT_OF_RANGE.items() for value in values]
)
def test_out_of_range_is_refused_by_name(field: str, poison: object):
    with pytest.raises(InvalidInput) as error:
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


def test_opacity_may_be_0_and_1():
    poisoned("opacities", 0.0).validate()
    poisoned("opacities", 1.0).validate()


def test_selection_keeps_the_rows_together():
    gaussians, _ = random_scene(0, 5)
    some = select(gaussians, np.array([3, 1]))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(some, name), getattr(gaussians, name)[[3, 1]])
