"""Image positions by OpenCV for tests/camera.rs: writes lenses.txt beside this file.

    python3 -m venv venv && venv/bin/pip install opencv-python-headless numpy
    venv/bin/python tests/golden/lenses.py

A line is: model, parameters in the order of rowgram's model, point in the camera frame of computer
vision (y down, z forward), pixel. Models: brown (12 parameters) and fisheye (8); OpenCV has no others of ours.
"""

from pathlib import Path

import cv2
import numpy as np

BROWN = [
    # f, aspect, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6
    [800.0, 1.0, 639.5, 479.5, 0, 0, 0, 0, 0, 0, 0, 0],
    [560.03, 1.0019, 651.08, 498.91, -0.2326, 0.0615, 0.0003, -0.0007, -0.0075, 0, 0, 0],
    [558.5, 1.002, 650.9, 499.2, 1.9, 0.31, 0.0002, -0.0006, 0.004, 2.17, 0.78, 0.041],
    [3500.0, 0.999, 1990.0, 1510.0, 0.05, -0.12, -0.001, 0.002, 0.04, 0, 0, 0],
]
FISHEYE = [
    # f, aspect, cx, cy, k1, k2, k3, k4
    [400.0, 1.0, 640.0, 480.0, 0, 0, 0, 0],
    [412.3, 1.001, 655.2, 470.1, 0.03, -0.012, 0.004, -0.0006],
]


def main() -> None:
    rng = np.random.default_rng(20261121)
    lines = []
    for values in BROWN:
        f, aspect, cx, cy = values[:4]
        matrix = np.array([[f, 0, cx], [0, f * aspect, cy], [0, 0, 1.0]], float)
        for _ in range(12):
            depth = rng.uniform(0.5, 20.0)
            point = np.array([*(rng.uniform(-0.6, 0.6, 2) * depth), depth])
            pixel, _ = cv2.projectPoints(
                point.reshape(1, 1, 3), np.zeros(3), np.zeros(3), matrix, np.array(values[4:], float)
            )
            lines.append(("brown", values, point, pixel.ravel()))
    for values in FISHEYE:
        f, aspect, cx, cy = values[:4]
        matrix = np.array([[f, 0, cx], [0, f * aspect, cy], [0, 0, 1.0]], float)
        for _ in range(12):
            depth = rng.uniform(0.5, 20.0)
            point = np.array([*(rng.uniform(-2.0, 2.0, 2) * depth), depth])
            pixel, _ = cv2.fisheye.projectPoints(
                point.reshape(1, 1, 3), np.zeros(3), np.zeros(3), matrix, np.array(values[4:], float)
            )
            lines.append(("fisheye", values, point, pixel.ravel()))
    with open(Path(__file__).with_name("lenses.txt"), "w") as out:
        out.write(f"# lenses.py, OpenCV {cv2.__version__}\n")
        for model, values, point, pixel in lines:
            numbers = [*values, *point, *pixel]
            out.write(model + " " + " ".join(repr(float(v)) for v in numbers) + "\n")


if __name__ == "__main__":
    main()
