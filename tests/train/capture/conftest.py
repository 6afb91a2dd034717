"""A clip that is captured once for all tests of a worker."""

from pathlib import Path
from typing import NamedTuple

import pytest

from msdgs_train.cli.main import main
from tests.support.camera_moves import arc
from tests.support.clips import Clip, clip_of_poses

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


class Captured(NamedTuple):
    """A recording and its dataset; both are only read."""

    clip: Clip
    data: Path
    status: int


@pytest.fixture(scope="session")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    """What `msdgs-train capture` makes of a clip of toys, which has a phone's metadata and name."""
    folder = tmp_path_factory.mktemp("PlantedFolder")
    clip = clip_of_poses(folder / "clip.mp4", arc(40, 16), width=224)
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
