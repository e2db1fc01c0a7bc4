#!/usr/bin/env python3
"""Writes hsv.txt: what OpenCV makes of all 2^24 colours.

    pip install opencv-python-headless numpy
    python3 tests/golden/hsv.py

One line for each red value 0..255: the CRC-32 of the bytes H S V H S V ... that
cv2.cvtColor(..., COLOR_RGB2HSV) gives for all green (slowest) and blue values. No tolerance: the
conversion is integer arithmetic, so equal means equal. Every byte is also held against the formula
in fixed point as src/raster/hsv.rs states it, written here from that statement in numpy.
"""

import pathlib
import zlib

import cv2
import numpy as np

SHIFT = 12


def reciprocals(numerator):
    table = np.zeros(256, np.int64)
    # numpy's rint rounds half to even
    table[1:] = np.rint(numerator / np.arange(1.0, 256.0)).astype(np.int64)
    return table


SATURATION = reciprocals(float(255 << SHIFT))
HUE = reciprocals((180 << SHIFT) / 6.0)


def formula(rgb):
    r, g, b = (rgb[..., i].astype(np.int64) for i in range(3))
    v = rgb.max(-1).astype(np.int64)
    d = v - rgb.min(-1)
    n = np.where(v == r, g - b, np.where(v == g, b - r + 2 * d, r - g + 4 * d))
    half = 1 << (SHIFT - 1)
    s = (d * SATURATION[v] + half) >> SHIFT
    h = (n * HUE[d] + half) >> SHIFT
    h = np.where(h < 0, h + 180, h)
    return np.stack([h, s, v], -1)


def main():
    lines = [
        f"# CRC-32 of OpenCV's HSV bytes, one line for each red value (hsv.py, cv2 {cv2.__version__})"
    ]
    green, blue = np.meshgrid(np.arange(256), np.arange(256), indexing="ij")
    for red in range(256):
        rgb = np.stack([np.full_like(green, red), green, blue], -1).astype(np.uint8)
        hsv = cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV)
        assert np.array_equal(hsv, formula(rgb)), f"red {red}: OpenCV departs from the formula"
        lines.append(f"{zlib.crc32(hsv.tobytes()):08x}")
    path = pathlib.Path(__file__).with_name("hsv.txt")
    path.write_text("\n".join(lines) + "\n")
    print(f"{path}: {len(lines) - 1} lines, all equal to the formula")


if __name__ == "__main__":
    main()
