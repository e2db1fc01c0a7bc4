//! The words in which a locator is asked for: the same in TOML, on the command line and in code.

use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// What is known of a plant's place before the pixels are seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Prior {
    /// Nothing: k-means and k-median.
    None,
    /// It lies near its row: the term across the rows only (the paper's `sigma_{p,i} -> infinity`).
    #[default]
    Rows,
    /// It lies near its row and near its column (the paper's full prior).
    Grid,
}

/// How a plant moves while its pixels are held.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PlantUpdate {
    /// To the minimiser of the sum of squared distances (the paper's closed form).
    Mean,
    /// To the exact minimiser of the stated cost, the sum of distances.
    #[default]
    Median,
}

/// How the rows hold a plant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Form {
    /// By the mean and variance of the other plants of its row (the paper's conditionals; they
    /// come from no joint density).
    Conditional,
    /// By latent lines with parameters of their own, in one objective that every step decreases.
    #[default]
    Joint,
}

rowgram_base::choices!(Prior: None, Rows, Grid);
rowgram_base::choices!(PlantUpdate: Mean, Median);
rowgram_base::choices!(Form: Conditional, Joint);

/// Where the scale `sigma` of the distances comes from.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum SigmaRule {
    /// Re-estimated from the paper's one-dimensional density of the distance: `mean d`.
    #[default]
    Paper,
    /// Re-estimated from the two-dimensional density of the pixel: `mean d / 2`.
    Planar,
    /// Held at this many pixels.
    Fixed(f64),
}

impl rowgram_base::options::Value for SigmaRule {
    fn kind() -> rowgram_base::options::Kind {
        rowgram_base::options::Kind::Text
    }
}

impl SigmaRule {
    /// How often `ln sigma` is counted per pixel: the dimension of the density.
    pub fn dimension(self) -> f64 {
        match self {
            SigmaRule::Paper | SigmaRule::Fixed(_) => 1.0,
            SigmaRule::Planar => 2.0,
        }
    }
}

impl FromStr for SigmaRule {
    type Err = String;

    fn from_str(word: &str) -> Result<SigmaRule, String> {
        let fixed = |px: &str| px.parse().ok().filter(|px: &f64| px.is_finite() && *px > 0.0);
        match (word, word.strip_prefix("fixed:").and_then(fixed)) {
            ("paper", _) => Ok(SigmaRule::Paper),
            ("planar", _) => Ok(SigmaRule::Planar),
            (_, Some(px)) => Ok(SigmaRule::Fixed(px)),
            _ => Err(format!(
                "`paper`, `planar` or `fixed:PX` with a positive number of pixels was expected, got: {word}"
            )),
        }
    }
}

impl TryFrom<String> for SigmaRule {
    type Error = String;

    fn try_from(word: String) -> Result<SigmaRule, String> {
        word.parse()
    }
}

impl fmt::Display for SigmaRule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SigmaRule::Paper => f.write_str("paper"),
            SigmaRule::Planar => f.write_str("planar"),
            SigmaRule::Fixed(px) => write!(f, "fixed:{px}"),
        }
    }
}

impl From<SigmaRule> for String {
    fn from(rule: SigmaRule) -> String {
        rule.to_string()
    }
}

/// The model of a locator.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Model {
    /// What holds the plants.
    pub prior: Prior,
    /// The inner step.
    pub update: PlantUpdate,
    /// The scale of the distances.
    pub sigma: SigmaRule,
    /// How the rows hold the plants.
    pub form: Form,
    /// Pixels of one leaf are not independent: with `v` here the data count as `v` pixels per plant,
    /// `T = min(1, v P / N)` times their full weight. None is the paper, `T = 1`.
    pub tempering: Option<f64>,
    /// Distances are truncated at this many pixels, so that weeds between the rows hold nothing.
    pub truncate_px: Option<f64>,
    /// Floor of the standard deviation about a row or column, in pixels (1 cm where the ground
    /// sampling distance is known).
    pub floor_px: f64,
    /// A plant is visited again when its prior moves its optimum by more than this; pixels.
    pub settle_px: f64,
    /// How far a long step goes, 1 being the optimum for the pixels that the plant has; less than 2.
    pub relaxation: f64,
}

impl Default for Model {
    fn default() -> Model {
        Model {
            prior: Prior::default(),
            update: PlantUpdate::default(),
            sigma: SigmaRule::default(),
            form: Form::default(),
            tempering: None,
            truncate_px: None,
            floor_px: 1.0,
            settle_px: 5e-2,
            relaxation: 1.7,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sigma_rules_are_spelled_the_same_everywhere() {
        for word in ["paper", "planar", "fixed:7.25"] {
            let rule: SigmaRule = word.parse().unwrap();
            assert_eq!(rule.to_string(), word);
            let json = serde_json::to_string(&rule).unwrap();
            assert_eq!(json, format!("\"{word}\""));
            assert_eq!(serde_json::from_str::<SigmaRule>(&json).unwrap(), rule);
        }
        for word in ["", "fixed", "fixed:", "fixed:0", "fixed:-1", "fixed:nan", "fixed:inf", "mean"]
        {
            assert!(word.parse::<SigmaRule>().is_err(), "{word}");
        }
    }
}
