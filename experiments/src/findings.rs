//! Findings: sentences whose numbers come from the tables, and claims that the tables must bear out.
//!
//! In a sentence, `{mean f1_5cm @ method=k-means, stage=mid}` is a number from the runs that have these
//! labels (a label may have commas). `mean`, `median`, `min`, `max`, `ci` (mean with half its 95 % interval), `sum` take a metric;
//! `best AXIS by METRIC` and `worst AXIS by METRIC` give the label with the highest or lowest mean. From a
//! sensitivity design, `first FACTOR of METRIC` and `total FACTOR of METRIC` are indices, `foremost of METRIC` is the
//! factor with the greatest total index, `foremost of METRIC without FACTOR` that among the others. A
//! claim puts two numbers in relation: `mean f1_5cm @ method=k-means < 0.9`, either side with a
//! factor in front (`2 * mean ...`).

use crate::{
    data::{Conditions, Frame, Summary, quantile},
    keys, sensitivity,
};
use serde::{Deserialize, Serialize};

/// What an experiment found.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Finding {
    /// Two sentences with places for numbers.
    pub(crate) text: String,
    /// What has to hold for the sentences to be true.
    #[serde(default)]
    pub(crate) claims: Vec<String>,
}

/// A number that is asked for.
#[derive(Debug, PartialEq)]
struct Query<'a> {
    how: &'a str,
    /// The axis of `best` and `worst`, the factor of a sensitivity index.
    axis: &'a str,
    metric: &'a str,
    conditions: Conditions,
}

impl Finding {
    /// Refuses axes and metrics that there are not.
    pub(crate) fn check(&self, axes: &[&str], metrics: &[&str]) -> Result<(), String> {
        let place = |e: String| format!("finding: {e}");
        let check = |query: &Query<'_>| {
            let axis = Some(query.axis).filter(|axis| !axis.is_empty());
            for axis in axis.into_iter().chain(query.conditions.keys().map(String::as_str)) {
                if !axes.contains(&axis) {
                    return Err(keys::unknown("axis", axis, axes.iter().copied()));
                }
            }
            if !metrics.contains(&query.metric) {
                return Err(keys::unknown("metric", query.metric, metrics.iter().copied()));
            }
            Ok(())
        };
        for part in places(&self.text).map_err(place)? {
            check(&query(part).map_err(place)?).map_err(place)?;
        }
        for claim in &self.claims {
            let (left, _, right) = sides(claim).map_err(place)?;
            for side in [left, right] {
                let (_, rest) = factor(side);
                if rest.parse::<f64>().is_err() {
                    check(&query(rest).map_err(place)?).map_err(place)?;
                }
            }
        }
        Ok(())
    }

    /// The sentences with their numbers.
    pub(crate) fn fill(&self, runs: &Frame) -> Result<String, String> {
        let mut text = self.text.trim().to_owned();
        for part in places(&self.text)? {
            let shown = show(&query(part)?, runs)?;
            text = text.replacen(&format!("{{{part}}}"), &shown, 1);
        }
        Ok(text)
    }

    /// The claims that do not hold, with the numbers.
    pub(crate) fn refuted(&self, runs: &Frame) -> Result<Vec<String>, String> {
        let mut refuted = Vec::new();
        for claim in &self.claims {
            let (left, relation, right) = sides(claim)?;
            let (a, b) = (side(left, runs)?, side(right, runs)?);
            let holds = if relation == '<' { a < b } else { a > b };
            if !holds {
                refuted.push(format!("{claim}: {a:.4} against {b:.4}"));
            }
        }
        Ok(refuted)
    }
}

/// What stands between braces.
fn places(text: &str) -> Result<Vec<&str>, String> {
    let mut found = Vec::new();
    let mut rest = text;
    while let Some((_, after)) = rest.split_once('{') {
        let (part, end) = after.split_once('}').ok_or("a brace is not closed")?;
        found.push(part);
        rest = end;
    }
    Ok(found)
}

fn sides(claim: &str) -> Result<(&str, char, &str), String> {
    for relation in [" < ", " > "] {
        if let Some((left, right)) = claim.split_once(relation) {
            return Ok((left.trim(), if relation == " < " { '<' } else { '>' }, right.trim()));
        }
    }
    Err(format!("{claim:?}: expected two numbers with < or > between them"))
}

fn factor(side: &str) -> (f64, &str) {
    side.split_once(" * ")
        .and_then(|(number, rest)| Some((number.trim().parse().ok()?, rest.trim())))
        .unwrap_or((1.0, side))
}

fn side(text: &str, runs: &Frame) -> Result<f64, String> {
    if let Ok(number) = text.parse() {
        return Ok(number);
    }
    let (times, rest) = factor(text);
    Ok(times * number(&query(rest)?, runs)?)
}

fn query(text: &str) -> Result<Query<'_>, String> {
    let (head, conditions) = text.split_once(" @ ").unwrap_or((text, ""));
    let words: Vec<&str> = head.split_whitespace().collect();
    let (how, axis, metric) = match words[..] {
        [how @ ("mean" | "median" | "min" | "max" | "ci" | "sum"), metric] => (how, "", metric),
        [how @ ("best" | "worst"), axis, "by", metric] => (how, axis, metric),
        [how @ ("first" | "total"), factor, "of", metric] => (how, factor, metric),
        [how @ "foremost", "of", metric] => (how, "", metric),
        [how @ "foremost", "of", metric, "without", factor] => (how, factor, metric),
        _ => {
            return Err(format!(
                "{text:?}: expected mean, median, min, max, ci or sum with a metric, best or worst AXIS by \
                 METRIC, first or total FACTOR of METRIC, or foremost of METRIC"
            ));
        }
    };
    let mut found = Conditions::new();
    let mut last = String::new();
    for part in conditions.split(", ").filter(|part| !part.is_empty()) {
        match (part.split_once('='), found.get_mut(&last)) {
            (Some((name, label)), _) => {
                last = name.trim().to_owned();
                found.insert(last.clone(), label.trim().to_owned());
            }
            // A label with a comma in it.
            (None, Some(label)) => *label += &format!(", {}", part.trim()),
            (None, None) => return Err(format!("{part:?}: expected AXIS=LABEL")),
        }
    }
    Ok(Query { how, axis, metric, conditions: found })
}

fn number(query: &Query<'_>, runs: &Frame) -> Result<f64, String> {
    if let how @ ("first" | "total") = query.how {
        return sensitivity::one(runs, query.metric, query.axis, how == "total");
    }
    let mut values = runs.at(&query.conditions)?.numbers(query.metric)?;
    values.sort_by(f64::total_cmp);
    let summary = Summary::of(&values)
        .ok_or_else(|| format!("{} has no value where {:?}", query.metric, query.conditions))?;
    match query.how {
        "mean" | "ci" => Ok(summary.mean),
        "median" => Ok(quantile(&values, 0.5)),
        "min" => Ok(values[0]),
        "max" => Ok(values[values.len() - 1]),
        "sum" => Ok(values.iter().sum()),
        how => Err(format!("{how} gives a label, not a number")),
    }
}

fn show(query: &Query<'_>, runs: &Frame) -> Result<String, String> {
    match query.how {
        "best" | "worst" => {
            let runs = runs.at(&query.conditions)?;
            let mut means = Vec::new();
            for label in runs.labels(query.axis)? {
                let values = runs.with(query.axis, &label)?.numbers(query.metric)?;
                if let Some(summary) = Summary::of(&values) {
                    means.push((summary.mean, label));
                }
            }
            let sign = if query.how == "best" { 1.0 } else { -1.0 };
            means
                .into_iter()
                .reduce(|a, b| if sign * b.0 > sign * a.0 { b } else { a })
                .map(|(_, label)| label)
                .ok_or_else(|| format!("{} has no value", query.metric))
        }
        "foremost" => sensitivity::foremost(runs, query.metric, query.axis),
        "ci" => {
            let values = runs.at(&query.conditions)?.numbers(query.metric)?;
            let summary = Summary::of(&values).ok_or("there is no value")?;
            Ok(format!("{} ± {}", short(summary.mean), short(summary.half)))
        }
        _ => number(query, runs).map(short),
    }
}

/// Three significant digits.
fn short(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let size = value.abs().log10().floor();
    if (-4.0..6.0).contains(&size) {
        let digits = (2.0 - size).max(0.0) as usize;
        format!("{value:.digits$}")
    } else {
        format!("{value:.2e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runs() -> Frame {
        let text = |cells: &[&str]| cells.iter().map(|&c| c.to_owned()).collect::<Vec<_>>();
        Frame {
            header: text(&["method", "seed", "f1"]),
            rows: vec![
                text(&["a", "1", "0.5"]),
                text(&["a", "2", "0.7"]),
                text(&["b", "1", "0.9"]),
                text(&["b", "2", "0.8"]),
                text(&["c, d", "1", "0.1"]),
            ],
        }
    }

    #[test]
    fn sentences_are_filled_and_claims_are_checked() {
        let finding = Finding {
            text: "{best method by f1} reaches {mean f1 @ method=b}, a only {ci f1 @ method=a}, the last {mean f1 @ method=c, d, seed=1}."
                .to_owned(),
            claims: vec![
                "mean f1 @ method=a < mean f1 @ method=b".to_owned(),
                "min f1 @ method=a > 0.6".to_owned(),
                "1.5 * mean f1 @ method=a > 0.89".to_owned(),
            ],
        };
        finding.check(&["method", "seed"], &["f1"]).unwrap();
        assert_eq!(
            finding.fill(&runs()).unwrap(),
            "b reaches 0.850, a only 0.600 ± 1.27, the last 0.100."
        );
        let refuted = finding.refuted(&runs()).unwrap();
        assert_eq!(refuted, ["min f1 @ method=a > 0.6: 0.5000 against 0.6000"]);
    }

    #[test]
    fn what_cannot_be_asked_is_refused() {
        for text in ["{mean}", "{mean f2}", "{best method f1}", "{mean f1 @ methd=a}", "{mean f1"] {
            let finding = Finding { text: text.to_owned(), claims: Vec::new() };
            assert!(finding.check(&["method"], &["f1"]).is_err(), "{text}");
        }
        let finding = Finding { text: String::new(), claims: vec!["mean f1 = 2".to_owned()] };
        assert!(finding.check(&["method"], &["f1"]).is_err());
    }
}
