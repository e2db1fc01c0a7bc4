//! `rowgram align features`: the key points of photos, and `rowgram align match`: what two photos have in common.

use super::project;
use rowgram_base::error::Error;
use rowgram_project::features::{write_features, write_matches};
use rowgram_survey::features::{FeatureOptions, Norm, Upscale, matching};
use std::path::PathBuf;

/// What is looked for in a photo.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct Search {
    /// The most features kept of a photo, spread over it; 0 keeps all.
    #[arg(long, value_name = "N", default_value_t = FeatureOptions::default().max_features)]
    max_features: usize,
    /// Least contrast, three times that of a key point, for grey values from 0 to 1.
    #[arg(long, value_name = "X", default_value_t = FeatureOptions::default().contrast_threshold)]
    contrast: f32,
    /// Largest ratio of the principal curvatures; above it a point lies on an edge.
    #[arg(long, value_name = "R", default_value_t = FeatureOptions::default().edge_threshold)]
    edge: f32,
    /// Do not enlarge photos before the search: a quarter of the time, without the finest points.
    #[arg(long)]
    no_upscale: bool,
    /// Descriptors of unit length instead of RootSIFT.
    #[arg(long)]
    plain_sift: bool,
}

impl Search {
    fn options(&self) -> Result<FeatureOptions, Error> {
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
        Ok(FeatureOptions {
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
/// Writes for each photo NAME.features.csv: position from the centre of the top-left pixel, blur,
/// direction from the u axis towards the v axis, contrast. With --figures also NAME.features.png,
/// where circles have three times the key points' blur.
///
/// Example: rowgram align features flight/*.jpg -o features --max-features 4000 --figures figures
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
    /// Folder for pictures: the key points on each photo.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs `rowgram align features`.
///
/// # Errors
/// Where an argument, a photo or an output path cannot be used, or writing fails.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let options = args.search.options()?;
    let (photos, folder, figures) = (&args.images, &args.output, args.figures.as_deref());
    project::present(
        args.json,
        |monitor| write_features(photos, &options, folder, figures, args.force, monitor),
        |found| {
            let line = |photo: &rowgram_project::features::PhotoFeatures| {
                format!("{}: {} features\n", photo.output.display(), photo.features)
            };
            found.photos.iter().map(line).collect()
        },
    )
}

/// Find what two photos have in common, by their features alone
///
/// Writes a CSV of the positions in both photos and the distance of the descriptors (their length
/// taken as 1). A match is the nearest in both directions and passes the ratio test. No geometry is
/// checked, so some are wrong: look at them with --figures.
///
/// Example: rowgram align match one.jpg other.jpg -o matches.csv --figures figures
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
    /// Folder for matches.png: both photos with a line for each match.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    #[command(flatten)]
    search: Search,
    /// Largest distance relative to that of the second nearest, from 0 to 1.
    #[arg(long, value_name = "X", default_value_t = matching::MatchOptions::default().ratio)]
    ratio: f32,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// Runs `rowgram align match`.
///
/// # Errors
/// Where an argument, a photo or an output path cannot be used, or writing fails.
pub(super) fn run_match(args: &MatchArgs) -> Result<(), Error> {
    let options = args.search.options()?;
    let (pair, path) = ([args.first.as_path(), args.second.as_path()], &args.output);
    let figures = args.figures.as_deref();
    project::present(
        args.json,
        |_| write_matches(pair, &options, args.ratio, path, figures, args.force),
        |found| {
            let ([one, other], count) = (found.features, found.matches);
            format!("{}: {count} matches of {one} and {other} features", path.display())
        },
    )
}
