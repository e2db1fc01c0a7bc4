"""Two points against five on the real pairs of a flight: who orients which pairs, with how many matches, how well.

    python -m venv /tmp/venv && /tmp/venv/bin/pip install numpy
    /tmp/venv/bin/python benches/align/solvers.py PROJECT [--csv pairs.csv] [-- further words for rowgram align]

The flight is oriented as a whole first; its adjusted poses are what the pairs are held against: the angle
of the rotation between both, and the angle between both baselines. The pairs are oriented twice: with the camera
as the files tell it, and with the one that the whole flight calibrated. Pairs of photos that stand closer together than
a tenth of the usual base have no direction to speak of and are left out. Matches are the same for all.
"""

import argparse
import csv
import itertools
import json
import pathlib
import statistics
import subprocess
import tempfile

import numpy

SOLVERS = ["two-point", "five-point", "auto"]


def matrix(w, x, y, z):
    return numpy.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def poses(path):
    """Rotation and translation of each image, camera frame with y up and looking along -z."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    flip = numpy.diag([1.0, -1.0, -1.0])
    found = {}
    for line in lines[::2]:
        words = line.split()
        numbers = [float(word) for word in words[1:8]]
        found[words[9]] = (flip @ matrix(*numbers[:4]), flip @ numpy.array(numbers[4:]))
    return found


def degrees(cosine):
    return float(numpy.degrees(numpy.arccos(numpy.clip(cosine, -1.0, 1.0))))


def run(program, project, output, words):
    command = [program, "align", str(project), "-o", str(output), "--json", "--quiet", *words]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout.decode().strip().splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("project", type=pathlib.Path)
    parser.add_argument("--rowgram", default="target/release/rowgram")
    parser.add_argument("--csv", type=pathlib.Path)
    parser.add_argument("more", nargs="*")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as work:
        work = pathlib.Path(work)
        whole = run(args.rowgram, args.project, work, args.more)
        truth = poses(work / "colmap" / "images.txt")
        centres = {name: -r.T @ t for name, (r, t) in truth.items()}
        bases = [numpy.linalg.norm(centres[a] - centres[b]) for a, b in itertools.combinations(centres, 2)]
        usual = statistics.median(bases)
        tried = run(args.rowgram, args.project, work, [*args.more, "--until", "match"])
        calibrated = ["--camera", str(work / "camera-1.toml")]
        for solver, lens in itertools.product(SOLVERS, ["from the files", "calibrated"]):
            words = [*args.more, *(calibrated if lens == "calibrated" else [])]
            told = run(args.rowgram, args.project, work, [*words, "--until", "verify", "--solver", solver])
            with (work / "report" / "pairs.csv").open() as file:
                for pair in csv.DictReader(file):
                    a, b = pair["first"], pair["second"]
                    row = {"solver": solver, "camera": lens, "first": a, "second": b, "matches": int(pair["matches"])}
                    row |= {"by": pair["solver"], "tilt_deg": float(pair["tilt_deg"])}
                    if a in truth and b in truth:
                        (ra, ta), (rb, tb) = truth[a], truth[b]
                        turn = rb @ ra.T
                        base = tb - turn @ ta
                        if numpy.linalg.norm(base) > 0.1 * usual:
                            found = matrix(*(float(pair[k]) for k in ("qw", "qx", "qy", "qz")))
                            along = numpy.array([float(pair[k]) for k in ("tx", "ty", "tz")])
                            row["rotation_deg"] = degrees(0.5 * (numpy.trace(found @ turn.T) - 1.0))
                            row["baseline_deg"] = degrees(along @ base / numpy.linalg.norm(base))
                    rows.append(row)
            seconds = told["seconds"]["verify"]
            own = [r for r in rows if (r["solver"], r["camera"]) == (solver, lens) and "rotation_deg" in r]
            right = [row for row in own if row["rotation_deg"] < 2.0 and row["baseline_deg"] < 10.0]
            print(
                f"{solver}, camera {lens}: {told['pairs']} of {tried['pairs']} pairs, {told['matches']} of {tried['matches']} matches, "
                f"{len(right)} of {len(own)} pairs within 2 and 10 degrees of the adjusted block, "
                f"median {statistics.median(r['rotation_deg'] for r in own):.3f} and "
                f"{statistics.median(r['baseline_deg'] for r in own):.3f} degrees, {seconds:.2f} s"
            )
    print(f"adjusted block: {whole['registered']} of {whole['images']} images, {whole['reprojection_rms_px']:.3f} px")
    if args.csv:
        names = ["solver", "camera", "first", "second", "matches", "by", "tilt_deg", "rotation_deg", "baseline_deg"]
        with args.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
