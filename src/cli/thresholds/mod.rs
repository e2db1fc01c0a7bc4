//! `rowgram thresholds`: four thresholds for the leaf mask.

mod figure;

use super::{leaves::check_paths, print, print_json};
use crate::{
    error::Error,
    io::{
        FileError,
        images::{self, Picture},
        output, photo,
    },
    raster::{
        Mask,
        mask::Thresholds,
        tuning::{self, Colours, Confusion, Index},
    },
};
use image::{DynamicImage, Rgb, RgbImage, metadata::Orientation};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Propose, tune or judge the thresholds of the leaf mask
///
/// Without masks: a proposal from the photos' colours alone (Otsu's threshold on the excess green or on the hue),
/// for a person to look at and to give to the other commands as --tau. With one mask per photo: the thresholds of
/// the largest IoU; with --judge those given by --tau are judged only. With --leave-one-out each photo is judged
/// with thresholds tuned on all the others.
///
/// A mask has two values, of which the brighter is plant. A grey picture with softened edges is split at half of its
/// white; in a picture of several classes everything but 0 is plant. Masks are laid over photos pixel by pixel as
/// stored; --as-shown first turns the photos as their metadata says, for masks drawn over what a viewer shows.
///
/// Example: rowgram thresholds a.jpg b.jpg --masks a.png,b.png --leave-one-out --sweep roc.svg
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Photos.
    #[arg(required = true)]
    photos: Vec<PathBuf>,
    /// Their annotated masks, in the same order.
    #[arg(long, value_name = "FILE[,FILE...]", value_delimiter = ',')]
    masks: Vec<PathBuf>,
    /// Turn photos as their metadata says before masks are laid over them.
    #[arg(long, requires = "masks")]
    as_shown: bool,
    /// What a proposal splits: excess-green or hue.
    #[arg(long, value_name = "INDEX", default_value = "excess-green", value_parser = index)]
    index: Index,
    /// Where tuning starts, and what --judge judges.
    #[arg(
        long,
        value_name = "TAU1,TAU2,TAU3,TAU4",
        default_value = "30,79,30,163",
        allow_hyphen_values = true
    )]
    tau: Thresholds,
    /// Judge --tau on the masks, tune nothing.
    #[arg(long, requires = "masks", conflicts_with = "leave_one_out")]
    judge: bool,
    /// Judge each photo with thresholds tuned on the others.
    #[arg(long, requires = "masks")]
    leave_one_out: bool,
    /// Draw histograms of hue, saturation and value (SVG; a CSV of the same name beside it).
    #[arg(long, value_name = "SVG")]
    histogram: Option<PathBuf>,
    /// Draw ROC and IoU curves, each threshold through its range with the others held (SVG; a CSV of the same name
    /// beside it).
    #[arg(long, value_name = "SVG", requires = "masks")]
    sweep: Option<PathBuf>,
    /// Print the result as one line of JSON.
    #[arg(long)]
    json: bool,
    /// Replace outputs that exist.
    #[arg(long)]
    force: bool,
}

fn index(word: &str) -> Result<Index, String> {
    match word {
        "excess-green" => Ok(Index::ExcessGreen),
        "hue" => Ok(Index::Hue),
        _ => Err("expected one of: excess-green, hue".to_owned()),
    }
}

#[derive(Serialize)]
struct Judged {
    photo: PathBuf,
    tau: String,
    iou: f64,
    true_positive_rate: f64,
    false_positive_rate: f64,
}

#[derive(Serialize)]
struct Summary {
    /// `proposed`, `tuned` or `given`.
    origin: &'static str,
    tau: String,
    judged: Vec<Judged>,
}

/// Runs the verb.
///
/// # Errors
/// Where an argument, an input or an output cannot be used.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    check(args)?;
    let photos: Vec<RgbImage> =
        args.photos.iter().map(|path| read(path, args)).collect::<Result<_, _>>()?;
    let annotated = !args.masks.is_empty();
    let masks: Vec<Mask> = if annotated {
        args.masks.iter().map(|path| annotation(path)).collect::<Result<_, _>>()?
    } else {
        photos.iter().map(|photo| tuning::split(photo, args.index)).collect()
    };
    let of_one: Vec<Colours> = photos
        .iter()
        .zip(&masks)
        .zip(&args.photos)
        .map(|((photo, mask), path)| {
            Colours::of([(photo, mask)])
                .map_err(|error| FileError::malformed(path, None, error.to_string()).into())
        })
        .collect::<Result<_, Error>>()?;
    let all = Colours::joined(&of_one);
    let (origin, tau) = match (annotated, args.judge) {
        (true, true) => ("given", args.tau),
        (true, false) => ("tuned", all.tune(args.tau)),
        (false, _) => ("proposed", all.tune(args.tau)),
    };
    let mut judged = Vec::new();
    for (k, colours) in of_one.iter().enumerate().filter(|_| annotated) {
        let used = if args.leave_one_out {
            let others = of_one.iter().enumerate().filter(|(other, _)| *other != k);
            Colours::joined(others.map(|(_, colours)| colours)).tune(args.tau)
        } else {
            tau
        };
        judged.push(line(&args.photos[k], &used, &colours.judge(&used)));
    }
    if let Some(path) = &args.histogram {
        figure::histograms(path, args.force, &all, &tau, annotated)?;
    }
    if let Some(path) = &args.sweep {
        figure::sweeps(path, args.force, &all, &tau)?;
    }
    let summary = Summary { origin, tau: tau.to_string(), judged };
    if args.json {
        return print_json(&summary);
    }
    let mut text = format!("--tau {}  ({origin})\n", summary.tau);
    for judged in &summary.judged {
        text += &format!(
            "{}: IoU {:.4}, TPR {:.4}, FPR {:.4} with {}\n",
            judged.photo.display(),
            judged.iou,
            judged.true_positive_rate,
            judged.false_positive_rate,
            judged.tau
        );
    }
    print(&text)
}

fn line(photo: &Path, tau: &Thresholds, confusion: &Confusion) -> Judged {
    Judged {
        photo: photo.to_owned(),
        tau: tau.to_string(),
        iou: confusion.iou(),
        true_positive_rate: confusion.true_positive_rate(),
        false_positive_rate: confusion.false_positive_rate(),
    }
}

/// A photo, turned where that is asked for.
fn read(path: &Path, args: &Args) -> Result<RgbImage, FileError> {
    let picture = images::read_photo(path)?;
    let turn = photo::read(path)?.orientation;
    let turn = u8::try_from(turn).ok().and_then(Orientation::from_exif);
    match turn.filter(|turn| *turn != Orientation::NoTransforms) {
        Some(turn) if args.as_shown => {
            let mut picture = DynamicImage::from(picture);
            picture.apply_orientation(turn);
            Ok(picture.into_rgb8())
        }
        Some(_) if !args.masks.is_empty() => {
            tracing::warn!(
                "{}: stored turned; if its mask was drawn over the photo as viewers show it, give --as-shown",
                path.display()
            );
            Ok(picture)
        }
        _ => Ok(picture),
    }
}

/// A mask, one with softened edges, or a picture of classes in which everything but black is plant.
fn annotation(path: &Path) -> Result<Mask, FileError> {
    Ok(match images::read(path)? {
        Picture::Mask(mask) => mask,
        Picture::Photo(classes) => {
            let grey = classes.pixels().all(|Rgb([r, g, b])| r == g && g == b);
            let white = classes.pixels().any(|p| p.0[0] == 255);
            let least = if grey && white { 128 } else { 1 };
            let data = classes
                .pixels()
                .map(|p| u8::from(p.0.iter().any(|&value| value >= least)))
                .collect();
            Mask { width: classes.width() as usize, height: classes.height() as usize, data }
        }
    })
}

fn check(args: &Args) -> Result<(), Error> {
    if !args.masks.is_empty() && args.masks.len() != args.photos.len() {
        return Err(Error::Argument(format!(
            "--masks: {} masks for {} photos, expected one for each",
            args.masks.len(),
            args.photos.len()
        )));
    }
    if args.leave_one_out && args.photos.len() < 2 {
        return Err(Error::Argument("--leave-one-out: expected two photos or more".to_owned()));
    }
    let figures: Vec<&PathBuf> =
        [&args.histogram, &args.sweep].into_iter().filter_map(Option::as_ref).collect();
    if let Some(path) = figures.iter().find(|path| path.extension().is_none_or(|e| e != "svg")) {
        return Err(Error::Argument(format!(
            "{}: expected a name that ends in .svg",
            path.display()
        )));
    }
    let tables: Vec<PathBuf> = figures.iter().map(|path| path.with_extension("csv")).collect();
    let outputs: Vec<&Path> = figures.into_iter().chain(&tables).map(PathBuf::as_path).collect();
    let inputs: Vec<&Path> = args.photos.iter().chain(&args.masks).map(PathBuf::as_path).collect();
    check_paths(&outputs, &inputs, args.force)
}

/// Writes a figure and its table.
fn write(path: &Path, force: bool, svg: &str, csv: &str) -> Result<(), FileError> {
    output::write(path, force, |out| out.write_all(svg.as_bytes()))?;
    output::write(&path.with_extension("csv"), force, |out| out.write_all(csv.as_bytes()))
}
