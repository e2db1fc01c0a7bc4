//! The terminal as a listener: progress as a bar, diagnostics as lines on stderr.

use crate::monitor::{Diagnostic, Monitor, Progress, Severity};
use indicatif::{ProgressBar, ProgressStyle};
use std::time::Instant;

/// Shows what stages tell.
#[derive(Default)]
pub(super) struct Terminal {
    stage: Option<(String, Instant)>,
    bar: Option<(String, ProgressBar)>,
}

impl Terminal {
    /// Nothing has happened yet.
    pub(super) fn new() -> Terminal {
        Terminal::default()
    }

    fn clear(&mut self) {
        if let Some((_, bar)) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

impl Monitor for Terminal {
    fn stage(&mut self, name: &str) {
        self.clear();
        if let Some((before, begin)) = self.stage.replace((name.to_owned(), Instant::now())) {
            tracing::debug!("{before}: {:.2} s", begin.elapsed().as_secs_f64());
        }
        tracing::info!("{name}");
    }

    fn progress(&mut self, progress: &Progress<'_>) {
        if self.bar.as_ref().is_none_or(|(activity, _)| activity != progress.activity) {
            self.clear();
            let bar = match progress.total {
                Some(total) => ProgressBar::new(total),
                None => ProgressBar::new_spinner(),
            };
            let shape = match progress.total {
                Some(_) => "{prefix} {wide_bar} {pos}/{len} {msg} {eta}",
                None => "{prefix} {spinner} {pos} {msg}",
            };
            if let Ok(style) = ProgressStyle::with_template(shape) {
                bar.set_style(style);
            }
            bar.set_prefix(progress.activity.to_owned());
            bar.set_message(progress.unit);
            self.bar = Some((progress.activity.to_owned(), bar));
        }
        if let Some((_, bar)) = &self.bar {
            bar.set_position(progress.done);
        }
        if progress.is_finished() {
            self.clear();
        }
    }

    fn diagnostic(&mut self, diagnostic: &Diagnostic) {
        let say = || match diagnostic.severity {
            Severity::Info => tracing::info!("{diagnostic}"),
            Severity::Warning => tracing::warn!("{diagnostic}"),
            Severity::Error => tracing::error!("{diagnostic}"),
        };
        match &self.bar {
            Some((_, bar)) => bar.suspend(say),
            None => say(),
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        self.clear();
    }
}
