"""Compares rowgram's features with OpenCV's SIFT. See README.md beside this file."""

import argparse
import csv
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

ROOT = Path(__file__).resolve().parents[2]
PROBE = Path(os.environ.get("FEATURES_PROBE", Path(__file__).resolve().parent / "target/release/features-probe"))


def probe(*words, threads):
    """Runs the probe; its lines `name value ...` as a dictionary of lists."""
    environment = dict(os.environ, RAYON_NUM_THREADS=str(threads))
    run = subprocess.run([PROBE, *map(str, words)], env=environment, check=True, capture_output=True, text=True)
    found = {}
    for line in run.stdout.splitlines():
        name, *values = line.split()
        found.setdefault(name, []).append([float(value) for value in values])
    return found


def ours(picture, folder, threads, max_features=0, norm="l2", repeats=1):
    """Key points (u, v, sigma, angle, response), descriptors, wall and processor seconds of each repeat."""
    path = Path(folder) / "picture.png"
    cv2.imwrite(str(path), picture)
    out = Path(folder) / "found"
    seconds = probe("detect", path, out, max_features, norm, repeats, threads=threads)["seconds"]
    points = np.fromfile(str(out) + ".points", "<f4").reshape(-1, 5).astype(float)
    descriptors = np.fromfile(str(out) + ".descriptors", np.uint8).reshape(-1, 128)
    return points, descriptors, seconds


def theirs(picture, max_features=0):
    sift = cv2.SIFT_create(nfeatures=max_features, enable_precise_upscale=True)
    wall, processor = time.perf_counter(), processor_seconds()
    points, descriptors = sift.detectAndCompute(picture, None)
    seconds = [time.perf_counter() - wall, processor_seconds() - processor]
    points = np.array([[*p.pt, p.size / 2, np.radians(p.angle), p.response] for p in points]).reshape(-1, 5)
    return points, descriptors, seconds


def processor_seconds():
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def agreement(wanted, found):
    """Share of `wanted` with one of `found` within 0.1 px, 5 % of its blur and 0.1 rad."""
    tree = cKDTree(found[:, :2])
    near = 0
    for point, candidates in zip(wanted, tree.query_ball_point(wanted[:, :2], 0.1)):
        other = found[candidates]
        turn = np.abs((other[:, 3] - point[3] + np.pi) % (2 * np.pi) - np.pi)
        near += bool(np.any((np.abs(np.log(other[:, 2] / point[2])) < 0.05) & (turn < 0.1)))
    return near / len(wanted)


def project(h, points):
    mapped = np.c_[points[:, :2], np.ones(len(points))] @ h.T
    return mapped[:, :2] / mapped[:, 2:]


def scale_at(h, points):
    """How much the homography enlarges at each point: the root of its area factor."""
    step = 0.5
    u = project(h, points + [step, 0, 0, 0, 0]) - project(h, points - [step, 0, 0, 0, 0])
    v = project(h, points + [0, step, 0, 0, 0]) - project(h, points - [0, step, 0, 0, 0])
    return np.sqrt(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]))


def mutual(first, second, ratio=0.8):
    """Nearest in both directions that pass the ratio test in both."""
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    first, second = first.astype(np.float32), second.astype(np.float32)

    def nearest(a, b):
        pairs = matcher.knnMatch(a, b, k=2)
        return {p[0].queryIdx: p[0].trainIdx for p in pairs if len(p) == 2 and p[0].distance < ratio * p[1].distance}

    forward, backward = nearest(first, second), nearest(second, first)
    return [(i, j) for i, j in forward.items() if backward.get(j) == i]


def graffiti(h, one, other, size):
    """Repeatability and matching score of two sets of key points."""
    (points_1, descriptors_1), (points_2, descriptors_2) = one, other
    width, height = size

    def visible(points, h):
        at = project(h, points)
        return (at[:, 0] >= 0) & (at[:, 1] >= 0) & (at[:, 0] < width) & (at[:, 1] < height)

    seen_1, seen_2 = visible(points_1, h), visible(points_2, np.linalg.inv(h))
    points_1, descriptors_1 = points_1[seen_1], descriptors_1[seen_1]
    points_2, descriptors_2 = points_2[seen_2], descriptors_2[seen_2]
    there, sizes = project(h, points_1), points_1[:, 2] * scale_at(h, points_1)
    tree = cKDTree(points_2[:, :2])
    again = 0
    for at, size, near in zip(there, sizes, tree.query_ball_point(there, 1.5)):
        again += bool(np.any(np.abs(np.log(points_2[near, 2] / size)) < np.log(1.5)))
    fewer = min(len(points_1), len(points_2))
    matches = mutual(descriptors_1, descriptors_2)
    right = sum(np.linalg.norm(there[i] - points_2[j, :2]) < 3.0 for i, j in matches)
    return again / len(points_1), right / fewer, right / max(len(matches), 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    if not PROBE.exists():
        sys.exit(f"{PROBE} is missing: cargo build --release in benches/features")
    cv2.setNumThreads(options.threads)
    rows = []

    def report(question, subject, measure, own, other):
        rows.append([question, subject, measure, own, other])
        print(f"{question:10} {subject:16} {measure:24} rowgram {own:9.4g}   OpenCV {other:9.4g}", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        wall = [cv2.imread(str(options.data / f"match_graf/img{k}.png"), 0) for k in range(1, 7)]
        found = {"rowgram": [], "rowgram root": [], "OpenCV": []}
        for picture in wall:
            found["rowgram"].append(ours(picture, folder, options.threads)[:2])
            found["rowgram root"].append(ours(picture, folder, options.threads, norm="root")[:2])
            found["OpenCV"].append(theirs(picture)[:2])
        for k in range(6):
            own, other = found["rowgram"][k][0], found["OpenCV"][k][0]
            report("agreement", f"graf {k + 1}", "share within 0.1 px", agreement(other, own), agreement(own, other))
        size = wall[0].shape[::-1]
        for k in range(1, 6):
            h = np.loadtxt(options.data / f"match_graf/H1to{k + 1}p")
            scores = {name: graffiti(h, sets[0], sets[k], size) for name, sets in found.items()}
            for index, measure in enumerate(["repeatability", "matching score", "precision"]):
                report("graffiti", f"1 to {k + 1}", measure, scores["rowgram"][index], scores["OpenCV"][index])
                if index > 0:
                    own, other = scores["rowgram root"][index], scores["OpenCV"][index]
                    report("graffiti", f"1 to {k + 1}", measure + ", RootSIFT", own, other)

        photos = sorted((options.data / "uav_full_size_samples").iterdir())
        largest = None
        for photo in photos:
            picture = cv2.imread(str(photo), 0)
            for budget in (0, 8000):
                times = {"rowgram": [], "OpenCV": []}
                for _ in range(options.repeats):
                    points, descriptors, seconds = ours(picture, folder, options.threads, budget)
                    times["rowgram"].append(seconds[-1])
                    other, other_descriptors, seconds = theirs(picture, budget)
                    times["OpenCV"].append(seconds)
                subject = f"{photo.stem} {budget or 'all'}"
                report("speed", subject, "features", len(points), len(other))
                for index, measure in enumerate(["wall s", "processor s"]):
                    own, cv = (statistics.median(t[index] for t in times[name]) for name in ("rowgram", "OpenCV"))
                    report("speed", subject, measure, own, cv)
                    report("speed", subject, measure + " ratio", 1.0, cv / own)
                if budget == 0:
                    report("agreement", photo.stem, "share within 0.1 px", agreement(other, points), agreement(points, other))
                elif len(points) >= budget // 2:
                    largest = picture, other_descriptors

        if largest:
            picture, descriptors = largest
            half = picture.shape[1] // 2
            sides = [picture[:, : half + half // 2], picture[:, half // 2 :]]
            sets = [ours(side, folder, options.threads, 8000)[1] for side in sides]
            paths = [Path(folder) / name for name in ("one.bytes", "other.bytes")]
            for path, one in zip(paths, sets):
                one.tofile(path)
            seconds = probe("match", *paths, options.repeats, threads=options.threads)["seconds"]
            own = [statistics.median(column) for column in zip(*seconds)]
            first, second = (one.astype(np.float32) for one in sets)
            for name, matcher in [
                ("brute force", cv2.BFMatcher(cv2.NORM_L2)),
                ("FLANN", cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})),
            ]:
                wall, processor = time.perf_counter(), processor_seconds()
                matcher.knnMatch(first, second, k=2)
                matcher.knnMatch(second, first, k=2)
                other = [time.perf_counter() - wall, processor_seconds() - processor]
                for index, measure in enumerate(["wall s", "processor s"]):
                    subject = f"{len(first)} x {len(second)}"
                    report("matching", subject, f"{measure}, {name}", own[index], other[index])

    if options.csv:
        with options.csv.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["question", "subject", "measure", "rowgram", "OpenCV"])
            writer.writerows(rows)


if __name__ == "__main__":
    main()
