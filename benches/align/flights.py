"""Orients the real flights and prints one table: what is registered, how exactly, and what it takes.

    ROWGRAM_DATA=DATA python3 benches/align/flights.py [--rowgram target/release/rowgram] [--keep DIR] [NAME ...]

NAME is one of swindale, brighton, copr, seneca, fountain; all where none is given. Swindale is adjusted seven times, with other targets
as check points each time: six splits, and one with all control at the border. Features and matches are kept between
these (with --keep DIR also between runs of the script), so that processor time is that of the whole only in the first of them.

Columns: photos that are oriented; tie points; observations per tie point; reprojection rms; root mean square errors of check points in ground
sampling distances, X Y Z; the same over their own standard deviations (survey included); sigma0; processor time of all
threads. For the fountain: root mean square distance of the camera centres from the truth after a similarity, millimetres.
"""

import argparse
import json
import math
import os
import pathlib
import resource
import subprocess
import sys
import tempfile

FOLDERS = {
    "swindale": "uav_swindale_sw_half",
    "brighton": "uav_brighton_beach_half",
    "copr": "uav_copr_half",
    "seneca": "uav_seneca_strip_half",
    "fountain": "strecha_fountain_half",
}
SPLITS = [
    "12317 12369 12373 12374 12362",
    "12316 12318 12369 12364 12317",
    "12371 12362 12373 12372 12363",
    "12316 12371 12374 12369 12318",
    "12362 12373 12369 12317 12316",
    "12374 12363 12318 12362 12371",
]
# Control along the edge of the block only.
BORDER = "12369 12373 12374 12316 12318"


def processor_seconds():
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return children.ru_utime + children.ru_stime


def align(program, project, output, words):
    begin = processor_seconds()
    command = [program, "align", str(project), "-o", str(output), "--json", "--quiet", *words]
    done = subprocess.run(command, capture_output=True, check=False, text=True)
    if done.returncode not in (0, 3) or not done.stdout.strip():
        sys.exit(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-2000:]}")
    found = json.loads(done.stdout.strip().splitlines()[-1])
    report = json.loads((output / "align" / "report" / "report.json").read_text())
    return found, report, processor_seconds() - begin, done.returncode


def root_mean_square(values):
    return math.sqrt(sum(v * v for v in values) / len(values)) if values else float("nan")


def check_points(found, report, names):
    """Errors in GSD and over their standard deviations, X Y Z."""
    survey = 0.008
    points = [p for p in report["ground"] if p["role"] == "check" and p["name"] in names]
    errors, ratios = [], []
    for axis in range(3):
        errors.append(root_mean_square([p["difference_m"][axis] / found["gsd_m"] for p in points]))
        sigma = [math.hypot(p["sigma_m"][axis], survey) for p in points]
        ratios.append(root_mean_square([p["difference_m"][axis] / s for p, s in zip(points, sigma)]))
    return errors, ratios, points


def similarity_misfit(pairs):
    """Root mean square distance after the best similarity (Horn 1987), by power iteration."""
    n = len(pairs)
    mean = [[sum(p[side][k] for p in pairs) / n for k in range(3)] for side in range(2)]
    a = [[p[0][k] - mean[0][k] for k in range(3)] for p in pairs]
    b = [[p[1][k] - mean[1][k] for k in range(3)] for p in pairs]
    s = [[sum(x[i] * y[j] for x, y in zip(a, b)) for j in range(3)] for i in range(3)]
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = s
    matrix = [
        [xx + yy + zz, yz - zy, zx - xz, xy - yx],
        [yz - zy, xx - yy - zz, xy + yx, zx + xz],
        [zx - xz, xy + yx, yy - xx - zz, yz + zy],
        [xy - yx, zx + xz, yz + zy, zz - xx - yy],
    ]
    shift = sum(abs(v) for row in matrix for v in row)
    q = [1.0, 0.1, 0.2, 0.3]
    for _ in range(20000):
        q = [sum(matrix[i][j] * q[j] for j in range(4)) + shift * q[i] for i in range(4)]
        length = math.sqrt(sum(v * v for v in q))
        q = [v / length for v in q]
    w, x, y, z = q
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    turned = [[sum(turn[i][k] * p[k] for k in range(3)) for i in range(3)] for p in a]
    scale = sum(t[k] * o[k] for t, o in zip(turned, b) for k in range(3))
    scale /= sum(v * v for t in turned for v in t)
    left = [math.dist([scale * v for v in t], o) for t, o in zip(turned, b)]
    return root_mean_square(left)


def fountain_misfit(folder, output):
    truth = {}
    for file in (folder / "gt_dense_cameras_fullres").glob("*.camera"):
        rows = [line.split() for line in file.read_text().splitlines()]
        truth[file.name.removesuffix(".camera")] = [float(v) for v in rows[7][:3]]
    lines = (output / "align" / "exterior_orientation.csv").read_text().splitlines()
    head = lines[0].split(",")
    places = [next(k for k, name in enumerate(head) if name.lower().startswith(axis)) for axis in ("x", "y", "z")]
    pairs = []
    for line in lines[1:]:
        cells = line.split(",")
        stem = pathlib.Path(cells[0]).stem
        own = next((v for name, v in truth.items() if pathlib.Path(name).stem == stem), None)
        if own:
            pairs.append(([float(cells[k]) for k in places], own))
    return similarity_misfit(pairs)


def row(name, found, report, seconds, code, more=""):
    ratio = found["observations"] / max(found["tie_points"], 1)
    print(
        f"| {name} | {found['registered']}/{found['images']} in {found['fragments']} | {found['tie_points']} | {ratio:.2f} | "
        f"{found['reprojection_rms_px']:.3f} | {more} | {report['sigma0']:.2f} | {seconds:.0f} | {code} |",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rowgram", default="target/release/rowgram")
    parser.add_argument("--keep", type=pathlib.Path)
    parser.add_argument("--details", action="store_true", help="every check point of every split")
    parser.add_argument("--more", default="", help="further words for rowgram align")
    parser.add_argument("names", nargs="*", metavar="NAME")
    args = parser.parse_args()
    for name in args.names:
        if name not in FOLDERS:
            parser.error(f"{name} is none of {', '.join(FOLDERS)}")
    data = os.environ.get("ROWGRAM_DATA")
    if not data:
        sys.exit("ROWGRAM_DATA names no folder: set it to the folder with the real data")
    with tempfile.TemporaryDirectory() as work:
        keep = args.keep or pathlib.Path(work)
        words = args.more.split()
        print("| flight | photos in blocks | tie points | rays | rms px | check points GSD; over sigma | sigma0 | CPU s | exit |")
        print("|---|---|---|---|---|---|---|---|---|")
        for name in args.names or FOLDERS:
            folder, output = pathlib.Path(data) / FOLDERS[name], keep / name
            if not folder.is_dir():
                print(f"| {name} | no folder {folder} | | | | | | | |")
                continue
            output.mkdir(parents=True, exist_ok=True)
            if name != "swindale":
                found, report, seconds, code = align(args.rowgram, folder, output, words)
                more = ""
                if name == "fountain":
                    more = f"centres {1000 * fountain_misfit(folder, output):.1f} mm"
                row(name, found, report, seconds, code, more)
                continue
            all_errors, all_ratios = [], []
            for k, split in enumerate([*SPLITS, BORDER]):
                names = [f"StkdT_{number}" for number in split.split()]
                more = [*words, "--crs", "EPSG:27700", "--check", ",".join(names)]
                found, report, seconds, code = align(args.rowgram, folder, output, more)
                errors, ratios, points = check_points(found, report, names)
                text = " ".join(f"{v:.2f}" for v in errors) + "; " + " ".join(f"{v:.2f}" for v in ratios)
                row("swindale border" if k == len(SPLITS) else f"swindale {k + 1}", found, report, seconds, code, text)
                if args.details:
                    for p in points:
                        numbers = [f"{1000 * e:+.0f} +- {1000 * s:.0f}" for e, s in zip(p["difference_m"], p["sigma_m"])]
                        print(f"    {p['name']}: {', '.join(numbers)} mm")
                if k < len(SPLITS):
                    all_errors.append(errors)
                    all_ratios.append(ratios)
            for what, of in [
                ("means", lambda v: sum(v) / len(v)),
                ("worst", max),
            ]:
                text = " ".join(f"{of([e[axis] for e in all_errors]):.2f}" for axis in range(3))
                if what == "means":
                    text += "; " + " ".join(f"{root_mean_square([r[axis] for r in all_ratios]):.2f}" for axis in range(3))
                print(f"| swindale, {what} of six | | | | | {text} | | | |", flush=True)


if __name__ == "__main__":
    main()
