"""The frames that were taken from the videos of a capture, with their times."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from msdgs_serve.writing import replacing


@dataclass(frozen=True)
class CapturedCamera:
    """A video, or a folder of images, as one camera."""

    name: str
    """Folder of its frames where there are several cameras, `cam01`, …; empty for one camera."""
    width: int
    """Pixels of the frames that were taken from it."""
    height: int
    duration: float
    """Seconds between its first and last frame."""
    available: int
    """Frames in the video or folder."""
    offset: float = 0.0
    """Seconds by which it starts after the first camera."""


@dataclass(frozen=True)
class CapturedFrame:
    """One image that was taken from a video."""

    name: str
    """Path below the folder of frames, `00012.png` or `cam01/00012.png`."""
    camera: int
    """Index of its camera."""
    time: float
    """Seconds on the clock of the first camera."""
    sharpness: float
    """Comparable among frames of one camera; larger is sharper."""


@dataclass(frozen=True)
class FrameSet:
    """What was taken from the videos of a capture."""

    cameras: tuple[CapturedCamera, ...]
    frames: tuple[CapturedFrame, ...]
    """In the order of cameras, then times."""
    blurred: int = 0
    """Intervals of time that are left out, as all of their frames are blurred."""
    cuts: tuple[float, ...] = ()
    """Times in seconds at which the picture changes as a whole."""
    black: int = 0
    """Frames that are left out as they are black, or of one color."""
    repeated: int = 0
    """Frames that are left out as they show the picture before again."""
    notes: tuple[str, ...] = ()
    """What people should know of the videos, each a sentence."""

    def save(self, file: Path) -> None:
        """Write it as JSON."""
        with replacing(file) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    @staticmethod
    def load(file: Path) -> "FrameSet":
        """Read what `save` wrote."""
        stored = json.loads(file.read_text(encoding="utf-8"))
        return FrameSet(
            tuple(CapturedCamera(**camera) for camera in stored["cameras"]),
            tuple(CapturedFrame(**frame) for frame in stored["frames"]),
            stored["blurred"],
            tuple(stored["cuts"]),
            stored["black"],
            stored["repeated"],
            tuple(stored["notes"]),
        )
