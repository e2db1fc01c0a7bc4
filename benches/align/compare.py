"""Orients a folder of photos with rowgram and with pycolmap and prints both side by side.

    python -m venv /tmp/venv && /tmp/venv/bin/pip install pycolmap numpy
    /tmp/venv/bin/python benches/align/compare.py PROJECT [--threads 2] [--rowgram target/release/rowgram]

Both run on the same number of threads, one after the other, from the photos to an adjusted block. Of both
it prints registered images, tie points, observations, reprojection rms (root mean square distance in
pixels over all observations), wall time and processor time. pycolmap runs with its own settings for
CPU: SIFT of at most 8192 features, exhaustive matching (its recommendation for a few hundred photos;
--matching sequential or spatial for others), incremental mapping, one shared camera.
"""

import argparse
import json
import pathlib
import resource
import subprocess
import sys
import tempfile
import time


def used():
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def colmap(images, threads, matching, model):
    import numpy
    import pycolmap

    with tempfile.TemporaryDirectory() as work:
        work = pathlib.Path(work)
        database = work / "database.db"
        begin, cpu = time.time(), used()
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads = threads
        extraction.use_gpu = False
        pycolmap.extract_features(
            database,
            images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(camera_model=model),
            extraction_options=extraction,
        )
        extracted = time.time()
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads = threads
        options.use_gpu = False
        {
            "exhaustive": pycolmap.match_exhaustive,
            "sequential": pycolmap.match_sequential,
            "spatial": pycolmap.match_spatial,
        }[matching](database, matching_options=options)
        matched = time.time()
        pipeline = pycolmap.IncrementalPipelineOptions()
        pipeline.num_threads = threads
        maps = pycolmap.incremental_mapping(database, images, work, options=pipeline)
        seconds, cpu = time.time() - begin, used() - cpu
        best = max(maps.values(), key=lambda m: m.num_reg_images())
        squares, count = 0.0, 0
        for image in best.images.values():
            if not image.has_pose:
                continue
            for point in image.points2D:
                if not point.has_point3D():
                    continue
                projected = image.project_point(best.points3D[point.point3D_id].xyz)
                if projected is not None:
                    squares += float(numpy.sum((projected - point.xy) ** 2))
                    count += 1
        return {
            "registered": best.num_reg_images(),
            "unregistered": sorted(i.name for i in best.images.values() if not i.has_pose),
            "pieces": len(maps),
            "tie_points": best.num_points3D(),
            "observations": count,
            "rms_px": (squares / max(count, 1)) ** 0.5,
            "seconds": seconds,
            "cpu_seconds": cpu,
            "stages": {
                "features": extracted - begin,
                "match": matched - extracted,
                "orient": time.time() - matched,
            },
        }


def rowgram(program, project, threads, more):
    with tempfile.TemporaryDirectory() as work:
        begin, cpu = time.time(), used()
        command = [program, "align", str(project), "-o", work, "--json", "--threads", str(threads)]
        done = subprocess.run(command + ["--quiet"] + more, stdout=subprocess.PIPE, check=False)
        seconds, cpu = time.time() - begin, used() - cpu
        if not done.stdout:
            sys.exit(f"{' '.join(command)} ended with {done.returncode}")
        found = json.loads(done.stdout.decode().strip().splitlines()[-1])
        return {
            "registered": found["registered"],
            "unregistered": found["unregistered"],
            "pieces": found["fragments"],
            "tie_points": found["tie_points"],
            "observations": found["observations"],
            "rms_px": found["reprojection_rms_px"],
            "seconds": seconds,
            "cpu_seconds": cpu,
            "check_points": found["check_points"],
        }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("project", type=pathlib.Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rowgram", default="target/release/rowgram")
    parser.add_argument("--matching", default="exhaustive")
    parser.add_argument("--camera-model", default="SIMPLE_RADIAL")
    parser.add_argument("--only", choices=["rowgram", "colmap"])
    parser.add_argument("more", nargs="*", help="further words for rowgram align, after --")
    args = parser.parse_args()
    images = args.project / "images"
    images = images if images.is_dir() else args.project
    found = {}
    if args.only != "colmap":
        found["rowgram"] = rowgram(args.rowgram, args.project, args.threads, args.more)
    if args.only != "rowgram":
        found["pycolmap"] = colmap(images, args.threads, args.matching, args.camera_model)
    print(json.dumps({"project": args.project.name, "threads": args.threads, **found}))
    if len(found) == 2:
        ratio = found["pycolmap"]["seconds"] / found["rowgram"]["seconds"]
        cpu = found["pycolmap"]["cpu_seconds"] / found["rowgram"]["cpu_seconds"]
        print(f"{args.project.name}: {ratio:.2f} times as fast (wall), {cpu:.2f} times (processor)")


if __name__ == "__main__":
    main()
