//! Problems of the project for every solver: the engine's, argmin's, and exact ones where they apply.
//!
//! The seed draws the instance. Work is counted in evaluations of all residuals, with derivatives or
//! without: a trial of the engine makes two, one to linearise and one to see what the cost is. Products
//! with a Jacobian inside a step are not counted; seconds are. A solver has solved an instance at the first
//! evaluation whose cost is within a share of the best known. That is the lowest that the engine reaches
//! from the start and from other places, such as the truth, or that an exact solver gives; `excess` is below 0
//! where a contestant has found a lower one.
//!
//! A solver that does not apply has `applies` = 0 and no more: Nelder and Mead on a thousand parameters,
//! cones on what is no cone programme.

use super::{
    bundle::descend,
    contestants::{self, Contestant},
    flat_problem::{FlatProblem, Limits},
    instances::{Family, Instance, Ranges},
};
use crate::stage::{Measured, Metric, Stage, Trace, metric};
use rowgram::{
    convex,
    nlls::{LinearSolver, Method, Options},
    problems::plants::inner_median,
};
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, sync::Mutex, time::Instant};

/// Who solves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Solver {
    /// The engine; points or poses are eliminated first, one block alone is solved dense.
    LevenbergMarquardt,
    /// The same with the whole system, dense.
    LevenbergMarquardtDense,
    /// The same with the whole system, sparse.
    LevenbergMarquardtSparse,
    /// The same with conjugate gradients on what elimination leaves.
    LevenbergMarquardtIterative,
    Dogleg,
    /// Levenberg-Marquardt with next to no damping to begin with.
    GaussNewton,
    /// argmin's Gauss-Newton method, without any damping.
    ArgminGaussNewton,
    /// argmin's trust region on the Gauss-Newton model.
    Steihaug,
    Lbfgs,
    NonlinearCg,
    SteepestDescent,
    NelderMead,
    /// The interior-point method on the cone programme.
    Clarabel,
    /// The plant locator's own: Newton steps, Weiszfeld's where they fail.
    NewtonWeiszfeld,
}

impl Solver {
    /// Whether it takes one plant only and does not say what it evaluates.
    fn is_exact(self) -> bool {
        matches!(self, Solver::Clarabel | Solver::NewtonWeiszfeld)
    }

    #[cfg(test)]
    const ALL: [Solver; 14] = [
        Solver::LevenbergMarquardt,
        Solver::LevenbergMarquardtDense,
        Solver::LevenbergMarquardtSparse,
        Solver::LevenbergMarquardtIterative,
        Solver::Dogleg,
        Solver::GaussNewton,
        Solver::ArgminGaussNewton,
        Solver::Steihaug,
        Solver::Lbfgs,
        Solver::NonlinearCg,
        Solver::SteepestDescent,
        Solver::NelderMead,
        Solver::Clarabel,
        Solver::NewtonWeiszfeld,
    ];
}

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    family: Family,
    solver: Solver,
    ranges: Ranges,
    /// Evaluations after which a solver has to be done.
    max_evaluations: u64,
    /// The same for Steihaug's steps and the trials of the engine, which cost more.
    max_steps: u64,
    /// Products with the Hessian that Steihaug's conjugate gradients make for a step, at most.
    max_products: u64,
    /// Seconds are the least of so many repetitions where one takes less than a tenth of a second.
    repetitions: u64,
    /// Whether the lowest cost so far is kept, by evaluations.
    trace: bool,
}

impl Default for Parameters {
    fn default() -> Parameters {
        Parameters {
            family: Family::Bundle,
            solver: Solver::LevenbergMarquardt,
            ranges: Ranges::default(),
            max_evaluations: 1000,
            max_steps: 200,
            max_products: 300,
            repetitions: 5,
            trace: false,
        }
    }
}

/// Parameters at most for a method that keeps a simplex.
const SIMPLEX: usize = 20;
/// The same for one that inverts a dense matrix.
const DENSE: usize = 600;
/// A contestant stops within this share of the best known cost.
const ENOUGH: f64 = 1e-9;
/// The shares at which an instance counts as solved, each with its metrics.
const SHARES: [(f64, &str, &str, &str); 2] = [
    (1e-3, "solved_1e3", "evaluations_1e3", "to_1e3"),
    (1e-6, "solved_1e6", "evaluations_1e6", "to_1e6"),
];

/// The stage.
pub(crate) struct Solvers;

impl Stage for Solvers {
    type Parameters = Parameters;
    const NAME: &'static str = "solvers";
    const ABOUT: &'static str = "problems of the project, every solver on the same instances";
    const METRICS: &'static [Metric] = &[
        metric("applies", "1 where the solver applies, otherwise 0 and no more"),
        metric("counted", "1 where it also says what it evaluates, otherwise 0"),
        metric("solved_1e3", "1 where the cost came within a thousandth of the best known"),
        metric("solved_1e6", "1 where it came within a millionth"),
        metric("evaluations_1e3", "evaluations until within a thousandth; none where it was not"),
        metric("evaluations_1e6", "evaluations until within a millionth; none where it was not"),
        metric("evaluations", "evaluations until the solver or the limit stopped it"),
        metric("excess", "lowest cost over the best known, less 1"),
        metric("start_ratio", "cost of the start over the best known"),
        metric("parameters", "numbers that move"),
        metric("residuals", "residuals"),
    ];

    fn check(p: &Parameters) -> Result<(), String> {
        p.ranges.check()?;
        for (name, value) in [
            ("max_evaluations", p.max_evaluations),
            ("max_steps", p.max_steps),
            ("max_products", p.max_products),
            ("repetitions", p.repetitions),
        ] {
            if value == 0 {
                return Err(format!("{name} has to be at least 1"));
            }
        }
        Ok(())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let instance = Instance::draw(p.family, &p.ranges, seed)?;
        let mut measured = Measured::default();
        let applies = applies(p.solver, &instance);
        measured.put("applies", f64::from(applies));
        measured.put("counted", f64::from(applies && !p.solver.is_exact()));
        if !applies {
            return Ok(measured);
        }
        let best = remembered(p, &instance, seed)?;
        let laps = timed(p, &instance, best)?;
        let lowest = laps.iter().fold(f64::INFINITY, |low, lap| low.min(lap.cost));
        for (share, solved, evaluations, seconds) in SHARES {
            let first = laps.iter().find(|lap| lap.cost <= best * (1.0 + share));
            measured.put(solved, f64::from(first.is_some()));
            measured.put_some(evaluations, first.and_then(|lap| lap.evaluations));
            if let Some(lap) = first {
                measured.seconds.insert(seconds.to_owned(), lap.seconds);
            }
        }
        measured.put_some("evaluations", laps.last().and_then(|lap| lap.evaluations));
        measured.put("excess", lowest / best - 1.0);
        measured.put("start_ratio", laps.first().map_or(f64::NAN, |lap| lap.cost / best));
        measured.put("parameters", instance.parameters() as f64);
        measured.put("residuals", instance.problem().residual_count() as f64);
        if p.trace {
            let mut trace = Trace::new("descent", &["evaluations", "excess"]);
            let known = laps.iter().filter_map(|lap| Some((lap.evaluations?, lap.cost)));
            // What is below the last share is not told apart.
            trace.rows.extend(known.map(|(n, cost)| vec![n, (cost / best - 1.0).max(ENOUGH)]));
            measured.traces.push(trace);
        }
        Ok(measured)
    }
}

/// Where a solver was.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Lap {
    /// None where a solver does not say what it evaluates.
    evaluations: Option<f64>,
    cost: f64,
    seconds: f64,
}

fn applies(solver: Solver, instance: &Instance) -> bool {
    let parameters = instance.parameters();
    match solver {
        Solver::LevenbergMarquardtDense => instance.eliminates && parameters <= DENSE,
        Solver::LevenbergMarquardtSparse | Solver::LevenbergMarquardtIterative => {
            instance.eliminates
        }
        Solver::ArgminGaussNewton => !instance.free_frame && parameters <= DENSE,
        Solver::NelderMead => parameters <= SIMPLEX,
        _ => instance.plant.is_some() || !solver.is_exact(),
    }
}

/// Options of the engine that leave it to the race to end.
fn options(method: Method, linear: LinearSolver) -> Options {
    Options {
        method,
        linear,
        cost_tolerance: 1e-15,
        gradient_tolerance: 1e-15,
        step_tolerance: 1e-15,
        ..Options::default()
    }
}

/// Next to no damping to begin with.
fn undamped(options: Options) -> Options {
    Options { initial_damping: 1e-12, ..options }
}

/// The way to a step that suits an instance.
fn usual(instance: &Instance) -> LinearSolver {
    if instance.eliminates { LinearSolver::Auto } else { LinearSolver::Dense }
}

/// The best cost, sought once for all contestants of an instance.
fn remembered(p: &Parameters, instance: &Instance, seed: u64) -> Result<f64, String> {
    static KNOWN: Mutex<BTreeMap<String, f64>> = Mutex::new(BTreeMap::new());
    let key = format!("{:?} {:?} {seed}", p.family, p.ranges);
    let known = || KNOWN.lock().map_err(|_| "another thread failed".to_owned());
    if let Some(&best) = known()?.get(&key) {
        return Ok(best);
    }
    let best = best_known(instance)?;
    known()?.insert(key, best);
    Ok(best)
}

/// The lowest cost from every place to begin with, by three ways to a step, and of the exact solvers.
fn best_known(instance: &Instance) -> Result<f64, String> {
    const TRIALS: u64 = 500;
    let problem = instance.problem();
    let mut best = f64::INFINITY;
    let mut starts = vec![problem.start()];
    starts.extend(instance.hints.iter().cloned());
    for start in starts {
        let [marquardt, dogleg] = [Method::LevenbergMarquardt, Method::Dogleg]
            .map(|method| options(method, usual(instance)));
        for options in [undamped(marquardt.clone()), marquardt, dogleg] {
            let mut x = start.clone();
            // From some places there is no way on; the others decide then.
            if let Ok((cost, _)) = descend(problem, &mut x, &options, TRIALS, |_, _, _| ()) {
                best = best.min(cost);
            }
        }
    }
    for solver in [Solver::Clarabel, Solver::NewtonWeiszfeld] {
        if applies(solver, instance) {
            best = best.min(instance.cost(&exact(solver, instance)?)?);
        }
    }
    if best.is_finite() && best > 0.0 { Ok(best) } else { Err("no best cost is known".to_owned()) }
}

/// The minimiser by a solver for one plant only.
fn exact(solver: Solver, instance: &Instance) -> Result<[f64; 2], String> {
    let plant = instance.plant.as_ref().ok_or("the solver takes one plant")?;
    let (u, v) = (&plant.u_px, &plant.v_px);
    if solver == Solver::NewtonWeiszfeld {
        return Ok(inner_median(u, v, plant.weight, &plant.prior));
    }
    convex::plant(u, v, plant.weight, plant.prior.hessian, plant.prior.pull)
        .map(|found| found.offset_px)
        .map_err(|e| e.to_string())
}

/// A race, and where it is short the least seconds of several.
fn timed(p: &Parameters, instance: &Instance, best: f64) -> Result<Vec<Lap>, String> {
    const SHORT: f64 = 0.1;
    let clock = Instant::now();
    let mut laps = race(p, instance, best)?;
    if clock.elapsed().as_secs_f64() < SHORT {
        for _ in 1..p.repetitions {
            for (lap, again) in laps.iter_mut().zip(race(p, instance, best)?) {
                lap.seconds = lap.seconds.min(again.seconds);
            }
        }
    }
    Ok(laps)
}

/// Every lap of a solver, its costs falling; the last says how much it evaluated.
fn race(p: &Parameters, instance: &Instance, best: f64) -> Result<Vec<Lap>, String> {
    let own = |method, linear| engine(p, instance, best, &options(method, linear));
    let usual = usual(instance);
    let from = |who| {
        let most = if who == Contestant::Steihaug { p.max_steps } else { p.max_evaluations };
        flat(p, instance, best, |problem| {
            let products = p.max_products.min(2 * instance.parameters() as u64);
            contestants::race(who, problem.clone(), problem.origin(), most, products)
        })
    };
    let marquardt = Method::LevenbergMarquardt;
    match p.solver {
        Solver::LevenbergMarquardt => own(marquardt, usual),
        Solver::LevenbergMarquardtDense => own(marquardt, LinearSolver::Dense),
        Solver::LevenbergMarquardtSparse => own(marquardt, LinearSolver::Sparse),
        Solver::LevenbergMarquardtIterative => own(marquardt, LinearSolver::IterativeSchur),
        Solver::Dogleg => own(Method::Dogleg, usual),
        Solver::GaussNewton => engine(p, instance, best, &undamped(options(marquardt, usual))),
        Solver::ArgminGaussNewton => flat(p, instance, best, |problem| {
            contestants::gauss_newton(problem.clone(), problem.origin(), p.max_evaluations)
        }),
        Solver::NelderMead => flat(p, instance, best, |problem| {
            contestants::nelder_mead(problem.clone(), &problem.origin(), p.max_evaluations)
        }),
        Solver::Steihaug => from(Contestant::Steihaug),
        Solver::Lbfgs => from(Contestant::Lbfgs),
        Solver::NonlinearCg => from(Contestant::NonlinearCg),
        Solver::SteepestDescent => from(Contestant::SteepestDescent),
        Solver::Clarabel | Solver::NewtonWeiszfeld => {
            let start = instance.cost(&instance.problem().start())?;
            let clock = Instant::now();
            let found = exact(p.solver, instance)?;
            let seconds = clock.elapsed().as_secs_f64();
            let cost = instance.cost(&found)?;
            Ok([(start, 0.0), (cost, seconds)]
                .map(|(cost, seconds)| Lap { evaluations: None, cost, seconds })
                .to_vec())
        }
    }
}

/// A race of the engine.
fn engine(
    p: &Parameters,
    instance: &Instance,
    best: f64,
    options: &Options,
) -> Result<Vec<Lap>, String> {
    let clock = Instant::now();
    let mut laps = Vec::new();
    let mut x = instance.problem().start();
    let observe = |trial: u64, cost: f64, _products: f64| {
        let evaluations = Some(1.0 + 2.0 * trial as f64);
        laps.push(Lap { evaluations, cost, seconds: clock.elapsed().as_secs_f64() });
    };
    let trials = p.max_steps.min(p.max_evaluations / 2);
    let ended = descend(instance.problem(), &mut x, options, trials, observe);
    // Who gives up has come as far as it has.
    if let (Err(error), true) = (ended, laps.is_empty()) {
        return Err(error);
    }
    // Where the others are stopped, too.
    let [low, high] = enough(best);
    if let Some(end) = laps.iter().position(|lap| (low..=high).contains(&lap.cost)) {
        laps.truncate(end + 1);
    }
    Ok(laps)
}

fn enough(best: f64) -> [f64; 2] {
    [best * (1.0 - ENOUGH), best * (1.0 + ENOUGH)]
}

/// A race of a solver that sees a plain vector.
fn flat(
    p: &Parameters,
    instance: &Instance,
    best: f64,
    solve: impl FnOnce(&FlatProblem) -> Result<(), String>,
) -> Result<Vec<Lap>, String> {
    let limits = Limits { passes: p.max_evaluations as f64, enough: enough(best) };
    let problem = FlatProblem::new(instance.charted.clone(), limits)?;
    let ended = solve(&problem);
    let noted = problem.noted.lock().map_err(|_| "a solver failed".to_owned())?;
    let mut laps: Vec<Lap> = noted
        .log
        .iter()
        .map(|&[passes, cost, seconds]| Lap { evaluations: Some(passes), cost, seconds })
        .collect();
    match (laps.last().copied(), ended) {
        (None, Err(error)) => Err(error),
        (None, Ok(())) => Err("the solver evaluated nothing".to_owned()),
        (Some(last), _) => {
            laps.push(Lap { evaluations: Some(noted.passes), ..last });
            Ok(laps)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::instances::tests::small;

    const FAMILIES: [Family; 4] =
        [Family::Bundle, Family::Calibration, Family::Plant, Family::Leaf];

    fn parameters(family: Family, solver: Solver) -> Parameters {
        let (max_evaluations, max_steps) = (60, 20);
        Parameters {
            family,
            solver,
            ranges: small(),
            max_evaluations,
            max_steps,
            repetitions: 1,
            ..Parameters::default()
        }
    }

    #[test]
    fn every_contestant_starts_at_the_same_cost() {
        for family in FAMILIES {
            let instance = Instance::draw(family, &small(), 5).unwrap();
            let start = instance.cost(&instance.problem().start()).unwrap();
            let mut raced = 0;
            for solver in Solver::ALL.into_iter().filter(|&solver| applies(solver, &instance)) {
                let laps = race(&parameters(family, solver), &instance, 0.0).unwrap();
                let off = laps[0].cost / start - 1.0;
                assert!(off.abs() < 1e-9, "{family:?} {solver:?}: {} {start}", laps[0].cost);
                raced += 1;
            }
            assert!(raced >= 9, "{family:?}: {raced}");
        }
    }

    #[test]
    fn the_cone_programme_and_the_own_minimiser_agree() {
        for seed in 1..13 {
            let instance = Instance::draw(Family::Plant, &Ranges::default(), seed).unwrap();
            let [cone, own] = [Solver::Clarabel, Solver::NewtonWeiszfeld]
                .map(|solver| instance.cost(&exact(solver, &instance).unwrap()).unwrap());
            assert!((cone / own - 1.0).abs() < 1e-6, "seed {seed}: {cone} {own}");
        }
    }

    #[test]
    fn what_does_not_apply_says_so_and_measures_nothing() {
        let found = Solvers::run(&parameters(Family::Bundle, Solver::Clarabel), 1).unwrap();
        let neither = ["applies", "counted"].map(|name| (name.to_owned(), 0.0));
        assert_eq!(found.values, BTreeMap::from(neither));
        let found = Solvers::run(&parameters(Family::Plant, Solver::Clarabel), 1).unwrap();
        assert_eq!((found.values["applies"], found.values["solved_1e6"]), (1.0, 1.0));
    }

    #[test]
    fn the_engine_solves_each_family() {
        for family in FAMILIES {
            let mut p = parameters(family, Solver::LevenbergMarquardt);
            (p.max_evaluations, p.max_steps) = (400, 200);
            let solved = (1..5)
                .filter(|&seed| Solvers::run(&p, seed).unwrap().values["solved_1e3"] == 1.0)
                .count();
            assert!(solved >= 2, "{family:?}: {solved} of 4");
        }
    }
}
