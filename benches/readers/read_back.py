"""Holds rowgram's files of reconstructions against pycolmap, a reader and a camera of their own.

    python -m venv venv && venv/bin/pip install pycolmap numpy
    venv/bin/python benches/readers/read_back.py target/release/rowgram

A synthetic reconstruction is made by pycolmap, with noise in the measurements, and converted by
`rowgram convert` there and back again:

- COLMAP binary -> text -> binary: pycolmap reads both; every camera, pose, point, feature and track
  is compared, and every measurement's reprojection error in pixels by pycolmap's camera.
- COLMAP -> Bundler -> COLMAP and COLMAP -> OpenSfM -> COLMAP: the same, from pycolmap's reading of
  what comes back.
- Bundler and OpenSfM have no reader in pycolmap: their projections are written down here from their
  documentation, and held against pycolmap's of the reconstruction that was converted.

Prints the largest difference of each comparison and exits with 1 where one is above its bound:
1e-9 px for pixel positions, 1e-9 px for reprojection errors.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

import numpy
import pycolmap

PIXELS = 1e-9
failed = False


def judge(name, value, bound):
    global failed
    failed |= not value <= bound
    print(f"{name:58} {value:9.2e}  (bound {bound:.0e})")


def synthetic(model, parameters):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 2
    options.num_cameras_per_rig = 1
    options.num_frames_per_rig = 8
    options.num_points3D = 200
    options.camera_width, options.camera_height = 1024, 768
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    options.camera_params = parameters
    pycolmap.set_random_seed(1)
    made = pycolmap.synthesize_dataset(options)
    random = numpy.random.default_rng(2)
    for image in made.images.values():
        for feature in image.points2D:
            feature.xy = feature.xy + random.normal(0.0, 0.5, 2)
    return made


def convert(program, source, form, target, *more):
    target.parent.mkdir(parents=True, exist_ok=True)
    command = [program, "convert", source, "--to", form, "-o", target, *more]
    subprocess.run([str(word) for word in command], check=True, stdout=subprocess.DEVNULL)


def measurements(of):
    """(image name, point id) -> measured position, reprojection error; by pycolmap's camera."""
    found = {}
    for image in of.images.values():
        if not image.has_pose:
            continue
        camera = of.cameras[image.camera_id]
        from_world = image.cam_from_world
        from_world = from_world() if callable(from_world) else from_world
        for feature in image.points2D:
            if feature.has_point3D():
                local = from_world * of.points3D[feature.point3D_id].xyz
                found[image.name, feature.point3D_id] = (
                    feature.xy,
                    camera.img_from_cam(local) - feature.xy,
                )
    return found


def compare(name, one, other, by_order=False):
    first, second = measurements(one), measurements(other)
    if by_order:
        # Formats that number the points anew keep their order.
        new = dict(zip(sorted(one.points3D), sorted(other.points3D)))
        first = {(image, new[point]): value for (image, point), value in first.items()}
    if set(first) != set(second):
        print(f"{name}: {len(first)} measurements against {len(second)}")
        judge(name, float("inf"), 0.0)
        return
    for k, what in enumerate(["pixel positions, px", "reprojection errors, px"]):
        apart = max(numpy.abs(first[key][k] - second[key][k]).max() for key in first)
        judge(f"{name}: {what}", apart, PIXELS)


def opensfm(folder, truth):
    """OpenSfM's equations: positions from the image centre in units of the larger side."""
    reconstruction = json.loads((folder / "reconstruction.json").read_text())[0]
    camera = next(iter(reconstruction["cameras"].values()))
    unit = max(camera["width"], camera["height"])
    get = lambda key: camera.get(key, 0.0)
    fx, fy = (get("focal"),) * 2 if "focal" in camera else (get("focal_x"), get("focal_y"))
    expected = measurements(truth)
    worst = [0.0, 0.0]
    rows = (folder / "tracks.csv").read_text().splitlines()[1:]
    for row in rows:
        name, track, _, x, y = row.split("\t")[:5]
        shot = reconstruction["shots"][name]
        turn = pycolmap.Rotation3d(numpy.array(shot["rotation"])).matrix()
        point = numpy.array(reconstruction["points"][track]["coordinates"])
        u, v, w = turn @ point + numpy.array(shot["translation"])
        u, v = u / w, v / w
        r2 = u * u + v * v
        radial = 1.0 + r2 * (get("k1") + r2 * (get("k2") + r2 * get("k3")))
        p1, p2 = get("p1"), get("p2")
        projected = numpy.array(
            [
                fx * (u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)) + get("c_x"),
                fy * (v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)) + get("c_y"),
            ]
        )
        measured = numpy.array([float(x), float(y)])
        # COLMAP's origin is the corner of the image.
        position = measured * unit + 0.5 * numpy.array([camera["width"], camera["height"]])
        known = expected[name, int(track)]
        worst[0] = max(worst[0], numpy.abs(position - known[0]).max())
        worst[1] = max(worst[1], numpy.abs(unit * (projected - measured) - known[1]).max())
    if len(rows) != len(expected):
        worst[0] = float("inf")
    judge("OpenSfM by its own equations: pixel positions, px", worst[0], PIXELS)
    judge("OpenSfM by its own equations: reprojection errors, px", worst[1], PIXELS)


def bundler(folder, truth):
    """Bundler's equations: positions from the image centre, y up, the camera looks along -z."""
    lines = (folder / "bundle.out").read_text().splitlines()[1:]
    numbers = iter([float(word) for line in lines for word in line.split()])
    take = lambda count: numpy.array([next(numbers) for _ in range(count)])
    names = (folder / "list.txt").read_text().split()
    cameras, points = (int(count) for count in take(2))
    cameras = [take(15) for _ in range(cameras)]
    expected = measurements(truth)
    worst, count = [0.0, 0.0], 0
    for point_id in sorted(truth.points3D)[:points]:
        at = take(3)
        take(3)
        for _ in range(int(next(numbers))):
            image = int(next(numbers))
            next(numbers)
            measured = take(2)
            f, k1, k2 = cameras[image][:3]
            u, v, w = cameras[image][3:12].reshape(3, 3) @ at + cameras[image][12:]
            u, v = -u / w, -v / w
            r2 = u * u + v * v
            projected = f * (1.0 + k1 * r2 + k2 * r2 * r2) * numpy.array([u, v])
            # COLMAP's origin is the corner of the image, its v is down.
            known = expected[names[image], point_id]
            position = numpy.array([512.0 + measured[0], 384.0 - measured[1]])
            error = (projected - measured) * [1.0, -1.0]
            worst[0] = max(worst[0], numpy.abs(position - known[0]).max())
            worst[1] = max(worst[1], numpy.abs(error - known[1]).max())
            count += 1
    if count != len(expected):
        worst[0] = float("inf")
    judge("Bundler by its own equations: pixel positions, px", worst[0], PIXELS)
    judge("Bundler by its own equations: reprojection errors, px", worst[1], PIXELS)


def main(program):
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        for model, parameters in [
            ("SIMPLE_RADIAL", [1000.0, 512.0, 384.0, -0.05]),
            ("OPENCV", [1000.0, 1003.0, 509.0, 387.0, -0.05, 0.02, 5e-4, -3e-4]),
            ("OPENCV_FISHEYE", [800.0, 803.0, 509.0, 387.0, 0.02, -0.01, 1e-3, 2e-3]),
            ("FULL_OPENCV", [1e3, 1003.0, 509.0, 387.0, -0.05, 0.02, 5e-4, -3e-4, 1e-3, 0.01, 0, 0]),
        ]:
            print(model)
            truth = synthetic(model, parameters)
            at = folder / model
            (at / "binary").mkdir(parents=True)
            truth.write_binary(at / "binary")
            convert(program, at / "binary", "colmap-text", at / "text")
            convert(program, at / "text", "colmap-binary", at / "again")
            compare("COLMAP text", truth, pycolmap.Reconstruction(at / "text"))
            compare("COLMAP binary", truth, pycolmap.Reconstruction(at / "again"))
            if model != "FULL_OPENCV":
                convert(program, at / "binary", "opensfm", at / "sfm" / "reconstruction.json")
                convert(program, at / "sfm" / "reconstruction.json", "colmap-binary", at / "of_sfm")
                compare("OpenSfM and back", truth, pycolmap.Reconstruction(at / "of_sfm"))
                if model != "OPENCV_FISHEYE":
                    opensfm(at / "sfm", truth)
            if model == "SIMPLE_RADIAL":
                convert(program, at / "binary", "bundler", at / "bundle" / "bundle.out")
                size = ["--image-size", "1024x768"]
                source = at / "bundle" / "bundle.out"
                convert(program, source, "colmap-binary", at / "of_bundler", *size)
                back = pycolmap.Reconstruction(at / "of_bundler")
                compare("Bundler and back", truth, back, by_order=True)
                bundler(at / "bundle", truth)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
