//! Plants that explain the leaf mass of a photo, with or without rows.
//!
//! Each component of the leaf mask has a mass `m`, the number of its pixels. How much leaf one plant has
//! is estimated from all components together ([`MassModel`]); that says how many plants each component holds, or that it
//! is a speck. Components of several plants are cut into groups of pixels ([`split`]). Nothing is assumed of rows,
//! of the crop or of the resolution.
//!
//! The number of plants has an interval: `Var(n) = sum_c Var(k_c | m_c) + (dn / d ln M)^2 Var(ln M) + (0.16 s n)^2`, the
//! last term for what the model does not know. Where few plants of very different sizes stand among weeds, mass does not say how many
//! there are, and each component is a plant or none (`sizes`). What no plant explains is reported: the mass of specks.

mod lengths;
mod model;
mod sizes;
mod split;

pub use lengths::LengthModel;
pub use model::{LEAST, MOST, MassModel, Measured};
use rowgram_optim::robust::median;
pub use split::split;

use rayon::prelude::*;
use rowgram_raster::{Mask, components};
use serde::{Deserialize, Serialize};
use sizes::Sizes;

/// A plant found by its mass. Pixel centres have whole coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Plant {
    /// Column of its middle, in pixels.
    pub u_px: f64,
    /// Row of its middle, in pixels.
    pub v_px: f64,
    /// Its share of the component's mass, in pixels.
    pub mass_px: f64,
    /// Its component, by the order of first pixels.
    pub component: usize,
    /// Plants that share its component.
    pub in_component: usize,
    /// Probability that a plant stands within a quarter of the spacing: that the component holds at least as many plants
    /// as were found in it, averaged over them, times the share of places that are right.
    pub confidence: f64,
    /// Its share of the number of plants that the component is expected to hold.
    pub expected: f64,
    /// Its share of the variance of that.
    pub variance: f64,
}

/// The plants of a photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MassCount {
    /// Plants, by the first pixels of their components.
    pub plants: Vec<Plant>,
    /// Leaf mass of one plant; that of the middle one where plants have very different sizes. 1 without plants.
    pub plant_px: f64,
    /// Expected number of plants.
    pub expected: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// Share of the leaf mass that no plant explains.
    pub unexplained: f64,
}

impl MassCount {
    /// Interval that holds the number with about 95 %.
    pub fn interval(&self) -> [f64; 2] {
        let (away, found) = (1.96 * self.sigma, self.plants.len() as f64);
        // What was found is possible.
        [(self.expected - away).max(0.0).min(found), (self.expected + away).max(found)]
    }
}

/// The components of a mask and the masses of plants that they suggest.
pub(super) struct Parts<'a> {
    mask: &'a Mask,
    posterior: Option<&'a [u8]>,
    heading_rad: Option<f64>,
    parts: Vec<components::Part>,
    measured: Vec<Measured>,
    model: Option<MassModel>,
    sizes: Option<Sizes>,
}

impl<'a> Parts<'a> {
    /// `posterior` has the probability of vegetation of each pixel in 1/255: how green components are.
    pub(super) fn new(mask: &'a Mask, posterior: Option<&'a [u8]>) -> Parts<'a> {
        let parts = components::parts(mask);
        let (measured, model, sizes, heading_rad) = (Vec::new(), None, None, None);
        let mut found = Parts { mask, posterior, heading_rad, parts, measured, model, sizes };
        found.measure_all();
        found
    }

    /// Plants stand in rows of this heading: components of several are long along it.
    pub(super) fn stand_along(&mut self, heading_rad: f64) {
        self.heading_rad = Some(heading_rad);
        self.measure_all();
    }

    fn measure_all(&mut self) {
        self.measured = self.parts.par_iter().map(|part| self.measure(part)).collect();
        self.model = MassModel::fit(&self.measured);
        self.sizes = self.model.as_ref().and_then(|model| {
            let numbers: Vec<usize> = self.measured.iter().map(|&of| model.count(of).0).collect();
            Sizes::fit(&self.measured, &numbers)
        });
    }

    /// Log odds of vegetation of a pixel; certainty is that of a count of 255.
    fn log_odds(&self, pixel: usize) -> Option<f64> {
        let p = f64::from(*self.posterior?.get(pixel)?).clamp(1.0, 254.0);
        Some((p / (255.0 - p)).ln())
    }

    /// The number of plants in a component, the expected one and its variance.
    fn number(&self, model: &MassModel, of: &Measured) -> (usize, f64, f64) {
        match &self.sizes {
            None => model.count(*of),
            Some(sizes) => {
                let p = sizes.probability(of);
                (usize::from(sizes.is_plant(of)), p, p * (1.0 - p))
            }
        }
    }

    fn measure(&self, part: &components::Part) -> Measured {
        let mut log_odds = Some(0.0);
        let [mut u1, mut v1, mut uu, mut uv, mut vv] = [0.0; 5];
        let (u0, v0) = (part.window.u as f64, part.window.v as f64);
        for run in &part.runs {
            for (pixel, [u, v]) in run.pixels(self.mask.width).zip(run.places()) {
                log_odds = log_odds.zip(self.log_odds(pixel)).map(|(sum, of)| sum + of);
                let [u, v] = [u - u0, v - v0];
                u1 += u;
                v1 += v;
                uu += u * u;
                uv += u * v;
                vv += v * v;
            }
        }
        let n = part.pixels.max(1) as f64;
        // A pixel is a square.
        let [a, b] = [uu / n - (u1 / n).powi(2), vv / n - (v1 / n).powi(2)].map(|x| x + 1.0 / 12.0);
        let c = uv / n - u1 * v1 / (n * n);
        let longest = 0.5 * (a + b) + (0.25 * (a - b).powi(2) + c * c).sqrt();
        let along = self.heading_rad.map_or(longest, |heading_rad| {
            let (sin, cos) = heading_rad.sin_cos();
            cos * cos * a + 2.0 * sin * cos * c + sin * sin * b
        });
        Measured {
            mass: part.pixels as f64,
            shape: Some(0.5 * (longest / n).ln()),
            length: Some(0.5 * along.ln()),
            log_odds: log_odds.map(|sum| sum / n),
        }
    }

    /// The mass of the component in which the middle pixel of all leaf lies.
    pub(super) fn middle_px(&self) -> f64 {
        sizes::middle_mass(&self.measured).unwrap_or(1.0)
    }

    /// The mask without its smallest components, which have this share of the mass together.
    pub(super) fn without_smallest(&self, share: f64) -> Mask {
        let mut masses: Vec<f64> = self.measured.iter().map(|of| of.mass).collect();
        masses.sort_by(f64::total_cmp);
        let mut left = share * masses.iter().sum::<f64>();
        let least = masses.into_iter().find(|mass| {
            left -= mass;
            left < 0.0
        });
        self.mask_of(|part| least.is_some_and(|least| self.measured[part].mass >= least))
    }

    /// The mask with some of its components only.
    pub(super) fn mask_of(&self, is_kept: impl Fn(usize) -> bool) -> Mask {
        let mut mask = Mask::empty(self.mask.width, self.mask.height);
        for part in (0..self.parts.len()).filter(|&part| is_kept(part)) {
            for run in &self.parts[part].runs {
                mask.data[run.pixels(mask.width)].fill(1);
            }
        }
        mask
    }

    /// Masses and middles of the components that hold no plant.
    pub(super) fn specks(&self) -> Vec<(f64, [f64; 2])> {
        let held = |of: &Measured| self.model.as_ref().map_or(0, |model| self.number(model, of).0);
        let middle = |part: &components::Part| {
            let window = part.window;
            let at = |from: usize, size: usize| from as f64 + 0.5 * (size as f64 - 1.0);
            [at(window.u, window.width), at(window.v, window.height)]
        };
        let all = self.parts.iter().zip(&self.measured);
        all.filter(|(_, of)| held(of) == 0).map(|(part, of)| (of.mass, middle(part))).collect()
    }

    /// Counts and locates the plants: `wanted` of them, or as many as there seem to be.
    pub(super) fn count(&self, wanted: Option<usize>) -> MassCount {
        let total: f64 = self.measured.iter().map(|of| of.mass).sum();
        let Some(model) = &self.model else {
            let unexplained = if total > 0.0 { 1.0 } else { 0.0 };
            return MassCount {
                plants: Vec::new(),
                plant_px: 1.0,
                expected: 0.0,
                sigma: 0.0,
                unexplained,
            };
        };
        let numbers = match wanted {
            Some(wanted) => self.share_out(model, wanted),
            None => self.measured.iter().map(|of| self.number(model, of).0).collect(),
        };
        let of_part = |(component, &plants): (usize, &usize)| {
            let (part, measured) = (&self.parts[component], self.measured[component]);
            if plants == 0 {
                return Vec::new();
            }
            let centres = split(part, plants);
            let confidence = match &self.sizes {
                Some(sizes) => PLACED * sizes.probability(&measured) / plants as f64,
                None => confidence(model, measured, plants),
            };
            let of_each = 1.0 / centres.len().max(1) as f64;
            let (_, expected, variance) = self.number(model, &measured);
            let plant = |centre: &[f64; 2]| Plant {
                u_px: centre[0],
                v_px: centre[1],
                mass_px: measured.mass * of_each,
                component,
                in_component: centres.len(),
                confidence,
                expected: expected * of_each,
                variance: variance * of_each,
            };
            centres.iter().map(plant).collect()
        };
        let of_parts = numbers.par_iter().enumerate().map(of_part);
        let plants: Vec<Plant> = of_parts.collect::<Vec<_>>().concat();
        let expected_of = |model: &MassModel| {
            self.measured.iter().map(|of| self.number(model, of).1).sum::<f64>()
        };
        let within: f64 = self.measured.iter().map(|of| self.number(model, of).2).sum();
        let (expected, plant_px, misfit, slope) = if self.sizes.is_some() {
            let middle = median(plants.iter().map(|plant| plant.mass_px)).unwrap_or(1.0);
            // Halfway between what is probable and what was found.
            let expected = 0.5 * (expected_of(model) + plants.len() as f64);
            (expected, middle, sizes::MISFIT * expected, 0.0)
        } else {
            let step = model.log_sigma;
            let apart = expected_of(&model.scaled(step)) - expected_of(&model.scaled(-step));
            let expected = expected_of(model);
            (expected, model.plant, MISFIT * model.spread * expected, apart / 2.0)
        };
        let explained: f64 = plants.iter().map(|plant| plant.mass_px).sum();
        let unexplained = if total > 0.0 { (1.0 - explained / total).max(0.0) } else { 0.0 };
        let sigma = (within + slope * slope + misfit * misfit).sqrt();
        MassCount { plants, plant_px, expected, sigma, unexplained }
    }

    /// `wanted` plants shared out to components.
    fn share_out(&self, model: &MassModel, wanted: usize) -> Vec<usize> {
        let Some(sizes) = self.sizes.as_ref().filter(|_| wanted <= self.measured.len()) else {
            return model.share_out(&self.measured, wanted);
        };
        let probabilities: Vec<f64> =
            self.measured.iter().map(|of| sizes.probability(of)).collect();
        let mut order: Vec<usize> = (0..self.measured.len()).collect();
        order.sort_by(|&a, &b| probabilities[b].total_cmp(&probabilities[a]).then(a.cmp(&b)));
        let mut numbers = vec![0; order.len()];
        order.into_iter().take(wanted).for_each(|at| numbers[at] = 1);
        numbers
    }
}

/// Standard deviation of the relative error of counts that the model does not explain, in spreads of a plant's mass: the more plants
/// differ, the less mass tells. Chosen on three sets together (maize plots, seedling clips, maize on straw): intervals of 95 % then hold the truth in
/// 0.95 of 100, 0.98 of 50 and 5 of 5 photos.
/// `experiments accuracy` fits the width of intervals without each set.
pub const MISFIT: f64 = 0.16;
/// Share of plants that are within a quarter of the spacing of a true one, of those whose number is right. Mean confidence and precision
/// are then 0.93 and 0.92 on maize plots, 0.90 and 0.92 on seedling clips, 0.91 and 0.98 on straw.
pub const PLACED: f64 = 0.94;

/// Mean over the plants found in a component of the probability that it holds as many.
fn confidence(model: &MassModel, measured: Measured, plants: usize) -> f64 {
    if plants > MOST {
        return PLACED * (1.0 - 0.5 * model.spread);
    }
    let p = model.probabilities(measured);
    let at_least = |k: usize| p[k..].iter().sum::<f64>();
    PLACED * (1..=plants).map(at_least).sum::<f64>() / plants as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Round plants, some in touching pairs, and specks.
    fn scattered(seed: u64, radius: f64) -> (Mask, Vec<[f64; 2]>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut places = Vec::new();
        for i in 0..8 {
            for j in 0..6 {
                let spacing = 5.0 * radius;
                let mut jitter = || (rng.random::<f64>() - 0.5) * radius;
                let place = [
                    spacing * (f64::from(i) + 0.7) + jitter(),
                    spacing * (f64::from(j) + 0.7) + jitter(),
                ];
                places.push(place);
                if rng.random::<f64>() < 0.2 {
                    places.push([place[0] + 1.8 * radius, place[1]]);
                }
            }
        }
        let specks: Vec<usize> = (0..300).map(|_| rng.random_range(0..1_000_000)).collect();
        let (width, height) = ((43.0 * radius) as usize, (33.0 * radius) as usize);
        let mut mask = Mask::from_fn(width, height, |u, v| {
            places.iter().any(|p| (u as f64 - p[0]).hypot(v as f64 - p[1]) < radius)
        });
        for at in specks {
            let pixels = mask.data.len();
            mask.data[at % pixels] = 1;
        }
        (mask, places)
    }

    #[test]
    fn scattered_plants_are_counted_at_any_resolution() {
        for (seed, radius) in [(1, 5.0), (2, 9.0), (3, 20.0)] {
            let (mask, places) = scattered(seed, radius);
            let found = Parts::new(&mask, None).count(None);
            let n = places.len() as f64;
            assert!((found.plants.len() as f64 - n).abs() <= 1.0, "{} of {n}", found.plants.len());
            let [low, high] = found.interval();
            assert!(low - 0.5 <= n && n <= high + 0.5, "{low}..{high} for {n}");
            let near = |p: &&[f64; 2]| {
                found.plants.iter().any(|q| (q.u_px - p[0]).hypot(q.v_px - p[1]) < 0.3 * radius)
            };
            assert!(places.iter().filter(near).count() as f64 > 0.97 * n);
            assert!(found.unexplained < 0.08, "{}", found.unexplained);
        }
    }

    #[test]
    fn nothing_one_and_two() {
        let count = |mask: &Mask| Parts::new(mask, None).count(None);
        assert_eq!(count(&Mask::empty(30, 20)).plants, []);
        let disc = |u: usize, v: usize, at: f64| (u as f64 - at).hypot(v as f64 - 15.0) < 8.0;
        let one = count(&Mask::from_fn(60, 30, |u, v| disc(u, v, 15.0)));
        assert_eq!(one.plants.len(), 1);
        assert!((one.plants[0].u_px - 15.0).abs() < 0.1);
        let two = count(&Mask::from_fn(60, 30, |u, v| disc(u, v, 15.0) || disc(u, v, 43.0)));
        assert_eq!(two.plants.len(), 2);
    }
}
