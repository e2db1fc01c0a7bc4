//! The weights of the stand count, from a file that `experiments fit-stand-count` writes.
//!
//! `weights.csv` has a row for each feature: its name, its weight where the spacing is estimated (`of_spacing`), and its
//! weight where plants are counted (`of_count`).

use super::{PAIR, PLACE};
use std::sync::LazyLock;

/// The features of a place, in their order.
pub const PLACE_FEATURES: [&str; PLACE] = [
    "one",
    "height",
    "height squared",
    "height over half a spacing",
    "peak over 2 px",
    "peak over 4 px",
    "mean height over 1 px",
    "mean height over 3 px",
    "leaf mass",
    "spacing",
    "contrast",
    "spacing x height",
    "contrast x height",
    "cover",
    "cover x height",
    "contrast x height over half a spacing",
    "share missing",
    "spacing jitter",
    "share missing x height",
    "spacing jitter x height",
    "spacing squared",
    "leaf outside rows",
    "leaf outside rows x height",
    "fewer leaves around",
    "more leaves around",
    "spacing x fewer leaves around",
    "spacing x more leaves around",
];
/// The features of two neighbours, in their order.
pub const PAIR_FEATURES: [&str; PAIR] = [
    "log density of the gap",
    "votes claimed within 2 px",
    "votes claimed within a third of a spacing",
    "leaf mass uncovered",
    "depth of the valley of a close pair",
    "depth of the valley of a middling pair",
    "share of doubles",
    "share of doubles x height",
    "closeness",
    "more leaves around a pair within 2 px",
    "share of doubles x more leaves around",
];

/// Weights of the features.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    /// Of those of a place.
    pub places: [f64; PLACE],
    /// Of those of two neighbours.
    pub pairs: [f64; PAIR],
}

impl Default for Weights {
    fn default() -> Weights {
        Weights { places: [0.0; PLACE], pairs: [0.0; PAIR] }
    }
}

/// Both sets of weights.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fitted {
    /// Fitted to fields whose spacing is known exactly: these estimate the spacing.
    pub(super) of_spacing: Weights,
    /// Fitted to the same fields with the spacings that `of_spacing` finds: these count.
    pub(super) of_count: Weights,
}

static FITTED: LazyLock<Result<Fitted, String>> =
    LazyLock::new(|| parse(include_str!("weights.csv")));

/// The weights.
///
/// # Errors
/// A file of weights that does not have the features: what was expected.
pub(super) fn fitted() -> Result<&'static Fitted, String> {
    FITTED.as_ref().map_err(Clone::clone)
}

fn parse(text: &str) -> Result<Fitted, String> {
    let names = PLACE_FEATURES.iter().chain(&PAIR_FEATURES);
    let lines: Vec<&str> = text.lines().skip(1).collect();
    if lines.len() != PLACE + PAIR {
        return Err(format!(
            "weights of the stand count: {} rows, expected {}",
            lines.len(),
            PLACE + PAIR
        ));
    }
    let mut columns = [[0.0; PLACE + PAIR]; 2];
    for (k, (line, name)) in lines.iter().zip(names).enumerate() {
        let cells: Vec<&str> = line.split(',').collect();
        let refuse =
            || format!("weights of the stand count: {line:?}, expected {name:?} and two numbers");
        let [feature, of_spacing, of_count] = cells[..] else { return Err(refuse()) };
        if feature != *name {
            return Err(refuse());
        }
        for (column, cell) in columns.iter_mut().zip([of_spacing, of_count]) {
            column[k] = cell.parse().map_err(|_| refuse())?;
        }
    }
    let [of_spacing, of_count] = columns.map(|all| Weights {
        places: std::array::from_fn(|k| all[k]),
        pairs: std::array::from_fn(|k| all[PLACE + k]),
    });
    Ok(Fitted { of_spacing, of_count })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_has_a_weight_for_every_feature() {
        let fitted = fitted().unwrap();
        assert_eq!(fitted.of_count.pairs.len() + fitted.of_count.places.len(), 38);
        assert!(fitted.of_spacing != fitted.of_count);
        let text = include_str!("weights.csv");
        for wrong in [
            text.replacen("cover,", "covers,", 1),
            text.replacen("one,", "one,x", 1),
            text.lines().take(30).map(|line| format!("{line}\n")).collect(),
        ] {
            assert!(parse(&wrong).unwrap_err().contains("weights of the stand count"));
        }
    }
}
