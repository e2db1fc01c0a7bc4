//! What long work tells while it goes on: progress, and diagnostics.
//!
//! A stage is given a [`Monitor`] and knows nothing of its listeners: the terminal, the log, the report, Python, a test.
//! A [`Diagnostic`] is a value with a severity, a code that never changes, a subject, a message and, where there is
//! one, a remedy; every listener shows the same.

use serde::{Deserialize, Serialize};
use std::{borrow::Cow, fmt, sync::Mutex};

/// How much a diagnostic matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Severity {
    /// Worth knowing; nothing has to be done.
    Info,
    /// Something was left out, assumed or is doubtful; the result may be less than it could be.
    Warning,
    /// The result should not be used before somebody has looked at it.
    Error,
}

impl Severity {
    /// The word for a person.
    pub fn word(self) -> &'static str {
        match self {
            Severity::Info => "info",
            Severity::Warning => "warning",
            Severity::Error => "error",
        }
    }
}

/// Something that was found about the input or the result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Diagnostic {
    /// How much it matters.
    pub severity: Severity,
    /// What kind of finding it is, in kebab case: the same in every release, for programs.
    pub code: Cow<'static, str>,
    /// What it is about: a file, an image, a ground point, a camera, a setting.
    pub subject: String,
    /// What was found, and what was done about it, in one or two sentences.
    pub message: String,
    /// What a person can do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub remedy: Option<String>,
}

impl Diagnostic {
    /// A diagnostic without a remedy.
    pub fn new(
        severity: Severity,
        code: &'static str,
        subject: impl Into<String>,
        message: impl Into<String>,
    ) -> Diagnostic {
        Diagnostic {
            severity,
            code: Cow::Borrowed(code),
            subject: subject.into(),
            message: message.into(),
            remedy: None,
        }
    }

    /// Worth knowing.
    pub fn info(
        code: &'static str,
        subject: impl Into<String>,
        message: impl Into<String>,
    ) -> Diagnostic {
        Diagnostic::new(Severity::Info, code, subject, message)
    }

    /// Something that makes the result less than it could be.
    pub fn warning(
        code: &'static str,
        subject: impl Into<String>,
        message: impl Into<String>,
    ) -> Diagnostic {
        Diagnostic::new(Severity::Warning, code, subject, message)
    }

    /// Something that makes the result unfit for use.
    pub fn error(
        code: &'static str,
        subject: impl Into<String>,
        message: impl Into<String>,
    ) -> Diagnostic {
        Diagnostic::new(Severity::Error, code, subject, message)
    }

    /// With what a person can do.
    #[must_use]
    pub fn with_remedy(mut self, remedy: impl Into<String>) -> Diagnostic {
        self.remedy = Some(remedy.into());
        self
    }
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.subject, self.message)?;
        match &self.remedy {
            Some(remedy) => write!(f, "; {remedy}"),
            None => Ok(()),
        }
    }
}

/// How far some work has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress<'a> {
    /// What is being done, e.g. `detecting features`.
    pub activity: &'a str,
    /// How much of it is done.
    pub done: u64,
    /// How much there is; `None` where nobody knows beforehand.
    pub total: Option<u64>,
    /// What is counted, e.g. `photos`.
    pub unit: &'static str,
}

impl Progress<'_> {
    /// Whether nothing is left to do.
    pub fn is_finished(&self) -> bool {
        self.total.is_some_and(|total| self.done >= total)
    }
}

/// A listener to long work.
pub trait Monitor: Send {
    /// A stage begins; progress and diagnostics that follow are its own.
    fn stage(&mut self, _name: &str) {}

    /// Work has moved on.
    fn progress(&mut self, _progress: &Progress<'_>) {}

    /// Something was found.
    fn diagnostic(&mut self, diagnostic: &Diagnostic);
}

/// Listens to nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Monitor for Silent {
    fn diagnostic(&mut self, _: &Diagnostic) {}
}

/// Keeps what is found.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Collector {
    /// All diagnostics in their order.
    pub diagnostics: Vec<Diagnostic>,
}

impl Monitor for Collector {
    fn diagnostic(&mut self, diagnostic: &Diagnostic) {
        self.diagnostics.push(diagnostic.clone());
    }
}

/// Hands everything on and keeps the diagnostics.
pub struct Recorder<'a> {
    to: &'a mut dyn Monitor,
    /// The diagnostics so far.
    pub diagnostics: Vec<Diagnostic>,
}

impl<'a> Recorder<'a> {
    /// Listens in place of `to`.
    pub fn new(to: &'a mut dyn Monitor) -> Recorder<'a> {
        Recorder { to, diagnostics: Vec::new() }
    }
}

impl Monitor for Recorder<'_> {
    fn stage(&mut self, name: &str) {
        self.to.stage(name);
    }

    fn progress(&mut self, progress: &Progress<'_>) {
        self.to.progress(progress);
    }

    fn diagnostic(&mut self, diagnostic: &Diagnostic) {
        self.to.diagnostic(diagnostic);
        self.diagnostics.push(diagnostic.clone());
    }
}

/// Counts work that several threads do.
pub struct Counter<'a> {
    state: Mutex<(&'a mut dyn Monitor, u64)>,
    activity: &'a str,
    total: Option<u64>,
    unit: &'static str,
}

impl<'a> Counter<'a> {
    /// Nothing is done yet.
    pub fn new(
        monitor: &'a mut dyn Monitor,
        activity: &'a str,
        total: impl Into<Option<usize>>,
        unit: &'static str,
    ) -> Counter<'a> {
        let total = total.into().map(|total| total as u64);
        monitor.progress(&Progress { activity, done: 0, total, unit });
        Counter { state: Mutex::new((monitor, 0)), activity, total, unit }
    }

    /// One more is done.
    pub fn tick(&self) {
        // A listener that panicked in another thread takes that thread down; counting goes on here.
        let mut state = self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        state.1 += 1;
        let done = state.1;
        let progress =
            Progress { activity: self.activity, done, total: self.total, unit: self.unit };
        state.0.progress(&progress);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_counter_counts_what_threads_do() {
        struct Last(Vec<u64>);
        impl Monitor for Last {
            fn progress(&mut self, progress: &Progress<'_>) {
                assert_eq!((progress.activity, progress.total), ("matching", Some(64)));
                self.0.push(progress.done);
            }
            fn diagnostic(&mut self, _: &Diagnostic) {}
        }
        let mut last = Last(Vec::new());
        let counter = Counter::new(&mut last, "matching", 64, "pairs");
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..16).for_each(|_| counter.tick()));
            }
        });
        assert_eq!(last.0, (0..=64).collect::<Vec<u64>>());
    }

    #[test]
    fn a_diagnostic_says_all_it_knows() {
        let found = Diagnostic::warning("gcp-rejected", "GCP04", "5.0 m from the block")
            .with_remedy("check its coordinates");
        assert_eq!(found.to_string(), "GCP04: 5.0 m from the block; check its coordinates");
        let text = serde_json::to_string(&found).unwrap();
        assert!(text.contains("\"severity\":\"warning\"") && text.contains("gcp-rejected"));
        assert_eq!(serde_json::from_str::<Diagnostic>(&text).unwrap(), found);
        assert!(Severity::Error > Severity::Warning);
    }
}
