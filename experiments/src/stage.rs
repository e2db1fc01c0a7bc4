//! What can be put under test: a stage has typed parameters with defaults, the metrics that one run of
//! it measures, and nothing to do with sweeps, files or figures.
//!
//! A new stage is one file in `stages/` and one line in [`STAGES`].

use crate::{keys, stages};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::collections::BTreeMap;
use toml::Table;

/// A number that a stage measures.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Metric {
    /// Its column, with its unit.
    pub(crate) name: &'static str,
    /// What it is, in words.
    pub(crate) about: &'static str,
}

/// Shorthand for the tables of metrics.
pub(crate) const fn metric(name: &'static str, about: &'static str) -> Metric {
    Metric { name, about }
}

/// A series of numbers that belongs to one run: how a cost fell, where residuals are.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Trace {
    /// Names the table it goes to.
    pub(crate) name: String,
    /// The columns.
    pub(crate) columns: Vec<String>,
    /// The rows.
    pub(crate) rows: Vec<Vec<f64>>,
}

impl Trace {
    /// An empty trace.
    pub(crate) fn new(name: &str, columns: &[&str]) -> Trace {
        let columns = columns.iter().map(|&column| column.to_owned()).collect();
        Trace { name: name.to_owned(), columns, rows: Vec::new() }
    }
}

/// What one run measured.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct Measured {
    /// Metrics by name; one that does not apply is left out.
    pub(crate) values: BTreeMap<String, f64>,
    /// Seconds of parts of the run, by name.
    pub(crate) seconds: BTreeMap<String, f64>,
    /// Series.
    pub(crate) traces: Vec<Trace>,
}

impl Measured {
    /// Notes a metric; what is not finite is left out.
    pub(crate) fn put(&mut self, name: &'static str, value: f64) {
        if value.is_finite() {
            self.values.insert(name.to_owned(), value);
        }
    }

    /// Notes a metric where there is one.
    pub(crate) fn put_some(&mut self, name: &'static str, value: Option<f64>) {
        if let Some(value) = value {
            self.put(name, value);
        }
    }
}

/// Something under test.
pub(crate) trait Stage {
    /// Everything that can be varied. No options: a value that is not there has no path.
    type Parameters: Serialize + DeserializeOwned + Default;
    /// The word for it in specs.
    const NAME: &'static str;
    /// What it does, in a sentence.
    const ABOUT: &'static str;
    /// What it measures.
    const METRICS: &'static [Metric];
    /// Paths that the seed of a run decides, and nobody else.
    const SEEDED: &'static [&'static str] = &[];

    /// Refuses parameters that cannot be used, before any work.
    fn check(parameters: &Self::Parameters) -> Result<(), String>;

    /// One run.
    fn run(parameters: &Self::Parameters, seed: u64) -> Result<Measured, String>;
}

/// A stage as the runner sees it.
pub(crate) struct Entry {
    pub(crate) name: &'static str,
    pub(crate) about: &'static str,
    pub(crate) metrics: &'static [Metric],
    /// The defaults, by path.
    pub(crate) defaults: fn() -> Result<Table, String>,
    /// Checks a full table of parameters.
    pub(crate) check: fn(&Table) -> Result<(), String>,
    /// Runs with a full table of parameters.
    pub(crate) run: fn(&Table, u64) -> Result<Measured, String>,
}

const fn entry<S: Stage>() -> Entry {
    Entry {
        name: S::NAME,
        about: S::ABOUT,
        metrics: S::METRICS,
        defaults: defaults::<S>,
        check: |table| S::check(&parse::<S>(table)?),
        run: |table, seed| S::run(&parse::<S>(table)?, seed),
    }
}

fn defaults<S: Stage>() -> Result<Table, String> {
    let mut table = Table::try_from(S::Parameters::default()).map_err(|e| e.to_string())?;
    for path in S::SEEDED {
        keys::remove(&mut table, path);
    }
    Ok(table)
}

/// What the seed decides is not in `table` and comes from the defaults.
fn parse<S: Stage>(table: &Table) -> Result<S::Parameters, String> {
    let mut full = Table::try_from(S::Parameters::default()).map_err(|e| e.to_string())?;
    keys::merge(&mut full, table);
    full.try_into().map_err(|e: toml::de::Error| keys::with_nearest(e.message()))
}

/// Every stage there is.
pub(crate) const STAGES: &[Entry] = &[
    entry::<stages::locate::Locate>(),
    entry::<stages::cost_map::CostMap>(),
    entry::<stages::segment::Segment>(),
    entry::<stages::orthomosaic::Orthomosaic>(),
    entry::<stages::adjust::Adjust>(),
    entry::<stages::bundle::BundleBlock>(),
    entry::<stages::chain::Chain>(),
    entry::<stages::arena::Arena>(),
    entry::<stages::solvers::Solvers>(),
    entry::<stages::lens::LensFit>(),
    entry::<stages::leaves::LeafSlices>(),
    entry::<stages::two_view::TwoView>(),
];

/// The stage of this name.
pub(crate) fn find(name: &str) -> Result<&'static Entry, String> {
    STAGES
        .iter()
        .find(|stage| stage.name == name)
        .ok_or_else(|| keys::unknown("stage", name, STAGES.iter().map(|stage| stage.name)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_of_every_stage_are_valid_and_come_back() {
        for stage in STAGES {
            let table = (stage.defaults)().unwrap();
            (stage.check)(&table).unwrap_or_else(|e| panic!("{}: {e}", stage.name));
            let again: Table = toml::to_string(&table).unwrap().parse().unwrap();
            assert_eq!(table, again, "{}", stage.name);
            assert!(!stage.metrics.is_empty() && !stage.about.is_empty());
        }
        assert!(find("locat").err().unwrap().contains("did you mean `locate`"));
    }
}
