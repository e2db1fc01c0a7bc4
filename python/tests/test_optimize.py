"""The two engines from Python."""

from pathlib import Path

import numpy as np
import pytest

import rowgram


def test_a_curve_is_fitted_with_its_covariance(rng):
    t = np.linspace(0, 4, 200)
    y = 5 * np.exp(-0.5 * t) + rng.normal(0, 0.02, t.size)
    problem = rowgram.Problem()
    curve = problem.blocks("curve", [[1.0, 1.0]])

    def residual(p, t, y):
        return (p[:, :1] * np.exp(-p[:, 1:] * t[:, None]) - y[:, None]) / 0.02

    problem.add("samples", np.repeat(curve, t.size), residual, data=[t, y])
    summary = problem.solve()
    assert summary.converged and summary.batches[0]["factors"] == t.size
    a, b = problem.values(curve)[0]
    sigma = np.sqrt(np.diag(problem.covariance(curve[0])))
    assert abs(a - 5) < 4 * sigma[0] and abs(b - 0.5) < 4 * sigma[1]
    jacobian = np.column_stack([np.exp(-b * t), -a * t * np.exp(-b * t)]) / 0.02
    assert np.allclose(problem.covariance(curve[0]), np.linalg.inv(jacobian.T @ jacobian), rtol=1e-5)


def test_a_jacobian_by_hand_gives_the_same(rng):
    target = rng.normal(size=(30, 2))
    results = []
    for by_hand in (False, True):
        problem = rowgram.Problem()
        points = problem.blocks("point", np.zeros((30, 2)))
        problem.add(
            "distances",
            points,
            lambda p, q: p - q,
            rows=2,
            data=[target],
            loss="huber:1.0",
            jacobian=(lambda p, q: [np.broadcast_to(np.eye(2), (len(p), 2, 2))]) if by_hand else None,
        )
        problem.solve()
        results.append(problem.values(points))
    assert np.allclose(results[0], results[1], atol=1e-8) and np.allclose(results[0], target, atol=1e-6)


def small_bundle(rng):
    """Three cameras over twenty points, with exact measurements."""
    points = np.column_stack([rng.uniform(-2, 2, (20, 2)), rng.uniform(7, 9, 20)])
    poses = np.array([[1.0, 0, 0, 0, x, 0, 0] for x in (-1.0, 0.0, 1.0)])
    camera, point = (index.ravel() for index in np.meshgrid(range(3), range(20), indexing="ij"))
    local = points[point] + poses[camera, 4:]
    return points, poses, camera, point, 900 * local[:, :2] / local[:, 2:]


@pytest.mark.parametrize("in_rust", [True, False])
def test_a_bundle_with_poses_comes_back(rng, in_rust):
    points, poses, camera, point, image_px = small_bundle(rng)
    problem = rowgram.Problem()
    pose_ids = problem.blocks("pose", poses, "pose")
    lens = problem.blocks("lens", [[900.0, 0.0, 0.0]])
    point_ids = problem.blocks("point", points + rng.normal(0, 0.05, points.shape))
    problem.fix(lens)
    problem.eliminate(point_ids)
    if in_rust:
        problem.add_reprojection("image", pose_ids[camera], point_ids[point], lens, image_px)
    else:

        def residual(pose, x, measured):
            w, u = pose[:, :1], pose[:, 1:4]
            turned = x + 2 * np.cross(u, np.cross(u, x) + w * x) + pose[:, 4:]
            return 900 * turned[:, :2] / turned[:, 2:] - measured

        blocks = np.column_stack([pose_ids[camera], point_ids[point]])
        problem.add("image", blocks, residual, rows=2, data=[image_px])
    centres = -poses[:, 4:]
    problem.add_camera_positions("gnss", pose_ids, centres, [0.01, 0.01, 0.01])
    problem.add_prior("survey", point_ids[:4], points[:4], [0.01] * 3)
    summary = problem.solve(cost_tolerance=1e-14)
    assert summary.final_cost < 1e-6, summary
    assert np.abs(problem.values(point_ids) - points).max() < 1e-3


def test_a_bundle_of_arrays_is_adjusted(rng):
    points, poses, camera, point, image_px = small_bundle(rng)
    # Here the camera looks along -z with y up.
    cameras = np.column_stack([np.zeros((3, 3)), poses[:, 4:] * [1, -1, -1], np.tile([900.0, 0, 0], (3, 1))])
    start = points * [1, -1, -1] + rng.normal(0, 0.05, points.shape)
    found = rowgram.bundle_adjust(cameras, start, camera, point, image_px * [1, -1], shared_lens=True)
    assert found.summary.converged and found.summary.final_cost < 1e-8
    assert found.summary.batches[0]["path"] == "fused"


class ColmapFolder:
    """What pycolmap's reconstruction is to `adjust_reconstruction`: it reads and writes COLMAP folders."""

    def __init__(self, folder):
        names = ("cameras.txt", "images.txt", "points3D.txt")
        self.files = {name: (Path(folder) / name).read_text() for name in names}

    def write(self, folder):
        for name, text in self.files.items():
            (Path(folder) / name).write_text(text)


def test_a_colmap_folder_goes_in_and_out(tmp_path):
    rowgram.synth.flight(tmp_path / "field", "small", photos=False, tie_points={"per_photo": 60})
    given = ColmapFolder(tmp_path / "field" / "model")
    adjusted, report = rowgram.adjust_reconstruction(given, datum="minimal", free=["f_px"])
    assert adjusted.files["images.txt"] != given.files["images.txt"]
    assert report.report["final_cost"] < report.report["initial_cost"]


def test_heights_are_smoothed_by_coordinate_descent():
    measured, smooth = np.array([0.0, 1.2, 1.8, 3.3, 3.9, 5.0]), 4.0

    def cost(x):
        return ((x - measured) ** 2).sum() + smooth * (np.diff(x) ** 2).sum()

    def update(x, k):
        near = [n for n in (k - 1, k + 1) if 0 <= n < len(x)]
        best = (measured[k] + smooth * x[near].sum()) / (1 + smooth * len(near))
        moved = abs(best - x[k])
        x[k] = best
        return moved, near if moved > 1e-9 else []

    found = rowgram.coordinate_descent(np.zeros(6), cost, update, movement_tolerance=1e-9, cost_tolerance=0.0)
    assert found.converged and abs((found.x - measured).sum()) < 1e-6
    assert found.final_cost < found.initial_cost


def test_exceptions_of_residuals_come_through():
    problem = rowgram.Problem()
    block = problem.blocks("x", [[1.0]])

    def broken(x):
        raise KeyError("mine")

    problem.add("broken", block, broken)
    with pytest.raises(KeyError, match="mine"):
        problem.solve()


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (lambda p, b: p.blocks("q", [[1.0, 1.0, 0.0, 0.0]], "rotation"), "q 0"),
        (lambda p, b: p.blocks("q", [[np.nan]]), "q 0"),
        (lambda p, b: p.blocks("q", [[1.0]], "torus"), "torus"),
        (lambda p, b: p.add("r", [7], lambda x: x), "block 7"),
        (lambda p, b: p.add("r", b, lambda x: x, loss="hubber:1"), "hubber"),
        (lambda p, b: p.add("r", b, lambda x: x, data=[np.zeros(5)]), "5 rows"),
        (lambda p, b: p.add("r", np.zeros((0, 2), int), lambda x, y: x), "one residual or more"),
        (lambda p, b: p.add_reprojection("r", b, b, b, [[0.0, 0.0]]), "pose"),
        (lambda p, b: p.solve(linaer="dense"), "linear"),
    ],
)
def test_what_cannot_be_is_refused(pose, message):
    problem = rowgram.Problem()
    block = problem.blocks("x", [[1.0]])
    with pytest.raises(rowgram.InputError, match=message):
        pose(problem, block)


def test_a_residual_of_another_shape_is_named():
    problem = rowgram.Problem()
    problem.add("r", problem.blocks("x", [[1.0]]), lambda x: np.zeros(3))
    with pytest.raises(rowgram.InputError, match=r"shape \[3\], expected \[1, 1\]"):
        problem.solve()


def test_undetermined_blocks_are_named():
    problem = rowgram.Problem()
    block = problem.blocks("height", [[1.0, 2.0]])
    problem.add("sum", block, lambda x: x.sum(axis=1, keepdims=True))
    problem.solve()
    with pytest.raises(rowgram.SolverError, match="height"):
        problem.covariance(block[0])


def test_a_file_that_takes_more_memory_than_allowed_is_refused(tmp_path):
    path = tmp_path / "problem.txt"
    with path.open("wb") as file:
        file.truncate(40_000_000)
    rowgram.limit_memory(20)
    try:
        with pytest.raises(rowgram.InputError, match="takes 40 MB of memory, 20 MB may be used"):
            rowgram.read_bal(path)
    finally:
        rowgram.limit_memory(None)
    with pytest.raises(rowgram.InputError, match="expected") as found:
        rowgram.read_bal(path)
    assert "memory" not in str(found.value)
