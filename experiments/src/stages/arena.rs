//! The same small problems for every solver: the engine's own and argmin's.
//!
//! Work is counted in evaluations of the residual; a Jacobian counts as many as it has columns, which is
//! what differences would cost. A solver has solved a problem at the first evaluation whose cost is
//! within a tolerance of the best known: what it does afterwards is not counted.

use super::{
    arena_problems::{CLASSICS, Classic},
    contestants::{self, Contestant, Dense, GaussNewtonHessian, Rows},
};
use crate::{
    keys,
    stage::{Measured, Metric, Stage, Trace, metric},
};
use argmin::core::{CostFunction, Error, Gradient, Hessian, Jacobian as Derivative, Operator};
use nalgebra::DMatrix;
use rowgram::nlls::{
    BlockId, Euclidean, Factor, Factors, Infeasible, Jacobian, LinearSolver, Loss, Method, Options,
    Problem, solve,
};
use serde::{Deserialize, Serialize};
use std::sync::{Arc, Mutex};

/// Who solves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Solver {
    LevenbergMarquardt,
    Dogleg,
    /// Levenberg-Marquardt with next to no damping to begin with.
    GaussNewton,
    /// argmin's Gauss-Newton method, without any damping.
    ArgminGaussNewton,
    Lbfgs,
    NonlinearCg,
    SteepestDescent,
    /// Trust region on the Gauss-Newton model.
    Steihaug,
    NelderMead,
}

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    /// The problem's name.
    problem: String,
    solver: Solver,
    /// The usual start is multiplied with this.
    start_factor: f64,
    /// Solved where the cost is above the best known by less than this share of it.
    relative_tolerance: f64,
    /// Or by less than this.
    absolute_tolerance: f64,
    max_iterations: u64,
    /// Whether the lowest cost so far is kept, by evaluations.
    trace: bool,
}

impl Default for Parameters {
    fn default() -> Parameters {
        Parameters {
            problem: CLASSICS[0].name.to_owned(),
            solver: Solver::LevenbergMarquardt,
            start_factor: 1.0,
            relative_tolerance: 1e-6,
            absolute_tolerance: 1e-10,
            max_iterations: 5000,
            trace: false,
        }
    }
}

/// The stage.
pub(crate) struct Arena;

impl Stage for Arena {
    type Parameters = Parameters;
    const NAME: &'static str = "arena";
    const ABOUT: &'static str = "small classical problems, the engine's solvers against argmin's";
    const METRICS: &'static [Metric] = &[
        metric("evaluations", "evaluations until solved; none where it was not solved"),
        metric("solved", "1 where it was solved"),
        metric("cost", "lowest cost seen"),
        metric("excess", "that above the best known"),
        metric("all_evaluations", "evaluations until the solver stopped"),
    ];

    fn check(p: &Parameters) -> Result<(), String> {
        classic(&p.problem)?;
        if !(p.start_factor.is_finite() && p.absolute_tolerance > 0.0) {
            return Err("start_factor has to be finite, absolute_tolerance positive".to_owned());
        }
        Ok(())
    }

    fn run(p: &Parameters, _seed: u64) -> Result<Measured, String> {
        let classic = classic(&p.problem)?;
        let target = classic.best + (p.relative_tolerance * classic.best).max(p.absolute_tolerance);
        let count = Arc::new(Mutex::new(Count::default()));
        let counted = Counted { classic, target, count, last: Arc::default() };
        // A start at 0 stays there whatever the factor; 1 is what More et al. take then.
        let zero = p.start_factor != 1.0 && classic.start.iter().all(|&value| value == 0.0);
        let start: Vec<f64> = classic
            .start
            .iter()
            .map(|value| if zero { p.start_factor } else { p.start_factor * value })
            .collect();
        let ended = race(p, &counted, start);
        let count = counted.count.lock().map_err(|_| "a solver failed".to_owned())?.clone();
        // Solvers that give up with an error have come as far as they have.
        if let (Err(error), true) = (ended, count.evaluations == 0.0) {
            return Err(error);
        }
        let mut measured = Measured::default();
        measured.put_some("evaluations", count.solved_at);
        measured.put("solved", f64::from(count.solved_at.is_some()));
        measured.put("cost", count.lowest);
        measured.put("excess", count.lowest - classic.best);
        measured.put("all_evaluations", count.evaluations);
        if p.trace {
            let mut trace = Trace::new("descent", &["evaluations", "excess"]);
            trace.rows = count.log;
            measured.traces.push(trace);
        }
        Ok(measured)
    }
}

fn classic(name: &str) -> Result<&'static Classic, String> {
    CLASSICS
        .iter()
        .find(|classic| classic.name == name)
        .ok_or_else(|| keys::unknown("problem", name, CLASSICS.iter().map(|c| c.name)))
}

/// What was evaluated so far.
#[derive(Debug, Clone)]
struct Count {
    evaluations: f64,
    lowest: f64,
    solved_at: Option<f64>,
    log: Vec<Vec<f64>>,
}

impl Default for Count {
    fn default() -> Count {
        Count { evaluations: 0.0, lowest: f64::INFINITY, solved_at: None, log: Vec::new() }
    }
}

/// A problem that counts.
#[derive(Clone)]
struct Counted {
    classic: &'static Classic,
    target: f64,
    count: Arc<Mutex<Count>>,
    /// Where the last Jacobian was asked for, residuals and Jacobian.
    last: Arc<Mutex<Option<Linearized>>>,
}

type Linearized = (Vec<f64>, Vec<f64>, Vec<f64>);

impl Counted {
    fn evaluate(&self, x: &[f64], r: &mut [f64], jacobian: Option<&mut [f64]>) {
        let price = 1.0 + if jacobian.is_some() { x.len() as f64 } else { 0.0 };
        (self.classic.evaluate)(x, r, jacobian);
        let cost = 0.5 * r.iter().map(|value| value * value).sum::<f64>();
        let Ok(mut count) = self.count.lock() else { return };
        count.evaluations += price;
        if cost < count.lowest {
            count.lowest = cost;
            let entry = vec![count.evaluations, (cost - self.classic.best).max(1e-18)];
            count.log.push(entry);
            if cost <= self.target && count.solved_at.is_none() {
                count.solved_at = Some(count.evaluations);
            }
        }
    }
}

impl Counted {
    /// Residuals and Jacobian; asking twice at the same place costs once.
    fn linearized(&self, x: &[f64]) -> Result<(Vec<f64>, Vec<f64>), Error> {
        let poisoned = |_| Error::msg("another thread failed");
        if let Some((at, r, j)) = &*self.last.lock().map_err(poisoned)?
            && at == x
        {
            return Ok((r.clone(), j.clone()));
        }
        let rows = self.classic.rows;
        let (mut r, mut j) = (vec![0.0; rows], vec![0.0; rows * x.len()]);
        self.evaluate(x, &mut r, Some(&mut j));
        let poisoned = |_| Error::msg("another thread failed");
        *self.last.lock().map_err(poisoned)? = Some((x.to_vec(), r.clone(), j.clone()));
        Ok((r, j))
    }
}

impl CostFunction for Counted {
    type Param = Vec<f64>;
    type Output = f64;

    fn cost(&self, x: &Vec<f64>) -> Result<f64, Error> {
        let mut r = vec![0.0; self.classic.rows];
        self.evaluate(x, &mut r, None);
        Ok(0.5 * r.iter().map(|value| value * value).sum::<f64>())
    }
}

impl Gradient for Counted {
    type Param = Vec<f64>;
    type Gradient = Vec<f64>;

    fn gradient(&self, x: &Vec<f64>) -> Result<Vec<f64>, Error> {
        let (rows, n) = (self.classic.rows, x.len());
        let (r, j) = self.linearized(x)?;
        Ok((0..n).map(|k| (0..rows).map(|i| j[i * n + k] * r[i]).sum()).collect())
    }
}

impl Hessian for Counted {
    type Param = Vec<f64>;
    type Hessian = GaussNewtonHessian;

    fn hessian(&self, x: &Vec<f64>) -> Result<GaussNewtonHessian, Error> {
        let mut rows = Rows::default();
        for row in self.linearized(x)?.1.chunks(x.len()) {
            row.iter().enumerate().for_each(|(column, &value)| rows.put(column, value));
            rows.end();
        }
        Ok(rows.into())
    }
}

impl Operator for Counted {
    type Param = Vec<f64>;
    type Output = Vec<f64>;

    fn apply(&self, x: &Vec<f64>) -> Result<Vec<f64>, Error> {
        let mut r = vec![0.0; self.classic.rows];
        self.evaluate(x, &mut r, None);
        Ok(r)
    }
}

impl Derivative for Counted {
    type Param = Vec<f64>;
    type Jacobian = Dense;

    fn jacobian(&self, x: &Vec<f64>) -> Result<Dense, Error> {
        let entries = self.linearized(x)?.1;
        Ok(Dense(DMatrix::from_row_slice(self.classic.rows, x.len(), &entries)))
    }
}

/// The whole problem as one factor of one block.
struct Whole {
    blocks: [BlockId; 1],
    counted: Counted,
}

impl Factor for Whole {
    fn rows(&self) -> usize {
        self.counted.classic.rows
    }

    fn blocks(&self) -> &[BlockId] {
        &self.blocks
    }

    fn linearize(
        &self,
        x: &[&[f64]],
        residual: &mut [f64],
        jacobian: Option<&mut Jacobian<'_>>,
    ) -> Result<(), Infeasible> {
        let n = x[0].len();
        match jacobian {
            None => self.counted.evaluate(x[0], residual, None),
            Some(jacobian) => {
                let mut entries = vec![0.0; residual.len() * n];
                self.counted.evaluate(x[0], residual, Some(&mut entries));
                for (row, entries) in entries.chunks(n).enumerate() {
                    jacobian.row(row).copy_from_slice(entries);
                }
            }
        }
        if residual.iter().all(|value| value.is_finite()) { Ok(()) } else { Err(Infeasible) }
    }
}

fn race(p: &Parameters, counted: &Counted, start: Vec<f64>) -> Result<(), String> {
    let own = |method, initial_damping| {
        let mut problem = Problem::new();
        let space = Euclidean(start.len());
        let block = problem.block("x", space, &start).map_err(|e| e.to_string())?;
        let factor = Whole { blocks: [block], counted: counted.clone() };
        problem.add("r", Loss::Trivial, Factors(vec![factor])).map_err(|e| e.to_string())?;
        let options = Options {
            method,
            linear: LinearSolver::Dense,
            initial_damping,
            cost_tolerance: 1e-14,
            gradient_tolerance: 1e-15,
            step_tolerance: 1e-15,
            ..Options::default()
        };
        let mut x = problem.start();
        solve(&problem, &mut x, &options, p.max_iterations).map(drop).map_err(|e| e.to_string())
    };
    let problem = counted.clone();
    let most = p.max_iterations;
    let contestant = match p.solver {
        Solver::LevenbergMarquardt => return own(Method::LevenbergMarquardt, 1e-3),
        Solver::GaussNewton => return own(Method::LevenbergMarquardt, 1e-12),
        Solver::Dogleg => return own(Method::Dogleg, 1e-3),
        Solver::ArgminGaussNewton => return contestants::gauss_newton(problem, start, most),
        Solver::NelderMead => return contestants::nelder_mead(problem, &start, most),
        Solver::Lbfgs => Contestant::Lbfgs,
        Solver::NonlinearCg => Contestant::NonlinearCg,
        Solver::SteepestDescent => Contestant::SteepestDescent,
        Solver::Steihaug => Contestant::Steihaug,
    };
    // Conjugate gradients inside a step may make twice as many products as there are parameters.
    let products = 2 * start.len() as u64;
    contestants::race(contestant, problem, start, most, products)
}
