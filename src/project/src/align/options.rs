//! How photos are oriented: the options of the stage.

use rowgram_survey::{
    features::FeatureOptions,
    sfm::{
        adjust_block::{BlockOptions, ShutterModel, USUAL_READOUT_S, When},
        incremental::IncrementalOptions,
        intrinsics::LensChoice,
        relative::Solver,
        verify::GeometricVerificationOptions,
    },
};
use serde::{Deserialize, Serialize};

/// A step of the stage, in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Step {
    /// Files and what they say.
    Inspect,
    /// Features of every photo.
    Features,
    /// Matches of the pairs worth trying.
    Match,
    /// Orientation of pairs.
    Verify,
    /// Exterior orientation.
    Orient,
    /// Mapping frame, bundle adjustment, self-calibration.
    Adjust,
    /// Files and pictures.
    Report,
}

rowgram_base::choices!(Step: Inspect, Features, Match, Verify, Orient, Adjust, Report);

rowgram_base::options! {
    /// From photos to camera poses, calibrated cameras and a sparse cloud in the mapping frame.
    pub struct AlignOptions in "align", together go_together,
        main [lens, control_sigma_m, check, rolling_shutter]
    {
        /// Lens model of cameras without a calibration.
        pub lens: LensChoice = LensChoice::Auto;
        /// Lens parameters estimated in the last adjustment; all but the aspect and rational terms where not set,
        /// or those that a calibrated camera names.
        pub free: Option<Vec<String>> = None, example "[\"f_px\", \"k1\", \"k2\"]";
        /// Minimal solver of relative orientation.
        pub solver: Solver = Solver::Auto;
        /// Maximum number of features per photo.
        pub max_features: usize = 6000, limits at_least(100.0);
        /// Enlarge photos twofold before feature detection, which takes four times as long: auto does so for photos
        /// below eight megapixels, and for those with too few features.
        pub enlarge: When = When::Auto;
        /// Maximum number of tie-point measurements in the adjustment. Beyond it the longest tracks are kept, such
        /// that every part of every photo has some; each measurement takes about 0.7 kB of memory.
        pub max_tie_observations: usize = 1_000_000, limits at_least(1000.0);
        /// Largest reprojection error of an image measurement that is used.
        pub tolerance_px: f64 = 4.0, limits POSITIVE;
        /// Standard deviation of control points that come without one.
        pub control_sigma_m: f64 = 0.02, limits POSITIVE;
        /// Standard deviation of image measurements of ground points that come without one.
        pub mark_sigma_px: f64 = 0.5, limits POSITIVE;
        /// Use camera positions in the adjustment; otherwise only to find neighbouring photos.
        pub use_positions: bool = true;
        /// Standard deviation of the roll and pitch of the gimbal in the XMP of single photos; that of the heading is five
        /// times as large. Errors common to all photos of a camera (boresight, declination) are estimated. 0: the
        /// gimbal's angles are not used.
        pub gimbal_sigma_deg: f64 = 1.0, limits between(0.0, 45.0);
        /// Check points: ground points that are left out of the adjustment and compared afterwards.
        pub check: Vec<String> = Vec::new();
        /// Control points that are never rejected as outliers.
        pub keep: Vec<String> = Vec::new();
        /// Model the rolling shutter (rows are read out one after the other while the camera moves): auto where the
        /// photos show it, on always.
        pub rolling_shutter: When = When::Auto;
        /// Readout time from the first to the last row of a photo. Where it is not set, velocities are given for
        /// 0.03 s.
        pub readout_s: Option<f64> = None, limits between(0.0001, 1.0), example "0.03";
        /// Repeat matching with the adjusted poses (guided matching): auto does so with ground control.
        pub guided_matching: When = When::Auto;
        /// Refine tie points by least-squares matching, several times more accurate, and find them in further
        /// photos: auto does so with ground control.
        pub refine_tie_points: When = When::Auto;
        /// Seed of all random sampling.
        pub seed: u64 = 1;
    }
}

/// Lens parameters are those of a lens, and only a rolling shutter has a readout.
fn go_together(options: &AlignOptions) -> Result<(), String> {
    let known: Vec<&str> = rowgram_survey::camera::Model::ALL
        .iter()
        .flat_map(|model| model.parameters())
        .map(|parameter| parameter.name)
        .collect();
    for name in options.free.iter().flatten() {
        if !known.contains(&name.as_str()) {
            let near = rowgram_base::options::nearest(name, &known)
                .map_or_else(String::new, |near| format!("; did you mean {near}?"));
            return Err(format!("free: no lens has a parameter {name:?}{near}"));
        }
    }
    match (options.rolling_shutter, options.readout_s) {
        (When::Off, Some(_)) => {
            Err("readout_s: rolling_shutter = off takes all rows to be read at once".to_owned())
        }
        _ => Ok(()),
    }
}

impl AlignOptions {
    pub(super) fn detection(&self) -> FeatureOptions {
        // Half of the usual contrast: the budget keeps the best, and a plain crop has no others.
        let contrast_threshold = 0.02;
        let max_features = self.max_features;
        FeatureOptions { max_features, contrast_threshold, ..FeatureOptions::default() }
    }

    pub(super) fn verification(&self) -> GeometricVerificationOptions {
        GeometricVerificationOptions {
            solver: self.solver,
            tolerance_px: self.tolerance_px,
            seed: self.seed,
            ..GeometricVerificationOptions::default()
        }
    }

    pub(super) fn incremental(&self, calibrated: bool) -> IncrementalOptions {
        // Of each camera those that its model has.
        let names: &[&str] =
            if calibrated { &[] } else { &["f_px", "k1", "k2", "c_px", "K1", "K2"] };
        IncrementalOptions {
            tolerance_px: self.tolerance_px,
            free: names.iter().map(|&name| name.to_owned()).collect(),
            seed: self.seed,
            ..IncrementalOptions::default()
        }
    }

    pub(super) fn block(&self, calibrated: bool) -> BlockOptions {
        let readout_s = self.readout_s.unwrap_or(USUAL_READOUT_S);
        BlockOptions {
            tolerance_px: self.tolerance_px,
            shutter: match self.rolling_shutter {
                When::Auto => ShutterModel::Auto(readout_s),
                When::Off => ShutterModel::Global,
                When::On => ShutterModel::Rolling(readout_s),
            },
            guided_matching: self.guided_matching,
            refine_tie_points: self.refine_tie_points,
            max_tie_observations: self.max_tie_observations,
            free: self.free.clone(),
            calibrated,
        }
    }
}
