//! Local density: how many plant pixels lie around each pixel.
//!
//! ```text
//! D(u, v) = sum of Y over |du| <= r, |dv| <= r,      the window has 2 r + 1 pixels a side.
//! ```
//!
//! The window is any odd number, 41 in the paper. Beyond the border there is no plant: near it the count is that
//! of the part of the window that lies inside. Running sums make the time independent of the window: the sums of
//! the columns are moved down by a row with one addition and one subtraction each, and a prefix sum over them
//! gives the row (a summed-area table of which one row is kept).
//!
//! Reference: F. C. Crow, "Summed-area tables for texture mapping", SIGGRAPH 1984.

use super::Mask;
use rowgram_base::error::Error;
use std::ops::Range;

/// Largest side of a window: its pixels must be counted in 32 bits.
pub const LARGEST_WINDOW_PX: usize = 65_535;

/// Half of a window: `r` of a window of `2 r + 1` pixels.
///
/// # Errors
/// [`Error::Argument`] where the window is even, zero or larger than [`LARGEST_WINDOW_PX`].
pub fn half_window(window_px: usize) -> Result<usize, Error> {
    if window_px > LARGEST_WINDOW_PX {
        return Err(Error::Argument(format!(
            "the window has {window_px} pixels a side, expected at most {LARGEST_WINDOW_PX}"
        )));
    }
    if window_px.is_multiple_of(2) {
        return Err(Error::Argument(format!(
            "the window has {window_px} pixels a side, expected an odd number such as 41"
        )));
    }
    Ok(window_px / 2)
}

/// The density of the rows `rows` of a mask, row by row.
pub fn rows(mask: &Mask, half: usize, rows: Range<usize>) -> Vec<u32> {
    let width = mask.width;
    let mut sums = vec![0u32; width];
    let mut density = Vec::with_capacity(width * rows.len());
    let add = |sums: &mut [u32], v: usize| {
        sums.iter_mut().zip(mask.row(v)).for_each(|(sum, &pixel)| *sum += u32::from(pixel));
    };
    let take = |sums: &mut [u32], v: usize| {
        sums.iter_mut().zip(mask.row(v)).for_each(|(sum, &pixel)| *sum -= u32::from(pixel));
    };
    for v in rows.start.saturating_sub(half)..(rows.start + half).min(mask.height) {
        add(&mut sums, v);
    }
    let mut prefix = vec![0u32; width + 1];
    for v in rows {
        if v + half < mask.height {
            add(&mut sums, v + half);
        }
        for u in 0..width {
            prefix[u + 1] = prefix[u].wrapping_add(sums[u]);
        }
        density.extend((0..width).map(|u| {
            prefix[(u + half + 1).min(width)].wrapping_sub(prefix[u.saturating_sub(half)])
        }));
        if v >= half {
            take(&mut sums, v - half);
        }
    }
    density
}

/// A colour for a share of the largest density, 0 to 1: dark blue over green to yellow, lighter all
/// the way (so that it reads in grey and to the colour-blind).
pub fn colour(share: f64) -> [u8; 3] {
    /// Seven points of matplotlib's "viridis" (CC0).
    const POINTS: [[f64; 3]; 7] = [
        [68.0, 1.0, 84.0],
        [68.0, 57.0, 131.0],
        [48.0, 104.0, 142.0],
        [33.0, 145.0, 140.0],
        [53.0, 183.0, 121.0],
        [144.0, 215.0, 67.0],
        [253.0, 231.0, 37.0],
    ];
    let place = share.clamp(0.0, 1.0) * (POINTS.len() - 1) as f64;
    let below = (place as usize).min(POINTS.len() - 2);
    let t = place - below as f64;
    let mix = |k: usize| (POINTS[below][k] + t * (POINTS[below + 1][k] - POINTS[below][k])).round();
    [mix(0) as u8, mix(1) as u8, mix(2) as u8]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn counts_are_those_of_the_definition(
            width in 1usize..30, bits in proptest::collection::vec(0u8..3, 1..400), half in 0usize..12,
            from in 0usize..20,
        ) {
            let height = bits.len() / width;
            let mask = Mask::from_fn(width, height, |u, v| bits[v * width + u] == 0);
            let found = rows(&mask, half, 0..height);
            for v in 0..height {
                for u in 0..width {
                    let around = |c: usize, end: usize| c.saturating_sub(half)..(c + half + 1).min(end);
                    let count = around(v, height)
                        .flat_map(|y| around(u, width).map(move |x| (x, y)))
                        .filter(|&(x, y)| mask.get(x, y))
                        .count();
                    prop_assert_eq!(found[v * width + u] as usize, count);
                }
            }
            let from = from.min(height);
            prop_assert_eq!(&rows(&mask, half, from..height)[..], &found[from * width..]);
        }
    }

    #[test]
    fn windows_are_odd_and_colours_get_lighter() {
        assert_eq!(half_window(41).unwrap(), 20);
        assert!(half_window(0).is_err() && half_window(40).is_err());
        let grey = |share: f64| colour(share).iter().map(|&c| f64::from(c)).sum::<f64>();
        assert!((1..=20).all(|i| grey(f64::from(i) / 20.0) > grey(f64::from(i - 1) / 20.0)));
    }
}
