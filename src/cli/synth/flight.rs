//! `rowgram synth flight`: a project folder with photos, ground control and the whole truth.

use super::read_config;
use crate::{
    error::Error,
    io::{FileError, output},
};
use data_synth::{
    board::{self, BOARD},
    exif,
    field::GrowthStage,
    files,
    photo::Photo,
    start_model,
    twin::{FlightPreset, Twin, TwinConfig},
};
use image::{
    ExtendedColorType, ImageEncoder,
    codecs::{jpeg::JpegEncoder, png::PngEncoder},
};
use indicatif::{ProgressBar, ProgressStyle};
use std::{
    io::Write,
    path::{Path, PathBuf},
};

/// Photos of a flight over a synthetic field, as a project folder with the whole truth.
///
/// Writes what a crew brings home: images/ (JPEG with EXIF: position, moment, lens), gcps.csv (surveyed
/// targets, role control or check), marks.csv (targets clicked in the photos), geolocation.csv, and field.toml
/// (every parameter, for --config). And under truth/ what no crew knows: camera.toml, exterior_orientation.csv,
/// plants.csv, leaves.csv, leaf_axes.csv, rows.csv, plots.csv, weeds.csv, gcps.csv, marks.csv, dem.asc, and the
/// field from straight above (mask.png, picture.png, with world files). Tie points without photos go to
/// tie_points.csv, truth/tie_points.csv and, with start values as from the receiver, to model/ in COLMAP's text
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
    /// Tie points per photo made straight from geometry.
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    tie_points: Option<usize>,
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

/// Runs the verb.
///
/// # Errors
/// A parameter that cannot be used, an output that exists, a file that cannot be read or written.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let config = args.config()?;
    let resolved = toml::to_string(&config).map_err(|e| Error::Argument(e.to_string()))?;
    let twin = config.build()?;
    let folder = Folder { root: &args.output, force: args.force };
    folder.prepare(args, &twin)?;
    folder.text("field.toml", |out| out.write_all(resolved.as_bytes()))?;
    tables(&folder, &twin)?;
    from_above(&folder, &twin)?;
    boards(&folder, &twin, args.boards.into())?;
    if !args.no_photos {
        photos(&folder, &twin, args.photo_truth)?;
    }
    tracing::info!(
        "{}: {} plants, {} photos{}, {} targets, {} marks",
        args.output.display(),
        twin.field().plants.len(),
        twin.shots.len(),
        if args.no_photos { " planned" } else { "" },
        twin.targets.len(),
        twin.marks.len(),
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
        if let Some(count) = self.tie_points {
            config.tie_points.per_photo = count;
        }
        config.check()?;
        Ok(config)
    }
}

/// The project folder.
struct Folder<'a> {
    root: &'a Path,
    force: bool,
}

/// A writer of one table.
type Table = fn(&Twin, &mut dyn Write) -> std::io::Result<()>;

/// Every table, by its place in the folder.
const TABLES: [(&str, Table); 15] = [
    ("gcps.csv", files::gcps),
    ("marks.csv", files::marks),
    ("geolocation.csv", files::geolocation),
    ("truth/gcps.csv", files::true_gcps),
    ("truth/marks.csv", files::true_marks),
    ("truth/camera.toml", files::camera),
    ("truth/exterior_orientation.csv", files::exterior_orientation),
    ("truth/plants.csv", files::plants),
    ("truth/leaves.csv", files::leaves),
    ("truth/leaf_axes.csv", files::leaf_axes),
    ("truth/rows.csv", files::rows),
    ("truth/plots.csv", files::plots),
    ("truth/weeds.csv", files::weeds),
    ("truth/dem.asc", files::dem),
    ("truth/dem.prj", |twin, out| out.write_all(files::projection(twin).as_bytes())),
];
const TIE_TABLES: [&str; 5] = [
    "tie_points.csv",
    "truth/tie_points.csv",
    "model/cameras.txt",
    "model/images.txt",
    "model/points3D.txt",
];
const FROM_ABOVE: [&str; 4] =
    ["truth/mask.png", "truth/picture.png", "truth/mask.pgw", "truth/picture.pgw"];

impl Folder<'_> {
    /// Makes the folders and refuses what is there already, before any work is done.
    fn prepare(&self, args: &Args, twin: &Twin) -> Result<(), Error> {
        let mut folders = vec!["truth"];
        folders.extend((!args.no_photos).then_some("images"));
        folders.extend((twin.config.tie_points.per_photo > 0).then_some("model"));
        folders.extend(args.photo_truth.then_some("truth/photos"));
        folders.extend((args.boards > 0).then_some("calibration"));
        for folder in folders {
            let path = self.root.join(folder);
            std::fs::create_dir_all(&path).map_err(|source| FileError::write(&path, source))?;
        }
        let mut names: Vec<String> = vec!["field.toml".to_owned()];
        names.extend(TABLES.iter().map(|(name, _)| (*name).to_owned()));
        names.extend(FROM_ABOVE.map(str::to_owned));
        if twin.config.tie_points.per_photo > 0 {
            names.extend(TIE_TABLES.map(str::to_owned));
        }
        if !args.no_photos {
            names.extend(twin.shots.iter().map(|shot| format!("images/{}", shot.name)));
        }
        if args.photo_truth {
            let of = |shot: usize| PHOTO_TRUTH.map(|end| photo_truth_name(twin, shot, end));
            names.extend((0..twin.shots.len()).flat_map(of));
        }
        names.extend((0..args.boards.into()).map(board_name));
        for name in names {
            output::check(&self.root.join(name), self.force)?;
        }
        Ok(())
    }

    fn text(
        &self,
        name: &str,
        fill: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
    ) -> Result<(), FileError> {
        output::write(&self.root.join(name), self.force, fill)
    }

    fn png(
        &self,
        name: &str,
        pixels: &[u8],
        (width, height): (u32, u32),
        colour: ExtendedColorType,
    ) -> Result<(), FileError> {
        self.text(name, |out| {
            PngEncoder::new(out)
                .write_image(pixels, width, height, colour)
                .map_err(std::io::Error::other)
        })
    }
}

fn tables(folder: &Folder<'_>, twin: &Twin) -> Result<(), FileError> {
    for (name, table) in TABLES {
        folder.text(name, |out| table(twin, out))?;
    }
    if twin.config.tie_points.per_photo > 0 {
        let points = twin.tie_points();
        folder.text(TIE_TABLES[0], |out| files::tie_points(twin, &points, out))?;
        folder.text(TIE_TABLES[1], |out| files::true_tie_points(twin, &points, out))?;
        folder.text(TIE_TABLES[2], |out| start_model::cameras(twin, out))?;
        folder.text(TIE_TABLES[3], |out| start_model::images(twin, &points, out))?;
        folder.text(TIE_TABLES[4], |out| start_model::points(twin, &points, out))?;
    }
    Ok(())
}

/// The field from straight above: the mask path of `synth mask`, cut from the same field.
fn from_above(folder: &Folder<'_>, twin: &Twin) -> Result<(), FileError> {
    let (mask, picture) = twin.scene.mask_and_picture();
    folder.png(FROM_ABOVE[0], mask.as_raw(), mask.dimensions(), ExtendedColorType::L8)?;
    folder.png(FROM_ABOVE[1], picture.as_raw(), picture.dimensions(), ExtendedColorType::Rgb8)?;
    for name in &FROM_ABOVE[2..] {
        folder.text(name, |out| files::world(twin, &twin.field().frame, out))?;
    }
    Ok(())
}

const PHOTO_TRUTH: [&str; 4] = ["_mask.png", "_plants.png", ".csv", "_leaves.png"];

fn photo_truth_name(twin: &Twin, shot: usize, end: &str) -> String {
    let name = &twin.shots[shot].name;
    let stem = name.split_once('.').map_or(name.as_str(), |(stem, _)| stem);
    format!("truth/photos/{stem}{end}")
}

fn board_name(number: usize) -> String {
    format!("calibration/BOARD_{:03}.JPG", number + 1)
}

fn boards(folder: &Folder<'_>, twin: &Twin, count: usize) -> Result<(), Error> {
    let seed = twin.config.field.seed;
    for (k, pose) in board::poses(BOARD, &twin.camera, count, seed)?.iter().enumerate() {
        let photo = board::photo(BOARD, &twin.camera, pose, seed, k);
        folder.text(&board_name(k), |out| {
            JpegEncoder::new_with_quality(out, 95)
                .encode_image(&photo)
                .map_err(std::io::Error::other)
        })?;
    }
    Ok(())
}

/// Renders photo after photo; while one is rendered, the one before is encoded and written.
fn photos(folder: &Folder<'_>, twin: &Twin, with_truth: bool) -> Result<(), Error> {
    let studio = twin.studio();
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar = ProgressBar::new(twin.shots.len() as u64).with_style(style).with_message("photos");
    let mut waiting: Option<(usize, Photo)> = None;
    for shot in 0..=twin.shots.len() {
        let (written, next) = rayon::join(
            || {
                waiting
                    .as_ref()
                    .map_or(Ok(()), |(at, photo)| save(folder, twin, *at, photo, with_truth))
            },
            || twin.shots.get(shot).map(|from| (shot, studio.photo(from, shot))),
        );
        written?;
        if waiting.is_some() {
            bar.inc(1);
        }
        waiting = next;
    }
    bar.finish_and_clear();
    Ok(())
}

fn save(
    folder: &Folder<'_>,
    twin: &Twin,
    shot: usize,
    photo: &Photo,
    with_truth: bool,
) -> Result<(), FileError> {
    let from = &twin.shots[shot];
    folder.text(&format!("images/{}", from.name), |out| {
        let quality = twin.config.image.jpeg_quality;
        let camera = twin.camera.config();
        out.write_all(&exif::jpeg(&photo.image, quality, from, camera, &twin.site)?)
    })?;
    if with_truth {
        let name = |which: usize| photo_truth_name(twin, shot, PHOTO_TRUTH[which]);
        let size = photo.mask.dimensions();
        folder.png(&name(0), photo.mask.as_raw(), size, ExtendedColorType::L8)?;
        folder.png(&name(1), photo.plants.as_raw(), size, ExtendedColorType::Rgb8)?;
        folder.text(&name(2), |out| files::photo_plants(twin, twin.field(), shot, out))?;
        let coded: Vec<u8> =
            photo.leaves.iter().flat_map(|label| label.to_le_bytes().into_iter().take(3)).collect();
        folder.png(&name(3), &coded, size, ExtendedColorType::Rgb8)?;
    }
    Ok(())
}
