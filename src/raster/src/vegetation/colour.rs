//! Green-red and yellow-blue of CIE L\*a\*b\* (D65, 2 degrees), from 8-bit sRGB by tables.
//!
//! ```text
//! a* = 500 (f(X) - f(Y)),   b* = 200 (f(Y) - f(Z)),   X, Y, Z relative to the white,
//! f(t) = t^(1/3)  where  t > (6/29)^3,  else  t / (3 (6/29)^2) + 4/29.
//! ```
//!
//! Greenness is `-a*`. Unlike ratios of channels, it goes to zero with the light, so the noise of dark pixels
//! stays small. The tables hold linear light in 14 bits.
//!
//! Where the near infrared is known, greenness is the NDVI instead, brought to the same numbers: soil (NDVI 0.1 to 0.2) about
//! -2, leaves (0.7 to 0.85) about 14, which are the priors of the two classes. Yellowness is then 0. Colours are smoothed over 3 x 3 pixels;
//! the classes are so much further apart in NDVI than its noise that smoothing would only blur the edges of leaves (`smoothing`).
//!
//! Linear light is first multiplied by a gain for each channel ([`super::white_balance`]); colours are clipped at white.

use crate::srgb::linear_light;
use std::sync::LazyLock;

/// Largest linear value of the tables.
const FULL: u32 = (1 << 14) - 1;

/// Rows of the matrix from linear sRGB to X, Y, Z, each divided by the white, in 1/2^14.
const XYZ: [[u32; 3]; 3] = [[7110, 6164, 3110], [3485, 11717, 1182], [291, 1794, 14299]];

/// Units of greenness for a unit of NDVI, and the NDVI whose greenness is 0.
const GREEN_OF_NDVI: f32 = 25.0;
const NDVI_OF_GREY: f32 = 0.2;

struct Tables {
    /// Linear light of bytes, 0 to `FULL`.
    linear: [f64; 256],
    root: Vec<f32>,
}

static TABLES: LazyLock<Tables> = LazyLock::new(|| {
    let linear = std::array::from_fn(|value| linear_light(value as f64) * f64::from(FULL));
    let root = (0..=FULL + 1).map(|t| {
        let t = f64::from(t) / f64::from(FULL);
        let knee = 6.0_f64 / 29.0;
        let f = if t > knee.powi(3) { t.cbrt() } else { t / (3.0 * knee * knee) + 4.0 / 29.0 };
        f as f32
    });
    Tables { linear, root: root.collect() }
});

/// Converts pixels; the tables are looked up once.
pub(super) struct Converter<'a> {
    /// Linear light of the bytes of each channel, with its gain.
    linear: [[u32; 256]; 3],
    root: &'static [f32],
    ndvi: Option<&'a [f32]>,
}

/// Greenness and yellowness for an NDVI; both 0 where it is not a number.
pub(super) fn of_ndvi(ndvi: f32) -> [f32; 2] {
    let ndvi = if ndvi.is_finite() { ndvi.clamp(-1.0, 1.0) } else { NDVI_OF_GREY };
    [GREEN_OF_NDVI * (ndvi - NDVI_OF_GREY), 0.0]
}

impl<'a> Converter<'a> {
    /// `ndvi` of all pixels of the picture, where it is known; `gains` of linear red, green, blue.
    pub(super) fn new(ndvi: Option<&'a [f32]>, gains: [f64; 3]) -> Converter<'a> {
        let scaled = |gain: f64, light: f64| (gain * light).round().min(f64::from(FULL)) as u32;
        let linear = gains.map(|gain| TABLES.linear.map(|light| scaled(gain, light)));
        Converter { linear, root: &TABLES.root, ndvi }
    }

    /// Greenness and yellowness of the pixel with this number of the picture.
    #[inline(always)]
    pub(super) fn of_pixel(&self, number: usize, rgb: [u8; 3]) -> [f32; 2] {
        match self.ndvi {
            None => self.green_yellow(rgb),
            Some(ndvi) => of_ndvi(ndvi.get(number).copied().unwrap_or(f32::NAN)),
        }
    }

    /// `[-a*, b*]` of a pixel.
    #[inline(always)]
    pub(super) fn green_yellow(&self, rgb: [u8; 3]) -> [f32; 2] {
        let [r, g, b] = [0, 1, 2].map(|k| self.linear[k][usize::from(rgb[k])]);
        let [x, y, z] = XYZ.map(|row| {
            let sum = row[0] * r + row[1] * g + row[2] * b;
            self.root[(((sum + (1 << 13)) >> 14) as usize).min(FULL as usize)]
        });
        [500.0 * (y - x), 200.0 * (y - z)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_colours() {
        // a*, b* of the primaries and of a leaf colour, computed in double precision from the definition.
        for (rgb, a, b) in [
            ([255, 0, 0], 80.09, 67.20),
            ([0, 255, 0], -86.18, 83.18),
            ([0, 0, 255], 79.19, -107.86),
            ([128, 128, 128], 0.0, 0.0),
            ([255, 255, 255], 0.0, 0.0),
            ([60, 120, 50], -34.22, 32.08),
        ] {
            let [green, yellow] = Converter::new(None, [1.0; 3]).of_pixel(0, rgb);
            assert!((green + a).abs() < 0.5, "{rgb:?}: {green}, expected {}", -a);
            assert!((yellow - b).abs() < 0.5, "{rgb:?}: {yellow}, expected {b}");
        }
    }

    #[test]
    fn infrared_comes_before_colours() {
        let ndvi = [0.12, 0.76, f32::NAN];
        let green =
            |number: usize| Converter::new(Some(&ndvi), [1.0; 3]).of_pixel(number, [60, 120, 50]);
        assert!((green(0)[0] + 2.0).abs() < 1e-4 && (green(1)[0] - 14.0).abs() < 1e-4);
        assert_eq!(green(2), [0.0, 0.0]);
    }
}
