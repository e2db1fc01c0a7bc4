//! Leaf along rows: how much of their length it covers, how long its gaps are, and whether single plants can be told at all.
//!
//! A place along a row is covered where leaf lies within a quarter of the distance between rows. Where a canopy has closed along its rows
//! that is what a picture from above tells in place of plants.
//!
//! Reference for gaps as a share of the rows: R. Stolf, "Metodologia de avaliação de falhas nas linhas de cana-de-açúcar", STAB 4, 1986.

use super::{
    evidence::stroke_px,
    plot_scatter::{PARTS, PlotParts, jackknife},
    plots::Area,
    rows::{Row, Rows},
    stand::BETWEEN,
    traits::{PlotTraits, put},
};
use rayon::prelude::*;
use rowgram_optim::robust::median;
use rowgram_raster::Mask;
use std::collections::{BTreeMap, BTreeSet};

/// A row reaches this far to either side, in distances between rows: half the way to the next.
const HALF: f64 = 0.5;
/// From this solidity on rows are closed: one-row plots of soybean have 0.99, and crops whose plants are told by votes 0.58 to 0.81 (ten kinds of
/// synthetic masks, four maps of synthetic flights at late stages, sorghum). In the middle between, so neither is left out.
const SOLID: f64 = 0.9;
/// Closed rows leave at most this share of the lines across them without leaf, or are no wider than [`WIDTHS`]. Lines across rows of young plants meet one leaf or none, which
/// is solid, too, but 0.13 to 0.34 of them meet none (six photos of sorghum, four synthetic photos). No set was left out.
const BARE: f64 = 0.05;
/// Closed rows with alleys are at most this many times as wide as the leaf in them: a trial of soybean has 1.2, those photos 1.7 to 3.2. No set was left out.
const WIDTHS: f64 = 1.4;

/// Places along the rows of a field, a pixel apart. The line of a row goes on before its first leaf and behind its last: there plots may have
/// gaps that reach their edge, and plots without any leaf.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RowCover {
    /// The places that the raster shows, by row and along it.
    pub places_px: Vec<[f64; 2]>,
    places: Vec<RowPlace>,
    rows_px: Vec<[[f64; 2]; 2]>,
    apart_px: f64,
    min_gap_px: Option<f64>,
}

/// What there is to say of a place.
#[derive(Debug, Clone, Copy, PartialEq)]
struct RowPlace {
    row: usize,
    /// Its number along the row.
    along: i64,
    is_covered: bool,
    /// Whether it is before the first leaf of its row or behind the last.
    is_beyond: bool,
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
        let at = [u + k as f64 * du, v + k as f64 * dv];
        pixel(mask, at).is_some_and(|[u, v]| mask.get(u, v))
    })
}

/// The pixel of a raster at a position.
fn pixel(mask: &Mask, at: [f64; 2]) -> Option<[usize; 2]> {
    let at = at.map(f64::round);
    let [u, v] = at.map(|x| x as usize);
    (at[0] >= 0.0 && at[1] >= 0.0 && u < mask.width && v < mask.height).then_some([u, v])
}

/// Length of a straight row and the direction along it.
fn direction([from, to]: [[f64; 2]; 2]) -> (f64, [f64; 2]) {
    let [du, dv] = [to[0] - from[0], to[1] - from[1]];
    let length = du.hypot(dv);
    (length, if length > 0.0 { [du / length, dv / length] } else { [1.0, 0.0] })
}

/// The places along a straight row, a pixel apart, and the direction across it.
fn places(line: [[f64; 2]; 2]) -> (Vec<[f64; 2]>, [f64; 2]) {
    let (length, [du, dv]) = direction(line);
    let place = |k: usize| [line[0][0] + k as f64 * du, line[0][1] + k as f64 * dv];
    ((0..=length as usize).map(place).collect(), [-dv, du])
}

/// How far a position is from the line of a row.
fn distance_px(line: [[f64; 2]; 2], at: [f64; 2]) -> f64 {
    let (_, [du, dv]) = direction(line);
    ((at[1] - line[0][1]) * du - (at[0] - line[0][0]) * dv).abs()
}

impl RowCover {
    /// Follows the lines of straight rows over a mask, where `valid` shows something; nothing of a single row, whose width is not known.
    pub fn new(
        mask: &Mask,
        valid: Option<&Mask>,
        rows_px: &[[[f64; 2]; 2]],
        min_gap_px: Option<f64>,
    ) -> Option<RowCover> {
        let apart_px = apart_px(rows_px)?;
        let of_row = |(row, &line): (usize, &[[f64; 2]; 2])| {
            let (length, [du, dv]) = direction(line);
            let normal = [-dv, du];
            let last = length as i64;
            let at = |k: i64| [line[0][0] + k as f64 * du, line[0][1] + k as f64 * dv];
            let is_on = |k: &i64| pixel(mask, at(*k)).is_some();
            let before = (1..).map(|k| -k).take_while(is_on).count() as i64;
            let behind = (last + 1..).take_while(is_on).count() as i64;
            let is_seen = |k: &i64| {
                valid.is_none_or(|valid| across(valid, at(*k), normal, 0.0).any(|is_seen| is_seen))
            };
            let place = |along: i64| {
                let is_covered =
                    across(mask, at(along), normal, BETWEEN * apart_px).any(|is_leaf| is_leaf);
                let is_beyond = !(0..=last).contains(&along);
                (at(along), RowPlace { row, along, is_covered, is_beyond })
            };
            (-before..=last + behind).filter(is_seen).map(place).collect::<Vec<_>>()
        };
        let all: Vec<_> = rows_px.par_iter().enumerate().map(of_row).collect::<Vec<_>>().concat();
        let (places_px, places) = all.into_iter().unzip();
        Some(RowCover { places_px, places, rows_px: rows_px.to_vec(), apart_px, min_gap_px })
    }

    /// The places of an area. The line of a row goes on beyond its leaf to the edge of a plot, but not where it meets the rows of
    /// another part of the field; a whole field ends with its rows.
    fn within(&self, area: Area<'_>, members: &[usize]) -> Vec<usize> {
        let mut own = BTreeMap::new();
        for &k in members.iter().filter(|&&k| !self.places[k].is_beyond) {
            own.entry(self.places[k].row).or_insert(self.places_px[k]);
        }
        let goes_on = |row: usize| {
            let is_near =
                |at: &[f64; 2]| distance_px(self.rows_px[row], *at) < HALF * self.apart_px;
            own.contains_key(&row) || !own.values().any(is_near)
        };
        let rows: BTreeSet<usize> =
            members.iter().map(|&k| self.places[k].row).filter(|&row| goes_on(row)).collect();
        let is_of_area = |k: &usize| {
            let place = &self.places[*k];
            !place.is_beyond || !area.is_field && rows.contains(&place.row)
        };
        members.iter().copied().filter(is_of_area).collect()
    }

    /// Adds what the rows in an area tell; `members` are the places in it.
    pub(super) fn add(&self, found: &mut PlotTraits, area: Area<'_>, members: &[usize]) {
        let mut members = self.within(area, members);
        members.sort_unstable();
        let parts = PlotParts::of(area.polygon);
        let mut counts = [Counts::default(); PARTS];
        // A stretch along a row that is covered or not; nobody knows what is where the raster shows nothing.
        let together = |a: &usize, b: &usize| {
            let [a, b] = [a, b].map(|k| &self.places[*k]);
            (a.row, a.along + 1, a.is_covered) == (b.row, b.along, b.is_covered)
        };
        for stretch in members.chunk_by(together) {
            let is_covered = self.places[stretch[0]].is_covered;
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
        distance_px(a, [0, 1].map(|axis| 0.5 * (b[0][axis] + b[1][axis])))
    };
    median(rows_px.windows(2).map(distance).filter(|&apart| apart > 1.0))
}

/// What lines across rows show, a pixel apart.
#[derive(Debug, Clone, Copy)]
struct Across {
    /// Leaf pixels over the pixels between the first and the last of them, near 1 where the canopy has closed along the rows.
    solidity: f64,
    /// Mean number of those pixels on lines that meet leaf.
    width_px: f64,
    /// Share of lines that meet none.
    bare: f64,
}

fn across_rows(mask: &Mask, rows: &Rows) -> Option<Across> {
    let reach_px = HALF * rows.spacing_px?;
    let of_row = |row: &Row| {
        let ends = [row.start_px, row.end_px].map(|along| rows.axes.image([along, row.across_px]));
        let (places, normal) = places(ends);
        places.into_iter().fold([0usize; 4], |[leaf, width, met, lines], at| {
            let (mut first, mut last, mut here) = (None, 0, 0);
            for (k, is_leaf) in across(mask, at, normal, reach_px).enumerate() {
                if is_leaf {
                    first = first.or(Some(k));
                    (last, here) = (k + 1, here + 1);
                }
            }
            let here_px = first.map_or(0, |first| last - first);
            [leaf + here, width + here_px, met + usize::from(here > 0), lines + 1]
        })
    };
    let sums: Vec<[usize; 4]> = rows.rows.par_iter().map(of_row).collect();
    let sum = |k: usize| sums.iter().map(|of| of[k]).sum::<usize>() as f64;
    let [leaf, width, met, lines] = [0, 1, 2, 3].map(sum);
    (width > 0.0).then(|| Across {
        solidity: leaf / width,
        width_px: width / met,
        bare: 1.0 - met / lines,
    })
}

/// Rows of solid leaf: no line across them shows blades side by side.
pub(super) struct SolidRows {
    /// Whether the canopy has closed along them, so that nothing tells its plants apart.
    pub(super) is_closed: bool,
    /// How wide they are where there is leaf.
    pub(super) width_px: f64,
}

/// The rows, where they are solid.
pub(super) fn solid_rows(mask: &Mask, rows: &Rows) -> Option<SolidRows> {
    let Across { solidity, width_px, bare } = across_rows(mask, rows)?;
    (solidity >= SOLID).then(|| SolidRows {
        is_closed: bare <= BARE || width_px <= WIDTHS * stroke_px(mask),
        width_px,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::polygon::{Polygon, Positions};

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
        traits_of(&RowCover::new(&mask(), None, &rows(), Some(min_gap_px)).unwrap(), polygon, false)
    }

    fn traits_of(cover: &RowCover, polygon: &Polygon, is_field: bool) -> PlotTraits {
        let positions = Positions::new(cover.places_px.iter().copied());
        let mut found = PlotTraits::default();
        cover.add(&mut found, Area { name: "", polygon, is_field }, &positions.inside(polygon));
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
    fn gaps_at_the_ends_of_rows_and_dead_plots_are_seen() {
        // Leaf ends at 100 px; plots go on to 140 px, the next ones are dead.
        let mask = Mask::from_fn(200, 60, |u, v| u < 100 && v % 20 >= 6 && v % 20 < 14);
        let to = |end: f64| rows().into_iter().map(move |[from, to]| [from, [end, to[1]]]);
        let cover = |valid: Option<&Mask>, rows: &[[[f64; 2]; 2]]| {
            RowCover::new(&mask, valid, rows, Some(20.0)).unwrap()
        };
        let of = |cover: &RowCover, from: f64, to: f64, is_field: bool| {
            let found = traits_of(cover, &rectangle([from, -0.5], [to, 59.5]), is_field);
            (found.row_cover, found.row_gap_share)
        };
        let ending = cover(None, &to(99.0).collect::<Vec<_>>());
        assert_eq!(of(&ending, 39.5, 139.5, false), (Some(0.6), Some(0.4)));
        assert_eq!(of(&ending, 139.5, 199.5, false), (Some(0.0), Some(1.0)));
        assert_eq!(of(&ending, 39.5, 139.5, true), (Some(1.0), Some(0.0)));
        // Rows of the next block, half a distance beside, are not those of this one.
        let other = rows().into_iter().map(|[[_, v], _]| [[150.0, v + 9.0], [199.0, v + 9.0]]);
        let both = cover(None, &to(99.0).chain(other).collect::<Vec<_>>());
        assert_eq!(
            both.within(area(&rectangle([150.0, 0.0], [199.0, 59.5])), &in_last_quarter(&both))
                .len(),
            150
        );
        // Of 40 px without leaf the raster shows 15 at either end: too short for gaps.
        let hole = Mask::from_fn(200, 60, |u, _| !(115..125).contains(&u));
        let holed = cover(Some(&hole), &to(99.0).collect::<Vec<_>>());
        assert_eq!(of(&holed, 39.5, 139.5, false), (Some(60.0 / 90.0), Some(0.0)));
    }

    fn area(polygon: &Polygon) -> Area<'_> {
        Area { name: "", polygon, is_field: false }
    }

    fn in_last_quarter(cover: &RowCover) -> Vec<usize> {
        (0..cover.places_px.len()).filter(|&k| cover.places_px[k][0] >= 150.0).collect()
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
        for (mask, expected) in [(closed, Some(true)), (crossed, None), (young, Some(false))] {
            let is_closed = solid_rows(&mask, rows).map(|solid| solid.is_closed);
            let across = across_rows(&mask, rows);
            assert_eq!(is_closed, expected, "{across:?}, {}", stroke_px(&mask));
        }
    }
}
