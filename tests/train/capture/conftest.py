"""A clip that is captured once for all tests of a worker."""

from pathlib import Path
from typing import NamedTuple

import pytest

from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.job import FRAMES, IMAGES
from msdgs_train.capture.masked_poses import MaskedPoses, find_masked_poses
from msdgs_train.capture.recordings import WORK
from msdgs_train.cli.main import main
from tests.support.clips import Clip, moving_camera_clip

PLANTED = {
    "location": "+48.8584+002.2945/",
    "com.apple.quicktime.location.ISO6709": "+48.8584+002.2945+035.000/",
    "com.apple.quicktime.make": "PlantedMaker",
    "com.apple.quicktime.model": "PlantedModel 15",
    "creation_time": "2023-04-05T06:07:08.000000Z",
    "comment": "recorded by PlantedOwner",
}
"""Metadata of a phone's recording."""
NAME = "PlantedPhone_VID_20230405_060708.mp4"

COUNT, ARC = 16, 25.0
"""Frames and degrees of the clip."""


class Captured(NamedTuple):
    """A recording and its dataset; both are only read."""

    clip: Clip
    data: Path
    status: int

    @property
    def images(self) -> Path:
        """The frames that were taken."""
        return self.step("frames") / IMAGES

    @property
    def frames(self) -> FrameSet:
        return FrameSet.load(self.step("frames") / FRAMES)

    @property
    def found(self) -> MaskedPoses:
        """The poses and masks of the dataset."""
        return find_masked_poses(self.images, self.frames, lambda name, run: self.step(name))

    def step(self, name: str) -> Path:
        """The folder of a step's result."""
        return self.data / WORK / name


@pytest.fixture(scope="session")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    """What `msdgs-train capture` makes of a clip with a phone's metadata and name: the camera moves around toys, and a
    third of its image moves."""
    folder = tmp_path_factory.mktemp("PlantedFolder")
    clip = moving_camera_clip(folder / "clip.mp4", width=224, frames=COUNT, arc=ARC)
    recording = with_metadata(clip.file, folder / NAME)
    data = folder / "data"
    status = main(["capture", str(recording), str(data), "--threads", "1"])
    return Captured(clip, data, status)


def with_metadata(source: Path, target: Path) -> Path:
    """Copy a video with planted metadata in its header."""
    import av

    with av.open(str(source)) as old, av.open(str(target), "w", options={"movflags": "use_metadata_tags"}) as new:
        new.metadata.update(PLANTED)
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(old.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                new.mux(packet)
    return target
