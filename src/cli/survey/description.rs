//! What is to be adjusted and how: options of the command line over a `block.toml`.

use crate::{
    error::Error,
    io::{FileError, control::Defaults},
    problems::adjustment::OutlierTest,
    scene::RollingShutter,
};
use clap::{Args, ValueEnum};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Options of `adjust` for blocks that are not BAL files.
#[derive(Debug, Clone, Default, Args, Deserialize)]
#[command(next_help_heading = "Blocks with control (COLMAP, Bundler, OpenSfM, block.toml)")]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub(in crate::cli) struct Options {
    /// In a block.toml: the reconstruction.
    #[arg(skip)]
    model: Option<PathBuf>,
    /// Ground points: label, easting_m, northing_m, height_m, standard deviations, role, axes.
    #[arg(long, visible_alias = "gcps", value_name = "CSV")]
    control: Option<PathBuf>,
    /// Where the ground points are in the images: image, label, u_px, v_px.
    #[arg(long, value_name = "CSV")]
    marks: Option<PathBuf>,
    /// Camera positions: image, easting_m, northing_m, height_m, standard deviations.
    #[arg(long, visible_alias = "gnss", value_name = "CSV")]
    positions: Option<PathBuf>,
    /// Distances between ground points: from, to, length_m, sigma_m.
    #[arg(long, value_name = "CSV")]
    scale_bars: Option<PathBuf>,
    /// The camera, in place of the reconstruction's: model, values, what is free, what is known.
    #[arg(long, value_name = "TOML")]
    camera: Option<PathBuf>,
    /// Interior orientation to adjust, e.g. f_px,k1,k2 or c_px,xp_px,yp_px,K1.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    free: Option<Vec<String>>,
    /// Ground points to use as check points.
    #[arg(long, value_name = "LABELS", value_delimiter = ',')]
    check: Vec<String>,
    /// Standard deviation of tie points, pixels.
    #[arg(long, value_name = "PX")]
    tie_sigma: Option<f64>,
    /// Standard deviation of marks where the file has none, pixels.
    #[arg(long, value_name = "PX")]
    mark_sigma: Option<f64>,
    /// Standard deviation of ground points where the file has none, metres.
    #[arg(long, value_name = "M")]
    control_sigma: Option<f64>,
    /// Standard deviation of camera positions where the file has none, metres.
    #[arg(long, value_name = "M")]
    position_sigma: Option<f64>,
    /// The antenna in the camera frame (x right, y up, looking along -z), metres.
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    lever_arm: Option<Vec<f64>>,
    /// Estimate the motion within each frame of a rolling shutter that needs this long from the
    /// first to the last row, seconds.
    #[arg(long, value_name = "SECONDS")]
    rolling_shutter: Option<f64>,
    /// Standard deviation of each component of that velocity about 0, metres per second.
    #[arg(long, value_name = "M/S")]
    velocity_sigma: Option<f64>,
    /// What fixes position, orientation and scale.
    #[arg(long, value_enum)]
    datum: Option<Datum>,
    /// Leave the block in the frame that it comes in.
    #[arg(long)]
    #[serde(default)]
    no_align: bool,
    /// Whether suspect observations are taken out, and by which test.
    #[arg(long, value_enum)]
    snoop: Option<Snoop>,
    /// Adjust again without each control point in turn.
    #[arg(long)]
    leave_one_out: bool,
    /// Estimate a factor on the standard deviations of each kind of observation.
    #[arg(long)]
    variance_components: bool,
    /// Take SMAC's residuals in the domain of corrected coordinates, for comparison.
    #[arg(long)]
    corrected_domain: bool,
    /// Image size of a Bundler file, which has none.
    #[arg(long, value_name = "WIDTHxHEIGHT")]
    image_size: Option<String>,
    /// Image names of a Bundler file; list.txt beside it if not given.
    #[arg(long, value_name = "TXT")]
    list: Option<PathBuf>,
    /// Measurements of an OpenSfM reconstruction; tracks.csv beside it if not given.
    #[arg(long, value_name = "CSV")]
    tracks: Option<PathBuf>,
    /// Folder for the report: JSON, tables, figures, camera.toml.
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Format of the output; that of the input if not given.
    #[arg(long, value_enum)]
    to: Option<Format>,
}

/// What fixes the frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(in crate::cli) enum Datum {
    /// Control points, camera positions, scale bars.
    #[default]
    Control,
    /// The first image, and one coordinate of the farthest.
    Minimal,
}

/// How suspect observations are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(in crate::cli) enum Snoop {
    /// Not at all.
    Off,
    /// By Pope's tau: standard deviations are right but for a common factor of each kind.
    Pope,
    /// By Baarda's w: standard deviations are right.
    Baarda,
}

/// Formats of reconstructions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(in crate::cli) enum Format {
    /// cameras.txt, images.txt, points3D.txt.
    ColmapText,
    /// cameras.bin, images.bin, points3D.bin.
    ColmapBinary,
    /// bundle.out and list.txt.
    Bundler,
    /// reconstruction.json and tracks.csv.
    Opensfm,
    /// Our own reconstruction.json with tie_points.csv and tie_observations.csv: everything, exactly.
    Rowgram,
}

/// All of it, checked.
#[derive(Debug)]
pub(super) struct Description {
    pub(super) model: PathBuf,
    pub(super) control: Option<PathBuf>,
    pub(super) marks: Option<PathBuf>,
    pub(super) positions: Option<PathBuf>,
    pub(super) scale_bars: Option<PathBuf>,
    pub(super) camera: Option<PathBuf>,
    pub(super) free: Option<Vec<String>>,
    pub(super) per_image: bool,
    pub(super) check: Vec<String>,
    pub(super) tie_sigma_px: f64,
    /// Whether somebody gave it.
    pub(super) has_tie_sigma: bool,
    pub(super) defaults: Defaults,
    pub(super) lever_arm_m: [f64; 3],
    pub(super) rolling_shutter: Option<RollingShutter>,
    pub(super) datum: Datum,
    pub(super) align: bool,
    pub(super) snooping: Option<OutlierTest>,
    pub(super) leave_one_out: bool,
    pub(super) variance_components: bool,
    pub(super) corrected_domain: bool,
    pub(super) image_size: Option<[u32; 2]>,
    pub(super) list: Option<PathBuf>,
    pub(super) tracks: Option<PathBuf>,
    pub(super) report: Option<PathBuf>,
    pub(super) to: Option<Format>,
}

/// Whether a path is a block.toml.
pub(super) fn is_description(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "toml")
}

impl Options {
    /// The name of the first option that was given, if any.
    pub(in crate::cli) fn given(&self) -> Option<&'static str> {
        [
            (self.control.is_some(), "--control"),
            (self.marks.is_some(), "--marks"),
            (self.positions.is_some(), "--positions"),
            (self.scale_bars.is_some(), "--scale-bars"),
            (self.camera.is_some(), "--camera"),
            (self.free.is_some(), "--free"),
            (!self.check.is_empty(), "--check"),
            (self.tie_sigma.is_some(), "--tie-sigma"),
            (self.mark_sigma.is_some(), "--mark-sigma"),
            (self.control_sigma.is_some(), "--control-sigma"),
            (self.position_sigma.is_some(), "--position-sigma"),
            (self.lever_arm.is_some(), "--lever-arm"),
            (self.rolling_shutter.is_some(), "--rolling-shutter"),
            (self.velocity_sigma.is_some(), "--velocity-sigma"),
            (self.datum.is_some(), "--datum"),
            (self.no_align, "--no-align"),
            (self.snoop.is_some(), "--snoop"),
            (self.leave_one_out, "--leave-one-out"),
            (self.variance_components, "--variance-components"),
            (self.corrected_domain, "--corrected-domain"),
            (self.image_size.is_some(), "--image-size"),
            (self.list.is_some(), "--list"),
            (self.tracks.is_some(), "--tracks"),
            (self.report.is_some(), "--report"),
            (self.to.is_some(), "--to"),
        ]
        .into_iter()
        .find_map(|(given, name)| given.then_some(name))
    }

    /// What the command line says, and where it says nothing what the file does.
    fn over(&self, file: Options) -> Options {
        let own = self.clone();
        Options {
            model: file.model,
            control: own.control.or(file.control),
            marks: own.marks.or(file.marks),
            positions: own.positions.or(file.positions),
            scale_bars: own.scale_bars.or(file.scale_bars),
            camera: own.camera.or(file.camera),
            free: own.free.or(file.free),
            check: if own.check.is_empty() { file.check } else { own.check },
            tie_sigma: own.tie_sigma.or(file.tie_sigma),
            mark_sigma: own.mark_sigma.or(file.mark_sigma),
            control_sigma: own.control_sigma.or(file.control_sigma),
            position_sigma: own.position_sigma.or(file.position_sigma),
            lever_arm: own.lever_arm.or(file.lever_arm),
            rolling_shutter: own.rolling_shutter.or(file.rolling_shutter),
            velocity_sigma: own.velocity_sigma.or(file.velocity_sigma),
            datum: own.datum.or(file.datum),
            no_align: own.no_align || file.no_align,
            snoop: own.snoop.or(file.snoop),
            leave_one_out: own.leave_one_out || file.leave_one_out,
            variance_components: own.variance_components || file.variance_components,
            corrected_domain: own.corrected_domain || file.corrected_domain,
            image_size: own.image_size.or(file.image_size),
            list: own.list.or(file.list),
            tracks: own.tracks.or(file.tracks),
            report: own.report.or(file.report),
            to: own.to.or(file.to),
        }
    }

    /// Paths of a file are relative to its folder.
    fn beside(&mut self, folder: &Path) {
        for path in [
            &mut self.model,
            &mut self.control,
            &mut self.marks,
            &mut self.positions,
            &mut self.scale_bars,
            &mut self.camera,
            &mut self.list,
            &mut self.tracks,
            &mut self.report,
        ]
        .into_iter()
        .flatten()
        {
            *path = folder.join(&*path);
        }
    }
}

impl Description {
    /// Reads `file` where it is a description, and lays the options over it.
    pub(super) fn of(
        file: &Path,
        options: &Options,
        per_image: bool,
    ) -> Result<Description, Error> {
        let mut all = options.clone();
        let model = if is_description(file) {
            let text = std::fs::read_to_string(file).map_err(|e| FileError::read(file, e))?;
            let mut read: Options = toml::from_str(&text).map_err(|e| {
                FileError::malformed(file, None, e.to_string().trim_end().to_owned())
            })?;
            read.beside(file.parent().unwrap_or(Path::new("")));
            all = options.over(read);
            all.model.clone().ok_or_else(|| {
                FileError::malformed(file, None, "model is missing: the reconstruction to adjust")
            })?
        } else {
            file.to_owned()
        };
        let sigma = |value: Option<f64>, name: &str, default: f64| match value {
            Some(value) if !(value > 0.0 && value.is_finite()) => {
                Err(Error::Argument(format!("{name} {value}: expected a positive number")))
            }
            value => Ok(value.unwrap_or(default)),
        };
        let plain = Defaults::default();
        let lever_arm_m = match all.lever_arm.as_deref() {
            None => [0.0; 3],
            Some(&[x, y, z]) => [x, y, z],
            Some(_) => {
                return Err(Error::Argument("--lever-arm: expected three numbers".into()));
            }
        };
        let rolling_shutter = match all.rolling_shutter {
            None => None,
            Some(readout_s) => Some(RollingShutter {
                readout_s: sigma(Some(readout_s), "--rolling-shutter", 0.0)?,
                sigma_velocity_m_s: sigma(all.velocity_sigma, "--velocity-sigma", 20.0)?,
                sigma_rate_rad_s: 0.0,
            }),
        };
        let image_size = image_size(all.image_size.as_deref())?;
        Ok(Description {
            model,
            tie_sigma_px: sigma(all.tie_sigma, "--tie-sigma", 1.0)?,
            has_tie_sigma: all.tie_sigma.is_some(),
            defaults: Defaults {
                mark_px: sigma(all.mark_sigma, "--mark-sigma", plain.mark_px)?,
                control_m: sigma(all.control_sigma, "--control-sigma", plain.control_m)?,
                position_m: sigma(all.position_sigma, "--position-sigma", plain.position_m)?,
            },
            lever_arm_m,
            rolling_shutter,
            image_size,
            control: all.control,
            marks: all.marks,
            positions: all.positions,
            scale_bars: all.scale_bars,
            camera: all.camera,
            free: all.free,
            per_image,
            check: all.check,
            datum: all.datum.unwrap_or_default(),
            align: !all.no_align,
            snooping: match all.snoop.unwrap_or(Snoop::Pope) {
                Snoop::Off => None,
                Snoop::Pope => Some(OutlierTest::Pope),
                Snoop::Baarda => Some(OutlierTest::Baarda),
            },
            leave_one_out: all.leave_one_out,
            variance_components: all.variance_components,
            corrected_domain: all.corrected_domain,
            list: all.list,
            tracks: all.tracks,
            report: all.report,
            to: all.to,
        })
    }
}

/// An image size as it is typed.
///
/// # Errors
/// Where it is none.
pub(super) fn image_size(text: Option<&str>) -> Result<Option<[u32; 2]>, Error> {
    let wrong = |text| Error::Argument(format!("--image-size {text}: expected WIDTHxHEIGHT"));
    text.map(|text| size(text).ok_or_else(|| wrong(text))).transpose()
}

fn size(text: &str) -> Option<[u32; 2]> {
    let (width, height) = text.split_once(['x', 'X'])?;
    let [width, height] = [width.parse().ok()?, height.parse().ok()?];
    (width > 0 && height > 0).then_some([width, height])
}
