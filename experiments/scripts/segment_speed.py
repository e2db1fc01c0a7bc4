#!/usr/bin/env python3
"""Throughput of the leaf mask: `experiments segment-speed` against OpenCV's cvtColor + inRange, and equal masks.

    pip install opencv-python-headless numpy
    cargo build --release -p experiments
    python3 experiments/scripts/segment_speed.py target/release/experiments

Both get the same 50-megapixel picture in memory and the same number of threads, take turns, and the best of eight
counts: neither files nor decoding are timed. OpenCV's mask is `inRange` on the hue, and on saturation or on value.
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import time

import cv2
import numpy as np

WIDTH, HEIGHT, THREADS = 8192, 6144, 2


def opencv(rgb):
    hsv = cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV)
    strong = cv2.inRange(hsv, (30, 30, 0), (79, 255, 255))
    bright = cv2.inRange(hsv, (30, 0, 163), (79, 255, 255))
    return cv2.bitwise_or(strong, bright)


def main():
    cv2.setNumThreads(THREADS)
    rng = np.random.default_rng(1)
    small = rng.integers(0, 256, (HEIGHT // 16, WIDTH // 16, 3), dtype=np.uint8)
    noise = rng.integers(0, 24, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    rgb = cv2.add(cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), noise)
    with tempfile.TemporaryDirectory() as folder:
        raw, mask = pathlib.Path(folder, "rgb.raw"), pathlib.Path(folder, "mask.raw")
        rgb.tofile(raw)
        theirs = ours = 1e9
        for _ in range(4):
            for _ in range(2):
                start = time.perf_counter()
                expected = opencv(rgb)
                theirs = min(theirs, time.perf_counter() - start)
            command = [sys.argv[1], "segment-speed", raw, str(WIDTH), str(HEIGHT), mask]
            environment = dict(os.environ, RAYON_NUM_THREADS=str(THREADS))
            out = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
            ours = min(ours, float(out.stdout))
        found = np.fromfile(mask, dtype=np.uint8).reshape(HEIGHT, WIDTH)
        different = int(np.count_nonzero((found > 0) != (expected > 0)))
    megapixels = WIDTH * HEIGHT / 1e6
    print(f"OpenCV {cv2.__version__}: {megapixels / theirs:.0f} Mpx/s, rowgram: {megapixels / ours:.0f} Mpx/s, "
          f"ratio {theirs / ours:.2f}, pixels that differ: {different}")
    return different != 0


if __name__ == "__main__":
    sys.exit(main())
