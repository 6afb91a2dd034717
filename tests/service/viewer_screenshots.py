"""Take the screenshots of docs/viewer.md: `python -m tests.service.viewer_screenshots docs/images`.

Needs Chromium and `make tests/export/runtime/node_modules`.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.support.processes import WEBGL, chromium, wait_until_still
from tests.support.service import serving
from tests.support.sites import file_server, write_site

SCENE = Path("examples/toys.onnx")
DESKTOP: Any = {"viewport": {"width": 1280, "height": 800}}
PHONE = {"viewport": {"width": 390, "height": 844}, "device_scale_factor": 2, "is_mobile": True, "has_touch": True}
AT = "t=0.6&at=30,20,3.4,0,0,0"
SCREENSHOTS = (
    ("color_light", DESKTOP, "light", "rgb"),
    ("layers_light", DESKTOP, "light", "rgb&steps=1"),
    ("depth_dark", DESKTOP, "dark", "depth"),
    ("motion_dark", DESKTOP, "dark", "motion"),
    ("count_dark", DESKTOP, "dark", "gaussians"),
    ("phone_dark", PHONE, "dark", "rgb"),
)
THUMBNAIL = "() => document.querySelector('#scenes canvas').getContext('2d').getImageData(0, 0, 1, 1).data[3] > 0"


def main(folder: Path) -> None:
    """Write one JPEG for each of `SCREENSHOTS`, and one of a site."""
    with serving(SCENE) as client, chromium(*WEBGL) as browser, tempfile.TemporaryDirectory() as sites:
        for name, device, scheme, view in SCREENSHOTS:
            options: Any = {**device, "color_scheme": scheme}
            with browser.new_context(**options) as context:
                page = context.new_page()
                page.goto(f"{client.base_url}/#scene={SCENE.stem}&view={view}&{AT}")
                wait_until_still(page)
                page.wait_for_function(THUMBNAIL)
                page.screenshot(path=folder / f"viewer_{name}.jpg", type="jpeg", quality=88)
        write_site(SCENE, Path(sites) / "site")
        with file_server(Path(sites)) as address:
            page = browser.new_page(**DESKTOP, color_scheme="light")
            page.goto(f"{address}/site/#{AT}")
            wait_until_still(page)
            page.screenshot(path=folder / "viewer_site_light.jpg", type="jpeg", quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
