//! The terminal as a listener: progress as a bar, diagnostics as lines on stderr.

use indicatif::{ProgressBar, ProgressStyle};
use rowgram_base::monitor::{Diagnostic, Monitor, Progress, Severity};
use std::{borrow::Cow, fmt, time::Instant};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::{
    fmt::{FmtContext, FormatEvent, FormatFields, format::Writer},
    registry::LookupSpan,
};

/// A text with its control characters escaped, but for ends of lines and tabs: names of files and plots are data, and must
/// not command the terminal.
pub(super) fn visible(text: &str) -> Cow<'_, str> {
    let commands = |c: char| c.is_control() && !matches!(c, '\n' | '\t');
    if !text.contains(commands) {
        return Cow::Borrowed(text);
    }
    // As JSON has them, so that a line of JSON stays one.
    let escaped = |c: char| match commands(c) {
        true => format!("\\u{:04x}", u32::from(c)),
        false => c.to_string(),
    };
    Cow::Owned(text.chars().map(escaped).collect())
}

/// How messages are written: as they are, warnings and errors behind their word.
pub(super) struct Lines {
    /// Whether the word has a colour.
    pub(super) colour: bool,
}

impl<S, N> FormatEvent<S, N> for Lines
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut line: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let (word, code) = match *event.metadata().level() {
            Level::ERROR => ("error: ", 31),
            Level::WARN => ("warning: ", 33),
            Level::INFO => ("", 0),
            Level::DEBUG => ("debug: ", 34),
            Level::TRACE => ("trace: ", 35),
        };
        match (word, self.colour) {
            ("", _) | (_, false) => line.write_str(word)?,
            (_, true) => write!(line, "\x1b[{code}m{word}\x1b[0m")?,
        }
        let mut text = String::new();
        context.field_format().format_fields(Writer::new(&mut text), event)?;
        writeln!(line, "{}", visible(&text))
    }
}

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
