//! The words of `rowgram locate`: its methods by name, the number of plants, the summary.

use super::stand::StandSummary;
use crate::{
    phenotype::{locate::Init, rows::Rows},
    problems::plants::{Form, Model, PlantUpdate, Prior, Proof},
};
use serde::{
    Deserialize, Serialize,
    de::{IntoDeserializer, value},
};

/// A named way to locate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Method {
    /// Votes along leaf axes, dynamic programming along curved rows.
    Full,
    /// `Full`, then the tempered descent from its plants.
    Refined,
    /// The tempered descent from regular spacing: row prior, truncated distances.
    Tempered,
    /// The paper: row prior of the other plants, mean distance as scale, from k-means++.
    Paper,
    /// k-means from k-means++.
    Kmeans,
    /// Detected rows and regular spacing; nothing is fitted.
    Rows,
}

/// How many plants there are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Count {
    /// As many as there seem to be.
    Auto,
    /// This many.
    Given(usize),
}

/// Reads a number of plants.
pub(super) fn count(text: &str) -> Result<Count, String> {
    if text == "auto" {
        return Ok(Count::Auto);
    }
    let number = text.parse().map(Count::Given);
    number.map_err(|_| format!("`auto` or a number of plants was expected, got: {text}"))
}

/// Independent votes of a plant's pixels where the descent is tempered: about one per leaf.
const VOTES_PER_PLANT: f64 = 6.0;
/// Where its distances are truncated, given the ground sampling distance.
const TRUNCATED_M: f64 = 0.3;

impl Method {
    /// Where the descent of a method starts.
    pub(super) fn init(self) -> Init {
        match self {
            Method::Full | Method::Refined => Init::Votes,
            Method::Tempered | Method::Rows => Init::Rows,
            Method::Paper | Method::Kmeans => Init::KmeansPlusPlus,
        }
    }

    /// Its model, given a ground sampling distance.
    pub(super) fn model(self, gsd_m: Option<f64>) -> Model {
        match self {
            Method::Full | Method::Refined | Method::Tempered => Model {
                tempering: Some(VOTES_PER_PLANT),
                truncate_px: gsd_m.map(|gsd| TRUNCATED_M / gsd),
                ..Model::default()
            },
            Method::Paper => Model { form: Form::Conditional, ..Model::default() },
            Method::Kmeans => {
                Model { prior: Prior::None, update: PlantUpdate::Mean, ..Model::default() }
            }
            Method::Rows => Model { prior: Prior::None, ..Model::default() },
        }
    }
}

/// What is printed as JSON.
#[derive(Debug, Serialize)]
pub(super) struct Summary {
    pub(super) plants: usize,
    pub(super) pixels: usize,
    pub(super) rows: usize,
    pub(super) heading_deg: Option<f64>,
    pub(super) row_spacing_px: Option<f64>,
    pub(super) row_spacing_m: Option<f64>,
    #[serde(flatten)]
    pub(super) descent: Option<DescentSummary>,
    #[serde(flatten)]
    pub(super) stand: Option<StandSummary>,
    pub(super) seconds: f64,
}

impl Summary {
    /// What is known before any plant is.
    pub(super) fn new(pixels: usize, found: Option<&Rows>, gsd_m: Option<f64>) -> Summary {
        let row_spacing_px = found.and_then(|rows| rows.spacing_px);
        Summary {
            plants: 0,
            pixels,
            rows: found.map_or(0, |rows| rows.rows.len()),
            heading_deg: found.map(|rows| rows.axes.heading_rad.to_degrees()),
            row_spacing_px,
            row_spacing_m: row_spacing_px.zip(gsd_m).map(|(px, gsd)| px * gsd),
            descent: None,
            stand: None,
            seconds: 0.0,
        }
    }
}

/// What only the descent knows.
#[derive(Debug, Serialize)]
pub(super) struct DescentSummary {
    pub(super) sigma_px: f64,
    pub(super) mean_distance_px: f64,
    pub(super) plants_without_pixels: usize,
    pub(super) initial_cost: f64,
    pub(super) final_cost: f64,
    pub(super) sweeps: u64,
    pub(super) stop: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) certificate: Option<Proof>,
}

/// A word as serde spells it, so that it is the same here as in TOML.
pub(super) fn word<T: for<'de> Deserialize<'de>>(text: &str) -> Result<T, String> {
    let text: value::StrDeserializer<'_, value::Error> = text.into_deserializer();
    T::deserialize(text).map_err(|error| error.to_string())
}
