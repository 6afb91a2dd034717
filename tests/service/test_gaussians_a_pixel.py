"""How many Gaussians add to each pixel, over HTTP; tests of the rasterizer count them one by one."""

from pathlib import Path

import numpy as np

from msdgs_serve.client import Client, Orbit
from tests.support.images import decode
from tests.support.service import serving

SIZE = 40
FRAME = {
    "camera": {"type": "orbit", "azimuth": 30, "elevation": 20},
    "t": 0.1,
    "width": SIZE,
    "height": SIZE,
    "channels": ["gaussians"],
}


def test_as_numbers_and_as_an_image(scene: Path):
    with serving(scene) as http:
        with Client(str(http.base_url)) as client:
            frame = client.render(Orbit(30, 20), 0.1, width=SIZE, height=SIZE, channels=("gaussians", "alpha"))
        assert frame.gaussians is not None
        assert frame.alpha is not None
        assert frame.gaussians.max() >= 1
        np.testing.assert_array_equal(frame.gaussians, frame.gaussians.round())
        np.testing.assert_array_equal(frame.gaussians > 0, frame.alpha > 0)
        pixels, spec = decode(http.post("/render", json={**FRAME, "format": "exr"}).content, "exr")
        assert spec.channelnames == ("gaussians",)
        np.testing.assert_array_equal(pixels[..., 0], frame.gaussians)
        grey = decode(http.post("/render", json=FRAME).content, "png")[0]
        np.testing.assert_allclose(grey[..., 0], 255 * frame.gaussians / frame.gaussians.max(), atol=0.5)


def test_under_a_shutter_it_is_the_mean_over_its_moments(scene: Path):
    with serving(scene) as http:

        def counted(**more: object) -> np.ndarray:
            return decode(http.post("/render", json={**FRAME, "format": "npy", **more}).content, "npy")[0]

        blurred = counted(shutter={"open": 0, "close": 0.2, "samples": 2})
        np.testing.assert_allclose(blurred, (counted(t=0.15) + counted(t=0.25)) / 2)
