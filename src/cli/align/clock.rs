//! How long the stages take.

use std::time::Instant;

/// Seconds of each stage.
#[derive(Default)]
pub(super) struct Clock {
    pub(super) seconds: Vec<(&'static str, f64)>,
}

impl Clock {
    /// Does some work and notes how long it took.
    pub(super) fn time<T>(&mut self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let begin = Instant::now();
        let done = work();
        let seconds = begin.elapsed().as_secs_f64();
        tracing::info!("{stage}: {seconds:.2} s");
        self.seconds.push((stage, seconds));
        done
    }
}
