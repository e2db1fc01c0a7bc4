//! RGB to hue, saturation, value, with 8 bits each.
//!
//! With `V = max(R, G, B)`, `D = V - min(R, G, B)` and the hue numerator
//!
//! ```text
//! n = G - B           where R is the largest,
//!     B - R + 2 D     else where G is,
//!     R - G + 4 D     else,
//! S = 255 D / V,      H = 30 n / D  (+ 180 where negative),
//! ```
//!
//! `H` counts half degrees, 0..=179, and `S` and `V` are 0..=255; grey has `H = S = 0`. Published
//! thresholds refer to OpenCV's 8-bit `COLOR_RGB2HSV`, which rounds in fixed point. With
//! `q(x, y) = round(2^12 x / y)`, halves to even, these are its bytes for all 2^24 colours:
//!
//! ```text
//! S = floor((D q(255, V) + 2^11) / 2^12),   H = floor((n q(30, D) + 2^11) / 2^12)  (+ 180).
//! ```
//!
//! All numbers in it are integers below 2^24, which `f32` holds exactly; and it rounds the quotients
//! as asked, because none comes closer to a half than `1 / (2 * 255)`. So the arithmetic is done
//! in `f32`, in [`super::mask`] several pixels at a time, with whatever SIMD the machine has.
//!
//! Reference: A. R. Smith, "Color gamut transform pairs", SIGGRAPH 1978; OpenCV's documentation of
//! `cvtColor`.

/// A colour's hue and saturation before they are rounded.
#[derive(Clone, Copy, Default)]
pub(super) struct Scaled {
    /// `n q(30, D)`, a turn added where that makes the hue one; in 2^-12 half degrees.
    pub(super) hue: f32,
    /// `D q(255, V)`, in 2^-12.
    pub(super) saturation: f32,
    /// `V`.
    pub(super) value: i16,
}

impl Scaled {
    /// One step of hue or saturation.
    pub(super) const STEP: f32 = 4096.0;
    /// From here on to the next step a number is rounded up to it.
    pub(super) const HALF: f32 = 2048.0;

    #[inline(always)]
    pub(super) fn of([r, g, b]: [i16; 3]) -> Scaled {
        let value = r.max(g).max(b);
        let range = value - r.min(g).min(b);
        let n = if value == r {
            g - b
        } else if value == g {
            b - r + 2 * range
        } else {
            r - g + 4 * range
        };
        // Grey has range 0 (and black value 0) and then n = 0 as well: any divisor will do.
        let hue = f32::from(n) * quotient(30.0, range.max(1));
        Scaled {
            hue: if hue < -Scaled::HALF { hue + 180.0 * Scaled::STEP } else { hue },
            saturation: f32::from(range) * quotient(255.0, value.max(1)),
            value,
        }
    }

    #[inline(always)]
    fn bytes(self) -> [u8; 3] {
        // Added to 2^23 an integer stands in the low bits as it is; not negative here.
        let rounded = |x: f32| ((x + (Scaled::HALF + 8_388_608.0)).to_bits() >> 12) as u8;
        [rounded(self.hue), rounded(self.saturation), self.value as u8]
    }
}

/// `q(x, y)` of the head of this file.
#[inline(always)]
fn quotient(x: f32, y: i16) -> f32 {
    // The sum has no place for fractions, so it is rounded, half to even.
    const NO_FRACTIONS: f32 = 12_582_912.0;
    (x * Scaled::STEP / f32::from(y) + NO_FRACTIONS) - NO_FRACTIONS
}

/// Hue (0..=179), saturation and value of one colour.
///
/// ```
/// use rowgram_raster::hsv::from_rgb;
/// assert_eq!(from_rgb([255, 0, 0]), [0, 255, 255]);
/// assert_eq!(from_rgb([0, 128, 0]), [60, 255, 128]);
/// assert_eq!(from_rgb([7, 7, 7]), [0, 0, 7]);
/// ```
#[inline]
pub fn from_rgb(rgb: [u8; 3]) -> [u8; 3] {
    Scaled::of(rgb.map(i16::from)).bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CRC-32 (the one of zip and PNG) of `H S V H S V ...` over all G (slowest) and B, per R.
    const GOLDEN: &str = include_str!("../../../tests/golden/hsv.txt");

    #[test]
    fn all_colours_equal_opencv() {
        let golden: Vec<u32> = GOLDEN
            .lines()
            .filter(|line| !line.starts_with('#'))
            .map(|line| u32::from_str_radix(line, 16).unwrap())
            .collect();
        assert_eq!(golden.len(), 256);
        for (red, &expected) in golden.iter().enumerate() {
            let colour = |gb: u32| from_rgb([red as u8, (gb >> 8) as u8, gb as u8]);
            let hsv: Vec<u8> = (0..1 << 16).flat_map(colour).collect();
            let mut crc = flate2::Crc::new();
            crc.update(&hsv);
            assert_eq!(crc.sum(), expected, "red {red}");
        }
    }

    #[test]
    fn conversion_is_close_to_the_real_quotients() {
        for rgb in [[200u8, 100, 50], [10, 250, 11], [0, 1, 255], [255, 254, 255]] {
            let [h, s, v] = from_rgb(rgb);
            let [r, g, b] = rgb.map(f64::from);
            let (largest, range) = (r.max(g).max(b), r.max(g).max(b) - r.min(g).min(b));
            let n = if largest == r {
                g - b
            } else if largest == g {
                b - r + 2.0 * range
            } else {
                r - g + 4.0 * range
            };
            let difference = (f64::from(h) - 30.0 * n / range).rem_euclid(180.0);
            assert!(difference.min(180.0 - difference) <= 0.51, "{rgb:?}");
            assert!((f64::from(s) - 255.0 * range / largest).abs() <= 0.51, "{rgb:?}");
            assert_eq!(f64::from(v), largest);
        }
    }
}
