#!/usr/bin/env python3
"""The bundle blocks of the solver arena by Ceres and arael beside rowgram's engine, in one run.

    experiments/scripts/arena_peers.py experiments/specs/solver-arena-full.toml --out DIR [--small]

`experiments arena-export` writes the blocks as BAL files; every program starts from the same numbers with
the same loss, in a process of its own with one thread. The programs take turns on each block, so that what
disturbs the machine disturbs all of them. A peer that is not installed is named, with the way to install
it, and left out: see benches/peers/README.md, which builds both.

DIR gets `peers.csv`, one row for each block, program and variant, and `peers-summary.csv`, the share of the
blocks solved and the ratio of seconds to the fastest program (Dolan and More 2002).

Python 3.9 with its standard library is enough.
"""

import argparse
import csv
import json
import os
import pathlib
import statistics
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT / "benches" / "peers"))
import compare  # noqa: E402

OWN_VARIANTS = ("schur", "sparse", "iterative", "dogleg")
SHARES = (("1e3", 1e-3), ("1e6", 1e-6))


def programs(options):
    """Name, variant and what makes the command line of each program that can be had."""
    own = ROOT / "target" / "release" / "experiments"
    if not own.is_file():
        sys.exit(f"{own} is missing: run `cargo build --release -p experiments` first")
    small = ["--small"] if options.small else []

    def ours(variant):
        return lambda block: [
            own, "arena-race", options.spec, *small, "--seed", block["seed"], "--variant", variant,
            "--tolerance", options.tolerance, "--max-iterations", options.max_iterations]

    def peer(program, variant):
        return lambda block: [
            program, options.out / "blocks" / block["file"], variant, block["loss"], 1,
            options.tolerance, options.max_iterations]

    found = [("rowgram", variant, ours(variant)) for variant in OWN_VARIANTS]
    for name, variants, build in (
        ("arael", compare.ARAEL_VARIANTS, compare.build_arael),
        ("ceres", compare.CERES_VARIANTS, compare.build_ceres),
    ):
        try:
            program = build()
        except compare.Missing as reason:
            compare.tell(f"left out: {reason}")
            continue
        found += [(name, variant, peer(program, variant)) for variant in variants]
    return own, found


def run(command, timeout):
    """What a program printed; None where it failed."""
    environment = dict(os.environ, OMP_NUM_THREADS="1", RAYON_NUM_THREADS="1")
    try:
        ran = subprocess.run([str(part) for part in command], env=environment, timeout=timeout,
                             capture_output=True, text=True, check=False)
    except subprocess.TimeoutExpired:
        compare.tell(f"  {command[0]}: not done after {timeout:g} s")
        return None
    if ran.returncode:
        compare.tell(f"  {command[0]} failed:\n{compare.last_lines(ran)}")
        return None
    return json.loads(ran.stdout.strip().splitlines()[-1])


def race(block, candidates, options):
    """One row for each program on a block: the least seconds of the repetitions."""
    results = {}
    for _ in range(options.repetitions):
        for name, variant, command in candidates:
            result = run(command(block), options.timeout)
            if result is not None:
                results.setdefault((name, variant), []).append(result)
    if not results:
        return []
    best = min(min(r["final_cost"], *(lap[1] for lap in r["log"]))
               for runs in results.values() for r in runs)
    rows = []
    for name, variant, _ in candidates:
        runs = results.get((name, variant))
        row = dict(block, program=name, variant=variant, status="ok" if runs else "failed")
        if runs:
            first = runs[0]
            row.update(
                start_cost=f"{first['initial_cost']:.9g}", cost=f"{first['final_cost']:.12g}",
                excess=f"{first['final_cost'] / best - 1:.3g}", iterations=first["iterations"],
                seconds=f"{min(r['solve_seconds'] for r in runs):.6f}")
            for label, share in SHARES:
                moments = [next((lap for lap in r["log"] if lap[1] <= best * (1 + share)), None)
                           for r in runs]
                if all(moments):
                    row[f"iterations_{label}"] = moments[0][0]
                    row[f"seconds_{label}"] = f"{min(lap[2] for lap in moments):.6f}"
        rows.append(row)
    return rows


def summary(rows):
    """For each program and variant: share solved, ratios of seconds to the fastest."""
    found = []
    for label, _ in SHARES:
        fastest = {}
        for row in rows:
            seconds = float(row.get(f"seconds_{label}", "inf"))
            fastest[row["file"]] = min(seconds, fastest.get(row["file"], float("inf")))
        for key in dict.fromkeys((row["program"], row["variant"]) for row in rows):
            mine = [row for row in rows if (row["program"], row["variant"]) == key]
            ratios = sorted(float(row[f"seconds_{label}"]) / fastest[row["file"]]
                            for row in mine if f"seconds_{label}" in row)
            share = lambda tau: sum(ratio <= tau for ratio in ratios) / len(mine)  # noqa: E731
            found.append({
                "within": label, "program": key[0], "variant": key[1], "blocks": len(mine),
                "solved": f"{len(ratios) / len(mine):.3f}", "best": f"{share(1.0):.3f}",
                "within_2": f"{share(2.0):.3f}", "within_10": f"{share(10.0):.3f}",
                "median_ratio": f"{statistics.median(ratios):.3f}" if ratios else ""})
    return found


def write(path, rows):
    header = list(dict.fromkeys(name for row in rows for name in row))
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, header, restval="")
        writer.writeheader()
        writer.writerows(rows)


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", 1)[0])
    parser.add_argument("spec", type=pathlib.Path, help="a spec of the stage `solvers`")
    parser.add_argument("--out", type=pathlib.Path, required=True, metavar="DIR")
    parser.add_argument("--small", action="store_true", help="the small setting of the spec")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--tolerance", type=float, default=1e-12,
                        help="relative change of the cost that ends a run")
    parser.add_argument("--max-iterations", type=int, default=200)
    parser.add_argument("--timeout", type=float, default=120.0, help="longest run, in seconds")
    return parser.parse_args()


def main():
    options = arguments()
    own, candidates = programs(options)
    small = ["--small"] if options.small else []
    blocks = options.out / "blocks"
    subprocess.run([own, "arena-export", options.spec, *small, "--out", blocks], check=True)
    rows = []
    with open(blocks / "instances.csv", newline="", encoding="utf-8") as file:
        for block in csv.DictReader(file):
            compare.tell(f"{block['file']}: {block['images']} images, {block['points']} points, "
                         f"loss {block['loss']}")
            rows += race(block, candidates, options)
    write(options.out / "peers.csv", rows)
    write(options.out / "peers-summary.csv", summary(rows))
    compare.tell(f"{compare.machine()}: {options.out / 'peers.csv'}")


if __name__ == "__main__":
    main()
