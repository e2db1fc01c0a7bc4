//! Every level of an axis against one of them, its baseline, within a result.
//!
//! Runs are paired by the other axes and the seed, which decides the same field or block at every level.
//! The tests and their correction are those of [`compare`](crate::compare): paired Student tests of the mean
//! difference, all probabilities of a result corrected together by Holm's step-down.

use crate::{
    compare::{Comparison, holm, judge},
    data::Frame,
    fail::Fail,
    keys,
};
use rowgram::io::output;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, path::Path};

/// The level of the tests.
const LEVEL: f64 = 0.05;

/// What the levels of an axis are compared with.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Baseline {
    /// The axis.
    pub(crate) axis: String,
    /// Its level that the others are compared with.
    pub(crate) label: String,
    /// The metrics that are tested; none tests all that are kept.
    #[serde(default)]
    pub(crate) metrics: Vec<String>,
}

/// One level against the baseline, in one setting of the other axes.
#[derive(Debug)]
pub(crate) struct Contrast {
    /// The labels of the other axes, in the order of the columns.
    at: Vec<String>,
    /// The level.
    label: String,
    comparison: Comparison,
}

impl Baseline {
    /// Refuses an axis, a level and metrics that there are not.
    pub(crate) fn check(
        &self,
        levels: &[(&str, Vec<String>)],
        kept: &[&str],
    ) -> Result<(), String> {
        let place = |e: String| format!("baseline: {e}");
        let Some((_, labels)) = levels.iter().find(|(axis, _)| *axis == self.axis) else {
            let axes = levels.iter().map(|(axis, _)| *axis);
            return Err(place(keys::unknown("axis", &self.axis, axes)));
        };
        if !labels.contains(&self.label) {
            let labels = labels.iter().map(String::as_str);
            return Err(place(keys::unknown("level", &self.label, labels)));
        }
        match self.metrics.iter().find(|metric| !kept.contains(&metric.as_str())) {
            Some(metric) => Err(place(keys::unknown("metric", metric, kept.iter().copied()))),
            None => Ok(()),
        }
    }

    /// All comparisons of a result; `axes` are its columns of axes.
    pub(crate) fn contrasts(&self, runs: &Frame, axes: &[&str]) -> Result<Vec<Contrast>, String> {
        let others = axes.iter().filter(|axis| **axis != self.axis);
        let others = others.map(|axis| runs.column(axis)).collect::<Result<Vec<_>, _>>()?;
        let (axis, seed) = (runs.column(&self.axis)?, runs.column("seed")?);
        let metrics = if self.metrics.is_empty() {
            runs.header[runs.column("reason")? + 1..].to_vec()
        } else {
            self.metrics.clone()
        };
        let labels = runs.labels(&self.axis)?;
        // Settings in the order in which they appear.
        let mut settings: Vec<Vec<String>> = Vec::new();
        let mut rows: BTreeMap<(Vec<String>, &str, &str), &Vec<String>> = BTreeMap::new();
        for row in &runs.rows {
            let at: Vec<String> = others.iter().map(|&c| row[c].clone()).collect();
            if !settings.contains(&at) {
                settings.push(at.clone());
            }
            rows.insert((at, row[axis].as_str(), row[seed].as_str()), row);
        }
        let seeds = runs.labels("seed")?;
        let mut found = Vec::new();
        for metric in &metrics {
            let column = runs.column(metric)?;
            for at in &settings {
                for label in labels.iter().filter(|label| **label != self.label) {
                    let value = |label: &str, seed: &str| -> Option<f64> {
                        rows.get(&(at.clone(), label, seed))?[column].parse().ok()
                    };
                    let pairs: Vec<[f64; 2]> = seeds
                        .iter()
                        .filter_map(|seed| Some([value(&self.label, seed)?, value(label, seed)?]))
                        .collect();
                    if pairs.is_empty() {
                        continue;
                    }
                    let comparison = judge(String::new(), metric.clone(), &pairs);
                    found.push(Contrast { at: at.clone(), label: label.clone(), comparison });
                }
            }
        }
        holm(found.iter_mut().map(|contrast| &mut contrast.comparison));
        Ok(found)
    }

    /// Writes `tests.csv` of a result, one row for each comparison.
    pub(crate) fn write(&self, found: &[Contrast], axes: &[&str], path: &Path) -> Result<(), Fail> {
        output::write(path, true, |out| {
            let mut writer = csv::Writer::from_writer(out);
            let mut header: Vec<&str> =
                axes.iter().copied().filter(|axis| *axis != self.axis).collect();
            header.extend([self.axis.as_str(), "baseline", "metric", "pairs", "mean_baseline"]);
            header.extend(["mean", "difference", "half_interval", "effect_size", "probability"]);
            writer.write_record(&header)?;
            for Contrast { at, label, comparison: c } in found {
                let mut row = at.clone();
                row.extend([label, &self.label, &c.metric].map(Clone::clone));
                row.push(c.pairs.to_string());
                let numbers =
                    [c.mean_a, c.mean_b, c.mean_b - c.mean_a, c.half, c.effect, c.probability];
                row.extend(
                    numbers.map(|x| if x.is_nan() { String::new() } else { format!("{x:.5e}") }),
                );
                writer.write_record(&row)?;
            }
            writer.flush()
        })?;
        Ok(())
    }

    /// How many of them are beyond chance, in a sentence.
    pub(crate) fn sentence(&self, found: &[Contrast]) -> String {
        let tested = found.iter().filter(|c| c.comparison.pairs > 1).count();
        let differ = found.iter().filter(|c| c.comparison.probability < LEVEL).count();
        if tested == 0 {
            return String::new();
        }
        let metrics = match self.metrics.as_slice() {
            [] => String::new(),
            metrics => format!(" in {}", metrics.join(", ")),
        };
        format!(
            "Against {} = {}{metrics}: {differ} of {tested} paired differences are beyond chance (t tests corrected \
             by Holm, level {LEVEL}).",
            self.axis, self.label
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runs() -> Frame {
        let text = |line: &str| line.split(',').map(str::to_owned).collect::<Vec<_>>();
        Frame {
            header: text("cell,stage,method,seed,status,reason,f1"),
            rows: [
                "0,mid,a,1,ok,,0.1",
                "0,mid,a,2,ok,,0.5",
                "0,mid,a,3,ok,,0.9",
                "0,mid,a,4,ok,,0.3",
                "1,mid,b,1,ok,,0.21",
                "1,mid,b,2,ok,,0.6",
                "1,mid,b,3,ok,,0.99",
                "1,mid,b,4,failed,x,",
                "2,late,a,1,ok,,0.4",
                "2,late,a,2,ok,,0.2",
                "3,late,b,1,ok,,0.1",
                "3,late,b,2,ok,,0.7",
            ]
            .map(text)
            .to_vec(),
        }
    }

    #[test]
    fn levels_are_paired_by_seed_within_their_setting() {
        let baseline =
            Baseline { axis: "method".to_owned(), label: "a".to_owned(), metrics: Vec::new() };
        let found = baseline.contrasts(&runs(), &["stage", "method"]).unwrap();
        assert_eq!(found.len(), 2);
        let (mid, late) = (&found[0], &found[1]);
        // Differences 0.11, 0.10, 0.09 of the three seeds that both have: t = 17.32, 2 degrees of freedom, p = 0.003317.
        assert_eq!((mid.at[0].as_str(), mid.label.as_str(), mid.comparison.pairs), ("mid", "b", 3));
        assert!((mid.comparison.probability - 2.0 * 0.003_317).abs() < 1e-5, "{mid:?}");
        assert!((mid.comparison.mean_a - 0.5).abs() < 1e-12);
        assert!(late.comparison.probability > 0.5, "{late:?}");
        assert!(baseline.sentence(&found).contains("1 of 2"));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tests.csv");
        baseline.write(&found, &["stage", "method"], &path).unwrap();
        let text = std::fs::read_to_string(path).unwrap();
        assert!(
            text.starts_with("stage,method,baseline,metric,pairs,mean_baseline,mean,"),
            "{text}"
        );
        assert!(text.contains("\nmid,b,a,f1,3,5.00000e-1,6.00000e-1,1.00000e-1,"), "{text}");
    }

    #[test]
    fn what_there_is_not_is_refused() {
        let levels = [("method", vec!["a".to_owned(), "b".to_owned()])];
        let with = |axis: &str, label: &str, metric: &str| Baseline {
            axis: axis.to_owned(),
            label: label.to_owned(),
            metrics: vec![metric.to_owned()],
        };
        assert!(with("method", "a", "f1").check(&levels, &["f1"]).is_ok());
        for (bad, word) in [
            (with("methd", "a", "f1"), "`methd`"),
            (with("method", "c", "f1"), "`c`"),
            (with("method", "a", "f2"), "`f2`"),
        ] {
            let error = bad.check(&levels, &["f1"]).unwrap_err();
            assert!(error.contains(word), "{error}");
        }
    }
}
