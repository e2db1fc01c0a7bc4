//! `rowgram season`: the flights over one field on several dates, and what grows.

use super::{print, print_json, terminal::Terminal};
use rowgram_base::error::Error;
use rowgram_project::{
    environment, report,
    season::{self, SeasonFile, SeasonOutcome},
};
use std::path::PathBuf;

/// Flights over one field on several dates: one frame, the same plots and plants, growth curves
///
/// FILE lists the flights (folders of projects) with their dates:
///
///   name = "Trial 7"
///   sown = "2015-05-20"
///   plots = "plots.geojson"
///
///   [[flights]]
///   project = "2015-05-28"
///   date = "2015-05-28"
///
/// Every flight is run as by rowgram run, as far as something has changed. Maps of flights without ground control are tied to
/// those of the dates before and after by what does not grow. Plots are those of the season; plants are followed from date to
/// date; logistic or Gompertz curves are fitted to every plot.
///
/// Writes into the folder season beside season.toml (NAME-season beside NAME.toml): flights.csv, traits_long.csv, plants_long.csv, growth.csv, season.json,
/// report.html. A flight that is added later changes nothing of the others.
///
/// Exit code 3 where a flight takes no part or has a stage that failed.
#[derive(Debug, clap::Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Examples:
  rowgram synth season -o field && rowgram season field/season.toml
  rowgram season field/season.toml --set ortho.gsd_m=0.01"
)]
pub(super) struct Args {
    /// The list of flights, usually season.toml.
    file: PathBuf,
    /// Set a key of the rowgram.toml of all flights; may be given several times.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Replace files that were edited since, or that rowgram did not write: they are kept beside, as NAME.edited.
    #[arg(long)]
    force: bool,
    /// Print the outcome as one line of JSON in place of the summary.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
///
/// # Errors
/// A file or settings that cannot be understood, and [`Error::Incomplete`] where a flight takes no part or has a stage that failed.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let file = SeasonFile::read(&args.file)?;
    let mut terminal = Terminal::new();
    let outcome = season::season(&file, &environment()?, &args.set, args.force, &mut terminal)?;
    let page = report::write_season(&file, &outcome, args.force)?;
    drop(terminal);
    if args.json {
        print_json(&outcome)?;
    } else {
        print(&format!("{}\nreport  {}", summary(&outcome), page.display()))?;
    }
    let faults: Vec<String> = outcome
        .flights
        .iter()
        .filter_map(|flight| {
            let fault = match (&flight.placement, &flight.failure) {
                (None, _) => "takes no part".to_owned(),
                (Some(_), Some(why)) => format!("has a stage that failed: {why}"),
                (Some(_), None) => return None,
            };
            Some(format!("{} {fault}", flight.date))
        })
        .collect();
    if faults.is_empty() { Ok(()) } else { Err(Error::Incomplete(faults.join("\nerror: "))) }
}

fn summary(outcome: &SeasonOutcome) -> String {
    let mut text = format!(
        "{}: {} flights, {} plots",
        outcome.name,
        outcome.flights.len(),
        outcome.plots.len()
    );
    for flight in &outcome.flights {
        let frame = match &flight.placement {
            None => "takes no part".to_owned(),
            Some(placement) => match &placement.fit {
                None => "in its own frame".to_owned(),
                Some(fit) => format!(
                    "tied to {} by {} places, +- {:.1} cm, deformation {:.1} cm",
                    placement.tied_to.join(" and "),
                    fit.ties,
                    100.0 * fit.edge_sigma_m,
                    100.0 * fit.deformation_m
                ),
            },
        };
        let plants = flight.plants.map(|plants| format!(", {plants} plants")).unwrap_or_default();
        let red = match flight.red_checks {
            0 => String::new(),
            1 => ", 1 red check (see its report)".to_owned(),
            n => format!(", {n} red checks (see its report)"),
        };
        text += &format!("\n  {}  day {:<5} {frame}{plants}{red}", flight.date, flight.day);
    }
    for of in &outcome.traits {
        let fitted = of.plots.iter().filter(|plot| plot.curve.is_some()).count();
        let plots = of.plots.len();
        text += &match fitted {
            0 => format!("\n  {:<18} no curve of {plots} plots", of.name),
            _ => format!("\n  {:<18} {fitted} curves of {plots} plots ({})", of.name, of.model),
        };
    }
    text += &format!("\n  {} plants followed, {} outliers", outcome.tracks, outcome.outliers.len());
    text
}
