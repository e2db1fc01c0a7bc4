//! `rowgram synth flight`: a project folder with photos, ground control and the whole truth.

use crate::cli::terminal::Terminal;
use data_synth::{
    field::GrowthStage,
    flight::GimbalRecordConfig,
    patterns::TargetPattern,
    twin::{FlightPreset, TwinConfig},
};
use rowgram_base::error::Error;
use rowgram_project::synth::{FlightOptions, read_config, write_flight};
use std::path::PathBuf;

/// Photos of a flight over a synthetic field, as a project folder with the whole truth.
///
/// Writes what a crew brings home: images/ (JPEG with EXIF: position, moment, lens), gcps.csv (surveyed
/// targets, role control or check), marks.csv (targets clicked in the photos), geolocation.csv, and field.toml
/// (every parameter, for --config). And under truth/ what no crew knows: camera.toml, exterior_orientation.csv,
/// plants.csv, leaves.csv, leaf_axes.csv, rows.csv, plots.csv, weeds.csv, gcps.csv, marks.csv, dem.asc, the field
/// from straight above (mask.png, picture.png, with world files) and, with photos, its first surface and the height
/// of that over the ground (dsm.tif, chm.tif). Tie points without photos go to tie_points.csv, truth/tie_points.csv and, with start values as from the receiver, to model/ in COLMAP's text
/// form (the lens without distortion: truth/camera.toml has it).
///
/// Positions are in a UTM zone on WGS84, heights above the ellipsoid; image positions have the centre of
/// the top-left pixel at 0,0. The same parameters give the same bytes for any number of threads.
///
/// Example: rowgram synth flight --preset small -o field
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Folder to write into, made if missing.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Replace files that exist.
    #[arg(long)]
    force: bool,
    /// Parameters from a field.toml; options given here come before it.
    #[arg(long, value_name = "FILE", conflicts_with = "preset")]
    config: Option<PathBuf>,
    /// A usual flight: small, paper or seneca [default: small].
    #[arg(long, value_name = "NAME")]
    preset: Option<FlightPreset>,
    /// Seed of everything random [default: 1].
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    seed: Option<u64>,
    /// Growth stage: early, mid or late.
    #[arg(long, value_name = "STAGE")]
    stage: Option<GrowthStage>,
    /// What is painted on the targets: chequered, cross, disc, apriltag or aruco [default: chequered].
    #[arg(long, value_name = "PATTERN")]
    targets: Option<TargetPattern>,
    /// Size of the targets: the side of a plate, the length of the arms of a cross, the diameter of a disc, the side of the
    /// black square of a coded one.
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    target_size: Option<f64>,
    /// Tie points per photo made straight from geometry.
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    tie_points: Option<usize>,
    /// Tilt of the camera in its mount, 0 to 8: it looks that much ahead of where the gimbal points [default: 0].
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    mount_tilt: Option<f64>,
    /// Write the gimbal's angles into the photos (XMP) with this standard deviation about east and north, and three
    /// times of it in the heading.
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    gimbal: Option<f64>,
    /// A receiver with corrections: positions have this standard deviation, and say so (XMP and geolocation.csv).
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    rtk: Option<f64>,
    /// Render no photos: everything else in seconds.
    #[arg(long)]
    no_photos: bool,
    /// Also write for each photo, under truth/photos/: its leaf mask, the plant that each pixel shows (number + 1 as
    /// red + 256 green + 65536 blue, 0 none), the leaf likewise (its place in truth/leaves.csv + 1, weeds behind the
    /// plants), and its stalk bases.
    #[arg(long, conflicts_with = "no_photos")]
    photo_truth: bool,
    /// Also write this many photos of a chessboard by the same camera, under calibration/: 9 x 6 inner corners,
    /// squares of 4 cm.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=999))]
    boards: u16,
}

/// Runs the command.
///
/// # Errors
/// A parameter that cannot be used, an output that exists, a file that cannot be read or written.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let options = FlightOptions {
        photos: !args.no_photos,
        photo_truth: args.photo_truth,
        boards: args.boards,
    };
    let mut terminal = Terminal::new();
    let found = write_flight(&args.config()?, &options, &args.output, args.force, &mut terminal)?;
    tracing::info!(
        "{}: {} plants, {} photos{}, {} targets, {} marks",
        args.output.display(),
        found.plants,
        found.photos,
        if args.no_photos { " planned" } else { "" },
        found.targets,
        found.marks,
    );
    Ok(())
}

impl Args {
    /// What to make: the preset or file, then the options.
    fn config(&self) -> Result<TwinConfig, Error> {
        let mut config = match &self.config {
            Some(path) => read_config(path)?,
            None => TwinConfig::preset(self.preset.unwrap_or(FlightPreset::Small)),
        };
        if let Some(seed) = self.seed {
            config.field.seed = seed;
        }
        if let Some(stage) = self.stage {
            config.field.stage = stage;
        }
        if let Some(pattern) = self.targets {
            config.targets.pattern = pattern;
        }
        if let Some(size_m) = self.target_size {
            config.targets.size_m = size_m;
        }
        if let Some(count) = self.tie_points {
            config.tie_points.per_photo = count;
        }
        if let Some(tilt_deg) = self.mount_tilt {
            config.flight.mount_tilt_deg = tilt_deg;
        }
        if let Some(sigma_deg) = self.gimbal {
            config.flight.gimbal_record = Some(GimbalRecordConfig::of_sigma_deg(sigma_deg));
        }
        if let Some(sigma_m) = self.rtk {
            let gnss = &mut config.flight.gnss;
            (gnss.horizontal_m, gnss.vertical_m) = (sigma_m, sigma_m);
            gnss.stated_sigma_m = Some(sigma_m);
        }
        Ok(config)
    }
}
