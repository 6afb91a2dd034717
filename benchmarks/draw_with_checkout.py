"""Draw a .npz of Gaussians with the rasterizer of the checkout that drawers.py names, and says what it asks for."""

import json
import sys
import time
from pathlib import Path

import numpy as np

import msdgs_serve
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import Camera, Gaussians


def main() -> None:
    """One answer a line; the first frame is drawn before the first answer, so that none has compiling in it."""
    job = json.loads(sys.argv[1])
    with np.load(job["file"]) as arrays:
        gaussians = Gaussians(**arrays)
    eye, target, up = (np.array(job[name]) for name in ("position", "focal_point", "view_up"))
    width, height = job["size"]
    camera = Camera.from_look_at(eye, target, up, width, height, job["view_angle"])
    rgb = rasterize(gaussians, camera).rgb
    print(json.dumps({"version": str(Path(msdgs_serve.__file__).parents[1])}), flush=True)
    for order in sys.stdin:
        if order.strip() == "save":
            np.save(job["image"], rgb)
            print(json.dumps({"saved": True}), flush=True)
            continue
        start = time.perf_counter()
        rgb = rasterize(gaussians, camera).rgb
        print(json.dumps({"seconds": time.perf_counter() - start}), flush=True)


if __name__ == "__main__":
    main()
