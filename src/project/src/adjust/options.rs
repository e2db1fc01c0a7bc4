//! Options of bundle adjustment, and the `block.toml` that holds them.

use crate::{
    calibrate::LossChoice,
    convert::{Format, ModelFileOptions},
};
use rowgram_base::{
    error::Error,
    options::{Kind, Options},
};
use rowgram_optim::{
    nlls::{LinearSolver, Loss, Method},
    output::FileError,
};
use rowgram_survey::problems::{adjustment::OutlierTest, bundle::InteriorSharing};
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, path::Path, path::PathBuf};
use toml::{Spanned, Table};

/// What fixes position, orientation and scale of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DatumChoice {
    /// Control points, camera positions, scale bars.
    Control,
    /// The first image, and one coordinate of the farthest.
    Minimal,
}

/// How suspect observations are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SnoopingChoice {
    /// Not at all.
    Off,
    /// By Pope's tau: standard deviations are right but for a common factor of each kind.
    Pope,
    /// By Baarda's w: standard deviations are right.
    Baarda,
}

impl SnoopingChoice {
    /// The test, if there is one.
    pub(super) fn test(self) -> Option<OutlierTest> {
        match self {
            SnoopingChoice::Off => None,
            SnoopingChoice::Pope => Some(OutlierTest::Pope),
            SnoopingChoice::Baarda => Some(OutlierTest::Baarda),
        }
    }
}

rowgram_base::choices!(DatumChoice: Control, Minimal);
rowgram_base::choices!(SnoopingChoice: Off, Pope, Baarda);

rowgram_base::options! {
    /// How a BAL file is solved.
    pub struct NetworkOptions in "adjust" {
        /// Of a BAL file: how the linear systems are solved.
        pub solver: LinearSolver = LinearSolver::Auto;
        /// Of a BAL file: which trial step.
        pub method: Method = Method::LevenbergMarquardt;
        /// Of a BAL file: the longest time to solve for, in seconds.
        pub max_seconds: Option<f64> = None, limits NON_NEGATIVE, example "600.0";
        /// Of a BAL file: stop as soon as the cost is not above this.
        pub target_cost: Option<f64> = None, example "1e4";
        /// Of a BAL file: stop where a step gains less than this share of the cost.
        pub cost_tolerance: f64 = 1e-9, limits between(0.0, 0.9);
        /// Of a BAL file: start points again that a step leaves with so many times the mean cost of a measurement; 0 never does.
        pub restart_ratio: f64 = 30.0, limits NON_NEGATIVE;
    }
}

rowgram_base::options! {
    /// Bundle adjustment of a block with what is known on the ground and in the air.
    pub struct AdjustOptions in "adjust" with {
        /// How a BAL file is solved.
        pub network: NetworkOptions,
        /// What the reconstruction's own files do not say.
        pub files: ModelFileOptions,
    }, together go_together {
        /// Ground points: label, easting_m, northing_m, height_m, standard deviations, role, axes.
        pub control: Option<PathBuf> = None, example "\"gcps.csv\"";
        /// Where the ground points are in the images: image, label, u_px, v_px.
        pub marks: Option<PathBuf> = None, example "\"marks.csv\"";
        /// Camera positions: image, easting_m, northing_m, height_m, standard deviations.
        pub positions: Option<PathBuf> = None, example "\"positions.csv\"";
        /// Distances between ground points: from, to, length_m, sigma_m.
        pub scale_bars: Option<PathBuf> = None, example "\"bars.csv\"";
        /// The camera, in place of the reconstruction's: model, values, what is free, what is known.
        pub camera: Option<PathBuf> = None, example "\"camera.toml\"";
        /// Lens parameters to adjust; those that the camera names where not set.
        pub free: Option<Vec<String>> = None, example "[\"f_px\", \"k1\", \"k2\"]";
        /// Ground points that take no part and are compared afterwards.
        pub check: Vec<String> = Vec::new();
        /// Who shares an interior orientation. Where not set: every image of a BAL file has its own, images of other blocks
        /// share as their files say.
        pub interior: Option<InteriorSharing> = None, example "\"per-image\"";
        /// Robust loss of tie points and its scale: trivial, huber:A, soft-l1:A, cauchy:A, geman-mcclure:A or tukey:A. The
        /// scale is in pixels for a BAL file, in standard deviations for others.
        pub loss: LossChoice = LossChoice(Loss::Trivial);
        /// Standard deviation of tie points; that of a rowgram reconstruction, else 1, where not set.
        pub tie_sigma_px: Option<f64> = None, limits POSITIVE, example "0.5";
        /// Standard deviation of image measurements of ground points that come without one.
        pub mark_sigma_px: f64 = 0.5, limits POSITIVE;
        /// Standard deviation of ground points that come without one.
        pub control_sigma_m: f64 = 0.02, limits POSITIVE;
        /// Standard deviation of camera positions that come without one.
        pub position_sigma_m: f64 = 5.0, limits POSITIVE;
        /// The antenna in the camera frame (x right, y up, looking along -z).
        pub lever_arm_m: [f64; 3] = [0.0; 3];
        /// Time from the first to the last row of a photo. Where it is set, the motion within each photo is estimated.
        pub readout_s: Option<f64> = None, limits between(0.0001, 1.0), example "0.03";
        /// Standard deviation of each component of the velocity within a photo, about 0.
        pub velocity_sigma_m_s: f64 = 20.0, limits POSITIVE;
        /// What fixes position, orientation and scale.
        pub datum: DatumChoice = DatumChoice::Control;
        /// Whether the block is first brought into the frame of its control, by a similarity.
        pub align: bool = true;
        /// Whether suspect observations are removed (data snooping), and by which test.
        pub snooping: SnoopingChoice = SnoopingChoice::Pope;
        /// Adjust again without each control point in turn.
        pub leave_one_out: bool = false;
        /// Estimate a factor on the standard deviations of each kind of observation.
        pub variance_components: bool = false;
        /// Take SMAC's residuals in the domain of corrected coordinates, for comparison.
        pub corrected_domain: bool = false;
        /// The most iterations; 200 for a BAL file and 100 for other blocks where not set.
        pub max_iterations: Option<u64> = None, limits at_least(1.0), example "50";
        /// Folder for the report: JSON, tables, figures, camera.toml.
        pub report: Option<PathBuf> = None, example "\"report\"";
        /// Format of the adjusted block; that of the input where not set.
        pub to: Option<Format> = None, example "\"colmap-text\"";
    }
}

fn go_together(options: &AdjustOptions) -> Result<(), String> {
    match (&options.control, &options.marks) {
        (Some(_), None) => {
            Err("control: expected marks with it, where the points are in the images".to_owned())
        }
        (None, Some(_)) => Err("marks: expected control with them, what is marked".to_owned()),
        _ => Ok(()),
    }
}

impl AdjustOptions {
    /// The options that were set and that the other kind of block has: of blocks with names where `network` is given, else
    /// of BAL files.
    pub(super) fn foreign(&self, is_network: bool) -> Option<String> {
        const BOTH: [&str; 3] = ["interior", "loss", "max_iterations"];
        let network: Vec<&str> = NetworkOptions::fields().iter().map(|field| field.name).collect();
        let is_foreign = |name: &str| match is_network {
            true => !network.contains(&name) && !BOTH.contains(&name),
            false => network.contains(&name),
        };
        self.changed().into_iter().map(|(name, _)| name).find(|name| is_foreign(name))
    }
}

/// Whether a path is a block.toml.
pub(super) fn is_description(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "toml")
}

/// The block that a file stands for and what the file says of its adjustment: a `block.toml` names a reconstruction and
/// has the keys of [`AdjustOptions`], paths being relative to its folder; any other file is the block itself.
///
/// # Errors
/// A file that cannot be read; a key or value that does not belong there, with its line and what was expected.
pub fn read_block(file: &Path) -> Result<(PathBuf, AdjustOptions), Error> {
    if !is_description(file) {
        return Ok((file.to_owned(), AdjustOptions::default()));
    }
    let text = rowgram_files::read_text(file)?;
    let at = |span: std::ops::Range<usize>| 1 + text[..span.start].matches('\n').count();
    let entries: BTreeMap<Spanned<String>, Spanned<toml::Value>> = toml::from_str(&text)
        .map_err(|e| FileError::malformed(file, e.span().map(at), e.message()))?;
    let folder = file.parent().unwrap_or(Path::new(""));
    let section = AdjustOptions::section();
    let (mut model, mut given) = (None, Table::new());
    for (key, value) in entries {
        let line = at(key.span());
        let (key, mut value) = (key.into_inner(), value.into_inner());
        let is_path =
            key == "model" || section.field(&key).is_some_and(|field| field.kind == Kind::Path);
        if let (true, Some(path)) = (is_path, value.as_str()) {
            value = toml::Value::String(folder.join(path).to_string_lossy().into_owned());
        }
        if key == "model" {
            let path = value.as_str().ok_or_else(|| {
                FileError::malformed(file, line, format!("model = {value}: expected a path"))
            })?;
            model = Some(PathBuf::from(path));
            continue;
        }
        section.check_entry(&key, &value).map_err(|why| FileError::malformed(file, line, why))?;
        given.insert(key, value);
    }
    let model = model.ok_or_else(|| {
        FileError::malformed(file, None, "model is missing: the reconstruction to adjust")
    })?;
    let options = AdjustOptions::default().with(&given);
    Ok((model, options.map_err(|why| FileError::malformed(file, None, why))?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<(PathBuf, AdjustOptions), String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("block.toml");
        std::fs::write(&path, text).unwrap();
        let relative = |path: PathBuf| path.strip_prefix(folder.path()).unwrap().to_owned();
        read_block(&path)
            .map(|(model, mut options)| {
                options.control = options.control.map(relative);
                (relative(model), options)
            })
            .map_err(|error| error.to_string())
    }

    #[test]
    fn a_block_toml_names_the_block_and_its_options() {
        let (model, options) = read(
            "model = \"sparse\"\ncontrol = \"gcps.csv\"\nloss = \"huber:2\"\nlever_arm_m = [0, 0, 0.1]\nsolver = \"dense\"",
        )
        .unwrap();
        assert_eq!(model, Path::new("sparse"));
        assert_eq!(options.control.as_deref(), Some(Path::new("gcps.csv")));
        assert_eq!(options.loss, LossChoice(Loss::Huber(2.0)));
        assert_eq!(options.lever_arm_m, [0.0, 0.0, 0.1]);
        assert_eq!(options.foreign(false).as_deref(), Some("solver"));
        assert_eq!(options.foreign(true).as_deref(), Some("control"));
        assert!(options.validate().unwrap_err().contains("marks"));
    }

    #[test]
    fn what_a_block_toml_cannot_say_is_refused_with_its_line() {
        for (text, parts) in [
            ("control = \"gcps.csv\"", ["block.toml", "model is missing"]),
            ("model = \"a\"\ntie_sigma = 1.0", ["line 2", "did you mean tie_sigma_px?"]),
            (
                "model = \"a\"\n\nmark_sigma_px = 0.0",
                ["line 3", "a number greater than 0, in pixels"],
            ),
            ("model = \"a\"\nloss = \"huber\"", ["line 2", "huber needs a scale"]),
            ("model = 3", ["line 1", "expected a path"]),
            ("model = \"a\"\ndatum = \"fixed\"", ["line 2", "control, minimal"]),
        ] {
            let error = read(text).unwrap_err();
            assert!(parts.iter().all(|part| error.contains(part)), "{text}: {error}");
        }
    }
}
