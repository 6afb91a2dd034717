"""The hand-written renderer that ours is timed against draws the same images."""

import pytest

from benchmarks.avx512.renderer import Avx512Renderer, why_not
from benchmarks.drawers import psnr
from benchmarks.splat_scenes import object_camera, object_scene
from msdgs_serve.rasterizer import GSPLAT, rasterize
from tests.support.tolerances import tolerance

REASON = why_not()


@pytest.mark.skipif(REASON is not None, reason=str(REASON))
@pytest.mark.parametrize(("count", "width", "height"), [(1, 64, 48), (1001, 150, 101), (10_000, 400, 400)])
def test_agrees_with_ours(count: int, width: int, height: int):
    scene, camera = object_scene(count), object_camera(width, height)
    with Avx512Renderer() as renderer:
        drawn = renderer.draw(scene, camera, GSPLAT)
        again = renderer.draw(scene, camera, GSPLAT)
    assert psnr(drawn.rgb, rasterize(scene, camera).rgb) >= tolerance("avx512_renderer_db")
    assert (drawn.rgb == again.rgb).all()
    assert set(drawn.seconds) == {"project", "sort", "bin", "composite"}
