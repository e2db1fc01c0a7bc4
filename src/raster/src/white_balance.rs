//! White balance of a photo: one gain per channel, before colours are judged by thresholds.
//!
//! ```text
//! grey-world:   g_c = mean(G) / mean(c),          white-patch:   g_c = q(G) / q(c),
//! ```
//!
//! with `q` the 99th percentile; over the pixels of which no channel is 0 or 255, because a value that was cut off
//! says nothing of the light. Green keeps its values, and gains are held within 1/4 and 4.
//!
//! Grey-world takes the scene to be grey on average: right for soil with plants all over, wrong for a canopy that
//! fills the photo.
//!
//! Reference: G. Buchsbaum, "A spatial processor model for object colour perception", J. Franklin Inst. 310, 1980;
//! E. Land, J. McCann, "Lightness and retinex theory", JOSA 61, 1971.

use image::RgbImage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How the gains are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WhiteBalance {
    /// The mean colour becomes grey.
    GreyWorld,
    /// The brightest colours become white.
    WhitePatch,
}

rowgram_base::choices!(WhiteBalance: GreyWorld, WhitePatch);

/// How often each value occurs in each channel, over pixels that are not cut off.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channels([[u64; 256]; 3]);

impl Default for Channels {
    fn default() -> Channels {
        Channels([[0; 256]; 3])
    }
}

impl Channels {
    /// Counts the pixels of a photo, or of a part of one.
    pub fn add(&mut self, photo: &RgbImage) {
        for pixel in photo.pixels().filter(|p| p.0.iter().all(|&x| (1..255).contains(&x))) {
            for (channel, &value) in self.0.iter_mut().zip(&pixel.0) {
                channel[usize::from(value)] += 1;
            }
        }
    }

    /// The gains for these counts; 1 where there is no pixel.
    pub fn gains(&self, how: WhiteBalance) -> Gains {
        let level = |channel: &[u64; 256]| -> f64 {
            let count: u64 = channel.iter().sum();
            match how {
                WhiteBalance::GreyWorld => {
                    let sum: u64 = channel.iter().zip(0..).map(|(&n, value)| n * value).sum();
                    sum as f64 / count.max(1) as f64
                }
                WhiteBalance::WhitePatch => {
                    let wanted = (count as f64 * 0.99).ceil() as u64;
                    let mut below = 0;
                    let found = channel.iter().position(|&n| {
                        below += n;
                        below >= wanted && below > 0
                    });
                    found.unwrap_or(0) as f64
                }
            }
        };
        let [red, green, blue] = [level(&self.0[0]), level(&self.0[1]), level(&self.0[2])];
        let gain = |x: f64| if x > 0.0 { (green / x).clamp(0.25, 4.0) } else { 1.0 };
        Gains([gain(red), 1.0, gain(blue)])
    }
}

/// One gain per channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gains(pub [f64; 3]);

impl Gains {
    /// The photo with its channels scaled, rounded and cut off at 255.
    pub fn applied(&self, photo: &RgbImage) -> RgbImage {
        let tables = self.0.map(|gain| -> Vec<u8> {
            (0..256).map(|value| (f64::from(value) * gain).round().min(255.0) as u8).collect()
        });
        let mut balanced = photo.clone();
        balanced.par_chunks_mut(3 << 15).for_each(|pixels| {
            for pixel in pixels.as_chunks_mut::<3>().0 {
                for (value, table) in pixel.iter_mut().zip(&tables) {
                    *value = table[usize::from(*value)];
                }
            }
        });
        balanced
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn a_tinted_grey_scene_becomes_grey() {
        let photo = RgbImage::from_fn(64, 64, |u, v| {
            let light = 60 + ((7 * u + 5 * v) % 61) as u8;
            Rgb([light, light, light / 2])
        });
        for how in [WhiteBalance::GreyWorld, WhiteBalance::WhitePatch] {
            let mut channels = Channels::default();
            channels.add(&photo);
            let balanced = channels.gains(how).applied(&photo);
            for pixel in balanced.pixels() {
                assert!(
                    pixel.0[0] == pixel.0[1] && pixel.0[2].abs_diff(pixel.0[1]) <= 2,
                    "{pixel:?}"
                );
            }
        }
    }

    #[test]
    fn what_was_cut_off_does_not_count_and_nothing_leaves_all_as_it_is() {
        let mut channels = Channels::default();
        channels.add(&RgbImage::from_pixel(9, 9, Rgb([255, 10, 20])));
        assert_eq!(channels, Channels::default());
        assert_eq!(channels.gains(WhiteBalance::WhitePatch).0, [1.0; 3]);
        let photo = RgbImage::from_pixel(3, 3, Rgb([1, 2, 255]));
        assert_eq!(channels.gains(WhiteBalance::GreyWorld).applied(&photo), photo);
    }
}
