//! The weights of the stand count, from a file that `experiments fit-stand-count` writes.
//!
//! `weights.csv` has a row for each feature: its name, its weight where leaves are narrow, and by how much that changes for leaves `e` times as wide.

use super::{PAIR, PLACE, features::UNCOVERED};
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

impl Weights {
    /// Worth of a plant by hand. With 1.1 for the best set of plants F1 is the same on 128 synthetic masks.
    pub const PLANT: f64 = 0.5;
    /// Worth of the height of its votes by hand; chosen on synthetic fields, before the other weights were fitted.
    const VOTES: f64 = 12.0;

    /// Weights by hand, which find the spacing: the fitted ones are fitted to a spacing that is known, and say nothing of which it is. The density of gaps
    /// counts as it is; votes that two plants close together claim both, and leaf mass that none covers, are taken off.
    pub fn by_hand() -> Weights {
        let mut weights = Weights::default();
        weights.places[..2].copy_from_slice(&[Weights::PLANT, Weights::VOTES]);
        weights.pairs[..2].copy_from_slice(&[1.0, -Weights::VOTES]);
        weights.pairs[UNCOVERED] = -1.0;
        weights
    }
}

/// Weights by the width of leaves.
#[derive(Debug, Clone, PartialEq)]
pub struct LeafWeights {
    /// Where leaves are as narrow as on a drawn mask.
    pub narrow: Weights,
    /// By how much the weights change per unit of [`LeafWeights::log_width`].
    pub change: Weights,
}

impl LeafWeights {
    /// Widths of leaves between which weights change, in pixels of the reduced grid. First choices, others were not compared: of the 160 drawn masks of
    /// the fit (`experiments fit-stand-count`) half have leaves of 3.5 px and less, the widest 5.1; of the maps of its twelve flights 5.3 to 8.9.
    const WIDTHS: [f64; 2] = [3.6, 8.5];

    /// The logarithm of the width of leaves (pixels of the reduced grid) over that of narrow ones, within what the fit has seen.
    pub fn log_width(leaf_width: f64) -> f64 {
        let [narrow, wide] = LeafWeights::WIDTHS;
        (leaf_width.clamp(narrow, wide) / narrow).ln()
    }

    /// The weights for leaves of this width, in pixels of the reduced grid.
    pub fn at(&self, leaf_width: f64) -> Weights {
        let by = LeafWeights::log_width(leaf_width);
        let LeafWeights { narrow, change } = self;
        Weights {
            places: std::array::from_fn(|k| narrow.places[k] + by * change.places[k]),
            pairs: std::array::from_fn(|k| narrow.pairs[k] + by * change.pairs[k]),
        }
    }
}

static FITTED: LazyLock<Result<LeafWeights, String>> =
    LazyLock::new(|| parse(include_str!("weights.csv")));

/// The weights.
///
/// # Errors
/// A file of weights that does not have the features: what was expected.
pub(super) fn fitted() -> Result<&'static LeafWeights, String> {
    FITTED.as_ref().map_err(Clone::clone)
}

fn parse(text: &str) -> Result<LeafWeights, String> {
    let names = PLACE_FEATURES.iter().chain(&PAIR_FEATURES);
    let lines: Vec<&str> = text.lines().skip(1).collect();
    if lines.len() != PLACE + PAIR {
        return Err(format!(
            "weights of the stand count: {} rows, expected {}",
            lines.len(),
            PLACE + PAIR
        ));
    }
    let mut weights = [[0.0; PLACE + PAIR]; 2];
    for (k, (line, name)) in lines.iter().zip(names).enumerate() {
        let refuse =
            || format!("weights of the stand count: {line:?}, expected {name:?} and two numbers");
        let cells: Vec<&str> = line.split(',').collect();
        let [feature, narrow, change] = cells[..] else { return Err(refuse()) };
        if feature != *name {
            return Err(refuse());
        }
        for (column, cell) in weights.iter_mut().zip([narrow, change]) {
            column[k] = cell.parse().map_err(|_| refuse())?;
        }
    }
    let [narrow, change] = weights.map(|weights| Weights {
        places: std::array::from_fn(|k| weights[k]),
        pairs: std::array::from_fn(|k| weights[PLACE + k]),
    });
    Ok(LeafWeights { narrow, change })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_has_a_weight_for_every_feature() {
        let fitted = fitted().unwrap();
        for Weights { places, pairs } in [&fitted.narrow, &fitted.change] {
            assert!(places.iter().chain(pairs).all(|&weight| weight != 0.0));
        }
        assert_eq!(fitted.at(2.0), fitted.narrow);
        let wide = fitted.at(3.6 * 1.0_f64.exp());
        assert_eq!(wide, fitted.at(8.5), "no change beyond what the fields showed");
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
