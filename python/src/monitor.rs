//! Progress and diagnostics for Python: a callback, and `warnings`.

use pyo3::{prelude::*, types::PyDict};
use rowgram::monitor::{Diagnostic, Monitor, Progress, Severity};
use std::time::{Duration, Instant};

/// The shortest time between two calls of the callback.
const PAUSE: Duration = Duration::from_millis(50);

/// Hands progress to a callable `progress(stage, activity, done, total, unit)`, and warnings to Python's own.
///
/// What Python raises (an interrupt, a warning that is an error) is kept and raised where the work ends: a stage cannot
/// be left half-way without losing what it has done.
pub(crate) struct PythonMonitor {
    callback: Option<Py<PyAny>>,
    stage: String,
    last: Option<Instant>,
    raised: Option<PyErr>,
    warns: bool,
    /// Everything that was found.
    pub(crate) diagnostics: Vec<Diagnostic>,
}

impl PythonMonitor {
    pub(crate) fn new(callback: Option<Py<PyAny>>) -> PythonMonitor {
        let (stage, diagnostics) = (String::new(), Vec::new());
        PythonMonitor { callback, stage, last: None, raised: None, warns: true, diagnostics }
    }

    /// What Python raised meanwhile.
    pub(crate) fn finish(&mut self) -> PyResult<()> {
        self.raised.take().map_or(Ok(()), Err)
    }

    fn keep(&mut self, outcome: PyResult<()>) {
        if let (Err(error), None) = (outcome, &self.raised) {
            self.raised = Some(error);
            self.callback = None;
            self.warns = false;
        }
    }
}

impl Monitor for PythonMonitor {
    fn stage(&mut self, name: &str) {
        name.clone_into(&mut self.stage);
    }

    fn progress(&mut self, progress: &Progress<'_>) {
        let Some(callback) = &self.callback else { return };
        let is_due = self.last.is_none_or(|last| last.elapsed() >= PAUSE);
        if !(is_due || progress.is_finished()) {
            return;
        }
        self.last = Some(Instant::now());
        let outcome = Python::attach(|py| {
            py.check_signals()?;
            let Progress { activity, done, total, unit } = *progress;
            callback.call1(py, (&self.stage, activity, done, total, unit)).map(drop)
        });
        self.keep(outcome);
    }

    fn diagnostic(&mut self, diagnostic: &Diagnostic) {
        self.diagnostics.push(diagnostic.clone());
        if diagnostic.severity == Severity::Info || !self.warns {
            return;
        }
        let outcome = Python::attach(|py| warn(py, diagnostic));
        self.keep(outcome);
    }
}

fn warn(py: Python<'_>, diagnostic: &Diagnostic) -> PyResult<()> {
    let class = py.import("rowgram._errors")?.getattr("RowgramWarning")?;
    let parts = crate::error::result(py, diagnostic)?;
    let warning = class.call1((diagnostic.to_string(), parts))?;
    let arguments = PyDict::new(py);
    arguments.set_item("stacklevel", 3)?;
    py.import("warnings")?.call_method("warn", (warning,), Some(&arguments)).map(drop)
}
