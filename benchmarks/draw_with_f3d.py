"""Draw a .splat file with F3D; run by other_renderers.py in an interpreter that has f3d and needs nothing of ours.

The only argument is JSON: file, image, size [2], position [3], focal_point [3], view_up [3], view_angle (vertical, in
degrees), repeats. Prints JSON: version, seconds [repeats].
"""

import json
import sys
import time

import f3d  # pyright: ignore[reportMissingImports]

OPTIONS = {
    "model.point_sprites.type": "gaussian",
    "model.point_sprites.absolute_size": True,  # scales are in scene units, not in parts of the scene's size
    "model.point_sprites.size": 1.0,
    "model.coloring": "direct",  # each splat's own colour and opacity, without light
    "render.effect.blending.mode": "sort",
    "render.background.color": (0.0, 0.0, 0.0),
    "ui.loader_progress": False,
}


def main() -> None:
    """One picture to the file `image`; one time a repeat, the first with all that F3D does once."""
    job = json.loads(sys.argv[1])
    engine = f3d.Engine.create_egl()
    engine.options.update(OPTIONS)
    engine.scene.add(job["file"])
    window = engine.window
    window.size = tuple(job["size"])
    view = f3d.CameraState(**{name: tuple(job[name]) for name in ("position", "focal_point", "view_up")})
    view.view_angle = job["view_angle"]
    seconds = []
    for _ in range(job["repeats"]):
        window.camera.state = view
        start = time.perf_counter()
        picture = window.render_to_image()
        seconds.append(time.perf_counter() - start)
        picture.save(job["image"])
        window.camera.azimuth(20)  # F3D keeps its depth order until the view has turned by 3°
        window.render_to_image()
    print(json.dumps({"version": engine.get_lib_info().version, "seconds": seconds}))


if __name__ == "__main__":
    main()
