"""Serve a scene, ask for one frame of it over HTTP and keep the service up. Needs what serving needs, and no torch.

python examples/demo.py examples/toys.onnx
"""

import argparse
import contextlib
import shlex
import time
from pathlib import Path

from serving import get, render, say, serving, stay_up

SITE = "out/site"


def main() -> None:
    """Serve, render out/demo.png, wait for Ctrl-C."""
    arguments = parse_arguments()
    if not arguments.scene.is_file():
        raise SystemExit(f"{arguments.scene}: no such scene; `make demo-train` makes one from nothing")
    with serving(arguments.scene, arguments.port) as url:
        scene = get(f"{url}/scenes/{arguments.scene.stem}")
        start, end = scene["time_range"]
        request = {
            "camera": {"type": "orbit", "azimuth": arguments.azimuth, "elevation": arguments.elevation},
            "t": start + arguments.time * (end - start),
            "width": 512,
            "height": 512,
        }
        started = time.perf_counter()
        frame = render(url, request)
        seconds = time.perf_counter() - started
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_bytes(frame)
        say(f"wrote {arguments.out}: {scene['gaussians']['total']:,} Gaussians at t = {request['t']}, {seconds:.2f} s")
        scene_file = shlex.quote(str(arguments.scene))
        say("a page that needs no service, with `pip install '.[export]'` and npm:")
        say(f"$ msdgs-convert {scene_file} {SITE} --site && python -m http.server -d {SITE} 8001")
        if not arguments.once:
            stay_up(url)


def parse_arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description="Serve a scene and write one frame of it.")
    parser.add_argument("scene", type=Path, help="a scene file (.onnx)")
    parser.add_argument("--port", type=int, default=8000, help="another one is used where it is taken")
    parser.add_argument("--azimuth", type=float, default=30.0, help="degrees around the scene")
    parser.add_argument("--elevation", type=float, default=25.0, help="degrees above the horizon")
    parser.add_argument("--time", type=float, default=0.5, help="0 is the scene's first moment, 1 its last")
    parser.add_argument("--out", type=Path, default=Path("out/demo.png"))
    parser.add_argument("--once", action="store_true", help="stop after the frame")
    return parser.parse_args()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
