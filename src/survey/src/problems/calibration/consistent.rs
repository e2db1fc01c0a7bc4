//! A calibration from photos of which some may contradict the others.

use super::{
    Request, Solution, View, calibrate,
    statistics::{Statistics, statistics},
};
use rowgram_optim::engine::SolveError;
use rowgram_optim::robust::median;

/// Fewer photos determine no camera.
pub const MIN_VIEWS: usize = 3;
/// A photo whose root mean square is this many times the median one contradicts the others,
const MISFIT_RATIO: f64 = 5.0;
/// unless it is within this distance, pixels, whatever the others are.
const MISFIT_PX: f64 = 1.0;

/// A photo that contradicts the others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Misfit {
    /// Which of the views.
    pub view: usize,
    /// Its root mean square, pixels.
    pub rms_px: f64,
    /// The median one of all views, pixels.
    pub median_px: f64,
    /// Whether it takes part all the same.
    pub kept: bool,
}

/// A calibration of views that agree with each other.
#[derive(Debug)]
pub struct Consistent {
    /// Indices of the views that take part.
    pub used: Vec<usize>,
    /// Those views.
    pub views: Vec<View>,
    /// The calibration.
    pub solution: Solution,
    /// How well it is known; its views are those of [`Consistent::used`].
    pub statistics: Statistics,
    /// Views that contradict the others, the worst first.
    pub misfits: Vec<Misfit>,
}

/// Calibrates; while a view contradicts the others, the worst one is left out and all is done again.
///
/// With `keep_misfits`, or where too few views would remain, the worst one is reported and kept.
///
/// # Errors
/// As [`calibrate`] and [`statistics`].
pub fn calibrate_consistent(
    views: &[View],
    request: &Request,
    keep_misfits: bool,
) -> Result<Consistent, SolveError> {
    let mut used: Vec<usize> = (0..views.len()).collect();
    let mut misfits = Vec::new();
    loop {
        let own: Vec<View> = used.iter().map(|&k| views[k].clone()).collect();
        let solution = calibrate(&own, request)?;
        let found = statistics(&own, request, &solution)?;
        let median_px = median(found.views.iter().map(|view| view.rms_px)).unwrap_or(0.0);
        let worst = (0..used.len())
            .max_by(|&a, &b| found.views[a].rms_px.total_cmp(&found.views[b].rms_px))
            .map(|k| (k, found.views[k].rms_px))
            .filter(|&(_, rms_px)| rms_px > MISFIT_RATIO * median_px && rms_px > MISFIT_PX);
        let kept = keep_misfits || used.len() <= MIN_VIEWS;
        if let Some((worst, rms_px)) = worst {
            misfits.push(Misfit { view: used[worst], rms_px, median_px, kept });
            if !kept {
                used.remove(worst);
                continue;
            }
        }
        return Ok(Consistent { used, views: own, solution, statistics: found, misfits });
    }
}
