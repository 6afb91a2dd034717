"""The whole path on a synthetic scene: images → training → ONNX scene → service → a new view.

python examples/demo_train.py --once
"""

import argparse
import contextlib
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from msdgs_serve.scene import Camera
from msdgs_train.datasets import Frame, composite, load_scene
from msdgs_train.datasets.common.images import read_rgba
from msdgs_train.engine.metrics_log import write_png
from msdgs_train.evaluation.metrics import image_metrics, mean_metrics
from serving import get, render, say, serving, stay_up

ROOT = Path(__file__).resolve().parents[1]
TRAIN = str(Path(sys.executable).with_name("msdgs-train"))
EXPORT = str(ROOT / "export" / "to_onnx.py")
MINIMUM_PSNR = 19.0
"""dB on the held-out images, below which the demo counts as broken; an empty frame has about 10."""


def main() -> None:
    """Make, train, export, serve, compare with the held-out images, wait for Ctrl-C."""
    arguments = parse_arguments()
    folder = arguments.out.with_suffix("")
    shutil.rmtree(folder, ignore_errors=True)
    data, run, scene = folder / "data", folder / "run", folder / "toy.onnx"
    folder.mkdir(parents=True)
    step("a small moving scene, captured", TRAIN, "synthetic", data, "--size", arguments.size)
    step("training", TRAIN, "fit", data, run, *fit_flags(arguments))
    step("export", sys.executable, EXPORT, run / "model.pt", "--quick", "--output", scene)
    with serving(scene, arguments.port) as url:
        compare(url, load_scene(data).splits["test"], folder / "frames", arguments.out)
        if not arguments.once:
            stay_up(url)


def fit_flags(arguments: argparse.Namespace) -> list[object]:
    """Settings for a minute rather than for quality: few Gaussians and nodes, too small to share among threads."""
    layer = "mlp:width=64,depth=2,xyz_frequencies=4,time_width=32"
    model = ["--support", "nodes:num_nodes=128,k_nearest=4", "--layers", layer, layer]
    density = ["--init-num-pts", 2500, "--max-gaussians", 4000, "--grow-grad2d", 1e-3]
    pace = ["--refine-start-fraction", 0.08, "--refine-every-fraction", 0.04, "--sh-degree-fraction", 0.2]
    rest = ["--window-full-fraction", 0.6, "--eval-every", 0, "--checkpoint-every", 500, "--threads", 1]
    return ["--steps", arguments.steps, *model, *density, *pace, *rest]


def compare(url: str, frames: list[Frame], folder: Path, out: Path) -> None:
    """Ask the service for every held-out image's camera and time; write one pair, image at the left."""
    (scene,) = get(f"{url}/scenes")["scenes"]
    background = get(f"{url}/scenes/{scene['name']}")["background"]
    folder.mkdir()
    pairs = []
    for frame in frames:
        path = folder / f"{Path(frame.name).name}.png"
        path.write_bytes(render(url, request_for(frame)))
        pairs.append((composite(frame.load_rgba(), background), composite(read_rgba(path), background)))
    metrics = [image_metrics(torch.from_numpy(rgb), torch.from_numpy(target)) for target, rgb in pairs]
    shown = len(frames) // 2
    write_png(out, np.concatenate(pairs[shown], axis=1))
    mean = mean_metrics(metrics)
    say(f"wrote {out}: image | render, {frames[shown].name} at t = {frames[shown].t:.3f}")
    say(f"  this frame: PSNR {metrics[shown].psnr:.2f} dB, SSIM {metrics[shown].ssim:.4f}")
    say(f"  all {len(frames)} held-out frames: PSNR {mean.psnr:.2f} dB, SSIM {mean.ssim:.4f}")
    if not mean.psnr >= MINIMUM_PSNR:
        raise SystemExit(f"the frames do not look like the images: {mean.psnr:.2f} dB < {MINIMUM_PSNR} dB")


def request_for(frame: Frame) -> dict[str, Any]:
    """The body of a `POST /render` for the frame's camera and time."""
    camera: Camera = frame.camera
    intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    pose = camera.camera_to_world.round(7).tolist()
    return {
        "camera": {"type": "matrix", "camera_to_world": pose, **intrinsics},
        "t": frame.t,
        "width": camera.width,
        "height": camera.height,
    }


def step(title: str, *command: object) -> None:
    """Run one command of the path and show its output; the demo ends if it fails."""
    words = [str(word) for word in command]
    say(f"\n== {title}\n$ {shlex.join(words)}")
    started = time.perf_counter()
    if code := subprocess.run(words, check=False).returncode:
        raise SystemExit(f"{title}: exit code {code}")
    say(f"== {title}: {time.perf_counter() - started:.0f} s")


def parse_arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description="Make a moving scene, train on it, export, serve, compare.")
    parser.add_argument("--port", type=int, default=8000, help="another one is used where it is taken")
    parser.add_argument("--size", type=int, default=100, help="width and height of the images")
    parser.add_argument("--steps", type=int, default=2500, help="of training")
    parser.add_argument("--out", type=Path, default=Path("out/demo_train.png"))
    parser.add_argument("--once", action="store_true", help="stop after the frames")
    return parser.parse_args()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
