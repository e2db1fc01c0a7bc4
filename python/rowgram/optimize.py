"""The two optimisation engines: sparse nonlinear least squares, and coordinate descent."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowgram
from ._errors import InputError
from .project import Progress


@dataclass(frozen=True)
class Summary:
    """How an adjustment went.

    Attributes:
        initial_cost: ``1/2 sum rho(|r|^2)`` at the start.
        final_cost: The same at the end.
        iterations: Trials made, refused ones included.
        stop: Why it ended.
        converged: Whether that is an optimum.
        linear: Solver of the linear systems: the one chosen where ``"auto"`` was asked for.
        batches: One dictionary per named batch of residuals: ``name``, ``factors``, ``cost``, ``rmse``, ``path``.
    """

    initial_cost: float
    final_cost: float
    iterations: int
    stop: Any
    converged: bool
    residuals: int
    parameters: int
    linear: str
    batches: list[dict[str, Any]]
    text: str

    def __str__(self) -> str:
        return self.text


class Problem:
    """A nonlinear least-squares problem: blocks of parameters on manifolds, residuals in named batches.

    ::

        problem = rowgram.Problem()
        curve = problem.blocks("curve", [[1.0, 1.0]])
        def residual(p, t, y):  # arrays with one row per residual of the call
            return p[:, :1] * np.exp(-p[:, 1:] * t[:, None]) - y[:, None]
        problem.add("samples", np.repeat(curve, len(t)), residual, data=[t, y])
        print(problem.solve())
        print(problem.values(curve), problem.covariance(curve[0]))

    Residuals are divided by their standard deviation by who writes them. Derivatives are central differences along the
    manifolds (about nine digits) unless ``jacobian`` is given. The interpreter is released while the engine works, and
    taken for each call of a residual.
    """

    def __init__(self) -> None:
        self._inner = _rowgram.Problem()

    def blocks(self, name: str, values: ArrayLike, manifold: str = "euclidean") -> NDArray[np.int64]:
        """Add blocks.

        Args:
            name: What they are, for messages.
            values: Starting values, one row per block.
            manifold: "euclidean"; "rotation" (unit quaternion w x y z); "pose" (quaternion and translation,
                ``y = R x + t``, 7 numbers, 6 degrees of freedom); "unit-vector"; "similarity" (pose and scale).

        Returns:
            Their numbers, shape (n,).
        """
        rows = np.atleast_2d(np.asarray(values, dtype=float))
        if rows.ndim != 2:
            raise InputError(f"{name}: expected values with one row per block, not shape {rows.shape}")
        return self._inner.add_blocks(name, rows.tolist(), manifold)

    def fix(self, blocks: ArrayLike, entries: Sequence[int] | None = None) -> None:
        """Keep blocks as they are, or only some entries of their tangents."""
        self._inner.fix(blocks, None if entries is None else list(entries))

    def free(self, blocks: ArrayLike) -> None:
        """Let blocks move again."""
        self._inner.free(blocks)

    def eliminate(self, blocks: ArrayLike) -> None:
        """Eliminate blocks first (Schur complement); no residual may join two of them."""
        self._inner.eliminate(blocks)

    def add(
        self,
        name: str,
        blocks: ArrayLike,
        residual: Callable[..., ArrayLike],
        *,
        rows: int = 1,
        data: Sequence[ArrayLike] = (),
        loss: str | None = None,
        jacobian: Callable[..., Sequence[ArrayLike]] | None = None,
    ) -> None:
        """Add residuals that a Python function computes for many of them at once.

        Args:
            name: Name of the batch.
            blocks: Numbers of the blocks of each residual, shape (n,) or (n, blocks per residual).
            residual: ``residual(*blocks, *data)``: one array per block, shape (k, numbers), and the same rows of each
                array of data; gives an array of shape (k, rows). ``k`` varies from call to call.
            rows: Length of each residual.
            data: Arrays with one entry per residual.
            loss: "huber:1.0", "soft-l1:1.0", "cauchy:1.0", "geman-mcclure:1.0", "tukey:1.0"; none is least squares.
            jacobian: Called likewise; gives one array of shape (k, rows, degrees of freedom) per block, the derivatives
                by the tangent of the manifold.
        """
        arrays = [np.asarray(array) for array in data]
        self._inner.add(name, np.asarray(blocks), residual, rows, arrays, loss, jacobian)

    def add_reprojection(
        self,
        name: str,
        poses: ArrayLike,
        points: ArrayLike,
        lenses: ArrayLike,
        image_px: ArrayLike,
        *,
        sigma_px: float = 1.0,
        loss: str | None = None,
    ) -> None:
        """Add image measurements, by a residual written in Rust.

        Args:
            poses: Numbers of pose blocks (camera from world; the camera looks along +z), shape (n,).
            points: Numbers of blocks of three coordinates, shape (n,).
            lenses: Numbers of blocks ``[f, k1, k2]``, shape (n,) or one for all.
            image_px: Measured ``(u, v)`` from the principal point, shape (n, 2).
            sigma_px: Their standard deviation.
        """
        poses, points, lenses = np.broadcast_arrays(np.atleast_1d(poses), points, lenses)
        blocks = np.column_stack([poses, points, lenses])
        self._inner.add_reprojection(name, blocks, np.asarray(image_px, dtype=float), sigma_px, loss)

    def add_camera_positions(
        self, name: str, poses: ArrayLike, positions: ArrayLike, sigma: Sequence[float], *, loss: str | None = None
    ) -> None:
        """Add measured projection centres (GNSS) of pose blocks, shape (n, 3), with a standard deviation per axis."""
        positions = np.asarray(positions, dtype=float)
        self._inner.add_camera_positions(name, np.atleast_1d(poses), positions, list(sigma), loss)

    def add_prior(
        self, name: str, blocks: ArrayLike, values: ArrayLike, sigma: Sequence[float], *, loss: str | None = None
    ) -> None:
        """Add what is known of euclidean blocks beforehand: values, one row per block, and a standard deviation per entry."""
        rows = np.atleast_2d(np.asarray(values, dtype=float)).tolist()
        self._inner.add_prior(name, np.atleast_1d(blocks), rows, list(np.atleast_1d(sigma)), loss)

    def solve(self, max_iterations: int = 100, **options: Any) -> Summary:
        """Run the engine from where the blocks are.

        Args:
            max_iterations: Limit of trials.
            **options: ``method`` ("levenberg-marquardt", "dogleg"), ``linear`` ("auto", "dense", "sparse",
                "schur", "iterative-schur"), ``cost_tolerance``, ``gradient_tolerance``, ``step_tolerance``, ...

        Raises:
            SolverError: The start cannot be evaluated, or something is not finite.
        """
        return Summary(**self._inner.solve(max_iterations, options))

    def values(self, blocks: ArrayLike) -> NDArray[np.float64]:
        """The values of blocks of one size, shape (n, numbers)."""
        return self._inner.values(np.atleast_1d(blocks))

    def covariance(self, first: int, second: int | None = None) -> NDArray[np.float64]:
        """The covariance of the tangents of two blocks (of one with itself where the second is not given).

        Raises:
            SolverError: The residuals do not determine some block; says which.
        """
        return self._inner.covariance(int(first), None if second is None else int(second))

    def costs(self) -> list[float]:
        """The cost of each batch where the blocks are."""
        return self._inner.costs()

    def __repr__(self) -> str:
        return repr(self._inner)


@dataclass(frozen=True)
class BundleResult:
    """An adjusted network.

    Attributes:
        cameras: Shape (n, 9), as given.
        points: Shape (m, 3).
        summary: How it went.
    """

    cameras: NDArray[np.float64]
    points: NDArray[np.float64]
    summary: Summary


def bundle_adjust(
    cameras: ArrayLike,
    points: ArrayLike,
    camera_index: ArrayLike,
    point_index: ArrayLike,
    image_px: ArrayLike,
    *,
    loss: str | None = None,
    shared_lens: bool = False,
    max_iterations: int = 50,
    **options: Any,
) -> BundleResult:
    """Adjust a bundle (the arrays of Bundle Adjustment in the Large).

    Args:
        cameras: Rotation vector, translation (camera from world; the camera looks along -z, y up), ``f_px, k1, k2``;
            shape (n, 9).
        points: Shape (m, 3).
        camera_index: The camera of each observation, shape (k,).
        point_index: The point of each observation, shape (k,).
        image_px: Measured positions from the image centre, right and up, shape (k, 2).
        loss: As for :meth:`Problem.add`.
        shared_lens: Whether all cameras have one ``f, k1, k2``, which starts at their mean.
        max_iterations: Limit of trials.
        **options: As for :meth:`Problem.solve`.
    """
    found = _rowgram.adjust_network(
        cameras, points, camera_index, point_index, image_px, loss, shared_lens, max_iterations, options
    )
    return BundleResult(found["cameras"], found["points"], Summary(**found["summary"]))


@dataclass(frozen=True)
class AdjustResult:
    """An adjusted block.

    Attributes:
        report: Statistics, ground points, suspect observations and so on, as ``rowgram adjust --json`` prints them.
        text: The same in short, for people.
    """

    report: dict[str, Any]
    text: str

    def __str__(self) -> str:
        return self.text


def adjust(
    file: str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    *,
    force: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> AdjustResult:
    """Adjust the block of a file, with control where there is any.

    Args:
        file: A COLMAP folder, ``bundle.out``, ``reconstruction.json`` of OpenSfM or rowgram, or a BAL file.
        output: Where the adjusted block goes, in the format of the input unless ``to`` says otherwise.
        force: Whether files that exist are replaced.
        progress: Called while work goes on.
        **options: ``control``, ``marks``, ``positions``, ``camera``, ``loss``, ``datum``, ``snooping``,
            ``variance_components`` and so on, as ``rowgram adjust --help`` lists them.
    """
    found, text = _rowgram.adjust_file(
        os.fspath(file), None if output is None else os.fspath(output), force, options, progress
    )
    return AdjustResult(found, text)


def adjust_reconstruction(reconstruction: Any, **options: Any) -> tuple[Any, AdjustResult]:
    """Adjust a reconstruction of pycolmap, or any object whose ``write(folder)`` makes a COLMAP folder and whose class
    reads one.

    Args:
        reconstruction: It is not changed.
        **options: As for :func:`adjust`.

    Returns:
        The adjusted reconstruction, an object of the same class, and the report.
    """
    if not callable(getattr(reconstruction, "write", None)):
        kind = type(reconstruction).__name__
        raise InputError(f"reconstruction: expected an object with write(folder), as pycolmap.Reconstruction; not {kind}")
    with tempfile.TemporaryDirectory() as folder:
        before, after = Path(folder, "before"), Path(folder, "after")
        before.mkdir()
        reconstruction.write(os.fspath(before))
        report = adjust(before, after, **options)
        return type(reconstruction)(os.fspath(after)), report


def read_bal(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Read a file of Bundle Adjustment in the Large: the arguments of :func:`bundle_adjust`."""
    return _rowgram.read_bal(Path(path))


@dataclass(frozen=True)
class CoordinateDescentResult:
    """Where a descent ended.

    Attributes:
        x: The variables.
        initial_cost, final_cost: The objective at start and end.
        sweeps: Sweeps over all blocks.
        stop: Why it ended.
        converged: Whether that is a minimum along every block.
    """

    x: NDArray[np.float64]
    initial_cost: float
    final_cost: float
    sweeps: int
    stop: str
    converged: bool


def coordinate_descent(
    x: ArrayLike,
    cost: Callable[[NDArray[np.float64]], float],
    update: Callable[[NDArray[np.float64], int], tuple[float, Sequence[int]]],
    *,
    blocks: int | None = None,
    end_sweep: Callable[[NDArray[np.float64]], Sequence[int]] | None = None,
    monotone: bool = True,
    shuffled: bool = False,
    seed: int = 0,
    max_sweeps: int = 500,
    movement_tolerance: float = 1e-2,
    cost_tolerance: float = 1e-6,
) -> CoordinateDescentResult:
    """Minimise by optimising one block of variables after the other.

    Args:
        x: Where it starts, shape (n,).
        cost: The objective.
        update: ``update(x, k)`` changes block ``k`` of ``x`` in place to its optimum with the rest held; gives how far
            it moved and the numbers of the blocks to visit again because of that.
        blocks: Number of blocks; one per variable where not given.
        end_sweep: Called after every sweep to refit what blocks share, in place; gives the blocks to visit again.
        monotone: Whether every update decreases the cost (or leaves it).
        shuffled: Whether each sweep has a new random order, by ``seed``.
        max_sweeps: Limit of sweeps.
        movement_tolerance: It ends where no block moves further in a sweep.
        cost_tolerance: It ends where a sweep decreases the cost by less than this share.
    """
    start = np.asarray(x, dtype=float)
    if start.ndim != 1:
        raise InputError(f"x: expected shape (n,), not {start.shape}")
    count = len(start) if blocks is None else blocks
    found, summary = _rowgram.coordinate_descent(
        start.tolist(), count, cost, update, end_sweep, monotone, shuffled, seed, max_sweeps,
        movement_tolerance, cost_tolerance,
    )  # fmt: skip
    return CoordinateDescentResult(x=found, **summary)
