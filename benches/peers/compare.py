#!/usr/bin/env python3
"""Bundle adjustment side by side: rowgram and public peers on the same BAL files.

Every program gets the same file, start, loss, number of threads and stopping rule, and runs in
its own process. The runs are interleaved: in each repetition every program runs once before any
runs again, so that what disturbs the machine disturbs all of them. A variant
of a program that is clearly slower than its fastest one is dropped after a repetition.

Python 3.9 with its standard library is enough. A peer that is not installed is named, with the
way to install it, and left out. See README.md beside this file.
"""

import argparse
import gzip
import json
import os
import pathlib
import platform
import resource
import shutil
import subprocess
import sys
import tempfile

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
BUILD = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "peers"
LEVELS = (1e-3, 1e-4, 1e-6)
ARAEL_VARIANTS = ("nielsen", "ladder")
CERES_VARIANTS = ("dense", "sparse", "iterative")


class Missing(Exception):
    """A peer that cannot be had; the text says how to get it."""


def tell(text):
    print(text, file=sys.stderr, flush=True)


def last_lines(process, count=3):
    return "\n".join(process.stderr.strip().splitlines()[-count:])


def find_rowgram(path):
    program = pathlib.Path(path) if path else ROOT / "target" / "release" / "rowgram"
    if not program.is_file():
        sys.exit(f"{program} is missing: run `cargo build --release` first, or give --rowgram")
    return program


def build_arael():
    if not shutil.which("cargo"):
        raise Missing("arael needs cargo: https://rustup.rs")
    environment = dict(os.environ, CARGO_TARGET_DIR=str(BUILD))
    environment["RUSTFLAGS"] = environment.get("RUSTFLAGS", "") + " -C target-cpu=native"
    built = subprocess.run(
        ["cargo", "build", "--release", "--locked"],
        cwd=HERE, env=environment, capture_output=True, text=True, check=False,
    )
    if built.returncode:
        raise Missing(f"arael did not build (it comes from crates.io):\n{last_lines(built)}")
    return BUILD / "release" / "arael-bal"


def build_ceres():
    compiler = os.environ.get("CXX", "g++")
    if not shutil.which(compiler):
        raise Missing(f"Ceres needs {compiler}: apt-get install g++")
    program, source = BUILD / "ceres_bal", HERE / "ceres_bal.cpp"
    if program.is_file() and program.stat().st_mtime > source.stat().st_mtime:
        return program
    BUILD.mkdir(parents=True, exist_ok=True)
    built = subprocess.run(
        [compiler, "-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-DEIGEN_MAX_ALIGN_BYTES=16",
         "-I/usr/include/eigen3", str(source), "-o", str(program), "-lceres", "-lglog"],
        capture_output=True, text=True, check=False,
    )
    if built.returncode:
        raise Missing("Ceres did not build; apt-get install libceres-dev "
                      f"--no-install-recommends:\n{last_lines(built)}")
    return program


class Program:
    """One program in one variant, as a command line."""

    def __init__(self, name, variant, command):
        self.name, self.variant, self.command = name, variant, command

    def __str__(self):
        return f"{self.name} {self.variant}".strip()


def programs(options):
    """The programs to compare, ours first."""
    ours = find_rowgram(options.rowgram)
    found = [Program("rowgram", "", lambda file, tolerance: [
        ours, "adjust", file, "--json", "--threads", options.threads, "--loss", options.loss,
        "--cost-tolerance", tolerance, "--max-iterations", options.max_iterations,
    ])]

    def peer(program, variant):
        return lambda file, tolerance: [
            program, file, variant, options.loss, options.threads, tolerance,
            options.max_iterations,
        ]

    if not (options.loss == "trivial" or options.loss.startswith("huber:")):
        sys.exit(f"--loss {options.loss}: the peers know trivial and huber:A")
    for name, variants, build in (
        ("arael", ARAEL_VARIANTS, build_arael),
        ("ceres", CERES_VARIANTS, build_ceres),
    ):
        if name not in options.peers.split(","):
            continue
        try:
            program = build()
        except Missing as reason:
            tell(f"left out: {reason}")
            continue
        found += [Program(name, variant, peer(program, variant)) for variant in variants]
    return found


def busy_seconds():
    """Processor time that the whole machine has spent, idling excepted."""
    try:
        fields = pathlib.Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    except OSError:
        return None
    user, nice, system, _idle, _wait, interrupt, soft_interrupt, steal = map(int, fields[:8])
    ticks = user + nice + system + interrupt + soft_interrupt + steal
    return ticks / os.sysconf("SC_CLK_TCK")


def run_once(program, file, tolerance, options):
    """What the program printed, and which share of the machine others took meanwhile."""
    command = [str(part) for part in program.command(file, tolerance)]
    environment = dict(os.environ, OMP_NUM_THREADS=str(options.threads))
    busy, children = busy_seconds(), resource.getrusage(resource.RUSAGE_CHILDREN)
    clock = os.times().elapsed
    try:
        ran = subprocess.run(command, env=environment, capture_output=True, text=True,
                             timeout=options.timeout, check=False)
    except subprocess.TimeoutExpired:
        tell(f"  {program}: not done after {options.timeout:g} s, left out")
        return None
    elapsed = os.times().elapsed - clock
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if ran.returncode:
        tell(f"  {program} failed:\n{last_lines(ran)}")
        return None
    result = json.loads(ran.stdout.strip().splitlines()[-1])
    own = after.ru_utime + after.ru_stime - children.ru_utime - children.ru_stime
    result["others"] = 0.0
    if busy is not None and elapsed > 0:
        others = (busy_seconds() - busy - own) / (elapsed * (os.cpu_count() or 1))
        result["others"] = max(0.0, others)
    return result


def run_undisturbed(program, file, tolerance, options):
    """The least disturbed of up to 1 + retries runs."""
    best = None
    for _ in range(1 + options.retries):
        result = run_once(program, file, tolerance, options)
        if result is None:
            return best
        if best is None or result["others"] < best["others"]:
            best = result
        if best["others"] <= options.disturbance:
            break
    return best


def measure(file, candidates, options):
    """All runs on one file: a list of results per program."""
    runs = {str(program): [] for program in candidates}
    racing = list(candidates)
    for repetition in range(options.repetitions):
        for program in racing:
            for tolerance in (options.tolerance, options.reach_tolerance):
                result = run_undisturbed(program, file, tolerance, options)
                if result is None:
                    break
                result["tolerance"] = tolerance
                runs[str(program)].append(result)
                tell(f"  {repetition + 1}: {program}, tolerance {tolerance:g}: "
                     f"{result['final_cost']:.4f} after {result['iterations']}, "
                     f"{result['solve_seconds']:.3f} s"
                     + (f", others {100 * result['others']:.0f} %"
                        if result["others"] > options.disturbance else ""))
        racing = fastest_variants(racing, runs, options)
    return {name: results for name, results in runs.items() if results}


def fastest_variants(racing, runs, options):
    """The variants that found their program's lowest cost and may yet be its fastest."""
    kept = []
    for name in dict.fromkeys(program.name for program in racing):
        variants = [p for p in racing if p.name == name and runs[str(p)]]
        lowest = min((r["final_cost"] for p in variants for r in runs[str(p)]), default=0.0)
        good = [p for p in variants
                if min(r["final_cost"] for r in runs[str(p)]) <= lowest * (1 + options.same_optimum)]
        fastest = min((solve_seconds(runs[str(p)], options) for p in good), default=0.0)
        kept += [p for p in good
                 if solve_seconds(runs[str(p)], options) <= options.contender * fastest]
    return kept


def solve_seconds(results, options):
    times = [r["solve_seconds"] for r in results if r["tolerance"] == options.tolerance]
    return min(times, default=float("inf"))


def seconds_to(results, cost):
    """The earliest that any of the runs was at or below the cost; None if none was."""
    moments = [
        min((seconds for _, reached, seconds in r["log"] if reached <= cost), default=None)
        for r in results
    ]
    return min((seconds for seconds in moments if seconds is not None), default=None)


def summarize(file, runs, options):
    """One row per program that has run, the best variants first in their group."""
    lowest = min(r["final_cost"] for results in runs.values() for r in results)
    known = options.best.get(pathlib.Path(file).name.removesuffix(".gz"))
    best = min(lowest, known) if known else lowest
    rows = []
    for name, results in runs.items():
        normal = [r for r in results if r["tolerance"] == options.tolerance]
        if not normal:
            continue
        quickest = min(normal, key=lambda r: r["solve_seconds"])
        rows.append({
            "program": name,
            "runs": len(normal),
            "final_cost": quickest["final_cost"],
            "lowest_cost": min(r["final_cost"] for r in results),
            "iterations": quickest["iterations"],
            "solve_seconds": quickest["solve_seconds"],
            "to": [seconds_to(results, best * (1 + level)) for level in LEVELS],
            "peak_memory_mb": max(r["peak_memory_mb"] or 0.0 for r in normal),
            "others": min(r["others"] for r in normal),
        })
    return {"file": pathlib.Path(file).name, "best_cost": best, "rows": rows}


def table(summary):
    """The rows of one file as a Markdown table; ratios are to our own time."""
    ours = next((row for row in summary["rows"] if row["program"] == "rowgram"), None)

    def timed(seconds, own):
        if seconds is None:
            return "never"
        if own is None or own is seconds:
            return f"{seconds:.3f}"
        return f"{seconds:.3f} ({seconds / own:.1f}x)" if own > 0 else f"{seconds:.3f}"

    lines = [
        f"{summary['file']}, best cost {summary['best_cost']:.4f}",
        "",
        "| program | final cost | lowest cost | iterations | solve s | to 1e-3 | to 1e-4 | to 1e-6 "
        "| peak MB | runs | others |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in summary["rows"]:
        own = ours["to"] if ours else [None] * len(LEVELS)
        to = " | ".join(timed(seconds, base) for seconds, base in zip(row["to"], own))
        lines.append(
            f"| {row['program']} | {row['final_cost']:.4f} | {row['lowest_cost']:.4f} "
            f"| {row['iterations']} "
            f"| {timed(row['solve_seconds'], ours['solve_seconds'] if ours else None)} | {to} "
            f"| {row['peak_memory_mb']:.0f} | {row['runs']} | {100 * row['others']:.0f} % |"
        )
    return "\n".join(lines) + "\n"


def machine():
    """The processor and how many cores there are."""
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        model = platform.processor() or "unknown processor"
    return f"{model}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}"


def unpack(file, folder):
    """A plain file, since not every peer reads gzip."""
    if not file.endswith(".gz"):
        return file
    plain = pathlib.Path(folder) / pathlib.Path(file).name.removesuffix(".gz")
    with gzip.open(file, "rb") as packed, open(plain, "wb") as out:
        shutil.copyfileobj(packed, out)
    return str(plain)


def known_cost(text):
    name, _, cost = text.rpartition("=")
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r}: expected FILE=COST")
    return name, float(cost)


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", 1)[0])
    parser.add_argument("files", nargs="+", help="BAL text files, plain or gzipped")
    parser.add_argument("--loss", default="trivial", help="trivial or huber:A, A in pixels")
    parser.add_argument("--repetitions", type=int, default=5, help="interleaved rounds")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--tolerance", type=float, default=1e-6,
                        help="relative cost change that ends the runs whose solve time counts")
    parser.add_argument("--reach-tolerance", type=float, default=1e-9,
                        help="the same for the runs that show the time to an accuracy")
    parser.add_argument("--max-iterations", type=int, default=100)
    parser.add_argument("--best", type=known_cost, action="append", default=[],
                        metavar="FILE=COST", help="best known cost of a file; else the lowest seen")
    parser.add_argument("--same-optimum", type=float, default=1e-4,
                        help="relative difference of costs still called the same optimum")
    parser.add_argument("--contender", type=float, default=1.5,
                        help="a variant this many times slower than its program's fastest is "
                             "dropped after a repetition")
    parser.add_argument("--peers", default="arael,ceres", help="which peers, by commas")
    parser.add_argument("--rowgram", help="our program; target/release/rowgram if not given")
    parser.add_argument("--timeout", type=float, default=600.0, help="longest run, in seconds")
    parser.add_argument("--disturbance", type=float, default=0.1,
                        help="share of the machine taken by others above which a run is repeated")
    parser.add_argument("--retries", type=int, default=2, help="how often a run is repeated")
    parser.add_argument("--json", metavar="OUT.json", help="write all runs with their logs here")
    options = parser.parse_args()
    options.best = dict(options.best)
    return options


def main():
    options = arguments()
    candidates = programs(options)
    print(f"{machine()}; {options.threads} threads, loss {options.loss}, stop at a relative cost "
          f"change of {options.tolerance:g}, lowest of {options.repetitions}\n", flush=True)
    collected = []
    with tempfile.TemporaryDirectory() as folder:
        for file in options.files:
            tell(file)
            runs = measure(unpack(file, folder), candidates, options)
            summary = summarize(file, runs, options)
            print(table(summary), flush=True)
            for row in summary["rows"]:
                if row["lowest_cost"] > summary["best_cost"] * (1 + options.same_optimum):
                    tell(f"  {row['program']} did not reach the optimum")
            collected.append(dict(summary, results=runs))
    if options.json:
        pathlib.Path(options.json).write_text(json.dumps({
            "machine": machine(), "threads": options.threads, "loss": options.loss,
            "tolerance": options.tolerance, "levels": LEVELS, "files": collected,
        }))


if __name__ == "__main__":
    main()
