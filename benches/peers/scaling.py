#!/usr/bin/env python3
"""How the time of a bundle adjustment grows with the block: 50 to 1,500 images.

Makes nadir blocks with `rowgram synth bundle`, adjusts each `--repetitions` times and prints a table of the
fastest runs. Python 3.9 with its standard library is enough.
"""

import argparse
import json
import pathlib
import subprocess
import tempfile

ROOT = pathlib.Path(__file__).resolve().parent.parent.parent


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, nargs="+", default=[50, 100, 200, 500, 1000, 1500])
    parser.add_argument("--points-per-image", type=int, default=200)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rowgram", default=ROOT / "target" / "release" / "rowgram")
    args = parser.parse_args()
    print("| images | points | observations | iterations | solve s "
          "| microseconds per observation and iteration | before the first step | peak MB |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for images in args.images:
            block = pathlib.Path(folder) / f"{images}.txt"
            points = images * args.points_per_image
            subprocess.run(
                [args.rowgram, "synth", "bundle", "--quiet", "--images", str(images), "--points",
                 str(points), "--seed", "7", "--output", block],
                check=True,
            )
            command = [args.rowgram, "adjust", block, "--cost-tolerance", "1e-6", "--json",
                       "--threads", str(args.threads)]
            runs = [
                json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
                for _ in range(args.repetitions)
            ]
            run = min(runs, key=lambda run: run["solve_seconds"])
            each = run["solve_seconds"] / run["iterations"] / run["observations"] * 1e6
            start = run["log"][0][-1] / run["solve_seconds"]
            print(f"| {images} | {run['points']} | {run['observations']} | {run['iterations']} "
                  f"| {run['solve_seconds']:.3f} | {each:.3f} | {100 * start:.0f} % "
                  f"| {run['peak_memory_mb']:.0f} |", flush=True)


if __name__ == "__main__":
    main()
