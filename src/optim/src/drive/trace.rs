//! The trace: one row per iteration, in memory while the run lasts, a CSV file when it is over.
//!
//! Columns: `iteration, cost, best_cost, step_norm, accepted, seconds`, then the engine's notes by
//! name. Row 0 is the start, whose other cells are empty. Numbers are written so that reading them
//! gives the same bits. The rows travel with every checkpoint: the trace of a resumed run begins at
//! row 0 and differs from that of an uninterrupted one in nothing but its seconds.

use crate::{
    engine::Step,
    output::{self, FileError},
};
use serde::{Deserialize, Serialize};
use std::{io::Write, path::Path};

const COLUMNS: [&str; 6] = ["iteration", "cost", "best_cost", "step_norm", "accepted", "seconds"];

/// The rows so far; the notes of all rows lie in one list, so that a row costs no allocation.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(super) struct Rows {
    names: Vec<String>,
    rows: Vec<Row>,
    metrics: Vec<f64>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Row {
    iteration: u64,
    cost: f64,
    best_cost: f64,
    seconds: f64,
    /// Movement and acceptance; the start has neither.
    step: Option<(f64, bool)>,
}

impl Rows {
    /// The row from which the run is traced: the start, or where it was resumed untraced.
    pub(super) fn start(iteration: u64, cost: f64, best_cost: f64, seconds: f64) -> Rows {
        let row = Row { iteration, cost, best_cost, seconds, step: None };
        Rows { rows: vec![row], ..Rows::default() }
    }

    /// Adds what one step did. The first step decides which notes are columns.
    pub(super) fn push(&mut self, iteration: u64, step: &Step, best_cost: f64, seconds: f64) {
        if self.rows.last().is_none_or(|row| row.step.is_none()) {
            self.names = step.metrics.iter().map(|(name, _)| (*name).to_owned()).collect();
        }
        debug_assert!(
            self.names.iter().map(String::as_str).eq(step.metrics.iter().map(|(name, _)| *name)),
            "an engine has the same notes in the same order at every step"
        );
        let values = step.metrics.iter().map(|(_, value)| *value);
        self.metrics.extend(values.chain(std::iter::repeat(f64::NAN)).take(self.names.len()));
        let (cost, step) = (step.cost, Some((step.step_norm, step.accepted)));
        self.rows.push(Row { iteration, cost, best_cost, seconds, step });
    }

    /// Writes the trace.
    pub(super) fn write(&self, path: &Path, force: bool) -> Result<(), FileError> {
        output::write(path, force, |file| self.write_csv(file))
    }

    fn write_csv(&self, file: &mut dyn Write) -> std::io::Result<()> {
        let names = self.names.iter().map(|name| quoted(name));
        let header: Vec<String> = COLUMNS.into_iter().map(str::to_owned).chain(names).collect();
        writeln!(file, "{}", header.join(","))?;
        let mut metrics = self.metrics.iter();
        for row in &self.rows {
            let (step_norm, accepted) = match row.step {
                Some((step_norm, accepted)) => {
                    (number(step_norm), if accepted { "1" } else { "0" })
                }
                None => (String::new(), ""),
            };
            let [cost, best_cost] = [row.cost, row.best_cost].map(number);
            let (iteration, seconds) = (row.iteration, row.seconds);
            write!(file, "{iteration},{cost},{best_cost},{step_norm},{accepted},{seconds:.6}")?;
            for _ in &self.names {
                let note = if row.step.is_some() { metrics.next() } else { None };
                write!(file, ",{}", note.map_or(String::new(), |value| number(*value)))?;
            }
            writeln!(file)?;
        }
        file.flush()
    }
}

/// A name as a cell: an engine of somebody else's may call a metric what it likes.
fn quoted(name: &str) -> String {
    if name.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", name.replace('"', "\"\""))
    } else {
        name.to_owned()
    }
}

/// The shortest text that reads back to the same bits.
fn number(value: f64) -> String {
    format!("{value:?}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_notes_are_columns() {
        let mut rows = Rows::start(0, 2.0, 2.0, 0.0);
        let step = |cost: f64, accepted: bool| Step {
            cost,
            step_norm: 1e-300,
            accepted,
            stop: None,
            metrics: vec![("damping", cost / 3.0), ("active, \"all\"", f64::NAN)],
        };
        rows.push(1, &step(1.0, true), 1.0, 0.5);
        rows.push(2, &step(1.5, false), 1.0, 0.75);
        let mut text = Vec::new();
        rows.write_csv(&mut text).unwrap();
        assert_eq!(
            String::from_utf8(text).unwrap(),
            "iteration,cost,best_cost,step_norm,accepted,seconds,damping,\"active, \"\"all\"\"\"\n\
             0,2.0,2.0,,,0.000000,,\n\
             1,1.0,1.0,1e-300,1,0.500000,0.3333333333333333,NaN\n\
             2,1.5,1.0,1e-300,0,0.750000,0.5,NaN\n"
        );
    }
}
