"""How long scikit-learn's KMeans takes on the leaf pixels of a field, and how well it finds the plants.

    python -m venv /tmp/venv && /tmp/venv/bin/pip install scikit-learn pillow numpy
    /tmp/venv/bin/python benches/locate/kmeans.py MASK.png TRUTH.csv [--budget-s 60]

KMeans is told the true number of plants (one start, k-means++, its default tolerance and at most 300
iterations) and gets the leaf pixels of the first rows of pixels of the mask: 1/64 of it, 1/32, ... until
the next part is expected to take more processor time than the budget. A power law through the last two
parts says what the whole mask would take: pixels and plants both grow with the field, so about its square,
times whatever the number of iterations grows by. That last figure is an extrapolation and is printed as
one. F1 counts pairs within 5 and 10 cm, nearest first, one to one, at 1.5 cm per pixel.
"""

import argparse
import csv
import math
import sys
import time

import numpy
from PIL import Image
from sklearn.cluster import KMeans

GSD_M = 0.015


def f1(found, truth, radius_px):
    pairs = []
    for i, at in enumerate(found):
        distances = numpy.hypot(truth[:, 0] - at[0], truth[:, 1] - at[1])
        pairs.extend((distances[j], i, j) for j in numpy.flatnonzero(distances <= radius_px))
    left, right, matched = set(), set(), 0
    for _, i, j in sorted(pairs):
        if i not in left and j not in right:
            left.add(i)
            right.add(j)
            matched += 1
    return 2 * matched / (len(found) + len(truth))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mask")
    parser.add_argument("truth")
    parser.add_argument("--budget-s", type=float, default=60.0)
    arguments = parser.parse_args()
    Image.MAX_IMAGE_PIXELS = None
    mask = numpy.array(Image.open(arguments.mask).convert("L")) > 0
    with open(arguments.truth, newline="") as file:
        rows = list(csv.DictReader(file))
    truth = numpy.array([[float(row["u_px"]), float(row["v_px"])] for row in rows])

    print("share,pixels,plants,iterations,cpu_s,wall_s,f1_5cm,f1_10cm")
    share, runs = 1 / 64, []
    while share <= 1:
        height = int(mask.shape[0] * share)
        v, u = numpy.nonzero(mask[:height])
        pixels = numpy.column_stack([u, v]).astype(numpy.float32)
        plants = truth[truth[:, 1] < height - 0.5]
        if len(plants) == 0:
            sys.exit(f"error: no plant of {arguments.truth} lies in the first {height} rows of pixels")
        begin, cpu = time.perf_counter(), time.process_time()
        fit = KMeans(len(plants), n_init=1, random_state=0).fit(pixels)
        wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
        scores = [f1(fit.cluster_centers_, plants, radius / GSD_M) for radius in (0.05, 0.10)]
        runs.append((len(pixels), cpu))
        print(
            f"{share:.5f},{len(pixels)},{len(plants)},{fit.n_iter_},{cpu:.2f},{wall:.2f},"
            f"{scores[0]:.3f},{scores[1]:.3f}",
            flush=True,
        )
        growth = cpu / runs[-2][1] if len(runs) > 1 else 4.0
        if cpu * growth > arguments.budget_s:
            break
        share *= 2
    if share < 1 and len(runs) > 1:
        (n0, t0), (n1, t1) = runs[-2:]
        power = math.log(t1 / t0) / math.log(n1 / n0)
        whole = int(mask.sum())
        hours = t1 * (whole / n1) ** power / 3600
        print(f"extrapolated (not measured): {whole} pixels, power {power:.2f}, {hours:.1f} h of processor time")


if __name__ == "__main__":
    main()
