"""Leaves found in side views of maize and sorghum against the annotated leaf tips.

    python3 leaf_tips.py ROWGRAM DATA/leaf_maize_sorghum_side OUT.csv

Thresholds and the smallest leaf are chosen on the training list (smallest mean absolute error) and reported on
the validation list. The stem is one label more than there are tips, so one is taken off the count of labels.
"""

import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

TAUS = ["25,90,60,255", "25,90,100,255"]
SMALLEST = [30, 60, 120, 240]


def listed(path):
    with open(path, newline="") as file:
        for row in csv.DictReader(file, delimiter="\t"):
            yield row["fn"], len(json.loads(row["targets"])["x"])


def areas(rowgram, photo, tau, folder):
    table = Path(folder) / "leaves.csv"
    subprocess.run(
        [rowgram, "leaves", photo, "--tau", tau, "-o", table, "--force"], check=True, capture_output=True
    )
    with open(table, newline="") as file:
        return [int(row["area_px"]) for row in csv.DictReader(file)]


def main(rowgram, data, out):
    root = next(path for path in Path(data).iterdir() if path.is_dir())
    lists = {name: list(listed(root / f"example_{name}.csv")) for name in ("training", "validation")}
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, photos in lists.items():
            for photo, _ in photos:
                for tau in TAUS:
                    path = root / "example_images" / photo
                    found[photo, tau] = areas(rowgram, path, tau, folder)

    def errors(name, tau, smallest):
        for photo, tips in lists[name]:
            count = sum(area >= smallest for area in found[photo, tau]) - 1
            yield photo, tips, max(count, 0)

    def mean_size(rows):
        rows = list(rows)
        return sum(abs(count - tips) for _, tips, count in rows) / len(rows)

    settings = [(tau, smallest) for tau in TAUS for smallest in SMALLEST]
    best = min(settings, key=lambda s: mean_size(errors("training", *s)))
    with open(out, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["list", "photo", "tips", "leaves"])
        for name in lists:
            rows = list(errors(name, *best))
            writer.writerows([name, *row] for row in rows)
            bias = sum(count - tips for _, tips, count in rows) / len(rows)
            tips = sum(tips for _, tips, _ in rows) / len(rows)
            print(f"{name}: {len(rows)} photos, {tips:.1f} tips each, |error| {mean_size(rows):.2f}, bias {bias:+.2f}")
    print(f"--tau {best[0]}, leaves of {best[1]} pixels or more")


if __name__ == "__main__":
    main(*sys.argv[1:])
