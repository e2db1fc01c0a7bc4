//! Thresholds of leaf pixels for photos: proposed from their colours, tuned on annotated masks, or judged.

mod figure;

use image::{DynamicImage, Rgb, RgbImage, metadata::Orientation};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{
    images::{self, Picture},
    photo,
};
use rowgram_optim::output::FileError;
use rowgram_raster::{
    Mask,
    mask::Thresholds,
    tuning::{self, Colours, Confusion, Index},
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

rowgram_base::options! {
    /// Thresholds of leaf pixels for photos.
    pub struct ThresholdsOptions in "thresholds" {
        /// What a proposal splits: the excess green, or the distance of the hue from green.
        pub index: Index = Index::ExcessGreen;
        /// Where tuning starts, and what is judged where nothing is tuned: hue from, hue to (0 to 180), least saturation, least
        /// value (0 to 255), in 8-bit HSV.
        pub hsv: Thresholds = Thresholds::default(), limits between(0.0, 255.0);
        /// Judge the thresholds of hsv on the masks and tune nothing.
        pub judge: bool = false;
        /// Judge each photo with thresholds tuned on the others.
        pub leave_one_out: bool = false;
        /// Turn photos as their metadata says before masks are laid over them, for masks drawn over what a viewer shows.
        pub as_shown: bool = false;
    }
}

/// Where thresholds come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Origin {
    /// From the colours of the photos alone.
    Proposed,
    /// With the largest intersection over union with the masks.
    Tuned,
    /// As given.
    Given,
}

rowgram_base::choices!(Origin: Proposed, Tuned, Given);

/// How thresholds judge one annotated photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JudgedPhoto {
    /// The photo.
    pub photo: PathBuf,
    /// The thresholds.
    pub hsv: Thresholds,
    /// Intersection over union with its mask.
    pub iou: f64,
    /// Share of the leaf pixels that were found.
    pub true_positive_rate: f64,
    /// Share of the other pixels that were taken for leaf.
    pub false_positive_rate: f64,
}

/// Thresholds for photos.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ThresholdsOutcome {
    /// Where they come from.
    pub origin: Origin,
    /// Hue from, hue to, least saturation, least value, in 8-bit HSV.
    pub hsv: Thresholds,
    /// The annotated photos.
    pub judged: Vec<JudgedPhoto>,
}

/// Photos, and their annotated masks in the same order where there are any.
///
/// A mask has two values, of which the brighter is leaf. A grey picture with softened edges is split at half of its white; in
/// a picture of several classes everything but black is leaf. Masks are laid over photos pixel by pixel as stored.
#[derive(Debug, Clone, Copy)]
pub struct Photos<'a> {
    /// The photos.
    pub photos: &'a [PathBuf],
    /// One mask for each, or none at all.
    pub masks: &'a [PathBuf],
}

/// Proposes thresholds for photos; tunes or judges them where there are masks. `figures` is a folder of pictures, each with its
/// numbers as CSV beside it: `histograms.svg` of hue, saturation and value, and with masks `sweeps.svg`, ROC and IoU of each
/// threshold through its range with the others held; `force` replaces files there.
///
/// # Errors
/// Options that do not go together; pictures that cannot be read or differ in size; figures that cannot be written.
pub fn thresholds(
    input: Photos<'_>,
    options: &ThresholdsOptions,
    figures: Option<(&Path, bool)>,
    monitor: &mut dyn Monitor,
) -> Result<ThresholdsOutcome, Error> {
    check(input, options)?;
    let annotated = !input.masks.is_empty();
    let photos: Vec<RgbImage> = input
        .photos
        .iter()
        .map(|path| read(path, options, annotated, monitor))
        .collect::<Result<_, _>>()?;
    let masks: Vec<Mask> = if annotated {
        input.masks.iter().map(|path| annotation(path)).collect::<Result<_, _>>()?
    } else {
        photos.iter().map(|photo| tuning::split(photo, options.index)).collect()
    };
    let of_one: Vec<Colours> = photos
        .iter()
        .zip(&masks)
        .zip(input.photos)
        .map(|((photo, mask), path)| {
            Colours::of([(photo, mask)])
                .map_err(|error| FileError::malformed(path, None, error.to_string()).into())
        })
        .collect::<Result<_, Error>>()?;
    let all = Colours::joined(&of_one);
    let (origin, hsv) = match (annotated, options.judge) {
        (true, true) => (Origin::Given, options.hsv),
        (true, false) => (Origin::Tuned, all.tune(options.hsv)),
        (false, _) => (Origin::Proposed, all.tune(options.hsv)),
    };
    let mut judged = Vec::new();
    for (k, colours) in of_one.iter().enumerate().filter(|_| annotated) {
        let used = if options.leave_one_out {
            let others = of_one.iter().enumerate().filter(|(other, _)| *other != k);
            Colours::joined(others.map(|(_, colours)| colours)).tune(options.hsv)
        } else {
            hsv
        };
        judged.push(JudgedPhoto::new(&input.photos[k], used, &colours.judge(&used)));
    }
    if let Some((folder, force)) = figures {
        figure::histograms(folder, force, &all, &hsv, annotated)?;
        if annotated {
            figure::sweeps(folder, force, &all, &hsv)?;
        }
    }
    Ok(ThresholdsOutcome { origin, hsv, judged })
}

impl JudgedPhoto {
    fn new(photo: &Path, hsv: Thresholds, confusion: &Confusion) -> JudgedPhoto {
        JudgedPhoto {
            photo: photo.to_owned(),
            hsv,
            iou: confusion.iou(),
            true_positive_rate: confusion.true_positive_rate(),
            false_positive_rate: confusion.false_positive_rate(),
        }
    }
}

/// A photo, turned where that is asked for.
fn read(
    path: &Path,
    options: &ThresholdsOptions,
    annotated: bool,
    monitor: &mut dyn Monitor,
) -> Result<RgbImage, FileError> {
    let picture = images::read_photo(path)?;
    if !annotated && picture.pixels().all(|Rgb([r, g, b])| r == g && g == b) {
        let message = "it has no colours, from which thresholds could be proposed: expected a photo in colours";
        return Err(FileError::malformed(path, None, message));
    }
    let turn = photo::read(path)?.orientation;
    let turn = u8::try_from(turn).ok().and_then(Orientation::from_exif);
    match turn.filter(|turn| *turn != Orientation::NoTransforms) {
        Some(turn) if options.as_shown => {
            let mut picture = DynamicImage::from(picture);
            picture.apply_orientation(turn);
            Ok(picture.into_rgb8())
        }
        Some(_) if annotated => {
            let message = "the photo is stored turned, and its mask is laid over it as stored";
            let remedy = "give --as-shown if the mask was drawn over the photo as viewers show it";
            let found = Diagnostic::warning("photo-turned", path.display().to_string(), message);
            monitor.diagnostic(&found.with_remedy(remedy));
            Ok(picture)
        }
        _ => Ok(picture),
    }
}

/// A mask, one with softened edges, or a picture of classes in which everything but black is leaf.
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

fn check(input: Photos<'_>, options: &ThresholdsOptions) -> Result<(), Error> {
    let (photos, masks) = (input.photos.len(), input.masks.len());
    let refuse = |why: String| Err(Error::Argument(why));
    if photos == 0 {
        return refuse("expected at least one photo".to_owned());
    }
    if masks > 0 && masks != photos {
        return refuse(format!("{masks} masks for {photos} photos, expected one for each"));
    }
    let of_masks = [
        ("judge", options.judge),
        ("leave_one_out", options.leave_one_out),
        ("as_shown", options.as_shown),
    ];
    if let Some((name, _)) = of_masks.iter().find(|(_, given)| *given && masks == 0) {
        return refuse(format!("{name}: needs annotated masks"));
    }
    if options.leave_one_out && options.judge {
        return refuse("judge and leave_one_out exclude each other".to_owned());
    }
    if options.leave_one_out && photos < 2 {
        return refuse("leave_one_out: expected two photos or more".to_owned());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_base::monitor::Silent;

    #[test]
    fn nothing_is_proposed_of_photos_without_colours() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("grey.png");
        let grey = RgbImage::from_fn(40, 30, |u, v| Rgb([(u * v % 251) as u8; 3]));
        images::write_photo(&path, false, &grey).unwrap();
        let photos = Photos { photos: &[path], masks: &[] };
        let outcome = thresholds(photos, &ThresholdsOptions::default(), None, &mut Silent);
        let error = outcome.unwrap_err().to_string();
        assert!(error.contains("grey.png: it has no colours"), "{error}");
    }
}
