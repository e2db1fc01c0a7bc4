//! Photos that were not taken straight down: their rows converge.
//!
//! A camera that is turned about the horizontal axis of its picture shows level ground in perspective. With `m` the middle of the picture and `h` half
//! its height,
//!
//! ```text
//! q = (p - m) / (1 + c (p_v - m_v) / h)
//! ```
//!
//! shows the same ground with parallel rows; `c`, the convergence, is the scale at the lower edge over that in the middle, less 1. The estimate is
//! the `c` with the greatest correlation ratio between the mask and the position across the rows ([`rows`](super::rows)), here of the whole
//! picture. Rows along the horizon do not converge and do not determine `c`. The foreshortening towards the horizon that is the same all
//! over the picture stays, as rows do not determine it either: `1 - cos` of the tilt, 6 % at 20 degrees.
//!
//! Positions in pixels, centre of the top-left pixel at (0, 0).

use super::{leaf_pixels::sample, stand::Stand};
use rayon::prelude::*;
use rowgram_raster::{Mask, components};

/// Leaf pixels that the search looks at, at most, and the side of the grid of places that stand for the whole picture. Not searched for.
const MAX_SAMPLE: usize = 20_000;
const GRID_SIDE: usize = 80;
/// Headings are tried in steps of so many degrees, from so many degrees to the horizon on. Not searched for.
const HEADING_STEP_DEG: usize = 2;
const MIN_HEADING_DEG: usize = 30;
/// The greatest convergence that is tried (plants at one edge are three times as large as at the other), and the number of steps from 0 to that. Assumed.
const MAX_CONVERGENCE: f64 = 0.5;
const STEPS: i32 = 20;
/// Strips across a picture. Not searched for.
const STRIPS: usize = 60;
/// Rows converge where levelling multiplies the correlation ratio by so much. In a trial with excess green above Otsu's threshold as mask, 49 pictures and masks
/// of the real and synthetic sets that were taken from above had 1.22 at most, two tilted photos (`corn_soy_low_drone`) 1.34 and 1.48; chosen between these.
/// `experiments accuracy` levels one of the two, one phone photo of emerging maize and one picture of trees.
const MIN_GAIN: f64 = 1.25;
/// Connected areas of leaf, at least: few lie on converging rows by chance. Counted as areas of equal size with the same sum of squared sizes. In the same trial 24 on the tilted
/// photo of soybean, 6 on that of maize, 5 to 6 on three tiles of potatoes whose rows seemed to converge.
const MIN_AREAS: f64 = 15.0;
/// The least correlation ratio after levelling. The tilted photos have 0.18 and 0.33.
const MIN_CONTRAST: f64 = 0.05;

/// How level ground is seen in a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Perspective {
    /// Columns and rows of the picture.
    size: [usize; 2],
    /// Scale at the lower edge over that in the middle, less 1.
    pub convergence: f64,
}

impl Perspective {
    /// The perspective of the picture that a mask is of; `None` where rows do not converge.
    pub fn of(mask: &Mask) -> Option<Perspective> {
        let size = [mask.width, mask.height];
        let view = |convergence: f64| Perspective { size, convergence };
        let pixels = sample(mask, mask.count().div_ceil(MAX_SAMPLE).max(1));
        if pixels.is_empty() || size.contains(&0) {
            return None;
        }
        let share = mask.count() as f64 / mask.data.len() as f64;
        let contrast = |convergence: f64, least_heading: usize| {
            view(convergence).contrast(&pixels, share, least_heading)
        };
        let parallel = contrast(0.0, 0);
        let step = MAX_CONVERGENCE / f64::from(STEPS);
        let tried: Vec<(f64, f64)> = (-STEPS..=STEPS)
            .into_par_iter()
            .map(|k| (contrast(step * f64::from(k), MIN_HEADING_DEG), step * f64::from(k)))
            .collect();
        let (highest, convergence) =
            tried.into_iter().reduce(|a, b| if b.0 > a.0 { b } else { a })?;
        let converge = highest >= MIN_CONTRAST && highest >= MIN_GAIN * parallel;
        (converge && areas(mask) >= MIN_AREAS).then(|| view(convergence))
    }

    /// The highest correlation ratio of any heading at least so many degrees from the horizon; `share` of the mask is leaf.
    fn contrast(&self, pixels: &[[f64; 2]], share: f64, least_heading: usize) -> f64 {
        // Where something is in the level picture, and how large a pixel is there.
        let levelled = |at: &[f64; 2]| {
            let factor = self.factor(at[1]);
            let [u, v] = self.away_from_middle(*at);
            (factor * u, factor * v, factor.powi(3))
        };
        let leaf: Vec<_> = pixels.iter().map(levelled).collect();
        let places: Vec<_> = (0..GRID_SIDE * GRID_SIDE)
            .map(|k| {
                let of = |at: usize, size: usize| {
                    (at as f64 + 0.5) / GRID_SIDE as f64 * size as f64 - 0.5
                };
                levelled(&[of(k % GRID_SIDE, self.size[0]), of(k / GRID_SIDE, self.size[1])])
            })
            .collect();
        // Of the whole picture, 1 together where the scale is the same everywhere.
        let (of_leaf, of_place) = (share / leaf.len() as f64, 1.0 / places.len() as f64);
        let headings = (least_heading..180 - least_heading).step_by(HEADING_STEP_DEG);
        let of_heading = |degrees: usize| {
            let (s, c) = (degrees as f64).to_radians().sin_cos();
            let across = |&(u, v, _): &(f64, f64, f64)| c * v - s * u;
            let low = places.iter().map(across).fold(f64::INFINITY, f64::min);
            let high = places.iter().map(across).fold(f64::NEG_INFINITY, f64::max);
            let per_strip = STRIPS as f64 / (high - low).max(f64::MIN_POSITIVE);
            let sums = |points: &[(f64, f64, f64)], of: f64| {
                let mut sums = [0.0; STRIPS];
                for point in points {
                    let strip = ((across(point) - low) * per_strip).max(0.0) as usize;
                    sums[strip.min(STRIPS - 1)] += of * point.2;
                }
                sums
            };
            let (leaf, area) = (sums(&leaf, of_leaf), sums(&places, of_place));
            let whole: f64 = area.iter().sum();
            let density = leaf.iter().sum::<f64>() / whole;
            // A corner is too small to say anything.
            let least = 0.25 * whole / STRIPS as f64;
            let strips = leaf.iter().zip(&area).filter(|(_, area)| **area > least);
            let between: f64 =
                strips.map(|(leaf, area)| (leaf - density * area).powi(2) / area).sum();
            // A picture full of leaf says nothing.
            between / (density * (1.0 - density)).max(0.02 * density) / whole
        };
        headings.map(of_heading).fold(0.0, f64::max)
    }

    fn half_height(&self) -> f64 {
        0.5 * self.size[1] as f64
    }

    fn away_from_middle(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        let [width, height] = self.size.map(|n| 0.5 * (n as f64 - 1.0));
        [u - width, v - height]
    }

    /// Scale of the level picture over that of the picture, at a row.
    fn factor(&self, v: f64) -> f64 {
        let [_, v] = self.away_from_middle([0.0, v]);
        1.0 / (1.0 + self.convergence * v / self.half_height())
    }

    /// The middle of the picture in the level one, and the size of that.
    fn level_picture(&self) -> ([f64; 2], [usize; 2]) {
        let last = self.size.map(|n| n as f64 - 1.0);
        let (above, below) = (self.factor(0.0), self.factor(last[1]));
        let half_width = 0.5 * last[0] * above.max(below);
        let (up, down) = (0.5 * last[1] * above, 0.5 * last[1] * below);
        let size = [2.0 * half_width, up + down].map(|n| n.ceil() as usize + 1);
        ([half_width, up], size)
    }

    /// Where the level picture shows what the picture shows at a position.
    pub fn level_px(&self, photo_px: [f64; 2]) -> [f64; 2] {
        let (middle, _) = self.level_picture();
        let (factor, away) = (self.factor(photo_px[1]), self.away_from_middle(photo_px));
        [0, 1].map(|k| middle[k] + factor * away[k])
    }

    /// Where the picture shows what the level picture shows at a position.
    pub fn photo_px(&self, level_px: [f64; 2]) -> [f64; 2] {
        let (middle, _) = self.level_picture();
        let away = [0, 1].map(|k| level_px[k] - middle[k]);
        let factor = 1.0 - self.convergence * away[1] / self.half_height();
        [0, 1].map(|k| 0.5 * (self.size[k] as f64 - 1.0) + away[k] / factor)
    }

    /// The level picture of values of the picture's pixels, the nearest of each, and its size; 0 where the picture shows nothing.
    pub fn level(&self, values: &[u8]) -> (Vec<u8>, [usize; 2]) {
        let (_, [width, height]) = self.level_picture();
        let mut out = vec![0; width * height];
        out.par_chunks_mut(width.max(1)).enumerate().for_each(|(row, out)| {
            for (column, out) in out.iter_mut().enumerate() {
                let at = self.photo_px([column as f64, row as f64]).map(f64::round);
                let is_inside = (0..2).all(|k| at[k] >= 0.0 && at[k] < self.size[k] as f64);
                if is_inside {
                    *out = values[at[1] as usize * self.size[0] + at[0] as usize];
                }
            }
        });
        (out, [width, height])
    }

    /// The level picture of a mask of the picture.
    pub fn level_mask(&self, mask: &Mask) -> Mask {
        let (data, [width, height]) = self.level(&mask.data);
        Mask { width, height, data }
    }
}

/// The effective number of connected areas of a mask: how many of equal size have the same sum and sum of squares.
fn areas(mask: &Mask) -> f64 {
    let areas = components::parts(mask).into_iter().map(|part| part.pixels as f64);
    let (sum, squares) = areas.fold((0.0, 0.0), |(sum, squares), n| (sum + n, squares + n * n));
    sum * sum / squares.max(1.0)
}

impl Stand {
    /// What was found in the level picture, as the picture shows it: positions there, lengths as they are in its middle.
    pub(super) fn seen_in(&mut self, perspective: Perspective) {
        let specks = self.leaf_mass.iter_mut().flat_map(|mass| &mut mass.specks_px);
        let weeds = self.between_rows.iter_mut().flat_map(|between| &mut between.weeds);
        let positions = (self.plants.iter_mut().map(|plant| &mut plant.position_px))
            .chain(self.missing.iter_mut().map(|gap| &mut gap.position_px))
            .chain(weeds.map(|weed| &mut weed.position_px))
            .chain(specks);
        positions.for_each(|at| *at = perspective.photo_px(*at));
        self.perspective = Some(perspective);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phenotype::{
        locator::{Found, LocateOptions, find},
        stand::Stalk,
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Rows of leaves 60 px apart as a tilted camera sees them, `turned` from the vertical of the picture.
    fn tilted(convergence: f64, turned_rad: f64, seed: u64) -> Mask {
        let view = Perspective { size: [800, 600], convergence };
        let (middle, [width, height]) = view.level_picture();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut mask = Mask::empty(800, 600);
        let (s, c) = turned_rad.sin_cos();
        for row in -20..=20 {
            let mut along = -1000.0;
            while along < 1000.0 {
                along += 20.0 + 10.0 * rng.random::<f64>();
                let across = 60.0 * f64::from(row) + 6.0 * (rng.random::<f64>() - 0.5);
                let at = [middle[0] + c * across - s * along, middle[1] + s * across + c * along];
                if at[0] < 0.0 || at[1] < 0.0 || at[0] > width as f64 || at[1] > height as f64 {
                    continue;
                }
                for _ in 0..120 {
                    let blur = [0, 1].map(|_| 12.0 * (rng.random::<f64>() - 0.5));
                    let at = view.photo_px([at[0] + blur[0], at[1] + blur[1]]).map(f64::round);
                    if at[0] >= 0.0 && at[1] >= 0.0 && at[0] < 800.0 && at[1] < 600.0 {
                        mask.data[at[1] as usize * 800 + at[0] as usize] = 1;
                    }
                }
            }
        }
        mask
    }

    #[test]
    fn convergence_is_found_and_undone() {
        for (k, &convergence) in [0.15, -0.2, 0.3].iter().enumerate() {
            let mask = tilted(convergence, 0.1, k as u64);
            let view = Perspective::of(&mask).unwrap();
            assert!((view.convergence - convergence).abs() < 0.03, "{convergence}: {view:?}");
            let rows = crate::phenotype::rows::detect(&view.level_mask(&mask));
            let spacing = rows.rows().and_then(|rows| rows.spacing_px).unwrap();
            assert!((spacing - 60.0).abs() < 2.0, "{convergence}: {spacing}");
        }
    }

    #[test]
    fn plants_of_a_tilted_photo_are_where_it_shows_them() {
        let view = Perspective { size: [900, 700], convergence: 0.25 };
        let (middle, _) = view.level_picture();
        let mut mask = Mask::empty(900, 700);
        let mut plants = Vec::new();
        for k in 0..21 * 41 {
            let [row, place] = [k % 21, k / 21].map(|n| n as f64);
            let at = [middle[0] + 90.0 * (row - 10.0), middle[1] + 30.0 * (place - 20.0)];
            let at = view.photo_px(at);
            if at[0] < 8.0 || at[1] < 8.0 || at[0] > 892.0 || at[1] > 692.0 {
                continue;
            }
            let radius = 6.0 * (1.0 + 0.25 * (at[1] - 349.5) / 350.0);
            for v in 0..700 {
                for u in 0..900 {
                    if (u as f64 - at[0]).hypot(v as f64 - at[1]) <= radius {
                        mask.data[v * 900 + u] = 1;
                    }
                }
            }
            plants.push(at);
        }
        let options = LocateOptions::default();
        let Found::Stand(stand) = find(&mask, None, &options).unwrap() else { panic!() };
        assert!(stand.perspective.is_some() && stand.rows.rows.len() > 8);
        let off = |at: &[f64; 2]| {
            let of = |plant: &Stalk| {
                let [u, v] = plant.position_px;
                (u - at[0]).hypot(v - at[1])
            };
            stand.plants.iter().map(of).fold(f64::INFINITY, f64::min)
        };
        let right = plants.iter().filter(|at| off(at) < 5.0).count();
        assert!(right * 100 > plants.len() * 95, "{right} of {}", plants.len());
        assert!(stand.plants.len() * 100 < plants.len() * 105, "{}", stand.plants.len());
        let there_and_back = stand.image(stand.aligned(plants[0]));
        assert!((there_and_back[0] - plants[0][0]).abs() < 1e-6);
        // Whoever knows the ground sampling distance has no such photo.
        let Found::Stand(flat) = find(&mask, Some(0.01), &options).unwrap() else { panic!() };
        assert_eq!(flat.perspective, None);
    }

    #[test]
    fn photos_from_above_are_left_as_they_are() {
        for (k, turned_rad) in [0.0, 0.1, 0.5, 1.3, 1.57].into_iter().enumerate() {
            assert_eq!(Perspective::of(&tilted(0.0, turned_rad, k as u64)), None, "{turned_rad}");
        }
        // Rows along the horizon do not converge.
        assert_eq!(Perspective::of(&tilted(0.2, 1.57, 7)), None);
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let scattered = Mask::from_fn(300, 200, |_, _| rng.random::<f64>() < 0.05);
        assert_eq!(Perspective::of(&scattered), None);
        assert_eq!(Perspective::of(&Mask::empty(10, 10)), None);
        assert_eq!(Perspective::of(&Mask::empty(0, 0)), None);
    }

    #[test]
    fn positions_go_there_and_back() {
        let view = Perspective { size: [640, 480], convergence: 0.3 };
        let (_, size) = view.level_picture();
        for at in [[0.0, 0.0], [639.0, 0.0], [320.0, 240.0], [17.0, 479.0], [639.0, 479.0]] {
            let level = view.level_px(at);
            let back = view.photo_px(level);
            assert!((0..2).all(|k| (back[k] - at[k]).abs() < 1e-9), "{at:?} {back:?}");
            assert!((0..2).all(|k| level[k] > -1e-9 && level[k] < size[k] as f64), "{level:?}");
        }
        let middle = [319.5, 239.5];
        let one_right = view.level_px([320.5, 239.5])[0] - view.level_px(middle)[0];
        assert!((one_right - 1.0).abs() < 1e-12, "{one_right}");
    }
}
