"""How fast a surface is matched, beside semi-global matching of pairs by OpenCV, in one run.

    cargo bench --bench dense --no-run
    python3 benches/surface/speed.py PROGRAM PROJECT [target/release/deps/dense-...]

PROJECT has been aligned and has a surface of tie points (`rowgram run PROJECT --until dem`). `rowgram surface` is run as a whole on one thread: photos
read, coarse and fine pass, 64 layers or more, the reference and four others, prior, heights with standard deviations, ground, files
written. Beside it `StereoSGBM` with MODE_HH (eight paths), 64 disparities, blocks of 5, one thread, on a photo of the project and the same one
moved: aggregation of one pair and nothing else. The bench, where it is given, is the same work by rowgram: census and aggregation of one pair. Processor time of the best of three, per million cells with two photos and per million
pixels. Needs numpy and opencv-python.
"""

import json
import pathlib
import resource
import subprocess
import sys
import time

import cv2
import numpy as np

ROUNDS = 3


def spent(run):
    """Processor time of a program, and what it says."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    said = subprocess.run(run, check=True, capture_output=True, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, said


def surface(program, project):
    def once():
        seconds, said = spent([program, "surface", str(project), "--force", "--quiet", "--json", "--threads", "1"])
        return seconds / json.loads(said)["cells_seen"] * 1e6

    return min(once() for _ in range(ROUNDS))


def kernel(bench):
    def once():
        seconds, said = spent([bench])
        return seconds / int(said.rsplit("pixels: ", 1)[1]) * 1e6

    return min(once() for _ in range(ROUNDS))


def pair(project):
    folder = project / "images" if (project / "images").is_dir() else project
    photo = next(path for path in sorted(folder.iterdir()) if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif"))
    left = cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE)
    right = np.roll(left, -20, axis=1)
    cv2.setNumThreads(1)
    matcher = cv2.StereoSGBM_create(0, 64, 5, 8 * 25, 32 * 25, mode=cv2.STEREO_SGBM_MODE_HH)

    def once():
        begin = time.process_time()
        found = matcher.compute(left, right)
        spent = time.process_time() - begin
        # It has to have done its work.
        assert abs(np.median(found[:, 100:-100]) / 16 - 20) < 0.5
        return spent / left.size * 1e6

    return min(once() for _ in range(ROUNDS))


def main():
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    program, project = sys.argv[1], pathlib.Path(sys.argv[2])
    whole, one = surface(program, project), pair(project)
    print(f"rowgram surface, all of it: {whole:.2f} s per million cells")
    print(f"StereoSGBM MODE_HH, one pair: {one:.2f} s per million pixels")
    print(f"four pairs: {4 * one:.2f}; ratio {whole / (4 * one):.2f}")
    if len(sys.argv) == 4:
        own = kernel(sys.argv[3])
        print(f"census and aggregation of one pair: {own:.3f} s per million pixels, {one / own:.1f} times as fast as StereoSGBM")


if __name__ == "__main__":
    main()
