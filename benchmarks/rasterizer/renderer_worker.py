"""Draws one view of one file, a frame for each line of its input; renderers.py runs this in other interpreters.

Its argument is JSON: renderer ("F3D", "Open3D" or "msdgs"), file, image, size [2], position, focal_point and view_up
[3], view_angle (vertical, degrees). First it prints {"version": …}; for a line `draw` it draws and prints
{"seconds": …}, for `save` it writes the last frame to `image` and prints {"saved": true}.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

Drawing = tuple[str, Callable[[], float], Callable[[str], object]]
"""Version; a function that draws a frame and returns its seconds; one that writes the last frame to a file."""


def f3d(job: dict) -> Drawing:
    """Draw a .splat file by OpenGL."""
    import f3d  # pyright: ignore[reportMissingImports]

    engine = f3d.Engine.create_egl()
    engine.options.update({
        "model.point_sprites.type": "gaussian",
        "model.point_sprites.absolute_size": True,  # scales are in scene units, not relative to the scene's size
        "model.point_sprites.size": 1.0,
        "model.coloring": "direct",  # each splat's own color and opacity, without light
        "render.effect.blending.mode": "sort",
        "render.background.color": (0.0, 0.0, 0.0),
        "ui.loader_progress": False,
    })  # fmt: skip
    engine.scene.add(job["file"])
    engine.window.size = tuple(job["size"])
    view = f3d.CameraState(**{name: tuple(job[name]) for name in ("position", "focal_point", "view_up")})
    view.view_angle = job["view_angle"]
    images = []

    def draw() -> float:
        window = engine.window  # valid as long as its engine
        window.camera.state = view
        start = time.perf_counter()
        images[:] = [window.render_to_image()]
        seconds = time.perf_counter() - start
        window.camera.azimuth(20)  # F3D sorts again only if the view has turned by 3°
        window.render_to_image()
        return seconds

    return engine.get_lib_info().version, draw, lambda file: images[0].save(file)


def open3d(job: dict) -> Drawing:
    """Draw a .splat file by Vulkan compute."""
    import open3d  # pyright: ignore[reportMissingImports]

    rendering = open3d.visualization.rendering
    width, height = job["size"]
    renderer = rendering.OffscreenRenderer(width, height)
    scene = renderer.scene
    scene.set_background([0, 0, 0, 1])
    scene.view.set_post_processing(False)  # no tone mapping
    material = rendering.MaterialRecord()
    material.shader = "gaussianSplat"
    material.gaussian_splat_sh_degree = 0
    material.gaussian_splat_min_alpha = 1 / 255
    material.gaussian_splat_max_tiles_per_splat = 1 << 20
    scene.add_geometry("splats", open3d.t.io.read_point_cloud(job["file"]), material)
    far = 2 * sum(abs(x) for x in job["position"]) + scene.bounding_box.get_extent().max() * 2
    scene.camera.set_projection(job["view_angle"], width / height, far * 1e-4, far, rendering.Camera.FovType.Vertical)
    scene.camera.look_at(job["focal_point"], job["position"], job["view_up"])
    images = []

    def draw() -> float:
        start = time.perf_counter()
        images[:] = [renderer.render_to_image()]
        return time.perf_counter() - start

    return open3d.__version__, draw, lambda file: open3d.io.write_image(file, images[0])


def msdgs(job: dict) -> Drawing:
    """Draw an .npz of Gaussians with the rasterizer on PYTHONPATH."""
    import numpy as np

    import msdgs_serve
    from msdgs_serve.rasterizer import rasterize
    from msdgs_serve.scene import Camera, Gaussians

    with np.load(job["file"]) as arrays:
        gaussians = Gaussians(**arrays)
    eye, target, up = (np.array(job[name]) for name in ("position", "focal_point", "view_up"))
    width, height = job["size"]
    camera = Camera.from_look_at(eye, target, up, width, height, job["view_angle"])
    images = []

    def draw() -> float:
        start = time.perf_counter()
        images[:] = [rasterize(gaussians, camera).rgb]
        return time.perf_counter() - start

    return str(Path(msdgs_serve.__file__).parents[1]), draw, lambda file: np.save(file, images[0])


def main() -> None:
    """Answer each line of the input."""
    job = json.loads(sys.argv[1])
    version, draw, save = {"F3D": f3d, "Open3D": open3d, "msdgs": msdgs}[job["renderer"]](job)
    print(json.dumps({"version": version}), flush=True)
    for order in sys.stdin:
        if order.strip() == "save":
            save(job["image"])
            print(json.dumps({"saved": True}), flush=True)
        else:
            print(json.dumps({"seconds": draw()}), flush=True)


if __name__ == "__main__":
    main()
