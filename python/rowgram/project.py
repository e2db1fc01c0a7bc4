"""Projects on disk: from a folder of photos to traits, stage by stage."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import _rowgram
from ._errors import InputError

if TYPE_CHECKING:
    import geopandas
    import pandas

Progress = Callable[[str, str, int, "int | None", str], None]
"""Called as ``progress(stage, activity, done, total, unit)`` while work goes on; ``total`` may be ``None``."""

MAIN_TABLES = {
    "locate": "plants.csv",
    "leaves": "leaves.csv",
    "plots": "traits.csv",
    "crops": "traits.csv",
    "targets": "targets.csv",
    "layout": "layout.csv",
    "season": "traits_long.csv",
    "leaf-count": "counts.csv",
    "align": "exterior_orientation.csv",
}
"""The table of a stage that ``to_pandas()`` reads where none is named."""


def _of_cell(cell: Any) -> Any:
    """A name as it was before it was written: one like a formula has an apostrophe in front (see the formats)."""
    if not isinstance(cell, str) or not cell.startswith("'"):
        return cell
    text = cell.lstrip("'")
    try:
        float(text)
    except ValueError:
        return cell[1:] if text.startswith(("=", "+", "-", "@", "\t", "\r")) else cell
    return cell


def season(
    file: str | os.PathLike[str],
    *,
    settings: Iterable[str] = (),
    progress: Progress | None = None,
    report: bool = True,
) -> StageResult:
    """Run the flights of a season as far as something has changed, and follow plots and plants through its dates.

    ``to_pandas()`` of the result has a row for each date, plot and trait; ``to_pandas("growth.csv")`` the growth curves,
    ``to_pandas("plants_long.csv")`` the plants, ``to_pandas("colours.csv")`` what the light of each date was multiplied by.

    Args:
        file: The list of flights, usually ``season.toml``.
        settings: Keys of the ``rowgram.toml`` of all flights, as ``"section.key=value"``.
        progress: Called while work goes on.
        report: Whether ``report.html`` is written.

    Raises:
        InputError: The list, the plots or a setting cannot be used.
    """
    values, folder = _rowgram.season(os.fspath(file), list(settings), progress, report)
    return StageResult("season", Path(folder), values, values["diagnostics"])


def print_targets(
    path: str | os.PathLike[str],
    kind: str,
    size_m: float,
    *,
    first: int = 0,
    count: int = 1,
    force: bool = False,
) -> None:
    """Write targets to print into a PDF, in true size, one on a page.

    Args:
        path: The file, ``.pdf``.
        kind: ``"chequered"``, ``"cross"``, ``"disc"``, ``"apriltag"`` or ``"aruco"``.
        size_m: Side of a chequered plate or of the black square of a code, length of the arms of a cross, diameter of a disc; metres.
        first: Code of the first target.
        count: Number of targets.
        force: Replace a file that exists.

    Raises:
        InputError: A kind or size that cannot be printed, codes that do not exist, a file that exists.
    """
    _rowgram.print_targets(os.fspath(path), {"kind": kind, "size_m": size_m}, first, count, force)


def doctor(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """What a project lacks, before hours are spent on it.

    Returns:
        One dictionary per finding: ``severity`` ("info", "warning", "error"), ``code``, ``subject``, ``message`` and,
        where there is one, ``remedy``.
    """
    return _rowgram.doctor(os.fspath(path))


def options(section: str | None = None) -> dict[str, Any]:
    """The definitions of all options: name, meaning, unit, default.

    Args:
        section: One section of ``rowgram.toml``, such as ``"locate"``; all where not given.
    """
    all_sections = _rowgram.sections()
    if section is None:
        return all_sections
    try:
        return all_sections[section.replace("-", "_")]
    except KeyError:
        known = ", ".join(all_sections)
        raise InputError(f"section {section!r}: expected one of {known}") from None


def progress_bar() -> Progress:
    """A progress bar per activity, by `tqdm` (which has to be installed)."""
    from tqdm.auto import tqdm

    bars: dict[tuple[str, str], Any] = {}

    def show(stage: str, activity: str, done: int, total: int | None, unit: str) -> None:
        bar = bars.get((stage, activity))
        if bar is None:
            bar = bars[stage, activity] = tqdm(total=total, desc=f"{stage}: {activity}", unit=f" {unit}")
        bar.update(done - bar.n)
        if total is not None and done >= total:
            bar.close()
            del bars[stage, activity]

    return show


class StageResult:
    """What came of a stage.

    Numbers are attributes (``result.plants``) and in ``values``; files are in ``folder``.
    """

    def __init__(self, stage: str, folder: Path, values: dict[str, Any], diagnostics: list[dict[str, Any]]) -> None:
        self.stage = stage
        self.folder = folder
        self.values = values
        self.diagnostics = diagnostics

    def __getattr__(self, name: str) -> Any:
        values = self.__dict__.get("values") or {}
        if name in values:
            return values[name]
        raise AttributeError(f"stage {self.__dict__.get('stage')} has no {name}; there are: {', '.join(values)}")

    def __dir__(self) -> Iterable[str]:
        return [*super().__dir__(), *self.values]

    def __repr__(self) -> str:
        shown = {k: v for k, v in self.values.items() if isinstance(v, (int, float, str, bool))}
        return f"<rowgram {self.stage}: {', '.join(f'{k}={v!r}' for k, v in shown.items())}>"

    @property
    def files(self) -> list[Path]:
        """All files of the stage."""
        return sorted(path for path in self.folder.rglob("*") if path.is_file())

    def file(self, name: str) -> Path:
        """A file of the stage.

        Raises:
            InputError: There is none of this name.
        """
        path = self.folder / name
        if not path.is_file():
            there = ", ".join(str(file.relative_to(self.folder)) for file in self.files)
            raise InputError(f"{path}: there is no such file; the stage {self.stage} wrote {there or 'nothing'}")
        return path

    def to_pandas(self, table: str | None = None) -> pandas.DataFrame:
        """A table of the stage; that of its plants, leaves, plots, ... where none is named."""
        import pandas

        found = pandas.read_csv(self.file(table or self._main(".csv")))
        for column in found.select_dtypes(exclude=["number", "bool"]):
            found[column] = found[column].map(_of_cell)
        return found.rename(columns=_of_cell)

    def to_geopandas(self, layer: str | None = None) -> geopandas.GeoDataFrame:
        """A map layer of the stage (GeoPackage or GeoJSON), where it has one."""
        import geopandas

        return geopandas.read_file(self.file(layer or self._main(".gpkg", ".geojson")))

    def _main(self, *endings: str) -> str:
        known = MAIN_TABLES.get(self.stage)
        if known is not None and known.endswith(endings) and (self.folder / known).is_file():
            return known
        fits = [str(path.relative_to(self.folder)) for path in self.files if path.name.endswith(endings)]
        if len(fits) == 1:
            return fits[0]
        raise InputError(f"stage {self.stage}: name one of {', '.join(fits)}" if fits else f"{self.stage} has no table")


class RunResult:
    """What came of a run: ``stages``, ``checks``, ``gsd_m`` and the result of each stage."""

    def __init__(self, project: Project, values: dict[str, Any]) -> None:
        self._project = project
        self.values = values
        self.stages: list[dict[str, Any]] = values["stages"]
        self.checks: list[dict[str, Any]] = values["checks"]
        self.gsd_m: float | None = values["gsd_m"]

    def __getitem__(self, stage: str) -> StageResult:
        word = stage.replace("_", "-")
        values = self.values["results"].get(word.replace("-", "_"))
        if values is None:
            done = [entry["stage"] for entry in self.stages if entry["ending"] in ("done", "kept")]
            raise InputError(f"stage {stage!r} was not done; these were: {', '.join(done)}")
        found = [entry["diagnostics"] for entry in self.stages if entry["stage"] == word]
        return StageResult(word, self._project.folder(word), values, found[0] if found else [])

    def __repr__(self) -> str:
        ends = ", ".join(f"{entry['stage']} {entry['ending']}" for entry in self.stages)
        return f"<rowgram run of {self.values['project']}: {ends}>"


class Project:
    """A folder with photos or an orthomosaic, its settings, and where results go.

    Args:
        path: The folder.
        results: Folder of the results; ``rowgram`` below the project where not given.
        **settings: Sections of ``rowgram.toml`` as dictionaries, which come before the file:
            ``align={"seed": 2}, dem={"cell_m": 0.1}``.

    Raises:
        InputError: No folder; a setting that does not exist or cannot have this value.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        results: str | os.PathLike[str] | None = None,
        **settings: dict[str, Any],
    ) -> None:
        if not isinstance(path, (str, os.PathLike)):
            raise InputError(f"path: expected text or a path, not {type(path).__name__}")
        self._path = os.fspath(path)
        self._results = None if results is None else os.fspath(results)
        self._settings = settings
        self._inner = _rowgram.Project(self._path, self._results, settings)

    @property
    def name(self) -> str:
        """Its name for people."""
        return self._inner.name

    @property
    def root(self) -> Path:
        """The folder of the project."""
        return Path(self._inner.root)

    @property
    def results(self) -> Path:
        """The folder of its results."""
        return Path(self._inner.results)

    @property
    def photos(self) -> list[Path]:
        """Its photos, sorted by name."""
        return [Path(path) for path in self._inner.photos]

    @property
    def settings(self) -> dict[str, Any]:
        """All settings by section."""
        return self._inner.settings

    def folder(self, stage: str) -> Path:
        """The folder of a stage."""
        return Path(self._inner.folder(stage))

    def run(
        self,
        until: str | None = None,
        *,
        begin: str | None = None,
        skip: Iterable[str] = (),
        progress: Progress | None = None,
        report: bool = True,
        **settings: dict[str, Any],
    ) -> RunResult:
        """Do all stages; what is current is kept.

        Args:
            until: The last stage.
            begin: This stage and those after it are done again, whatever is kept.
            skip: Stages to leave out.
            progress: Called while work goes on, see :data:`Progress`; :func:`progress_bar` makes one.
            report: Whether ``report.html`` is written.
            **settings: Sections as dictionaries, for this run: ``locate={"method": "paper"}``.

        Raises:
            InputError: The input cannot be used.
            RowgramError: A stage failed; results of the stages before it are kept.
        """
        inner = self._inner
        if settings:
            merged = {name: dict(keys) for name, keys in self._settings.items()}
            for name, keys in settings.items():
                if not isinstance(keys, dict):
                    raise InputError(f"{name}: expected a dictionary of options, as {name}={{...}}")
                merged.setdefault(name, {}).update(keys)
            inner = _rowgram.Project(self._path, self._results, merged)
        values = inner.run(list(skip), begin, until, progress, report)
        return RunResult(self, values)

    def stage(self, stage: str, *, progress: Progress | None = None, **options: Any) -> StageResult:
        """Do one stage, unless its result is current.

        Args:
            stage: Its name, such as ``"align"`` or ``"leaf-count"``.
            progress: Called while work goes on.
            **options: Its options; ``rowgram.options(stage)`` lists them.
        """
        values, diagnostics = self._inner.stage(stage, options, progress)
        return StageResult(stage.replace("_", "-"), self.folder(stage), values, diagnostics)

    def crops(self, *, force: bool = False, progress: Progress | None = None, **options: Any) -> StageResult:
        """Cut every plot out of its best photos, with traits photo by photo.

        The table of the result (``to_pandas()``) has a row per plot: the mean of each trait over the photos and its standard
        deviation between photos (``_sd``); ``to_pandas("crops.csv")`` has a row per picture.

        Args:
            force: Replace crops that are there.
            progress: Called while work goes on.
            **options: ``photos_per_plot``, ``margin_m``, ...: ``rowgram.options("crops")`` lists them.

        Raises:
            InputError: There are no plots, or crops are there already.
        """
        values, diagnostics = self._inner.crops(options, force, progress)
        return StageResult("crops", Path(values["folder"]), values, diagnostics)

    def targets(self, *, force: bool = False, progress: Progress | None = None, **options: Any) -> StageResult:
        """Find the ground control targets of an aligned project in its photos, and write ``marks.csv``.

        The next :meth:`run` uses the marks. Marks made by hand stay as they are. The table of the result (``to_pandas()``) has a
        row for each target in each photo that should show it; ``file("targets.png")`` is a contact sheet.

        Args:
            force: Replace marks made by hand, too.
            progress: Called while work goes on.
            **options: ``kind``, ``size_m``, ``search_m``, ...: ``rowgram.options("targets")`` lists them.

        Raises:
            InputError: The project has no ground points, or they are nowhere near the photos.
            IncompleteError: Photos and survey agree about no target.
        """
        values, diagnostics = self._inner.targets(options, force, progress)
        return StageResult("targets", Path(values["table"]).parent, values, diagnostics)

    def layout(
        self,
        corners: str | os.PathLike[str] | None = None,
        *,
        refine: str | os.PathLike[str] | None = None,
        field_map: str | os.PathLike[str] | None = None,
        output: str | os.PathLike[str] | None = None,
        force: bool = False,
        progress: Progress | None = None,
        **options: Any,
    ) -> StageResult:
        """Lay out the plots of the field, and move them onto the rows that were found.

        The result has the plots as ``plots.gpkg``, ``plots.geojson`` and ``plots.shp`` (``to_geopandas("plots.gpkg")``), and
        ``layout.csv`` with the standard deviations of their corners, metres. Where the plants of the project were not located
        yet, the plots are where corners and design put them.

        Args:
            corners: Table of two to four surveyed corners (``corner``, ``easting_m``, ``northing_m``, or degrees).
            refine: Polygons to move, in place of corners.
            field_map: Table of entries: ``plot`` and any other columns, which become attributes of the plots.
            output: Folder to write into; ``layout`` in the results where none is named.
            force: Replace files that exist.
            progress: Called while work goes on.
            **options: The design: ``ranges``, ``plots_per_range``, ...: ``rowgram.options("layout")`` lists them.

        Raises:
            InputError: The design lacks something, corners do not fit, polygons are damaged, or files exist.
        """
        path = lambda given: None if given is None else os.fspath(given)  # noqa: E731
        folder = Path(output) if output is not None else Path(self.results) / "layout"
        arguments = (path(corners), path(refine), path(field_map), os.fspath(folder))
        values, diagnostics = self._inner.layout(*arguments, options, force, progress)
        return StageResult("layout", folder, values, diagnostics)

    def result(self, stage: str) -> StageResult:
        """What came of a stage in the last run.

        Raises:
            InputError: There was no run, or it did not do this stage.
        """
        import json

        path = self.results / "stats.json"
        if not path.is_file():
            raise InputError(f"{path}: there are no results here; call run() first")
        return RunResult(self, json.loads(path.read_text(encoding="utf-8")))[stage]

    @property
    def report(self) -> Path:
        """The report of the last run, one HTML file."""
        return self.results / "report.html"

    def show(self) -> Any:
        """The report inside a notebook."""
        from IPython.display import IFrame

        if not self.report.is_file():
            raise InputError(f"{self.report}: there is no report; call run() first")
        return IFrame(os.path.relpath(self.report), width="100%", height=600)

    def __repr__(self) -> str:
        return f"<rowgram.Project {self.name!r} in {self.root}>"


def _stage_method(stage: str) -> Callable[..., StageResult]:
    def method(self: Project, *, progress: Progress | None = None, **options: Any) -> StageResult:
        return self.stage(stage, progress=progress, **options)

    method.__name__ = method.__qualname__ = stage.replace("-", "_")
    method.__doc__ = f"Do the stage ``{stage}``; options as ``rowgram.options({stage!r})`` lists them."
    return method


for _stage in _rowgram.stage_names():
    setattr(Project, _stage.replace("-", "_"), _stage_method(_stage))
