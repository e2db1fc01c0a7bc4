//! How far from the surface of the tie points heights are looked for.
//!
//! ```text
//! range = q90 over squares (z_95 - z_05) + c
//! ```
//!
//! with `z_05` and `z_95` percentiles of the heights of the tie points of a square, metres, and `c` what leaves stand above them.

use rowgram_survey::mapping::{dem::SurfacePoint, grid::rounded};
use std::collections::BTreeMap;

/// Side of the squares in which tie points are compared, in cells.
const SQUARE_CELLS: f64 = 60.0;
/// Fewer points in a square say nothing.
const MIN_POINTS: usize = 8;
/// Share of the squares that differ less than what the range is for.
const USUAL: f64 = 0.9;
/// The range is so much more than what tie points of a square differ by, metres: they seldom lie on the highest leaves.
const MORE_M: f64 = 0.3;
/// Limits of the range, metres.
const RANGE_M: [f64; 2] = [0.5, 30.0];

/// Side of the squares in which trees and houses are compared with what is around them, in cells: a coarse tile.
const RELIEF_CELLS: f64 = 2048.0;
/// Trees and houses stand up to so high above the surface of the tie points, in cells: a quarter to half of the height of flight of usual
/// cameras. Not measured.
const MAX_RELIEF_CELLS: f64 = 1000.0;
/// Fewer squares than this do not say what is usual; larger squares are tried.
const MIN_SQUARES: usize = 10;
/// How often the side of the squares is doubled.
const DOUBLINGS: usize = 5;

/// How far heights are looked for: what tie points of the same square differ by, from the lowest twentieth to the highest.
pub(super) fn range_of(points: &[SurfacePoint], cell_m: f64) -> f64 {
    let mut side_m = SQUARE_CELLS * cell_m;
    let mut spans = Vec::new();
    for _ in 0..DOUBLINGS {
        spans = spans_m(points, side_m, 20);
        if spans.len() >= MIN_SQUARES {
            break;
        }
        side_m *= 2.0;
    }
    let at = (USUAL * spans.len().saturating_sub(1) as f64) as usize;
    let span = spans.get(at).copied().unwrap_or(0.0);
    rounded((span + MORE_M).clamp(RANGE_M[0], RANGE_M[1]), 3)
}

/// How far trees and houses may be from the surface of the tie points: the most that tie points of a tile differ by.
pub(super) fn relief_of(points: &[SurfacePoint], cell_m: f64) -> f64 {
    let most = spans_m(points, RELIEF_CELLS * cell_m, 0).last().copied().unwrap_or(0.0);
    rounded((most + MORE_M).min(MAX_RELIEF_CELLS * cell_m), 3)
}

/// What heights differ by in squares of this side, without one of so many at both ends (0: with all); sorted.
fn spans_m(points: &[SurfacePoint], side_m: f64, one_of: usize) -> Vec<f64> {
    let mut squares: BTreeMap<[i64; 2], Vec<f64>> = BTreeMap::new();
    for point in points {
        let [x, y, z] = point.position_m;
        squares.entry([x, y].map(|c| (c / side_m).floor() as i64)).or_default().push(z);
    }
    let enough = squares.into_values().filter(|heights| heights.len() >= MIN_POINTS);
    let mut spans: Vec<f64> = enough
        .map(|mut heights| {
            heights.sort_by(f64::total_cmp);
            let cut = heights.len().checked_div(one_of).unwrap_or(0);
            heights[heights.len() - 1 - cut] - heights[cut]
        })
        .collect();
    spans.sort_by(f64::total_cmp);
    spans
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_range_follows_what_neighbouring_tie_points_differ_by() {
        let points = |top: f64| -> Vec<SurfacePoint> {
            (0..900)
                .map(|k| {
                    let (x, y) = (f64::from(k % 30) * 0.1, f64::from(k / 30) * 0.1);
                    // A slope of a tenth, and a canopy on every second point.
                    let z = 100.0 + 0.1 * x + if k % 2 == 0 { top } else { 0.0 };
                    SurfacePoint { position_m: [x, y, z], sigma_z_m: f64::NAN }
                })
                .collect()
        };
        let (low, high) = (range_of(&points(0.4), 0.015), range_of(&points(2.5), 0.015));
        assert!((0.7..0.9).contains(&low), "{low}");
        assert!((2.8..3.0).contains(&high), "{high}");
        assert_eq!(range_of(&[], 0.015), RANGE_M[0]);
        // One tie point on a tree: the relief has to reach it, the range of usual heights not.
        let mut with_tree = points(0.4);
        with_tree.push(SurfacePoint { position_m: [1.0, 0.5, 109.0], sigma_z_m: f64::NAN });
        assert!((0.7..0.9).contains(&range_of(&with_tree, 0.015)));
        assert!((9.0..9.5).contains(&relief_of(&with_tree, 0.015)));
        assert!((0.95..1.05).contains(&relief_of(&points(0.4), 0.015)));
    }
}
