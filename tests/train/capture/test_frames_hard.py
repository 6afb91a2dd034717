"""Recordings that no frames can be taken of, or only some; and what is never written."""

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from av.stream import Disposition

from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.frames import extract_frames
from tests.train.capture.clips import HEIGHT, WIDTH, picture, pictures, write_clip, write_sound
from tests.train.capture.test_frames import read
from tests.train.datasets.test_video_rotation import turn

SECRETS = ("Canary1Device", "+37.3318-122.0312", "2019-07-04T11:22:33Z", "Canary2Software", "Canary3Datum")


def only_sound(folder: Path) -> Path:
    with av.open(str(folder / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=16000, layout="mono")
        write_sound(container, stream, np.sin(np.arange(16000)))
    return folder / "sound.mp4"


def stored(folder: Path, name: str, content: bytes) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


def folder_of(folder: Path, name: str, file: str = "") -> Path:
    (folder / name).mkdir()
    if file:
        (folder / name / file).mkdir() if "." not in file else (folder / name / file).write_bytes(b"-")
    return folder / name


def one_picture(folder: Path) -> Path:
    cv2.imwrite(str(folder / "photo.jpg"), picture(0))
    return folder / "photo.jpg"


def unequal(folder: Path) -> Path:
    images = folder_of(folder, "unequal")
    cv2.imwrite(str(images / "1.png"), picture(0))
    cv2.imwrite(str(images / "2.png"), picture(0)[:-2])
    return images


def cut_off(folder: Path) -> Path:
    images = folder_of(folder, "cut")
    content = cv2.imencode(".jpg", picture(0))[1].tobytes()
    stored(images, "a.jpg", content[: len(content) // 2])
    return images


def half(folder: Path, ending: str, muxer: dict[str, str] | None = None, part: float = 0.6) -> Path:
    rng = np.random.default_rng(0)
    noise = [np.clip(im + rng.normal(0, 20, im.shape), 0, 255).astype(np.uint8) for im in pictures(24)]
    clip = write_clip(folder / f"whole.{ending}", noise, muxer=muxer, options={"crf": "18", "g": "6"})
    content = clip.read_bytes()
    return stored(folder, f"half.{ending}", content[: int(part * len(content))])


REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "sound only": (only_sound, r"sound\.mp4: has no video in it"),
    "a text": (lambda folder: stored(folder, "notes.txt", b"hello\n" * 50), r"notes\.txt: .*(no|not a) video"),
    "a text called mp4": (lambda folder: stored(folder, "a.mp4", b"hello\n" * 50), r"a\.mp4: .*(no|not a) video"),
    "an empty file": (lambda folder: stored(folder, "empty.mp4", b""), r"empty\.mp4: can't be read: .* cut off"),
    "an image": (one_picture, r"photo\.jpg: is not a video"),
    "a folder without images": (lambda folder: folder_of(folder, "none", "a.txt"), "none: has no images in it"),
    "a folder of videos": (lambda folder: folder_of(folder, "clips", "a.mp4"), r"but videos such as a\.mp4"),
    "a folder of folders": (lambda folder: folder_of(folder, "rig", "cam0"), "but folders such as cam0"),
    "images of a phone": (lambda folder: folder_of(folder, "phone", "a.HEIC"), r"a\.HEIC: is HEIC, .* convert .* JPEG"),
    "a damaged image": (lambda folder: folder_of(folder, "bad", "a.png"), r"a\.png: can.t be read: .* convert it"),
    "an image that is cut off": (cut_off, r"a\.jpg: is cut off: copy it again"),
    "images of two sizes": (unequal, r"2\.png: is 96×62, but 1\.png is 96×64: give images of one size"),
    "all black": (lambda folder: write_clip(folder / "a.mp4", [np.zeros((64, 96, 3), np.uint8)] * 9), "is black"),
    "all gray": (lambda folder: write_clip(folder / "a.mp4", [np.full((64, 96, 3), 99, np.uint8)] * 9), "of one color"),
    "cut off before its end": (lambda folder: half(folder, "mp4"), r"half\.mp4: .*(cut off|no video)"),
    "cut off in its first frame": (lambda folder: half(folder, "mkv", part=0.02), r"half\.mkv: .*(cut off|decoded)"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_holds_no_frames_is_refused_in_words(tmp_path: Path, name: str):
    make, message = REFUSED[name]
    with pytest.raises(CaptureFailed, match=message):
        extract_frames([make(tmp_path)], tmp_path / "out")


@pytest.mark.parametrize(("ending", "muxer"), [("mp4", {"movflags": "faststart"}), ("mkv", {}), ("ts", {})])
def test_of_a_truncated_file_what_can_be_decoded_is_used_and_it_is_said(tmp_path: Path, ending: str, muxer: Any):
    clip = half(tmp_path, ending, muxer)
    frames = extract_frames([clip], tmp_path / "out")
    whole = extract_frames([tmp_path / f"whole.{ending}"], tmp_path / "whole")
    assert 6 <= len(frames.frames) < 24
    for one, two in zip(frames.frames, whole.frames, strict=False):
        assert one.time == two.time
        assert (read(tmp_path / "out", one.name) == read(tmp_path / "whole", two.name)).all()
    if ending == "mp4":  # its header says how many there were
        assert "cut off or damaged" in frames.notes[0]


def test_black_frames_at_the_start_are_left_out(tmp_path: Path):
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    frames = extract_frames([write_clip(tmp_path / "a.mp4", [black] * 4 + pictures(8))], tmp_path / "out")
    assert (frames.black, len(frames.frames), frames.cuts) == (4, 8, ())
    assert frames.frames[0].time == pytest.approx(4 / 30)


@pytest.mark.parametrize("count", [1, 8])
def test_few_frames_are_all_taken(tmp_path: Path, count: int):
    frames = extract_frames([write_clip(tmp_path / "a b ü 1:2.mp4", pictures(count))], tmp_path / "out")
    assert len(frames.frames) == frames.cameras[0].available == count
    assert frames.notes == ()


def test_a_mirrored_matrix_mirrors(tmp_path: Path):
    clip = write_clip(tmp_path / "a.mp4", pictures(1), options={"crf": "0"})
    turn(clip, (-1, 0, 0, 1))
    extract_frames([clip], tmp_path / "out")
    assert np.abs(read(tmp_path / "out", "00000.png") - np.fliplr(picture(0))).mean() < 3


def test_odd_sizes(tmp_path: Path):
    clip = write_clip(tmp_path / "a.mp4", [picture(0, 97, 63)], pixels="yuv444p")
    frames = extract_frames([clip], tmp_path / "out")
    assert read(tmp_path / "out", frames.frames[0].name).shape == (63, 97, 3)


def test_4k_of_10_bits(tmp_path: Path):
    image = cv2.resize(picture(0), (3840, 2160))
    clip = write_clip(tmp_path / "a.mp4", [image], pixels="yuv420p10le", options={"preset": "ultrafast"})
    frames = extract_frames([clip], tmp_path / "out")
    assert (frames.cameras[0].width, frames.cameras[0].height) == (1024, 576)
    assert np.abs(read(tmp_path / "out", "00000.png") - cv2.resize(image, (1024, 576))).mean() < 3


def test_hdr_is_said(tmp_path: Path):
    colors = {"color_trc": 18, "color_primaries": 9, "colorspace": 9}
    clip = write_clip(
        tmp_path / "a.mp4",
        pictures(2),
        pixels="yuv420p10le",
        colors=colors,
    )
    assert "a.mp4 is HDR (HLG)" in extract_frames([clip], tmp_path / "out").notes[0]


def test_interlaced_frames_are_not_combed(tmp_path: Path):
    """Even lines of a bar are where it was, odd lines where it is a field later."""
    image = np.full((64, 96, 3), 40, np.uint8)
    image[0::2, 20:40] = image[1::2, 40:60] = 220
    options = {"x264-params": "tff=1", "crf": "0"}
    clip = write_clip(tmp_path / "a.mp4", [image, image[:, ::-1]], options=options, interlaced=True)
    frames = extract_frames([clip], tmp_path / "out")
    pixels = read(tmp_path / "out", "00000.png")
    assert pixels[8:-8, 25:35].min() > 190
    assert pixels[8:-8, 45:55].max() < 70
    assert "is interlaced" in frames.notes[0]


def test_a_cover_is_not_the_video(tmp_path: Path):
    clip = tmp_path / "a.mp4"
    with av.open(str(clip), "w") as container:
        cover: Any = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 640, 640, "yuvj420p"
        cover.disposition = Disposition.attached_pic
        stream: Any = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        container.mux(cover.encode(av.VideoFrame.from_ndarray(picture(0, 640, 640), format="rgb24")))
        container.mux(cover.encode())
        for image in pictures(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    camera = extract_frames([clip], tmp_path / "out").cameras[0]
    assert (camera.width, camera.height, camera.available) == (WIDTH, HEIGHT, 3)


def write_image(file: Path, pixels: np.ndarray, **attributes: Any) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], pixels.dtype.name)
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    writer = oiio.ImageOutput.create(str(file))
    assert writer is not None
    assert writer.open(str(file), spec)
    assert writer.write_image(np.ascontiguousarray(pixels))
    writer.close()


def test_images_of_many_kinds_become_8_bit_rgb_upright(tmp_path: Path):
    images = tmp_path / "images"
    images.mkdir()
    shown = pictures(6)
    opaque = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
    half_transparent = opaque // 2
    gray = shown[2].mean(axis=2, keepdims=True).astype(np.uint8)
    write_image(images / "1.png", shown[0].astype(np.uint16) * 257)
    write_image(images / "2.png", np.concatenate([shown[1], half_transparent], axis=2), oiio__UnassociatedAlpha=1)
    write_image(images / "3.png", gray)
    write_image(images / "4.JPG", shown[3])
    write_image(images / "6.jpeg", np.rot90(shown[4]), Orientation=6)
    (images / "10.jpg").write_bytes(cmyk(shown[5]))
    (images / "._4.JPG").write_bytes(b"of macOS")
    frames = extract_frames([images], tmp_path / "out")
    assert [frame.time for frame in frames.frames] == pytest.approx(np.array([0, 1, 2, 3, 5, 9]) / 30)
    wanted = [shown[0], shown[1] / 255 * 127, np.repeat(gray, 3, axis=2), shown[3], shown[4], shown[5]]
    for frame, pixels in zip(frames.frames, wanted, strict=True):
        assert np.abs(read(tmp_path / "out", frame.name) - pixels).mean() < 4
    assert "30 images per second are assumed" in frames.notes[0]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientations_of_exif(tmp_path: Path, orientation: int):
    """A picture is stored as it has to be, to be shown upright."""
    shown = picture(0)
    kept = {1: shown, 2: shown[:, ::-1], 3: shown[::-1, ::-1], 4: shown[::-1]}
    kept |= {5: shown.swapaxes(0, 1), 6: np.rot90(shown), 7: np.rot90(shown, 2).swapaxes(0, 1), 8: np.rot90(shown, -1)}
    (tmp_path / "images").mkdir()
    write_image(tmp_path / "images" / "1.jpg", kept[orientation], Orientation=orientation)
    extract_frames([tmp_path / "images"], tmp_path / "out")
    assert np.abs(read(tmp_path / "out", "00000.png") - shown).mean() < 4


def cmyk(pixels: np.ndarray) -> bytes:
    """A JPEG of inverted CMYK, as Adobe's programs write it."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).convert("CMYK").save(stream, "jpeg", quality=95)
    return stream.getvalue()


def test_nothing_of_the_recording_is_written_but_pixels(tmp_path: Path):
    private = tmp_path / "home-of-somebody"
    private.mkdir()
    device, place, date, software, datum = SECRETS
    metadata = {"make": device, "location": place, "creation_time": date, "encoder": software, "title": device}
    clip = write_clip(private / "a.mp4", pictures(3), metadata=metadata, muxer={"movflags": "use_metadata_tags"})
    assert all(secret.encode() in clip.read_bytes() for secret in (device, place))
    images = private / "images"
    images.mkdir()
    for index in range(3):
        options = {"Make": device, "ImageDescription": place, "DateTime": date, "Software": software}
        write_image(images / f"{index}.jpg", picture(index), **options, GPS__MapDatum=datum)
    assert all(secret.encode() in (images / "0.jpg").read_bytes() for secret in (device, datum))
    for source in (clip, images):
        frames = extract_frames([source], tmp_path / "out")
        frames.save(tmp_path / "out" / "frames.json")
        assert FrameSet.load(tmp_path / "out" / "frames.json") == frames
        for file in (tmp_path / "out").iterdir():
            content = file.read_bytes()
            assert not any(secret.encode() in content for secret in (*SECRETS, "somebody", str(tmp_path)))
            if file.suffix == ".png":
                assert chunks(content) == {"IHDR", "IDAT", "IEND"}


def chunks(content: bytes) -> set[str]:
    """Names of the chunks of a PNG."""
    names, place = set(), 8
    while place < len(content):
        (length,) = struct.unpack(">I", content[place : place + 4])
        names.add(content[place + 4 : place + 8].decode())
        place += 12 + length
    return names
