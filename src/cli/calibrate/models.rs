//! Lens models side by side on the same corners, and whether the board is flat.

use super::{Args, LensName, request};
use crate::{
    error::Error,
    problems::calibration::{
        BoardShape, MAX_ITERATIONS, Request, Solution, View, adjust, calibrate,
        statistics::{Statistics, statistics},
    },
};
use clap::ValueEnum;
use serde::Serialize;
use statrs::distribution::{ContinuousCDF, FisherSnedecor};

/// A lens model on the same corners.
#[derive(Debug, Clone, Serialize)]
pub(super) struct ModelRow {
    pub(super) lens: &'static str,
    pub(super) terms: String,
    /// Free parameters of the interior orientation.
    pub(super) parameters: usize,
    pub(super) rms_px: f64,
    sigma0_px: f64,
    /// Bayes' information criterion, `n ln(v^T v / n) + u ln n`: less is better.
    bic: f64,
}

/// Adjusts the usual lens models to the same corners, so that they can be compared.
pub(super) fn compare(
    args: &Args,
    views: &[View],
    own: &Request,
    found: &Statistics,
) -> Result<Vec<ModelRow>, Error> {
    let mut rows = vec![row(own, found)];
    let rational: Vec<String> =
        "k1,k2,p1,p2,k3,k4,k5,k6".split(',').map(ToOwned::to_owned).collect();
    let lenses = LensName::value_variants().iter().map(|lens| (lens.model(), None));
    for (model, free) in lenses.chain([(LensName::Brown.model(), Some(rational.as_slice()))]) {
        let mut request = request(args, model, free, own.size_px)?;
        if (request.model, &request.free) == (own.model, &own.free) {
            continue;
        }
        request.shape = own.shape;
        // A model that cannot be determined from these photos has no line.
        let fitted =
            calibrate(views, &request).and_then(|solution| statistics(views, &request, &solution));
        match fitted {
            Ok(found) => rows.push(row(&request, &found)),
            Err(error) => tracing::info!("{} for comparison: {error}", model.word()),
        }
    }
    rows.sort_by(|a, b| a.bic.total_cmp(&b.bic));
    Ok(rows)
}

fn row(request: &Request, found: &Statistics) -> ModelRow {
    let n = found.observations as f64;
    let squares = found.rms_px * found.rms_px * n / 2.0;
    let terms = found
        .free
        .iter()
        .filter(|name| !name.ends_with("_px") && **name != "aspect")
        .copied()
        .collect::<Vec<_>>();
    ModelRow {
        lens: request.model.word(),
        terms: terms.join(" "),
        parameters: found.free.len(),
        rms_px: found.rms_px,
        sigma0_px: found.sigma0_px,
        bic: n * (squares / n).ln() + found.unknowns as f64 * n.ln(),
    }
}

/// How far the board is off its plane, were every corner free to leave it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct Bend {
    /// The corner furthest off, metres.
    pub(super) largest_m: f64,
    /// Root mean square of the distances with heights estimated, pixels.
    pub(super) rms_px: f64,
    /// Probability of so much better a fit if the board is flat.
    probability: f64,
    /// Whether that is no accident and large enough to matter.
    pub(super) bent: bool,
}

/// A bend matters where it explains at least this share of the root mean square.
const MATTERS: f64 = 0.1;
/// A bend is no accident below this probability.
const ACCIDENT: f64 = 1e-6;

/// Tests whether the board is flat, by an F test of the heights of its corners; nothing where not all
/// photos show it whole, so that a corner need not be the same one in all of them.
pub(super) fn bend(
    args: &Args,
    views: &[View],
    request: &Request,
    solution: &Solution,
    found: &Statistics,
) -> Option<Bend> {
    let corners = args.board.columns * args.board.rows;
    let whole = views.iter().all(|view| view.marks.len() == corners);
    if request.shape == BoardShape::Free || !whole || views.len() < 4 {
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
    let bent = probability < ACCIDENT && curved.rms_px < (1.0 - MATTERS) * found.rms_px;
    let largest_m = curved.heights_m.iter().map(|h| h[0].abs()).fold(0.0, f64::max);
    if bent {
        tracing::warn!(
            "the board does not look flat: up to {:.2} mm off its plane, rms {:.3} px instead of {:.3} px with it; \
             --board-shape free estimates it",
            1e3 * largest_m,
            curved.rms_px,
            found.rms_px
        );
    }
    Some(Bend { largest_m, rms_px: curved.rms_px, probability, bent })
}
