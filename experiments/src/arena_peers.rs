//! The bundle blocks of the solver arena for solvers outside this program: as files, and the engine on them
//! with the same printed answer as `benches/peers` have; see scripts/arena_peers.py.

use crate::{
    fail::{Fail, write_csv},
    spec::Spec,
    stages::{
        bundle::descend,
        instances::{Family, Instance, Ranges, drawn_block},
    },
};
use clap::{Args, ValueEnum};
use data_synth::block::write_bal;
use rowgram::{
    io::output,
    nlls::{LinearSolver, Method, Options},
};
use serde_json::json;
use std::{io::Write as _, path::PathBuf, time::Instant};

/// Where the blocks come from.
#[derive(Debug, Args)]
pub(crate) struct Source {
    /// A spec of the stage `solvers`, its ranges and its seeds.
    #[arg(value_name = "SPEC")]
    spec: PathBuf,
    /// In its small setting.
    #[arg(long)]
    small: bool,
}

impl Source {
    /// The seeds of the spec, and what its blocks are drawn from.
    fn read(&self) -> Result<(std::ops::Range<u64>, Ranges), Fail> {
        let (spec, cells) = Spec::read(&self.spec, self.small)?;
        let bundle = |cell: &&crate::spec::Cell| {
            let family = cell.parameters.get("family").and_then(|family| family.as_str());
            family == Some("bundle")
        };
        let ranges = cells.iter().find(bundle).and_then(|cell| cell.parameters.get("ranges"));
        let ranges: Ranges = ranges
            .cloned()
            .ok_or_else(|| Fail::Input(format!("{}: no bundle blocks", self.spec.display())))?
            .try_into()
            .map_err(|e: toml::de::Error| Fail::Input(e.to_string()))?;
        Ok((spec.seeds.first..spec.seeds.first + spec.seeds.count, ranges))
    }
}

/// Writes the bundle blocks of a spec as BAL files, and `instances.csv`.
#[derive(Debug, Args)]
pub(crate) struct Export {
    #[command(flatten)]
    source: Source,
    /// Where the files go; made if it is not there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl Export {
    pub(crate) fn run(&self) -> Result<(), Fail> {
        let (seeds, ranges) = self.source.read()?;
        std::fs::create_dir_all(&self.out).map_err(|e| Fail::io(&self.out, &e))?;
        let mut rows =
            vec![["file", "seed", "loss", "images", "points", "measurements"].map(str::to_owned)];
        for seed in seeds {
            let (block, loss) = drawn_block(&ranges, seed).map_err(Fail::Failed)?;
            let name = format!("block-{seed:03}.txt");
            output::write(&self.out.join(&name), true, |out| {
                let (cameras, points) = (&block.cameras_start, &block.points_start);
                write_bal(cameras, points, &block.observations, out)
            })?;
            rows.push([
                name,
                seed.to_string(),
                loss.to_string(),
                block.cameras_start.len().to_string(),
                block.points_start.len().to_string(),
                block.observations.len().to_string(),
            ]);
        }
        Ok(write_csv(&self.out.join("instances.csv"), &rows)?)
    }
}

/// How the engine goes about it.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Variant {
    Schur,
    Sparse,
    Iterative,
    Dogleg,
}

/// Adjusts one bundle block of a spec and prints costs and seconds as a line of JSON.
#[derive(Debug, Args)]
pub(crate) struct Race {
    #[command(flatten)]
    source: Source,
    /// Which block.
    #[arg(long)]
    seed: u64,
    #[arg(long, value_enum, default_value = "schur")]
    variant: Variant,
    /// Ends where a step decreases the cost by less than this share.
    #[arg(long, default_value_t = 1e-9)]
    tolerance: f64,
    #[arg(long, default_value_t = 200)]
    max_iterations: u64,
}

impl Race {
    pub(crate) fn run(&self) -> Result<(), Fail> {
        let (_, ranges) = self.source.read()?;
        let instance = Instance::draw(Family::Bundle, &ranges, self.seed).map_err(Fail::Failed)?;
        let (method, linear) = match self.variant {
            Variant::Schur => (Method::LevenbergMarquardt, LinearSolver::Schur),
            Variant::Sparse => (Method::LevenbergMarquardt, LinearSolver::Sparse),
            Variant::Iterative => (Method::LevenbergMarquardt, LinearSolver::IterativeSchur),
            Variant::Dogleg => (Method::Dogleg, LinearSolver::Schur),
        };
        let options =
            Options { method, linear, cost_tolerance: self.tolerance, ..Options::default() };
        let problem = instance.problem();
        let mut x = problem.start();
        let mut log = Vec::new();
        let clock = Instant::now();
        let (cost, iterations) =
            descend(problem, &mut x, &options, self.max_iterations, |trial, cost, _| {
                log.push((trial, cost, clock.elapsed().as_secs_f64()));
            })
            .map_err(Fail::Failed)?;
        let line = json!({
            "initial_cost": log.first().map(|&(_, cost, _)| cost),
            "final_cost": cost,
            "iterations": iterations,
            "solve_seconds": clock.elapsed().as_secs_f64(),
            "log": log,
        });
        writeln!(std::io::stdout(), "{line}").map_err(|e| Fail::Failed(e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram::problems::bundle::{Bundle, InteriorSharing};

    #[test]
    fn the_files_hold_the_instances_of_the_stage() {
        let out = tempfile::tempdir().unwrap();
        let spec =
            std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("specs/solver-arena-full.toml");
        let source = || Source { spec: spec.clone(), small: true };
        let (seeds, ranges) = source().read().unwrap();
        Export { source: source(), out: out.path().to_owned() }.run().unwrap();
        let seed = seeds.start;
        let instance = Instance::draw(Family::Bundle, &ranges, seed).unwrap();
        let start = instance.cost(&instance.problem().start()).unwrap();
        let path = out.path().join(format!("block-{seed:03}.txt"));
        let network = rowgram::io::bal::read(&path).unwrap();
        let (_, loss) = drawn_block(&ranges, seed).unwrap();
        let problem = Bundle::new(&network, InteriorSharing::PerImage, loss).unwrap().problem;
        let again: f64 = problem.costs(&problem.start()).unwrap().iter().sum();
        assert!((again / start - 1.0).abs() < 1e-12, "{again} {start}");
        let table = std::fs::read_to_string(out.path().join("instances.csv")).unwrap();
        assert_eq!(table.lines().count() as u64, 1 + seeds.end - seeds.start);
    }
}
