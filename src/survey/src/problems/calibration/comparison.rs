//! Lens models side by side on the same corners, and whether the board is flat.
//!
//! ```text
//! BIC = n ln(v^T v / n) + u ln n,   F = ((v^T v)_flat - (v^T v)_free) / (u_free - u_flat) / s0_free^2
//! ```
//!
//! for `n` observations, `u` unknowns and residuals `v`.

use super::{
    BoardShape, MAX_ITERATIONS, Request, Solution, View, adjust, calibrate,
    statistics::{Statistics, statistics},
};
use crate::camera::Model;
use rowgram_optim::engine::SolveError;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, FisherSnedecor};

/// A lens model fitted to the corners.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelFit {
    /// The lens model.
    pub lens: Model,
    /// Its free distortion terms, separated by blanks.
    pub terms: String,
    /// Number of free parameters of the interior orientation.
    pub parameters: usize,
    /// Root mean square of the distances between corners and projections, pixels.
    pub rms_px: f64,
    /// Standard deviation of one coordinate of a corner, pixels.
    pub sigma0_px: f64,
    /// Bayes' information criterion: less is better.
    pub bic: f64,
}

impl ModelFit {
    /// The row of a calibration.
    pub fn of(request: &Request, found: &Statistics) -> ModelFit {
        let n = found.observations as f64;
        let squares = found.rms_px * found.rms_px * n / 2.0;
        let is_term = |name: &&str| !name.ends_with("_px") && *name != "aspect";
        let terms: Vec<&str> = found.free.iter().map(AsRef::as_ref).filter(is_term).collect();
        ModelFit {
            lens: request.model,
            terms: terms.join(" "),
            parameters: found.free.len(),
            rms_px: found.rms_px,
            sigma0_px: found.sigma0_px,
            bic: n * (squares / n).ln() + found.unknowns as f64 * n.ln(),
        }
    }
}

/// Lens models on the same corners.
#[derive(Debug)]
pub struct Comparison {
    /// Those that were fitted, the best first.
    pub models: Vec<ModelFit>,
    /// Those that these photos do not determine, and why.
    pub undetermined: Vec<(Model, SolveError)>,
}

/// Fits `others` to the corners of the calibration `own`; a request that is the same is not fitted again.
pub fn compare_models(
    views: &[View],
    own: &Request,
    found: &Statistics,
    others: &[Request],
) -> Comparison {
    let mut models = vec![ModelFit::of(own, found)];
    let mut undetermined = Vec::new();
    for request in others {
        if (request.model, &request.free) == (own.model, &own.free) {
            continue;
        }
        let fitted =
            calibrate(views, request).and_then(|solution| statistics(views, request, &solution));
        match fitted {
            Ok(found) => models.push(ModelFit::of(request, &found)),
            Err(error) => undetermined.push((request.model, error)),
        }
    }
    models.sort_by(|a, b| a.bic.total_cmp(&b.bic));
    Comparison { models, undetermined }
}

/// How far the board is off its plane, were every corner free to leave it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BoardBend {
    /// The corner furthest off, metres.
    pub largest_m: f64,
    /// Root mean square of the distances with heights estimated, pixels.
    pub rms_px: f64,
    /// Probability of so much better a fit if the board is flat.
    pub probability: f64,
    /// Whether that is no accident and large enough to matter.
    pub bent: bool,
}

/// A bend matters where it explains at least this share of the root mean square.
const MIN_IMPROVEMENT: f64 = 0.1;
/// A bend is no accident below this probability.
const MAX_PROBABILITY: f64 = 1e-6;
/// Heights of corners are not tested from fewer photos.
const MIN_VIEWS: usize = 4;

/// Tests whether a board of `corners` inner corners is flat, by an F test of the heights of its corners; `None` where not
/// all photos show it whole, so that a corner need not be the same one in all of them, and where heights are unknowns
/// anyway.
pub fn board_bend(
    corners: usize,
    views: &[View],
    request: &Request,
    solution: &Solution,
    found: &Statistics,
) -> Option<BoardBend> {
    let whole = views.iter().all(|view| view.marks.len() == corners);
    if request.shape == BoardShape::Free || !whole || views.len() < MIN_VIEWS {
        return None;
    }
    let free = Request { shape: BoardShape::Free, ..request.clone() };
    let adjusted = adjust(views, &free, &solution.state, request.loss, MAX_ITERATIONS).ok()?;
    let curved = statistics(views, &free, &adjusted).ok()?;
    let squares = |s: &Statistics| s.rms_px * s.rms_px * s.observations as f64 / 2.0;
    let more = (curved.unknowns - found.unknowns) as f64;
    let freedom = (curved.observations - curved.unknowns) as f64;
    let f = (squares(found) - squares(&curved)) / more / (squares(&curved) / freedom);
    let probability = FisherSnedecor::new(more, freedom).ok()?.sf(f.max(0.0));
    Some(BoardBend {
        largest_m: curved.heights_m.iter().map(|h| h[0].abs()).fold(0.0, f64::max),
        rms_px: curved.rms_px,
        probability,
        bent: probability < MAX_PROBABILITY
            && curved.rms_px < (1.0 - MIN_IMPROVEMENT) * found.rms_px,
    })
}
