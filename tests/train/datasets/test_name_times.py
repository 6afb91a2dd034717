"""Times from the names of images: spellings that have one meaning, spellings that are ambiguous, and numbers that are
no times."""

import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import product

import pytest

from msdgs_train.datasets.common.hexadecimal import as_decimal
from msdgs_train.datasets.common.name_times import (
    NameWithoutTime,
    Reading,
    readings,
    times_by_pattern,
    times_in_order,
)

CAMERAS, FRAMES = 3, 14
GRID = list(product(range(CAMERAS), range(FRAMES)))
SECONDS = [7 * index for index in range(FRAMES)]
"""Seconds over two minutes, at irregular places in them."""


def read(names: Sequence[str], cameras: Sequence[int] | None = None, lenses: Sequence[int] | None = None):
    """The readings of names; `cameras` of those that stand still."""
    return readings(names, cameras or range(len(names)), lenses or [0] * len(names))


def since_first(reading: Reading) -> list[float]:
    return [float(time - min(reading.times)) for time in reading.times]


def clock(seconds: int, form: str, hour: int = 23, minute: int = 59) -> str:
    """A moment after 23:59, or after another time, on 31 December, past midnight if need be."""
    total = hour * 3600 + minute * 60 + seconds
    days, rest = divmod(total, 86400)
    year, month, day = ((2023, 12, 31), (2024, 1, 1))[days]
    month_name = {12: "Dec", 1: "January"}[month]
    values = {
        "b": month_name,
        "H": rest // 3600,
        "h": (rest // 3600 + 11) % 12 + 1,
        "M": rest // 60 % 60,
        "S": rest % 60,
    }
    return form.format(Y=year, m=month, d=day, p="PM" if rest // 3600 >= 12 else "AM", **values)


ONE_CAMERA: dict[str, Callable[[int], str]] = {
    "padded": lambda i: f"frame_{i:05}",
    "not padded": lambda i: f"frame_{i}",
    "bare, six digits": lambda i: f"{50 * i:06}",
    "bare": lambda i: f"{i:03}",
    "scale before": lambda i: f"images_4/frame_{i:05}",
    "scale after": lambda i: f"frame_{i:05}_2x",
    "scale x2": lambda i: f"frame_{i}_x2",
    "scale @": lambda i: f"{i:05}@2x",
    "height": lambda i: f"frame_{i:05}-1080p",
    "size and rate": lambda i: f"clip_3840x2160_60fps_{i:06}_v2",
    "of a known number": lambda i: f"frame_{i:03}_of_{FRAMES}",
    "constant day": lambda i: f"2024-01-31_{i:04}",
    "constant day and 6 digits": lambda i: f"20240131_{55 + i:06}",
    "constant recording": lambda i: f"GX010023_{i:06}",
    "constant scene": lambda i: f"0001_r_{i}",
    "seconds": lambda i: f"t_{i / 8}",
    "seconds of 3 digits": lambda i: f"{i / 8:.3f}",
    "seconds with comma": lambda i: f"t_{i / 8}".replace(".", ","),
    "halves": lambda i: f"frame_{12 + i / 2}",
    "whole and halves": lambda i: f"frame_{12 + i / 2:g}",
    "hyphen before": lambda i: f"clip -{i:04}",
    "hyphen in parentheses": lambda i: f"clip(-{i + 1})",
    "hyphen first": lambda i: f"-{i}",
    "hexadecimal": lambda i: f"cam_face/frame_{i:04x}",
    "hexadecimal of every second": lambda i: f"frame{2 * i + 246:X}",
    "seconds and milliseconds": lambda i: f"f_{i * 125 // 1000}s{i * 125 % 1000}ms",
    "minutes and seconds": lambda i: f"clip_{(50 + i) // 60}m{(50 + i) % 60}s",
    "below 0": lambda i: f"t_{i - 5}",
    "decimals below 0": lambda i: f"t=-{(FRAMES - i) / 8}",
    "signed": lambda i: f"t_{i / 4 - 1:+.2f}",
    "signed after a letter": lambda i: f"frame{i - 5:+03}",
    "below 0 after a letter": lambda i: f"frame{i - 5}",
    "below 0 after a hyphen": lambda i: f"frame-{i - 5}",
    "minus of typography": lambda i: f"t_{i - 5}".replace("-", "\u2212"),
    "exponents": lambda i: f"t_{2.5e-05 * i}",
    "p for the point": lambda i: f"t{i // 2}p{i % 2 * 5}",
    "pt for the point": lambda i: f"run3_{i // 2}pt{i % 2 * 5}",
    "seconds, then minutes": lambda i: f"{f'{(50 + i) // 60}m' * (i > 9)}{(50 + i) % 60:02}s",
    "minutes, then hours": lambda i: f"clip_{50 + i}m" if i < 10 else f"clip_1h{i - 10:02}m",
    "milliseconds, then seconds": lambda i: (
        f"{i * 125}ms" if i < 8 else f"{i // 8}s{i % 8 * 125}ms".replace("s0ms", "s")
    ),
    "numbered copies": lambda i: f"IMG_1234{f' ({i})' * (i > 0)}",
    "days with names of months": lambda i: f"{10 + i}Jan2024",
    "dots are no decimals": lambda i: f"shot010.{1 + i}",
    "milliseconds since 1970": lambda i: f"{1706745599600 + 100 * i}",
    "nanoseconds since 1970": lambda i: f"{1706745599600000000 + 100 * i}",
    "seconds since 1970": lambda i: f"rgb/{1706745599 + i / 16:.6f}",
    "two parts since 1970": lambda i: f"{1706745599 + i // 4}_{i % 4 * 250000000:09}",
    "part of a video": lambda i: f"part{i // 5}_{i:04}",
    "photo beside": lambda i: f"{i:04}_IMG_{4711 + i * i}",
    "hashes of digits": lambda i: f"frame_{i:04}-3f2",
    "two numbers as one": lambda i: f"{i:04}/{i:04}_rgb",
    "frame and seconds": lambda i: f"frame_{i:04}_t{i / 8:.3f}",
    "index and milliseconds": lambda i: f"{i:06}_{1706745599900 + 33 * i}",
    "dates": lambda i: f"2024-01-{10 + i:02}",
}


@pytest.mark.parametrize("spell", ONE_CAMERA.values(), ids=ONE_CAMERA)
def test_the_number_that_varies_is_the_time(spell: Callable[[int], str]):
    (reading,) = read([f"{spell(index)}.png" for index in range(FRAMES)])
    step = since_first(reading)[1]
    assert step > 0
    assert [time / step for time in since_first(reading)] == pytest.approx(list(range(FRAMES)))


CLOCKS = (
    "{Y}{m:02}{d:02}_{H:02}{M:02}{S:02}",
    "{Y}{m:02}{d:02}{H:02}{M:02}{S:02}",
    "{Y}-{m:02}-{d:02}T{H:02}-{M:02}-{S:02}",
    "{Y}-{m:02}-{d:02}T{H:02}-{M:02}-{S:02}.250",
    "{Y}-{m:02}-{d:02}T{H:02}:{M:02}:{S:02}Z",
    "{Y}{m:02}{d:02}T{H:02}{M:02}{S:02}Z",
    "{Y}_{m:02}_{d:02}_{H:02}_{M:02}_{S:02}",
    "IMG_{Y}{m:02}{d:02}_{H:02}{M:02}{S:02}_123",
    "IMG_{Y}{m:02}{d:02}_{H:02}{M:02}{S:02}_123_x2",
    "PXL_{Y}{m:02}{d:02}_{H:02}{M:02}{S:02}123",
    "signal-{Y}-{m:02}-{d:02}-{H:02}-{M:02}-{S:02}-250",
    "Screenshot {Y}-{m:02}-{d:02} at {h:02}.{M:02}.{S:02} {p}",
    "Screenshot {Y}-{m:02}-{d:02} at {h}.{M:02}.{S:02}\u202f{p}",
    "Screenshot {Y}-{m:02}-{d:02} at {H}.{M:02}.{S:02}",
    "vlcsnap-{Y}-{m:02}-{d:02}-{H:02}h{M:02}m{S:02}s250",
    "{Y}{m:02}{d:02}/{Y}{m:02}{d:02}_{H:02}{M:02}{S:02}",
    "{Y}-{m:02}-{d:02}/{H:02}-{M:02}-{S:02}",
    "{Y}{m:02}{d:02}/{H:02}{M:02}{S:02}",
    "cam_{H:02}{M:02}{S:02}_x2",
    "{d:02}-{m:02}-{Y}_{H:02}-{M:02}-{S:02}",
    "{d:02}.{m:02}.{Y} {H:02}.{M:02}.{S:02}",
    "IMG{d:02}{b}{Y}_{H:02}{M:02}{S:02}",
    "{Y}-{b}-{d}_{H:02}-{M:02}-{S:02}",
    "{b} {d}, {Y} at {h}.{M:02}.{S:02} {p}",
    "{d}{b}{Y}{H:02}{M:02}{S:02}",
    "DJI_{Y}{m:02}{d:02}{H:02}{M:02}{S:02}_0001_V",
    "{H:02}-{M:02}-{S:02}",
    "{H:02}h{M:02}m{S:02}s",
    "video_{H:02}:{M:02}:{S:02}.500",
)


@pytest.mark.parametrize("form", CLOCKS)
def test_date_and_clock_are_one_time_also_past_midnight(form: str):
    (reading,) = read([f"{clock(second, form)}.jpg" for second in SECONDS])
    assert since_first(reading) == SECONDS


def test_fractions_of_seconds_count():
    names = [clock(i // 4, "IMG_{Y}{m:02}{d:02}_{H:02}{M:02}{S:02}") + f"_{i % 4 * 250:03}.jpg" for i in range(FRAMES)]
    (reading,) = read(names)
    assert since_first(reading) == [i / 4 for i in range(FRAMES)]
    for form in ("vlcsnap-{Y}-{m:02}-{d:02}-{H:02}h{M:02}m{S:02}s", "vlcsnap-{H:02}h{M:02}m{S:02}s", "{M}m{S:02}s"):
        names = [clock(i // 4, form, 0, 1) + f"{i % 4 * 250:03}.png" for i in range(FRAMES)]
        assert since_first(read(names)[0]) == [i / 4 for i in range(FRAMES)]
    names = [clock(i // 4, "{H:02}-{M:02}-{S:02}", 0, 1) + f".{i % 4 * 250:03}.jpg" for i in range(FRAMES)]
    assert since_first(read(names)[0]) == [i / 4 for i in range(FRAMES)]


def test_cameras_need_not_be_synchronous():
    names = [clock(i, f"cam{c}/{{Y}}-{{m:02}}-{{d:02}}T{{H:02}}-{{M:02}}-{{S:02}}.{c}50.png") for c, i in GRID]
    assert since_first(read(names)[0]) == pytest.approx([i + c / 10 for c, i in GRID])


def test_copies_of_a_name_in_the_same_second_share_its_time():
    names = ["IMG_20240131_235958.jpg", "IMG_20240131_235958(1).jpg", "IMG_20240201_000003.jpg"]
    assert since_first(read(names)[0]) == [0, 0, 5]


SEVERAL_CAMERAS: dict[str, Callable[[int, int], str]] = {
    "camera's folder": lambda c, i: f"cam{c:02}/{i:06}",
    "camera's folder, images below": lambda c, i: f"cam{c:02}/images/{i:06}",
    "folder of cameras": lambda c, i: f"cameras/{c}/{i:06}",
    "folder of frames": lambda c, i: f"frames/{i}/{c}",
    "time's folder": lambda c, i: f"{i:06}/cam{c:02}",
    "camera first": lambda c, i: f"cam_{c}_{i}",
    "camera last": lambda c, i: f"{i:04}_camera{c}",
    "letters": lambda c, i: f"cam{'ABC'[c]}_{i}",
    "letters in folders": lambda c, i: f"{'ABC'[c]}/{i:03}",
    "letter and number": lambda c, i: f"Camera_B{c}/{i:06}",
    "sides": lambda c, i: f"{('left', 'right', 'top')[c]}_{i:04}",
    "sides with numbers": lambda c, i: f"{('left1', 'right2', 'top3')[c]}_{i:04}",
    "sides last": lambda c, i: f"{i:06}_{('left', 'right', 'top')[c]}",
    "unlike cameras": lambda c, i: f"{('cam1', 'cam2', 'drone')[c]}/{i:04}",
    "serial numbers": lambda c, i: f"{('18182E3B', '2019A4C1', 'FF5503')[c]}/{i:04}",
    "frame is called so": lambda c, i: f"{c}_frame_{i:04}",
    "time is called so": lambda c, i: f"{c}_t{i / 4}",
    "dot after the camera": lambda c, i: f"cam{c}.{i:04}",
    "clock": lambda c, i: clock(i, f"cam{c}_{{Y}}{{m:02}}{{d:02}}_{{H:02}}{{M:02}}{{S:02}}"),
    "clock and number": lambda c, i: clock(i, f"{c}_{{Y}}{{m:02}}{{d:02}}_{{H:02}}{{M:02}}{{S:02}}"),
    "letters before numbers": lambda c, i: f"C{c:04}_F{i:05}",
    "dot before the camera": lambda c, i: f"{i:06}.cam{c}",
    "constant rig": lambda c, i: f"rig1_cam{c}_time{i}_x2",
    "scale suffix": lambda c, i: f"cam{c}/{i:04}_x2",
}


@pytest.mark.parametrize("spell", SEVERAL_CAMERAS.values(), ids=SEVERAL_CAMERAS)
def test_each_camera_has_each_time(spell: Callable[[int, int], str]):
    (reading,) = read([f"{spell(*pair)}.png" for pair in GRID])
    step = sorted(set(since_first(reading)))[1]
    assert [time / step for time in since_first(reading)] == [frame for _, frame in GRID]


AMBIGUOUS: dict[str, Callable[[int, int], str]] = {
    "Technicolor": lambda c, i: f"Camera_undist_{i:05}_{c:02}",
    "camera, then frame": lambda c, i: f"{c:02}_{i:04}",
    "folders": lambda c, i: f"{c:02}/{i:04}",
    "folders of times": lambda c, i: f"{i:04}/{c:02}",
    "renderings": lambda c, i: f"{c:04}_r_{i}",
    "minus": lambda c, i: f"{c:02}-{i:02}",
    "three numbers like a clock": lambda c, i: f"00-{c:02}-{i:02}",
    "two numbers like a decimal": lambda c, i: f"{c}.{i:04}",
    "street": lambda c, i: f"image_{c:02}/{i:010}",
    "Panoptic Studio": lambda c, i: f"hdImgs/00_{c:02}/00_{c:02}_{i:08}",
    "rest of a sentence": lambda c, i: f"{i} of {c}",
    "cameras or several in a second": lambda c, i: clock(i, f"{{Y}}{{m:02}}{{d:02}}_{{H:02}}{{M:02}}{{S:02}}_0{c}"),
    "the same of 3 digits": lambda c, i: clock(i, f"{{Y}}{{m:02}}{{d:02}}_{{H:02}}{{M:02}}{{S:02}}_00{c}"),
}


@pytest.mark.parametrize("spell", AMBIGUOUS.values(), ids=AMBIGUOUS)
def test_cameras_decide_where_names_alone_are_ambiguous(spell: Callable[[int, int], str]):
    names = [f"images/{spell(*pair)}.png" for pair in GRID]
    found = read(names)
    assert len(found) == 2
    for reading in found:
        assert reading.pattern is not None
        assert times_by_pattern(names, re.compile(reading.pattern)) == reading.times
    cameras = [camera for camera, _ in GRID]
    for decided in (read(names, cameras=cameras), read(names, lenses=cameras)):
        assert [since_first(reading) for reading in decided] == [[frame for _, frame in GRID]]


UNDECIDED = {
    "frames of several scenes": lambda c, i: f"scene{c}/frame_{i:04}",
    "frames of several takes": lambda c, i: f"take{c}_frame_{i:04}",
    "chapters of a camera": lambda c, i: f"GX0{c + 1}0023_{i:06}",
    "clips with their start": lambda c, i: clock(60 * c, "{Y}{m:02}{d:02}_{H:02}{M:02}00") + f"_frame_{i:04}",
    "two cameras' numbers": lambda c, i: f"cam{c}_cam{i}",
}


@pytest.mark.parametrize("spell", UNDECIDED.values(), ids=UNDECIDED)
def test_frames_that_may_start_again_are_ambiguous(spell: Callable[[int, int], str]):
    assert len(read([f"{spell(*pair)}.png" for pair in GRID])) == 2


def test_copies_with_a_number_of_their_own_are_ambiguous():
    assert len(read(["frame_0001.png", "frame_0002.png", "frame_0002 (1).png"])) == 2


@pytest.mark.parametrize("spell", ["a.png", "left_1.png", "cam1/frame_1.png"])
def test_equal_numbers_are_no_times(spell: str):
    assert read([spell]) == []
    assert read(["left_1.png", "right_1.png"]) == []
    assert read(["c1/0005.png", "c2/0005.png"]) == read(["frame_3/cam1.png", "frame_3/cam2.png"]) == []


@pytest.mark.parametrize(("spell", "called"), [("IMG_{:04}", "photo"), ("_DSC{}", "photo"), ("cam{}", "camera")])
def test_numbers_of_cameras_and_photos_are_called_so(spell: str, called: str):
    assert [reading.called for reading in read([spell.format(12 + index) for index in range(4)])] == [called]


def test_a_name_without_a_number_is_named():
    for names in (["front.png", "back.png"], ["a_1.png", "cam07/front.png"], ["a_1.png", "front.png"]):
        with pytest.raises(NameWithoutTime, match=r"front\.png"):
            read(names)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("12", 12), ("-3", -3), ("0.25", 0.25), ("1,5", 1.5), ("00_01_02", 62), ("01-05", 65), ("1m05.5s", 65.5)],
)
def test_a_pattern_finds_numbers_and_clocks(text: str, seconds: float):
    assert times_by_pattern([f"cam_{text}_x2"], re.compile("cam_(.*)_x2")) == (Fraction(seconds),)
    assert times_by_pattern([f"7_{text}"], re.compile("(.)_(?P<time>.*)")) == (Fraction(seconds),)


def test_a_pattern_reads_all_names_alike():
    names = [f"f_{20 * index:06}.png" for index in range(20)]  # some, but not all, are clocks
    assert times_by_pattern(names, re.compile(r"f_(\d+)")) == tuple(20 * index for index in range(20))
    names = ["59.jpg", "01_00.jpg", "01_01.5.jpg"]
    assert times_by_pattern(names, re.compile(r"(.*)\.jpg")) == (59, 60, 61.5)


@pytest.mark.parametrize("name", ["frame_x", "frame_", "other_1"])
def test_a_name_that_a_pattern_does_not_fit_is_named(name: str):
    with pytest.raises(NameWithoutTime, match=name):
        times_by_pattern(["frame_1", name], re.compile("frame_(.*)"))


def test_the_order_of_names_is_that_of_their_numbers_and_shared_by_folders():
    names = ["a/f10.png", "a/f2.png", "b/f09.jpg", "b/f2.jpg", "b/g.jpg"]
    assert [int(time) for time in times_in_order(names)] == [2, 0, 1, 0, 3]
    assert times_in_order([f"{index:02x}.png" for index in range(40)]) == tuple(range(40))


def test_hashes_are_no_hexadecimal_counters():
    names = [f"{index * index * 7919 % 65536:04x}_{index:03}.png" for index in range(FRAMES)]
    assert names == as_decimal(names)
    assert as_decimal(["cam_1a.png", "cam_2a.png", "cam_3a.png"]) == ["cam_1a.png", "cam_2a.png", "cam_3a.png"]


def test_several_images_in_a_second_are_ambiguous():
    for form in (
        "{Y}{m:02}{d:02}_{H:02}{M:02}{S:02}",
        "{Y}-{m:02}-{d:02}/{H:02}-{M:02}-{S:02}",
        "A_{H:02}-{M:02}-{S:02}",
    ):
        names = [clock(i // 4, form) + f"-{i % 4 + 1:02}.jpg" for i in range(FRAMES)]
        assert len(read(names)) == 2
