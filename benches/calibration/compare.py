"""The calibration bench and OpenCV's calibrateCamera on the same corners, in turns.

Needs opencv-python and numpy:

    python benches/calibration/compare.py opencv_reference.json [rounds]

The file has `pattern` ([columns, rows]), `size` ([width, height]) and `corners` (for each photo a
list of [u, v], row by row, the centre of the top-left pixel at (0, 0)). OpenCV's time is that of
calibrateCamera with its own start, for five terms (k1, k2, p1, p2, k3) and for the rational model;
ours is printed by the bench: the search for a start, which ends with an adjustment, the adjustment
from there, and their sum, which is what compares with OpenCV's.
"""

import csv
import json
import os
import subprocess
import sys
import tempfile
import time

import cv2
import numpy as np

reference = json.load(open(sys.argv[1]))
rounds = int(sys.argv[2]) if len(sys.argv) > 2 else 3
columns, rows = reference["pattern"]
width, height = reference["size"]
board = np.zeros((columns * rows, 3), np.float32)
board[:, :2] = 0.025 * np.mgrid[:columns, :rows].T.reshape(-1, 2)
images = [np.array(c, np.float32).reshape(-1, 1, 2) for c in reference["corners"].values()]


def opencv(name, flags):
    times = []
    for _ in range(15):
        begin = time.perf_counter()
        found = cv2.calibrateCamera([board] * len(images), images, (width, height), None, None, flags=flags)
        times.append(1e3 * (time.perf_counter() - begin))
    print(
        f"OpenCV {cv2.__version__}, {name}: {len(images)} photos, rms {found[0]:.4f} px; "
        f"{np.median(times):.1f} ms (least {min(times):.1f})"
    )


with tempfile.TemporaryDirectory() as folder:
    path = os.path.join(folder, "corners.csv")
    with open(path, "w", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(["image", "column", "row", "u_px", "v_px"])
        for image, corners in reference["corners"].items():
            for k, (u, v) in enumerate(np.array(corners).reshape(-1, 2)):
                writer.writerow([image, k % columns, k // columns, u, v])
    environment = dict(
        os.environ,
        ROWGRAM_CORNERS=path,
        ROWGRAM_BOARD=f"{columns}x{rows}",
        ROWGRAM_SIZE=f"{width}x{height}",
    )
    for _ in range(rounds):
        subprocess.run(["cargo", "bench", "-q", "--bench", "calibration"], env=environment, check=True)
        opencv("5 terms", 0)
        opencv("8 terms", cv2.CALIB_RATIONAL_MODEL)
