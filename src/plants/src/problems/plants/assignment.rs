//! Which plant every leaf pixel belongs to, kept exact while plants move.
//!
//! For every pixel `n`: the nearest plant `C(n) = argmin_p |Z_n - X_p|`, the second nearest, and
//! both squared distances. All of it is a pure function of the positions: distances are compared
//! as `f32` values computed in one way only ([`distance2`]), equal ones by the lower number. So a
//! checkpoint needs the positions alone, and the fast updates can be compared with brute force bit
//! for bit.
//!
//! A moved plant changes only the pixels in which it is nearest or second nearest, before or after:
//! those closer to its old or new place than their second nearest plant. The tree over the pixels
//! finds them; a pixel that loses the plant looks for its new second nearest among the plants in
//! the buckets around.
//!
//! Positions and distances in pixels (squared where the name ends in 2).

use super::{
    buckets::Buckets,
    index::{LEAF, PixelIndex, Reach, Walk, largest},
};
use rayon::prelude::*;

/// Stands for "there is no such plant".
pub const NONE: u32 = u32::MAX;

/// The squared distance by which plants are compared: differences in `f64`, the rest in `f32`.
#[inline]
pub fn distance2(u_px: f32, v_px: f32, plant: [f64; 2]) -> f32 {
    let du = (f64::from(u_px) - plant[0]) as f32;
    let dv = (f64::from(v_px) - plant[1]) as f32;
    du * du + dv * dv
}

/// Whether plant `a` at `a2` comes before plant `b` at `b2`.
#[inline]
fn before(a2: f32, a: u32, b2: f32, b: u32) -> bool {
    a2 < b2 || (a2 == b2 && a < b)
}

/// The two nearest plants of one pixel, in order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NearestPlants {
    /// Nearest plant.
    pub near: u32,
    /// Second nearest plant, or [`NONE`].
    pub second: u32,
    /// Squared distance to the nearest.
    pub near2: f32,
    /// Squared distance to the second nearest; infinite where there is none.
    pub second2: f32,
}

impl NearestPlants {
    const NOBODY: NearestPlants =
        NearestPlants { near: NONE, second: NONE, near2: f32::INFINITY, second2: f32::INFINITY };

    fn offer(&mut self, plant: u32, d2: f32) {
        if before(d2, plant, self.near2, self.near) {
            (self.second, self.second2) = (self.near, self.near2);
            (self.near, self.near2) = (plant, d2);
        } else if before(d2, plant, self.second2, self.second) {
            (self.second, self.second2) = (plant, d2);
        }
    }
}

/// Sums over the pixels of the distance to the nearest plant, in pixels and square pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sums {
    /// `sum d_n`.
    pub distance: f64,
    /// `sum d_n^2`.
    pub square: f64,
}

/// Nearest and second nearest plant of every pixel.
#[derive(Debug, Clone, Default)]
pub struct Assignment {
    pairs: Vec<NearestPlants>,
    /// Largest squared distance to the nearest plant below every node.
    near_reach: Reach,
    /// The same to the second nearest.
    second_reach: Reach,
    buckets: Buckets,
    sums: Vec<Sums>,
    stale: Vec<bool>,
    /// Squared distance at which the distances in the sums are truncated.
    truncate2: Option<f64>,
    walk: Walk,
    changed: Vec<u32>,
    nodes: Vec<u32>,
    losers: Vec<u32>,
    candidates: Vec<(u32, [f64; 2])>,
}

/// What the move of a plant did to a pixel.
enum Followed {
    /// Nothing: the plant is farther than its two nearest ones.
    Unchanged,
    /// Its two nearest plants or their distances are others.
    Changed,
    /// The plant is its second now and farther than it was: another one may be before it.
    Fallen,
}

impl NearestPlants {
    /// Takes the square distance `d2` to `plant`, which has moved; calls `mark` with the plants that won or lost the
    /// pixel.
    #[inline(always)]
    fn follow(&mut self, plant: u32, d2: f32, mark: &mut impl FnMut(u32)) -> Followed {
        let (near, second) = (self.near == plant, self.second == plant);
        if !near && !second && d2 > self.second2 {
            return Followed::Unchanged;
        }
        let first = before(d2, plant, self.near2, self.near);
        if near {
            if before(d2, plant, self.second2, self.second) {
                self.near2 = d2;
                return Followed::Changed;
            }
            mark(plant);
            mark(self.second);
            (self.near, self.near2) = (self.second, self.second2);
            (self.second, self.second2) = (plant, d2);
            return Followed::Fallen;
        }
        if first {
            mark(plant);
            mark(self.near);
            (self.second, self.second2) = (self.near, self.near2);
            (self.near, self.near2) = (plant, d2);
        } else if second {
            let farther = d2 > self.second2;
            self.second2 = d2;
            if farther {
                return Followed::Fallen;
            }
        } else if before(d2, plant, self.second2, self.second) {
            (self.second, self.second2) = (plant, d2);
        } else {
            return Followed::Unchanged;
        }
        Followed::Changed
    }
}

impl Assignment {
    /// Assigns every pixel from nothing.
    pub fn new(index: &PixelIndex, plants: &[[f64; 2]]) -> Assignment {
        let buckets = Buckets::new(index.extent(), plants);
        let leaves: Vec<Vec<NearestPlants>> = (0..index.leaves())
            .into_par_iter()
            .with_min_len(256)
            .map_init(Vec::new, |candidates, leaf| {
                assign(index, leaf, plants, &buckets, candidates)
            })
            .collect();
        let pairs: Vec<NearestPlants> = leaves.into_iter().flatten().collect();
        let column = |f: fn(&NearestPlants) -> f32| pairs.iter().map(f).collect::<Vec<f32>>();
        let near_reach = Reach::new(index, &column(|pair| pair.near2));
        let second_reach = Reach::new(index, &column(|pair| pair.second2));
        let mut assignment = Assignment {
            pairs,
            near_reach,
            second_reach,
            buckets,
            sums: vec![Sums::default(); index.leaves()],
            stale: vec![true; index.leaves()],
            ..Assignment::default()
        };
        assignment.refresh(index, plants);
        assignment
    }

    /// Nearest and second nearest plant of every pixel.
    pub fn pairs(&self) -> &[NearestPlants] {
        &self.pairs
    }

    /// Calls `each` with every pixel whose nearest plant is `plant`, in ascending order.
    pub fn won_by(
        &mut self,
        index: &PixelIndex,
        plant: u32,
        at: [f64; 2],
        mut each: impl FnMut(usize),
    ) {
        index.within_reach(&self.near_reach, &[at], &mut self.walk);
        for &leaf in &self.walk.found {
            for pixel in index.pixels_of(leaf as usize) {
                if self.pairs[pixel].near == plant {
                    each(pixel);
                }
            }
        }
    }

    /// Follows `plant`, which went from `old` to `plants[plant]`; calls `mark` with every plant
    /// that won or lost a pixel.
    pub fn follow(
        &mut self,
        index: &PixelIndex,
        plants: &[[f64; 2]],
        plant: u32,
        old: [f64; 2],
        mut mark: impl FnMut(u32),
    ) {
        let new = plants[plant as usize];
        self.buckets.moved(plant, old, new);
        index.within_reach(&self.second_reach, &[old, new], &mut self.walk);
        self.changed.clear();
        let found = std::mem::take(&mut self.walk.found);
        for &leaf in &found {
            let (mut active, mut farthest2) = (false, 0.0_f32);
            self.losers.clear();
            let pixels = index.pixels_of(leaf as usize);
            let (us, vs) = (&index.u_px()[pixels.clone()], &index.v_px()[pixels.clone()]);
            let mut distances2 = [0.0_f32; LEAF];
            for (d2, (&u, &v)) in distances2.iter_mut().zip(us.iter().zip(vs)) {
                *d2 = distance2(u, v, new);
            }
            let pairs = &mut self.pairs[pixels.clone()];
            for ((pixel, pair), &d2) in pixels.zip(pairs).zip(&distances2) {
                match pair.follow(plant, d2, &mut mark) {
                    Followed::Unchanged => continue,
                    Followed::Changed => {}
                    Followed::Fallen => {
                        self.losers.push(pixel as u32);
                        farthest2 = farthest2.max(d2);
                    }
                }
                active = true;
            }
            if active {
                self.changed.push(leaf);
            }
            if !self.losers.is_empty() {
                self.find_seconds(index, plants, leaf, farthest2);
            }
        }
        self.walk.found = found;
        self.measure_reaches(index);
    }

    /// Looks for the second nearest plants of the pixels of `leaf` whose second one may have another before it now,
    /// within the root of `farthest2`.
    fn find_seconds(&mut self, index: &PixelIndex, plants: &[[f64; 2]], leaf: u32, farthest2: f32) {
        let bounds = index.bounds(leaf as usize);
        self.buckets.within(bounds, farthest2, plants, &mut self.candidates);
        for &pixel in &self.losers {
            let pixel = pixel as usize;
            let (u, v) = (index.u_px()[pixel], index.v_px()[pixel]);
            let pair = &mut self.pairs[pixel];
            for &(other, at) in &self.candidates {
                let d2 = distance2(u, v, at);
                if other != pair.near && before(d2, other, pair.second2, pair.second) {
                    (pair.second, pair.second2) = (other, d2);
                }
            }
        }
    }

    /// Brings the reaches of the leaves that changed up to date.
    fn measure_reaches(&mut self, index: &PixelIndex) {
        for &leaf in &self.changed {
            let leaf = leaf as usize;
            self.stale[leaf] = true;
            let pairs = &self.pairs[index.pixels_of(leaf)];
            let (mut near, mut second) = ([0.0_f32; LEAF], [0.0_f32; LEAF]);
            for (k, pair) in pairs.iter().enumerate() {
                (near[k], second[k]) = (pair.near2, pair.second2);
            }
            self.near_reach.set(leaf, largest(&near[..pairs.len()]));
            self.second_reach.set(leaf, largest(&second[..pairs.len()]));
        }
        index.repair(&mut self.near_reach, &self.changed, &mut self.nodes);
        index.repair(&mut self.second_reach, &self.changed, &mut self.nodes);
    }

    /// Brings the sums of the leaves that changed up to date.
    pub fn refresh(&mut self, index: &PixelIndex, plants: &[[f64; 2]]) {
        for leaf in 0..self.stale.len() {
            if std::mem::take(&mut self.stale[leaf]) {
                self.sums[leaf] = self.sum_of(index, plants, leaf);
            }
        }
    }

    /// The same with the distances in [`Assignment::sums`] truncated.
    pub fn truncated(mut self, at_px: Option<f64>) -> Assignment {
        self.truncate2 = at_px.map(|px| px * px);
        self.stale.fill(true);
        self
    }

    /// `sum d_n` and `sum d_n^2` over all pixels, in `f64` from the exact positions, added in a
    /// fixed order.
    pub fn sums(&self, index: &PixelIndex, plants: &[[f64; 2]]) -> Sums {
        let mut total = Sums::default();
        for (leaf, sums) in self.sums.iter().enumerate() {
            let sums = if self.stale[leaf] { self.sum_of(index, plants, leaf) } else { *sums };
            total.distance += sums.distance;
            total.square += sums.square;
        }
        total
    }

    /// The sum of a function of `d_n^2` over all pixels, likewise.
    pub fn sum(&self, index: &PixelIndex, plants: &[[f64; 2]], of: impl Fn(f64) -> f64) -> f64 {
        (0..self.pairs.len()).map(|pixel| of(self.square(index, plants, pixel))).sum()
    }

    /// The squared distance of a pixel from its plant, truncated.
    fn square(&self, index: &PixelIndex, plants: &[[f64; 2]], pixel: usize) -> f64 {
        let plant = plants[self.pairs[pixel].near as usize];
        let [u, v] = index.position(pixel);
        let (du, dv) = (u - plant[0], v - plant[1]);
        (du * du + dv * dv).min(self.truncate2.unwrap_or(f64::INFINITY))
    }

    fn sum_of(&self, index: &PixelIndex, plants: &[[f64; 2]], leaf: usize) -> Sums {
        let mut sums = Sums::default();
        for pixel in index.pixels_of(leaf) {
            let square = self.square(index, plants, pixel);
            sums.distance += square.sqrt();
            sums.square += square;
        }
        sums
    }
}

/// The two nearest plants of every pixel of a leaf.
fn assign(
    index: &PixelIndex,
    leaf: usize,
    plants: &[[f64; 2]],
    buckets: &Buckets,
    candidates: &mut Vec<(u32, [f64; 2])>,
) -> Vec<NearestPlants> {
    let bounds = index.bounds(leaf);
    let (middle, radius) = bounds.circle();
    // No pixel is farther from its second nearest plant than `radius` plus the distance of the
    // middle to the middle's.
    let reach = buckets.second_nearest(middle, plants) + radius;
    buckets.within(bounds, (reach * reach * 1.000_01) as f32, plants, candidates);
    index
        .pixels_of(leaf)
        .map(|pixel| {
            let (u, v) = (index.u_px()[pixel], index.v_px()[pixel]);
            let mut pair = NearestPlants::NOBODY;
            candidates.iter().for_each(|&(plant, at)| pair.offer(plant, distance2(u, v, at)));
            pair
        })
        .collect()
}

/// The same by comparing every pixel with every plant: the reference for tests.
#[cfg(test)]
pub(super) fn brute_force(index: &PixelIndex, plants: &[[f64; 2]]) -> Vec<NearestPlants> {
    (0..index.len())
        .map(|pixel| {
            let mut pair = NearestPlants::NOBODY;
            for (plant, &at) in (0u32..).zip(plants) {
                pair.offer(plant, distance2(index.u_px()[pixel], index.v_px()[pixel], at));
            }
            pair
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random(seed: u64, pixels: usize, plants: usize) -> (PixelIndex, Vec<[f64; 2]>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let pixels: Vec<[u32; 2]> =
            (0..pixels).map(|_| [rng.random_range(0..200), rng.random_range(0..90)]).collect();
        let plants = (0..plants)
            .map(|_| [rng.random_range(0..400) as f64 / 2.0, rng.random_range(0..180) as f64 / 2.0])
            .collect();
        (PixelIndex::new(&pixels), plants)
    }

    #[test]
    fn it_equals_brute_force_while_plants_move_near_and_far() {
        for (seed, count) in [(1, 1), (2, 2), (3, 3), (4, 40), (5, 300)] {
            let (index, mut plants) = random(seed, 1500, count);
            let mut assignment = Assignment::new(&index, &plants);
            assert_eq!(assignment.pairs(), brute_force(&index, &plants));
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for step in 0..120 {
                let plant = rng.random_range(0..count);
                let (old, before) = (plants[plant], assignment.pairs().to_vec());
                let reach = if step % 9 == 0 { 300.0 } else { 3.0 };
                // Half-pixel positions, so that ties are common.
                let shift = |rng: &mut ChaCha8Rng| {
                    (reach * (rng.random::<f64>() - 0.5_f64) * 2.0).round() / 2.0
                };
                plants[plant] = [old[0] + shift(&mut rng), old[1] + shift(&mut rng)];
                let mut marked = vec![false; count];
                assignment
                    .follow(&index, &plants, plant as u32, old, |p| marked[p as usize] = true);
                assert_eq!(assignment.pairs(), brute_force(&index, &plants), "step {step}");
                for (then, now) in before.iter().zip(assignment.pairs()) {
                    if then.near != now.near {
                        assert!(marked[then.near as usize] && marked[now.near as usize]);
                    }
                }
                assert_eq!(assignment.near_reach, Assignment::new(&index, &plants).near_reach);
                let sums = assignment.sums(&index, &plants);
                assignment.refresh(&index, &plants);
                assert_eq!(sums, assignment.sums(&index, &plants));
                assert_eq!(sums, Assignment::new(&index, &plants).sums(&index, &plants));
                let mut won = vec![];
                assignment.won_by(&index, plant as u32, plants[plant], |n| won.push(n));
                let all: Vec<usize> = (0..index.len())
                    .filter(|&n| assignment.pairs()[n].near == plant as u32)
                    .collect();
                assert_eq!(won, all);
            }
        }
    }
}
