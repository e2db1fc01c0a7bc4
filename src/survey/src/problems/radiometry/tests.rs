//! Blocks whose gains, vignetting and light are known.

use super::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// A flight of strips to and fro, all photos 1 high and 4/3 wide on the ground at unit height.
struct Flight {
    strips: usize,
    along: usize,
    seed: u64,
    /// Log of the light from the first photo to the last.
    drift: f64,
    /// Standard deviation of the noise of a window.
    noise: f64,
    /// Share of the observations that are of something else.
    wrong: f64,
    reported: bool,
    direction: [f64; DIRECTION],
}

const FLIGHT: Flight = Flight {
    strips: 4,
    along: 10,
    seed: 1,
    drift: 0.0,
    noise: 0.02,
    wrong: 0.0,
    reported: false,
    direction: [0.1, -0.15, 0.03, 0.02],
};
const RADIAL_TRUTH: [f64; RADIAL] = [-0.35, 0.05, -0.03];

/// A block and the true log gains, with the mean that the adjustment gives them.
fn block(flight: &Flight) -> (RadiometricBlock, Vec<[f64; 3]>) {
    let mut rng = ChaCha8Rng::seed_from_u64(flight.seed);
    let normal = |sigma: f64, rng: &mut ChaCha8Rng| sigma * rng.sample::<f64, _>(StandardNormal);
    let count = flight.strips * flight.along;
    let mut photos = Vec::new();
    let (mut gains, mut centres) = (Vec::new(), Vec::new());
    for n in 0..count {
        let (strip, step) = (n / flight.along, n % flight.along);
        let step = if strip % 2 == 0 { step } else { flight.along - 1 - step };
        centres.push([step as f64 * 0.25, strip as f64 * 0.45]);
        let light = flight.drift * n as f64 / count as f64;
        let exposure = 0.23 * normal(1.0, &mut rng).round();
        let own = light + exposure + normal(0.04, &mut rng);
        gains.push([own + normal(0.02, &mut rng), own, own + normal(0.02, &mut rng)]);
        let place = centres[n];
        photos.push(Photo {
            camera: 0,
            place,
            log_exposure: flight.reported.then_some(exposure + 3.0),
        });
    }
    let mut observations = Vec::new();
    let mut seen_by = vec![0.0; count];
    let mut points = 0;
    for _ in 0..1500 {
        let mut between = |low: f64, high: f64| low + (high - low) * rng.random::<f64>();
        let at = [
            between(-0.6, flight.along as f64 * 0.25 + 0.4),
            between(-0.5, flight.strips as f64 * 0.45 + 0.1),
        ];
        let level = normal(0.4, &mut rng);
        let light = [level - 1.5, level - 1.2 + normal(0.2, &mut rng), level - 2.0];
        let mut of = Vec::new();
        for (photo, centre) in centres.iter().enumerate() {
            let s = [at[0] - centre[0], at[1] - centre[1]];
            if s[0].abs() > 0.66 || s[1].abs() > 0.5 {
                continue;
            }
            let radius2 = (s[0] * s[0] + s[1] * s[1]) / (0.66 * 0.66 + 0.25);
            let terms = |terms: &[f64], values: &[f64]| {
                terms.iter().zip(values).map(|(a, b)| a * b).sum::<f64>()
            };
            let shape = terms(&radial_terms(radius2), &RADIAL_TRUTH)
                + terms(&direction_terms(s), &flight.direction);
            let common = normal(flight.noise, &mut rng);
            let wrong = if rng.random::<f64>() < flight.wrong { 0.7 } else { 0.0 };
            let log_light = std::array::from_fn(|c| {
                light[c] + gains[photo][c] + shape + common + wrong + normal(0.005, &mut rng)
            });
            of.push(Observation {
                point: points,
                photo: photo as u32,
                log_light,
                radius2,
                direction: s,
            });
        }
        if of.len() >= 2 {
            points += 1;
            of.iter().for_each(|seen| seen_by[seen.photo as usize] += 1.0);
            observations.extend(of);
        }
    }
    let total: f64 = seen_by.iter().sum();
    for c in 0..3 {
        let mean = gains.iter().zip(&seen_by).map(|(g, n)| g[c] * n).sum::<f64>() / total;
        gains.iter_mut().for_each(|g| g[c] -= mean);
    }
    (RadiometricBlock { photos, cameras: 1, points: points as usize, observations }, gains)
}

/// Root mean square of the errors of gains beside those of the photo before, of errors, and of errors over their standard deviations.
fn errors(solution: &RadiometricSolution, truth: &[[f64; 3]]) -> [f64; 3] {
    let off = |k: usize, c: usize| solution.log_gains[k].value[c] - truth[k][c];
    let rms = |of: &dyn Fn(usize, usize) -> f64| {
        let all = (1..truth.len()).flat_map(|k| [0, 1, 2].map(|c| of(k, c).powi(2)));
        (all.sum::<f64>() / (3 * (truth.len() - 1)) as f64).sqrt()
    };
    [
        rms(&|k, c| off(k, c) - off(k - 1, c)),
        rms(&off),
        rms(&|k, c| off(k, c) / solution.log_gains[k].sigma[c]),
    ]
}

#[test]
fn gains_vignetting_and_light_are_found_with_true_standard_deviations() {
    let (mut scaled, mut shapes) = (Vec::new(), Vec::new());
    for seed in 1..=6 {
        let (block, truth) = block(&Flight { seed, drift: 0.06, reported: true, ..FLIGHT });
        let solution = block.adjust().unwrap();
        let [step, plain, over_sigma] = errors(&solution, &truth);
        println!(
            "seed {seed}: gains {plain:.4} off, {step:.4} from photo to photo, {over_sigma:.2} standard deviations"
        );
        // Where strips change, what is drift and what is direction cannot be told.
        assert!(step < 0.025, "seed {seed}: {step} from photo to photo");
        assert!((solution.sigma[0] / 0.02 - 1.0).abs() < 0.15, "{:?}", solution.sigma);
        scaled.push(over_sigma);
        let (lens, light) = (&solution.vignetting[0], &solution.direction[0]);
        for k in 0..RADIAL {
            shapes.push((lens.value[k] - RADIAL_TRUTH[k]) / lens.sigma[k]);
        }
        for k in 0..DIRECTION {
            shapes.push((light.value[k] - FLIGHT.direction[k]) / light.sigma[k]);
        }
        // The light that is left in the corners.
        let corner = lens.value.iter().sum::<f64>() - RADIAL_TRUTH.iter().sum::<f64>();
        assert!(corner.abs() < 0.02, "seed {seed}: {corner}");
    }
    let rms = |of: &[f64]| (of.iter().map(|v| v * v).sum::<f64>() / of.len() as f64).sqrt();
    println!("gains {scaled:?}, shapes {shapes:?}");
    // Errors of the gains of one block have a part in common, so six blocks say it to about a third.
    assert!((0.5..1.6).contains(&rms(&scaled)), "gains: {scaled:?}");
    assert!((0.5..1.6).contains(&rms(&shapes)), "vignetting and light: {shapes:?}");
}

#[test]
fn windows_of_something_else_do_not_move_the_gains() {
    let (clean, truth) = block(&FLIGHT);
    let (dirty, dirty_truth) = block(&Flight { wrong: 0.08, ..FLIGHT });
    let [clean, ..] = errors(&clean.adjust().unwrap(), &truth);
    let solution = dirty.adjust().unwrap();
    let [dirty, ..] = errors(&solution, &dirty_truth);
    println!("from photo to photo: {clean} without, {dirty} with");
    assert!(dirty < 1.5 * clean && clean < 0.03, "{dirty} {clean}");
    assert!(solution.downweighted > 0.08, "{}", solution.downweighted);
}

#[test]
fn without_anything_to_balance_nothing_changes() {
    let (mut block, _) = block(&Flight { noise: 0.0, ..FLIGHT });
    // Each point has one colour in all photos.
    let mut colours = std::collections::BTreeMap::new();
    for seen in &mut block.observations {
        seen.log_light = *colours.entry(seen.point).or_insert(seen.log_light);
    }
    let solution = block.adjust().unwrap();
    for found in &solution.log_gains {
        assert!(found.value.iter().all(|g| g.abs() < 1e-6), "{found:?}");
    }
    assert!(solution.vignetting[0].value.iter().all(|k| k.abs() < 1e-6));
}

#[test]
fn a_photo_without_overlap_has_a_gain_from_its_neighbours_and_none_is_an_error() {
    let (mut block, truth) = block(&Flight { drift: 0.3, reported: true, ..FLIGHT });
    block.observations.retain(|seen| seen.photo != 17);
    let solution = block.adjust().unwrap();
    let off = solution.log_gains[17].value[1] - truth[17][1];
    let sigma = solution.log_gains[17].sigma[1];
    assert!(off.abs() < 4.0 * sigma && sigma < 0.15, "{off} {sigma}");
    assert!(sigma > 1.5 * solution.log_gains[16].sigma[1]);
    block.observations.clear();
    assert!(block.adjust().is_err());
}
