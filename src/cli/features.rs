//! `rowgram features`: the key points of photos, and `rowgram match`: what two photos have in common.

use super::{print_json, segment::same_file};
use crate::{
    error::Error,
    features::{self, Features, Norm, Options, Upscale, matching},
    io::{self, FileError, images, output},
    raster::sketch,
};
use image::RgbImage;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What is looked for in a photo.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct Search {
    /// The most features kept of a photo, spread over it; 0 keeps all.
    #[arg(long, value_name = "N", default_value_t = Options::default().max_features)]
    max_features: usize,
    /// Least contrast, three times that of a key point, for grey values from 0 to 1.
    #[arg(long, value_name = "X", default_value_t = Options::default().contrast_threshold)]
    contrast: f32,
    /// Largest ratio of the principal curvatures; above it a point lies on an edge.
    #[arg(long, value_name = "R", default_value_t = Options::default().edge_threshold)]
    edge: f32,
    /// Do not enlarge photos before the search: a quarter of the time, without the finest points.
    #[arg(long)]
    no_upscale: bool,
    /// Descriptors of unit length instead of RootSIFT.
    #[arg(long)]
    plain_sift: bool,
}

impl Search {
    fn options(&self) -> Result<Options, Error> {
        if !(self.contrast.is_finite() && self.contrast >= 0.0) {
            let contrast = self.contrast;
            return Err(Error::Argument(format!(
                "--contrast {contrast}: expected a number from 0, such as 0.04"
            )));
        }
        if !(self.edge.is_finite() && self.edge >= 1.0) {
            let edge = self.edge;
            return Err(Error::Argument(format!(
                "--edge {edge}: expected a number from 1, such as 10"
            )));
        }
        Ok(Options {
            max_features: self.max_features,
            upscale: if self.no_upscale { Upscale::None } else { Upscale::Precise },
            norm: if self.plain_sift { Norm::L2 } else { Norm::Root },
            contrast_threshold: self.contrast,
            edge_threshold: self.edge,
        })
    }
}

/// Find the key points of photos and describe them (SIFT)
///
/// Writes for each photo NAME.features (for the program) and NAME.features.csv: position from the
/// centre of the top-left pixel, blur, direction from the u axis towards the v axis, contrast. With
/// --overlay also NAME.features.png, where circles have three times the key points' blur.
///
/// Example: rowgram features flight/*.jpg -o features --max-features 4000 --overlay
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// The photos (PNG, JPEG or TIFF).
    #[arg(required = true)]
    images: Vec<PathBuf>,
    /// Folder to write to; it is made where it does not exist.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    search: Search,
    /// Also draw the key points on each photo.
    #[arg(long)]
    overlay: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Print what was found as one line of JSON for each photo.
    #[arg(long)]
    json: bool,
}

/// What `--json` prints for a photo.
#[derive(Serialize)]
struct Summary<'a> {
    image: &'a Path,
    output: &'a Path,
    width_px: u32,
    height_px: u32,
    features: usize,
    options: Options,
}

/// Runs `rowgram features`.
///
/// # Errors
/// Where an argument, a photo or an output path cannot be used, or writing fails.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let options = args.search.options()?;
    let outputs = outputs(args)?;
    std::fs::create_dir_all(&args.output).map_err(|e| FileError::write(&args.output, e))?;
    for paths in &outputs {
        for path in [Some(&paths.binary), Some(&paths.table), paths.picture.as_ref()] {
            path.map_or(Ok(()), |path| output::check(path, args.force))?;
        }
    }
    for (image, paths) in args.images.iter().zip(&outputs) {
        let bytes = std::fs::read(image).map_err(|error| FileError::read(image, error))?;
        let key = io::features::key(&bytes, &options);
        let mut photo = images::read_photo(image)?;
        let found = features::detect(&features::grey(&photo), &options);
        if found.key_points.is_empty() {
            tracing::warn!("{}: no feature was found; is it blurred or flat?", image.display());
        }
        io::features::write(&paths.binary, args.force, key, &found)?;
        write_table(&paths.table, args.force, &found)?;
        if let Some(path) = &paths.picture {
            sketch::draw_key_points(&mut photo, &found.key_points);
            images::write_photo(path, args.force, &photo)?;
        }
        if args.json {
            print_json(&Summary {
                image,
                output: &paths.binary,
                width_px: found.width_px,
                height_px: found.height_px,
                features: found.key_points.len(),
                options,
            })?;
        } else {
            let (count, path) = (found.key_points.len(), paths.binary.display());
            tracing::info!("{path}: {count} features");
        }
    }
    Ok(())
}

/// Where the results of a photo go.
struct Outputs {
    binary: PathBuf,
    table: PathBuf,
    picture: Option<PathBuf>,
}

fn outputs(args: &Args) -> Result<Vec<Outputs>, Error> {
    let mut names: Vec<(&std::ffi::OsStr, &Path)> = Vec::new();
    let mut found = Vec::new();
    for image in &args.images {
        let Some(name) = image.file_stem() else {
            let image = image.display();
            return Err(Error::Argument(format!("{image}: expected the path of a photo")));
        };
        if let Some((_, other)) = names.iter().find(|(taken, _)| *taken == name) {
            let (image, other) = (image.display(), other.display());
            return Err(Error::Argument(format!(
                "{other} and {image} would have the same output; give them in two calls"
            )));
        }
        names.push((name, image));
        let path = |end: &str| {
            let mut name = name.to_owned();
            name.push(end);
            args.output.join(name)
        };
        found.push(Outputs {
            binary: path(".features"),
            table: path(".features.csv"),
            picture: args.overlay.then(|| path(".features.png")),
        });
    }
    Ok(found)
}

fn write_table(path: &Path, force: bool, found: &Features) -> Result<(), FileError> {
    output::write(path, force, |file| {
        writeln!(file, "u_px,v_px,sigma_px,angle_rad,response")?;
        for point in &found.key_points {
            let features::KeyPoint { u_px, v_px, sigma_px, angle_rad, response } = point;
            writeln!(file, "{u_px},{v_px},{sigma_px},{angle_rad},{response}")?;
        }
        Ok(())
    })
}

/// Find what two photos have in common, by their features alone
///
/// Writes a CSV of the positions in both photos and the distance of the descriptors (their length
/// taken as 1). A match is the nearest in both directions, and clearly nearer than the second nearest.
/// No geometry is asked, so some are wrong: look at them with --picture.
///
/// Example: rowgram match one.jpg other.jpg -o matches.csv --picture matches.png
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct MatchArgs {
    /// The first photo (PNG, JPEG or TIFF).
    first: PathBuf,
    /// The second photo.
    second: PathBuf,
    /// Where to write the matches.
    #[arg(short, long, value_name = "CSV")]
    output: PathBuf,
    /// Also draw both photos with a line for each match.
    #[arg(long, value_name = "PNG")]
    picture: Option<PathBuf>,
    #[command(flatten)]
    search: Search,
    /// Largest distance relative to that of the second nearest, from 0 to 1.
    #[arg(long, value_name = "X", default_value_t = matching::MatchOptions::default().ratio)]
    ratio: f32,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Print what was found as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// What `--json` prints for a pair.
#[derive(Serialize)]
struct MatchSummary<'a> {
    first: &'a Path,
    second: &'a Path,
    output: &'a Path,
    features: [usize; 2],
    matches: usize,
}

/// Runs `rowgram match`.
///
/// # Errors
/// Where an argument, a photo or an output path cannot be used, or writing fails.
pub(super) fn run_match(args: &MatchArgs) -> Result<(), Error> {
    let options = args.search.options()?;
    if !(args.ratio > 0.0 && args.ratio <= 1.0) {
        let ratio = args.ratio;
        return Err(Error::Argument(format!("--ratio {ratio}: expected a number from 0 to 1")));
    }
    for path in [Some(&args.output), args.picture.as_ref()].into_iter().flatten() {
        if same_file(path, &args.first) || same_file(path, &args.second) {
            let path = path.display();
            return Err(Error::Argument(format!("{path} is a photo, expected another output")));
        }
        output::check(path, args.force)?;
    }
    if let Some(picture) = args.picture.as_ref().filter(|path| same_file(path, &args.output)) {
        let picture = picture.display();
        return Err(Error::Argument(format!("{picture} is given for two outputs")));
    }
    let load = |path: &Path| -> Result<(RgbImage, Features), Error> {
        let photo = images::read_photo(path)?;
        let found = features::detect(&features::grey(&photo), &options);
        Ok((photo, found))
    };
    let (first, second) = (load(&args.first)?, load(&args.second)?);
    let rule = matching::MatchOptions { ratio: args.ratio, ..Default::default() };
    let matches = matching::match_descriptors(&first.1.descriptors, &second.1.descriptors, &rule);
    output::write(&args.output, args.force, |file| {
        writeln!(file, "first_u_px,first_v_px,second_u_px,second_v_px,distance")?;
        for m in &matches {
            let a = &first.1.key_points[m.first as usize];
            let b = &second.1.key_points[m.second as usize];
            let distance = f64::from(m.distance_squared).sqrt() / 512.0;
            let (u, v, x, y) = (a.u_px, a.v_px, b.u_px, b.v_px);
            writeln!(file, "{u},{v},{x},{y},{distance:.4}")?;
        }
        Ok(())
    })?;
    if let Some(path) = &args.picture {
        let picture = sketch::correspondences(
            (&first.0, &first.1.key_points),
            (&second.0, &second.1.key_points),
            &matches,
        );
        images::write_photo(path, args.force, &picture)?;
    }
    let features = [first.1.key_points.len(), second.1.key_points.len()];
    if args.json {
        return print_json(&MatchSummary {
            first: &args.first,
            second: &args.second,
            output: &args.output,
            features,
            matches: matches.len(),
        });
    }
    let ([one, other], count) = (features, matches.len());
    let path = args.output.display();
    tracing::info!("{path}: {count} matches of {one} and {other} features");
    Ok(())
}
