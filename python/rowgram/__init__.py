"""From overlapping drone photos of a crop field to plant traits.

A project on disk, stage by stage::

    import rowgram

    project = rowgram.Project("field")
    project.run(until="plots", progress=rowgram.progress_bar())
    traits = project.result("plots").to_pandas()

Single steps on arrays: :func:`segment`, :func:`spectral_index`, :func:`locate`, :func:`leaves`, :func:`evaluate`, :func:`sift`, :func:`match`.
Synthetic fields with ground truth: :mod:`rowgram.synth`. The two optimisation engines: :class:`Problem`,
:func:`bundle_adjust` and :func:`coordinate_descent`.

A file that takes more memory than the machine has free is refused; :func:`limit_memory` sets another limit.

Image positions are ``(u, v)`` in pixels, ``u`` to the right and ``v`` down, with the centre of the top-left pixel at
``(0, 0)``. Lengths carry their unit in the name (``_px``, ``_m``, ``_rad``).
"""

from . import synth
from ._errors import (
    IncompleteError,
    InputError,
    InternalError,
    NothingToDoError,
    RowgramError,
    RowgramWarning,
    SolverError,
)
from ._rowgram import __version__, limit_memory
from .arrays import (
    Leaves,
    Plants,
    Score,
    Vegetation,
    evaluate,
    leaves,
    locate,
    match,
    segment,
    sift,
    spectral_index,
)
from .optimize import (
    AdjustResult,
    BundleResult,
    CoordinateDescentResult,
    Problem,
    Summary,
    adjust,
    adjust_reconstruction,
    bundle_adjust,
    coordinate_descent,
    read_bal,
)
from .project import Project, RunResult, StageResult, doctor, options, print_targets, progress_bar, season

__all__ = [
    "AdjustResult",
    "BundleResult",
    "CoordinateDescentResult",
    "IncompleteError",
    "InputError",
    "InternalError",
    "Leaves",
    "NothingToDoError",
    "Plants",
    "Problem",
    "Project",
    "RowgramError",
    "RowgramWarning",
    "RunResult",
    "Score",
    "SolverError",
    "StageResult",
    "Summary",
    "Vegetation",
    "__version__",
    "adjust",
    "adjust_reconstruction",
    "bundle_adjust",
    "coordinate_descent",
    "doctor",
    "evaluate",
    "leaves",
    "limit_memory",
    "locate",
    "match",
    "options",
    "print_targets",
    "progress_bar",
    "read_bal",
    "season",
    "segment",
    "sift",
    "spectral_index",
    "synth",
]
