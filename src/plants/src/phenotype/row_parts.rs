//! The parts of rows that have plants: rows end at alleys and go on behind them.
//!
//! A stretch of a row is bare where a window of [`BARE`] spacings has less leaf than [`TRACE`] of what a plant has. Where most
//! of the rows beside it are bare too, it is an alley, in which nothing is missing; else plants are missing in it, however long it is.
//! Between bare stretches a row has parts, each with its own first and last plant. All lengths in pixels of the reduced grid.

use super::{
    row_curves::RowCurve,
    row_profile::{Profile, STEP},
};
use std::ops::Range;

/// Length of a bare window, in spacings. Leaves reach half a spacing into it from either side: plants are four spacings apart.
const BARE: f64 = 3.0;
/// Leaf mass of a bare window, at most, in that of a plant.
const TRACE: f64 = 0.1;
/// A part of a row with less leaf mass, in that of a plant, holds no plant of the crop.
const MIN_PART_MASS: f64 = 0.3;
/// Rows to either side that are asked whether a stretch is an alley.
const BESIDE: usize = 3;
/// Share of those that are bare there, at least.
const AGREE: f64 = 0.6;

/// A stretch of a row without leaf.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bare {
    /// Where it begins along the row.
    pub(super) start: f64,
    /// Where it ends.
    pub(super) end: f64,
    /// Whether the rows beside it are bare there too.
    pub(super) is_alley: bool,
}

/// A part of a row with plants.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Part {
    /// Number of its row.
    pub(super) row: usize,
    /// Its course.
    pub(super) curve: RowCurve,
    /// What lies between it and the part of the same row before it.
    pub(super) before: Option<Bare>,
}

/// Cuts rows at their bare stretches. `mass` is the leaf mass of a plant, `spacing` the distance between plants.
pub(super) fn cut(profiles: &[Profile], curves: &[RowCurve], spacing: f64, mass: f64) -> Vec<Part> {
    let bare: Vec<Vec<[f64; 2]>> =
        profiles.iter().map(|profile| bare_stretches(profile, spacing, TRACE * mass)).collect();
    let mut parts = Vec::new();
    for (row, curve) in curves.iter().enumerate() {
        let mut start = curve.start;
        let mut before: Option<Bare> = None;
        let mut found: Vec<Part> = Vec::new();
        let ends = [curve.end, f64::INFINITY];
        for [from, to] in bare[row].iter().copied().chain([ends]) {
            let end = from.min(curve.end);
            if end > start && mass_between(&profiles[row], start, end) >= MIN_PART_MASS * mass {
                let curve = curve.part(start, end);
                found.push(Part { row, curve, before: before.take() });
            }
            // Stretches on both sides of a speck are one.
            let begin = before.map_or(from, |bare| bare.start);
            let middle = 0.5 * (begin + to);
            let reaches = |row: usize| curves[row].start < middle && middle < curves[row].end;
            let is_bare = |row: usize| bare[row].iter().any(|b| b[0] < middle && middle < b[1]);
            let is_alley = is_alley(curves.len(), row, reaches, is_bare);
            before = (!found.is_empty()).then_some(Bare { start: begin, end: to, is_alley });
            start = to.max(start);
        }
        if found.is_empty() {
            // A row that is all bare stays as it is.
            found.push(Part { row, curve: curve.clone(), before: None });
        }
        parts.append(&mut found);
    }
    parts
}

/// Leaf mass between two places along a row.
fn mass_between(profile: &Profile, from: f64, to: f64) -> f64 {
    let last = profile.mass.len() - 1;
    let step = |at: f64| (((at - profile.start) / STEP).max(0.0) as usize).min(last);
    profile.mass[step(to)][0] - profile.mass[step(from)][0]
}

/// Windows with next to no leaf mass, joined where they overlap: where they begin and end along the row.
fn bare_stretches(profile: &Profile, spacing: f64, trace: f64) -> Vec<[f64; 2]> {
    let window = ((BARE * spacing / STEP) as usize).max(1);
    let mut found: Vec<Range<usize>> = Vec::new();
    for from in 0..profile.mass.len().saturating_sub(window) {
        let to = from + window;
        if profile.mass[to][0] - profile.mass[from][0] > trace {
            continue;
        }
        match found.last_mut().filter(|last| from <= last.end) {
            Some(last) => last.end = to,
            None => found.push(from..to),
        }
    }
    let along = |step: usize| profile.start + step as f64 * STEP;
    found.into_iter().map(|steps| [along(steps.start), along(steps.end)]).collect()
}

/// Whether most of the rows beside one of `rows` rows, those that reach beyond a stretch of it, are bare there.
pub(super) fn is_alley(
    rows: usize,
    row: usize,
    reaches: impl Fn(usize) -> bool,
    is_bare: impl Fn(usize) -> bool,
) -> bool {
    let below = (0..row).rev().filter(|&row| reaches(row)).take(BESIDE);
    let above = (row + 1..rows).filter(|&row| reaches(row)).take(BESIDE);
    let asked: Vec<usize> = below.chain(above).collect();
    let agree = asked.iter().filter(|&&row| is_bare(row)).count();
    !asked.is_empty() && agree as f64 >= AGREE * asked.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phenotype::rows::Row;

    /// Rows of 60 plants 12 apart, without the plants that `missing` names.
    fn rows(rows: usize, missing: impl Fn(usize, usize) -> bool) -> (Vec<Profile>, Vec<RowCurve>) {
        let profile = |row: usize| {
            let steps = 1440;
            let mut mass = vec![[0.0; 2]];
            let mut sum = [0.0; 2];
            for step in 0..steps {
                let along = step as f64 * STEP;
                let plant = (along / 12.0) as usize;
                let is_leaf = (along - 12.0 * (plant as f64 + 0.5)).abs() < 4.0;
                let here = if is_leaf && !missing(row, plant) { 1.0 } else { 0.0 };
                sum = [sum[0] + here, sum[1] + here * step as f64];
                mass.push(sum);
            }
            Profile {
                start: 0.0,
                votes: vec![1.0; steps],
                offsets: vec![0.0; steps],
                mass,
                surroundings: Vec::new(),
            }
        };
        let curve = |row: usize| {
            let across_px = 40.0 * row as f64;
            RowCurve::straight(&Row { across_px, start_px: 0.0, end_px: 720.0, pixels: 1 })
        };
        ((0..rows).map(profile).collect(), (0..rows).map(curve).collect())
    }

    #[test]
    fn rows_are_cut_at_alleys_and_at_long_gaps() {
        let alley = |_: usize, plant: usize| (20..26).contains(&plant);
        let gap = |row: usize, plant: usize| row == 2 && (40..48).contains(&plant);
        let (profiles, curves) = rows(5, |row, plant| alley(row, plant) || gap(row, plant));
        let parts = cut(&profiles, &curves, 12.0, 15.0);
        assert_eq!(parts.len(), 11);
        for part in &parts {
            match part.before {
                None => assert_eq!(part.curve.start, 0.0),
                Some(bare) if bare.is_alley => {
                    assert!((bare.start - 240.0).abs() < 4.0 && (bare.end - 312.0).abs() < 4.0);
                }
                Some(bare) => {
                    assert_eq!(part.row, 2);
                    assert!((bare.start - 480.0).abs() < 4.0 && (bare.end - 576.0).abs() < 4.0);
                }
            }
            assert!(
                (part.curve.offset(part.curve.start + 5.0) - 40.0 * part.row as f64).abs() < 1e-9
            );
        }
    }

    #[test]
    fn short_gaps_lone_rows_and_bare_rows() {
        let (profiles, curves) = rows(4, |_, plant| plant % 20 < 2);
        assert!(cut(&profiles, &curves, 12.0, 15.0).iter().all(|part| part.before.is_none()));
        let (profiles, curves) = rows(1, |_, plant| (20..30).contains(&plant));
        let parts = cut(&profiles, &curves, 12.0, 15.0);
        assert!(parts.len() == 2 && !parts[1].before.unwrap().is_alley);
        let (profiles, curves) = rows(2, |_, _| true);
        let parts = cut(&profiles, &curves, 12.0, 15.0);
        assert_eq!(parts.iter().map(|part| part.row).collect::<Vec<_>>(), [0, 1]);
    }
}
