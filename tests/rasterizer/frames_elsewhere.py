"""Compare frames with those of another kind of processor.

python -m tests.rasterizer.frames_elsewhere FILE

The command draws random and adversarial scenes with all options. Without FILE, an NPZ, it writes the frames; with it,
it compares them, and the exit status is 1 if one is further away than the bound in tests/support/tolerances.py. Colors
are clipped to [0, 1].
"""

import platform
import sys
from pathlib import Path

import numpy as np

from msdgs_serve.rasterizer import rasterize
from tests.support.scenes import ADVERSARIAL, OPTIONS, Scene, random_scene
from tests.support.tolerances import tolerance

SEEDS, COUNT = range(8), 500


def frames() -> dict[str, np.ndarray]:
    """[H, W, 3] colors by the names of scene and options."""
    scenes: dict[str, Scene] = {f"random {seed}": random_scene(seed, COUNT, 96, 80) for seed in SEEDS}
    scenes |= {name: make() for name, make in ADVERSARIAL.items()}
    return {
        f"{name}, {option}": rasterize(*scene, options=options).rgb
        for name, scene in scenes.items()
        for option, options in OPTIONS.items()
    }


def main(file: Path) -> int:
    """Write or compare."""
    drawn = frames()
    if not file.exists():
        np.savez_compressed(file, **drawn)  # pyright: ignore[reportArgumentType]
        print(f"{len(drawn)} frames of {platform.machine()} written to {file}")
        return 0
    with np.load(file) as others:
        errors = {name: np.clip(frame, 0, 1) - np.clip(others[name], 0, 1) for name, frame in drawn.items()}
    decibels = {name: -10 * np.log10(np.mean(error**2) + 1e-20) for name, error in errors.items()}
    worst = min(decibels, key=lambda name: decibels[name])
    print(f"{len(drawn)} frames of {platform.machine()}: {decibels[worst]:.1f} dB or more ({worst})")
    return int(decibels[worst] < tolerance("frames.other_processor"))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
