"""Where the targets and stalks of a synthetic flight are on its orthophoto.

    rowgram synth flight --preset small --photo-truth -o field
    venv/bin/python benches/ortho/twin.py --field field --rowgram target/release/rowgram --work /tmp/twin [--aligned]

With the true poses, lens and ground, or with --aligned with those of `rowgram align field` and `rowgram surface dem field`.
The map is drawn on the ground, where the bases of the stalks are.

Targets: the saddle point of each target's pattern in the mosaic (cv2.cornerSubPix) against the target's true place.
Stalks: at the true place of each stalk's base the provenance raster names a photo and a pixel; the generator knows at
which pixel of that photo the base truly is. The difference, in ground sampling distances of that photo, is how far
the mosaic shows the base from its place.
"""

import argparse
import csv
import json
import os
import subprocess
import sys

import cv2
import numpy as np
import rasterio


def table(path):
    with open(path) as file:
        return list(csv.DictReader(file))


def summary(name, errors, gsd):
    errors = np.array(errors) / gsd
    return {
        "what": name, "count": len(errors), "median_gsd": float(np.median(errors)) if len(errors) else None,
        "p95_gsd": float(np.percentile(errors, 95)) if len(errors) else None,
        "largest_gsd": float(errors.max()) if len(errors) else None,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", required=True)
    parser.add_argument("--rowgram", default="target/release/rowgram")
    parser.add_argument("--work", required=True)
    parser.add_argument("--aligned", action="store_true")
    parser.add_argument("--gsd", type=float)
    args = parser.parse_args()
    os.makedirs(args.work, exist_ok=True)
    truth = f"{args.field}/truth"
    folder = f"{args.field}/rowgram/ortho" if args.aligned else args.work
    mosaic = f"{folder}/ortho.tif"
    options = ["--canopy-height-m", "0", "--force", "--json"]
    if args.gsd:
        options += ["--gsd-m", str(args.gsd)]
    if args.aligned:
        command = [args.rowgram, "ortho", args.field, *options]
    else:
        options += ["-o", mosaic, "--figures", f"{args.work}/pictures"]
        dem = f"{args.work}/dem.tif"
        with rasterio.open(f"{truth}/dem.asc") as file:
            with open(f"{truth}/dem.prj") as prj:
                crs = rasterio.crs.CRS.from_wkt(prj.read())
            profile = dict(driver="GTiff", dtype="float64", count=1, width=file.width, height=file.height,
                           transform=file.transform, crs=crs, nodata=file.nodata)
            with rasterio.open(dem, "w", **profile) as out:
                out.write(file.read(1).astype(float), 1)
        command = [args.rowgram, "ortho", "--poses", f"{truth}/exterior_orientation.csv", "--camera",
                   f"{truth}/camera.toml", "--photos", f"{args.field}/images", "--dem", dem, *options]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    gsd = json.loads(done.stdout)["gsd_m"]
    with rasterio.open(mosaic) as file:
        colours, place = file.read(), file.transform
    full = f"{args.work}/origins.tif"
    subprocess.run([args.rowgram, "ortho", "query", mosaic, "--write", full, "--force"], check=True, capture_output=True)
    with rasterio.open(full) as file:
        provenance = file.read()
    with open(f"{folder}/ortho.json") as file:
        photos = [photo["name"] for photo in json.load(file)["photos"]]
    grey = cv2.cvtColor(np.moveaxis(colours[:3], 0, 2), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape

    def cell(e, n):
        u, v = ~place * (e, n)
        return u - 0.5, v - 0.5

    targets = []
    for row in table(f"{truth}/gcps.csv"):
        u, v = cell(float(row["easting_m"]), float(row["northing_m"]))
        if not (8 <= u < width - 8 and 8 <= v < height - 8) or colours[3, round(v), round(u)] == 0:
            continue
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
        found = cv2.cornerSubPix(grey, np.array([[[u, v]]], np.float32), (4, 4), (-1, -1), criteria)[0, 0]
        targets.append(float(np.hypot(found[0] - u, found[1] - v)) * gsd)
    stalks, known = [], {}
    for k, name in enumerate(photos):
        path = f"{truth}/photos/{os.path.splitext(name)[0]}.csv"
        if os.path.exists(path):
            known[k] = {row["plant"]: (float(row["u_px"]), float(row["v_px"])) for row in table(path)}
    for number, row in enumerate(table(f"{truth}/plants.csv")):
        u, v = cell(float(row["easting_m"]), float(row["northing_m"]))
        i, j = round(u), round(v)
        if not (0 <= i < width and 0 <= j < height) or provenance[0, j, i] < 0:
            continue
        source = int(provenance[0, j, i])
        base = known.get(source, {}).get(row.get("plant", str(number)))
        if base is None:
            continue
        # The pixel of the place itself, from those of the cells around it.
        step = [
            (provenance[1:3, j, i + 1] - provenance[1:3, j, i - 1]) / 2 if 0 < i < width - 1 else None,
            (provenance[1:3, j + 1, i] - provenance[1:3, j - 1, i]) / 2 if 0 < j < height - 1 else None,
        ]
        if any(s is None for s in step) or np.abs(step).max() > 5:
            continue
        pixel = provenance[1:3, j, i] + (u - i) * step[0] + (v - j) * step[1]
        scale = gsd / np.sqrt(abs(step[0][0] * step[1][1] - step[0][1] * step[1][0]))
        stalks.append(float(np.hypot(*(pixel - base))) * scale)
    inside = colours[3] > 0
    closed = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((25, 25)))
    holes = int((closed[30:-30, 30:-30] > 0).sum() - inside[30:-30, 30:-30][closed[30:-30, 30:-30] > 0].sum())
    black = int(((colours[:3].max(0) == 0) & inside).sum())
    print(json.dumps({
        "gsd_m": gsd, "size": [width, height], "targets": summary("targets", targets, gsd),
        "stalks": summary("stalks", stalks, gsd), "holes_px": holes, "black_px": black,
    }, indent=1))


if __name__ == "__main__":
    main()
