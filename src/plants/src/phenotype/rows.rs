//! Heading, lines and spacing of the rows, from the leaf mask alone.
//!
//! For a heading `h`, cut the picture into strips along `h` and let `delta_i` be the share of strip
//! `i` that is leaf. The heading is where the strips tell most about the mask:
//!
//! `eta^2(h) = sum_i l_i (delta_i - delta)^2 / (delta (1 - delta) sum_i l_i)`,
//!
//! the correlation ratio of the mask given the position across (`l_i`: area of the strip inside the
//! mask's bounding box). Dividing by the area keeps a long narrow picture from looking like a row.
//! First in windows small enough that a degree of error does not smear a row, then over windows
//! that double in size while the angle is refined. Of several peaks, the highest that shows a
//! repeating profile is taken.
//!
//! The profile `delta` at that heading has its peaks on the rows; the lag at which its
//! autocorrelation peaks is the distance between rows. One peak is one row; no contrast is no row.
//!
//! Headings are measured from the image's `u` axis towards its `v` axis; along and across as in
//! [`Axes`]; everything else in pixels.

use super::{
    leaf_pixels::{extent, sample},
    row_lines::lines,
};
use crate::problems::plants::lines::Axes;
use rowgram_optim::robust::median;
use rowgram_raster::Mask;
use std::f64::consts::PI;

/// Pixels that the search for the heading looks at, at most.
const SAMPLE: usize = 60_000;
/// Another peak is looked at if it has this share of the highest correlation ratio.
const LEAST_RIVAL: f64 = 0.3;
/// Side of the first windows, in pixels.
const FIRST_WINDOW_PX: f64 = 512.0;
/// The heading is believed from this correlation ratio on ...
const LEAST_CONTRAST: f64 = 0.03;
/// ... and where it exceeds that of the median direction this many times.
const LEAST_PROMINENCE: f64 = 2.0;
/// ... or this many times and several rows repeat themselves ...
const LEAST_WITH_REPEATS: f64 = 1.3;
/// ... that is so many.
const REPEATS: usize = 4;

/// One row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// Position across the rows.
    pub across_px: f64,
    /// Where it begins along the rows.
    pub start_px: f64,
    /// Where it ends along the rows.
    pub end_px: f64,
    /// Leaf pixels that belong to it.
    pub pixels: usize,
}

impl Row {
    /// From its beginning to its end.
    pub fn length_px(&self) -> f64 {
        self.end_px - self.start_px
    }
}

/// The rows of a mask.
#[derive(Debug, Clone, PartialEq)]
pub struct Rows {
    /// Their axes: origin in the middle of the mask's bounding box.
    pub axes: Axes,
    /// The rows, by position across. At least one.
    pub rows: Vec<Row>,
    /// Distance between rows, where there is more than one.
    pub spacing_px: Option<f64>,
    /// Correlation ratio at the heading, between 0 and 1.
    pub contrast: f64,
}

impl Rows {
    /// The row nearest to a position across, and how far away it is; `None` without rows.
    pub(super) fn nearest(&self, across_px: f64) -> Option<(usize, f64)> {
        nearest(&self.rows, |row| row.across_px, across_px)
    }
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub enum Detection {
    /// Rows.
    Found(Rows),
    /// No heading stands out: the highest correlation ratio and how it compares with the median.
    NoRows {
        /// Highest correlation ratio.
        contrast: f64,
        /// Highest over median correlation ratio.
        prominence: f64,
    },
}

/// The nearest of things in the order of their places, and how far away it is.
pub(super) fn nearest<T>(sorted: &[T], place: impl Fn(&T) -> f64, at: f64) -> Option<(usize, f64)> {
    let next = sorted.partition_point(|thing| place(thing) < at);
    let beside = [next.checked_sub(1), (next < sorted.len()).then_some(next)];
    let away = beside.into_iter().flatten().map(|k| (k, (place(&sorted[k]) - at).abs()));
    away.min_by(|a, b| a.1.total_cmp(&b.1))
}

impl Detection {
    /// The rows, if any were found.
    pub fn rows(&self) -> Option<&Rows> {
        match self {
            Detection::Found(rows) => Some(rows),
            Detection::NoRows { .. } => None,
        }
    }
}

/// Finds the rows of a mask.
pub fn detect(mask: &Mask) -> Detection {
    let none = |contrast, prominence| Detection::NoRows { contrast, prominence };
    let Some(extent) = extent(mask) else { return none(0.0, 0.0) };
    let (origin_px, _) = extent.circle();
    let size = [
        f64::from(extent.u_max) - f64::from(extent.u_min) + 1.0,
        f64::from(extent.v_max) - f64::from(extent.v_min) + 1.0,
    ];
    let stride = mask.count().div_ceil(SAMPLE);
    let from_origin = |[u, v]: [f64; 2]| [u - origin_px[0], v - origin_px[1]];
    let sample: Vec<[f64; 2]> = sample(mask, stride).into_iter().map(from_origin).collect();
    let finder = Finder { sample: &sample, size, weight: stride as f64 };
    let window = FIRST_WINDOW_PX.min(size[0].hypot(size[1]));
    let first = Windows::new(&finder, window);
    let scores: Vec<f64> =
        (0..180).map(|degree| first.score(f64::from(degree).to_radians())).collect();
    let mut sorted = scores.clone();
    sorted.sort_by(f64::total_cmp);
    let contrast = sorted[179];
    let prominence = contrast / sorted[90].max(1e-9);
    if contrast.is_nan() || contrast < LEAST_CONTRAST {
        return none(contrast, prominence);
    }
    // What surrounds a field, and holes in its map, tell much of the mask in every direction; then several rows must repeat
    // themselves.
    let stands_out = prominence >= LEAST_PROMINENCE;
    if prominence < LEAST_WITH_REPEATS {
        return none(contrast, prominence);
    }
    let mut found: Option<Rows> = None;
    for degree in peaks(&scores) {
        let lines_near = |heading_rad: f64| {
            let heading_rad = finder.refine(heading_rad, window).rem_euclid(PI);
            let axes = Axes { origin_px, heading_rad };
            let (rows, spacing_px) = lines(mask, &axes);
            (axes, rows, spacing_px)
        };
        let (mut axes, mut rows, mut spacing_px) = lines_near((degree as f64).to_radians());
        if spacing_px.is_some_and(|spacing| are_plants(&rows, spacing)) {
            let across = lines_near(axes.heading_rad + PI / 2.0);
            if !across.1.is_empty() {
                (axes, rows, spacing_px) = across;
            }
        }
        let repeats = spacing_px.is_some() && (stands_out || rows.len() >= REPEATS);
        if !rows.is_empty() && (repeats || stands_out && found.is_none()) {
            found = Some(Rows { axes, rows, spacing_px, contrast: scores[degree] });
        }
        if repeats {
            break;
        }
    }
    found.map_or(none(contrast, prominence), Detection::Found)
}

/// Whether what repeats itself are the plants of one row, seen end on: a row is longer than the
/// distance to the next.
fn are_plants(rows: &[Row], spacing_px: f64) -> bool {
    median(rows.iter().map(Row::length_px)).is_some_and(|length| length < 1.2 * spacing_px)
}

/// The headings, in whole degrees, at which the score peaks, the highest first: a field's edges can
/// tell more of the mask than rows whose leaves have closed, but only rows repeat themselves.
fn peaks(scores: &[f64]) -> Vec<usize> {
    let around = |degree: usize, by: usize| scores[(degree + by) % scores.len()];
    let highest = scores.iter().copied().fold(0.0, f64::max);
    let mut peaks: Vec<usize> = (0..scores.len())
        .filter(|&degree| {
            let nearby = (1..=10).flat_map(|by| [around(degree, by), around(degree, 180 - by)]);
            scores[degree] >= LEAST_CONTRAST.max(LEAST_RIVAL * highest)
                && nearby.fold(0.0, f64::max) <= scores[degree]
        })
        .collect();
    peaks.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]).then(a.cmp(&b)));
    peaks
}

/// What the search for a heading looks at.
struct Finder<'s> {
    /// Some of the pixels, from the middle of the mask.
    sample: &'s [[f64; 2]],
    /// Width and height of the mask.
    size: [f64; 2],
    /// Pixels that one of the sample stands for.
    weight: f64,
}

impl Finder<'_> {
    /// Refines a heading by bisection while the windows grow to the whole mask.
    fn refine(&self, mut heading: f64, mut window: f64) -> f64 {
        let diagonal = self.size[0].hypot(self.size[1]);
        let mut step = 1_f64.to_radians();
        loop {
            let windows = Windows::new(self, window);
            // Down to a sixteenth of a pixel over the length of the window.
            let finest = (1.0 / 16.0) / window;
            while step > finest {
                let score = |k: i32| windows.score(heading + f64::from(k) * step / 2.0);
                let (middle, left, right) = (score(0), score(-1), score(1));
                if left > middle && left >= right {
                    heading -= step / 2.0;
                } else if right > middle {
                    heading += step / 2.0;
                }
                step /= 2.0;
            }
            if window >= diagonal {
                return heading;
            }
            window = (window * 2.0).min(diagonal);
            step *= 8.0;
        }
    }
}

/// A part of the bounding box and the sample in it.
struct Window<'s> {
    half_u: f64,
    half_v: f64,
    middle: [f64; 2],
    pixels: Vec<&'s [f64; 2]>,
}

/// The sample cut into windows, with the part of the bounding box that each covers.
struct Windows<'s> {
    windows: Vec<Window<'s>>,
    /// Pixels that one of the sample stands for.
    weight: f64,
}

impl<'s> Windows<'s> {
    fn new(finder: &Finder<'s>, side: f64) -> Windows<'s> {
        let &Finder { sample, size, weight } = finder;
        let counts = size.map(|s| (s / side).ceil().max(1.0) as usize);
        let cell = [size[0] / counts[0] as f64, size[1] / counts[1] as f64];
        let cell_of = |x: f64, axis: usize| {
            (((x + size[axis] / 2.0) / cell[axis]) as usize).min(counts[axis] - 1)
        };
        let mut windows: Vec<_> = (0..counts[0] * counts[1])
            .map(|k| {
                let middle = [
                    ((k % counts[0]) as f64 + 0.5) * cell[0] - size[0] / 2.0,
                    ((k / counts[0]) as f64 + 0.5) * cell[1] - size[1] / 2.0,
                ];
                Window { half_u: cell[0] / 2.0, half_v: cell[1] / 2.0, middle, pixels: Vec::new() }
            })
            .collect();
        for at in sample {
            windows[cell_of(at[1], 1) * counts[0] + cell_of(at[0], 0)].pixels.push(at);
        }
        Windows { windows, weight }
    }

    /// The correlation ratio at a heading, all windows together.
    fn score(&self, heading_rad: f64) -> f64 {
        let (s, c) = heading_rad.sin_cos();
        let (mut between, mut within) = (0.0, 0.0);
        let mut counts: Vec<f64> = Vec::new();
        for Window { half_u, half_v, middle, pixels } in &self.windows {
            if pixels.is_empty() {
                continue;
            }
            let (a, b) = ((half_u * s).abs(), (half_v * c).abs());
            let half = a + b;
            // Strips wide enough to hold some of the sample each. A pixel is shared between the two
            // nearest, which with two pixels or more hides the lattice of the picture.
            let strip = (half / 40.0).max(2.0);
            let strips = (2.0 * half / strip).ceil().max(1.0) as usize;
            counts.clear();
            counts.resize(strips, 0.0);
            for at in pixels {
                let across = c * (at[1] - middle[1]) - s * (at[0] - middle[0]);
                let place = (across + half) / strip - 0.5;
                let left = place.floor();
                let part = place - left;
                counts[(left.max(0.0) as usize).min(strips - 1)] += self.weight * (1.0 - part);
                counts[((left + 1.0) as usize).min(strips - 1)] += self.weight * part;
            }
            let area = 4.0 * half_u * half_v;
            let share = (pixels.len() as f64 * self.weight / area).min(1.0);
            let mut below = 0.0;
            for (k, count) in counts.iter().enumerate() {
                let upto = area_below(a, b, area, (k as f64 + 1.0) * strip - half);
                let inside = upto - below;
                below = upto;
                // A corner is too small to say anything.
                if inside > 0.25 * area / strips as f64 {
                    between += (count - share * inside).powi(2) / inside;
                }
            }
            // A window full of leaf tells nothing.
            within += (share * (1.0 - share)).max(0.02) * area;
        }
        between / within.max(1.0)
    }
}

/// Area of a rectangle on one side of a line: its profile is a trapezoid, the convolution of two
/// boxes of half widths `a` and `b`.
fn area_below(a: f64, b: f64, area: f64, at: f64) -> f64 {
    let (a, b) = (a.max(b), a.min(b));
    let at = at.clamp(-a - b, a + b);
    let height = area / (2.0 * a).max(f64::MIN_POSITIVE);
    let ramp = |x: f64| if b > 0.0 { height * x * x / (4.0 * b) } else { 0.0 };
    if at < b - a {
        ramp(at + a + b)
    } else if at <= a - b {
        height * (at + a)
    } else {
        area - ramp(a + b - at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn mask_of(pixels: &[[u32; 2]]) -> Mask {
        let size = |k: usize| pixels.iter().map(|at| at[k] as usize + 1).max().unwrap_or(0);
        let (width, height) = (size(0), size(1));
        let mut mask = Mask::empty(width, height);
        pixels.iter().for_each(|&[u, v]| mask.data[v as usize * width + u as usize] = 1);
        mask
    }

    /// Ragged rows at a heading: blobs along parallel lines inside a square picture.
    fn field(degrees: f64, rows: i32, spacing: f64, seed: u64) -> Mask {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let axes = Axes { origin_px: [300.0, 300.0], heading_rad: degrees.to_radians() };
        let mut pixels = Vec::new();
        for row in 0..rows {
            let across = (f64::from(row) - f64::from(rows - 1) / 2.0) * spacing;
            let mut along = -200.0;
            while along < 200.0 {
                for _ in 0..70 {
                    let mut blur = || (0..3).map(|_| rng.random::<f64>() - 0.5).sum::<f64>();
                    let place = [along + 12.0 * blur(), across + 9.0 * blur()];
                    let [u, v] = axes.image(place);
                    pixels.push([u.round() as u32, v.round() as u32]);
                }
                along += 14.0 + 4.0 * rng.random::<f64>();
            }
        }
        mask_of(&pixels)
    }

    /// Rows whose leaves have nearly closed, on a round field amid nothing.
    #[test]
    fn what_surrounds_a_field_does_not_hide_its_rows() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let axes = Axes { origin_px: [600.0, 600.0], heading_rad: 0.4 };
        let mut pixels = Vec::new();
        for v in 0..1200u32 {
            for u in 0..1200u32 {
                let [along, across] = axes.aligned([f64::from(u), f64::from(v)]);
                let phase = (across / 52.0 * 2.0 * PI).cos();
                let inside = along.hypot(across) < 450.0 && (along - 60.0).hypot(across) > 110.0;
                if inside && rng.random::<f64>() < 0.5 + 0.28 * phase {
                    pixels.push([u, v]);
                }
            }
        }
        let detection = detect(&mask_of(&pixels));
        let rows = detection.rows().unwrap_or_else(|| panic!("{detection:?}"));
        assert!((rows.axes.heading_rad - 0.4).abs() < 0.01, "{:?}", rows.axes);
        assert!((rows.spacing_px.unwrap() - 52.0).abs() < 1.0, "{:?}", rows.spacing_px);
        // Without rows there are none, whatever surrounds it.
        let even: Vec<[u32; 2]> = (0..1200u32)
            .flat_map(|v| (0..1200u32).map(move |u| [u, v]))
            .filter(|&[u, v]| {
                let [along, across] = axes.aligned([f64::from(u), f64::from(v)]);
                along.hypot(across) < 450.0 && (along - 60.0).hypot(across) > 110.0
            })
            .filter(|_| rng.random::<f64>() < 0.5)
            .collect();
        assert!(matches!(detect(&mask_of(&even)), Detection::NoRows { .. }));
    }

    #[test]
    fn headings_from_0_to_180_degrees_are_recovered() {
        for k in 0..36 {
            let degrees = f64::from(k) * 5.0 + f64::from(k % 3) * 0.7;
            let detection = detect(&field(degrees, 6, 50.0, k as u64));
            let rows = detection.rows().unwrap_or_else(|| panic!("{degrees}: {detection:?}"));
            let error =
                (rows.axes.heading_rad.to_degrees() - degrees + 90.0).rem_euclid(180.0) - 90.0;
            assert!(error.abs() < 0.4, "{degrees} degrees: off by {error}");
            assert_eq!(rows.rows.len(), 6, "{degrees} degrees: {rows:?}");
            let spacing = rows.spacing_px.unwrap();
            assert!((spacing - 50.0).abs() < 0.7, "{degrees} degrees: spacing {spacing}");
            for row in &rows.rows {
                assert!((row.length_px() - 412.0).abs() < 25.0, "{row:?}");
            }
        }
    }

    #[test]
    fn one_row_and_two_rows_are_rows() {
        for (count, degrees) in [(1, 0.0), (1, 33.0), (2, 90.0), (2, 140.0)] {
            let detection = detect(&field(degrees, count, 60.0, 4));
            let rows = detection.rows().unwrap_or_else(|| panic!("{count}: {detection:?}"));
            assert_eq!(rows.rows.len(), count as usize, "{degrees}: {rows:?}");
            assert_eq!(rows.spacing_px.is_some(), count > 1);
        }
    }

    #[test]
    fn two_rows_at_the_borders_of_a_long_picture_are_two() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut pixels = Vec::new();
        for row in [30.0, 250.0] {
            for plant in 0..40 {
                for _ in 0..150 {
                    let mut blur = || (0..3).map(|_| rng.random::<f64>() - 0.5).sum::<f64>();
                    let at = [30.0 + 45.0 * f64::from(plant) + 16.0 * blur(), row + 16.0 * blur()];
                    pixels.push(at.map(|v| v.round() as u32));
                }
            }
        }
        let detection = detect(&mask_of(&pixels));
        let rows = detection.rows().unwrap();
        assert_eq!(rows.rows.len(), 2, "{rows:?}");
        assert!((rows.spacing_px.unwrap() - 220.0).abs() < 3.0, "{rows:?}");
    }

    #[test]
    fn scattered_leaves_and_degenerate_masks_have_no_rows_or_one() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let mut draw = || [rng.random_range(0..400_u32), rng.random_range(0..400_u32)];
        let scattered: Vec<[u32; 2]> = (0..8000).map(|_| draw()).collect();
        let detection = detect(&mask_of(&scattered));
        assert!(detection.rows().is_none(), "{detection:?}");
        let square: Vec<[u32; 2]> = (0..10_000).map(|k| [k % 100, k / 100]).collect();
        assert!(detect(&mask_of(&square)).rows().is_none());
        assert!(detect(&mask_of(&[])).rows().is_none());
        // Must not panic, whatever they answer.
        detect(&mask_of(&[[7, 7]]));
        detect(&mask_of(&(0..50).map(|k| [3, k]).collect::<Vec<_>>()));
        detect(&mask_of(&(0..50).map(|k| [k, 3]).collect::<Vec<_>>()));
    }

    #[test]
    fn the_area_below_a_line_grows_to_the_whole() {
        for (a, b) in [(3.0, 1.0), (1.0, 3.0), (2.0, 0.0), (2.0, 2.0)] {
            assert_eq!(area_below(a, b, 10.0, -a - b), 0.0);
            approx::assert_relative_eq!(area_below(a, b, 10.0, 0.0), 5.0, epsilon = 1e-12);
            approx::assert_relative_eq!(area_below(a, b, 10.0, a + b), 10.0, epsilon = 1e-12);
        }
    }
}
