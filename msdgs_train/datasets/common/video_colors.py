"""Pixels of a decoded video frame in 8-bit sRGB, as people see the video on a usual screen.

The matrix, the range of values and the number of bits are those that the frame names; without a matrix it is BT.601, as
in FFmpeg. SDR keeps its code values, as all players do. Wider primaries (BT.2020, Display P3) are converted to those of
sRGB, whose colors outside of it are cut off.

HDR (PQ, HLG) becomes light on a display of 1,000 cd/m² (BT.2100, with a system gamma of 1.2 for HLG). White of diffuse
surfaces, 203 cd/m² by BT.2408, is 1; values above `KNEE` are compressed by a Möbius function of the largest component
so that the display's peak becomes 1, as FFmpeg's `tonemap=mobius` does. The curve is the same for all frames.
"""

from functools import cache
from typing import Any

import numpy as np

PQ, HLG = 16, 18
"""Transfer functions of HDR by their numbers in ISO/IEC 23091-2."""

BT709 = ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060))
WIDE = {
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),  # BT.2020
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),  # Display P3
}
"""x, y of red, green and blue by the primaries' number in ISO/IEC 23091-2; white is D65 in all."""

D65 = (0.3127, 0.3290)
BT2020_LUMA = np.array([0.2627, 0.6780, 0.0593], np.float32)
DIFFUSE_WHITE, DISPLAY_PEAK = 203.0, 1000.0  # cd/m²
KNEE = 0.5
"""Light, relative to diffuse white, up to which HDR isn't compressed."""


def as_srgb(frame: Any, width: int, height: int) -> np.ndarray:
    """Convert PyAV's frame to uint8 RGB [height, width, 3]; each new pixel is the mean over the area that it covers."""
    transfer = int(frame.color_trc)
    if transfer not in (PQ, HLG) and int(frame.color_primaries) not in WIDE:
        return _resampled(frame, "rgb24", width, height)
    light = _light_table(transfer)[_resampled(frame, "rgb48le", width, height)]
    if transfer in (PQ, HLG):
        light = _tone_mapped(_on_display(light) if transfer == HLG else light)
    light = np.clip(light @ _to_bt709(int(frame.color_primaries)).T, 0, 1)
    return (255 * _encoded(light) + 0.5).astype(np.uint8)


def as_grey(frame: Any, width: int, height: int) -> np.ndarray:
    """Convert PyAV's frame to uint8 brightness [height, width], of full range, in the frame's own transfer function."""
    return _resampled(frame, "gray", width, height)


def _resampled(frame: Any, layout: str, width: int, height: int) -> np.ndarray:
    """Differs from `resize_area` by less than 0.5 of 255 on average. FFmpeg's default skips half of the chroma at the
    full size and at half of it, and differs by 1.4 to 5."""
    from av.video.reformatter import Interpolation

    area = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
    return frame.to_ndarray(format=layout, interpolation=area, width=width, height=height)


@cache
def _light_table(transfer: int) -> np.ndarray:
    """float32 [65536]: light of each 16-bit value. PQ is relative to diffuse white, HLG and SDR to their largest."""
    value = np.arange(65536) / 65535
    if transfer == PQ:  # SMPTE ST 2084
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        root = value ** (1 / m2)
        light = 10000 / DIFFUSE_WHITE * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
    elif transfer == HLG:  # BT.2100
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(value <= 0.5, value**2 / 3, (np.exp((value - c) / a) + b) / 12)
    else:  # the inverse of `_encoded`, so that gray keeps its values
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


def _on_display(scene: np.ndarray) -> np.ndarray:
    """The light of HLG on the display, relative to diffuse white, from that of the scene, [H, W, 3]."""
    luma = np.maximum(scene @ BT2020_LUMA, 1e-9)[..., None]
    return DISPLAY_PEAK / DIFFUSE_WHITE * luma**0.2 * scene


def _tone_mapped(light: np.ndarray) -> np.ndarray:
    """Scale each pixel of [H, W, 3] so that its largest component is compressed."""
    largest, peak = light.max(axis=2, keepdims=True), DISPLAY_PEAK / DIFFUSE_WHITE
    a = -(KNEE**2) * (peak - 1) / (KNEE**2 - 2 * KNEE + peak)
    b = (KNEE**2 - 2 * KNEE * peak + peak) / (peak - 1)
    compressed = (b * b + 2 * b * KNEE + KNEE**2) / (b - a) * (largest + a) / (largest + b)
    return light * np.where(largest > KNEE, compressed / np.maximum(largest, KNEE), 1)


@cache
def _to_bt709(primaries: int) -> np.ndarray:
    """float32 [3, 3] from linear light in these primaries; HDR that names none has BT.2020's."""
    matrix = np.linalg.inv(_to_xyz(BT709)) @ _to_xyz(WIDE.get(primaries, BT709 if primaries == 1 else WIDE[9]))
    return matrix.astype(np.float32)


def _to_xyz(primaries: tuple[tuple[float, float], ...]) -> np.ndarray:
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in (*primaries, D65)]).T
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])


def _encoded(light: np.ndarray) -> np.ndarray:
    """sRGB's values, IEC 61966-2-1, of linear light."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
