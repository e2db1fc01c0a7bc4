"""Leaves found in side views of maize and sorghum against the annotated leaf tips.

    python3 leaf_tips.py ROWGRAM DATA/leaf_maize_sorghum_side OUT.csv

Connected pixels fewer than 500 are not the plant. The smallest leaf is chosen on the training list (smallest mean absolute error) and reported on
the validation list. The stem is one label more than there are tips, so one is taken off the count of labels.
"""

import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

TAU = "25,90,100,255"
SMALLEST = [60, 120, 240, 480]


def listed(path):
    with open(path, newline="") as file:
        for row in csv.DictReader(file, delimiter="\t"):
            yield row["fn"], len(json.loads(row["targets"])["x"])


def areas(rowgram, photo, folder):
    mask, table = Path(folder) / "mask.png", Path(folder) / "leaves.csv"
    for command in (
        ["segment", photo, "--tau", TAU, "--min-pixels", "500", "-o", mask],
        ["leaves", mask, "-o", table],
    ):
        subprocess.run([rowgram, *command, "--force"], check=True, capture_output=True)
    with open(table, newline="") as file:
        return [int(row["area_px"]) for row in csv.DictReader(file)]


def main(rowgram, data, out):
    root = next(path for path in Path(data).iterdir() if path.is_dir())
    lists = {name: list(listed(root / f"example_{name}.csv")) for name in ("training", "validation")}
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, photos in lists.items():
            for photo, _ in photos:
                found[photo] = areas(rowgram, root / "example_images" / photo, folder)

    def errors(name, smallest):
        for photo, tips in lists[name]:
            count = sum(area >= smallest for area in found[photo]) - 1
            yield photo, tips, max(count, 0)

    def mean_size(rows):
        rows = list(rows)
        return sum(abs(count - tips) for _, tips, count in rows) / len(rows)

    best = min(SMALLEST, key=lambda smallest: mean_size(errors("training", smallest)))
    with open(out, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["list", "photo", "tips", "leaves"])
        for name in lists:
            rows = list(errors(name, best))
            writer.writerows([name, *row] for row in rows)
            bias = sum(count - tips for _, tips, count in rows) / len(rows)
            tips = sum(tips for _, tips, _ in rows) / len(rows)
            print(f"{name}: {len(rows)} photos, {tips:.1f} tips each, |error| {mean_size(rows):.2f}, bias {bias:+.2f}")
    print(f"leaves of {best} pixels or more")


if __name__ == "__main__":
    main(*sys.argv[1:])
