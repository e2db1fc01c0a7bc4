use super::{search::Deviation, *};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use rowgram_optim::nlls::{Euclidean, Problem, Residuals};

const DAYS: [f64; 7] = [8.0, 11.0, 14.0, 18.0, 22.0, 27.0, 34.0];

/// `plots` series with their true parameters (K, r, h).
fn season(
    model: GrowthModel,
    plots: usize,
    scatter: f64,
    seed: u64,
) -> Vec<([f64; 3], Vec<Sample>)> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = || -> f64 { rng.sample(StandardNormal) };
    (0..plots)
        .map(|_| {
            let truth =
                [0.6 * (0.1 * normal()).exp(), 0.35 * (0.1 * normal()).exp(), 19.0 + normal()];
            let parameters = [truth[0].ln(), truth[1].ln(), truth[2]];
            let sample =
                |day: f64| Sample { day, value: model.value(parameters, day) + scatter * normal() };
            (truth, DAYS.map(sample).to_vec())
        })
        .collect()
}

fn values(season: &[([f64; 3], Vec<Sample>)]) -> Vec<Vec<Sample>> {
    season.iter().map(|(_, samples)| samples.clone()).collect()
}

#[test]
fn both_forms_are_half_on_the_half_day_and_start_at_their_onset() {
    for model in [GrowthModel::Logistic, GrowthModel::Gompertz] {
        let parameters = [0.8f64.ln(), 0.3f64.ln(), 20.0];
        approx::assert_relative_eq!(model.value(parameters, 20.0), 0.4, epsilon = 1e-12);
        // The steepest place by differences; its tangent meets zero at the onset.
        let slope =
            |t: f64| (model.value(parameters, t + 1e-4) - model.value(parameters, t - 1e-4)) / 2e-4;
        let steepest =
            (0..4000).map(|k| f64::from(k) * 0.01).max_by(|a, b| slope(*a).total_cmp(&slope(*b)));
        let at = steepest.unwrap();
        let meets = at - model.value(parameters, at) / slope(at);
        approx::assert_abs_diff_eq!(meets, 20.0 - model.lag() / 0.3, epsilon = 0.01);
    }
}

#[test]
fn derivatives_are_those_of_dual_numbers() {
    let deviation = Deviation {
        model: GrowthModel::Gompertz,
        sample: Sample { day: 15.0, value: 0.2 },
        sigma: 0.01,
    };
    let mut problem = Problem::new();
    let block = problem.block("curve", Euclidean(3), &[-0.5, -1.0, 18.0]).unwrap();
    let residuals = Residuals::new([([block], deviation)]);
    assert!(residuals.check_derivatives(0, &[&[-0.5, -1.0, 18.0]]).unwrap() < 1e-6);
}

/// Of 400 intervals of 95 % each, 380 hold; the binomial standard deviation is 4.4, so three of them are 13.
#[test]
fn intervals_hold_as_often_as_they_say() {
    for model in [GrowthModel::Logistic, GrowthModel::Gompertz] {
        let season = season(model, 400, 0.015, 7);
        let fits = fit(&values(&season), Some(model));
        approx::assert_relative_eq!(fits.scatter.unwrap(), 0.015, max_relative = 0.08);
        let mut holds = [0; 3];
        for ((truth, _), curve) in season.iter().zip(&fits.curves) {
            let curve = curve.as_ref().unwrap();
            for (k, (of, truth)) in [curve.final_value, curve.rate_per_day, curve.half_day]
                .iter()
                .zip(truth)
                .enumerate()
            {
                holds[k] += usize::from((of.low..=of.high).contains(truth));
            }
        }
        assert!(holds.iter().all(|n| (363..=394).contains(n)), "{model}: {holds:?}");
    }
}

#[test]
fn the_form_is_that_of_the_data() {
    for model in [GrowthModel::Logistic, GrowthModel::Gompertz] {
        let season = season(model, 30, 0.01, 3);
        assert_eq!(fit(&values(&season), None).model, model);
    }
}

#[test]
fn a_wrong_value_is_named_and_does_not_count() {
    let season = season(GrowthModel::Logistic, 20, 0.01, 5);
    let mut samples = values(&season);
    samples[4][3].value += 0.3;
    let fits = fit(&samples, Some(GrowthModel::Logistic));
    let curve = fits.curves[4].as_ref().unwrap();
    assert_eq!(curve.outliers, [3]);
    let truth = season[4].0;
    assert!((curve.half_day.value - truth[2]).abs() < 4.0 * curve.half_day.sigma);
    let others = fits.curves.iter().enumerate().filter(|(k, _)| *k != 4);
    // One good series in a hundred may lose a value.
    assert!(others.filter(|(_, c)| !c.as_ref().unwrap().outliers.is_empty()).count() <= 1);
}

#[test]
fn what_cannot_be_told_is_said() {
    let series = |from: &[(f64, f64)]| -> Vec<Sample> {
        from.iter().map(|&(day, value)| Sample { day, value }).collect()
    };
    let told = |samples: Vec<Sample>| {
        let mut all = values(&season(GrowthModel::Logistic, 10, 0.01, 9));
        all.push(samples);
        fit(&all, Some(GrowthModel::Logistic)).curves.pop().unwrap()
    };
    assert_eq!(told(series(&[(8.0, 0.1), (12.0, 0.3), (20.0, 0.5)])), Err(Untold::TooFewDates));
    let flat = series(&[(8.0, 0.3), (12.0, 0.31), (18.0, 0.295), (26.0, 0.3), (30.0, 0.302)]);
    assert_eq!(told(flat), Err(Untold::NoGrowth));
    // Still exponential on the last date.
    let early: Vec<(f64, f64)> =
        [8.0, 10.0, 12.0, 14.0, 16.0].map(|t: f64| (t, 0.2 * (0.3 * (t - 18.0)).exp())).into();
    assert_eq!(told(series(&early)), Err(Untold::NotBracketed));
    assert_eq!(fit(&[], None).scatter, None);
    assert_eq!(told(Vec::new()), Err(Untold::TooFewDates));
}

#[test]
fn exact_values_give_their_parameters() {
    let season = season(GrowthModel::Logistic, 3, 0.0, 1);
    for ((truth, _), curve) in season.iter().zip(fit(&values(&season), None).curves) {
        let curve = curve.unwrap();
        approx::assert_relative_eq!(curve.final_value.value, truth[0], max_relative = 1e-6);
        approx::assert_abs_diff_eq!(curve.half_day.value, truth[2], epsilon = 1e-5);
        let [value, sigma] = curve.at(truth[2]);
        approx::assert_relative_eq!(value, 0.5 * truth[0], max_relative = 1e-5);
        assert!(sigma < 1e-6);
    }
}
