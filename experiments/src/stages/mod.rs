//! The stages: what can be put under test. Each is a file of its own that knows nothing of sweeps.

pub(crate) mod adjust;
pub(crate) mod arena;
mod arena_problems;
pub(crate) mod bundle;
pub(crate) mod chain;
mod chain_map;
mod contestants;
pub(crate) mod cost_map;
mod flat_problem;
pub(crate) mod instances;
pub(crate) mod leaves;
pub(crate) mod lens;
pub(crate) mod locate;
pub(crate) mod orthomosaic;
pub(crate) mod segment;
mod small_instances;
pub(crate) mod solvers;
pub(crate) mod two_view;
