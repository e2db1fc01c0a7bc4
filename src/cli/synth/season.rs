//! `rowgram synth season`: flights over one field on several dates, with the truth over all of them.

use crate::cli::terminal::Terminal;
use data_synth::season_plan::{SeasonConfig, SeasonPreset};
use rowgram_base::error::Error;
use rowgram_project::synth::{FlightOptions, read_config, write_season};
use std::path::PathBuf;

/// Flights over one synthetic field on several dates: the same plants as they grow, with the whole truth.
///
/// Writes a project folder per flight, named by its date (as synth flight does; only the first has ground control),
/// season.toml (the list of flights for rowgram season), plots.geojson, season-twin.toml (every parameter, for
/// --config), and under truth/ what belongs to no single flight: plants.csv (emergence and loss of every plant),
/// plant_days.csv (its leaves on each date), plots.csv (how plots grow), plot_days.csv (plants, cover, height) and light.csv
/// (the light of each date). With --panels panels.geojson has panels of known reflectance.
///
/// Sun, wind, flying height, weeds and part of the soil differ from date to date. The same parameters give the same bytes
/// for any number of threads.
///
/// Example: rowgram synth season --preset small -o season && rowgram season season/season.toml
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct Args {
    /// Folder to write into, made if missing.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Replace files that exist.
    #[arg(long)]
    force: bool,
    /// Parameters from a season-twin.toml; options given here come before it.
    #[arg(long, value_name = "FILE", conflicts_with = "preset")]
    config: Option<PathBuf>,
    /// A usual season: small or tiny [default: small].
    #[arg(long, value_name = "NAME")]
    preset: Option<SeasonPreset>,
    /// Seed of everything random [default: 1].
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    seed: Option<u64>,
    /// Days from sowing to each flight [default: those of the preset].
    #[arg(long, value_name = "DAYS", value_delimiter = ',')]
    days: Vec<u32>,
    /// Standard deviation of the logarithm of the light from flight to flight [default: 0].
    #[arg(long, value_name = "X")]
    light_spread: Option<f64>,
    /// The same of red and of blue against green [default: 0].
    #[arg(long, value_name = "X")]
    cast_spread: Option<f64>,
    /// Side of panels of known reflectance beside the field, metres [default: 0, none].
    #[arg(long, value_name = "M")]
    panels: Option<f64>,
    /// Render no photos: everything else in seconds.
    #[arg(long)]
    no_photos: bool,
}

/// Runs the command.
///
/// # Errors
/// A parameter that cannot be used, an output that exists, a file that cannot be read or written.
pub(super) fn run(args: &Args) -> Result<(), Error> {
    let mut config = match &args.config {
        Some(path) => read_config(path)?,
        None => SeasonConfig::preset(args.preset.unwrap_or(SeasonPreset::Small)),
    };
    if let Some(seed) = args.seed {
        config.twin.field.seed = seed;
    }
    if !args.days.is_empty() {
        config.days.clone_from(&args.days);
    }
    config.light_spread = args.light_spread.unwrap_or(config.light_spread);
    config.cast_spread = args.cast_spread.unwrap_or(config.cast_spread);
    config.twin.panels.size_m = args.panels.unwrap_or(config.twin.panels.size_m);
    let options = FlightOptions { photos: !args.no_photos, ..FlightOptions::default() };
    let mut terminal = Terminal::new();
    let found = write_season(&config, &options, &args.output, args.force, &mut terminal)?;
    let flights = found.dates.iter().zip(&found.photos).zip(&found.plants);
    for ((date, photos), plants) in flights {
        tracing::info!("{date}: {photos} photos, {plants} plants");
    }
    tracing::info!(
        "{}: {} flights over {} plots",
        args.output.display(),
        found.dates.len(),
        found.plots
    );
    Ok(())
}
