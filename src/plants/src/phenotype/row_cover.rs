//! Leaf along rows: how much of their length it covers, how long its gaps are, and whether single plants can be told at all.
//!
//! A place along a row is covered where leaf lies within a quarter of the distance between rows. Where a canopy has closed along its rows
//! that is what a picture from above tells in place of plants.
//!
//! Reference for gaps as a share of the rows: R. Stolf, "Metodologia de avaliação de falhas nas linhas de cana-de-açúcar", STAB 4, 1986.

use super::{
    evidence::stroke_px,
    plot_scatter::{PARTS, PlotParts, jackknife},
    rows::{Row, Rows},
    stand::BETWEEN,
    traits::{PlotTraits, put},
};
use rayon::prelude::*;
use rowgram_optim::robust::median;
use rowgram_raster::{Mask, polygon::Polygon};

/// A row reaches this far to either side, in distances between rows: half the way to the next.
const HALF: f64 = 0.5;
/// From this solidity on rows are closed: one-row plots of soybean have 0.99, and crops whose plants are told by votes 0.58 to 0.81 (ten kinds of
/// synthetic masks, four maps of synthetic flights at late stages, sorghum). In the middle between, so neither is left out.
const SOLID: f64 = 0.9;
/// Closed rows are at most this many times as wide as the leaf in them: a trial of soybean has 1.2. Where lines across rows meet one leaf or none, as of young
/// plants, rows are solid, too, and 1.7 to 3.2 times as wide (six photos of sorghum, eight synthetic photos). No set was left out.
const WIDTHS: f64 = 1.4;

/// Places along the rows of a field, a pixel apart.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RowCover {
    /// The places by row and along it.
    pub places_px: Vec<[f64; 2]>,
    /// The row of each place, and whether leaf covers it.
    pub row_and_cover: Vec<(usize, bool)>,
    /// Shorter gaps do not count; `None` where there is no scale to tell.
    pub min_gap_px: Option<f64>,
}

/// The rows of an area: numbers of places.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Counts {
    places: usize,
    covered: usize,
    in_gaps: usize,
}

/// Pixels of a mask on a line across a row, from one side to the other.
fn across(
    mask: &Mask,
    [u, v]: [f64; 2],
    [du, dv]: [f64; 2],
    reach_px: f64,
) -> impl Iterator<Item = bool> {
    let steps = reach_px.round().max(0.0) as i64;
    (-steps..=steps).map(move |k| {
        let at = [u + k as f64 * du, v + k as f64 * dv].map(f64::round);
        let is_on = at[0] >= 0.0 && at[1] >= 0.0;
        is_on && {
            let [u, v] = at.map(|x| x as usize);
            u < mask.width && v < mask.height && mask.get(u, v)
        }
    })
}

/// The places along a straight row, a pixel apart, and the direction across it.
fn places([from, to]: [[f64; 2]; 2]) -> (Vec<[f64; 2]>, [f64; 2]) {
    let [du, dv] = [to[0] - from[0], to[1] - from[1]];
    let length = du.hypot(dv);
    let [du, dv] = if length > 0.0 { [du / length, dv / length] } else { [1.0, 0.0] };
    let place = |k: usize| [from[0] + k as f64 * du, from[1] + k as f64 * dv];
    ((0..=length as usize).map(place).collect(), [-dv, du])
}

impl RowCover {
    /// Follows straight rows from their first leaf to their last in a mask, where `valid` shows something; nothing of a single row,
    /// whose width is not known.
    pub fn new(
        mask: &Mask,
        valid: Option<&Mask>,
        rows_px: &[[[f64; 2]; 2]],
        min_gap_px: Option<f64>,
    ) -> Option<RowCover> {
        let reach_px = BETWEEN * apart_px(rows_px)?;
        let of_row = |(row, &line): (usize, &[[f64; 2]; 2])| {
            let (places, normal) = places(line);
            let is_seen = |at: &[f64; 2]| {
                valid.is_none_or(|valid| across(valid, *at, normal, 0.0).any(|is_seen| is_seen))
            };
            let seen = places.into_iter().filter(is_seen);
            let covered = |at: [f64; 2]| {
                (at, (row, across(mask, at, normal, reach_px).any(|is_leaf| is_leaf)))
            };
            seen.map(covered).collect::<Vec<_>>()
        };
        let all: Vec<_> = rows_px.par_iter().enumerate().map(of_row).collect::<Vec<_>>().concat();
        let (places_px, row_and_cover) = all.into_iter().unzip();
        Some(RowCover { places_px, row_and_cover, min_gap_px })
    }

    /// Adds what the rows in an area tell; `members` are the places in it.
    pub(super) fn add(&self, found: &mut PlotTraits, polygon: &Polygon, mut members: Vec<usize>) {
        members.sort_unstable();
        let parts = PlotParts::of(polygon);
        let mut counts = [Counts::default(); PARTS];
        // A stretch along a row that is covered or not.
        let together =
            |a: &usize, b: &usize| *b == a + 1 && self.row_and_cover[*a] == self.row_and_cover[*b];
        for stretch in members.chunk_by(together) {
            let is_covered = self.row_and_cover[stretch[0]].1;
            let is_long = self.min_gap_px.is_some_and(|least| stretch.len() as f64 >= least);
            for &place in stretch {
                let count = &mut counts[parts.at(self.places_px[place])];
                count.places += 1;
                count.covered += usize::from(is_covered);
                count.in_gaps += usize::from(!is_covered && is_long);
            }
        }
        let share = |of: fn(&Counts) -> usize, without: Option<usize>| {
            let left = || counts.iter().enumerate().filter(|(part, _)| Some(*part) != without);
            let places: usize = left().map(|(_, count)| count.places).sum();
            let some: usize = left().map(|(_, count)| of(count)).sum();
            (places > 0).then(|| some as f64 / places as f64)
        };
        let scatter = |of: fn(&Counts) -> usize| {
            jackknife(|part| counts[part].places > 0, |part| share(of, Some(part)))
        };
        let covered: fn(&Counts) -> usize = |count| count.covered;
        found.row_cover = share(covered, None);
        put(found, "row_cover", scatter(covered));
        if self.min_gap_px.is_some() {
            let in_gaps: fn(&Counts) -> usize = |count| count.in_gaps;
            found.row_gap_share = share(in_gaps, None);
            put(found, "row_gap_share", scatter(in_gaps));
        }
    }
}

/// The middle distance of neighbouring rows, each from the middle of one to the line of the next.
fn apart_px(rows_px: &[[[f64; 2]; 2]]) -> Option<f64> {
    let distance = |pair: &[[[f64; 2]; 2]]| {
        let [a, b] = [pair[0], pair[1]];
        let (_, normal) = places(a);
        let middle = [0, 1].map(|axis| 0.5 * (b[0][axis] + b[1][axis]));
        ((middle[0] - a[0][0]) * normal[0] + (middle[1] - a[0][1]) * normal[1]).abs()
    };
    median(rows_px.windows(2).map(distance).filter(|&apart| apart > 1.0))
}

/// Leaf pixels over the pixels between the first and the last of them on lines across rows, near 1 where the canopy has closed along them; and the mean
/// number of those pixels on lines that meet leaf.
fn solidity(mask: &Mask, rows: &Rows) -> Option<[f64; 2]> {
    let reach_px = HALF * rows.spacing_px?;
    let of_row = |row: &Row| {
        let ends = [row.start_px, row.end_px].map(|along| rows.axes.image([along, row.across_px]));
        let (places, normal) = places(ends);
        places.into_iter().fold([0usize; 3], |[leaf, width, lines], at| {
            let (mut first, mut last, mut here) = (None, 0, 0);
            for (k, is_leaf) in across(mask, at, normal, reach_px).enumerate() {
                if is_leaf {
                    first = first.or(Some(k));
                    (last, here) = (k + 1, here + 1);
                }
            }
            let here_px = first.map_or(0, |first| last - first);
            [leaf + here, width + here_px, lines + usize::from(here > 0)]
        })
    };
    let sums: Vec<[usize; 3]> = rows.rows.par_iter().map(of_row).collect();
    let [leaf, width, lines] = [0, 1, 2].map(|k| sums.iter().map(|of| of[k]).sum::<usize>() as f64);
    (width > 0.0).then(|| [leaf / width, width / lines])
}

/// Whether the canopy has closed along its rows, so that nothing tells its plants apart.
pub(super) fn is_closed(mask: &Mask, rows: &Rows) -> bool {
    solidity(mask, rows).is_some_and(|[solidity, width_px]| {
        solidity >= SOLID && width_px <= WIDTHS * stroke_px(mask)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three rows 20 px apart, 8 px wide, with a gap of 30 px in the middle one.
    fn mask() -> Mask {
        Mask::from_fn(200, 60, |u, v| {
            v % 20 >= 6 && v % 20 < 14 && !(v / 20 == 1 && (80..110).contains(&u))
        })
    }

    fn rows() -> Vec<[[f64; 2]; 2]> {
        (0..3).map(|row| f64::from(row) * 20.0 + 10.0).map(|v| [[0.0, v], [199.0, v]]).collect()
    }

    fn traits(min_gap_px: f64, polygon: &Polygon) -> PlotTraits {
        let cover = RowCover::new(&mask(), None, &rows(), Some(min_gap_px)).unwrap();
        let positions = rowgram_raster::polygon::Positions::new(cover.places_px.iter().copied());
        let mut found = PlotTraits::default();
        cover.add(&mut found, polygon, positions.inside(polygon));
        found
    }

    fn rectangle([u0, v0]: [f64; 2], [u1, v1]: [f64; 2]) -> Polygon {
        Polygon { rings: vec![vec![[u0, v0], [u1, v0], [u1, v1], [u0, v1]]] }
    }

    #[test]
    fn cover_and_gaps_are_shares_of_the_rows_in_an_area() {
        let all = rectangle([-0.5, -0.5], [199.5, 59.5]);
        let found = traits(20.0, &all);
        assert!((found.row_cover.unwrap() - 0.95).abs() < 1e-12, "{found:?}");
        assert!((found.row_gap_share.unwrap() - 0.05).abs() < 1e-12, "{found:?}");
        assert!(found.more["row_cover_sd"] > 0.0);
        // A gap that is too short is not covered either.
        let found = traits(31.0, &all);
        assert_eq!((found.row_cover, found.row_gap_share), (Some(0.95), Some(0.0)));
        // Half of the gap of the middle row alone.
        let found = traits(10.0, &rectangle([94.5, 20.0], [124.5, 40.0]));
        assert_eq!((found.row_cover, found.row_gap_share), (Some(0.5), Some(0.5)));
        let found = traits(10.0, &rectangle([300.0, 0.0], [310.0, 10.0]));
        assert_eq!((found.row_cover, found.row_gap_share), (None, None));
    }

    #[test]
    fn one_row_has_no_width_and_no_cover() {
        assert_eq!(RowCover::new(&mask(), None, &rows()[..1], None), None);
    }

    #[test]
    fn closed_rows_are_told_from_rows_of_plants() {
        let closed = mask();
        let detection = crate::phenotype::rows::detect(&closed);
        let rows = detection.rows().unwrap();
        let crossed =
            Mask::from_fn(200, 60, |u, v| (u + 3 * v) % 11 < 3 && v % 20 >= 3 && v % 20 < 17);
        // Plants of one upright leaf, which no line across the row leaves and enters again.
        let young = Mask::from_fn(200, 60, |u, v| {
            let leaf = |k: usize| (k * k * 7 + 31 * (v / 20)) % 195;
            v % 20 >= 6 && v % 20 < 14 && (0..14).any(|k| (leaf(k)..leaf(k) + 3).contains(&u))
        });
        for (mask, is_solid, expected) in
            [(closed, true, true), (crossed, false, false), (young, true, false)]
        {
            let [solidity, width_px] = solidity(&mask, rows).unwrap();
            assert_eq!(solidity >= SOLID, is_solid, "{solidity}");
            assert_eq!(is_closed(&mask, rows), expected, "{width_px} of {}", stroke_px(&mask));
        }
    }
}
