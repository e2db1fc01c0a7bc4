//! Engine two: block coordinate descent.
//!
//! `x_p <- argmin_{x_p} J(x_0, ..., x_p, ..., x_{P-1})` for one block `p` after the other; one
//! *sweep* visits every block that can still move, then lets the problem refit what all blocks
//! share (an assignment, a scale, latent lines). One [`Engine::step`] is one sweep.
//!
//! - The order of sweep `k` is a pure function of `(seed, k)`, so nothing of it has to be kept.
//! - A block is visited only while *active*: at the start, and whenever an update or the end of a
//!   sweep says that its optimum may have moved ([`ActiveSet::mark`]).
//! - It ends as converged when no block is active, or none moved by more than the tolerance and the end of the
//!   sweep active no other, or, where one joint objective exists, when a sweep decreases it by less
//!   than the relative tolerance. A problem without a joint objective (the paper's conditionals) is
//!   judged by movement alone.
//! - A sweep that raises a joint objective beyond rounding ends it as stalled: an update is not the minimiser that it should be.
//!
//! Reference: S. J. Wright, "Coordinate descent algorithms", Mathematical Programming 151 (2015).

use crate::engine::{self, Engine, RunOutcome, SolveError, Step, Termination};
use rand::{SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// The set of blocks whose optimum may have moved.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ActiveSet {
    flags: Vec<bool>,
}

impl ActiveSet {
    /// A set over `len` blocks, all of them active or none.
    pub fn new(len: usize, all: bool) -> ActiveSet {
        ActiveSet { flags: vec![all; len] }
    }

    /// Notes that `block` has to be visited (again). A block that is not there is ignored.
    pub fn mark(&mut self, block: usize) {
        if let Some(flag) = self.flags.get_mut(block) {
            *flag = true;
        }
    }

    /// Whether `block` has to be visited.
    pub fn contains(&self, block: usize) -> bool {
        self.flags.get(block).copied().unwrap_or(false)
    }

    /// How many blocks have to be visited.
    pub fn count(&self) -> usize {
        self.flags.iter().filter(|&&flag| flag).count()
    }

    /// Takes a block out of those that can still move; whether it was among them.
    pub fn take(&mut self, block: usize) -> bool {
        self.flags.get_mut(block).is_some_and(std::mem::take)
    }

    fn blocks(&self) -> Vec<u32> {
        (0u32..).zip(&self.flags).filter(|(_, flag)| **flag).map(|(block, _)| block).collect()
    }
}

/// A problem whose variables come in blocks, each of which can be optimised with the rest held.
pub trait BlockCost {
    /// All variables. What can be recomputed from the rest need not be serialised.
    type Iterate: Clone + Send + Serialize + DeserializeOwned;

    /// Number of blocks.
    fn len(&self) -> usize;

    /// Whether there is nothing to optimise.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Checks the iterate and rebuilds whatever of it is not serialised.
    ///
    /// # Errors
    /// Where the iterate does not belong to the problem or cannot be evaluated.
    fn prepare(&self, x: &mut Self::Iterate) -> Result<(), SolveError>;

    /// The objective; where [`BlockCost::monotone`] is false, only a number for the trace.
    fn cost(&self, x: &Self::Iterate) -> f64;

    /// Whether every update decreases [`BlockCost::cost`] (or leaves it).
    fn monotone(&self) -> bool;

    /// Moves one block to its optimum, marks the blocks whose optimum this may have moved, and
    /// returns how far the block went.
    fn update(&self, x: &mut Self::Iterate, block: usize, active: &mut ActiveSet) -> f64;

    /// Refits what the blocks share, and marks the blocks whose optimum this moved.
    fn end_sweep(&self, x: &mut Self::Iterate, active: &mut ActiveSet);

    /// Named numbers for the trace, always the same names in the same order.
    fn metrics(&self, _x: &Self::Iterate) -> Vec<(&'static str, f64)> {
        Vec::new()
    }
}

/// In which order a sweep visits the blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// 0, 1, 2, ...
    #[default]
    Cyclic,
    /// A new random order in every sweep, derived from the seed and the number of the sweep.
    Shuffled,
}

/// How to descend.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CoordinateDescentOptions {
    /// In which order to visit the blocks.
    pub order: Order,
    /// Decides the shuffled orders.
    pub seed: u64,
    /// A sweep in which no block moves further ends the descent; in the blocks' own unit.
    pub movement_tolerance: f64,
    /// A sweep that decreases the cost by less than this fraction ends the descent (only where
    /// there is a joint objective; 0 switches the test off).
    pub cost_tolerance: f64,
}

impl Default for CoordinateDescentOptions {
    fn default() -> CoordinateDescentOptions {
        CoordinateDescentOptions {
            order: Order::Cyclic,
            seed: 0,
            movement_tolerance: 1e-2,
            cost_tolerance: 1e-6,
        }
    }
}

/// What decides all future sweeps besides the iterate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DescentState {
    /// Sweeps made so far.
    pub sweep: u64,
    /// Blocks to visit, ascending.
    pub active: Vec<u32>,
    /// Cost after the last sweep.
    pub cost: f64,
}

/// The coordinate descent engine.
#[derive(Debug, Clone, Default)]
pub struct Descent {
    options: CoordinateDescentOptions,
    sweep: u64,
    /// `None` before the start.
    active: Option<ActiveSet>,
    cost: f64,
    order: Vec<u32>,
}

/// A cost that an exact update has to leave or lower may rise by this share of it: rounding, also of problems that compare
/// in single precision.
const ROUNDING: f64 = 1e-8;

impl Descent {
    /// An engine with these options.
    pub fn new(options: CoordinateDescentOptions) -> Descent {
        Descent { options, ..Descent::default() }
    }

    /// Fills `order` with the order of the coming sweep.
    fn order_blocks(&mut self, len: usize) {
        self.order.clear();
        self.order.extend((0u32..).take(len));
        if self.options.order == Order::Shuffled {
            let mut rng = ChaCha8Rng::seed_from_u64(self.options.seed);
            rng.set_stream(self.sweep);
            self.order.shuffle(&mut rng);
        }
    }

    fn check<P: BlockCost>(problem: &P, x: &mut P::Iterate) -> Result<f64, SolveError> {
        if u32::try_from(problem.len()).is_err() {
            return Err(SolveError::Misuse("more than 2^32 blocks".to_owned()));
        }
        problem.prepare(x)?;
        let cost = problem.cost(x);
        if !cost.is_finite() {
            return Err(SolveError::NotFinite("the cost of the start".to_owned()));
        }
        Ok(cost)
    }
}

impl<P: BlockCost> Engine<P> for Descent {
    type Iterate = P::Iterate;
    type State = DescentState;
    const NAME: &'static str = "coordinate-descent";

    fn start(&mut self, problem: &P, x: &mut P::Iterate) -> Result<f64, SolveError> {
        self.cost = Descent::check(problem, x)?;
        self.sweep = 0;
        self.active = Some(ActiveSet::new(problem.len(), true));
        Ok(self.cost)
    }

    fn step(&mut self, problem: &P, x: &mut P::Iterate) -> Result<Step, SolveError> {
        self.order_blocks(problem.len());
        let started = self.active.as_mut().filter(|active| active.flags.len() == problem.len());
        let Some(active) = started else {
            return Err(SolveError::Misuse("the engine was not started on this problem".into()));
        };
        let (mut step_norm, mut visited) = (0.0_f64, 0_u32);
        for index in 0..self.order.len() {
            let block = self.order[index] as usize;
            if active.take(block) {
                visited += 1;
                step_norm = step_norm.max(problem.update(x, block, active));
            }
        }
        let waiting = active.count();
        problem.end_sweep(x, active);
        let waiting_after = active.count();
        self.sweep += 1;
        let before = self.cost;
        self.cost = problem.cost(x);
        if !(self.cost.is_finite() && step_norm.is_finite()) {
            return Err(SolveError::NotFinite(format!("sweep {}", self.sweep)));
        }
        let still = waiting_after == 0
            || (step_norm <= self.options.movement_tolerance && waiting_after == waiting);
        let flat = problem.monotone()
            && self.options.cost_tolerance > 0.0
            && before - self.cost <= self.options.cost_tolerance * before.abs();
        let rises = problem.monotone() && self.cost - before > ROUNDING * before.abs();
        let stop = match (rises, still, flat) {
            // An update or the end of a sweep is not the minimiser that it is said to be.
            (true, ..) => Some(Termination::Stalled),
            (_, true, _) => Some(Termination::StepConverged),
            (_, _, true) => Some(Termination::CostConverged),
            (false, false, false) => None,
        };
        let mut metrics = vec![("visited", f64::from(visited))];
        metrics.extend(problem.metrics(x));
        Ok(Step { cost: self.cost, step_norm, accepted: step_norm > 0.0, stop, metrics })
    }

    fn state(&self) -> DescentState {
        let active = self.active.as_ref().map_or_else(Vec::new, ActiveSet::blocks);
        DescentState { sweep: self.sweep, active, cost: self.cost }
    }

    fn resume(
        &mut self,
        problem: &P,
        x: &mut P::Iterate,
        memory: DescentState,
    ) -> Result<f64, SolveError> {
        let found_cost = Descent::check(problem, x)?;
        if memory.active.iter().any(|&block| block as usize >= problem.len()) {
            return Err(SolveError::Misuse(
                "the checkpoint names blocks that are not there".into(),
            ));
        }
        let mut active = ActiveSet::new(problem.len(), false);
        for block in memory.active {
            active.mark(block as usize);
        }
        self.active = Some(active);
        (self.sweep, self.cost) = (memory.sweep, memory.cost);
        Ok(found_cost)
    }
}

/// Descends until nothing moves any more or `max_sweeps` are made; `observe` sees the number of every sweep and what it did.
///
/// # Errors
/// As [`engine::run`].
pub fn run<P: BlockCost>(
    problem: &P,
    x: &mut P::Iterate,
    options: CoordinateDescentOptions,
    max_sweeps: u64,
    observe: impl FnMut(u64, &Step),
) -> Result<RunOutcome, SolveError> {
    engine::run(problem, &mut Descent::new(options), x, max_sweeps, observe)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `J = 1/2 sum_p (x_p - t_p)^2 + 1/2 sum_p (x_p - x_{p+1})^2`: a chain pulled to targets.
    struct Chain {
        targets: Vec<f64>,
    }

    impl BlockCost for Chain {
        type Iterate = Vec<f64>;
        fn len(&self) -> usize {
            self.targets.len()
        }
        fn prepare(&self, x: &mut Vec<f64>) -> Result<(), SolveError> {
            if x.len() == self.len() { Ok(()) } else { Err(SolveError::Misuse("length".into())) }
        }
        fn cost(&self, x: &Vec<f64>) -> f64 {
            let data: f64 = x.iter().zip(&self.targets).map(|(x, t)| (x - t).powi(2)).sum();
            data / 2.0 + x.windows(2).map(|w| (w[0] - w[1]).powi(2)).sum::<f64>() / 2.0
        }
        fn monotone(&self) -> bool {
            true
        }
        fn update(&self, x: &mut Vec<f64>, block: usize, active: &mut ActiveSet) -> f64 {
            let mut neighbours = vec![];
            neighbours.extend(block.checked_sub(1));
            neighbours.extend((block + 1 < x.len()).then_some(block + 1));
            let sum: f64 = neighbours.iter().map(|&q| x[q]).sum();
            let new = (self.targets[block] + sum) / (1 + neighbours.len()) as f64;
            let step_norm = (new - x[block]).abs();
            x[block] = new;
            if step_norm > 1e-12 {
                neighbours.iter().for_each(|&q| active.mark(q));
            }
            step_norm
        }
        fn end_sweep(&self, _: &mut Vec<f64>, _: &mut ActiveSet) {}
    }

    fn chain() -> Chain {
        Chain { targets: (0..20).map(|p| f64::from(p * p % 7)).collect() }
    }

    fn options(order: Order) -> CoordinateDescentOptions {
        CoordinateDescentOptions { order, seed: 5, movement_tolerance: 1e-13, cost_tolerance: 0.0 }
    }

    #[test]
    fn it_descends_to_the_solution_of_the_normal_equations() {
        for order in [Order::Cyclic, Order::Shuffled] {
            let (problem, mut x) = (chain(), vec![0.0; 20]);
            let mut last = f64::INFINITY;
            let outcome = run(&problem, &mut x, options(order), 1000, |_, step| {
                assert!(step.cost <= last * (1.0 + 1e-14));
                last = step.cost;
            })
            .unwrap();
            assert_eq!(outcome.stop, Termination::StepConverged);
            for p in 0..20 {
                let mut gradient = x[p] - problem.targets[p];
                if p > 0 {
                    gradient += x[p] - x[p - 1];
                }
                if p < 19 {
                    gradient += x[p] - x[p + 1];
                }
                assert!(gradient.abs() < 1e-10, "{order:?}: {gradient}");
            }
        }
    }

    #[test]
    fn a_resumed_descent_equals_an_unbroken_one_bit_for_bit() {
        for order in [Order::Cyclic, Order::Shuffled] {
            let problem = chain();
            let (mut whole, mut engine) = (vec![0.0; 20], Descent::new(options(order)));
            engine.start(&problem, &mut whole).unwrap();
            let mut saved = String::new();
            for sweep in 0..9 {
                if sweep == 4 {
                    let memory = Engine::<Chain>::state(&engine);
                    saved = serde_json::to_string(&(&whole, memory)).unwrap();
                }
                engine.step(&problem, &mut whole).unwrap();
            }
            let (mut x, memory): (Vec<f64>, DescentState) = serde_json::from_str(&saved).unwrap();
            let mut second = Descent::new(options(order));
            second.resume(&problem, &mut x, memory).unwrap();
            for _ in 4..9 {
                second.step(&problem, &mut x).unwrap();
            }
            assert_eq!(x, whole);
            assert_eq!(Engine::<Chain>::state(&second), Engine::<Chain>::state(&engine));
        }
    }

    #[test]
    fn shuffled_orders_are_permutations_that_differ_by_sweep_and_seed() {
        let mut engine = Descent::new(options(Order::Shuffled));
        engine.order_blocks(50);
        let first = engine.order.clone();
        engine.sweep = 1;
        engine.order_blocks(50);
        assert_ne!(first, engine.order);
        let mut sorted = engine.order.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..50).collect::<Vec<u32>>());
        engine.sweep = 0;
        engine.order_blocks(50);
        assert_eq!(first, engine.order);
    }

    #[test]
    fn an_empty_problem_converges_and_a_foreign_checkpoint_is_refused() {
        let problem = Chain { targets: vec![] };
        let outcome =
            run(&problem, &mut vec![], CoordinateDescentOptions::default(), 10, |_, _| ()).unwrap();
        assert_eq!((outcome.iterations, outcome.stop), (1, Termination::StepConverged));
        let memory = DescentState { sweep: 3, active: vec![20], cost: 0.0 };
        let refused = Descent::default().resume(&chain(), &mut vec![0.0; 20], memory);
        assert!(matches!(refused, Err(SolveError::Misuse(_))));
    }
}
