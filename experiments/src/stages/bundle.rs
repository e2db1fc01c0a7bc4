//! Bundle adjustment of a synthetic aerial block: start error, losses, gross errors, solvers.
//!
//! Work is counted in passes over all measurements, with derivatives or without. A trial of the engine
//! makes two: one to linearise and eliminate, one to move the points and see what the cost is there.

use super::{
    contestants::{self, Contestant},
    flat_problem::{Chart, Charted, FlatProblem, Limits, Weighing},
};
use crate::stage::{Measured, Metric, Stage, Trace, metric};
use data_synth::block::{Block, BlockConfig, ForwardCamera};
use rowgram::{
    engine::{Engine, Termination},
    nlls::{LeastSquares, Loss, Options, Problem},
    problems::bundle::{Bundle, Camera, InteriorSharing, Network, Observation, TIE_POINTS},
};
use serde::{Deserialize, Serialize};
use std::{sync::Arc, time::Instant};

/// Who adjusts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Solver {
    /// The engine with its options.
    Engine,
    /// Solvers of argmin on all parameters as one vector, scaled by the curvatures at the start.
    Lbfgs,
    NonlinearCg,
    SteepestDescent,
    Steihaug,
}

impl Solver {
    fn contestant(self) -> Option<Contestant> {
        match self {
            Solver::Engine => None,
            Solver::Lbfgs => Some(Contestant::Lbfgs),
            Solver::NonlinearCg => Some(Contestant::NonlinearCg),
            Solver::SteepestDescent => Some(Contestant::SteepestDescent),
            Solver::Steihaug => Some(Contestant::Steihaug),
        }
    }
}

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    block: BlockConfig,
    /// All start errors are multiplied with this.
    start_scale: f64,
    /// `trivial`, `huber:1.0`, `cauchy:1.0`, ...
    loss: String,
    interior: InteriorSharing,
    solver: Solver,
    options: Options,
    max_iterations: u64,
    /// Whether the cost of every iteration is kept.
    trace: bool,
}

impl Default for Parameters {
    fn default() -> Parameters {
        let block = BlockConfig { images: 12, points: 400, ..BlockConfig::default() };
        Parameters {
            block,
            start_scale: 1.0,
            loss: Loss::Trivial.to_string(),
            interior: InteriorSharing::PerImage,
            solver: Solver::Engine,
            options: Options::default(),
            max_iterations: 100,
            trace: false,
        }
    }
}

/// Solved at this multiple of the cost reached from the truth.
const SOLVED: f64 = 1.001;
/// The seconds until then, generating the block and finding that cost not among them.
const TO_SOLVE: &str = "to_solve";

/// The stage.
pub(crate) struct BundleBlock;

impl Stage for BundleBlock {
    type Parameters = Parameters;
    const NAME: &'static str = "bundle";
    const ABOUT: &'static str = "bundle adjustment of a synthetic aerial block";
    const METRICS: &'static [Metric] = &[
        metric(
            "error_px",
            "root mean square distance of adjusted from true, error-free image points",
        ),
        metric("rms_px", "root mean square residual of the good measurements"),
        metric("cost_ratio", "final cost over that reached from the truth"),
        metric("solved", "1 where that is below 1.001"),
        metric("iterations", "trials made by the engine"),
        metric("iterations_to_solve", "trials of the engine until the cost was below 1.001 of it"),
        metric("passes", "passes over all measurements until then, whoever solves"),
        metric("products", "products with the reduced system that an iterative engine made"),
        metric("cost", "final cost"),
    ];
    const SEEDED: &'static [&'static str] = &["block.seed"];

    fn check(p: &Parameters) -> Result<(), String> {
        config(p, 1).check().map_err(|e| e.to_string())?;
        p.loss.parse::<Loss>()?;
        if !(p.start_scale >= 0.0 && p.start_scale.is_finite()) {
            return Err("start_scale has to be 0 or more".to_owned());
        }
        let plain = p.loss == Loss::Trivial.to_string() && p.interior == InteriorSharing::PerImage;
        if p.solver != Solver::Engine && !plain {
            return Err("argmin's solvers take no loss and a lens for each image".to_owned());
        }
        Ok(())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let block = Block::fly(&config(p, seed)).map_err(|e| e.to_string())?;
        let loss: Loss = p.loss.parse()?;
        let pose =
            |network: &Network| Bundle::new(network, p.interior, loss).map_err(|e| e.to_string());
        let truth = pose(&network(&block, &block.cameras_true, &block.points_true))?;
        let mut x = truth.problem.start();
        let (best, _) = descend(&truth.problem, &mut x, &Options::default(), 200, |_, _, _| ())?;
        let mut adjusted = network(&block, &block.cameras_start, &block.points_start);
        let bundle = pose(&adjusted)?;
        let mut measured = Measured::default();
        let mut trace = Trace::new("iterations", &["iteration", "passes", "cost_excess"]);
        let cost =
            match p.solver.contestant() {
                None => adjust(p, &bundle, best, &mut adjusted, &mut measured, &mut trace)?,
                Some(who) => {
                    let problem = pose(&adjusted)?.problem;
                    let charted = charted(problem, adjusted.cameras.len(), loss);
                    let flat = FlatProblem::new(Arc::new(charted), Limits::NONE)?;
                    let (start, most) = (flat.origin(), p.max_iterations);
                    let products = 2 * start.len() as u64;
                    let ended = contestants::race(who, flat.clone(), start, most, products);
                    let noted = flat.noted.lock().map_err(|_| "a solver failed".to_owned())?;
                    // Solvers that give up with an error have come as far as they have.
                    if let (Err(error), true) = (ended, noted.passes == 0.0) {
                        return Err(error);
                    }
                    let solved = noted.log.iter().find(|[_, cost, _]| *cost <= SOLVED * best);
                    measured.put_some("passes", solved.map(|[passes, _, _]| *passes));
                    if let Some([_, _, seconds]) = solved {
                        measured.seconds.insert(TO_SOLVE.to_owned(), *seconds);
                    }
                    let rows = noted.log.iter().enumerate();
                    trace.rows.extend(rows.map(|(k, [passes, cost, _])| {
                        vec![k as f64, *passes, (cost - best) / best]
                    }));
                    bundle.update(&noted.best, &mut adjusted);
                    noted.lowest
                }
            };
        let (error_px, rms_px) = errors(&block, &adjusted);
        measured.put("error_px", error_px);
        measured.put("rms_px", rms_px);
        measured.put("cost_ratio", cost / best);
        measured.put("solved", f64::from(cost <= SOLVED * best));
        measured.put("cost", cost);
        if p.trace {
            measured.traces.push(trace);
        }
        Ok(measured)
    }
}

fn config(p: &Parameters, seed: u64) -> BlockConfig {
    let mut block = BlockConfig { seed, ..p.block.clone() };
    block.start.rotation_deg *= p.start_scale;
    block.start.centre_m *= p.start_scale;
    block.start.point_m *= p.start_scale;
    block
}

/// The block as one vector: cameras with their lenses first, then the points.
pub(super) fn charted(problem: Problem, cameras: usize, loss: Loss) -> Charted {
    let points = problem.block_count() - cameras;
    let charts = [vec![Chart::Pose(3); cameras], vec![Chart::Plain(3); points]].concat();
    Charted { problem, charts, batches: vec![(TIE_POINTS, Weighing::Robust(loss))] }
}

/// The network of a block from these cameras and points.
pub(super) fn network(block: &Block, cameras: &[[f64; 9]], points: &[[f64; 3]]) -> Network {
    let observations = block.observations.iter().map(|o| Observation {
        camera: o.camera as u32,
        point: o.point as u32,
        image_px: o.measured_px,
    });
    Network {
        cameras: cameras.iter().map(camera).collect(),
        points: points.to_vec(),
        observations: observations.collect(),
    }
}

fn camera(values: &[f64; 9]) -> Camera {
    let [a, b, c, x, y, z, f, k1, k2] = *values;
    Camera { rotation_rad: [a, b, c], translation: [x, y, z], interior: [f, k1, k2] }
}

/// Adjusts with the engine; the final cost.
fn adjust(
    p: &Parameters,
    bundle: &Bundle,
    best: f64,
    adjusted: &mut Network,
    measured: &mut Measured,
    trace: &mut Trace,
) -> Result<f64, String> {
    let mut x = bundle.problem.start();
    let clock = Instant::now();
    let (mut solved_at, mut products) = (None, 0.0);
    let observe = |trial: u64, cost: f64, more: f64| {
        let (passes, excess) = (1.0 + 2.0 * trial as f64, (cost - best) / best);
        products += more;
        trace.rows.push(vec![trial as f64, passes, excess]);
        if cost <= SOLVED * best && solved_at.is_none() {
            solved_at = Some((trial as f64, passes, clock.elapsed().as_secs_f64()));
        }
    };
    let (cost, trials) = descend(&bundle.problem, &mut x, &p.options, p.max_iterations, observe)?;
    bundle.update(&x, adjusted);
    measured.put("iterations", trials as f64);
    measured.put("products", products);
    measured.put_some("iterations_to_solve", solved_at.map(|(trials, _, _)| trials));
    measured.put_some("passes", solved_at.map(|(_, passes, _)| passes));
    if let Some((_, _, seconds)) = solved_at {
        measured.seconds.insert(TO_SOLVE.to_owned(), seconds);
    }
    Ok(cost)
}

/// Runs the engine and shows every trial, its cost and its products with the reduced system; the last cost and the
/// number of trials.
pub(crate) fn descend(
    problem: &Problem,
    x: &mut Vec<f64>,
    options: &Options,
    max_iterations: u64,
    mut observe: impl FnMut(u64, f64, f64),
) -> Result<(f64, u64), String> {
    let mut engine = LeastSquares::new(options.clone());
    let mut cost = engine.start(problem, x).map_err(|e| e.to_string())?;
    observe(0, cost, 0.0);
    for iteration in 1..=max_iterations {
        let step = engine.step(problem, x).map_err(|e| e.to_string())?;
        cost = step.cost;
        let products = step.metrics.iter().find(|(name, _)| *name == "linear_products");
        observe(iteration, cost, products.map_or(0.0, |(_, count)| *count));
        if step.stop.is_some_and(|stop| stop != Termination::MaxIterations) {
            return Ok((cost, iteration));
        }
    }
    Ok((cost, max_iterations))
}

/// Root mean squares of what the good measurements leave: against the truth, and against themselves.
/// Image points do not depend on the frame, which is free.
fn errors(block: &Block, adjusted: &Network) -> (f64, f64) {
    let found: Vec<ForwardCamera> = adjusted
        .cameras
        .iter()
        .map(|c| {
            let ([a, b, d], [x, y, z], [f, k1, k2]) = (c.rotation_rad, c.translation, c.interior);
            ForwardCamera::new(&[a, b, d, x, y, z, f, k1, k2])
        })
        .collect();
    let truth: Vec<ForwardCamera> = block.cameras_true.iter().map(ForwardCamera::new).collect();
    let (mut squares, mut count) = ([0.0; 2], 0.0);
    for o in block.observations.iter().filter(|o| !o.outlier) {
        let ours = found[o.camera].project(adjusted.points[o.point]);
        let exact = truth[o.camera].project(block.points_true[o.point]);
        let (Some(ours), Some(exact)) = (ours, exact) else {
            // Behind the camera: as wrong as the picture is wide.
            squares = squares.map(|s| s + block.cameras_true[0][6].powi(2));
            count += 1.0;
            continue;
        };
        for (sum, against) in squares.iter_mut().zip([exact, o.measured_px]) {
            *sum += (ours[0] - against[0]).powi(2) + (ours[1] - against[1]).powi(2);
        }
        count += 1.0;
    }
    ((squares[0] / count).sqrt(), (squares[1] / count).sqrt())
}
