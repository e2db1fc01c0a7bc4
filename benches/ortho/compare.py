"""Orthophotos of rowgram against those of orthority: positions, colours, speed.

    python -m venv venv && venv/bin/pip install orthority rio-cogeo
    venv/bin/python benches/ortho/compare.py --data <folder with ngi/, odm/, io/, reference/> \
        --rowgram target/release/rowgram --work /tmp/compare

Positions and colours: every orthophoto is made by both programs on the same grid from the same poses, lens and DEM.
In windows of 48 x 48 pixels the shift between the two is found by least squares on the gradients (Lucas-Kanade, until it
stands still); windows without texture are left out. `reference/` holds orthophotos made earlier by orthority 0.7.

Speed: both programs make the same frames on the same grid with the same number of threads, one after the other in
turns; the time is that of the whole process for rowgram, and for orthority without the start of Python and its imports.
"""

import argparse
import glob
import json
import os
import statistics
import subprocess
import sys
import time

import cv2
import numpy as np
import rasterio


def shifts(a, b, valid, size=48):
    """Shift of b against a in windows, in pixels (column, row)."""
    found = []
    h, w = a.shape
    for v in range(0, h - size, size):
        for u in range(0, w - size, size):
            if not valid[v : v + size, u : u + size].all():
                continue
            p = a[v : v + size, u : u + size].astype(float)
            d = np.zeros(2)
            for _ in range(15):
                m = np.float32([[1, 0, u + d[0]], [0, 1, v + d[1]]])
                q = cv2.warpAffine(
                    b.astype(np.float32), m, (size, size), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
                ).astype(float)
                gy, gx = np.gradient(0.5 * (p + q))
                gx, gy, r = (x[2:-2, 2:-2].ravel() for x in (gx, gy, p - q))
                one = np.ones_like(gx)
                j = np.stack([gx, gy, one], 1)
                n = j.T @ j
                if np.linalg.eigvalsh(n[:2, :2])[0] < 25 * len(gx) * 0.2:
                    d = None
                    break
                s = np.linalg.solve(n, j.T @ r)
                d = d + s[:2]
                if np.abs(s[:2]).max() < 1e-3:
                    break
            if d is not None and np.abs(d).max() < 5:
                found.append(d)
    return np.array(found)


def read(path):
    with rasterio.open(path) as file:
        pixels = file.read([1, 2, 3])
        valid = file.dataset_mask() > 0
        return pixels, valid, file.transform


def compare(ours, theirs, label):
    a, va, ta = read(theirs)
    b, vb, tb = read(ours)
    assert a.shape == b.shape and ta.almost_equals(tb, 1e-6), (ta, tb, a.shape, b.shape)
    both = cv2.erode((va & vb).astype(np.uint8), np.ones((9, 9))) > 0
    grey = [cv2.cvtColor(np.moveaxis(x, 0, 2), cv2.COLOR_RGB2GRAY) for x in (a, b)]
    d = shifts(grey[0], grey[1], both)
    length = np.hypot(d[:, 0], d[:, 1])
    colour = np.abs(a.astype(int) - b.astype(int))[:, both]
    result = {
        "frame": label,
        "windows": len(d),
        "median_offset_px": float(np.median(length)),
        "p90_offset_px": float(np.percentile(length, 90)),
        "mean_shift_px": [float(x) for x in d.mean(0)],
        "mean_colour_difference": float(colour.mean()),
        "median_colour_difference": float(np.median(colour)),
        "p95_colour_difference": float(np.percentile(colour, 95)),
        "only_ours_pixels": int((vb & ~va).sum()),
        "only_theirs_pixels": int((va & ~vb).sum()),
        "pixels": int(va.sum()),
    }
    print(json.dumps(result))
    return result


def rowgram(args, *options):
    done = subprocess.run([args.rowgram, *options], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(done.stderr)
    return json.loads(done.stdout)


def positions(args):
    data, work = args.data, args.work
    results = []
    common = ["--interpolation", "bicubic", "--dem-interpolation", "bicubic", "--provenance=false", "--balance=false", "--force", "--json"]
    ngi = [
        "--poses", f"{data}/io/ngi_xyz_opk.csv", "--camera", f"{data}/io/ngi_int_param.yaml",
        "--dem", f"{data}/ngi/dem.tif", "--photos", f"{data}/ngi",
    ]
    # Orthority takes angles as in the GeoJSON file for its references; the table has them to a thousandth of a degree.
    exact = ["--poses", f"{data}/io/ngi_ext_param.geojson", *ngi[2:]]
    for reference in sorted(glob.glob(f"{data}/reference/*_ORTHO.tif")):
        name = os.path.basename(reference).replace("_ORTHO.tif", "")
        out = f"{work}/{name}_reference.tif"
        rowgram(args, "ortho", *exact, "--only", name, "--like", reference, "-o", out, *common)
        results.append(compare(out, reference, f"reference {name}"))
    odm = f"{data}/odm"
    os.makedirs(f"{work}/odm", exist_ok=True)
    os.makedirs(f"{work}/ours", exist_ok=True)
    subprocess.run(
        [f"{os.path.dirname(sys.executable)}/oty", "-q", "frame", "--dem", f"{odm}/odm_dem/dsm.tif",
         "-ip", f"{odm}/opensfm/reconstruction.json", "-ep", f"{data}/io/odm_xyz_opk.csv", "-c", "EPSG:32651",
         "-r", "0.2", "-cm", "deflate", "-o", "-od", f"{work}/odm", *sorted(glob.glob(f"{odm}/images/*.tif"))],
        check=True,
    )
    for theirs in sorted(glob.glob(f"{work}/odm/*_ORTHO.tif")):
        name = os.path.basename(theirs).replace("_ORTHO.tif", "")
        out = f"{work}/ours/{name}.tif"
        rowgram(
            args, "ortho", "--poses", f"{data}/io/odm_xyz_opk.csv", "--camera", f"{odm}/opensfm/reconstruction.json",
            "--dem", f"{odm}/odm_dem/dsm.tif", "--photos", f"{odm}/images", "--only", name, "--like", theirs,
            "-o", out, *common,
        )
        results.append(compare(out, theirs, f"odm {name}"))
    return results


def speed(args):
    import orthority as oty

    data, work = args.data, args.work
    cv2.setNumThreads(args.threads)
    os.makedirs(f"{work}/speed_theirs", exist_ok=True)
    sources = sorted(glob.glob(f"{data}/ngi/*RGB.tif"))
    ratios = []
    os.makedirs(f"{work}/speed_ours", exist_ok=True)
    for turn in range(args.turns):
        started, cpu, pixels = time.perf_counter(), time.process_time(), 0
        cameras = oty.FrameCameras(f"{data}/io/ngi_int_param.yaml", f"{data}/io/ngi_xyz_opk.csv")
        for source in sources:
            out = f"{work}/speed_theirs/{os.path.basename(source)}"
            with rasterio.open(f"{data}/io/../ngi/dem.tif") as dem:
                crs = cameras.crs or dem.crs
            ortho = oty.Ortho(source, f"{data}/ngi/dem.tif", cameras.get(source), crs)
            ortho.process(
                out, resolution=(args.gsd, args.gsd), interp="bilinear", dem_interp="bilinear",
                compress=args.compress, overwrite=True,
            )
            with rasterio.open(out) as file:
                pixels += file.width * file.height
        theirs = pixels / (time.perf_counter() - started) * 1e-6
        theirs_cpu = pixels / (time.process_time() - cpu) * 1e-6
        before = os.times()
        started = time.perf_counter()
        report = rowgram(
            args, "ortho", "--poses", f"{data}/io/ngi_xyz_opk.csv", "--camera", f"{data}/io/ngi_int_param.yaml",
            "--dem", f"{data}/ngi/dem.tif", "--photos", f"{data}/ngi", "--frames", "--gsd-m", str(args.gsd),
            "-o", f"{work}/speed_ours/ortho.tif", "--provenance=false", "--balance=false", "--force", "--json", "--threads", str(args.threads),
        )
        seconds = time.perf_counter() - started
        after = os.times()
        # The mosaic of all of them is made too.
        pixels = sum(m["width_px"] * m["height_px"] for m in [report, *report["frames"]])
        ours = pixels / seconds * 1e-6
        used = after.children_user + after.children_system - before.children_user - before.children_system
        row = {
            "turn": turn, "megapixels": round(pixels * 1e-6, 1), "threads": args.threads,
            "orthority_mpx_per_s": round(theirs, 2), "rowgram_mpx_per_s": round(ours, 2), "ratio": round(ours / theirs, 2),
            "orthority_mpx_per_cpu_s": round(theirs_cpu, 2), "rowgram_mpx_per_cpu_s": round(pixels / used * 1e-6, 2),
        }
        ratios.append(ours / theirs)
        print(json.dumps(row))
    print(json.dumps({"median_ratio": statistics.median(ratios)}))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--rowgram", default="target/release/rowgram")
    parser.add_argument("--work", required=True)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--gsd", type=float, default=1.0, help="pixel of the speed comparison, metres")
    parser.add_argument("--compress", default=None, help="compression of orthority [its default: JPEG]")
    parser.add_argument("--only", choices=["positions", "speed"])
    args = parser.parse_args()
    os.makedirs(args.work, exist_ok=True)
    if args.only != "speed":
        results = positions(args)
        worst = max(r["median_offset_px"] for r in results)
        print(json.dumps({"largest_median_offset_px": worst}))
        if worst >= 0.1:
            sys.exit("the median offset is not below 0.1 px")
    if args.only != "positions":
        speed(args)


if __name__ == "__main__":
    main()
