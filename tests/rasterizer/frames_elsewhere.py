"""Compare frames with those of another kind of processor.

python -m tests.rasterizer.frames_elsewhere FILE

The command draws random and adversarial scenes with all options. If FILE doesn't exist, it writes the frames to it as
NPZ; otherwise it compares them, with colors clipped to [0, 1], and the exit status is 1 if the PSNR of one is below the
bound in tests/support/tolerances.py.
"""

import platform
import sys
from pathlib import Path

import numpy as np

from msdgs_serve.rasterizer import rasterize
from tests.support.images import psnr
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
        with file.open("wb") as written:
            np.savez_compressed(written, **drawn)  # pyright: ignore[reportArgumentType]
        print(f"{len(drawn)} frames of {platform.machine()} written to {file}")
        return 0
    with np.load(file) as others, np.errstate(divide="ignore"):  # of equal frames
        assert others.files == [*drawn]
        assert all(np.isfinite(each[name]).all() for each in (drawn, others) for name in drawn)
        decibels = {name: psnr(np.clip(frame, 0, 1), np.clip(others[name], 0, 1)) for name, frame in drawn.items()}
    worst = min(decibels, key=lambda name: decibels[name])
    print(f"{len(drawn)} frames of {platform.machine()}: {decibels[worst]:.1f} dB or more ({worst})")
    return int(decibels[worst] < tolerance("frames.other_processor"))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
