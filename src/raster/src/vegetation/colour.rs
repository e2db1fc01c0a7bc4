//! Green-red and yellow-blue of CIE L\*a\*b\* (D65, 2 degrees), from 8-bit sRGB by tables.
//!
//! ```text
//! a* = 500 (f(X) - f(Y)),   b* = 200 (f(Y) - f(Z)),   X, Y, Z relative to the white,
//! f(t) = t^(1/3)  where  t > (6/29)^3,  else  t / (3 (6/29)^2) + 4/29.
//! ```
//!
//! Greenness is `-a*`. Unlike ratios of channels, it goes to zero with the light, so the noise of dark pixels
//! stays small. The tables hold linear light in 14 bits.

use std::sync::LazyLock;

/// Largest linear value of the tables.
const FULL: u32 = (1 << 14) - 1;

/// Rows of the matrix from linear sRGB to X, Y, Z, each divided by the white, in 1/2^14.
const XYZ: [[u32; 3]; 3] = [[7110, 6164, 3110], [3485, 11717, 1182], [291, 1794, 14299]];

struct Tables {
    linear: [u32; 256],
    root: Vec<f32>,
}

static TABLES: LazyLock<Tables> = LazyLock::new(|| {
    let mut linear = [0; 256];
    for (value, linear) in linear.iter_mut().enumerate() {
        let encoded = value as f64 / 255.0;
        let light = if encoded <= 0.04045 {
            encoded / 12.92
        } else {
            ((encoded + 0.055) / 1.055).powf(2.4)
        };
        *linear = (light * f64::from(FULL)).round() as u32;
    }
    let root = (0..=FULL + 1).map(|t| {
        let t = f64::from(t) / f64::from(FULL);
        let knee = 6.0_f64 / 29.0;
        let f = if t > knee.powi(3) { t.cbrt() } else { t / (3.0 * knee * knee) + 4.0 / 29.0 };
        f as f32
    });
    Tables { linear, root: root.collect() }
});

/// Converts pixels; the tables are looked up once.
#[derive(Clone, Copy)]
pub(super) struct Converter {
    tables: &'static Tables,
}

impl Converter {
    pub(super) fn new() -> Converter {
        Converter { tables: &TABLES }
    }

    /// `[-a*, b*]` of a pixel.
    #[inline(always)]
    pub(super) fn green_yellow(self, rgb: [u8; 3]) -> [f32; 2] {
        let [r, g, b] = rgb.map(|value| self.tables.linear[usize::from(value)]);
        let [x, y, z] = XYZ.map(|row| {
            let sum = row[0] * r + row[1] * g + row[2] * b;
            self.tables.root[(((sum + (1 << 13)) >> 14) as usize).min(FULL as usize)]
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
            let [green, yellow] = Converter::new().green_yellow(rgb);
            assert!((green + a).abs() < 0.5, "{rgb:?}: {green}, expected {}", -a);
            assert!((yellow - b).abs() < 0.5, "{rgb:?}: {yellow}, expected {b}");
        }
    }
}
