//! How many leaves there are around a place: what tells two plants in one place from one, and one from none.
//!
//! Three numbers of a place, on the reduced grid of [`Evidence`]: leaf mass within `NEAR`, leaf mass within `WIDE`, and
//! the leaves that point at it: of each of `SECTORS` directions the square root of the coherent leaf mass between
//! `RING` whose axis passes the place, so that a leaf counts once, be it long or short. Each is taken as a logarithm
//! and compared with what is usual of the plants of the field ([`PlantBaseline`]); their sum is the score of the place.
//!
//! On synthetic masks such a score tells two plants within 7.5 cm from one with an area under the curve of 0.95 (spacing 20 cm), 0.98
//! (30 cm), 0.73 (10 and 12 cm), with 3 % doubles.

use super::evidence::{Evidence, LeafAxes};
use rayon::prelude::*;
use rowgram_optim::robust::median_and_sigma;

/// Radius of the leaf mass near a place.
const NEAR: f64 = 5.0;
/// Radius of the leaf mass about it.
const WIDE: f64 = 9.0;
/// Where leaves are whose directions count.
const RING: [f64; 2] = [4.0, 14.0];
/// Scale of the distance at which an axis passes.
const PASSES: f64 = 1.5;
/// A leaf that passes farther than by this exponent counts for less than single precision can add.
const NOT_AT_ALL: f32 = -20.0;
/// Directions.
const SECTORS: usize = 36;

/// Numbers of a place.
pub const FEATURES: usize = 3;

/// A pixel beside the place that is looked at.
struct Neighbour {
    dx: i32,
    dy: i32,
    /// How far on it is in the grid, row by row.
    step: isize,
    squared: f32,
    /// `cos 2 phi`, `sin 2 phi` of its direction.
    doubled: [f32; 2],
    sector: usize,
}

// Around a place at the border of a stripe, leaves are looked at beyond the stripe.
const _: () = assert!(RING[1] <= LeafAxes::REACH as f64);
/// Stripes of the grid that are in work together: enough for many threads, and few of a large map (one of 21,000 rows has 165). Any number gives the same.
const STRIPES_TOGETHER: usize = 32;

/// The numbers of places, in pixels of the grid and in their order. Stripe by stripe of the grid: the axes of leaves are in memory only for stripes in work.
pub fn leaf_surroundings(evidence: &Evidence<'_>, places: &[[f64; 2]]) -> Vec<[f64; FEATURES]> {
    let last = evidence.height.saturating_sub(1) as f64;
    let stripe_of = |v: f64| Evidence::stripe_of(v.round().clamp(0.0, last) as usize);
    let mut stripes: Vec<Vec<u32>> = vec![vec![]; stripe_of(last) + 1];
    for (k, [_, v]) in places.iter().enumerate() {
        stripes[stripe_of(*v)].push(k as u32);
    }
    let neighbours = Neighbours::new([evidence.width, evidence.height]);
    let of_stripe = |(stripe, places_in_it): (usize, &Vec<u32>)| -> Vec<_> {
        if places_in_it.is_empty() {
            return vec![];
        }
        let leaves = evidence.leaf_axes(stripe);
        places_in_it.iter().map(|&k| neighbours.look(&leaves, places[k as usize])).collect()
    };
    let mut found = vec![[0.0; FEATURES]; places.len()];
    let numbered: Vec<(usize, &Vec<u32>)> = stripes.iter().enumerate().collect();
    for group in numbered.chunks(STRIPES_TOGETHER) {
        let numbers: Vec<Vec<_>> = group.par_iter().copied().map(of_stripe).collect();
        let places = group.iter().flat_map(|(_, places)| places.iter());
        for (&k, numbers) in places.zip(numbers.into_iter().flatten()) {
            found[k as usize] = numbers;
        }
    }
    found
}

/// The pixels beside a place that are looked at.
struct Neighbours {
    around: Vec<Neighbour>,
    size: [usize; 2],
}

impl Neighbours {
    /// On a grid of so many columns and rows.
    fn new(size: [usize; 2]) -> Neighbours {
        let reach = RING[1] as i32;
        let mut around = Vec::new();
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let (x, y) = (f64::from(dx), f64::from(dy));
                if x.hypot(y) > RING[1] {
                    continue;
                }
                let phi = y.atan2(x);
                let turn = (phi / std::f64::consts::TAU).rem_euclid(1.0);
                let (sin, cos) = (2.0 * phi).sin_cos();
                around.push(Neighbour {
                    dx,
                    dy,
                    step: dy as isize * size[0] as isize + dx as isize,
                    squared: (x * x + y * y) as f32,
                    doubled: [cos as f32, sin as f32],
                    sector: ((turn * SECTORS as f64) as usize).min(SECTORS - 1),
                });
            }
        }
        Neighbours { around, size }
    }

    /// The numbers of a place, from the leaves of its stripe.
    fn look(&self, leaves: &LeafAxes, at: [f64; 2]) -> [f64; FEATURES] {
        let [x, y] = at.map(|a| a.round() as i64);
        let reach = RING[1] as i64;
        let [width, height] = self.size.map(|n| n as i64);
        let centre = ((y - leaves.rows.start as i64) * width + x) as isize;
        if (reach..width - reach).contains(&x) && (reach..height - reach).contains(&y) {
            let whole = self.around.iter();
            numbers(leaves, whole.map(|neighbour| ((centre + neighbour.step) as usize, neighbour)))
        } else {
            let inside = self.around.iter().filter(|neighbour| {
                let (u, v) = (x + i64::from(neighbour.dx), y + i64::from(neighbour.dy));
                (0..width).contains(&u) && (0..height).contains(&v)
            });
            numbers(leaves, inside.map(|neighbour| ((centre + neighbour.step) as usize, neighbour)))
        }
    }
}

/// The numbers of these pixels.
#[inline(always)]
fn numbers<'n>(
    leaves: &LeafAxes,
    pixels: impl Iterator<Item = (usize, &'n Neighbour)>,
) -> [f64; FEATURES] {
    let (mut near, mut wide) = (0.0_f32, 0.0_f32);
    let mut sectors = [0.0_f32; SECTORS];
    for (k, neighbour) in pixels {
        let leaf = leaves.share[k];
        if leaf == 0.0 {
            continue;
        }
        let squared = neighbour.squared;
        if squared <= (NEAR * NEAR) as f32 {
            near += leaf;
        }
        if squared <= (WIDE * WIDE) as f32 {
            wide += leaf;
        }
        if squared > (RING[0] * RING[0]) as f32 {
            let [cos2, sin2] = leaves.axis[k].map(f32::from);
            let coherence = (cos2 * cos2 + sin2 * sin2).sqrt();
            if coherence < 6.0 {
                continue;
            }
            let along = (cos2 * neighbour.doubled[0] + sin2 * neighbour.doubled[1]) / coherence;
            let passes = 0.5 * squared * (1.0 - along);
            let exponent = -0.5 * passes / (PASSES * PASSES) as f32;
            if exponent > NOT_AT_ALL {
                sectors[neighbour.sector] += leaf * exponent.exp() * coherence / 127.0;
            }
        }
    }
    let pointing: f32 = sectors.iter().map(|s| s.sqrt()).sum();
    [near, wide, pointing].map(|n| f64::from(n + 1.0).ln())
}

/// Middle and robust standard deviation.
fn usual(values: &[f64]) -> [f64; 2] {
    let (middle, sigma) = median_and_sigma(values).unwrap_or((0.0, 0.0));
    [middle, sigma.max(1e-3)]
}

/// What is usual of the plants of a field.
pub struct PlantBaseline {
    /// Middle and standard deviation of each number.
    of_each: [[f64; 2]; FEATURES],
    /// Of their sum, in standard deviations.
    of_sum: [f64; 2],
}

impl PlantBaseline {
    /// From the numbers of plants.
    pub fn new(plants: &[[f64; FEATURES]]) -> PlantBaseline {
        let of_each: [[f64; 2]; FEATURES] = std::array::from_fn(|k| {
            usual(&plants.iter().map(|plant| plant[k]).collect::<Vec<_>>())
        });
        let mut found = PlantBaseline { of_each, of_sum: [0.0, 1.0] };
        found.of_sum = usual(&plants.iter().map(|plant| found.score(plant)).collect::<Vec<_>>());
        found
    }

    /// How much more leaf than is usual, in standard deviations of plants.
    pub fn score(&self, place: &[f64; FEATURES]) -> f64 {
        let each = place.iter().zip(&self.of_each);
        let sum: f64 = each.map(|(x, [middle, sd])| (x - middle) / sd).sum();
        (sum - self.of_sum[0]) / self.of_sum[1]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_raster::Mask;

    /// Leaves, two pixels wide, from some stalks outwards.
    fn field(stalks: &[([f64; 2], u32)]) -> Mask {
        Mask::from_fn(300, 60, |u, v| {
            stalks.iter().any(|&([x, y], leaves)| {
                let (x, y) = (u as f64 - x, v as f64 - y);
                (0..leaves).any(|k| {
                    let turn = 0.2 + std::f64::consts::TAU * f64::from(k) / f64::from(leaves);
                    let (s, c) = turn.sin_cos();
                    (c * y - s * x).abs() < 1.2 && (0.0..13.0).contains(&(c * x + s * y))
                })
            })
        })
    }

    #[test]
    fn more_leaves_score_more_and_fewer_less() {
        let stalks: Vec<([f64; 2], u32)> = (0..9)
            .map(|k| ([20.0 + 32.0 * f64::from(k), 30.0], [5, 5, 4, 5, 9, 5, 6, 2, 5][k as usize]))
            .collect();
        let mask = field(&stalks);
        let places: Vec<_> = stalks.iter().map(|&(at, _)| at).chain([[-50.0, 30.0]]).collect();
        let mut numbers = leaf_surroundings(&Evidence::new(&mask, 0.0, 1), &places);
        // Beside the mask there is nothing.
        assert_eq!(numbers.pop(), Some([0.0; FEATURES]));
        let usual = PlantBaseline::new(&numbers);
        let score = |k: usize| usual.score(&numbers[k]);
        assert!(score(4) > 1.5 && score(7) < -1.5, "{} {}", score(4), score(7));
        assert!((0..9).all(|k| k == 4 || score(k) < score(4)));
        assert!((0..9).all(|k| k == 7 || score(k) > score(7)));
    }

    #[test]
    fn plants_that_are_all_the_same_or_none_at_all_are_no_fault() {
        for numbers in [vec![], vec![[1.0; FEATURES]; 4]] {
            assert!(PlantBaseline::new(&numbers).score(&[1.0; FEATURES]).is_finite());
        }
    }
}
