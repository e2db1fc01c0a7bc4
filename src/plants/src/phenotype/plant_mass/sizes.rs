//! Few plants of very different sizes among weeds: potatoes, trees and emerging rows, where mass does not say how many there are.
//!
//! A plant's mass ([`MassModel`](super::MassModel)) explains a photo badly where much of the leaf mass is left to specks, or where
//! compact components would have to hold many plants. Where plants are few as well, each component is one plant or none:
//!
//! ```text
//! P(plant | m, l) = 1 / (1 + (m_0 / m)^1.5)  *  1 / (1 + exp(-3 (z + 1))),     z = (l - l_0) / s_0
//! ```
//!
//! `m_0` is a share of the mass at which half of the leaf mass is in smaller components; `l` is the mean log odds of vegetation of a
//! component's pixels, `l_0` and `s_0` their mean and standard deviation over the leaf mass: weeds are less green than a crop that has
//! most of the leaf.

use super::Measured;

// Constants of this file were chosen on potatoes and emerging maize together (`experiments accuracy`; docs/accuracy.md has what that says of
// sets left out).
/// Leaf mass that plants of one size do not explain, as a share of all, from which on the photo is looked at in this way; 0.05 to 0.07
/// are the same on all sets.
const UNEXPLAINED: f64 = 0.06;
/// More plants, in components that are not odd, say enough of their size.
const FEW: usize = 30;
/// A component with so many plants or more ...
const MANY: usize = 5;
/// ... is compact below this shape: a disc has -1.27, plants in a line 0 and more.
const COMPACT: f64 = -0.8;
/// A component of this share of the middle mass is as likely a speck as a plant. Chosen with [`LESS_GREEN`] on potatoes and emerging maize
/// together: from 0.05 to 0.1, mean F1 is 0.87 to 0.84 and 0.96 to 0.99.
const MIN_SIZE: f64 = 0.07;
/// So many standard deviations below the mean log odds a component is as likely a weed as a plant.
const LESS_GREEN: f64 = 1.0;
/// How sharply both tell.
const SHARPNESS: (f64, f64) = (1.5, 3.0);
/// The least standard deviation of log odds.
const MIN_SPREAD: f64 = 0.05;
/// Standard deviation of the relative error of a count that the probabilities do not know: intervals of 95 % then hold the truth in 0.90 of
/// 20 photos of potatoes and in 4 of 4 of emerging maize.
pub(super) const MISFIT: f64 = 0.25;

/// The mass of the component in which the middle pixel of all leaf lies.
pub(super) fn middle_mass(measured: &[Measured]) -> Option<f64> {
    let mut masses: Vec<f64> = measured.iter().map(|of| of.mass).collect();
    masses.sort_by(f64::total_cmp);
    let mut left = 0.5 * masses.iter().sum::<f64>();
    masses.into_iter().find(|mass| {
        left -= mass;
        left <= 0.0
    })
}

/// What tells plants of any size from specks and weeds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sizes {
    /// Mass of components that are as likely specks as plants.
    least: f64,
    /// Mean log odds over the leaf mass, and their standard deviation.
    green: (f64, f64),
}

impl Sizes {
    /// Looks at a photo whose components hold `numbers` of plants by their mass; `None` where those explain it, or where it is not
    /// known how green components are.
    pub(super) fn fit(measured: &[Measured], numbers: &[usize]) -> Option<Sizes> {
        let total: f64 = measured.iter().map(|of| of.mass).sum();
        let is_odd = |of: &Measured, number: usize| {
            number == 0 || number >= MANY && of.shape.is_some_and(|shape| shape < COMPACT)
        };
        let all = || measured.iter().zip(numbers);
        let odd = all().filter(|(of, number)| is_odd(of, **number));
        let unexplained: f64 = odd.map(|(of, _)| of.mass).sum();
        let usual = all().filter(|(of, number)| !is_odd(of, **number));
        let plants: usize = usual.map(|(_, number)| number).sum();
        if plants >= FEW || unexplained <= UNEXPLAINED * total {
            return None;
        }
        let green: Option<Vec<f64>> = measured.iter().map(|of| of.log_odds).collect();
        let green = green?;
        let mean_of = |value: &dyn Fn(f64) -> f64| {
            let parts = measured.iter().zip(&green);
            parts.map(|(of, &green)| of.mass * value(green)).sum::<f64>() / total
        };
        let mean = mean_of(&|green| green);
        let variance = mean_of(&|green| (green - mean).powi(2));
        let least = MIN_SIZE * middle_mass(measured)?;
        Some(Sizes { least, green: (mean, variance.sqrt().max(MIN_SPREAD)) })
    }

    /// How much greener than the least green plant, in standard deviations.
    fn greener(&self, of: &Measured) -> f64 {
        let (mean, spread) = self.green;
        of.log_odds.map_or(0.0, |green| (green - mean) / spread + LESS_GREEN)
    }

    /// Whether a component is a plant.
    pub(super) fn is_plant(&self, of: &Measured) -> bool {
        of.mass > self.least && self.greener(of) > 0.0
    }

    /// The probability of that.
    pub(super) fn probability(&self, of: &Measured) -> f64 {
        let (by_mass, by_green) = SHARPNESS;
        let large = 1.0 / (1.0 + (self.least / of.mass.max(f64::MIN_POSITIVE)).powf(by_mass));
        large / (1.0 + (-by_green * self.greener(of)).exp())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compact components of these masses and log odds.
    fn measured(of: &[(f64, f64)]) -> Vec<Measured> {
        of.iter()
            .map(|&(mass, green)| Measured {
                mass,
                shape: Some(-1.1),
                length: None,
                log_odds: Some(green),
            })
            .collect()
    }

    #[test]
    fn plants_of_many_sizes_are_told_from_weeds() {
        let plants = [(9000.0, 4.6), (7000.0, 4.4), (2400.0, 4.2), (2000.0, 4.3), (900.0, 3.9)];
        let weeds = [(1500.0, 2.1), (900.0, 2.0), (250.0, 2.2), (60.0, 1.0)];
        let all = measured(&[&plants[..], &weeds[..]].concat());
        // Two plants of one size, the rest specks.
        let sizes = Sizes::fit(&all, &[1, 1, 0, 0, 0, 0, 0, 0, 0]).unwrap();
        let found: Vec<bool> = all.iter().map(|of| sizes.is_plant(of)).collect();
        assert_eq!(found, [true, true, true, true, true, false, false, false, false]);
        for (of, found) in all.iter().zip(found) {
            assert_eq!(sizes.probability(of) > 0.5, found, "{of:?}");
        }
    }

    #[test]
    fn photos_that_one_size_explains_are_left_alone() {
        let all = measured(&[(500.0, 4.0), (520.0, 4.1), (480.0, 4.2), (20.0, 1.0)]);
        assert_eq!(Sizes::fit(&all, &[1, 1, 1, 0]), None);
        // A compact component cannot hold many plants, a long one can.
        let mut all = measured(&[(500.0, 4.0), (520.0, 4.1), (5000.0, 4.2)]);
        assert!(Sizes::fit(&all, &[1, 1, 10]).is_some());
        all[2].shape = Some(0.1);
        assert_eq!(Sizes::fit(&all, &[1, 1, 10]), None);
        // Without a posterior it is not known how green components are.
        all[2] = Measured { mass: 5000.0, shape: Some(-1.1), length: None, log_odds: None };
        assert_eq!(Sizes::fit(&all, &[1, 1, 10]), None);
    }
}
