//! Projects on disk and their stages.

use crate::{
    error::{from_library, input, result, without_python},
    monitor::PythonMonitor,
    options,
};
use pyo3::{
    prelude::*,
    types::{PyDict, PyList},
};
use rowgram::{
    monitor::Diagnostic,
    options::Choice,
    pipeline::{
        self, Config, Stage,
        plots::layout::{self, LayoutRequest, LayoutSource},
        run::{RunOptions, RunOutcome},
        season::SeasonFile,
        targets::{self, TargetsOptions},
    },
};
use std::path::PathBuf;

/// A folder with photos or an orthomosaic, its settings, and where results go.
#[pyclass(frozen, module = "rowgram._rowgram")]
pub(crate) struct Project(pipeline::Project);

/// `section.key=value` settings from `{"section": {"key": value}}`.
fn settings(given: Option<&Bound<'_, PyDict>>) -> PyResult<Vec<String>> {
    let mut all = Vec::new();
    for (section, keys) in given.into_iter().flatten() {
        let section: String = section.extract()?;
        let keys = keys.cast::<PyDict>().map_err(|_| {
            input(format!("{section}: expected a dictionary of options, as {section}={{...}}"))
        })?;
        for (key, value) in options::table(Some(keys))? {
            all.push(format!("{section}.{key}={value}"));
        }
    }
    Ok(all)
}

fn stage(word: &str) -> PyResult<Stage> {
    Stage::read(&word.replace('_', "-")).map_err(|why| input(format!("stage {word:?}: {why}")))
}

macro_rules! stages {
    ($($module:ident: $stage:ident),* $(,)?) => {
        /// Does one stage; its outcome as plain objects.
        fn perform<'py>(
            py: Python<'py>,
            project: &pipeline::Project,
            stage: Stage,
            given: &Bound<'py, PyDict>,
            monitor: &mut PythonMonitor,
        ) -> PyResult<Bound<'py, PyAny>> {
            match stage {
                $(Stage::$stage => {
                    let options = options::with(&project.config().$module, Some(given))?;
                    let outcome = without_python(py, || {
                        pipeline::$module::$module(project, &options, monitor)
                    })?;
                    result(py, &outcome.map_err(|error| from_library(&error))?)
                })*
            }
        }

    };
}

stages!(
    calibrate: Calibrate, align: Align, dem: Dem, surface: Surface, ortho: Ortho, segment: Segment, leaf_density: LeafDensity,
    leaf_count: LeafCount, locate: Locate, leaves: Leaves, plots: Plots, evaluate: Evaluate,
);

/// Does long work: `(outcome, diagnostics)`.
fn done<'py, T: serde::Serialize + Send>(
    py: Python<'py>,
    progress: Option<Py<PyAny>>,
    work: impl FnOnce(&mut PythonMonitor) -> Result<T, rowgram::Error> + Send,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let mut monitor = PythonMonitor::new(progress);
    let outcome = without_python(py, || work(&mut monitor))?;
    let outcome = result(py, &outcome.map_err(|error| from_library(&error))?)?;
    monitor.finish()?;
    Ok((outcome, diagnostics(py, &monitor.diagnostics)?))
}

fn diagnostics<'py>(py: Python<'py>, found: &[Diagnostic]) -> PyResult<Bound<'py, PyAny>> {
    result(py, &found)
}

#[pymethods]
impl Project {
    #[new]
    #[pyo3(signature = (path, results=None, settings=None))]
    fn new(
        path: PathBuf,
        results: Option<PathBuf>,
        settings: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Project> {
        let settings = self::settings(settings)?;
        let config = pipeline::environment()
            .and_then(|environment| Config::read(&path, environment.into_iter(), &settings))
            .map_err(|error| from_library(&error))?;
        let project = pipeline::Project::new(path, config).map_err(|error| from_library(&error))?;
        Ok(Project(match results {
            Some(results) => project.with_results(results),
            None => project,
        }))
    }

    #[getter]
    fn name(&self) -> String {
        self.0.name()
    }

    #[getter]
    fn root(&self) -> PathBuf {
        self.0.root().to_owned()
    }

    #[getter]
    fn results(&self) -> PathBuf {
        self.0.results().to_owned()
    }

    #[getter]
    fn photos(&self) -> Vec<PathBuf> {
        self.0.photos()
    }

    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        result(py, self.0.config())
    }

    /// The folder of a stage.
    fn folder(&self, stage: &str) -> PyResult<PathBuf> {
        Ok(self.0.folder(self::stage(stage)?))
    }

    /// Does one stage unless its result is current: `(outcome, diagnostics)`.
    #[pyo3(signature = (stage, options, progress=None))]
    fn stage<'py>(
        &self,
        py: Python<'py>,
        stage: &str,
        options: &Bound<'py, PyDict>,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let mut monitor = PythonMonitor::new(progress);
        let outcome = perform(py, &self.0, self::stage(stage)?, options, &mut monitor);
        let outcome = outcome?;
        monitor.finish()?;
        Ok((outcome, diagnostics(py, &monitor.diagnostics)?))
    }

    /// Cuts the plots out of their best photos: `(outcome, diagnostics)`.
    #[pyo3(signature = (options, force=false, progress=None))]
    fn crops<'py>(
        &self,
        py: Python<'py>,
        options: &Bound<'py, PyDict>,
        force: bool,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let options = options::with(&self.0.config().crops, Some(options))?;
        done(py, progress, |monitor| pipeline::crops::crops(&self.0, &options, force, monitor))
    }

    /// Finds ground control targets in the photos: `(outcome, diagnostics)`.
    #[pyo3(signature = (options, force=false, progress=None))]
    fn targets<'py>(
        &self,
        py: Python<'py>,
        options: &Bound<'py, PyDict>,
        force: bool,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let options = options::with(&self.0.config().targets, Some(options))?;
        done(py, progress, |monitor| targets::targets(&self.0, &options, force, monitor))
    }

    /// Lays out plots, and moves them onto the rows of the project: `(outcome, diagnostics)`.
    #[pyo3(signature = (corners, refine, field_map, output, options, force=false, progress=None))]
    #[expect(clippy::too_many_arguments, reason = "those of Python")]
    fn layout<'py>(
        &self,
        py: Python<'py>,
        corners: Option<PathBuf>,
        refine: Option<PathBuf>,
        field_map: Option<PathBuf>,
        output: PathBuf,
        options: &Bound<'py, PyDict>,
        force: bool,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let options = options::with(&self.0.config().layout, Some(options))?;
        let source = match (&corners, &refine) {
            (Some(corners), None) => LayoutSource::Corners(corners),
            (None, Some(polygons)) => LayoutSource::Polygons(polygons),
            _ => return Err(input("expected either corners or refine".to_owned())),
        };
        let request = LayoutRequest {
            source,
            field_map: field_map.as_deref(),
            crs: None,
            project: Some(&self.0),
            output: &output,
            force,
        };
        done(py, progress, |monitor| layout::layout(&request, &options, monitor))
    }

    /// Does all stages; the outcome of the run.
    #[pyo3(signature = (skip, begin=None, until=None, progress=None, report=true))]
    fn run<'py>(
        &self,
        py: Python<'py>,
        skip: Vec<String>,
        begin: Option<&str>,
        until: Option<&str>,
        progress: Option<Py<PyAny>>,
        report: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let options = RunOptions {
            skip: skip.iter().map(|word| stage(word)).collect::<PyResult<_>>()?,
            from: begin.map(stage).transpose()?,
            until: until.map(stage).transpose()?,
        };
        let mut monitor = PythonMonitor::new(progress);
        let project = &self.0;
        let outcome: RunOutcome = without_python(py, || {
            let outcome = pipeline::run::run(project, &options, &mut monitor)?;
            if report {
                rowgram::report::write(project, &outcome)?;
            }
            Ok(outcome)
        })?
        .map_err(|error: rowgram::Error| from_library(&error))?;
        monitor.finish()?;
        if let Some(failure) = &outcome.failure {
            return Err(from_library(failure));
        }
        result(py, &outcome)
    }
}

/// Runs a season as far as something has changed: its outcome, its folder.
#[pyfunction]
#[pyo3(signature = (file, settings, progress=None, report=true))]
pub(crate) fn season<'py>(
    py: Python<'py>,
    file: PathBuf,
    settings: Vec<String>,
    progress: Option<Py<PyAny>>,
    report: bool,
) -> PyResult<(Bound<'py, PyAny>, PathBuf)> {
    let mut monitor = PythonMonitor::new(progress);
    let done = without_python(py, || {
        let file = SeasonFile::read(&file)?;
        let environment = pipeline::environment()?;
        let outcome =
            pipeline::season::season(&file, &environment, &settings, false, &mut monitor)?;
        if report {
            rowgram::report::write_season(&file, &outcome, false)?;
        }
        Ok((outcome, file.results()))
    })?;
    let (outcome, folder) = done.map_err(|error: rowgram::Error| from_library(&error))?;
    monitor.finish()?;
    Ok((result(py, &outcome)?, folder))
}

/// Writes a PDF of targets to print.
#[pyfunction]
#[pyo3(signature = (path, options, first=0, count=1, force=false))]
pub(crate) fn print_targets(
    path: PathBuf,
    options: &Bound<'_, PyDict>,
    first: usize,
    count: usize,
    force: bool,
) -> PyResult<()> {
    let options = options::with(&TargetsOptions::default(), Some(options))?;
    targets::print_targets(&options, (first, count), &path, force)
        .map_err(|error| from_library(&error))
}

/// What a project lacks, before hours are spent on it: diagnostics.
#[pyfunction]
pub(crate) fn doctor(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyAny>> {
    let found = without_python(py, || {
        pipeline::doctor::doctor(&path, pipeline::environment()?.into_iter())
    })?;
    result(py, &found.map_err(|error| from_library(&error))?)
}

/// The names of all stages in their order.
#[pyfunction]
pub(crate) fn stage_names() -> Vec<String> {
    Stage::all().into_iter().map(|stage| stage.word()).collect()
}

/// The definitions of all options, by section.
#[pyfunction]
pub(crate) fn sections(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let all = PyDict::new(py);
    for section in Config::sections() {
        let list = PyList::empty(py);
        for field in &section.fields {
            list.append(options::describe(py, field)?)?;
        }
        let entry = PyDict::new(py);
        entry.set_item("about", section.about)?;
        entry.set_item("options", list)?;
        all.set_item(section.name, entry)?;
    }
    Ok(all)
}
