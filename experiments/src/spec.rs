//! What an experiment is: a stage, its base parameters, what is varied, seeds, metrics, figures, tables,
//! and the finding that its numbers are to bear out.
//!
//! Axes multiply: a grid is several axes, a list is one axis of labelled levels, and a random sweep is an
//! axis of drawn settings, as is a sensitivity design. `[small]` shrinks an experiment to what a laptop does in a minute; the rest of
//! the file is the setting for a paper.

use crate::{
    contrasts::Baseline,
    fail::Fail,
    figures::{Figure, Look},
    findings::Finding,
    keys,
    sensitivity::Sensitivity,
    stage::{self, Entry},
    streams::{Stream, stream},
    tables::TableSpec,
};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeSet, path::Path};
use toml::{Table, Value};

/// Most tasks of one experiment.
const MAX_TASKS: usize = 1_000_000;

/// An experiment as its file has it.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Spec {
    /// Names files and folders: small letters, digits, hyphens.
    pub(crate) name: String,
    /// A line for people.
    pub(crate) title: String,
    /// What is under test.
    pub(crate) stage: String,
    /// Parameters that differ from the stage's defaults.
    #[serde(default)]
    pub(crate) base: Table,
    /// The seeds.
    pub(crate) seeds: Seeds,
    /// What is varied.
    #[serde(default, rename = "axis", skip_serializing_if = "Vec::is_empty")]
    pub(crate) axes: Vec<Axis>,
    /// What is drawn at random.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) random: Option<Random>,
    /// Which inputs' shares of the variance are asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) sensitivity: Option<Sensitivity>,
    /// The metrics to keep, in the order of their columns; none keeps all.
    #[serde(default)]
    pub(crate) metrics: Vec<String>,
    /// How it is made small.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) small: Option<Small>,
    /// What the levels of an axis are tested against.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) baseline: Option<Baseline>,
    /// What is drawn.
    #[serde(default, rename = "figure", skip_serializing_if = "Vec::is_empty")]
    pub(crate) figures: Vec<Figure>,
    /// What is tabulated.
    #[serde(default, rename = "table", skip_serializing_if = "Vec::is_empty")]
    pub(crate) tables: Vec<TableSpec>,
    /// What comes out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) finding: Option<Finding>,
}

/// Consecutive seeds.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Seeds {
    #[serde(default = "one")]
    pub(crate) first: u64,
    pub(crate) count: u64,
}

fn one() -> u64 {
    1
}

/// Either one key with its values, or labelled levels that set several keys each.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Axis {
    /// Its column; the key where nothing is said.
    #[serde(default)]
    pub(crate) name: String,
    #[serde(default)]
    pub(crate) key: String,
    #[serde(default)]
    pub(crate) values: Vec<Value>,
    #[serde(default, rename = "level")]
    pub(crate) levels: Vec<Level>,
}

/// A labelled setting of some keys.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Level {
    pub(crate) label: String,
    #[serde(default)]
    pub(crate) set: Table,
}

/// Settings drawn at random, all from the stream of `seed`.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Random {
    pub(crate) count: usize,
    pub(crate) seed: u64,
    #[serde(rename = "draw")]
    pub(crate) draws: Vec<Draw>,
}

/// How the value of one key is drawn: in exactly one of these ways.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Draw {
    pub(crate) key: String,
    /// In a sensitivity design, the factor that it belongs to; the key where nothing is said.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    factor: String,
    /// Uniform between two ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) uniform: Option<[f64; 2]>,
    /// Uniform in the logarithm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) log_uniform: Option<[f64; 2]>,
    /// A whole number, both ends among them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) integer: Option<[i64; 2]>,
    /// One of several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) choice: Option<Vec<Value>>,
}

/// What changes where an experiment is made small.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Small {
    #[serde(default)]
    pub(crate) seeds: Option<u64>,
    #[serde(default)]
    pub(crate) base: Table,
    /// Axes that take the place of those of the same name.
    #[serde(default, rename = "axis")]
    pub(crate) axes: Vec<Axis>,
    /// Draws of the random sweep.
    #[serde(default)]
    pub(crate) random: Option<usize>,
    /// Samples of the sensitivity design.
    #[serde(default)]
    pub(crate) samples: Option<usize>,
}

/// One setting: where it is on every axis, and all parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Cell {
    /// Column and label, axis by axis.
    pub(crate) at: Vec<(String, String)>,
    /// Every parameter.
    pub(crate) parameters: Table,
}

impl Spec {
    /// Reads a spec and checks all of it: every key, every cell, metrics, figures, tables, finding.
    pub(crate) fn read(path: &Path, small: bool) -> Result<(Spec, Vec<Cell>), Fail> {
        let text = std::fs::read_to_string(path).map_err(|e| Fail::Input(named(path, &e)))?;
        let (spec, cells) = Spec::parse(&text, small).map_err(|e| Fail::Input(named(path, &e)))?;
        let stem = path.file_stem().and_then(|stem| stem.to_str());
        if stem != Some(spec.name.as_str()) {
            let message = format!("the name {:?} should be that of the file", spec.name);
            return Err(Fail::Input(named(path, &message)));
        }
        Ok((spec, cells))
    }

    /// As [`Spec::read`], from text.
    pub(crate) fn parse(text: &str, small: bool) -> Result<(Spec, Vec<Cell>), String> {
        let mut spec: Spec =
            toml::from_str(text).map_err(|e| keys::with_nearest(&e.to_string()))?;
        if small {
            spec.shrink()?;
        }
        let entry = stage::find(&spec.stage)?;
        let cells = spec.check(entry)?;
        Ok((spec, cells))
    }

    fn shrink(&mut self) -> Result<(), String> {
        let Some(small) = self.small.clone() else { return Ok(()) };
        self.seeds.count = small.seeds.unwrap_or(self.seeds.count);
        for axis in small.axes {
            let name = axis.column().to_owned();
            let names: Vec<&str> = self.axes.iter().map(Axis::column).collect();
            let place = names.iter().position(|&other| other == name).ok_or_else(|| {
                format!("small: {}", keys::unknown("axis", &name, names.iter().copied()))
            })?;
            self.axes[place] = axis;
        }
        if let (Some(random), Some(count)) = (&mut self.random, small.random) {
            random.count = count;
        }
        if let (Some(sensitivity), Some(samples)) = (&mut self.sensitivity, small.samples) {
            sensitivity.samples = samples;
        }
        keys::merge(&mut self.base, &small.base);
        Ok(())
    }

    fn check(&self, entry: &Entry) -> Result<Vec<Cell>, String> {
        let letters = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        if self.name.is_empty() || !self.name.chars().all(letters) {
            return Err(format!("name = {:?}: expected small letters, digits, hyphens", self.name));
        }
        if self.seeds.count == 0 || self.seeds.first > u64::MAX / 4 {
            return Err("seeds: expected at least one, starting at a number below 2^62".to_owned());
        }
        let metrics: Vec<&str> = entry.metrics.iter().map(|metric| metric.name).collect();
        for name in &self.metrics {
            if !metrics.contains(&name.as_str()) {
                return Err(keys::unknown("metric", name, metrics.iter().copied()));
            }
        }
        let columns = self.columns()?;
        let factors = self.sensitivity.as_ref().map(Sensitivity::factors);
        let named = columns.iter().map(String::as_str).chain(["seed"]);
        let known: Vec<&str> = named.chain(factors.iter().flatten().map(String::as_str)).collect();
        let kept = self.kept(entry);
        self.figures.iter().try_for_each(|figure| figure.check(&known, &kept))?;
        if self.sensitivity.is_none() && self.figures.iter().any(|f| f.look == Look::Sensitivity) {
            return Err("a figure of sensitivity needs [sensitivity]".to_owned());
        }
        self.tables.iter().try_for_each(|table| table.check(&known, &kept))?;
        if let Some(finding) = &self.finding {
            finding.check(&known, &kept)?;
        }
        if let Some(baseline) = &self.baseline {
            let labels = |axis: &Axis| -> Result<Vec<String>, String> {
                Ok(axis.levels()?.into_iter().map(|level| level.label).collect())
            };
            let levels = self.axes.iter().map(|axis| Ok((axis.column(), labels(axis)?)));
            baseline.check(&levels.collect::<Result<Vec<_>, String>>()?, &kept)?;
        }
        self.cells(entry)
    }

    /// The metrics that are kept.
    pub(crate) fn kept<'a>(&'a self, entry: &Entry) -> Vec<&'a str> {
        if self.metrics.is_empty() {
            entry.metrics.iter().map(|metric| metric.name).collect()
        } else {
            self.metrics.iter().map(String::as_str).collect()
        }
    }

    /// The columns of the axes.
    pub(crate) fn columns(&self) -> Result<Vec<String>, String> {
        let mut columns: Vec<String> =
            self.axes.iter().map(|axis| axis.column().to_owned()).collect();
        if let Some(random) = &self.random {
            columns.extend(random.draws.iter().map(|draw| draw.key.clone()));
        }
        if let Some(sensitivity) = &self.sensitivity {
            columns.extend(sensitivity.columns());
        }
        let mut seen = BTreeSet::from(["cell", "seed", "status", "reason"].map(str::to_owned));
        for column in &columns {
            if column.is_empty() || !seen.insert(column.clone()) {
                return Err(format!("axis {column:?}: every axis needs a name of its own"));
            }
        }
        Ok(columns)
    }

    /// Every setting, the last axis fastest.
    fn cells(&self, entry: &Entry) -> Result<Vec<Cell>, String> {
        let mut table = (entry.defaults)()?;
        for (path, value) in keys::flatten(&self.base) {
            keys::set(&mut table, &path, &value).map_err(|e| format!("base: {e}"))?;
        }
        let mut cells = vec![Cell { at: Vec::new(), parameters: table }];
        for axis in &self.axes {
            let levels = axis.levels()?;
            cells = product(&cells, &levels, |cell, level| {
                cell.at.push((axis.column().to_owned(), level.label.clone()));
            })
            .map_err(|e| format!("axis {}: {e}", axis.column()))?;
        }
        let drawn = match (&self.random, &self.sensitivity) {
            (None, None) => None,
            (Some(random), None) => Some(random.levels()?),
            (None, Some(sensitivity)) if self.axes.is_empty() => Some(sensitivity.levels()?),
            _ => return Err("sensitivity goes without axes and [random]".to_owned()),
        };
        if let Some((labels, levels)) = drawn {
            let mut number = 0;
            let count = levels.len().max(1);
            cells = product(&cells, &levels, |cell, _| {
                cell.at.extend(labels[number % count].iter().cloned());
                number += 1;
            })
            .map_err(|e| format!("draws: {e}"))?;
        }
        for cell in &cells {
            let place: Vec<String> = cell.at.iter().map(|(c, l)| format!("{c} = {l}")).collect();
            let place = if place.is_empty() { "base".to_owned() } else { place.join(", ") };
            (entry.check)(&cell.parameters).map_err(|e| format!("{place}: {e}"))?;
        }
        let mut places: Vec<&Vec<(String, String)>> = cells.iter().map(|cell| &cell.at).collect();
        places.sort();
        if let Some(twice) = places.windows(2).find(|pair| pair[0] == pair[1]) {
            return Err(format!("two cells have the same labels: {:?}", twice[0]));
        }
        Ok(cells)
    }
}

impl Axis {
    /// The name of its column.
    pub(crate) fn column(&self) -> &str {
        if self.name.is_empty() { &self.key } else { &self.name }
    }

    fn levels(&self) -> Result<Vec<Level>, String> {
        let levels = match (self.key.is_empty(), self.levels.is_empty()) {
            (false, true) => self.values.iter().map(|value| single(&self.key, value)).collect(),
            (true, false) if self.values.is_empty() => self.levels.clone(),
            _ => {
                return Err(format!(
                    "axis {}: expected either `key` with `values`, or `name` with levels",
                    self.column()
                ));
            }
        };
        if levels.is_empty() {
            return Err(format!("axis {} has no values", self.column()));
        }
        Ok(levels)
    }
}

/// Columns and labels of a cell.
pub(crate) type Labels = Vec<(String, String)>;

impl Random {
    fn levels(&self) -> Result<(Vec<Labels>, Vec<Level>), String> {
        let mut rng = stream(self.seed, Stream::Sweep);
        let (mut labels, mut levels) = (Vec::new(), Vec::new());
        for _ in 0..self.count {
            let mut set = Table::new();
            let mut label = Labels::new();
            if let Some(draw) = self.draws.iter().find(|draw| !draw.factor.is_empty()) {
                return Err(format!("random {}: a factor goes with [sensitivity]", draw.key));
            }
            for draw in &self.draws {
                // One number per key and draw, whatever its kind: changing one leaves the others.
                let unit: f64 = rng.random();
                let value = draw.at(unit).map_err(|e| format!("random {}: {e}", draw.key))?;
                label.push((draw.key.clone(), text(&value)));
                set.insert(draw.key.clone(), value);
            }
            labels.push(label);
            levels.push(Level { label: String::new(), set });
        }
        if levels.is_empty() {
            return Err("random: expected a count of at least 1".to_owned());
        }
        Ok((labels, levels))
    }
}

impl Draw {
    /// The factor that it belongs to.
    pub(crate) fn factor(&self) -> &str {
        if self.factor.is_empty() { &self.key } else { &self.factor }
    }

    /// The value at a share from 0 to 1 of its range.
    pub(crate) fn at(&self, unit: f64) -> Result<Value, String> {
        let ordered = |low: f64, high: f64| {
            let sound = low.is_finite() && high.is_finite() && low <= high;
            if sound { Ok(()) } else { Err(format!("[{low}, {high}] is not an interval")) }
        };
        match (self.uniform, self.log_uniform, self.integer, &self.choice) {
            (Some([low, high]), None, None, None) => {
                ordered(low, high)?;
                Ok(Value::Float(low + (high - low) * unit))
            }
            (None, Some([low, high]), None, None) => {
                ordered(low, high)?;
                if low <= 0.0 {
                    return Err("a log-uniform interval has to be above 0".to_owned());
                }
                Ok(Value::Float((low.ln() + (high.ln() - low.ln()) * unit).exp()))
            }
            (None, None, Some([low, high]), None) => {
                ordered(low as f64, high as f64)?;
                let count = (high - low + 1) as f64;
                Ok(Value::Integer((low + (unit * count) as i64).min(high)))
            }
            (None, None, None, Some(values)) => values
                .get((unit * values.len() as f64) as usize)
                .cloned()
                .ok_or_else(|| "there is nothing to choose from".to_owned()),
            _ => Err("expected one of uniform, log_uniform, integer, choice".to_owned()),
        }
    }
}

/// A level that sets one key.
fn single(key: &str, value: &Value) -> Level {
    Level { label: text(value), set: Table::from_iter([(key.to_owned(), value.clone())]) }
}

/// A value as a label: strings without quotes.
pub(crate) fn text(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

fn product(
    cells: &[Cell],
    levels: &[Level],
    mut label: impl FnMut(&mut Cell, &Level),
) -> Result<Vec<Cell>, String> {
    if cells.len().saturating_mul(levels.len()) > MAX_TASKS {
        return Err(format!("more than {MAX_TASKS} cells"));
    }
    let mut found = Vec::with_capacity(cells.len() * levels.len());
    for cell in cells {
        for level in levels {
            let mut cell = cell.clone();
            for (path, value) in keys::flatten(&level.set) {
                keys::set(&mut cell.parameters, &path, &value)?;
            }
            label(&mut cell, level);
            found.push(cell);
        }
    }
    Ok(found)
}

fn named(path: &Path, error: &impl std::fmt::Display) -> String {
    format!("{}: {error}", path.display())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPEC: &str = "
        name = 'a'\n title = 'A'\n stage = 'locate'\n metrics = ['f1_5cm']\n seeds = { count = 3 }
        [base]\n scenario.field.rows = 2
        [[axis]]\n key = 'scenario.field.spacing_m'\n values = [0.1, 0.2]
        [[axis]]\n name = 'method'
        [[axis.level]]\n label = 'k-means'\n set = { model.prior = 'none', model.update = 'mean' }
        [[axis.level]]\n label = 'rows'
        [random]\n count = 2\n seed = 1
        [[random.draw]]\n key = 'scenario.field.jitter_along'\n uniform = [0.0, 0.3]
        [small]\n seeds = 1\n random = 1\n base = { scenario.field.rows = 1 }
        [[small.axis]]\n key = 'scenario.field.spacing_m'\n values = [0.3]
    ";

    #[test]
    fn axes_multiply_and_the_last_is_fastest() {
        let (spec, cells) = Spec::parse(SPEC, false).unwrap();
        assert_eq!((spec.seeds.count, cells.len()), (3, 8));
        assert_eq!(cells[0].at[1].1, "k-means");
        assert_eq!(cells[2].at[1].1, "rows");
        assert_eq!(cells[4].at[0].1, "0.2");
        assert_eq!(cells[0].at[2], cells[2].at[2], "draws are the same for every other setting");
        assert_ne!(cells[0].at[2], cells[1].at[2]);
        let (small, cells) = Spec::parse(SPEC, true).unwrap();
        assert_eq!((small.seeds.count, cells.len()), (1, 2));
        assert_eq!(cells[0].at[0].1, "0.3");
        assert_eq!(cells[0].parameters["scenario"]["field"]["rows"].as_integer(), Some(1));
    }

    #[test]
    fn mistakes_are_found_before_any_work() {
        for (good, bad, part) in [
            ("'f1_5cm'", "'f1_5'", "did you mean `f1_5cm`"),
            ("field.rows = 2", "field.row = 2", "did you mean `scenario.field.rows`"),
            ("'locate'", "'lokate'", "did you mean `locate`"),
            ("title =", "titel =", "did you mean `title`"),
            ("[0.1, 0.2]", "[0.1, -0.2]", "spacing_m = -0.2"),
            ("[0.1, 0.2]", "[0.1, 'x']", "expected a float"),
            ("[0.1, 0.2]", "[]", "no values"),
            ("[0.1, 0.2]", "[0.1, 0.1]", "same labels"),
            ("prior = 'none'", "prior = 'nothing'", "unknown variant"),
            ("count = 3", "count = 0", "at least one"),
            ("uniform = [0.0, 0.3]", "uniform = [0.3, 0.0]", "not an interval"),
            ("name = 'method'", "name = 'seed'", "name of its own"),
        ] {
            let error = Spec::parse(&SPEC.replacen(good, bad, 1), false).unwrap_err();
            assert!(error.contains(part), "{bad}: {error}");
        }
    }
}
