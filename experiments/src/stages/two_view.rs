//! Relative orientation of two photos among wrong matches: two points, five points, or whichever explains
//! a pair better.

use crate::{
    relative::{self, Setting},
    stage::{Measured, Metric, Stage, metric},
};
use rowgram::sfm::relative::Solver;
use serde::{Deserialize, Serialize};

/// What can be varied; the geometry of the pair is that of [`relative`].
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    solver: Solver,
    /// Share of wrong matches.
    wrong_share: f64,
    /// Wrong matches are a few rows or plants off instead of anywhere.
    repetitive: bool,
    /// Tilt of the second photo, degrees.
    tilt_deg: f64,
    /// How much higher the second photo is, share of the flying height.
    height_share: f64,
}

impl Default for Parameters {
    fn default() -> Parameters {
        Parameters {
            solver: Solver::TwoPoint,
            wrong_share: 0.5,
            repetitive: true,
            tilt_deg: 0.0,
            height_share: 0.0,
        }
    }
}

/// The stage.
pub(crate) struct TwoView;

impl Stage for TwoView {
    type Parameters = Parameters;
    const NAME: &'static str = "two-view";
    const ABOUT: &'static str = "relative orientation of two photos among wrong matches";
    const METRICS: &'static [Metric] = &[
        metric("right", "1 where the rotation is within 1 degree and the baseline within 3"),
        metric("inliers", "correspondences that fit, of 300"),
        metric("samples", "samples drawn"),
    ];

    fn check(p: &Parameters) -> Result<(), String> {
        if !(0.0..1.0).contains(&p.wrong_share) {
            return Err(format!("wrong_share = {}: expected a share below 1", p.wrong_share));
        }
        if !(p.tilt_deg.abs() <= 45.0 && p.height_share.abs() <= 0.5) {
            return Err("expected a tilt up to 45 degrees, a height_share up to 0.5".to_owned());
        }
        Ok(())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let setting = Setting {
            wrong_share: p.wrong_share,
            tilt_deg: p.tilt_deg,
            height_share: p.height_share,
            repetitive: p.repetitive,
        };
        let (right, inliers, samples) = relative::run(&setting, p.solver, seed);
        let mut measured = Measured::default();
        measured.put("right", f64::from(right));
        measured.put("inliers", inliers as f64);
        measured.put("samples", samples as f64);
        Ok(measured)
    }
}
