//! What one photo says of a plot.

use crate::{
    Project, Stage,
    leaf_mask::SWEEPS,
    segment::{SegmentOptions, SegmentOutcome},
};
use image::RgbImage;
use rowgram_base::error::Error;
use rowgram_optim::output::FileError;
use rowgram_plants::phenotype::colour_indices::ColourSum;
use rowgram_raster::{
    Mask, components,
    mask::Thresholds,
    polygon::Polygon,
    vegetation::{self, Coherence, Model},
};
use serde::{Deserialize, Serialize};

/// Traits of a plot in one photo; `None` where a trait is not known.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct PhotoTraits {
    /// Standard deviation of the Laplacian of the grey picture over that of the picture itself: smaller where it is blurred.
    pub sharpness: Option<f64>,
    /// Share of the plot that leaves cover.
    pub canopy_cover: Option<f64>,
    /// Excess green of the leaf pixels.
    pub exg: Option<f64>,
    /// Green leaf index of the leaf pixels.
    pub gli: Option<f64>,
    /// Normalized green-red difference index of the leaf pixels.
    pub ngrdi: Option<f64>,
    /// Visible atmospherically resistant index of the leaf pixels.
    pub vari: Option<f64>,
    /// Triangular greenness index of the leaf pixels.
    pub tgi: Option<f64>,
    /// a* of the mean colour of the leaf pixels.
    pub a_star: Option<f64>,
}

/// A column of the tables and its value.
pub(super) type Column = (&'static str, fn(&PhotoTraits) -> Option<f64>);

/// The traits that are averaged over photos, as they are named in the tables of plots.
pub(super) const COLUMNS: [Column; 7] = [
    ("canopy_cover", |of| of.canopy_cover),
    ("exg", |of| of.exg),
    ("gli", |of| of.gli),
    ("ngrdi", |of| of.ngrdi),
    ("vari", |of| of.vari),
    ("tgi", |of| of.tgi),
    ("a_star", |of| of.a_star),
];

/// How leaf pixels of a photo are told: as those of the orthomosaic were.
pub(super) struct LeafRule {
    class: Class,
    options: SegmentOptions,
}

enum Class {
    Vegetation(Model),
    Hsv(Thresholds),
}

impl LeafRule {
    /// The rule of the stage `segment`; `None` where it was not done.
    ///
    /// # Errors
    /// A record that is damaged.
    pub(super) fn of(project: &Project) -> Result<Option<LeafRule>, Error> {
        let Some(record) = project.records().read(Stage::Segment) else { return Ok(None) };
        let path = project.folder(Stage::Segment);
        let damaged = |e: serde_json::Error| {
            FileError::malformed(&path, None, format!("its record is damaged ({e}); make it again"))
        };
        let options: SegmentOptions = serde_json::from_value(record.options).map_err(damaged)?;
        let outcome: SegmentOutcome = serde_json::from_value(record.outcome).map_err(damaged)?;
        let class = match (outcome.vegetation, outcome.hsv) {
            (Some(model), _) => Class::Vegetation(model),
            (None, Some(hsv)) => Class::Hsv(hsv),
            (None, None) => return Ok(None),
        };
        Ok(Some(LeafRule { class, options }))
    }

    /// Leaf pixels of a picture that lies at a place of the orthomosaic, -1 to 1 of its width and height.
    fn mask(&self, picture: &RgbImage, shown: &Mask, place: [f64; 2]) -> Result<Mask, Error> {
        let mut mask = match &self.class {
            Class::Hsv(hsv) => hsv.mask(picture),
            Class::Vegetation(model) => {
                let coherence = match self.options.coherence {
                    0.0 => Coherence::None,
                    weight => Coherence::Icm { weight, sweeps: SWEEPS },
                };
                vegetation::classify(picture, Some(shown), &model.at(place), coherence)
                    .map_err(|why| Error::Argument(why.to_string()))?
            }
        };
        components::remove_small(&mut mask, self.options.min_pixels);
        components::fill_holes(&mut mask, self.options.fill_holes);
        Ok(mask)
    }
}

impl PhotoTraits {
    /// Traits of an area of a picture, of which `shown` are the pixels with a colour.
    pub(super) fn of(
        picture: &RgbImage,
        shown: &Mask,
        area: &Polygon,
        rule: Option<&LeafRule>,
        place: [f64; 2],
    ) -> Result<PhotoTraits, Error> {
        let sharpness = sharpness(picture, shown);
        let Some(rule) = rule else { return Ok(PhotoTraits { sharpness, ..Default::default() }) };
        let mask = rule.mask(picture, shown, place)?;
        let mut sum = ColourSum::default();
        let mut pixels = 0_u64;
        for (v, run) in area.runs(mask.width, mask.height) {
            for u in run.filter(|&u| shown.get(u, v)) {
                pixels += 1;
                if mask.get(u, v) {
                    sum.add(picture.get_pixel(u as u32, v as u32).0);
                }
            }
        }
        let indices = sum.indices();
        Ok(PhotoTraits {
            sharpness,
            canopy_cover: (pixels > 0).then(|| sum.pixels as f64 / pixels as f64),
            exg: indices.map(|of| of.exg),
            gli: indices.map(|of| of.gli),
            ngrdi: indices.and_then(|of| of.ngrdi),
            vari: indices.and_then(|of| of.vari),
            tgi: indices.map(|of| of.tgi),
            a_star: indices.map(|of| of.a_star),
        })
    }
}

/// Standard deviation of the Laplacian (four neighbours) over that of the picture, both in grey; `None` where all is alike.
fn sharpness(picture: &RgbImage, shown: &Mask) -> Option<f64> {
    let (width, height) = (shown.width, shown.height);
    let grey = |u: usize, v: usize| {
        let [r, g, b] = picture.get_pixel(u as u32, v as u32).0.map(f64::from);
        0.299 * r + 0.587 * g + 0.114 * b
    };
    let (mut count, mut sums) = (0.0_f64, [0.0; 4]);
    for v in 1..height.saturating_sub(1) {
        for u in 1..width.saturating_sub(1) {
            let around = [(u - 1, v), (u + 1, v), (u, v - 1), (u, v + 1)];
            if !shown.get(u, v) || around.iter().any(|&(u, v)| !shown.get(u, v)) {
                continue;
            }
            let here = grey(u, v);
            let laplacian = around.iter().map(|&(u, v)| grey(u, v)).sum::<f64>() - 4.0 * here;
            count += 1.0;
            for (sum, value) in
                sums.iter_mut().zip([here, here * here, laplacian, laplacian * laplacian])
            {
                *sum += value;
            }
        }
    }
    let variance = |first: usize| sums[first + 1] / count - (sums[first] / count).powi(2);
    (count > 0.0 && variance(0) > 1e-9).then(|| (variance(2).max(0.0) / variance(0)).sqrt())
}

/// Mean of the values that are known, and their standard deviation where there are two or more.
pub(super) fn mean_and_deviation(
    values: impl Iterator<Item = Option<f64>>,
) -> (Option<f64>, Option<f64>) {
    use statrs::statistics::Statistics;
    let known: Vec<f64> = values.flatten().collect();
    let mean = (!known.is_empty()).then(|| (&known).mean());
    (mean, (known.len() > 1).then(|| (&known).std_dev()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn a_blurred_picture_is_less_sharp() {
        let sharp = RgbImage::from_fn(60, 40, |u, v| {
            Rgb([if (u / 4 + v / 4) % 2 == 0 { 40 } else { 200 }; 3])
        });
        let soft = image::imageops::blur(&sharp, 2.0);
        let all = Mask::from_fn(60, 40, |_, _| true);
        let of = |picture: &RgbImage| sharpness(picture, &all).unwrap();
        assert!(of(&sharp) > 2.0 * of(&soft), "{} {}", of(&sharp), of(&soft));
        assert_eq!(sharpness(&RgbImage::new(60, 40), &all), None);
        assert_eq!(sharpness(&RgbImage::new(1, 1), &Mask::from_fn(1, 1, |_, _| true)), None);
    }

    #[test]
    fn scatter_needs_two_photos() {
        assert_eq!(mean_and_deviation([None, None].into_iter()), (None, None));
        assert_eq!(mean_and_deviation([Some(2.0), None].into_iter()), (Some(2.0), None));
        let (mean, deviation) = mean_and_deviation([Some(1.0), Some(3.0)].into_iter());
        assert_eq!((mean, deviation), (Some(2.0), Some(2.0_f64.sqrt())));
    }
}
