//! How much leaf one plant has, estimated from the components of a photo (empirical Bayes).
//!
//! ```text
//! ln m | k plants    ~ N(ln(k^g M), s^2 / k + t^2),  k = 1..12,  specks: log-uniform from 4 px to 0.3 M, with a soft end
//! ln a | m, k plants ~ N(ln sqrt((c^2 + d^2 (k^2 - 1) / 12) M) + b ln(m / (k M)), q^2)
//! ```
//!
//! `a` is the standard deviation of a component's pixels along the row, or along its longest axis where no rows are known. Plants in a line,
//! `d sqrt(M)` apart, make a component longer than a large plant is: where plants differ much in size, that tells two plants from
//! one better than mass. Leaves of plants that touch cover one another, hence `g`.
//!
//! `M`, `s`, the share of specks and the frequencies of `k` are estimated by EM over all components. It starts at the
//! mode of leaf mass over `ln m`, where the largest component near each size is left out: one field of grass or one
//! boot is no evidence of a size, and specks have little mass however many they are. Lengths come in last, as they say nothing of
//! `M`; but where masses differ more than those of plants do, `M` is the mass near by that masses and lengths together make likeliest.

use super::lengths::LengthModel;
use serde::{Deserialize, Serialize};

/// Most plants that a component of the mixture holds; larger ones are counted by their mass.
pub const MOST: usize = 12;
/// Least mass that is looked at, in pixels.
pub const LEAST: f64 = 4.0;
/// Spread of `ln m` of one plant before the photo is seen, what that is worth in plants, and the spread that is
/// common to all components.
const SPREAD: (f64, f64, f64) = (0.35, 8.0, 0.03);
/// Plants of one age differ no more than this: a greater spread of `ln m` means that the mass of a plant is wrong. Assumed; 40 maize plots and five photos of maize
/// on straw stay below it.
const MAX_SPREAD: f64 = 0.5;
/// Step in `ln M` of the search for a likelier mass of a plant, and by how much its log-likelihood has to be greater. Most of 40 seedling clips, 14 plots of
/// beans and 3 tiles of sorghum have such a spread; a likelier mass by 6 makes the number better on all three tiles, one clip and four plots and worse on one of
/// each of these two. Chosen with them in view.
const CLIMB: (f64, f64) = (0.1, 6.0);
/// So many components, spread over the picture, are enough for that search. Assumed: pictures of the real sets have fewer.
const MAX_CLIMBED: usize = 2000;
/// Specks end at this share of a plant.
const SPECK: f64 = 0.3;
/// Ratio of the frequencies of `k + 1` and `k` plants before the photo is seen, worth some components.
const TOUCHING: (f64, f64) = (0.4, 3.0);
/// What the starting value of `M` is worth, in components at a spread of 0.35. With 2, dirt among 35 seedlings in residue passes for
/// plants; with 12 pairs do.
const START: f64 = 6.0;
/// Leaf of `k` plants that touch, in plants, is `k` to this power. From 0.93 to 1 the mean error of numbers on maize plots, seedling clips and
/// maize on straw changes by 0.6 % of the number at most; each set alone would have 0.93 to 0.97.
const COVERED: f64 = 0.95;
/// A mode this many times heavier, with this share of the highest, is that of the crop: from 3 to 4 times and 0.5 to 0.7 the same on
/// maize plots, seedling clips, maize on straw and potatoes.
const HEAVIER: (f64, f64) = (3.0, 0.5);
/// A number of plants that is given is reached with plants lighter or heavier by this factor at most, in `ln M`.
const LIGHTEST: f64 = 4.0;
/// Width of the mode and step of its search, in `ln m`.
const MODE: (f64, f64) = (0.25, 0.05);

/// What was estimated of a field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MassModel {
    /// Leaf mass of one plant, in pixels.
    pub plant: f64,
    /// Standard deviation of the logarithm of a plant's mass.
    pub spread: f64,
    /// Standard deviation of `ln plant`.
    pub log_sigma: f64,
    /// Share of the components that are specks.
    pub specks: f64,
    /// Frequencies of `1..=MOST` plants among the others.
    pub frequencies: Vec<f64>,
    /// What lengths say; `None` where they are not known.
    pub length: Option<LengthModel>,
}

/// What is measured of a component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Its mass, in pixels.
    pub mass: f64,
    /// Logarithm of its standard deviation along its longest axis over the square root of its pixels.
    pub shape: Option<f64>,
    /// Logarithm of its standard deviation along the row, in pixels, or along its longest axis.
    pub length: Option<f64>,
    /// Mean log odds of vegetation of its pixels; `None` where their posterior is not known.
    pub log_odds: Option<f64>,
}

impl From<f64> for Measured {
    fn from(mass: f64) -> Measured {
        Measured { mass, shape: None, length: None, log_odds: None }
    }
}

impl Measured {
    /// Logarithm of the length in square roots of a plant's mass, and that of the mass in plants.
    pub(super) fn relative(&self, plant: f64) -> Option<(f64, f64)> {
        Some((self.length? - 0.5 * plant.ln(), (self.mass / plant).ln()))
    }
}

/// What a step of EM estimates besides the share of specks, the frequencies and lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Free {
    /// The mass of a plant, which starts at this one, and the spread of masses.
    Mass { start: f64 },
    /// The spread of masses.
    Spread,
    /// Nothing: lengths say nothing of the mass of a plant.
    Lengths,
}

/// Logarithm of the density of a spread that is usually so great, for each plant that this is worth.
pub(super) fn log_prior_of_spread(sigma: f64, usual: f64) -> f64 {
    -sigma.ln() - 0.5 * (usual / sigma).powi(2)
}

/// Frequencies of `1..=MOST` plants before the photo is seen.
fn usual_frequencies() -> [f64; MOST] {
    let usual: [f64; MOST] = std::array::from_fn(|k| TOUCHING.0.powi(k as i32));
    let sum: f64 = usual.iter().sum();
    usual.map(|u| u / sum)
}

impl MassModel {
    /// Estimates the model from components, or masses of components in pixels; `None` if none has at least [`LEAST`].
    pub fn fit<C: Into<Measured> + Copy>(components: &[C]) -> Option<MassModel> {
        let all = components.iter().map(|&c| c.into());
        let measured: Vec<Measured> = all.filter(|c| c.mass >= LEAST).collect();
        let start = mode(&measured.iter().map(|c| c.mass).collect::<Vec<f64>>())?;
        let mut model = MassModel::before(start);
        for _ in 0..40 {
            model.update(&measured, Free::Mass { start });
        }
        if measured.iter().any(|c| c.length.is_some()) {
            model.length = Some(LengthModel::BEFORE);
            let by_mass = model.clone();
            for _ in 0..20 {
                model.update(&measured, Free::Lengths);
            }
            if by_mass.spread >= MAX_SPREAD
                && let Some(better) = by_mass.climb(&measured)
            {
                return Some(better);
            }
        }
        Some(model)
    }

    /// What is known of plants of a mass before the photo is seen.
    fn before(plant: f64) -> MassModel {
        MassModel {
            plant,
            spread: SPREAD.0,
            log_sigma: 1.0,
            specks: 0.5,
            frequencies: usual_frequencies().to_vec(),
            length: None,
        }
    }

    /// The mass of a plant that masses and lengths together make likeliest, uphill from this one; `None` where that is not much likelier.
    /// Each mass is judged with all that fits it best.
    fn climb(&self, all: &[Measured]) -> Option<MassModel> {
        let every = all.len().div_ceil(MAX_CLIMBED).max(1);
        let measured: Vec<Measured> = all.iter().step_by(every).copied().collect();
        let measured = &measured[..];
        let at = |steps: i32| {
            let mut model = MassModel::before(self.plant * (CLIMB.0 * f64::from(steps)).exp());
            model.length = Some(LengthModel::BEFORE);
            for _ in 0..30 {
                model.update(measured, Free::Spread);
            }
            let likely = model.log_posterior(measured);
            (model, likely)
        };
        let here = at(0).1;
        let mut best = None;
        let mut most = here + CLIMB.1;
        for direction in [-1, 1] {
            let (mut steps, mut last) = (direction, here);
            loop {
                let (model, likely) = at(steps);
                if likely.is_nan() || likely <= last {
                    break;
                }
                if likely > most {
                    (best, most) = (Some(model), likely);
                }
                (steps, last) = (steps + direction, likely);
            }
        }
        let mut best = best?;
        if every > 1 {
            best.update(all, Free::Spread);
        }
        Some(best)
    }

    /// Logarithm of the probability of the components and of what was estimated besides the mass of a plant, up to a constant.
    fn log_posterior(&self, measured: &[Measured]) -> f64 {
        let likely = |c: &Measured| self.densities(*c).iter().sum::<f64>().max(1e-12).ln();
        let mut sum: f64 = measured.iter().map(likely).sum();
        sum += SPREAD.1 * log_prior_of_spread(self.spread, SPREAD.0);
        sum += self.length.map_or(0.0, |length| length.log_prior());
        let frequencies = usual_frequencies().into_iter().zip(&self.frequencies);
        sum += frequencies.map(|(usual, of)| TOUCHING.1 * usual * of.ln()).sum::<f64>();
        sum + 0.5 * (self.specks.ln() + (1.0 - self.specks).ln())
    }

    /// The usual leaf of `k` plants that touch.
    fn mass(&self, k: usize) -> f64 {
        (k as f64).powf(COVERED) * self.plant
    }

    /// One step of EM for the share of specks, the frequencies, and what is free besides.
    fn update(&mut self, measured: &[Measured], free: Free) {
        let mut counts = usual_frequencies().map(|u| TOUCHING.1 * u);
        let (mut specks, mut singles, mut squares) = (0.5, 0.0, 0.0);
        let (mut precision, mut sum) = (0.0, 0.0);
        if let Free::Mass { start } = free {
            // The mode of leaf mass is that of plants weighed by their mass.
            precision = START / SPREAD.0.powi(2);
            sum = precision * (start.ln() - self.spread.powi(2));
        }
        let posteriors: Vec<_> = measured.iter().map(|&c| self.probabilities(c)).collect();
        for (c, p) in measured.iter().zip(&posteriors) {
            specks += p[0];
            counts.iter_mut().zip(&p[1..]).for_each(|(count, p)| *count += p);
            // Larger groups say little of one plant: their `k` is uncertain.
            for k in 1..=4 {
                let weight = p[k] / self.variance(k);
                precision += weight;
                sum += weight * (c.mass.ln() - COVERED * (k as f64).ln());
            }
            singles += p[1];
            squares += p[1] * (c.mass / self.plant).ln().powi(2);
        }
        if let Some(length) = self.length {
            self.length = Some(length.updated(self.plant, measured, &posteriors));
        }
        if let Free::Mass { .. } = free {
            self.plant = (sum / precision).exp();
        }
        if free != Free::Lengths {
            self.log_sigma = precision.sqrt().recip();
            let spread = ((squares + SPREAD.1 * SPREAD.0.powi(2)) / (singles + SPREAD.1)).sqrt();
            self.spread = spread.clamp(0.15, MAX_SPREAD);
        }
        self.specks = specks / (measured.len() as f64 + 1.0);
        let total: f64 = counts.iter().sum();
        self.frequencies = counts.iter().map(|c| c / total).collect();
    }

    fn variance(&self, k: usize) -> f64 {
        self.spread.powi(2) / k as f64 + SPREAD.2.powi(2)
    }

    /// Densities of a component, in the logarithm of its mass, where it holds 0 (a speck), 1, .., [`MOST`] plants.
    fn densities(&self, component: Measured) -> [f64; MOST + 1] {
        let m = component.mass;
        let mut p = [0.0; MOST + 1];
        let end = SPECK * self.plant;
        // Log-uniform, with an end that is soft.
        p[0] = self.specks / (end.max(2.0 * LEAST) / LEAST).ln() / (1.0 + (m / end).powi(8));
        for k in 1..=MOST {
            let variance = self.variance(k);
            let away = (m / self.mass(k)).ln();
            let density =
                (-0.5 * away * away / variance).exp() / (std::f64::consts::TAU * variance).sqrt();
            p[k] = (1.0 - self.specks) * self.frequencies[k - 1] * density;
        }
        if let (Some((length, heavier)), Some(model)) =
            (component.relative(self.plant), &self.length)
            && p.iter().sum::<f64>() >= 1e-12
        {
            let densities = model.densities(length, heavier);
            p.iter_mut().zip(densities).for_each(|(p, density)| *p *= density);
        }
        p
    }

    /// Probabilities that a component holds 0 (a speck), 1, .., [`MOST`] plants.
    pub fn probabilities(&self, component: impl Into<Measured>) -> [f64; MOST + 1] {
        let component = component.into();
        let mut p = self.densities(component);
        let sum: f64 = p.iter().sum();
        if sum < 1e-18 {
            p = [0.0; MOST + 1];
            p[if component.mass < SPECK * self.plant { 0 } else { MOST }] = 1.0;
        } else {
            p.iter_mut().for_each(|p| *p /= sum);
        }
        p
    }

    /// The likeliest number of plants in a component, the expected one and its variance.
    pub fn count(&self, component: impl Into<Measured>) -> (usize, f64, f64) {
        let component = component.into();
        let m = component.mass;
        if m < LEAST {
            return (0, 0.0, 0.0);
        }
        if m > self.mass(MOST) {
            let k = MOST as f64 * m / self.mass(MOST);
            return (k.round() as usize, k, k * self.spread.powi(2));
        }
        let p = self.probabilities(component);
        let best = (1..=MOST).fold(1, |best, k| if p[k] > p[best] { k } else { best });
        let mean: f64 = p.iter().enumerate().map(|(k, p)| k as f64 * p).sum();
        let square: f64 = p.iter().enumerate().map(|(k, p)| (k * k) as f64 * p).sum();
        (if p[0] > 0.5 { 0 } else { best }, mean, (square - mean * mean).max(0.0))
    }

    /// `wanted` plants shared out to components: the likeliest numbers, of plants so heavy that it fits.
    pub fn share_out(&self, components: &[Measured], wanted: usize) -> Vec<usize> {
        let numbers = |model: &MassModel| -> Vec<usize> {
            components.iter().map(|&component| model.count(component).0).collect()
        };
        let total = |model: &MassModel| numbers(model).iter().sum::<usize>();
        // Heavier plants are fewer, apart from what turns into specks.
        let (mut light, mut heavy) = (-LIGHTEST, LIGHTEST);
        for _ in 0..24 {
            let middle = 0.5 * (light + heavy);
            if total(&self.scaled(middle)) > wanted { light = middle } else { heavy = middle }
        }
        let model = self.scaled(heavy);
        let mut found = numbers(&model);
        let mut sum: usize = found.iter().sum();
        // What is left goes one by one to where it costs least.
        let worth = |mass: f64, k: usize| model.log_worth(mass, k);
        while sum != wanted {
            let more = sum < wanted;
            let gain = |at: usize| -> f64 {
                let (mass, k) = (components[at].mass, found[at]);
                if more {
                    worth(mass, k + 1) - worth(mass, k)
                } else if k > 0 {
                    worth(mass, k - 1) - worth(mass, k)
                } else {
                    f64::NEG_INFINITY
                }
            };
            let gains: Vec<f64> = (0..found.len()).map(gain).collect();
            let best =
                (0..gains.len()).max_by(|&a, &b| gains[a].total_cmp(&gains[b]).then(b.cmp(&a)));
            let Some(best) = best.filter(|&best| gains[best] > f64::NEG_INFINITY) else { break };
            (found[best], sum) =
                if more { (found[best] + 1, sum + 1) } else { (found[best] - 1, sum - 1) };
        }
        found
    }

    /// Logarithm of how well `k` plants explain a component; the mass of a speck cannot be told well.
    fn log_worth(&self, mass: f64, k: usize) -> f64 {
        if mass < LEAST {
            return if k == 0 { 0.0 } else { -1e6 * k as f64 };
        }
        if k == 0 {
            return self.probabilities(mass)[0].max(1e-12).ln();
        }
        let variance = self.variance(k);
        let away = (mass / self.mass(k)).ln();
        let usual = (1.0 - self.specks) * self.frequencies[k.min(MOST) - 1].max(1e-12);
        usual.ln() - 0.5 * away * away / variance - 0.5 * variance.ln()
    }

    /// The same model for plants heavier by `log_ratio` in `ln M`.
    pub fn scaled(&self, log_ratio: f64) -> MassModel {
        MassModel { plant: self.plant * log_ratio.exp(), ..self.clone() }
    }
}

/// Where leaf mass is densest over `ln m`, each time without the component that gives most; or where it is densest among components
/// too heavy for a few of those, as weeds and dirt may have more leaf together than the crop.
fn mode(masses: &[f64]) -> Option<f64> {
    let (width, step) = MODE;
    let largest = masses.iter().copied().reduce(f64::max)?;
    if masses.len() == 1 {
        return Some(largest);
    }
    let bins = ((largest / LEAST).ln() / step).ceil() as usize + 3;
    let (mut sums, mut most) = (vec![0.0; bins], vec![0.0_f64; bins]);
    for &m in masses {
        let at = (m / LEAST).ln() / step;
        let reach = 4.0 * width / step;
        for bin in (at - reach).max(0.0) as usize..((at + reach) as usize + 1).min(bins) {
            let away = (bin as f64 - at) * step / width;
            let share = m * (-0.5 * away * away).exp();
            sums[bin] += share;
            most[bin] = most[bin].max(share);
        }
    }
    let without = |bin: usize| sums[bin] - most[bin];
    let best = (1..bins).fold(0, |best, bin| if without(bin) > without(best) { bin } else { best });
    let (factor, share) = HEAVIER;
    let is_mode = |&bin: &usize| {
        let next = without((bin + 1).min(bins - 1));
        without(bin) >= share * without(best) && without(bin) >= without(bin - 1).max(next)
    };
    let far = best + (factor.ln() / step).ceil() as usize;
    let best = (far.max(1)..bins.max(far)).rev().find(is_mode).unwrap_or(best);
    Some(LEAST * (best as f64 * step).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phenotype::plant_mass::lengths::LONGER;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Masses of components: specks, plants alone and in groups, one boot. And how many plants.
    fn field(seed: u64, plants: usize, specks: usize, boot: bool) -> (Vec<f64>, usize) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let normal = |rng: &mut ChaCha8Rng| (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
        let mut masses = Vec::new();
        let mut left = plants;
        while left > 0 {
            let k = if rng.random::<f64>() < 0.25 { 2 } else { 1 }.min(left);
            left -= k;
            masses.push((0..k).map(|_| 600.0 * (0.25 * normal(&mut rng)).exp()).sum());
        }
        masses.extend((0..specks).map(|_| 4.0 + 60.0 * rng.random::<f64>().powi(4)));
        masses.extend(boot.then_some(60_000.0));
        (masses, plants)
    }

    #[test]
    fn mass_of_a_plant_is_found_among_specks() {
        for (seed, specks) in [(1, 0), (2, 50), (3, 800)] {
            let (masses, plants) = field(seed, 80, specks, false);
            let model = MassModel::fit(&masses).unwrap();
            assert!((model.plant / 600.0).ln().abs() < 0.12, "{specks} specks: {model:?}");
            let count: f64 = masses.iter().map(|&m| model.count(m).1).sum();
            assert!((count - plants as f64).abs() < 7.0, "{specks} specks: {count} of {plants}");
        }
    }

    #[test]
    fn a_crop_among_many_small_weeds_is_the_heavier_of_two_sizes() {
        let (mut masses, _) = field(8, 30, 0, false);
        masses.extend((0..120).map(|k| 80.0 + 0.4 * f64::from(k % 100)));
        let model = MassModel::fit(&masses).unwrap();
        assert!((model.plant / 600.0).ln().abs() < 0.3, "{model:?}");
    }

    #[test]
    fn one_large_thing_is_no_evidence_of_a_size() {
        let (masses, _) = field(4, 9, 40, true);
        let model = MassModel::fit(&masses).unwrap();
        assert!((model.plant / 600.0).ln().abs() < 0.3, "{model:?}");
    }

    #[test]
    fn few_plants_are_counted_too() {
        assert!(MassModel::fit::<f64>(&[]).is_none());
        assert_eq!(MassModel::fit(&[500.0]).unwrap().count(500.0).0, 1);
        let model = MassModel::fit(&[500.0, 560.0]).unwrap();
        assert_eq!((model.count(500.0).0, model.count(560.0).0), (1, 1));
        assert_eq!(model.count(2.0).0, 0);
        assert_eq!(model.count(8.0 * model.mass(MOST)).0, 8 * MOST);
    }

    #[test]
    fn long_components_are_pairs_where_plants_differ_in_size() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let (mut components, mut truth) = (Vec::new(), Vec::new());
        for k in [1, 1, 1, 2].repeat(40) {
            let normal: f64 = (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
            let mass = k as f64 * 300.0 * (0.5 * normal).exp();
            let round = -1.0 + 0.1 * (rng.random::<f64>() - 0.5) + 0.5 * mass.ln();
            let length = Some(round + if k == 2 { 0.35 } else { 0.0 });
            components.push(Measured { mass, shape: None, length, log_odds: None });
            truth.push(k);
        }
        let wrong = |model: &MassModel, components: &[Measured]| {
            let counts = components.iter().map(|&c| model.count(c).0);
            counts.zip(&truth).filter(|(found, k)| found != *k).count()
        };
        let masses: Vec<Measured> = components.iter().map(|c| c.mass.into()).collect();
        let by_mass = wrong(&MassModel::fit(&masses).unwrap(), &masses);
        let by_both = wrong(&MassModel::fit(&components).unwrap(), &components);
        assert!(2 * by_both < by_mass, "{by_both} and {by_mass} of 160");
    }

    #[test]
    fn lengths_tell_the_mass_of_a_plant_where_most_plants_touch() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let mut normal = || (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
        let (mut components, mut plants) = (Vec::new(), 0);
        for k in [1, 2, 1, 3, 2, 1].repeat(12) {
            // Leaves across the row: a plant is short along it, and its neighbour as far away as it is wide.
            let mass = (0..k).map(|_| 300.0 * (0.4 * normal()).exp()).sum::<f64>();
            let along = 300.0 * (0.23_f64.powi(2) + 1.3 * f64::from(k * k - 1) / 12.0);
            let heavier = (mass / (300.0 * f64::from(k))).ln();
            let length = Some(0.5 * along.ln() + LONGER * heavier + 0.15 * normal());
            components.push(Measured { mass, shape: None, length, log_odds: None });
            plants += k;
        }
        let count = |components: &[Measured]| {
            let model = MassModel::fit(components).unwrap();
            components.iter().map(|&c| model.count(c).1).sum::<f64>() / f64::from(plants)
        };
        let masses: Vec<Measured> = components.iter().map(|c| c.mass.into()).collect();
        let (by_mass, by_both) = (count(&masses), count(&components));
        assert!(by_mass < 0.75 && (by_both - 1.0).abs() < 0.1, "{by_mass} {by_both}");
    }

    #[test]
    fn a_given_number_is_shared_out() {
        let (masses, plants) = field(6, 60, 100, false);
        let model = MassModel::fit(&masses).unwrap();
        for wanted in [1, plants / 2, plants, plants + 7, 3 * plants] {
            let all: Vec<Measured> = masses.iter().map(|&mass| mass.into()).collect();
            let numbers = model.share_out(&all, wanted);
            assert_eq!(numbers.iter().sum::<usize>(), wanted);
        }
        // The heaviest get more.
        let numbers = model.share_out(&[600.0, 620.0, 1300.0, 5.0].map(Measured::from), 4);
        assert_eq!(numbers, [1, 1, 2, 0]);
    }

    #[test]
    fn probabilities_sum_to_one() {
        let (masses, _) = field(5, 40, 100, true);
        let model = MassModel::fit(&masses).unwrap();
        for m in [4.0, 30.0, 200.0, 600.0, 1300.0, 7000.0, 1e6] {
            let sum: f64 = model.probabilities(m).iter().sum();
            assert!((sum - 1.0).abs() < 1e-9, "{m}: {sum}");
        }
    }
}
