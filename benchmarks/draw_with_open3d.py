"""Draw a .splat file with Open3D; drawers.py runs this in an interpreter that has open3d, and says what it asks for."""

import json
import sys
import time

import open3d  # pyright: ignore[reportMissingImports]

rendering = open3d.visualization.rendering


def main() -> None:
    """One answer a line; the first frame has in it all that Open3D does once."""
    job = json.loads(sys.argv[1])
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
    print(json.dumps({"version": open3d.__version__}), flush=True)
    image = None
    for order in sys.stdin:
        if order.strip() == "save":
            open3d.io.write_image(job["image"], image)
            print(json.dumps({"saved": True}), flush=True)
            continue
        start = time.perf_counter()
        image = renderer.render_to_image()
        print(json.dumps({"seconds": time.perf_counter() - start}), flush=True)


if __name__ == "__main__":
    main()
