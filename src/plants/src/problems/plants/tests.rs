//! The locator against its definition: brute force, the joint objective, the cone programme.

use super::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram_optim::{
    descent::{CoordinateDescentOptions, Descent, Order, run},
    engine::{Engine, Termination},
};

const AXES: Axes = Axes { origin_px: [80.0, 50.0], heading_rad: 0.1 };
const ROWS: [f64; 3] = [-30.0, 0.0, 30.0];

/// Until nothing moves any more, however little the cost gains.
fn exact() -> CoordinateDescentOptions {
    CoordinateDescentOptions { cost_tolerance: 0.0, ..CoordinateDescentOptions::default() }
}

/// Stars of leaves in three rows; their centres.
fn field(seed: u64) -> (PixelIndex, Vec<[f64; 2]>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (mut pixels, mut centres) = (Vec::new(), Vec::new());
    for across in ROWS {
        for k in 0..8 {
            let along = f64::from(k) * 16.0 - 56.0 + 3.0 * rng.random::<f64>();
            let centre = AXES.image([along, across + rng.random::<f64>() - 0.5]);
            centres.push(centre);
            for _ in 0..6 {
                let (angle, length) =
                    (std::f64::consts::TAU * rng.random::<f64>(), 5.0 + 9.0 * rng.random::<f64>());
                for step in 0..30 {
                    let r = length * f64::from(step) / 30.0;
                    let at = [centre[0] + r * f64::cos(angle), centre[1] + r * f64::sin(angle)];
                    pixels.push([at[0].round() as u32, at[1].round() as u32]);
                    pixels.push([at[0].round() as u32 + 1, at[1].round() as u32]);
                }
            }
        }
    }
    pixels.sort_unstable();
    pixels.dedup();
    (PixelIndex::new(&pixels), centres)
}

fn models() -> Vec<Model> {
    let mut models = Vec::new();
    for prior in [Prior::None, Prior::Rows, Prior::Grid] {
        for update in [PlantUpdate::Mean, PlantUpdate::Median] {
            for sigma in [SigmaRule::Paper, SigmaRule::Planar, SigmaRule::Fixed(5.0)] {
                for form in [Form::Joint, Form::Conditional] {
                    let settle_px = 5e-3;
                    models.push(Model {
                        prior,
                        update,
                        sigma,
                        form,
                        settle_px,
                        ..Model::default()
                    });
                }
            }
        }
    }
    for (tempering, truncate_px) in [(Some(6.0), None), (None, Some(9.0)), (Some(6.0), Some(9.0))] {
        for update in [PlantUpdate::Mean, PlantUpdate::Median] {
            let settle_px = 5e-3;
            models.push(Model { update, tempering, truncate_px, settle_px, ..Model::default() });
        }
    }
    models
}

fn problem(model: Model, seed: u64) -> (Plants, Field) {
    let (index, _) = field(seed);
    let start = start::kmeans_plus_plus(&index, 24, &mut ChaCha8Rng::seed_from_u64(seed));
    let problem = Plants::new(index, 24, model, AXES).unwrap();
    let columns: Vec<f64> = (0..8).map(|k| f64::from(k) * 16.0 - 56.0).collect();
    let x = problem.field(start, &ROWS, &columns).unwrap();
    (problem, x)
}

/// Takes steps one by one and looks at the objective after each.
fn check_decrease<D: LeafDensity>(problem: &Plants<LinePrior, D>, mut x: Field) {
    let mut active = ActiveSet::new(24, true);
    let mut cost = problem.cost(&x);
    let mut check = |x: &Field, what: &str| {
        let (next, model) = (problem.cost(x), problem.model);
        // The assignment compares distances rounded to single precision.
        assert!(next <= cost + 1e-9 * cost.abs(), "{model:?}, {what}: {cost} -> {next}");
        cost = next;
    };
    for _ in 0..8 {
        for plant in 0..24 {
            problem.update(&mut x, plant, &mut active);
            check(&x, "plant");
        }
        problem.prior.reassign(&mut x.latent, &x.positions_px);
        check(&x, "members");
        problem.prior.refit_lines(&mut x.latent);
        check(&x, "lines");
        problem.prior.refit_variances(&mut x.latent);
        check(&x, "variances");
        problem.refit_sigma(&mut x);
        check(&x, "sigma");
    }
}

/// Any density, with the provided methods alone.
#[derive(Debug, Clone)]
struct Own(fn(f64) -> f64, fn(f64) -> f64);

impl LeafDensity for Own {
    fn cost(&self, ratio2: f64) -> f64 {
        self.0(ratio2)
    }
    fn slope(&self, ratio2: f64) -> f64 {
        self.1(ratio2)
    }
}

#[test]
fn every_step_of_the_joint_form_decreases_its_objective() {
    let student = Own(|ratio2| 2.0 * (0.5 * ratio2).ln_1p(), |ratio2| 1.0 / (1.0 + 0.5 * ratio2));
    for model in models().into_iter().filter(|model| model.form == Form::Joint) {
        let (problem, x) = problem(model, 1);
        check_decrease(&problem, x.clone());
        let own = problem.with_density(student.clone());
        let x = own.field_with(x.positions_px, x.latent).unwrap();
        check_decrease(&own, x);
    }
}

#[test]
fn the_provided_methods_find_the_closed_form_of_squares() {
    let gaussian = Own(|ratio2| 0.5 * ratio2, |_| 0.5);
    let squares = models().into_iter().filter(|model| model.update == PlantUpdate::Mean);
    for model in squares {
        let (problem, mut exact) = problem(model, 5);
        let own = problem.clone().with_density(gaussian.clone());
        let mut x = own.field_with(exact.positions_px.clone(), exact.latent.clone()).unwrap();
        let options = CoordinateDescentOptions::default();
        run(&problem, &mut exact, options, 20, |_, _| ()).unwrap();
        run(&own, &mut x, options, 20, |_, _| ()).unwrap();
        approx::assert_relative_eq!(x.sigma_px, exact.sigma_px, max_relative = 1e-6);
        for (a, b) in x.positions_px.iter().zip(&exact.positions_px) {
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-4, "{model:?}: {a:?} {b:?}");
        }
    }
}

/// The same problem with every pixel compared with every plant after every move.
struct BruteForce(Plants);

impl BlockCost for BruteForce {
    type Iterate = Field;
    fn len(&self) -> usize {
        self.0.len()
    }
    fn prepare(&self, x: &mut Field) -> Result<(), SolveError> {
        self.0.prepare(x)
    }
    fn cost(&self, x: &Field) -> f64 {
        let distance = |n: usize| {
            let [u, v] = self.0.index.position(n);
            let all = x.positions_px.iter().map(|p| (p[0] - u).hypot(p[1] - v));
            all.fold(self.0.model.truncate_px.unwrap_or(f64::INFINITY), f64::min)
        };
        (0..self.0.index.len()).map(distance).sum()
    }
    /// Its cost is the sum of the distances alone.
    fn monotone(&self) -> bool {
        false
    }
    fn update(&self, x: &mut Field, plant: usize, active: &mut ActiveSet) -> f64 {
        let (index, at) = (&self.0.index, x.positions_px[plant]);
        let before = assignment::brute_force(index, &x.positions_px);
        let mine = (0..index.len()).filter(|&n| before[n].near as usize == plant);
        let offset = |n: usize| (index.position(n)[0] - at[0], index.position(n)[1] - at[1]);
        let farthest = self.0.model.truncate_px.unwrap_or(f64::INFINITY);
        let near = |(du, dv): &(f64, f64)| du * du + dv * dv <= farthest * farthest;
        (x.work.u, x.work.v) = mine.map(offset).filter(near).unzip();
        let offset = self.0.solve(x, plant);
        let step_norm = offset[0].hypot(offset[1]);
        if step_norm > RELAXED_PX {
            active.mark(plant);
        }
        let after = assignment::brute_force(index, &x.positions_px);
        for (old, new) in before.iter().zip(&after).filter(|(old, new)| old.near != new.near) {
            active.mark(old.near as usize);
            active.mark(new.near as usize);
        }
        step_norm
    }
    fn end_sweep(&self, x: &mut Field, active: &mut ActiveSet) {
        x.work.assignment = self.0.assign(&x.positions_px);
        self.0.end_sweep(x, active);
    }
}

#[test]
fn fast_updates_equal_brute_force_bit_for_bit() {
    for model in models().into_iter().filter(|model| model.sigma != SigmaRule::Planar) {
        let (problem, mut fast) = problem(model, 2);
        let mut slow = fast.clone();
        let options = CoordinateDescentOptions { order: Order::Shuffled, ..exact() };
        let outcome = run(&problem, &mut fast, options, 12, |_, _| ()).unwrap();
        let reference =
            run(&BruteForce(problem.clone()), &mut slow, options, 12, |_, _| ()).unwrap();
        assert_eq!(fast.positions_px, slow.positions_px, "{model:?}");
        assert_eq!(outcome.iterations, reference.iterations);
        assert_eq!(fast.sigma_px.to_bits(), slow.sigma_px.to_bits());
        let mean = reference.final_cost / problem.index().len() as f64;
        approx::assert_relative_eq!(mean, problem.mean_distance_px(&fast), epsilon = 1e-9);
    }
}

#[test]
fn converged_plants_are_certified_by_the_cone_programme() {
    for model in models().into_iter().filter(|model| model.update == PlantUpdate::Median) {
        let (problem, mut x) = problem(model, 3);
        let outcome = run(&problem, &mut x, exact(), 200, |_, _| ()).unwrap();
        assert_eq!(outcome.stop, Termination::StepConverged, "{model:?}");
        for plant in 0..24 {
            problem.gather(&mut x, plant);
            if x.work.u.is_empty() {
                continue;
            }
            // Solve once more for the present sigma and lines, then compare.
            let (prior, weight) = (problem.prior_of(&x, plant), problem.weight(&x));
            let offset = inner_median(&x.work.u, &x.work.v, weight, &prior);
            let moved = offset[0].hypot(offset[1]);
            assert!(moved < 0.1, "{model:?}: plant {plant} was {moved} px from its optimum");
            let certificate = problem.certify(&mut x, plant).unwrap();
            let error =
                (certificate.offset_px[0] - offset[0]).hypot(certificate.offset_px[1] - offset[1]);
            assert!(error < 1e-4, "{model:?}: plant {plant}: {error:e}");
            assert!(certificate.gap() < 1e-8 * (1.0 + certificate.primal.abs()));
        }
    }
}

#[test]
fn a_resumed_descent_equals_an_unbroken_one_bit_for_bit() {
    for model in models() {
        let (problem, mut whole) = problem(model, 4);
        let options = CoordinateDescentOptions { order: Order::Shuffled, seed: 3, ..exact() };
        let mut engine = Descent::new(options);
        engine.start(&problem, &mut whole).unwrap();
        let mut saved = String::new();
        for sweep in 0..6 {
            if sweep == 2 {
                saved = serde_json::to_string(&(&whole, Engine::<Plants>::state(&engine))).unwrap();
            }
            engine.step(&problem, &mut whole).unwrap();
        }
        let (mut x, memory): (Field, _) = serde_json::from_str(&saved).unwrap();
        let mut second = Descent::new(options);
        second.resume(&problem, &mut x, memory).unwrap();
        let mut last = None;
        for _ in 2..6 {
            last = Some(second.step(&problem, &mut x).unwrap());
        }
        assert_eq!(last.unwrap().cost.to_bits(), problem.cost(&whole).to_bits());
        assert_eq!(serde_json::to_string(&x).unwrap(), serde_json::to_string(&whole).unwrap());
    }
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let model = Model::default();
    let of = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let (problem, mut x) = problem(model, 5);
            run(&problem, &mut x, CoordinateDescentOptions::default(), 20, |_, _| ()).unwrap();
            serde_json::to_string(&x).unwrap()
        })
    };
    assert_eq!(of(1), of(3));
}

#[test]
fn plants_started_near_the_truth_of_separate_plants_stay_there() {
    let (index, centres) = field(6);
    let shifted = centres.iter().map(|c| [c[0] + 1.5, c[1] - 1.0]).collect();
    let problem = Plants::new(index, 24, Model::default(), AXES).unwrap();
    let mut x = problem.field(shifted, &ROWS, &[]).unwrap();
    run(&problem, &mut x, CoordinateDescentOptions::default(), 100, |_, _| ()).unwrap();
    for (plant, centre) in x.positions_px.iter().zip(&centres) {
        assert!((plant[0] - centre[0]).hypot(plant[1] - centre[1]) < 4.0, "{plant:?} {centre:?}");
    }
}

#[test]
fn degenerate_fields_are_solved_or_refused_but_never_panic() {
    let square: Vec<[u32; 2]> = (0..36).map(|k| [k % 6, k / 6]).collect();
    let column: Vec<[u32; 2]> = (0..36).map(|k| [5, k]).collect();
    for pixels in [vec![[3, 4]], square, column] {
        let index = PixelIndex::new(&pixels);
        for model in models() {
            for count in [1, 2, pixels.len()] {
                let Ok(problem) = Plants::new(index.clone(), count, model, AXES) else {
                    assert!(count > pixels.len());
                    continue;
                };
                let start = start::random(&index, count, &mut ChaCha8Rng::seed_from_u64(0));
                let mut x = problem.field(start, &[-2.0, 40.0], &[0.0]).unwrap();
                let outcome =
                    run(&problem, &mut x, CoordinateDescentOptions::default(), 50, |_, _| ())
                        .unwrap();
                assert!(outcome.final_cost.is_finite(), "{model:?}");
            }
        }
    }
    let index = PixelIndex::new(&[[1, 1], [2, 1]]);
    let new = |count, model| Plants::new(index.clone(), count, model, AXES);
    assert!(matches!(new(0, Model::default()), Err(SolveError::Misuse(_))));
    assert!(matches!(new(3, Model::default()), Err(SolveError::Misuse(_))));
    assert!(Plants::new(PixelIndex::new(&[]), 1, Model::default(), AXES).is_err());
    assert!(new(1, Model { relaxation: 2.0, ..Model::default() }).is_err());
    assert!(new(1, Model { tempering: Some(0.0), ..Model::default() }).is_err());
    assert!(new(1, Model { truncate_px: Some(-1.0), ..Model::default() }).is_err());
    assert!(new(1, Model { floor_px: f64::NAN, ..Model::default() }).is_err());
    let problem = new(1, Model::default()).unwrap();
    assert!(problem.field(vec![[f64::NAN, 0.0]], &ROWS, &[]).is_err());
    assert!(problem.field(vec![[0.0; 2]; 2], &ROWS, &[]).is_err());
    assert!(problem.field(vec![[0.0; 2]], &[], &[]).is_err());
    // Far away from everything is not degenerate.
    assert!(problem.field(vec![[1e8, -1e8]], &ROWS, &[]).is_ok());
}

#[test]
fn a_settled_field_is_certified_and_a_shifted_one_is_not() {
    let model = Model { relaxation: 1.0, ..Model::default() };
    let (problem, mut x) = problem(model, 4);
    run(
        &problem,
        &mut x,
        CoordinateDescentOptions { movement_tolerance: 1e-6, ..exact() },
        500,
        |_, _| (),
    )
    .unwrap();
    let proof = problem.prove(&mut x).unwrap();
    assert!(proof.plants > 20 && proof.worst_gap < 0.01, "{proof}");
    let worst = proof.worst_gap;
    x.positions_px[3][0] += 4.0;
    problem.prepare(&mut x).unwrap();
    let proof = problem.prove(&mut x).unwrap();
    assert!(proof.worst_gap > worst && proof.worst_offset_px > 1.0, "{proof}");
}

#[test]
fn the_inner_solver_matches_the_cone_programme() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for case in 0..40 {
        let count = [1, 3, 20, 150][case % 4];
        let mut draw = || f64::from(rng.random_range(-12..=12));
        let (u, v): (Vec<f64>, Vec<f64>) = (0..count).map(|_| (draw(), draw())).unzip();
        let mut prior = Quadratic::default();
        if case % 3 > 0 {
            prior.add([0.2, 0.98], draw() / 4.0, 2.5);
        }
        if case % 3 > 1 {
            prior.add([0.98, -0.2], draw() / 4.0, 6.0);
        }
        let weight = 0.15;
        let certificate =
            rowgram_optim::convex::plant(&u, &v, weight, prior.hessian, prior.pull).unwrap();
        let x = inner_median(&u, &v, weight, &prior);
        let [uu, uv, vv] = prior.hessian;
        let value = weight * u.iter().zip(&v).map(|(u, v)| (u - x[0]).hypot(v - x[1])).sum::<f64>()
            + 0.5 * (uu * x[0] * x[0] + 2.0 * uv * x[0] * x[1] + vv * x[1] * x[1])
            - prior.pull[0] * x[0]
            - prior.pull[1] * x[1];
        let scale = 1.0 + value.abs();
        assert!(certificate.gap() <= 1e-8 * scale, "case {case}: {certificate:?}");
        assert!(
            (value - certificate.primal).abs() <= 1e-8 * scale,
            "case {case}: {value} {certificate:?}"
        );
        if count >= 20 {
            // The minimiser itself is less sharp than the minimum: its error is the square root.
            let error = (x[0] - certificate.offset_px[0]).hypot(x[1] - certificate.offset_px[1]);
            assert!(error <= 1e-5, "case {case}: {error:e}");
        }
    }
}
