//! Grey values of a picture as linear light, and a linear scale of that light.
//!
//! ```text
//! x = ((v + 0.055) / 1.055)^2.4        v above 0.04045, from 0 to 1; v / 12.92 below
//! y = g x + o                          by channel
//! ```
//!
//! `x` is proportional to the light on the sensor, 1 at saturation. Light, exposure and white balance multiply it by a gain `g`; haze adds an
//! offset `o`.
//!
//! Reference: IEC 61966-2-1 (sRGB).

use image::RgbImage;

/// The linear light, 0 to 1, of a grey value, 0 to 255.
pub fn linear_light(grey: f64) -> f64 {
    let value = grey / 255.0;
    if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// The grey value, 0 to 255 and beyond, of linear light.
pub fn grey_value(light: f64) -> f64 {
    255.0 * if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

/// What the linear light of each channel is multiplied by, and what is added then.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LightScale {
    /// Gains of red, green, blue.
    pub gain: [f64; 3],
    /// Offsets.
    pub offset: [f64; 3],
}

impl LightScale {
    /// Light as it is.
    pub const IDENTITY: LightScale = LightScale { gain: [1.0; 3], offset: [0.0; 3] };

    /// Light in this scale.
    pub fn apply(&self, light: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|c| self.gain[c] * light[c] + self.offset[c])
    }

    /// The grey values of all bytes in this scale, by channel.
    pub fn grey_values(&self) -> [[f64; 256]; 3] {
        std::array::from_fn(|channel| {
            let (gain, offset) = (self.gain[channel], self.offset[channel]);
            std::array::from_fn(|byte| {
                grey_value((gain * linear_light(byte as f64) + offset).max(0.0))
            })
        })
    }

    /// Brings a picture into this scale, rounded to bytes.
    pub fn convert(&self, picture: &mut RgbImage) {
        if *self == LightScale::IDENTITY {
            return;
        }
        let bytes =
            self.grey_values().map(|of| of.map(|grey| grey.round().clamp(0.0, 255.0) as u8));
        for pixel in picture.pixels_mut() {
            for (value, bytes) in pixel.0.iter_mut().zip(&bytes) {
                *value = bytes[usize::from(*value)];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_come_back_and_a_scale_changes_light_by_its_gain() {
        for byte in 0..=255 {
            assert!(
                (grey_value(linear_light(f64::from(byte))) - f64::from(byte)).abs() < 1e-3,
                "{byte}"
            );
        }
        assert!((linear_light(188.0) - 0.5029).abs() < 1e-4);
        let mut picture = RgbImage::from_pixel(1, 1, image::Rgb([120, 120, 120]));
        LightScale::IDENTITY.convert(&mut picture);
        assert_eq!(picture.get_pixel(0, 0).0, [120; 3]);
        let scale = LightScale { gain: [0.5, 1.0, 2.0], offset: [0.0, 0.1, 0.0] };
        scale.convert(&mut picture);
        let found = picture.get_pixel(0, 0).0.map(|value| linear_light(f64::from(value)));
        let light = linear_light(120.0);
        for (found, expected) in found.iter().zip(scale.apply([light; 3])) {
            assert!((found / expected - 1.0).abs() < 0.02, "{found} {expected}");
        }
        // What is brighter than white is white, what is darker than black is black.
        let mut picture = RgbImage::from_pixel(1, 1, image::Rgb([0, 120, 250]));
        LightScale { gain: [1.0; 3], offset: [-0.1, -0.9, 0.5] }.convert(&mut picture);
        assert_eq!(picture.get_pixel(0, 0).0, [0, 0, 255]);
    }
}
