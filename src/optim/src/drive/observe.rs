//! Watching a run: what an observer is shown, and the progress line on stderr.
//!
//! An observer sees and never steers. To end a run from one, raise the flag that was given to
//! [`Drive::interrupt`](super::Drive::interrupt).

use super::Limits;
use crate::engine::{Step, Termination};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::{
    io::{IsTerminal, Write},
    time::Duration,
};

/// Where a run stands.
#[derive(Debug)]
#[non_exhaustive]
pub struct Event<'e, X> {
    /// Name of the engine.
    pub engine: &'static str,
    /// How many iterations have been made, those before a resumption among them.
    pub iteration: u64,
    /// The iterate as it is now.
    pub x: &'e X,
    /// What the last step did; `None` before the first one.
    pub step: Option<&'e Step>,
    /// Cost of the iterate.
    pub cost: f64,
    /// Smallest cost so far.
    pub best_cost: f64,
    /// Seconds since the start, those before a resumption among them.
    pub seconds: f64,
    /// Iterations made since the start or the last resumption.
    pub iterations_here: u64,
    /// Seconds since the start or the last resumption.
    pub seconds_here: f64,
    /// What ends the run at the latest.
    pub limits: &'e Limits,
}

impl<X> Event<'_, X> {
    /// Iterations per second since the start or the last resumption; `None` before the first.
    pub fn rate(&self) -> Option<f64> {
        let rate = self.iterations_here as f64 / self.seconds_here;
        (rate > 0.0 && rate.is_finite()).then_some(rate)
    }

    /// Seconds until a limit ends the run, if there is one that can be foreseen.
    pub fn seconds_left(&self) -> Option<f64> {
        let by_time = self.limits.max_time.map(|limit| limit.as_secs_f64() - self.seconds);
        let by_count = (self.limits.max_iterations < u64::MAX).then(|| {
            let left = self.limits.max_iterations.saturating_sub(self.iteration);
            self.rate().map(|rate| left as f64 / rate)
        });
        [by_time, by_count.flatten()].into_iter().flatten().reduce(f64::min).map(|s| s.max(0.0))
    }
}

/// Somebody who watches a run over iterates of type `X`.
pub trait Observe<X> {
    /// The run begins or goes on from a checkpoint.
    fn start(&mut self, _event: &Event<'_, X>) {}
    /// A step was made.
    fn step(&mut self, _event: &Event<'_, X>) {}
    /// The run is over.
    fn end(&mut self, _event: &Event<'_, X>, _stop: Termination) {}
}

/// A closure that is called after every step.
pub(super) struct EachStep<F>(pub(super) F);

impl<X, F: FnMut(&Event<'_, X>)> Observe<X> for EachStep<F> {
    fn step(&mut self, event: &Event<'_, X>) {
        (self.0)(event);
    }
}

/// Progress for a person: a bar on a terminal, a plain line every ten seconds elsewhere.
///
/// Both show the stage, the iteration and its limit, the cost, the rate, and the time that is left
/// until a limit. A run that ends within a second shows nothing.
#[derive(Debug)]
pub struct Progress {
    stage: String,
    form: Form,
    /// Seconds of the run at which something is shown next.
    due: f64,
}

enum Form {
    Bar(ProgressBar),
    Lines(Box<dyn Write>),
}

impl std::fmt::Debug for Form {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            Form::Bar(_) => "Bar",
            Form::Lines(_) => "Lines",
        })
    }
}

/// Seconds before anything is shown, between updates of the bar, and between plain lines.
const PATIENCE_SECONDS: f64 = 1.0;
const BAR_EVERY_SECONDS: f64 = 0.1;
const LINE_EVERY_SECONDS: f64 = 10.0;

impl Progress {
    /// Progress on stderr under the name of a stage, e.g. "adjust".
    pub fn stderr(stage: &str) -> Progress {
        if std::io::stderr().is_terminal() {
            let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
            Progress { stage: stage.to_owned(), form: Form::Bar(bar), due: 0.0 }
        } else {
            Progress::lines(stage, std::io::stderr())
        }
    }

    /// Progress as plain lines to `writer`.
    pub fn lines(stage: &str, writer: impl Write + 'static) -> Progress {
        Progress { stage: stage.to_owned(), form: Form::Lines(Box::new(writer)), due: 0.0 }
    }
}

impl<X> Observe<X> for Progress {
    fn start(&mut self, event: &Event<'_, X>) {
        self.due = event.seconds + PATIENCE_SECONDS;
        if let Form::Bar(bar) = &self.form {
            bar.set_prefix(self.stage.clone());
            let limit = event.limits.max_iterations;
            let template = if limit < u64::MAX {
                bar.set_length(limit);
                "{prefix} {bar:24} {pos}/{len}  {msg}"
            } else {
                "{prefix} {spinner} {pos}  {msg}"
            };
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style);
            }
        }
    }

    fn step(&mut self, event: &Event<'_, X>) {
        if event.seconds < self.due {
            return;
        }
        match &mut self.form {
            Form::Bar(bar) => {
                self.due = event.seconds + BAR_EVERY_SECONDS;
                bar.set_message(describe(event));
                bar.set_position(event.iteration);
            }
            Form::Lines(writer) => {
                self.due = event.seconds + LINE_EVERY_SECONDS;
                let count = counted(event);
                // A progress line that cannot be written is no reason to end a run.
                let _ = writeln!(writer, "{}: iteration {count}, {}", self.stage, describe(event));
            }
        }
    }

    fn end(&mut self, _event: &Event<'_, X>, _stop: Termination) {
        if let Form::Bar(bar) = &self.form {
            bar.finish_and_clear();
        }
    }
}

fn counted<X>(event: &Event<'_, X>) -> String {
    match event.limits.max_iterations {
        u64::MAX => event.iteration.to_string(),
        limit => format!("{} of {limit}", event.iteration),
    }
}

/// "cost 1.234567e3, 12.5 iterations/s, 41 s, at most 19 s left".
fn describe<X>(event: &Event<'_, X>) -> String {
    let mut text = format!("cost {:.6e}", event.cost);
    if let Some(rate) = event.rate() {
        text += &match rate {
            0.1.. => format!(", {rate:.1} iterations/s"),
            _ => format!(", {:.0} s per iteration", 1.0 / rate),
        };
    }
    text += &format!(", {}", span(event.seconds));
    if let Some(left) = event.seconds_left() {
        text += &format!(", at most {} left", span(left));
    }
    text
}

fn span(seconds: f64) -> String {
    let whole = Duration::from_secs_f64(seconds.clamp(0.0, 1e9).round()).as_secs();
    match whole {
        0..120 => format!("{whole} s"),
        120..7200 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{cell::RefCell, rc::Rc};

    #[derive(Clone, Default)]
    struct Paper(Rc<RefCell<Vec<u8>>>);

    impl Write for Paper {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.borrow_mut().extend_from_slice(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    fn event<'e>(limits: &'e Limits, iteration: u64, seconds: f64) -> Event<'e, ()> {
        Event {
            engine: "toy",
            iteration,
            x: &(),
            step: None,
            cost: 1234.5,
            best_cost: 1234.5,
            seconds,
            iterations_here: iteration,
            seconds_here: seconds,
            limits,
        }
    }

    #[test]
    fn plain_lines_are_rare_and_say_everything() {
        let limits = Limits { max_iterations: 100, ..Limits::default() };
        let paper = Paper::default();
        let mut progress = Progress::lines("adjust", paper.clone());
        progress.start(&event(&limits, 0, 0.0));
        for second in 1..=12 {
            progress.step(&event(&limits, 2 * second, second as f64));
        }
        let text = String::from_utf8(paper.0.borrow().clone()).unwrap();
        assert_eq!(
            text,
            "adjust: iteration 2 of 100, cost 1.234500e3, 2.0 iterations/s, 1 s, at most 49 s left\n\
             adjust: iteration 22 of 100, cost 1.234500e3, 2.0 iterations/s, 11 s, at most 39 s left\n"
        );
    }

    #[test]
    fn the_nearer_limit_counts() {
        let mut limits = Limits::default();
        assert_eq!(event(&limits, 10, 5.0).seconds_left(), None);
        limits.max_time = Some(Duration::from_secs(6));
        assert_eq!(event(&limits, 10, 5.0).seconds_left(), Some(1.0));
        limits.max_iterations = 11;
        assert_eq!(event(&limits, 10, 5.0).seconds_left(), Some(0.5));
        assert_eq!(event(&limits, 10, 7.0).seconds_left(), Some(0.0), "never negative");
    }

    #[test]
    fn spans_read_well() {
        assert_eq!(span(0.4), "0 s");
        assert_eq!(span(125.0), "2 min 05 s");
        assert_eq!(span(3.0 * 3600.0 + 61.0), "3 h 01 min");
    }
}
