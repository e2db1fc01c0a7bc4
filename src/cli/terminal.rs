//! The terminal as a listener: progress as a bar, diagnostics as lines on stderr.

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use rowgram_base::monitor::{Diagnostic, Monitor, Progress, Severity};
use std::{
    borrow::Cow,
    fmt, io,
    sync::LazyLock,
    time::{Duration, Instant},
};
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

/// The bars that are on the terminal, if it is one; everything else is written above them.
fn bars() -> &'static MultiProgress {
    static BARS: LazyLock<MultiProgress> = LazyLock::new(MultiProgress::new);
    &BARS
}

/// Writes to stderr above the bars.
pub(super) struct AboveBars;

impl io::Write for AboveBars {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        bars().suspend(|| io::stderr().write(text))
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

/// How often a bar shows the time, so that nobody takes long work for none.
const TICK: Duration = Duration::from_secs(1);

/// Shows what stages tell, and between that for how long the work has been silent.
pub(super) struct Terminal {
    stage: Option<(String, Instant)>,
    /// What is being done, where that was told, and its bar.
    bar: (Option<String>, ProgressBar),
}

impl Terminal {
    /// Nothing has happened yet.
    pub(super) fn new() -> Terminal {
        let mut terminal = Terminal { stage: None, bar: (None, ProgressBar::hidden()) };
        terminal.wait();
        terminal
    }

    fn clear(&mut self) {
        self.bar.1.finish_and_clear();
        bars().remove(&self.bar.1);
    }

    /// Shows a bar in place of the last one.
    fn show(&mut self, activity: Option<&str>, total: Option<u64>, shape: &str) {
        self.clear();
        let bar = bars().add(total.map_or_else(ProgressBar::new_spinner, ProgressBar::new));
        if let Ok(style) = ProgressStyle::with_template(shape) {
            bar.set_style(style);
        }
        let stage = self.stage.as_ref().map(|(stage, _)| stage.as_str());
        bar.set_prefix(activity.or(stage).unwrap_or("working").to_owned());
        bar.enable_steady_tick(TICK);
        self.bar = (activity.map(ToOwned::to_owned), bar);
    }

    /// Shows that the work goes on, although nobody says how far it is.
    fn wait(&mut self) {
        self.show(None, None, "{prefix} {spinner} {elapsed}");
    }
}

impl Monitor for Terminal {
    fn stage(&mut self, name: &str) {
        if let Some((before, begin)) = self.stage.replace((name.to_owned(), Instant::now())) {
            tracing::debug!("{before}: {:.2} s", begin.elapsed().as_secs_f64());
        }
        tracing::info!("{name}");
        self.wait();
    }

    fn progress(&mut self, progress: &Progress<'_>) {
        if self.bar.0.as_deref() != Some(progress.activity) {
            let shape = match progress.total {
                Some(_) => "{prefix} {wide_bar} {pos}/{len} {msg} {eta}",
                None => "{prefix} {spinner} {pos} {msg} {elapsed}",
            };
            self.show(Some(progress.activity), progress.total, shape);
            self.bar.1.set_message(progress.unit);
        }
        self.bar.1.set_position(progress.done);
        if progress.is_finished() {
            self.wait();
        }
    }

    fn diagnostic(&mut self, diagnostic: &Diagnostic) {
        match diagnostic.severity {
            Severity::Info => tracing::info!("{diagnostic}"),
            Severity::Warning => tracing::warn!("{diagnostic}"),
            Severity::Error => tracing::error!("{diagnostic}"),
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        self.clear();
    }
}
