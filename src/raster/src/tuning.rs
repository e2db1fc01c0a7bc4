//! Thresholds of the leaf mask from photos: proposed from the colours alone, or tuned against annotated masks.
//!
//! With the counts `TP, FP, FN, TN` of pixels, a set of thresholds is judged by `IoU = TP / (TP + FP + FN)`, and
//! drawn by its `TPR = TP / (TP + FN)` and `FPR = FP / (FP + TN)`. Pixels of one hue, saturation and value share
//! their fate, so they are counted once ([`Colours`]) and a set of thresholds is judged in the time of the distinct
//! colours, not of the pixels.
//!
//! Tuning: Nelder-Mead (argmin) over the four thresholds from several starts, then the best value of each one with the
//! others held, in turn, until none changes. What comes out cannot be improved by changing any one threshold.
//!
//! A proposal splits the excess green `2 g - r - b` of the chromatic coordinates, or the hue's distance from green, by
//! Otsu's threshold, and tunes against that split; it is a proposal, for a person to look at.
//!
//! References: N. Otsu, IEEE Trans. SMC 9, 1979; D. Woebbecke et al., Trans. ASAE 38, 1995 (excess green).

use super::{Mask, hsv, mask::Thresholds, simplex};
use image::RgbImage;
use rowgram_base::error::Error;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// The colours of annotated photos, each with how often it was plant and how often not.
#[derive(Debug, Clone, Default)]
pub struct Colours(Vec<([u8; 3], [u64; 2])>);

/// How thresholds judge annotated pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Confusion {
    /// Plant taken for plant.
    pub true_positive: u64,
    /// Other taken for plant.
    pub false_positive: u64,
    /// Plant taken for other.
    pub false_negative: u64,
    /// Other taken for other.
    pub true_negative: u64,
}

fn share(part: u64, rest: u64) -> f64 {
    if part + rest == 0 { 0.0 } else { part as f64 / (part + rest) as f64 }
}

impl Confusion {
    /// Intersection over union; 0 where there is neither plant nor what was taken for it.
    pub fn iou(&self) -> f64 {
        share(self.true_positive, self.false_positive + self.false_negative)
    }

    /// Share of the plant that was found.
    pub fn true_positive_rate(&self) -> f64 {
        share(self.true_positive, self.false_negative)
    }

    /// Share of the rest that was taken for plant.
    pub fn false_positive_rate(&self) -> f64 {
        share(self.false_positive, self.true_negative)
    }
}

impl Colours {
    /// The colours of photos with their masks.
    ///
    /// # Errors
    /// [`Error::Argument`] where a photo and its mask differ in size.
    pub fn of<'a>(
        pairs: impl IntoIterator<Item = (&'a RgbImage, &'a Mask)>,
    ) -> Result<Colours, Error> {
        let mut counts: HashMap<[u8; 3], [u64; 2]> = HashMap::new();
        for (photo, mask) in pairs {
            let size = (photo.width() as usize, photo.height() as usize);
            if size != (mask.width, mask.height) {
                return Err(Error::Argument(format!(
                    "the mask has {} x {} pixels, the photo {} x {}: expected the same size",
                    mask.width, mask.height, size.0, size.1
                )));
            }
            for (pixel, &plant) in photo.pixels().zip(&mask.data) {
                counts.entry(hsv::from_rgb(pixel.0)).or_default()[usize::from(plant != 0)] += 1;
            }
        }
        let mut colours: Vec<_> = counts.into_iter().collect();
        colours.sort_unstable();
        Ok(Colours(colours))
    }

    /// The colours of several sets of photos together.
    pub fn joined<'a>(parts: impl IntoIterator<Item = &'a Colours>) -> Colours {
        let mut all: Vec<_> = parts.into_iter().flat_map(|part| part.0.iter().copied()).collect();
        all.sort_unstable();
        all.dedup_by(|next, kept| {
            let same = next.0 == kept.0;
            if same {
                (0..2).for_each(|k| kept.1[k] += next.1[k]);
            }
            same
        });
        Colours(all)
    }

    /// Judges thresholds.
    pub fn judge(&self, thresholds: &Thresholds) -> Confusion {
        let mut confusion = Confusion::default();
        for &(colour, [other, plant]) in &self.0 {
            if thresholds.contain(colour) {
                confusion.true_positive += plant;
                confusion.false_positive += other;
            } else {
                confusion.false_negative += plant;
                confusion.true_negative += other;
            }
        }
        confusion
    }

    /// How often each hue (0..180), saturation and value occurs: `[other, plant]`.
    pub fn histograms(&self) -> [[[u64; 2]; 256]; 3] {
        let mut histograms = [[[0; 2]; 256]; 3];
        for &(colour, counts) in &self.0 {
            for (histogram, value) in histograms.iter_mut().zip(colour) {
                for k in 0..2 {
                    histogram[usize::from(value)][k] += counts[k];
                }
            }
        }
        histograms
    }

    /// The thresholds of the largest IoU that are found from `start` and from the usual ones.
    pub fn tune(&self, start: Thresholds) -> Thresholds {
        let mut best = (self.judge(&start).iou(), start);
        for start in [start, Thresholds::default(), wide()] {
            for reach in [[15.0, 15.0, 40.0, 40.0], [-15.0, -15.0, -25.0, -60.0]] {
                let from = values(&start).map(f64::from);
                let cost = |x: &[f64]| 1.0 - thresholds(x).map_or(0.0, |t| self.judge(&t).iou());
                let found = thresholds(&simplex::minimise(cost, &from, &reach, 120));
                let polished = self.polish(found.unwrap_or(start));
                let iou = self.judge(&polished).iou();
                if iou > best.0 {
                    best = (iou, polished);
                }
            }
        }
        best.1
    }

    /// The best value of each threshold in turn, the others held, until none improves.
    fn polish(&self, start: Thresholds) -> Thresholds {
        let mut best = (self.judge(&start).iou(), start);
        loop {
            let before = best.0;
            for index in 0..4 {
                for (_, candidate, confusion) in self.sweep(&best.1, index) {
                    if confusion.iou() > best.0 {
                        best = (confusion.iou(), candidate);
                    }
                }
            }
            if best.0 <= before {
                return best.1;
            }
        }
    }

    /// Every value of one threshold (`index` 0..4) with the others held: value, thresholds, confusion.
    pub fn sweep(&self, held: &Thresholds, index: usize) -> Vec<(u8, Thresholds, Confusion)> {
        // What the other three say is settled once; along the one it is a running sum.
        let range = match index {
            0 => 0..=held.hue_max,
            1 => held.hue_min..=180,
            _ => 0..=255,
        };
        let with = |value: u8| {
            let mut all = values(held);
            all[index] = value;
            Thresholds {
                hue_min: all[0],
                hue_max: all[1],
                saturation_min: all[2],
                value_min: all[3],
            }
        };
        let mut hits = [[0u64; 2]; 257];
        let mut always = [0u64; 2];
        let mut total = [0u64; 2];
        for &([h, s, v], counts) in &self.0 {
            let place = match index {
                0 if h <= held.hue_max && (held.saturation_min <= s || held.value_min <= v) => {
                    Some(usize::from(h))
                }
                1 if held.hue_min <= h && (held.saturation_min <= s || held.value_min <= v) => {
                    Some(usize::from(h))
                }
                2 | 3 if held.hue_min <= h && h <= held.hue_max => {
                    let (own, other) = if index == 2 {
                        (s, held.value_min <= v)
                    } else {
                        (v, held.saturation_min <= s)
                    };
                    // 256: whatever the threshold.
                    Some(if other { 256 } else { usize::from(own) })
                }
                _ => None,
            };
            for k in 0..2 {
                total[k] += counts[k];
                match place {
                    Some(256) => always[k] += counts[k],
                    Some(place) => hits[place][k] += counts[k],
                    None => {}
                }
            }
        }
        range
            .map(|value| {
                let own = usize::from(value);
                let inside = if index == 1 { &hits[..=own] } else { &hits[own..256] };
                let sum = |k: usize| always[k] + inside.iter().map(|counts| counts[k]).sum::<u64>();
                let (false_positive, true_positive) = (sum(0), sum(1));
                let confusion = Confusion {
                    true_positive,
                    false_positive,
                    false_negative: total[1] - true_positive,
                    true_negative: total[0] - false_positive,
                };
                (value, with(value), confusion)
            })
            .collect()
    }
}

/// Any hue between yellow and cyan.
fn wide() -> Thresholds {
    Thresholds { hue_min: 22, hue_max: 100, saturation_min: 50, value_min: 255 }
}

fn values(thresholds: &Thresholds) -> [u8; 4] {
    [thresholds.hue_min, thresholds.hue_max, thresholds.saturation_min, thresholds.value_min]
}

/// The thresholds nearest to four numbers; `None` where the hues are in the wrong order.
fn thresholds(x: &[f64]) -> Option<Thresholds> {
    let whole = |i: usize| x.get(i).map(|x| x.round().clamp(-1000.0, 1000.0) as i64);
    let hue = |i: usize| whole(i).map(|x| x.clamp(0, 180));
    let byte = |i: usize| whole(i).map(|x| x.clamp(0, 255));
    Thresholds::new(hue(0)?, hue(1)?, byte(2)?, byte(3)?).ok()
}

/// The colour index that a proposal splits by Otsu's threshold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Index {
    /// Excess green of the chromatic coordinates.
    ExcessGreen,
    /// The hue's distance from green, for pixels that have one.
    Hue,
}

rowgram_base::choices!(Index: ExcessGreen, Hue);

/// The mask of a photo by Otsu's threshold on an index.
pub fn split(photo: &RgbImage, index: Index) -> Mask {
    let values: Vec<u8> = photo.pixels().map(|pixel| greenness(pixel.0, index)).collect();
    let mut histogram = [0u64; 256];
    values.iter().for_each(|&value| histogram[usize::from(value)] += 1);
    let threshold = otsu(&histogram);
    Mask {
        width: photo.width() as usize,
        height: photo.height() as usize,
        data: values.iter().map(|&value| u8::from(value > threshold)).collect(),
    }
}

/// An index as a byte, larger for plants.
fn greenness(rgb: [u8; 3], index: Index) -> u8 {
    let [r, g, b] = rgb.map(f64::from);
    match index {
        Index::ExcessGreen => {
            // -1 to 2, of which plants use the upper and soil the middle third.
            let excess = (2.0 * g - r - b) / (r + g + b).max(1.0);
            ((excess + 1.0) * 85.0).round() as u8
        }
        Index::Hue => {
            let [hue, saturation, _] = hsv::from_rgb(rgb);
            let from_green = f64::from(hue.abs_diff(60)).min(60.0);
            ((60.0 - from_green) / 60.0 * f64::from(saturation)).round() as u8
        }
    }
}

/// The value that separates a histogram best: values above it are the upper class.
pub fn otsu(histogram: &[u64; 256]) -> u8 {
    let total: u64 = histogram.iter().sum();
    let sum: f64 = histogram.iter().zip(0..).map(|(&n, value)| n as f64 * f64::from(value)).sum();
    let (mut below, mut sum_below) = (0u64, 0.0);
    let mut best = (0.0, 0);
    for value in 0..255u8 {
        below += histogram[usize::from(value)];
        sum_below += histogram[usize::from(value)] as f64 * f64::from(value);
        let above = total - below;
        if below == 0 || above == 0 {
            continue;
        }
        let apart = sum_below / below as f64 - (sum - sum_below) / above as f64;
        let between = below as f64 * above as f64 * apart * apart;
        if between > best.0 {
            best = (between, value);
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;
    use proptest::prelude::*;

    fn colours(pixels: &[(u8, u8, u8, bool)]) -> Colours {
        let photo = RgbImage::from_fn(pixels.len() as u32, 1, |u, _| {
            let (r, g, b, _) = pixels[u as usize];
            Rgb([r, g, b])
        });
        let mask = Mask::from_fn(pixels.len(), 1, |u, _| pixels[u].3);
        Colours::of([(&photo, &mask)]).unwrap()
    }

    proptest! {
        #[test]
        fn a_sweep_judges_as_the_definition(
            pixels in proptest::collection::vec(any::<(u8, u8, u8, bool)>(), 1..60),
            hsv in (0u8..=90, 90u8..=180, any::<u8>(), any::<u8>()), index in 0usize..4,
        ) {
            let colours = colours(&pixels);
            let held = Thresholds {
                hue_min: hsv.0,
                hue_max: hsv.1,
                saturation_min: hsv.2,
                value_min: hsv.3,
            };
            for (_, candidate, confusion) in colours.sweep(&held, index) {
                prop_assert_eq!(confusion, colours.judge(&candidate));
            }
        }
    }

    #[test]
    fn joined_colours_judge_as_the_sum() {
        let (a, b) = ([(60, 160, 50, true), (9, 9, 9, false)], [(60, 160, 50, false)]);
        let joined = Colours::joined([&colours(&a), &colours(&b)]);
        let confusion = joined.judge(&Thresholds::default());
        assert_eq!((confusion.true_positive, confusion.false_positive), (1, 1));
        assert_eq!((confusion.true_negative, joined.0.len()), (1, 2));
    }

    #[test]
    fn tuning_finds_thresholds_that_separate() {
        // Plants of hue 50..70 and saturation above 90 among grey and red soil and pale green stones.
        let mut pixels = Vec::new();
        for i in 0..200u32 {
            let x = (i * 37 % 60) as u8;
            pixels.push((40 + x / 3, 120 + x, 30 + x / 4, true));
            pixels.push((120 + x, 100 + x / 2, 80, false));
            pixels.push((140, 150 + x / 12, 140, false));
        }
        let colours = colours(&pixels);
        let tuned = colours.tune(Thresholds::default());
        assert_eq!(colours.judge(&tuned).iou(), 1.0, "{tuned}");
    }

    #[test]
    fn otsu_separates_two_heaps_and_proposals_find_plants() {
        let mut histogram = [0; 256];
        (10..30).for_each(|value| histogram[value] = 50);
        (200..240).for_each(|value| histogram[value] = 10);
        assert!((29..200).contains(&otsu(&histogram)));
        assert_eq!(otsu(&[0; 256]), 0);
        let photo = RgbImage::from_fn(60, 60, |u, v| {
            let noise = ((7 * u + 13 * v) % 11) as u8;
            if u < 15 {
                Rgb([60 + noise, 140 + noise, 50])
            } else {
                Rgb([150 + noise, 120, 90 + noise])
            }
        });
        for index in [Index::ExcessGreen, Index::Hue] {
            assert_eq!(split(&photo, index), Mask::from_fn(60, 60, |u, _| u < 15));
        }
    }
}
