//! Performance profiles: for solver `s` and problem `p` with the measure `m`, the share of problems with
//! `m(s, p) <= tau min_s m(s, p)`, over `tau`. A run that failed or has no value is never within; a problem
//! without a run of a solver is none of that solver's problems.
//!
//! Reference: E. D. Dolan and J. J. More, "Benchmarking optimization software with performance
//! profiles", Mathematical Programming 91, 2002.

use crate::data::{Frame, quantile};
use std::collections::BTreeSet;

/// The profile of one solver.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Profile {
    /// Problems that it was run on.
    pub(super) problems: usize,
    /// The ratio to the best of each that it solved, ascending.
    pub(super) ratios: Vec<f64>,
}

impl Profile {
    /// The share of its problems within a factor of the best.
    pub(super) fn share(&self, tau: f64) -> f64 {
        let within = self.ratios.iter().filter(|ratio| **ratio <= tau).count();
        within as f64 / self.problems.max(1) as f64
    }

    /// The median ratio over the problems that it solved.
    pub(super) fn median(&self) -> Option<f64> {
        (!self.ratios.is_empty()).then(|| quantile(&self.ratios, 0.5))
    }
}

/// The profile of each solver; `problem` and the seed name the problems.
pub(super) fn profiles(
    rows: &Frame,
    problem: &str,
    solver: &str,
    measure: &str,
    solvers: &[String],
) -> Result<Vec<Profile>, String> {
    let (problem, seed) = (rows.column(problem)?, rows.column("seed")?);
    let (solver, measure) = (rows.column(solver)?, rows.column(measure)?);
    let mut names: Vec<(&str, &str)> = Vec::new();
    let mut measured: Vec<Vec<Option<f64>>> = Vec::new();
    for row in &rows.rows {
        let key = (row[problem].as_str(), row[seed].as_str());
        let place = names.iter().position(|other| *other == key).unwrap_or_else(|| {
            names.push(key);
            measured.push(vec![None; solvers.len()]);
            names.len() - 1
        });
        let s = solvers.iter().position(|name| *name == row[solver]).unwrap_or(0);
        measured[place][s] = Some(row[measure].parse().unwrap_or(f64::INFINITY));
    }
    let best: Vec<f64> = measured
        .iter()
        .map(|of| of.iter().flatten().copied().fold(f64::INFINITY, f64::min))
        .map(|best| best.max(f64::MIN_POSITIVE))
        .collect();
    let profile = |s: usize| {
        let mine: Vec<f64> =
            measured.iter().zip(&best).filter_map(|(of, best)| Some(of[s]? / best)).collect();
        let mut ratios: Vec<f64> = mine.iter().copied().filter(|r| r.is_finite()).collect();
        ratios.sort_by(f64::total_cmp);
        Profile { problems: mine.len(), ratios }
    };
    Ok((0..solvers.len()).map(profile).collect())
}

/// The rows of `frame` without those whose run has 0 in the column `applies` of `runs`.
pub(super) fn applicable(frame: &Frame, runs: &Frame, applies: &str) -> Result<Frame, String> {
    let place = |frame: &Frame| Ok::<_, String>([frame.column("cell")?, frame.column("seed")?]);
    let ([cell, seed], applies) = (place(runs)?, runs.column(applies)?);
    let not: BTreeSet<(&str, &str)> = runs
        .rows
        .iter()
        .filter(|row| row[applies].parse() == Ok(0.0))
        .map(|row| (row[cell].as_str(), row[seed].as_str()))
        .collect();
    let [cell, seed] = place(frame)?;
    let stays = |row: &&Vec<String>| !not.contains(&(row[cell].as_str(), row[seed].as_str()));
    Ok(Frame {
        header: frame.header.clone(),
        rows: frame.rows.iter().filter(stays).cloned().collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(text: &str) -> Frame {
        let mut lines =
            text.lines().map(|line| line.trim().split(',').map(str::to_owned).collect());
        Frame { header: lines.next().unwrap(), rows: lines.collect() }
    }

    #[test]
    fn ratios_are_those_of_the_hand() {
        // c has nothing to do with problem 2, and does not solve problem 1.
        let runs = frame(
            "cell,problem,solver,seed,m,applies
             0,x,a,1,10,1
             1,x,b,1,20,1
             2,x,c,1,,1
             0,x,a,2,30,1
             1,x,b,2,15,1
             2,x,c,2,,0
             3,y,a,1,8,1
             4,y,b,1,,1
             5,y,c,1,2,1",
        );
        let solvers = ["a", "b", "c"].map(str::to_owned);
        let rows = applicable(&runs, &runs, "applies").unwrap();
        assert_eq!(rows.rows.len(), 8);
        let found = profiles(&rows, "problem", "solver", "m", &solvers).unwrap();
        let profile = |problems, ratios: &[f64]| Profile { problems, ratios: ratios.to_vec() };
        assert_eq!(
            found,
            [profile(3, &[1.0, 2.0, 4.0]), profile(3, &[1.0, 2.0]), profile(2, &[1.0])]
        );
        assert_eq!([1.0, 2.0, 4.0].map(|tau| found[0].share(tau)), [1.0 / 3.0, 2.0 / 3.0, 1.0]);
        assert_eq!((found[1].share(100.0), found[2].share(1.0)), (2.0 / 3.0, 0.5));
        assert_eq!((found[0].median(), found[1].median()), (Some(2.0), Some(1.5)));
        assert_eq!(profile(3, &[]).median(), None);
        // Seconds are in another table, which has no such column.
        let timing = frame("cell,seed,s\n2,2,0.1\n2,1,0.2");
        assert_eq!(applicable(&timing, &runs, "applies").unwrap().rows.len(), 1);
    }
}
