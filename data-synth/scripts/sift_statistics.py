#!/usr/bin/env python3
"""How photos look to SIFT: features per megapixel, their scales, and how well neighbours match.

    python sift_statistics.py FOLDER... [--pairs 6] [--csv FILE]

Each FOLDER holds photos (jpg); consecutive ones by name, `--pairs` of them spread evenly, are matched. Needs
opencv-python-headless and numpy (written with 5.0 and 2.x). One line per folder:

    features_per_mp   key points per megapixel, OpenCV's SIFT with its default thresholds
    scale_px          median diameter of the key points (OpenCV's `size`), pixels
    large             share of key points with a diameter above 8 px
    response          median contrast of the key points
    distance          median L2 distance of inlier descriptors (OpenCV's bytes, norm about 512)
    nearest           median distance to the nearest descriptor of the other photo, all key points
    ratio             median of nearest over second nearest distance, all key points
    matched           share of key points with a mutual nearest neighbour below ratio 0.8
    inliers           share of those that agree with one fundamental matrix (MAGSAC, 1.5 px)
    gradient          mean absolute difference of neighbouring pixels' grey values, 0-255
    deviation         standard deviation of the grey values, 0-255
"""
import argparse
import csv
import pathlib
import sys

import cv2
import numpy as np

COLUMNS = ["set", "photos", "features_per_mp", "scale_px", "large", "response", "distance", "nearest",
           "ratio", "matched", "inliers", "gradient", "deviation"]


def describe(path, sift):
    """Key points and descriptors of one photo, with its own numbers."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        sys.exit(f"{path}: not a photo that OpenCV reads")
    points, descriptors = sift.detectAndCompute(grey, None)
    size = np.array([p.size for p in points])
    values = grey.astype(float)
    return {
        "xy": np.array([p.pt for p in points]),
        "descriptors": descriptors,
        "features_per_mp": len(points) / (grey.size / 1e6),
        "scale_px": float(np.median(size)),
        "large": float(np.mean(size > 8)),
        "response": float(np.median([p.response for p in points])),
        "gradient": float(np.abs(np.diff(values, axis=1)).mean()),
        "deviation": float(values.std()),
    }


def compare(a, b):
    """How two neighbouring photos match."""
    def two_nearest(p, q):
        matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(p["descriptors"], q["descriptors"], k=2)
        index = np.array([m[0].trainIdx for m in matches])
        first = np.array([m[0].distance for m in matches])
        second = np.array([m[1].distance for m in matches])
        return index, first, second

    forth, first, second = two_nearest(a, b)
    back, _, _ = two_nearest(b, a)
    mutual = back[forth] == np.arange(len(forth))
    good = mutual & (first < 0.8 * second)
    pairs = np.flatnonzero(good)
    inliers = np.zeros(len(pairs), bool)
    if len(pairs) >= 16:
        _, mask = cv2.findFundamentalMat(a["xy"][pairs], b["xy"][forth[pairs]], cv2.USAC_MAGSAC, 1.5, 0.999, 20000)
        if mask is not None:
            inliers = mask.ravel().astype(bool)
    return {
        "distance": float(np.median(first[pairs][inliers])) if inliers.any() else float("nan"),
        "nearest": float(np.median(first)),
        "ratio": float(np.median(first / np.maximum(second, 1e-9))),
        "matched": float(good.mean()),
        "inliers": float(inliers.mean()) if len(inliers) else float("nan"),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=pathlib.Path)
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--most", type=int, default=20000, help="key points kept for matching, strongest first")
    parser.add_argument("--csv", type=pathlib.Path)
    args = parser.parse_args()
    cv2.setRNGSeed(1)
    sift = cv2.SIFT_create()
    rows = []
    for folder in args.folders:
        photos = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg"))
        if len(photos) < 2:
            sys.exit(f"{folder}: expected at least two photos")
        starts = sorted(set(np.linspace(0, len(photos) - 2, args.pairs).round().astype(int)))
        cache = {}
        def photo(index):
            if index not in cache:
                cache[index] = describe(photos[index], sift)
            return cache[index]
        pairs = []
        for start in starts:
            a, b = dict(photo(start)), dict(photo(start + 1))
            for one in (a, b):
                if len(one["xy"]) > args.most:
                    rng = np.random.default_rng(1)
                    keep = rng.choice(len(one["xy"]), args.most, replace=False)
                    one["xy"], one["descriptors"] = one["xy"][keep], one["descriptors"][keep]
            pairs.append(compare(a, b))
        row = {"set": folder.parent.name if folder.name == "images" else folder.name, "photos": len(cache)}
        for key in COLUMNS[2:]:
            source = list(cache.values()) if key in next(iter(cache.values())) else pairs
            row[key] = float(np.nanmedian([one[key] for one in source]))
        rows.append(row)
        print("  ".join(f"{k}={row[k]:.3f}" if isinstance(row[k], float) else f"{k}={row[k]}" for k in COLUMNS), flush=True)
    if args.csv:
        with open(args.csv, "w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)


main()
