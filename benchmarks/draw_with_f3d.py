"""Draw a .splat file with F3D; drawers.py runs this in an interpreter that has f3d, and says what it asks for."""

import json
import sys
import time

import f3d  # pyright: ignore[reportMissingImports]

OPTIONS = {
    "model.point_sprites.type": "gaussian",
    "model.point_sprites.absolute_size": True,  # scales are in scene units, not in parts of the scene's size
    "model.point_sprites.size": 1.0,
    "model.coloring": "direct",  # each splat's own color and opacity, without light
    "render.effect.blending.mode": "sort",
    "render.background.color": (0.0, 0.0, 0.0),
    "ui.loader_progress": False,
}


def main() -> None:
    """One answer a line; the first frame has in it all that F3D does once."""
    job = json.loads(sys.argv[1])
    engine = f3d.Engine.create_egl()
    engine.options.update(OPTIONS)
    engine.scene.add(job["file"])
    window = engine.window
    window.size = tuple(job["size"])
    view = f3d.CameraState(**{name: tuple(job[name]) for name in ("position", "focal_point", "view_up")})
    view.view_angle = job["view_angle"]
    print(json.dumps({"version": engine.get_lib_info().version}), flush=True)
    image = None
    for order in sys.stdin:
        if order.strip() == "save":
            image.save(job["image"])  # pyright: ignore[reportOptionalMemberAccess]
            print(json.dumps({"saved": True}), flush=True)
            continue
        window.camera.state = view
        start = time.perf_counter()
        image = window.render_to_image()
        seconds = time.perf_counter() - start
        window.camera.azimuth(20)  # F3D keeps its depth order until the view has turned by 3°
        window.render_to_image()
        print(json.dumps({"seconds": seconds}), flush=True)


if __name__ == "__main__":
    main()
