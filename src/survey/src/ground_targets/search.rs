//! Where in a piece of a photo something looks like a target: normalised cross-correlation with its shape in a few turns, on a
//! level of the photo on which a target has about 8 pixels; the best places are fitted, and codes read.
//!
//! ```text
//! r = sum t g / sqrt(sum t^2 (sum g^2 - (sum g)^2/n)),     sum t = 0
//! ```

use super::{
    TargetKind,
    codes::{APRILTAG, ARUCO, Family, Reading},
    fit::{Fit, Jacobian, fit, px_per_m},
    patch::Patch,
    shape::Shape,
};
use std::f64::consts::{FRAC_PI_2, TAU};

/// Pixels of a target on the level that is searched; coded ones have a border of one cell that has to be seen.
const SEARCHED_PX: f64 = 8.0;
const SEARCHED_CODED_PX: f64 = 16.0;
/// Turns that are tried in a quarter of a circle: a pattern that is turned by 11 degrees still correlates by 0.8.
const TURNS: usize = 4;
/// Places that correlate less are not fitted.
const MIN_CORRELATION: f64 = 0.35;
/// Places that are fitted.
const MAX_PLACES: usize = 24;
/// Fits that are handed on, for the other photos to decide among.
const MAX_CANDIDATES: usize = 6;

/// A place that looks like a target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    pub(super) fit: Fit,
    pub(super) code: Option<usize>,
}

/// What is looked for.
#[derive(Debug, Clone)]
pub(super) struct Wanted {
    pub(super) kind: TargetKind,
    pub(super) size_m: f64,
    pub(super) min_score: f64,
    shape: Shape,
}

/// What a search of one piece of a photo found.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Searched {
    /// The best first.
    pub(super) candidates: Vec<Candidate>,
    /// The best score of those that were refused, and whether a code could not be read.
    pub(super) refused: Option<(f64, bool)>,
}

impl Wanted {
    pub(super) fn new(kind: TargetKind, size_m: f64, min_score: f64) -> Wanted {
        Wanted { kind, size_m, min_score, shape: Shape::of(kind) }
    }

    /// The same, also of what is less alike.
    pub(super) fn with_min_score(self, min_score: f64) -> Wanted {
        Wanted { min_score, ..self }
    }

    fn family(&self) -> Option<&'static Family> {
        match self.kind {
            TargetKind::Apriltag => Some(&APRILTAG),
            TargetKind::Aruco => Some(&ARUCO),
            TargetKind::Chequered | TargetKind::Cross | TargetKind::Disc => None,
        }
    }

    /// Candidates whose centres are within `radius_px` of a place.
    pub(super) fn search(
        &self,
        patch: &Patch,
        ground: &Jacobian,
        centre_px: [f64; 2],
        radius_px: f64,
    ) -> Searched {
        let size_px = px_per_m(ground) * self.size_m;
        let wanted_px = if self.family().is_some() { SEARCHED_CODED_PX } else { SEARCHED_PX };
        let level = patch.reduced((size_px / wanted_px) as usize);
        let mut places = self.places(&level, ground, centre_px, radius_px);
        places.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1[0].total_cmp(&b.1[0])));
        let mut found = Searched::default();
        let mut chosen: Vec<[f64; 2]> = Vec::new();
        for (_, at_px, turn_rad) in places {
            let near =
                |other: &[f64; 2]| (other[0] - at_px[0]).hypot(other[1] - at_px[1]) < 0.4 * size_px;
            if chosen.iter().any(near) {
                continue;
            }
            chosen.push(at_px);
            match self.measure(patch, ground, at_px, turn_rad) {
                Ok(candidate) => found.candidates.push(candidate),
                Err((score, unread)) => {
                    let better = found.refused.is_none_or(|(best, _)| score > best);
                    if better {
                        found.refused = Some((score, unread));
                    }
                }
            }
            if chosen.len() >= MAX_PLACES {
                break;
            }
        }
        let inside = |candidate: &Candidate| {
            let [u, v] = candidate.fit.centre_px;
            (u - centre_px[0]).hypot(v - centre_px[1]) <= radius_px + 0.5 * size_px
        };
        found.candidates.retain(inside);
        found.candidates.sort_by(|a, b| b.fit.score.total_cmp(&a.fit.score));
        let mut apart: Vec<Candidate> = Vec::new();
        for candidate in found.candidates {
            let [u, v] = candidate.fit.centre_px;
            let twin = |other: &Candidate| {
                (other.fit.centre_px[0] - u).hypot(other.fit.centre_px[1] - v) < 0.4 * size_px
            };
            if apart.len() < MAX_CANDIDATES && !apart.iter().any(twin) {
                apart.push(candidate);
            }
        }
        found.candidates = apart;
        found
    }

    /// Local maxima of the correlation: its value, the place in the photo, the turn.
    fn places(
        &self,
        level: &Patch,
        ground: &Jacobian,
        centre_px: [f64; 2],
        radius_px: f64,
    ) -> Vec<(f64, [f64; 2], f64)> {
        let templates: Vec<Template> = self.templates(level, ground);
        let (columns, rows) = level.window(level.in_patch(centre_px), radius_px / level.factor);
        let (width, height) = (columns.len(), rows.len());
        let mut values = vec![(0.0f32, 0usize); width * height];
        let mut correlations = vec![0.0f32; width];
        for (values, j) in values.chunks_mut(width.max(1)).zip(rows.clone()) {
            for (number, template) in templates.iter().enumerate() {
                template.correlate_row(level, columns.start, j, &mut correlations);
                for (value, &correlation) in values.iter_mut().zip(&correlations) {
                    if correlation > value.0 {
                        *value = (correlation, number);
                    }
                }
            }
        }
        let is_peak = |k: usize| {
            let (i, j) = (k % width, k / width);
            (j.saturating_sub(1)..(j + 2).min(height)).all(|row| {
                (i.saturating_sub(1)..(i + 2).min(width)).all(|column| {
                    let other = row * width + column;
                    values[other].0 < values[k].0
                        || other == k
                        || (values[other].0 == values[k].0 && other > k)
                })
            })
        };
        (0..values.len())
            .filter(|&k| f64::from(values[k].0) >= MIN_CORRELATION && is_peak(k))
            .map(|k| {
                let at = [(columns.start + k % width) as f64, (rows.start + k / width) as f64];
                (f64::from(values[k].0), level.to_photo(at), templates[values[k].1].turn_rad)
            })
            .collect()
    }

    fn templates(&self, level: &Patch, ground: &Jacobian) -> Vec<Template> {
        let turns = match self.shape.period_rad {
            None => vec![0.0],
            Some(period) => (0..TURNS).map(|k| period * k as f64 / TURNS as f64).collect(),
        };
        let make = |&turn_rad: &f64| Template::new(self, level.factor, ground, turn_rad);
        // A chequered target that is turned by a quarter has white and black exchanged.
        let both = self.kind == TargetKind::Chequered;
        let mut turns: Vec<f64> = turns;
        if both {
            let further: Vec<f64> = turns.iter().map(|turn| turn + FRAC_PI_2).collect();
            turns.extend(further);
        }
        turns.iter().map(make).collect()
    }

    /// Fits a place from the turn of its template, then, where that is not enough, from those halfway to the next ones.
    fn measure(
        &self,
        patch: &Patch,
        ground: &Jacobian,
        at_px: [f64; 2],
        turn_rad: f64,
    ) -> Result<Candidate, (f64, bool)> {
        let half = self.shape.period_rad.map_or(0.0, |period| 0.5 * period / TURNS as f64);
        let mut refused = (0.0, false);
        for turn_rad in [turn_rad, turn_rad + half, turn_rad - half] {
            match self.measure_turned(patch, ground, at_px, turn_rad) {
                Ok(found) => return Ok(found),
                Err((score, unread)) => refused = (f64::max(score, refused.0), unread | refused.1),
            }
            if half == 0.0 {
                break;
            }
        }
        Err(refused)
    }

    /// Fits a place, and reads its code.
    fn measure_turned(
        &self,
        patch: &Patch,
        ground: &Jacobian,
        at_px: [f64; 2],
        turn_rad: f64,
    ) -> Result<Candidate, (f64, bool)> {
        let geometry = (ground, self.size_m);
        let found = fit(patch, &self.shape, geometry, at_px, turn_rad).ok_or((0.0, false))?;
        let Some(family) = self.family() else {
            return match found.score >= self.min_score {
                true => Ok(Candidate { fit: found, code: None }),
                false => Err((found.score, false)),
            };
        };
        let unread = (found.score, found.score >= self.min_score);
        let reading = read_code(patch, family, geometry, &found).ok_or(unread)?;
        // Read with its top up, the target is turned by what the word had to be turned.
        let turn_rad = (found.turn_rad + FRAC_PI_2 * reading.turns as f64) % TAU;
        let shape = Shape::coded(family, Some(reading.code));
        let whole = fit(patch, &shape, geometry, found.centre_px, turn_rad).ok_or(unread)?;
        match whole.score >= self.min_score {
            true => Ok(Candidate { fit: whole, code: Some(reading.code) }),
            false => Err((whole.score, true)),
        }
    }
}

/// The code within a border that was fitted: cells brighter than the middle of white and black are white.
fn read_code(
    patch: &Patch,
    family: &Family,
    (ground, size_m): (&Jacobian, f64),
    border: &Fit,
) -> Option<Reading> {
    let (sin, cos) = border.turn_rad.sin_cos();
    let size = size_m * border.scale;
    let cell = 1.0 / (family.cells + 2) as f64;
    let middle = 0.5 * (border.grey[1] + border.grey[2]);
    let mut white = Vec::with_capacity(family.cells * family.cells);
    for row in 0..family.cells {
        for column in 0..family.cells {
            let (mut sum, mut count) = (0.0, 0.0);
            // The middle half of the cell, on a grid of 3 x 3.
            for k in 0..9 {
                let offset = [k % 3, k / 3].map(|at| (f64::from(at) - 1.0) * 0.25);
                let [x, y] = [(column, offset[0]), (row, offset[1])]
                    .map(|(at, offset)| -0.5 + cell * (at as f64 + 1.5 + offset));
                let turned = [size * (x * cos - y * sin), size * (x * sin + y * cos)];
                let at_px = std::array::from_fn(|k| {
                    border.centre_px[k] + ground[k][0] * turned[0] + ground[k][1] * turned[1]
                });
                sum += patch.sample(at_px)?;
                count += 1.0;
            }
            white.push(sum / count > middle);
        }
    }
    family.decode(&white)
}

/// A shape on the pixels of a level, with mean 0 and sum of squares 1.
struct Template {
    turn_rad: f64,
    /// Its pixels are no farther from the middle, along each axis.
    half: i32,
    pixels: Vec<(i32, i32, f32)>,
}

impl Template {
    fn new(wanted: &Wanted, factor: f64, ground: &Jacobian, turn_rad: f64) -> Template {
        let (sin, cos) = turn_rad.sin_cos();
        let side = px_per_m(ground) * wanted.size_m / factor;
        let determinant = ground[0][0] * ground[1][1] - ground[0][1] * ground[1][0];
        let scale = factor / (wanted.size_m * determinant);
        let place = |i: i32, j: i32| {
            let (i, j) = (f64::from(i), f64::from(j));
            let east = scale * (ground[1][1] * i - ground[0][1] * j);
            let south = scale * (ground[0][0] * j - ground[1][0] * i);
            [east * cos + south * sin, south * cos - east * sin]
        };
        let half = (1.5 * side * wanted.shape.reach).ceil() as i32;
        let square = (-half..=half).flat_map(|j| (-half..=half).map(move |i| (i, j)));
        let mut pixels: Vec<(i32, i32, f32)> = square
            .filter(|&(i, j)| wanted.shape.covers(place(i, j)))
            .map(|(i, j)| {
                let [white, black] = wanted.shape.shares(place(i, j), 0.7 / side);
                // The ground around a cross or a disc is as dark as its plate may be.
                let value = match wanted.kind {
                    TargetKind::Cross | TargetKind::Disc => white,
                    _ => white - black,
                };
                (i, j, value as f32)
            })
            .collect();
        let mean = pixels.iter().map(|p| p.2).sum::<f32>() / pixels.len().max(1) as f32;
        pixels.iter_mut().for_each(|p| p.2 -= mean);
        let norm = pixels.iter().map(|p| p.2 * p.2).sum::<f32>().sqrt().max(1e-6);
        pixels.iter_mut().for_each(|p| p.2 /= norm);
        Template { turn_rad, half, pixels }
    }

    /// Correlations about the pixels of a row, from a column on.
    fn correlate_row(&self, level: &Patch, first: usize, j: usize, correlations: &mut [f32]) {
        /// Pixels that are worked on together: their sums stay in registers.
        const LANES: usize = 16;
        let (half, width) = (self.half as usize, level.width);
        let is_within = j >= half && j + half < level.height;
        let mut k = 0;
        while k < correlations.len() {
            let i = first + k;
            if !is_within || i < half || i + LANES + half > width || k + LANES > correlations.len()
            {
                correlations[k] = self.correlation(level, i, j);
                k += 1;
                continue;
            }
            let (mut sum, mut squares, mut product) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
            for &(di, dj, value) in &self.pixels {
                let at = (j as i32 + dj) as usize * width + (i as i32 + di) as usize;
                let Some(greys) = level.data.get(at..at + LANES) else { continue };
                for (lane, grey) in greys.iter().enumerate() {
                    let grey = grey - 128.0;
                    sum[lane] += grey;
                    squares[lane] += grey * grey;
                    product[lane] += value * grey;
                }
            }
            for (lane, correlation) in correlations[k..k + LANES].iter_mut().enumerate() {
                let count = self.pixels.len();
                *correlation = of_sums(sum[lane], squares[lane], product[lane], count);
            }
            k += LANES;
        }
    }

    /// Correlation about a pixel; of pixels beyond the border of the photo nothing is known.
    fn correlation(&self, level: &Patch, i: usize, j: usize) -> f32 {
        let (width, height) = (level.width as i32, level.height as i32);
        let (mut sum, mut squares, mut product, mut count) = (0.0f32, 0.0f32, 0.0f32, 0usize);
        for &(di, dj, value) in &self.pixels {
            let (column, row) = (i as i32 + di, j as i32 + dj);
            if column < 0 || row < 0 || column >= width || row >= height {
                continue;
            }
            let grey = level.data[(row * width + column) as usize] - 128.0;
            sum += grey;
            squares += grey * grey;
            product += value * grey;
            count += 1;
        }
        if 3 * count < 2 * self.pixels.len() {
            return 0.0;
        }
        of_sums(sum, squares, product, count)
    }
}

/// The correlation that sums over so many pixels make.
fn of_sums(sum: f32, squares: f32, product: f32, count: usize) -> f32 {
    let n = count as f32;
    let spread = squares - sum * sum / n.max(1.0);
    // Less than two grey values of contrast is noise.
    if spread < 4.0 * n { 0.0 } else { product / spread.sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_that_are_worked_on_together_have_the_correlations_of_single_ones() {
        let (width, height) = (83, 40);
        let noise = |k: usize| ((k * 7919 + k * k * 31) % 251) as f32;
        let level = Patch {
            origin_px: [0.0; 2],
            factor: 1.0,
            width,
            height,
            data: (0..width * height).map(noise).collect(),
        };
        let ground: Jacobian = [[40.0, 3.0], [-2.0, 41.0]];
        for kind in [TargetKind::Chequered, TargetKind::Disc, TargetKind::Aruco] {
            let wanted = Wanted::new(kind, 0.2, 0.7);
            for template in wanted.templates(&level, &ground) {
                let mut row = vec![0.0; width];
                for j in 0..height {
                    template.correlate_row(&level, 0, j, &mut row);
                    let single: Vec<f32> =
                        (0..width).map(|i| template.correlation(&level, i, j)).collect();
                    assert_eq!(row, single);
                }
            }
        }
    }
}
