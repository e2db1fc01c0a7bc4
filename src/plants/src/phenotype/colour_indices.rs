//! Colour indices of leaves in an RGB picture.
//!
//! An index is taken of the mean colour of the leaf pixels of an area, not as the mean of the index of each pixel: ratios of
//! dark pixels are mostly noise, and those with a difference in the denominator (VARI) have no mean. With R, G, B from 0 to 255 and
//! r = R / (R + G + B) and so on:
//!
//! | index | equation | from |
//! |---|---|---|
//! | ExG, excess green | 2 g - r - b | Woebbecke et al. 1995, Trans. ASAE 38, 259-269 |
//! | GLI, green leaf index | (2 G - R - B) / (2 G + R + B) | Louhaichi et al. 2001, Geocarto Int. 16, 65-70 |
//! | NGRDI, normalized green-red difference index | (G - R) / (G + R) | Tucker 1979, Remote Sens. Environ. 8, 127-150 |
//! | VARI, visible atmospherically resistant index | (G - R) / (G + R - B) | Gitelson et al. 2002, Remote Sens. Environ. 80, 76-87 |
//! | TGI, triangular greenness index | G - 0.39 R - 0.61 B, over 255 | Hunt et al. 2011, Agron. J. 103, 1090-1099 |
//! | a* | CIELAB, white D65 | CIE 15; sRGB after IEC 61966-2-1 |
//!
//! They are those of the colours as they come: compare plots of one flight, or dates of a season, whose colours have one scale.

use rowgram_raster::srgb::linear_light;

/// Sum of the colours of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ColourSum {
    /// Sums of red, green and blue, 0 to 255 each.
    pub rgb: [u64; 3],
    /// Number of pixels.
    pub pixels: u64,
}

impl ColourSum {
    /// Adds a pixel.
    pub fn add(&mut self, rgb: [u8; 3]) {
        for (sum, value) in self.rgb.iter_mut().zip(rgb) {
            *sum += u64::from(value);
        }
        self.pixels += 1;
    }

    /// The indices of the mean colour; `None` where there is no pixel, or all are black.
    pub fn indices(&self) -> Option<ColourIndices> {
        let total: u64 = self.rgb.iter().sum();
        if self.pixels == 0 || total == 0 {
            return None;
        }
        let [r, g, b] = self.rgb.map(|sum| sum as f64 / self.pixels as f64);
        let over = |numerator: f64, denominator: f64| {
            (denominator.abs() > f64::EPSILON).then(|| numerator / denominator)
        };
        Some(ColourIndices {
            exg: (2.0 * g - r - b) / (r + g + b),
            gli: (2.0 * g - r - b) / (2.0 * g + r + b),
            ngrdi: over(g - r, g + r),
            vari: over(g - r, g + r - b),
            tgi: (g - 0.39 * r - 0.61 * b) / 255.0,
            a_star: a_star([r, g, b]),
        })
    }
}

/// Colour indices of an area; `None` where the denominator is zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColourIndices {
    /// Excess green, -1 to 2.
    pub exg: f64,
    /// Green leaf index, -1 to 1.
    pub gli: f64,
    /// Normalized green-red difference index, -1 to 1.
    pub ngrdi: Option<f64>,
    /// Visible atmospherically resistant index.
    pub vari: Option<f64>,
    /// Triangular greenness index, of reflectances between 0 and 1.
    pub tgi: f64,
    /// a* of CIELAB; green is negative.
    pub a_star: f64,
}

/// a* of a colour of sRGB, 0 to 255 each.
fn a_star(rgb: [f64; 3]) -> f64 {
    let linear = rgb.map(linear_light);
    let dot = |row: [f64; 3]| row.iter().zip(linear).map(|(a, b)| a * b).sum::<f64>();
    let x = dot([0.412_456_4, 0.357_576_1, 0.180_437_5]) / 0.950_47;
    let y = dot([0.212_672_9, 0.715_152_2, 0.072_175]);
    let f = |t: f64| {
        let d: f64 = 6.0 / 29.0;
        if t > d.powi(3) { t.cbrt() } else { t / (3.0 * d * d) + 4.0 / 29.0 }
    };
    500.0 * (f(x) - f(y))
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    fn of(rgb: [u8; 3]) -> ColourIndices {
        let mut sum = ColourSum::default();
        sum.add(rgb);
        sum.indices().unwrap()
    }

    #[test]
    fn indices_of_a_leaf() {
        // By hand from the equations; a* by skimage.color.rgb2lab of the same colour.
        let leaf = of([60, 120, 40]);
        assert_abs_diff_eq!(leaf.exg, 140.0 / 220.0, epsilon = 1e-12);
        assert_abs_diff_eq!(leaf.gli, 140.0 / 340.0, epsilon = 1e-12);
        assert_abs_diff_eq!(leaf.ngrdi.unwrap(), 60.0 / 180.0, epsilon = 1e-12);
        assert_abs_diff_eq!(leaf.vari.unwrap(), 60.0 / 140.0, epsilon = 1e-12);
        assert_abs_diff_eq!(leaf.tgi, (120.0 - 23.4 - 24.4) / 255.0, epsilon = 1e-12);
        assert_abs_diff_eq!(leaf.a_star, -35.378, epsilon = 2e-2);
    }

    #[test]
    fn grey_has_no_greenness_and_black_no_indices() {
        let grey = of([90, 90, 90]);
        for value in [grey.exg, grey.gli, grey.ngrdi.unwrap(), grey.vari.unwrap(), grey.tgi] {
            assert_abs_diff_eq!(value, 0.0, epsilon = 1e-12);
        }
        assert_abs_diff_eq!(grey.a_star, 0.0, epsilon = 2e-2);
        assert_eq!(ColourSum { rgb: [0; 3], pixels: 5 }.indices(), None);
        assert_eq!(ColourSum::default().indices(), None);
        // Blue of both others together: VARI is not defined.
        assert_eq!(of([40, 60, 100]).vari, None);
    }
}
