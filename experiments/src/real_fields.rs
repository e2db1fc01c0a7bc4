//! The paper's locators, rows with regular spacing and today's locator on real photos, and on synthetic fields in the same way.
//!
//! Photos go the way of the command `locate`: the estimated leaf mask, with its posterior for today's locator. All but `today` are
//! told the number of plants. Where a locator has a choice (form, scale, votes, start) it is the one with the largest mean F1 on
//! at most [`MAX_FOR_CHOICE`] photos of each *other* real set, every set counting the same; synthetic fields take no part in it.
//! The synthetic fields are the levels of the axis `field` of a spec, by default `locate-like-real.toml`.
//!
//! Writes `real.csv` (one row for each set, photo and locator), `real-summary.csv`, `real-against-synthetic.csv`
//! and `twin-statistics.csv`. Numbers only.

use crate::{
    accuracy,
    fail::Fail,
    fail::make,
    real_locators::{CHOSEN, Case, How, Judged, LOCATORS, MOST_SWEEPS, Ready, candidates, choose},
    real_tables,
    spec::Spec,
    twin_statistics,
};
use clap::Args;
use data_synth::scenario::Scenario;
use rayon::prelude::*;
use rowgram::{Error, raster::Mask};
use std::path::PathBuf;

/// Photos of a set that decide choices, at most: evenly from the list.
const MAX_FOR_CHOICE: usize = 12;
/// The axis of a spec whose levels are fields.
const AXIS: &str = "field";

/// What is compared, and where.
#[derive(Debug, Args)]
pub(crate) struct RealFields {
    /// The data folder; the environment variable ROWGRAM_DATA where it is not given.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Where tables go; made if it is not there.
    #[arg(long, value_name = "DIR", default_value = "experiments/out/real-fields")]
    out: PathBuf,
    /// Only every so many-th photo of a set.
    #[arg(long, default_value_t = 1)]
    every: usize,
    /// The spec with the synthetic fields.
    #[arg(long, value_name = "SPEC", default_value = "experiments/specs/locate-like-real.toml")]
    twin: PathBuf,
    /// Synthetic fields of each kind.
    #[arg(long, default_value_t = 6)]
    fields: u64,
}

/// One locator on one photo.
#[derive(Debug, Clone)]
pub(crate) struct Row {
    pub(crate) set: String,
    pub(crate) real: bool,
    pub(crate) photo: String,
    pub(crate) method: &'static str,
    /// What was chosen on other sets.
    pub(crate) choice: String,
    pub(crate) truth: usize,
    pub(crate) judged: Judged,
}

impl Row {
    fn new(case: &Case, real: bool, method: &'static str, choice: String, judged: Judged) -> Row {
        let (set, photo, truth) = (case.set.clone(), case.photo.clone(), case.truth.len());
        Row { set, real, photo, method, choice, truth, judged }
    }

    /// Found minus true plants over the true ones.
    pub(crate) fn count_error(&self) -> f64 {
        (self.judged.found as f64 - self.truth as f64) / self.truth.max(1) as f64
    }
}

/// The statistics of one photo.
#[derive(Debug, Clone)]
pub(crate) struct Described {
    pub(crate) set: String,
    pub(crate) values: [Option<f64>; 16],
}

/// A set of pictures.
struct Set {
    name: String,
    real: bool,
    cases: Vec<Case>,
}

/// Runs everything.
pub(crate) fn run(asked: &RealFields) -> Result<(), Fail> {
    make(&asked.out)?;
    let mut sets = synthetic(asked)?;
    sets.splice(0..0, real(asked)?);
    let (mut rows, mut described, mut scores) = (Vec::new(), Vec::new(), Vec::new());
    for set in &sets {
        let step = set.cases.len().div_ceil(MAX_FOR_CHOICE).max(1);
        let done: Vec<Measurements> = set
            .cases
            .par_iter()
            .enumerate()
            .map(|(k, case)| measure(case, set.real, set.real && k % step == 0))
            .collect::<Result<_, Error>>()?;
        for (mine, statistics, tried) in done {
            rows.extend(mine);
            described.push(statistics);
            scores.extend(tried.into_iter().map(|(p, k, f1)| (set.name.as_str(), p, k, f1)));
        }
        say(&format!("{}: {} pictures", set.name, set.cases.len()));
    }
    for set in &sets {
        for (p, (name, prior)) in CHOSEN.into_iter().enumerate() {
            let all = candidates(prior);
            let mine: Vec<(&str, usize, f64)> =
                scores.iter().filter(|s| s.1 == p).map(|s| (s.0, s.2, s.3)).collect();
            let variant = all[choose(&mine, &set.name, all.len())];
            let done: Vec<Row> = set
                .cases
                .par_iter()
                .map(|case| {
                    let judged = Ready::new(case).run(How::Descent(variant))?;
                    Ok(Row::new(case, set.real, name, variant.words(), judged))
                })
                .collect::<Result<_, Error>>()?;
            rows.extend(done);
        }
    }
    let stopped = rows.iter().filter(|row| row.judged.sweeps == MOST_SWEEPS).count();
    say(&format!(
        "{stopped} of {} runs ended at the limit of {MOST_SWEEPS} sweeps (column `sweeps`)",
        rows.len()
    ));
    real_tables::write(&asked.out, &rows, &described)
}

/// Rows of the table, statistics, and scores of choices: place in [`CHOSEN`], number of the candidate, F1.
type Measurements = (Vec<Row>, Described, Vec<(usize, usize, f64)>);

/// Everything without a choice, the statistics, and the scores of all choices where this photo decides any.
fn measure(case: &Case, real: bool, decides: bool) -> Result<Measurements, Error> {
    let ready = Ready::new(case);
    let rows = LOCATORS
        .into_iter()
        .map(|(name, how)| Ok(Row::new(case, real, name, String::new(), ready.run(how)?)))
        .collect::<Result<_, Error>>()?;
    let described = Described { set: case.set.clone(), values: twin_statistics::of(&ready) };
    let mut scores = Vec::new();
    for (p, (_, prior)) in CHOSEN.into_iter().enumerate().filter(|_| decides) {
        for (k, variant) in candidates(prior).into_iter().enumerate() {
            scores.push((p, k, ready.run(How::Descent(variant))?.f1));
        }
    }
    Ok((rows, described, scores))
}

fn real(asked: &RealFields) -> Result<Vec<Set>, Fail> {
    let data = asked.data.clone().or_else(|| std::env::var_os("ROWGRAM_DATA").map(PathBuf::from));
    let data = data.ok_or_else(|| Fail::Input("expected --data or ROWGRAM_DATA".to_owned()))?;
    if !data.is_dir() {
        let message = format!("{}: there is no such folder with data", data.display());
        return Err(Fail::Input(message));
    }
    let mut sets = Vec::new();
    for (name, plots) in accuracy::sets(&data)? {
        let cases = plots
            .into_par_iter()
            .step_by(asked.every.max(1))
            .map(|plot| {
                let (mask, posterior) = accuracy::leaf_of(&plot.photo);
                let (set, spacing_px) = (name.to_owned(), 4.0 * plot.radius_px);
                Case { set, photo: plot.name, mask, posterior, truth: plot.truth, spacing_px }
            })
            .collect();
        sets.push(Set { name: name.to_owned(), real: true, cases });
    }
    Ok(sets)
}

fn synthetic(asked: &RealFields) -> Result<Vec<Set>, Fail> {
    let (_, cells) = Spec::read(&asked.twin, false)?;
    let fail = |e: String| Fail::Input(format!("{}: {e}", asked.twin.display()));
    let mut sets: Vec<Set> = Vec::new();
    for cell in cells {
        let label = cell.at.iter().find(|(axis, _)| axis == AXIS).map(|(_, label)| label);
        let label = label.ok_or_else(|| fail(format!("there is no axis `{AXIS}`")))?;
        if sets.iter().any(|set| set.name == *label) {
            continue;
        }
        let table = cell.parameters.get("scenario").cloned();
        let table = table.ok_or_else(|| fail("a stage without a scenario".to_owned()))?;
        let scenario: Scenario =
            table.try_into().map_err(|e: toml::de::Error| fail(e.to_string()))?;
        let cases = (1..=asked.fields)
            .into_par_iter()
            .map(|seed| grow(label, &scenario, seed))
            .collect::<Result<_, String>>()
            .map_err(fail)?;
        sets.push(Set { name: label.clone(), real: false, cases });
    }
    Ok(sets)
}

fn grow(set: &str, scenario: &Scenario, seed: u64) -> Result<Case, String> {
    let mut scenario = scenario.clone();
    scenario.field.seed = seed;
    let scene = scenario.build().map_err(|e| e.to_string())?;
    let picture = scene.mask();
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let data = picture.into_raw().into_iter().map(|y| u8::from(y != 0)).collect();
    Ok(Case {
        set: set.to_owned(),
        photo: seed.to_string(),
        mask: Mask { width, height, data },
        posterior: None,
        truth: scene.field.plants.iter().map(|p| [p.u_px, p.v_px]).collect(),
        spacing_px: scenario.field.spacing_m / scene.field.frame.gsd_m,
    })
}

#[expect(clippy::print_stderr, reason = "a long run says how far it is, and what it left out")]
fn say(what: &str) {
    eprintln!("{what}");
}
