"""The frames of a video with the times at which players show them."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.pictures import Picture, fitted
from msdgs_train.datasets.common.readers import DatasetInvalid
from msdgs_train.datasets.common.video import display_turn, opened_video
from msdgs_train.datasets.common.video_colors import HLG, PQ, as_grey, as_srgb

NO_VIDEO = ("tty", "bin", "xbin", "adf", "idf", "image2")
"""FFmpeg's formats that are texts or single images. Those of images also end with `_pipe`."""
MOSTLY = 0.9
"""Share of the packets that have times of their own if a video's times can be used."""
USUAL_RATE = 30.0
"""Frames per second of a video that states none."""


class VideoSource:
    """A video as `Source`. Reads all packets, but decodes only the first frame; raises `CaptureFailed`."""

    def __init__(self, file: Path, size: int) -> None:
        self.file = file
        self._broken = self._read = self._untimed = 0
        self._is_interlaced = False
        with opened(file) as container:
            stream = recording(file, container)
            rate = stream.average_rate or stream.guessed_rate
            self.period = float(1 / rate) if rate else 1 / USUAL_RATE
            first = next(self._decoded(container, stream), None)
            if first is None:
                raise CaptureFailed(file, "holds no frame that can be decoded: record or copy it again")
            self._turn = display_turn(file, first)
            self._transfer = int(first.color_trc)
            self._stored = first.width, first.height
            width = first.width * float(stream.sample_aspect_ratio or 1)
            shown = (first.height, width) if self._turn.transposed else (width, first.height)
        self.width, self.height = fitted(*shown, size)
        self.count, self.start, self.duration, self.is_timed = self._packets()
        self._broken = 0

    def pictures(self) -> Iterator[Picture]:
        """Decode the video once. Frames that are damaged are left out."""
        self._broken = self._read = self._untimed = 0
        first = previous = None
        with opened(self.file) as container:
            stream = recording(self.file, container)
            stream.thread_type = "AUTO"
            fields = Fields(stream)
            for frame in self._decoded(container, stream):
                time = self._time(frame.pts, stream.time_base, previous)
                first = time if first is None else first
                previous = time
                if (frame.width, frame.height) != self._stored:
                    raise CaptureFailed(self.file, f"changes its size at {time - first:.1f} s: cut it there")
                self._is_interlaced |= bool(frame.interlaced_frame)
                picture = fields.one_of(frame) if frame.interlaced_frame else frame
                yield Picture(self._read, time - first, self._grey(picture), lambda shown=picture: self._srgb(shown))
                self._read += 1

    def notes(self) -> list[str]:
        notes = []
        if self._broken or self._read < self.count:
            notes.append(f"{self.file.name} is cut off or damaged: {self._read} of {self.count} frames can be decoded")
        if self._untimed:
            notes.append(
                f"{self.file.name} has no usable times for {self._untimed} frames: they are taken to follow at "
                f"{1 / self.period:.4g} frames per second"
            )
        if self._is_interlaced:
            notes.append(f"{self.file.name} is interlaced: of each frame only every second line is used")
        if self._transfer in (PQ, HLG):
            kind = "PQ" if self._transfer == PQ else "HLG"
            notes.append(f"{self.file.name} is HDR ({kind}): the brightest parts are compressed into sRGB")
        return notes

    def _packets(self) -> tuple[int, float, float, bool]:
        """Number of frames, time of the first in the file in seconds, duration, and whether frames have times."""
        from av.error import FFmpegError

        with opened(self.file) as container:
            stream = recording(self.file, container)
            packets = container.demux(stream)
            times, count = [], 0
            with suppress(FFmpegError):  # at the end of a file that is cut off
                for packet in packets:
                    if packet.size and not packet.is_discard:
                        count += 1
                        times += [] if packet.pts is None else [float(packet.pts * stream.time_base)]
            count = max(count, stream.frames if not times else 0)
            is_decoding_order = container.format.name == "avi" and stream.codec_context.has_b_frames
        is_timed = len(set(times)) > MOSTLY * count and not is_decoding_order
        if not is_timed:
            return count, 0.0, (count - 1) * self.period, False
        return count, min(times), max(times) - min(times), True

    def _decoded(self, container: Any, stream: Any) -> Iterator[Any]:
        """Yield the frames, and count what can't be decoded."""
        from av.error import FFmpegError

        packets, ended = container.demux(stream), False
        while not ended:
            try:
                packet = next(packets, None)  # none after an error; the last one is empty
                ended = packet is None or packet.size == 0
                frames = stream.decode(None if ended else packet)
            except EOFError:
                return
            except FFmpegError:
                self._broken += 1
                continue
            for frame in frames:
                self._broken += frame.is_corrupt
                if not frame.is_corrupt:
                    yield frame

    def _time(self, ticks: int | None, unit: Any, previous: float | None) -> float:
        """Seconds; a time that is missing, or not later than the previous one, is taken from the frame rate."""
        time = float(ticks * unit) if ticks is not None and self.is_timed else None
        if time is not None and (previous is None or time > previous):
            return time
        self._untimed += 1
        return 0.0 if previous is None else previous + self.period

    def _grey(self, frame: Any) -> np.ndarray:
        return np.ascontiguousarray(self._turn(as_grey(frame, *self._unturned())))

    def _srgb(self, frame: Any) -> np.ndarray:
        return np.ascontiguousarray(self._turn(as_srgb(frame, *self._unturned())))

    def _unturned(self) -> tuple[int, int]:
        return (self.height, self.width) if self._turn.transposed else (self.width, self.height)


class Fields:
    """One field of an interlaced frame: its two fields show different times, and together comb what moves."""

    def __init__(self, stream: Any) -> None:
        self._stream, self._graph = stream, None

    def one_of(self, frame: Any) -> Any:
        """The first, third, … line of PyAV's frame."""
        if self._graph is None:
            import av.filter

            self._graph = av.filter.Graph()
            self._graph.link_nodes(
                self._graph.add_buffer(template=self._stream),
                self._graph.add("field", "top"),
                self._graph.add("buffersink"),
            ).configure()
        self._graph.vpush(frame)
        return self._graph.vpull()


@contextmanager
def opened(file: Path) -> Iterator[Any]:
    """The container of a video in PyAV; what can't be read is raised as `CaptureFailed`."""
    try:
        with opened_video(file) as container:
            yield container
    except DatasetInvalid as error:
        raise CaptureFailed(file, f"{error.problem}: it is no video, or was cut off; copy or record it again") from None


def recording(file: Path, container: Any) -> Any:
    """The stream of PyAV's container that is the recording. Raises `CaptureFailed` if there is none."""
    if container.format.name in NO_VIDEO or container.format.name.endswith("_pipe"):
        raise CaptureFailed(file, "is not a video: give a video, or a folder of images")
    from av.stream import Disposition as Is

    beside = Is.attached_pic | Is.still_image | Is.timed_thumbnails | Is.dependent  # such as a cover
    streams = [s for s in container.streams.video if not s.disposition & beside]
    if not streams:
        raise CaptureFailed(file, "has no video in it: give a video, or a folder of images")
    if not any(s.codec_context.width for s in streams):
        raise CaptureFailed(file, "says nothing of its frames, so it was cut off: copy or record it again")
    return max(
        streams, key=lambda s: (bool(s.disposition & Is.default), s.codec_context.width * s.codec_context.height)
    )
