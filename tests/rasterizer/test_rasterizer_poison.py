"""Extreme values are rendered correctly by `rasterize`, and invalid ones are refused by name."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.scene import Gaussians, InvalidInput
from tests.support.scenes import FIELDS, Scene, as_dtype, draw, front_camera, gaussians_of, random_scene

BACKGROUND = (0.2, 0.6, 0.9)


def poisoned(field: str, value: object) -> Scene:
    gaussians, camera = random_scene(30, 20)
    array = getattr(gaussians, field).copy()
    array[7] = value
    return replace(gaussians, **{field: array}), camera


BAD_OPTIONS = {
    "near_plane": (0.0, np.nan),
    "eps2d": (-0.1, np.inf),
    "alpha_min": (0.0, np.nan),
    "alpha_max": (1.0, 0.001),
    "transmittance_min": (-1e-4, 1.0),
}


@pytest.mark.parametrize(
    ("field", "scene", "settings"),
    [
        *((f"gaussians.{field}", poisoned(field, np.nan), {}) for field in FIELDS),
        *((f"gaussians.{field}", poisoned(field, value), {}) for field, value in (("quats", 0), ("opacities", 1.5))),
        *(
            ("background", random_scene(30, 5), {"background": background})
            for background in ((np.nan, 0, 0), (0, np.inf, 0), (0, 0), 0.5, np.zeros((2, 3)))
        ),
        *(
            (f"options.{field}", random_scene(30, 5), {"options": GSPLAT._replace(**{field: value})})
            for field, values in BAD_OPTIONS.items()
            for value in values
        ),
    ],
)
def test_invalid_input_is_refused_by_name(field: str, scene: Scene, settings: dict[str, Any]):
    """All invalid Gaussians are tested in tests/scene/test_scene_gaussians.py."""
    with pytest.raises(InvalidInput) as error:
        draw(*scene, **settings)
    assert error.value.field == field


BEHIND = gaussians_of([[0, 0, -1], [0, 0, 0], [0.1, 0, -5]], scales=3.0, opacities=1.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("gaussians", [BEHIND, *(random_scene(30, 0, sh_degree=degree)[0] for degree in range(4))])
def test_none_and_all_behind_the_camera_are_the_background(gaussians: Gaussians, dtype: type):
    image = draw(as_dtype(gaussians, dtype), front_camera(), background=BACKGROUND)
    np.testing.assert_array_equal(image.rgb, np.broadcast_to(np.array(BACKGROUND, dtype), image.rgb.shape))
    assert not image.alpha.any()
    assert np.isinf(image.depth).all()
    assert image.rgb.dtype == dtype


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("means", 3e38),
        ("means", -3e38),
        ("means", 1e-45),
        ("scales", 3e38),
        ("scales", [3e38, 1e-38, 1.0]),
        ("scales", 1e-45),
        ("sh", 1e30),
        ("sh", -1e30),
    ],
)
def test_extreme_but_finite_values_leave_no_nan(field: str, value: object, dtype: type):
    gaussians, camera = poisoned(field, value)
    image = draw(as_dtype(gaussians, dtype), camera, background=BACKGROUND)
    for channel in image:
        assert not np.isnan(channel).any()
    assert (image.alpha >= 0).all()
    assert (image.alpha <= 1).all()
    assert (image.depth > 0).all()


@pytest.mark.parametrize("means", [[0, 0, 1e-30], [1e30, 0, 1e-2], [1e20, 1e20, 1.0], [0, 0, 3e38]])
def test_extreme_places_leave_no_nan(means: list[float]):
    image = draw(gaussians_of([means, [0, 0, 2]], scales=[1e10, 0.1]), front_camera())
    assert np.isfinite(image.rgb).all()
    assert not np.isnan(image.depth).any()


def test_mixed_dtypes_are_cast():
    gaussians, camera = random_scene(30, 20)
    mixed = replace(gaussians, scales=gaussians.scales.astype(np.float64), sh=gaussians.sh.astype(np.float64))
    np.testing.assert_array_equal(draw(mixed, camera).rgb, draw(gaussians, camera).rgb)


def test_inputs_are_left_alone():
    gaussians, camera = random_scene(30, 50)
    before = {name: getattr(gaussians, name).copy() for name in FIELDS}
    draw(gaussians, camera, background=BACKGROUND)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(gaussians, name), before[name])
