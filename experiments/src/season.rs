//! How near a season of `rowgram synth season` comes to its truth: the tables of docs/accuracy.md.
//!
//! Writes `season.csv`, one line for each date, `season_emergence.csv`, one for each plot, and `season.md`, both as tables.
//!
//! | column | what it is |
//! |---|---|
//! | `apart_gsd` | root mean square distance of the targets of a date from where the date before puts them; only the first flight of such a season has control |
//! | `cover_held`, `plants_held`, `height_held` | plots whose value lies in its interval, and those that have an interval |
//! | `same_plant` | of the plants that this date and the one before show within 10 cm of their true place, the share that is one plant on both |

use crate::fail::{Fail, write_csv};
use rowgram::{
    io::output,
    pipeline::season::{SeasonFile, SeasonOutcome},
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// A located plant is the true one within this distance, metres.
const RIGHT_M: f64 = 0.10;

/// A season against its truth.
#[derive(Debug, clap::Args)]
pub(crate) struct Season {
    /// The list of flights of a season that `rowgram synth season` made and `rowgram season` has measured.
    season: PathBuf,
    /// Where the tables go; made if it is not there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// What a plot truly is on a date (truth/plot_days.csv).
#[derive(Debug, Deserialize)]
struct PlotDay {
    date: String,
    plot: String,
    plants: f64,
    canopy_cover: f64,
    canopy_height_m: f64,
}

/// A line of season/traits_long.csv.
#[derive(Debug, Deserialize)]
struct Value {
    date: String,
    plot: String,
    #[serde(rename = "trait")]
    name: String,
    low: Option<f64>,
    high: Option<f64>,
}

/// A plant (truth/plants.csv).
#[derive(Debug, Deserialize)]
struct Plant {
    plant: usize,
    easting_m: f64,
    northing_m: f64,
}

/// A plant on a date (truth/plant_days.csv).
#[derive(Debug, Deserialize)]
struct PlantDay {
    date: String,
    plant: usize,
    leaf_area_m2: f64,
}

/// A located plant (season/plants_long.csv).
#[derive(Debug, Deserialize)]
struct Located {
    plant: usize,
    date: String,
    easting_m: f64,
    northing_m: f64,
}

/// A ground point (truth/gcps.csv of a flight).
#[derive(Debug, Deserialize)]
struct Target {
    label: String,
    easting_m: f64,
    northing_m: f64,
}

/// When a plot truly emerged (truth/plots.csv).
#[derive(Debug, Deserialize)]
struct PlotTruth {
    plot: String,
    emergence_day: f64,
}

/// What the report of the orientation says of a ground point.
#[derive(Debug, Deserialize)]
struct Ground {
    name: String,
    adjusted_m: Option<[f64; 3]>,
}

#[derive(Debug, Deserialize)]
struct Report {
    ground: Vec<Ground>,
}

/// How a date came out.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Date {
    date: String,
    day: f64,
    apart_gsd: Option<f64>,
    plants_true: usize,
    located: usize,
    right: usize,
    cover_held: usize,
    cover_told: usize,
    plants_held: usize,
    plants_told: usize,
    height_held: usize,
    height_told: usize,
    same_plant: Option<f64>,
}

/// How the emergence of a plot came out, days.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Emergence {
    plot: String,
    truth: f64,
    found: Option<f64>,
    low: Option<f64>,
    high: Option<f64>,
}

fn table<T: DeserializeOwned>(path: &Path) -> Result<Vec<T>, Fail> {
    let fail = |e: csv::Error| Fail::Input(format!("{}: {e}", path.display()));
    csv::Reader::from_path(path)
        .map_err(fail)?
        .into_deserialize()
        .map(|row| row.map_err(fail))
        .collect()
}

impl Season {
    pub(crate) fn run(&self) -> Result<(), Fail> {
        let file = SeasonFile::read(&self.season)?;
        let outcome = SeasonOutcome::read(&file)?;
        let (truth, results) = (file.root().join("truth"), file.results());
        let dates = dates(&file, &outcome, &truth, &results)?;
        let emergence = emergence(&outcome, &table(&truth.join("plots.csv"))?);
        crate::fail::make(&self.out).map_err(rowgram::Error::from)?;
        write_csv(&self.out.join("season.csv"), &dates)?;
        write_csv(&self.out.join("season_emergence.csv"), &emergence)?;
        let text = page(&dates, &emergence);
        output::write(&self.out.join("season.md"), true, |to| to.write_all(text.as_bytes()))
            .map_err(rowgram::Error::from)?;
        crate::accuracy::show(&text);
        Ok(())
    }
}

/// How each date came out.
fn dates(
    file: &SeasonFile,
    outcome: &SeasonOutcome,
    truth: &Path,
    results: &Path,
) -> Result<Vec<Date>, Fail> {
    let plot_days: Vec<PlotDay> = table(&truth.join("plot_days.csv"))?;
    let values: Vec<Value> = table(&results.join("traits_long.csv"))?;
    let plants: BTreeMap<usize, [f64; 2]> = table::<Plant>(&truth.join("plants.csv"))?
        .into_iter()
        .map(|p| (p.plant, [p.easting_m, p.northing_m]))
        .collect();
    let days: Vec<PlantDay> = table(&truth.join("plant_days.csv"))?;
    let located: Vec<Located> = table(&results.join("plants_long.csv"))?;
    let (mut dates, mut errors_before, mut tracks_before) = (Vec::new(), None, None);
    for flight in &outcome.flights {
        let date = &flight.date;
        let visible: Vec<(usize, [f64; 2])> = days
            .iter()
            .filter(|day| day.date == *date && day.leaf_area_m2 > 0.0)
            .filter_map(|day| Some((day.plant, *plants.get(&day.plant)?)))
            .collect();
        let found: Vec<(usize, [f64; 2])> = located
            .iter()
            .filter(|plant| plant.date == *date)
            .map(|plant| (plant.plant, [plant.easting_m, plant.northing_m]))
            .collect();
        let tracks = matched(&visible, &found);
        let held = |name: &str, of: fn(&PlotDay) -> f64| held(&values, &plot_days, date, name, of);
        let [cover, count, height] = [
            held("canopy_cover", |day| day.canopy_cover),
            held("plants", |day| day.plants),
            held("canopy_height_m", |day| day.canopy_height_m),
        ];
        let errors = match (&flight.placement, flight.gsd_m) {
            (Some(placement), Some(gsd_m)) => {
                let errors = target_errors(&file.root().join(&flight.project), |at| {
                    placement.transform.apply(at)
                })?;
                Some((errors, gsd_m))
            }
            _ => None,
        };
        let apart = match (&errors_before, &errors) {
            (Some((before, _)), Some((now, gsd_m))) => apart_m(before, now).map(|d| d / gsd_m),
            _ => None,
        };
        dates.push(Date {
            date: date.clone(),
            day: flight.day,
            apart_gsd: apart,
            plants_true: visible.len(),
            located: found.len(),
            right: tracks.len(),
            cover_held: cover[0],
            cover_told: cover[1],
            plants_held: count[0],
            plants_told: count[1],
            height_held: height[0],
            height_told: height[1],
            same_plant: tracks_before.as_ref().and_then(|before| same(before, &tracks)),
        });
        (errors_before, tracks_before) = (errors, Some(tracks));
    }
    Ok(dates)
}

/// Plots whose true value lies in the interval, and those that have one.
fn held(
    values: &[Value],
    days: &[PlotDay],
    date: &str,
    name: &str,
    of: fn(&PlotDay) -> f64,
) -> [usize; 2] {
    let mut counts = [0; 2];
    for value in values.iter().filter(|value| value.date == date && value.name == name) {
        let day = days.iter().find(|day| day.date == date && day.plot == value.plot);
        if let (Some(day), Some(low), Some(high)) = (day, value.low, value.high) {
            counts[0] += usize::from((low..=high).contains(&of(day)));
            counts[1] += 1;
        }
    }
    counts
}

/// Where the adjusted targets of a flight are in the frame of the season, minus where they truly are.
fn target_errors(
    project: &Path,
    place: impl Fn([f64; 2]) -> [f64; 2],
) -> Result<BTreeMap<String, [f64; 2]>, Fail> {
    let targets: Vec<Target> = table(&project.join("truth/gcps.csv"))?;
    let path = project.join("rowgram/align/report/report.json");
    let text = std::fs::read_to_string(&path)
        .map_err(|error| Fail::Input(format!("{}: {error}", path.display())))?;
    let report: Report = serde_json::from_str(&text)
        .map_err(|error| Fail::Input(format!("{}: {error}", path.display())))?;
    let of = |ground: Ground| {
        let target = targets.iter().find(|target| target.label == ground.name)?;
        let [x, y, _] = ground.adjusted_m?;
        let [x, y] = place([x, y]);
        Some((ground.name, [x - target.easting_m, y - target.northing_m]))
    };
    Ok(report.ground.into_iter().filter_map(of).collect())
}

/// Root mean square difference of the errors of the targets that both dates have.
fn apart_m(before: &BTreeMap<String, [f64; 2]>, now: &BTreeMap<String, [f64; 2]>) -> Option<f64> {
    let squares: Vec<f64> = now
        .iter()
        .filter_map(|(name, a)| {
            before.get(name).map(|b| (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2))
        })
        .collect();
    (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
}

/// The track of each true plant that is located within [`RIGHT_M`], nearest pairs first.
fn matched(truth: &[(usize, [f64; 2])], found: &[(usize, [f64; 2])]) -> BTreeMap<usize, usize> {
    let mut pairs = Vec::new();
    for (i, (_, a)) in truth.iter().enumerate() {
        for (j, (_, b)) in found.iter().enumerate() {
            let apart = (a[0] - b[0]).hypot(a[1] - b[1]);
            if apart < RIGHT_M {
                pairs.push((apart, i, j));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let (mut tracks, mut taken) = (BTreeMap::new(), BTreeSet::new());
    for (_, i, j) in pairs {
        if !tracks.contains_key(&truth[i].0) && taken.insert(j) {
            tracks.insert(truth[i].0, found[j].0);
        }
    }
    tracks
}

/// Share of the plants of both dates that are one track.
fn same(before: &BTreeMap<usize, usize>, now: &BTreeMap<usize, usize>) -> Option<f64> {
    let both: Vec<bool> = now
        .iter()
        .filter_map(|(plant, track)| before.get(plant).map(|before| before == track))
        .collect();
    let same = both.iter().filter(|same| **same).count();
    (!both.is_empty()).then(|| same as f64 / both.len() as f64)
}

fn emergence(outcome: &SeasonOutcome, plots: &[PlotTruth]) -> Vec<Emergence> {
    let of = |plot: &PlotTruth| {
        let day = outcome.emergence.iter().find(|date| date.plot == plot.plot)?.day;
        Some(Emergence {
            plot: plot.plot.clone(),
            truth: plot.emergence_day,
            found: day.map(|day| day.value),
            low: day.map(|day| day.low),
            high: day.map(|day| day.high),
        })
    };
    plots.iter().filter_map(of).collect()
}

fn page(dates: &[Date], emergence: &[Emergence]) -> String {
    let mut text = String::from(
        "| date | day | apart, GSD | plants, true | located | within 10 cm | cover within its interval | number | height | same plant as on the date before |\n|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let or_dash = |value: Option<String>| value.unwrap_or_else(|| "-".into());
    for d in dates {
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {} | {} of {} | {} of {} | {} of {} | {} |",
            d.date,
            d.day,
            or_dash(d.apart_gsd.map(|apart| format!("{apart:.2}"))),
            d.plants_true,
            d.located,
            d.right,
            d.cover_held,
            d.cover_told,
            d.plants_held,
            d.plants_told,
            d.height_held,
            d.height_told,
            or_dash(d.same_plant.map(|share| format!("{:.0} %", 100.0 * share))),
        );
    }
    text.push_str("\n| plot | emerged on day, true | found | interval |\n|---|---|---|---|\n");
    for e in emergence {
        let found = or_dash(e.found.map(|day| format!("{day:.2}")));
        let interval = e.low.zip(e.high).map(|(low, high)| format!("{low:.2} to {high:.2}"));
        let _ = writeln!(text, "| {} | {:.2} | {found} | {} |", e.plot, e.truth, or_dash(interval));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plant_is_the_nearest_within_ten_centimetres_and_counts_once() {
        let truth = [(7, [0.0, 0.0]), (8, [0.05, 0.0]), (9, [1.0, 0.0])];
        let found = [(70, [0.01, 0.0]), (90, [1.2, 0.0])];
        let before = matched(&truth, &found);
        assert_eq!(before, BTreeMap::from([(7, 70)]));
        let now = matched(&truth, &[(70, [0.0, 0.0]), (81, [0.05, 0.0])]);
        assert_eq!(same(&before, &now), Some(1.0));
        assert_eq!(same(&BTreeMap::from([(7, 71)]), &now), Some(0.0));
        assert_eq!(same(&BTreeMap::new(), &now), None);
    }

    #[test]
    fn dates_are_apart_by_what_their_errors_differ() {
        let of = |x: f64| BTreeMap::from([("A".to_owned(), [x, 1.0]), (format!("{x}"), [0.0; 2])]);
        assert_eq!(apart_m(&of(1.0), &of(4.0)), Some(3.0));
        assert_eq!(apart_m(&BTreeMap::new(), &of(4.0)), None);
    }
}
