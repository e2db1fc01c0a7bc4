//! Plants whose leaves a mask shows apart, beside stalks that it does not show: beans, seedlings in shadow, masks with holes.
//!
//! There a component is a leaf, and no mass says how many leaves a plant has. But plants stand on the line of their row and leaves about
//! them, so a plant is a peak of the leaf along its row, blurred by somewhat less than the distance between two leaves of one plant:
//!
//! `l(a) = sum_i exp( -(a - a_i)^2 / (2 h^2) )`, `h` = [`BLUR`] sqrt(m),
//!
//! `a_i` the pixels of the row's band, `m` the mass of the component in which the middle pixel of all leaf lies. That `h` joins leaves of
//! a plant and tells plants of a component apart, both at once. What it may be off by tells the interval of the number and how sure a
//! plant is: its peak is there with a blur [`BLUR_FACTOR`] times as wide and as narrow, or not.

use super::{
    plant_mass::{MassCount, Plant},
    rows::Rows,
};
use rayon::prelude::*;
use rowgram_optim::robust::median;
use rowgram_raster::Mask;

/// Blur along the row, in square roots of the mass of the middle component. From 0.21 to 0.25 the number of peaks is right within 7 % on maize
/// plots, seedling clips and maize on straw, which took part in its choice, and within 10 % on plots of beans, which did not.
const BLUR: f64 = 0.24;
/// The blur that tells plants may be wider or narrower by this factor. Not fitted: with it the interval holds the number on 13 of 14 plots of beans.
const BLUR_FACTOR: f64 = 1.35;
/// A peak has this share of the median height of places with leaf, at least; a guess, not searched for.
const MIN_PEAK_HEIGHT: f64 = 0.15;
/// Places with less than this share of the highest peak have no leaf; a guess, not searched for.
const BARE_SHARE: f64 = 0.01;
/// Places along the row with fewer leaf pixels across its band show noise; a guess, not searched for.
const MIN_LEAF_PIXELS: f64 = 2.0;
/// Where the blur is cut off, in its standard deviations: it is 0.0003 there.
const KERNEL_REACH: f64 = 4.0;
/// Share of plants within a quarter of the spacing of a true one where their number is right: F1 of potatoes, the least of the sets that are
/// counted by mass (0.871 to 0.977, docs/accuracy.md).
const SHARE_WELL_PLACED: f64 = 0.87;
/// The narrowest blur that is tried for a number that was told, as a share of the usual one, and the step of the search.
const NARROWER_BLUR: (f64, f64) = (0.25, 0.9);

/// The leaf along one row.
struct Profile {
    /// Where it begins along the row.
    start: f64,
    /// Leaf pixels of each place.
    pixels: Vec<f64>,
    /// Sum of their positions across the rows.
    across: Vec<f64>,
}

/// Plants as peaks of the leaf within `band_px` of rows; `middle_px` is the mass of the middle component. `count` of them, or as many as there
/// are; `None` where there are fewer.
pub(super) fn locate(
    mask: &Mask,
    rows: &Rows,
    band_px: f64,
    middle_px: f64,
    count: Option<usize>,
) -> Option<MassCount> {
    let blur = (BLUR * middle_px.sqrt()).max(1.0);
    let profiles = profiles(mask, rows, band_px, (KERNEL_REACH * blur).ceil());
    let at = |blur: f64| -> Vec<Vec<usize>> {
        profiles.par_iter().map(|profile| profile.peaks(blur)).collect()
    };
    let mut peaks = at(blur);
    let mut narrow = 1.0;
    while count.is_some_and(|count| total(&peaks) < count) && narrow > NARROWER_BLUR.0 {
        narrow *= NARROWER_BLUR.1;
        peaks = at(narrow * blur);
    }
    if total(&peaks) == 0 || count.is_some_and(|count| total(&peaks) < count) {
        return None;
    }
    let others = [at(narrow * blur / BLUR_FACTOR), at(narrow * blur * BLUR_FACTOR)];
    let [more, less] = [&others[0], &others[1]].map(|peaks| total(peaks) as f64);
    let mut plants = Vec::new();
    for (row, (profile, found)) in profiles.iter().zip(&peaks).enumerate() {
        for (k, &place) in found.iter().enumerate() {
            let from = k.checked_sub(1).map_or(0, |k| found[k].midpoint(place));
            let to = found.get(k + 1).map_or(profile.pixels.len(), |next| place.midpoint(*next));
            let near = (blur.round() as usize).max(1);
            let seen = |peaks: &Vec<Vec<usize>>| {
                peaks[row].iter().any(|other| other.abs_diff(place) <= near)
            };
            let stable = (1 + others.iter().filter(|peaks| seen(peaks)).count()) as f64 / 3.0;
            let across = profile.middle(place, near).unwrap_or(rows.rows[row].across_px);
            let [u_px, v_px] = rows.axes.image([profile.start + place as f64, across]);
            plants.push(Plant {
                u_px,
                v_px,
                mass_px: profile.pixels[from..to].iter().sum(),
                component: plants.len(),
                in_component: 1,
                confidence: SHARE_WELL_PLACED * stable,
                expected: 1.0,
                variance: stable * (1.0 - stable),
            });
        }
    }
    if let Some(count) = count {
        plants.sort_by(|a, b| b.mass_px.total_cmp(&a.mass_px).then(a.component.cmp(&b.component)));
        plants.truncate(count);
        plants.sort_by_key(|plant| plant.component);
    }
    let expected = plants.len() as f64;
    let explained: f64 = plants.iter().map(|plant| plant.mass_px).sum();
    Some(MassCount {
        plant_px: median(plants.iter().map(|plant| plant.mass_px)).unwrap_or(1.0).max(1.0),
        expected,
        sigma: 0.5 * (more - less).abs(),
        unexplained: (1.0 - explained / mask.count().max(1) as f64).max(0.0),
        plants,
    })
}

fn total(peaks: &[Vec<usize>]) -> usize {
    peaks.iter().map(Vec::len).sum()
}

/// The leaf of every row, with `beyond` pixels before its first leaf and after its last.
fn profiles(mask: &Mask, rows: &Rows, band_px: f64, beyond: f64) -> Vec<Profile> {
    let mut profiles: Vec<Profile> = rows
        .rows
        .iter()
        .map(|row| {
            let places = (row.length_px() + 2.0 * beyond).ceil().max(1.0) as usize;
            let start = row.start_px - beyond;
            Profile { start, pixels: vec![0.0; places], across: vec![0.0; places] }
        })
        .collect();
    for v in 0..mask.height {
        for (u, _) in mask.row(v).iter().enumerate().filter(|(_, pixel)| **pixel != 0) {
            let [along, across] = rows.axes.aligned([u as f64, v as f64]);
            let Some((row, _)) = rows.nearest(across).filter(|found| found.1 <= band_px) else {
                continue;
            };
            let profile = &mut profiles[row];
            let place = (along - profile.start).round();
            if place >= 0.0 && (place as usize) < profile.pixels.len() {
                profile.pixels[place as usize] += 1.0;
                profile.across[place as usize] += across;
            }
        }
    }
    profiles
}

impl Profile {
    /// The places of its peaks under a blur.
    fn peaks(&self, blur: f64) -> Vec<usize> {
        let reach = (KERNEL_REACH * blur).ceil() as usize;
        let kernel: Vec<f64> =
            (0..=reach).map(|k| (-0.5 * (k as f64 / blur).powi(2)).exp()).collect();
        let leaf = |at: usize| Some(self.pixels[at]).filter(|&pixels| pixels >= MIN_LEAF_PIXELS);
        let mut heights = vec![0.0; self.pixels.len()];
        for at in 0..heights.len() {
            let Some(pixels) = leaf(at) else { continue };
            let (from, to) = (at.saturating_sub(reach), (at + reach + 1).min(heights.len()));
            for (near, height) in heights[from..to].iter_mut().enumerate() {
                *height += pixels * kernel[(from + near).abs_diff(at)];
            }
        }
        let highest = heights.iter().copied().fold(0.0, f64::max);
        let with_leaf = heights.iter().copied().filter(|height| *height > BARE_SHARE * highest);
        let least = MIN_PEAK_HEIGHT * median(with_leaf).unwrap_or(0.0);
        (1..heights.len().saturating_sub(1))
            .filter(|&at| {
                let [before, here, after] = [heights[at - 1], heights[at], heights[at + 1]];
                here > before && here >= after && here > least
            })
            .collect()
    }

    /// The middle of the leaf across the row within some places.
    fn middle(&self, place: usize, near: usize) -> Option<f64> {
        let around = place.saturating_sub(near)..(place + near + 1).min(self.pixels.len());
        let pixels: f64 = self.pixels[around.clone()].iter().sum();
        (pixels > 0.0).then(|| self.across[around].iter().sum::<f64>() / pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        phenotype::{
            row_model::{self, RowModelOptions},
            rows::{self, Row},
            stand::Doubt,
        },
        problems::plants::lines::Axes,
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Two rows of plants with a leaf on either side of a stalk that is not seen, some with a small one between them; some places are
    /// without a plant. And where the stalks are.
    fn beans(seed: u64) -> (Mask, Vec<[f64; 2]>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (mut leaves, mut plants) = (Vec::new(), Vec::new());
        for row in 0..2 {
            for k in 0..40 {
                let mut jitter = |by: f64| by * (2.0 * rng.random::<f64>() - 1.0);
                let at = [50.0 + 48.0 * f64::from(k) + jitter(13.0), 90.0 + 220.0 * f64::from(row)];
                let (turn, size) = (jitter(0.2), 1.0 + jitter(0.3));
                if jitter(1.0) < -0.6 {
                    continue;
                }
                plants.push(at);
                let away = 11.0 * size;
                for side in [-away, away] {
                    let middle = [at[0] + side * turn.sin(), at[1] + side * turn.cos()];
                    leaves.push((middle, (7.0 + jitter(1.5)) * size));
                }
                if jitter(1.0) > 0.4 {
                    leaves.push((at, 2.5));
                }
            }
        }
        let mask = Mask::from_fn(2000, 400, |u, v| {
            leaves.iter().any(|(at, r)| (u as f64 - at[0]).hypot(v as f64 - at[1]) < *r)
        });
        (mask, plants)
    }

    #[test]
    fn several_leaves_are_one_plant() {
        let axes = Axes { origin_px: [0.0; 2], heading_rad: 0.0 };
        let row = |across_px| Row { across_px, start_px: 20.0, end_px: 1980.0, pixels: 1 };
        let rows = vec![row(90.0), row(310.0)];
        let rows = Rows { axes, rows, spacing_px: Some(220.0), contrast: 0.5 };
        for seed in 1..4 {
            let (mask, plants) = beans(seed);
            let n = plants.len() as f64;
            for count in [None, Some(plants.len())] {
                let found = locate(&mask, &rows, 55.0, 150.0, count).unwrap();
                let number = found.plants.len() as f64;
                assert!((number / n - 1.0).abs() < 0.1, "{seed}: {number} of {n}");
                let near = |plant: &&[f64; 2]| {
                    let off = |at: &Plant| (at.u_px - plant[0]).hypot(at.v_px - plant[1]);
                    found.plants.iter().any(|at| off(at) < 12.0)
                };
                let right = plants.iter().filter(near).count() as f64;
                assert!(right > 0.9 * n, "{seed}: {right} of {n}");
                let [low, high] = found.interval();
                assert!(low <= number && number <= high, "{seed}: {low} to {high}");
            }
            assert!(locate(&mask, &rows, 55.0, 150.0, Some(5000)).is_none());
        }
    }

    #[test]
    fn plants_nearer_than_they_are_wide_are_in_doubt() {
        let (mask, _) = beans(1);
        let detection = rows::detect(&mask);
        let sure = row_model::locate(&mask, &detection, None, &RowModelOptions::default()).unwrap();
        let mut stand = sure.clone();
        stand.spacing.spacing = 10.0;
        stand.doubt(None, None, 0);
        assert!(matches!(stand.doubts[..], [Doubt::Narrow { .. }]), "{:?}", stand.doubts);
        assert!(stand.plants[0].confidence < sure.plants[0].confidence);
        let width = |stand: &crate::phenotype::stand::Stand| {
            stand.count_interval[1] - stand.count_interval[0]
        };
        assert!(width(&stand) > 1.9 * width(&sure));
        let mut stand = sure;
        (stand.spacing.missing, stand.spacing.doubles) = (0.5, 0.1);
        stand.doubt(None, None, 0);
        assert_eq!(stand.doubts, [Doubt::Uneven { missing: 0.5, doubles: 0.1 }]);
    }

    #[test]
    fn what_is_larger_than_any_crop_is_in_doubt() {
        let (mask, _) = beans(1);
        let detection = rows::detect(&mask);
        let sure = row_model::locate(&mask, &detection, None, &RowModelOptions::default()).unwrap();
        let doubts_at = |gsd_m: f64| {
            let mut stand = sure.clone();
            stand.doubt(Some(gsd_m), None, 0);
            stand.doubts
        };
        assert_eq!(sure.doubts, []);
        assert_eq!(doubts_at(0.004), []);
        let [Doubt::Wide { spacing_m, .. }, Doubt::Large { plant_m2 }] = doubts_at(0.25)[..] else {
            panic!("{:?}", doubts_at(0.25));
        };
        let spacing_px = sure.spacing.spacing;
        assert!((spacing_m - 0.25 * spacing_px).abs() < 1e-9 && plant_m2 > 7.0);
        let apart_px = sure.rows.spacing_px.unwrap();
        let [Doubt::Wide { rows_m: Some(rows_m), .. }] = doubts_at(4.1 / apart_px)[..] else {
            panic!("{:?}", doubts_at(4.1 / apart_px));
        };
        assert!((rows_m - 4.1).abs() < 1e-9, "{rows_m}");
        assert!(matches!(doubts_at(0.04 / apart_px)[..], [Doubt::Tight { .. }]));
        assert!(matches!(doubts_at(0.009 / spacing_px)[..], [Doubt::Tight { .. }]));
        let mut stand = sure.clone();
        stand.rows.rows.clear();
        stand.doubt(None, None, 0);
        assert_eq!(stand.doubts, [Doubt::NoRows]);
        assert_eq!(stand.count_interval, sure.count_interval);
        assert!(stand.plants[0].confidence < sure.plants[0].confidence);
    }
}
