//! From corners to grids: who is whose neighbour, which rows and columns that makes, and what is
//! missing in between.
//!
//! Two corners are neighbours where each lies along an edge of the other, the picture really has
//! an edge between them, and bright and dark change sides: the sides of an edge swap at every
//! corner it passes.

use super::{
    grey::Grey,
    refine::refine,
    shape::{Corner, Ring},
};
use std::{
    collections::{BTreeMap, VecDeque},
    f64::consts::PI,
};

/// Corners by their place in a grid, `(column, row)`; a step in columns and one in rows are a
/// right-handed pair in the picture.
pub(super) type Grid = BTreeMap<(i32, i32), Corner>;

/// How far a neighbour may be off the direction of an edge: a wide lens bends edges.
const CONE_RAD: f64 = 0.45;
/// Share of the contrast that an edge must have wherever it is looked at.
const MIN_EDGE: f64 = 0.3;

/// The grids of a picture, the largest first.
pub(super) fn grids(blurred: &Grey, corners: &[Corner]) -> Vec<Grid> {
    let links = squares(corners, &links(blurred, corners));
    let mut placed = vec![false; corners.len()];
    let mut grids = Vec::new();
    for seed in 0..corners.len() {
        if placed[seed] || links[seed].iter().flatten().count() < 2 {
            continue;
        }
        grids.push(walk(corners, &links, seed, &mut placed));
    }
    grids.sort_by_key(|grid: &Grid| std::cmp::Reverse(grid.len()));
    grids
}

/// For each corner and edge the neighbour and the edge of the neighbour that leads back.
type Links = Vec<[Option<(usize, usize)>; 4]>;

fn links(blurred: &Grey, corners: &[Corner]) -> Links {
    use rayon::prelude::*;
    let buckets = Buckets::new(blurred, corners);
    let best: Links = (0..corners.len())
        .into_par_iter()
        .map(|k| {
            let mut best: [Option<(f64, usize, usize)>; 4] = [None; 4];
            buckets.near(corners[k].at, |other| {
                if let Some((cost, edge, back)) =
                    candidate(&corners[k], &corners[other], k == other)
                    && best[edge].is_none_or(|(least, ..)| cost < least)
                    && has_edge(blurred, &corners[k], &corners[other], edge)
                {
                    best[edge] = Some((cost, other, back));
                }
            });
            best.map(|found| found.map(|(_, other, back)| (other, back)))
        })
        .collect();
    // Only what both ends agree on.
    let mut mutual = best.clone();
    for (k, edges) in mutual.iter_mut().enumerate() {
        for (edge, link) in edges.iter_mut().enumerate() {
            *link = link.filter(|&(other, back)| best[other][back] == Some((k, edge)));
        }
    }
    mutual
}

/// The links that are a side of a square: two steps the one way round lead to the same corner as
/// two the other way, and opposite sides are of about the same length. Whatever lines up with a
/// board by chance is not.
fn squares(corners: &[Corner], links: &Links) -> Links {
    let length = |a: usize, b: usize| {
        let (a, b) = (corners[a].at, corners[b].at);
        (a[0] - b[0]).hypot(a[1] - b[1])
    };
    // `turn` is 1 for the square towards larger angles and 3 for the other.
    let closes = |corner: usize, edge: usize, turn: usize| {
        let (other, back) = links[corner][edge]?;
        let (beside, back_beside) = links[corner][(edge + turn) % 4]?;
        let (opposite, _) = links[other][(back + 4 - turn) % 4]?;
        let (again, _) = links[beside][(back_beside + turn) % 4]?;
        let ratio = length(corner, other) / length(beside, opposite);
        let ratio_beside = length(corner, beside) / length(other, opposite);
        let alike = |ratio: f64| (1.0 / MAX_SIDE_RATIO..=MAX_SIDE_RATIO).contains(&ratio);
        (opposite == again && alike(ratio) && alike(ratio_beside)).then_some(())
    };
    let mut kept = links.clone();
    for (corner, edges) in kept.iter_mut().enumerate() {
        for (edge, link) in edges.iter_mut().enumerate() {
            if closes(corner, edge, 1).or_else(|| closes(corner, edge, 3)).is_none() {
                *link = None;
            }
        }
    }
    kept
}

/// Opposite sides of a square differ by perspective and lens, not by more than this.
const MAX_SIDE_RATIO: f64 = 2.5;

/// How well `other` would do as a neighbour: distance, made longer by the angles it is off; and
/// by which edge of either.
fn candidate(corner: &Corner, other: &Corner, same: bool) -> Option<(f64, usize, usize)> {
    let (du, dv) = (other.at[0] - corner.at[0], other.at[1] - corner.at[1]);
    let distance = du.hypot(dv);
    if same || distance < 4.0 {
        return None;
    }
    let angle = dv.atan2(du);
    let (edge, off) = corner.nearest_edge(angle);
    let (back, off_back) = other.nearest_edge(angle + PI);
    if off > CONE_RAD || off_back > CONE_RAD || corner.rises(edge) == other.rises(back) {
        return None;
    }
    let ratio = corner.contrast / other.contrast;
    if !(0.2..=5.0).contains(&ratio) {
        return None;
    }
    Some((distance * (1.0 + 2.0 * (off + off_back)), edge, back))
}

/// Whether an edge leads from one corner to the other, with bright and dark on their sides.
fn has_edge(blurred: &Grey, corner: &Corner, other: &Corner, edge: usize) -> bool {
    let along = [other.at[0] - corner.at[0], other.at[1] - corner.at[1]];
    let length = along[0].hypot(along[1]);
    // Towards larger angles.
    let across = [-along[1] / length, along[0] / length];
    let sign = if corner.rises(edge) { 1.0 } else { -1.0 };
    let least = MIN_EDGE * corner.contrast.min(other.contrast);
    let reach = (0.2 * length).clamp(1.5, 12.0);
    [0.3, 0.5, 0.7].iter().all(|share| {
        let at = [corner.at[0] + share * along[0], corner.at[1] + share * along[1]];
        let side = |s: f64| blurred.sample([at[0] + s * across[0], at[1] + s * across[1]]);
        match (side(reach), side(-reach)) {
            (Some(after), Some(before)) => sign * (after - before) > least,
            _ => false,
        }
    })
}

/// Corners by the square of the picture they lie in.
struct Buckets {
    side: f64,
    columns: usize,
    rows: usize,
    corners: Vec<Vec<usize>>,
}

impl Buckets {
    /// Neighbours are looked for within so many pixels at least, in all directions.
    const MIN_REACH_PX: f64 = 64.0;

    fn new(picture: &Grey, corners: &[Corner]) -> Buckets {
        // A board that fills the picture has few squares of up to a third of it.
        let long = picture.width.max(picture.height) as f64;
        let few = corners.len() < 1000;
        let side = if few { long / 3.0 } else { (long / 12.0).max(Self::MIN_REACH_PX) };
        let columns = (picture.width as f64 / side) as usize + 1;
        let rows = (picture.height as f64 / side) as usize + 1;
        let mut buckets =
            Buckets { side, columns, rows, corners: vec![Vec::new(); columns * rows] };
        for (k, corner) in corners.iter().enumerate() {
            let [column, row] = buckets.place(corner.at);
            buckets.corners[row * columns + column].push(k);
        }
        buckets
    }

    fn place(&self, at: [f64; 2]) -> [usize; 2] {
        [
            ((at[0] / self.side) as usize).min(self.columns - 1),
            ((at[1] / self.side) as usize).min(self.rows - 1),
        ]
    }

    fn near(&self, at: [f64; 2], mut each: impl FnMut(usize)) {
        let [column, row] = self.place(at);
        for row in row.saturating_sub(1)..=(row + 1).min(self.rows - 1) {
            for column in column.saturating_sub(1)..=(column + 1).min(self.columns - 1) {
                self.corners[row * self.columns + column].iter().for_each(|&k| each(k));
            }
        }
    }
}

/// The steps of the four edges of a corner whose edge `right` leads to the next column.
const STEPS: [(i32, i32); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];

/// Everybody that can be reached from a seed, by neighbours.
fn walk(corners: &[Corner], links: &Links, seed: usize, placed: &mut [bool]) -> Grid {
    let mut grid = Grid::new();
    let mut queue = VecDeque::from([(seed, (0, 0), 0usize)]);
    placed[seed] = true;
    grid.insert((0, 0), corners[seed]);
    while let Some((corner, place, right)) = queue.pop_front() {
        for edge in 0..4 {
            let Some((other, back)) = links[corner][edge] else { continue };
            let turn = (edge + 4 - right) % 4;
            let there = (place.0 + STEPS[turn].0, place.1 + STEPS[turn].1);
            if placed[other] || grid.contains_key(&there) {
                continue;
            }
            placed[other] = true;
            grid.insert(there, corners[other]);
            // Its edge `back` leads the opposite way, so `right` lies `turn + 2` before it.
            queue.push_back((other, there, (back + 4 - (turn + 2) % 4) % 4));
        }
    }
    grid
}

/// Adds what is missing beside and between the corners of a grid, where the picture shows a corner
/// at the place that its neighbours predict.
pub(super) fn grow(picture: &Grey, blurred: &Grey, ring: &Ring, grid: &mut Grid) {
    loop {
        let mut wanted: Vec<(i32, i32)> = grid
            .keys()
            .flat_map(|&(i, j)| STEPS.map(|(di, dj)| (i + di, j + dj)))
            .filter(|place| !grid.contains_key(place))
            .collect();
        wanted.sort_unstable();
        wanted.dedup();
        let found: Vec<_> = wanted
            .into_iter()
            .filter_map(|place| Some((place, grown(picture, blurred, ring, grid, place)?)))
            .collect();
        if found.is_empty() {
            return;
        }
        grid.extend(found);
    }
}

fn grown(
    picture: &Grey,
    blurred: &Grey,
    ring: &Ring,
    grid: &Grid,
    place: (i32, i32),
) -> Option<Corner> {
    let (at, spacing) = predict(grid, place)?;
    let half = ((0.3 * spacing) as usize).clamp(2, 8);
    let at = {
        let refined = refine(picture, at, half)?;
        let off = (refined[0] - at[0]).hypot(refined[1] - at[1]);
        (off < 0.25 * spacing).then_some(refined)?
    };
    let radii = [5.0, 3.5, 2.5];
    let corner = radii
        .iter()
        .filter(|&&radius| radius < 0.45 * spacing)
        .find_map(|&radius| ring.corner(blurred, at, radius))?;
    // It must continue the edges of every neighbour that is there, and no corner may be taken twice.
    let mut count = 0;
    for (di, dj) in STEPS {
        let Some(neighbour) = grid.get(&(place.0 + di, place.1 + dj)) else { continue };
        let (_, edge, _) = candidate(neighbour, &corner, false)?;
        let contrast = corner.contrast / neighbour.contrast;
        let step = (neighbour.at[0] - at[0]).hypot(neighbour.at[1] - at[1]);
        let before = grid
            .get(&(place.0 + 2 * di, place.1 + 2 * dj))
            .map(|behind| (neighbour.at[0] - behind.at[0]).hypot(neighbour.at[1] - behind.at[1]));
        if !(0.4..=2.5).contains(&contrast)
            || before.is_some_and(|before| !(0.5..=2.0).contains(&(step / before)))
            || !has_edge(blurred, neighbour, &corner, edge)
        {
            return None;
        }
        count += 1;
    }
    let taken =
        grid.values().any(|other| (other.at[0] - at[0]).hypot(other.at[1] - at[1]) < 0.4 * spacing);
    (count > 0 && !taken).then_some(corner)
}

/// Where a missing corner should be, and the distance to the nearest corner from there: the mean
/// of what the lines through the place say.
fn predict(grid: &Grid, (i, j): (i32, i32)) -> Option<([f64; 2], f64)> {
    let at = |di: i32, dj: i32| grid.get(&(i + di, j + dj)).map(|corner| corner.at);
    let mut predictions: Vec<([f64; 2], f64)> = Vec::new();
    for (di, dj) in STEPS {
        let line = |k: i32| at(k * di, k * dj);
        match (line(1), line(2), line(3)) {
            (Some(a), Some(b), Some(c)) => {
                let p = std::array::from_fn(|k| 3.0 * a[k] - 3.0 * b[k] + c[k]);
                predictions.push((p, 1.0));
            }
            (Some(a), Some(b), None) => {
                predictions.push((std::array::from_fn(|k| 2.0 * a[k] - b[k]), 0.5));
            }
            _ => {}
        }
        // Between two on the same line, and by the fourth corner of a square.
        if (di, dj) > (0, 0)
            && let (Some(a), Some(b)) = (line(1), line(-1))
        {
            predictions.push((std::array::from_fn(|k| 0.5 * (a[k] + b[k])), 2.0));
        }
        let (ei, ej) = (-dj, di);
        if let (Some(a), Some(b), Some(c)) = (line(1), at(ei, ej), at(di + ei, dj + ej)) {
            predictions.push((std::array::from_fn(|k| a[k] + b[k] - c[k]), 0.7));
        }
    }
    let total: f64 = predictions.iter().map(|(_, weight)| weight).sum();
    if total < 0.5 {
        return None;
    }
    let mean: [f64; 2] = std::array::from_fn(|k| {
        predictions.iter().map(|(p, weight)| weight * p[k]).sum::<f64>() / total
    });
    let spacing = STEPS
        .iter()
        .filter_map(|&(di, dj)| at(di, dj))
        .map(|p| (p[0] - mean[0]).hypot(p[1] - mean[1]))
        .fold(f64::INFINITY, f64::min);
    (spacing.is_finite() && spacing > 4.0).then_some((mean, spacing))
}

/// Cuts off outer rows and columns of which less than half is there, until none is left: what
/// belongs to something else beside the board.
pub(super) fn trim(grid: &mut Grid) {
    loop {
        let Some((low, high)) = bounds(grid) else { return };
        let (columns, rows) = ((high.0 - low.0 + 1) as usize, (high.1 - low.1 + 1) as usize);
        let in_row = |j: i32| grid.keys().filter(|place| place.1 == j).count();
        let in_column = |i: i32| grid.keys().filter(|place| place.0 == i).count();
        let sides = [
            (in_column(low.0), rows, 0, low.0),
            (in_column(high.0), rows, 0, high.0),
            (in_row(low.1), columns, 1, low.1),
            (in_row(high.1), columns, 1, high.1),
        ];
        // The emptiest side first.
        let worst = sides.iter().min_by(|a, b| (a.0 * b.1).cmp(&(b.0 * a.1)));
        match worst {
            Some(&(count, length, axis, at)) if 2 * count < length => {
                grid.retain(|place, _| if axis == 0 { place.0 != at } else { place.1 != at });
            }
            _ => return,
        }
    }
}

/// The smallest and largest column and row.
pub(super) fn bounds(grid: &Grid) -> Option<((i32, i32), (i32, i32))> {
    let mut keys = grid.keys();
    let first = *keys.next()?;
    Some(keys.fold((first, first), |(low, high), place| {
        ((low.0.min(place.0), low.1.min(place.1)), (high.0.max(place.0), high.1.max(place.1)))
    }))
}
