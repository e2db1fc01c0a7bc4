//! The leaf mask: four thresholds on hue, saturation and value.
//!
//! ```text
//! Y = 1  where  tau1 <= H <= tau2  and  (tau3 <= S  or  tau4 <= V),
//! ```
//!
//! with `H` in half degrees, 0..=180, and `S`, `V` in 0..=255 ([`super::hsv`]). A person writes the four thresholds as one
//! list, `hsv = [30, 79, 30, 163]` or `--hsv 30,79,30,163`. The defaults 30, 79,
//! 30, 163 are those published for photos of sorghum on 24 June 2015.
//!
//! No HSV picture is made: the thresholds are scaled to the fixed-point numbers of the conversion and
//! compared before these are rounded to bytes. A pixel is in the mask exactly if its 8-bit HSV is
//! within the thresholds.
//!
//! Reference: Ribera, He, Chen, Habib, Delp, "Estimating phenotypic traits from UAV based RGB
//! imagery", KDD 2016 workshop on data science for food, energy and water.

use super::{
    Mask,
    hsv::Scaled,
    pixels::{self, BLOCK, Channel, PerBlock},
};
use image::RgbImage;
use rowgram_base::{error::Error, options};
use serde::{Deserialize, Serialize};

/// The four thresholds of the leaf mask, `tau1` to `tau4` of the paper; `[hue_min, hue_max, saturation_min, value_min]` in
/// files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "[i64; 4]", into = "[u8; 4]")]
pub struct Thresholds {
    /// Least hue, in half degrees (0..=180).
    pub hue_min: u8,
    /// Largest hue, in half degrees (`hue_min`..=180).
    pub hue_max: u8,
    /// Saturation from which a pixel of the right hue is leaf.
    pub saturation_min: u8,
    /// Value from which a pixel of the right hue is leaf, however pale.
    pub value_min: u8,
}

impl Default for Thresholds {
    fn default() -> Thresholds {
        Thresholds { hue_min: 30, hue_max: 79, saturation_min: 30, value_min: 163 }
    }
}

impl TryFrom<[i64; 4]> for Thresholds {
    type Error = Error;

    fn try_from([hue_min, hue_max, saturation, value]: [i64; 4]) -> Result<Thresholds, Error> {
        Thresholds::new(hue_min, hue_max, saturation, value)
    }
}

impl From<Thresholds> for [u8; 4] {
    fn from(thresholds: Thresholds) -> [u8; 4] {
        let Thresholds { hue_min, hue_max, saturation_min, value_min } = thresholds;
        [hue_min, hue_max, saturation_min, value_min]
    }
}

impl options::Value for Thresholds {
    fn kind() -> options::Kind {
        options::Kind::Several(Box::new(options::Kind::Whole), 4)
    }
}

impl Thresholds {
    /// Checked thresholds.
    ///
    /// # Errors
    /// [`Error::Argument`] unless `0 <= hue_min <= hue_max <= 180`, and saturation and value are in 0..=255.
    pub fn new(
        hue_min: i64,
        hue_max: i64,
        saturation_min: i64,
        value_min: i64,
    ) -> Result<Thresholds, Error> {
        let within = |name: &str, value: i64, largest: u8| {
            u8::try_from(value).ok().filter(|&value| value <= largest).ok_or_else(|| {
                Error::Argument(format!(
                    "the {name} is {value}, expected a number from 0 to {largest}"
                ))
            })
        };
        let hue_min = within("least hue", hue_min, 180)?;
        let hue_max = within("largest hue", hue_max, 180)?;
        if hue_min > hue_max {
            return Err(Error::Argument(format!(
                "the least hue {hue_min} is above the largest hue {hue_max}"
            )));
        }
        let saturation_min = within("least saturation", saturation_min, 255)?;
        let value_min = within("least value", value_min, 255)?;
        Ok(Thresholds { hue_min, hue_max, saturation_min, value_min })
    }

    /// Whether a colour with this hue, saturation and value is leaf.
    pub fn contain(&self, [h, s, v]: [u8; 3]) -> bool {
        self.hue_min <= h && h <= self.hue_max && (self.saturation_min <= s || self.value_min <= v)
    }

    /// The mask of a photo.
    ///
    /// ```
    /// use rowgram_raster::mask::Thresholds;
    /// let photo = image::RgbImage::from_raw(2, 1, vec![60, 160, 50, 120, 100, 80]).unwrap();
    /// assert_eq!(Thresholds::default().mask(&photo).data, [1, 0]);
    /// ```
    pub fn mask(&self, photo: &RgbImage) -> Mask {
        let mut mask = Mask::empty(photo.width() as usize, photo.height() as usize);
        pixels::map(&Fused::from(*self), photo.as_raw(), &mut mask.data);
        mask
    }
}

/// The thresholds on the scale of the conversion.
struct Fused {
    hue_from: f32,
    hue_below: f32,
    saturation: f32,
    value: i16,
}

impl From<Thresholds> for Fused {
    fn from(thresholds: Thresholds) -> Fused {
        // A number comes to `t` when rounded if it is at least `t - 1/2` steps.
        let least = |t: u8| f32::from(t) * Scaled::STEP - Scaled::HALF;
        Fused {
            hue_from: least(thresholds.hue_min),
            hue_below: least(thresholds.hue_max) + Scaled::STEP,
            saturation: least(thresholds.saturation_min),
            value: i16::from(thresholds.value_min),
        }
    }
}

impl PerBlock for Fused {
    #[inline(always)]
    fn block(&self, red: &Channel, green: &Channel, blue: &Channel, out: &mut [u8; BLOCK]) {
        for i in 0..BLOCK {
            let pixel = Scaled::of([red[i], green[i], blue[i]]);
            let hue = (pixel.hue >= self.hue_from) & (pixel.hue < self.hue_below);
            let strong = (pixel.saturation >= self.saturation) | (pixel.value >= self.value);
            out[i] = u8::from(hue & strong);
        }
    }
}

impl std::fmt::Display for Thresholds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [hue_min, hue_max, saturation_min, value_min] = <[u8; 4]>::from(*self);
        write!(f, "{hue_min},{hue_max},{saturation_min},{value_min}")
    }
}

impl std::str::FromStr for Thresholds {
    type Err = Error;

    /// Reads least and largest hue, least saturation and least value, e.g. `30,79,30,163`.
    fn from_str(text: &str) -> Result<Thresholds, Error> {
        let numbers: Option<Vec<i64>> =
            text.split(',').map(|number| number.trim().parse().ok()).collect();
        match numbers.as_deref() {
            Some(&[hue_min, hue_max, saturation, value]) => {
                Thresholds::new(hue_min, hue_max, saturation, value)
            }
            _ => Err(Error::Argument(format!(
                "thresholds {text:?}: expected four whole numbers (hue from, hue to, least saturation, least value), such as 30,79,30,163"
            ))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hsv::from_rgb;
    use rayon::prelude::*;

    #[test]
    fn fused_thresholds_equal_the_definition_on_all_colours() {
        let all: Vec<Thresholds> = [
            "30,79,30,163",
            "0,180,0,0",
            "0,0,1,255",
            "0,40,60,200",
            "150,179,20,255",
            "1,1,255,255",
            "180,180,0,0",
            "179,180,128,128",
            "0,179,254,254",
            "59,61,0,10",
        ]
        .map(|text| text.parse().unwrap())
        .to_vec();
        (0..256).into_par_iter().for_each(|red| {
            let colours = (0..1 << 16).map(|gb: u32| [red as u8, (gb >> 8) as u8, gb as u8]);
            let photo = RgbImage::from_raw(256, 256, colours.clone().flatten().collect()).unwrap();
            let hsv: Vec<_> = colours.map(from_rgb).collect();
            for thresholds in &all {
                let mask = thresholds.mask(&photo);
                let wrong =
                    (0..hsv.len()).find(|&i| mask.data[i] != u8::from(thresholds.contain(hsv[i])));
                assert_eq!(wrong, None, "red {red} with {thresholds}");
            }
        });
    }

    #[test]
    fn thresholds_out_of_range_are_refused() {
        for (text, expected) in [
            ("30,79,30", "four whole numbers"),
            ("30,79,30,163,1", "four whole numbers"),
            ("", "four whole numbers"),
            ("a,79,30,163", "four whole numbers"),
            ("30.5,79,30,163", "four whole numbers"),
            ("80,79,30,163", "above the largest hue 79"),
            ("-1,79,30,163", "least hue is -1"),
            ("30,181,30,163", "largest hue is 181"),
            ("30,79,256,163", "least saturation is 256"),
            ("30,79,30,99999999999999", "least value is 99999999999999"),
        ] {
            let error = text.parse::<Thresholds>().unwrap_err();
            assert_eq!(error.kind(), rowgram_base::Kind::BadInput);
            assert!(error.to_string().contains(expected), "{text}: {error}");
        }
        let thresholds: Thresholds = " 30, 79,30 ,163".parse().unwrap();
        assert_eq!(thresholds, Thresholds::default());
        assert_eq!(thresholds.to_string(), "30,79,30,163");
    }

    #[test]
    fn odd_sizes_are_classified_to_the_last_pixel() {
        let green = image::Rgb([20, 200, 30]);
        for (width, height) in [(0, 0), (1, 1), (63, 1), (65, 1), (129, 3), (1000, 77)] {
            let photo = RgbImage::from_pixel(width, height, green);
            let mask = Thresholds::default().mask(&photo);
            assert_eq!(mask.count(), (width * height) as usize);
        }
    }
}
