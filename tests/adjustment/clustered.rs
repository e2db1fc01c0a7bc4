//! Standard deviations where errors of neighbouring measurements are alike.

use super::toy::{NOISE, Plan, TIE_PX, free, measured, truth, with_positions};
use crate::nlls::toys::normal;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rowgram::{
    camera::Lens,
    problems::adjustment::{Settings, adjust},
    scene::Reconstruction,
};
use std::collections::HashMap;

const RUNS: u64 = 30;
const NAMES: [&str; 2] = ["xp_px", "K1"];
/// Side of the patches on the ground that err together, metres; the images are 50 m above.
const SIDE_M: f64 = 3.0;

/// Root mean square errors of the two parameters in their standard deviations: those of independent measurements,
/// and those given; and what these are of those on average.
fn errors(truth: &Reconstruction, spoil: impl Fn(&mut Reconstruction, u64)) -> [[f64; 3]; 2] {
    let values = truth.cameras[0].interior.values();
    let mut sums = [[0.0; 3]; 2];
    for run in 0..RUNS {
        let mut survey = measured(truth, 500 + run, NOISE);
        spoil(&mut survey, run);
        free(&mut survey, &NAMES);
        let adjusted = adjust(&mut survey, &Settings::default()).unwrap();
        let (sigma0, interior) = (adjusted.statistics.sigma0, &adjusted.statistics.interiors[0]);
        for (k, place) in [1, 4].into_iter().enumerate() {
            let error = (interior.values[k] - values[place]) / sigma0;
            let (independent, given) = (interior.independent[k], interior.standard_deviations[k]);
            assert!(given >= independent);
            sums[k][0] += (error / independent).powi(2);
            sums[k][1] += (error / given).powi(2);
            sums[k][2] += given / independent;
        }
    }
    let mean = 1.0 / RUNS as f64;
    sums.map(|[a, b, c]| [(a * mean).sqrt(), (b * mean).sqrt(), c * mean])
}

fn block() -> Reconstruction {
    with_positions(truth(&Plan { tie_points: 3000, ..Plan::default() }))
}

#[test]
fn independent_measurements_keep_their_standard_deviations() {
    for [independent, given, ratio] in errors(&block(), |_, _| ()) {
        assert!((0.7..1.3).contains(&independent) && (0.7..1.3).contains(&given));
        assert!((1.0..1.1).contains(&ratio), "{ratio}");
    }
}

#[test]
fn where_patches_err_together_standard_deviations_say_so() {
    let truth = block();
    let spoil = |survey: &mut Reconstruction, run: u64| {
        let mut rng = ChaCha8Rng::seed_from_u64(9000 + run);
        let mut shifts: HashMap<(u32, [i64; 2]), [f64; 2]> = HashMap::new();
        for o in &mut survey.observations {
            let at = truth.points[o.point as usize].position_m;
            let patch = [0, 1].map(|k| (at[k] / SIDE_M).floor() as i64);
            let shift = *shifts
                .entry((o.image, patch))
                .or_insert_with(|| [0, 1].map(|_| TIE_PX * normal(&mut rng)));
            o.image_px = [0, 1].map(|k| o.image_px[k] + shift[k]);
        }
    };
    let [xp, radial] = errors(&truth, spoil);
    // Errors are 1.73 and 1.13 times what independent measurements would have. A hundred patches and eighty
    // parameters leave residuals smaller than errors are: not all of it is found.
    assert!(xp[0] > 1.5 && xp[1] < xp[0] - 0.25, "{xp:?}");
    for [_, given, ratio] in [xp, radial] {
        assert!((0.7..1.5).contains(&given) && ratio > 1.15, "{given} {ratio}");
    }
}
