//! The tables of a season, long: one row per value.

use super::{
    SEASON_RESULTS, SeasonOutcome,
    follow::{Day, Found},
};
use rowgram_base::error::Error;
use rowgram_files::csv_table::CsvWriter;
use rowgram_optim::output;
use rowgram_plants::{
    phenotype::{stand::NORMAL_95, traits::known_traits},
    problems::growth_curve::Estimate,
};
use serde_json::Value;
use std::path::Path;

/// The files.
pub(super) const FILES: [&str; 7] = [
    "flights.csv",
    "colours.csv",
    "traits_long.csv",
    "plants_long.csv",
    "growth.csv",
    SEASON_RESULTS,
    crate::run::REPORT_FILE,
];

/// Writes all of them but the report into a folder.
///
/// # Errors
/// Where a file cannot be written.
pub(super) fn write(
    folder: &Path,
    outcome: &SeasonOutcome,
    days: &[Day],
    found: &Found,
) -> Result<(), Error> {
    flights(&folder.join("flights.csv"), outcome)?;
    colours(&folder.join("colours.csv"), outcome)?;
    traits(&folder.join("traits_long.csv"), outcome, days)?;
    plants(&folder.join("plants_long.csv"), days, found)?;
    growth(&folder.join("growth.csv"), outcome)?;
    Ok(output::write_json(&folder.join(SEASON_RESULTS), true, outcome)?)
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.filter(|x| x.is_finite()).map(|x| format!("{x:.digits$}")).unwrap_or_default()
}

/// Six significant digits, as traits have them.
fn significant(value: Option<f64>) -> String {
    let Some(x) = value.filter(|x| x.is_finite()) else { return String::new() };
    if x == 0.0 {
        return "0".to_owned();
    }
    let unit = 10f64.powi(5 - x.abs().log10().floor() as i32);
    ((x * unit).round() / unit).to_string()
}

/// The attributes of the plots as columns behind those of a table.
struct AttributeColumns<'a> {
    outcome: &'a SeasonOutcome,
    names: Vec<&'a str>,
}

impl<'a> AttributeColumns<'a> {
    /// In the order in which they first appear.
    fn of(outcome: &'a SeasonOutcome) -> AttributeColumns<'a> {
        let mut names = Vec::new();
        for (name, _) in outcome.attributes.iter().flatten() {
            if !names.contains(&name.as_str()) {
                names.push(name.as_str());
            }
        }
        AttributeColumns { outcome, names }
    }

    /// Their headings; one with the name of a column of the table gets another one.
    fn header(&self, own: &[String]) -> Vec<String> {
        let mut header = own.to_vec();
        for &name in &self.names {
            let mut name = name.to_owned();
            while header.contains(&name) {
                name += "_of_plot";
            }
            header.push(name);
        }
        header
    }

    fn values(&self, plot: &str) -> impl Iterator<Item = String> {
        let index = self.outcome.plots.iter().position(|name| name == plot);
        let all = index.and_then(|k| self.outcome.attributes.get(k));
        self.names.iter().map(move |&name| {
            let value = all.and_then(|all| all.iter().find(|(own, _)| own == name));
            match value.map(|(_, value)| value) {
                None => String::new(),
                Some(Value::String(text)) => text.clone(),
                Some(other) => other.to_string(),
            }
        })
    }
}

fn flights(path: &Path, outcome: &SeasonOutcome) -> Result<(), Error> {
    Ok(output::write(path, true, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record([
            "date",
            "day",
            "project",
            "gsd_m",
            "frame",
            "tied_to",
            "ties",
            "shift_east_m",
            "shift_north_m",
            "scale",
            "rotation_rad",
            "stretch",
            "stretch_45",
            "scatter_m",
            "deformation_m",
            "middle_sigma_m",
            "edge_sigma_m",
            "plants",
            "red_checks",
        ])?;
        for flight in &outcome.flights {
            let fit = flight.placement.as_ref().and_then(|placement| placement.fit);
            let frame = match (&flight.placement, fit) {
                (None, _) => "none",
                (Some(_), None) => "own",
                (Some(_), Some(_)) => "tied",
            };
            let tied_to = flight.placement.as_ref().map(|placement| placement.tied_to.join(" "));
            let transform = fit.map(|fit| fit.transform);
            csv.write_record([
                flight.date.clone(),
                flight.day.to_string(),
                flight.project.to_string_lossy().into_owned(),
                number(flight.gsd_m, 5),
                frame.to_owned(),
                tied_to.unwrap_or_default(),
                fit.map(|fit| fit.ties.to_string()).unwrap_or_default(),
                number(transform.map(|s| s.shift_m[0]), 4),
                number(transform.map(|s| s.shift_m[1]), 4),
                number(transform.map(|s| 1.0 + s.scale), 6),
                number(transform.map(|s| s.rotation), 6),
                number(transform.map(|s| s.stretch[0]), 6),
                number(transform.map(|s| s.stretch[1]), 6),
                number(fit.map(|fit| fit.scatter_m), 4),
                number(fit.map(|fit| fit.deformation_m), 4),
                number(fit.map(|fit| fit.middle_sigma_m), 4),
                number(fit.map(|fit| fit.edge_sigma_m), 4),
                flight.plants.map(|plants| plants.to_string()).unwrap_or_default(),
                flight.red_checks.to_string(),
            ])?;
        }
        csv.flush()
    })?)
}

fn colours(path: &Path, outcome: &SeasonOutcome) -> Result<(), Error> {
    Ok(output::write(path, true, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record([
            "date",
            "channel",
            "source",
            "compared_with",
            "places",
            "gain",
            "gain_sigma",
            "offset",
            "offset_sigma",
            "scatter",
        ])?;
        for flight in &outcome.flights {
            let Some(of) = &flight.colours else { continue };
            for (c, channel) in ["red", "green", "blue"].into_iter().enumerate() {
                let has_offset = of.offset_sigma[c] > 0.0;
                csv.write_record([
                    flight.date.clone(),
                    channel.to_owned(),
                    of.source.to_string(),
                    of.compared_with.join(" "),
                    of.places.to_string(),
                    significant(Some(of.gain[c])),
                    significant(Some(of.gain_sigma[c])),
                    significant(Some(of.offset[c]).filter(|_| has_offset)),
                    significant(Some(of.offset_sigma[c]).filter(|_| has_offset)),
                    significant(of.scatter[c]),
                ])?;
            }
        }
        csv.flush()
    })?)
}

fn traits(path: &Path, outcome: &SeasonOutcome, days: &[Day]) -> Result<(), Error> {
    Ok(output::write(path, true, |out| {
        let mut csv = CsvWriter::new(out);
        let attributes = AttributeColumns::of(outcome);
        let own = [
            "date",
            "day",
            "plot",
            "trait",
            "value",
            "unit",
            "low",
            "high",
            "fitted",
            "fitted_low",
            "fitted_high",
            "outlier",
        ];
        csv.write_record(attributes.header(&own.map(str::to_owned)))?;
        let all = known_traits();
        for day in days {
            for plot in &outcome.plots {
                let Some(traits) = day.traits.get(plot) else { continue };
                for of in &all {
                    let Some(value) = of.value(traits) else { continue };
                    let season = outcome.traits.iter().find(|season| season.name == of.name);
                    let sd = of.standard_deviation(traits);
                    let half = match season {
                        Some(season) => season.half_interval_with(sd),
                        None => sd.map(|sd| NORMAL_95 * sd),
                    };
                    let curve = season
                        .and_then(|season| season.plots.iter().find(|series| series.plot == *plot))
                        .and_then(|series| series.curve.as_ref());
                    let fitted = curve.map(|curve| {
                        let [value, sigma] = curve.at(day.day);
                        [value, value - curve.t95 * sigma, value + curve.t95 * sigma]
                    });
                    let is_outlier = outcome
                        .outliers
                        .iter()
                        .any(|o| o.plot == *plot && o.name == of.name && o.date == day.date);
                    let own = [
                        day.date.clone(),
                        day.day.to_string(),
                        plot.clone(),
                        of.name.to_string(),
                        significant(Some(value)),
                        of.unit.to_owned(),
                        significant(half.map(|half| of.within_range(value - half))),
                        significant(half.map(|half| of.within_range(value + half))),
                        significant(fitted.map(|f| f[0])),
                        significant(fitted.map(|f| of.within_range(f[1]))),
                        significant(fitted.map(|f| of.within_range(f[2]))),
                        season.map(|_| u8::from(is_outlier).to_string()).unwrap_or_default(),
                    ];
                    csv.write_record(own.into_iter().chain(attributes.values(plot)))?;
                }
            }
        }
        csv.flush()
    })?)
}

fn plants(path: &Path, days: &[Day], found: &Found) -> Result<(), Error> {
    Ok(output::write(path, true, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record([
            "plant",
            "plot",
            "date",
            "day",
            "easting_m",
            "northing_m",
            "place",
            "confidence",
            "same_probability",
            "new_probability",
            "lost_probability",
        ])?;
        for (number_of, track) in found.tracks.tracks.iter().enumerate() {
            let (first, last) = (track.first(), track.last());
            for (k, place) in track.seen.iter().enumerate() {
                let Some((place, plants)) = place.zip(days[k].plants.as_ref()) else { continue };
                let plant = &plants[place];
                csv.write_record([
                    (number_of + 1).to_string(),
                    plant.plot.clone(),
                    days[k].date.clone(),
                    days[k].day.to_string(),
                    format!("{:.4}", plant.at_m[0]),
                    format!("{:.4}", plant.at_m[1]),
                    (place + 1).to_string(),
                    number(plant.confidence, 4),
                    number(track.same_probability[k], 4),
                    number(track.new_probability.filter(|_| first == Some(k)), 4),
                    number(track.lost_probability.filter(|_| last == Some(k)), 4),
                ])?;
            }
        }
        csv.flush()
    })?)
}

fn growth(path: &Path, outcome: &SeasonOutcome) -> Result<(), Error> {
    Ok(output::write(path, true, |out| {
        let mut csv = CsvWriter::new(out);
        let mut header: Vec<String> =
            ["plot", "trait", "unit", "model", "dates", "status", "scatter"]
                .map(str::to_owned)
                .to_vec();
        for name in ["final", "rate_per_day", "half_day", "onset_day"] {
            header.extend(["", "_sigma", "_low", "_high"].map(|end| format!("{name}{end}")));
        }
        let attributes = AttributeColumns::of(outcome);
        csv.write_record(attributes.header(&header))?;
        for of in &outcome.traits {
            for series in &of.plots {
                let status = match (&series.curve, series.untold) {
                    (Some(_), _) => "fitted".to_owned(),
                    (None, untold) => untold.map(|why| why.to_string()).unwrap_or_default(),
                };
                let mut row = vec![
                    series.plot.clone(),
                    of.name.clone(),
                    of.unit.clone(),
                    of.model.to_string(),
                    series.samples.len().to_string(),
                    status,
                    significant(of.scatter),
                ];
                let pick: [fn(&rowgram_plants::problems::growth_curve::GrowthCurve) -> Estimate;
                    4] = [|c| c.final_value, |c| c.rate_per_day, |c| c.half_day, |c| c.onset_day];
                for of in pick {
                    let estimate = series.curve.as_ref().map(of);
                    row.extend(
                        [
                            estimate.map(|e| e.value),
                            estimate.map(|e| e.sigma),
                            estimate.map(|e| e.low),
                            estimate.map(|e| e.high),
                        ]
                        .map(significant),
                    );
                }
                row.extend(attributes.values(&series.plot));
                csv.write_record(&row)?;
            }
        }
        csv.flush()
    })?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attributes_are_columns_of_their_plots() {
        let attribute = |name: &str, value: &str| (name.to_owned(), Value::from(value));
        let outcome = SeasonOutcome {
            name: String::new(),
            from_sowing: false,
            flights: Vec::new(),
            plots: vec!["A".to_owned(), "B".to_owned()],
            outlines_m: Vec::new(),
            attributes: vec![
                vec![attribute("genotype", "B73")],
                vec![attribute("unit", "5"), attribute("genotype", "W22")],
            ],
            traits: Vec::new(),
            emergence: Vec::new(),
            tracks: 0,
            steps: Vec::new(),
            outliers: Vec::new(),
            diagnostics: Vec::new(),
        };
        let columns = AttributeColumns::of(&outcome);
        let header = columns.header(&["plot".to_owned(), "unit".to_owned()]);
        assert_eq!(header, ["plot", "unit", "genotype", "unit_of_plot"]);
        let values = |plot: &str| columns.values(plot).collect::<Vec<_>>();
        assert_eq!(values("A"), ["B73", ""]);
        assert_eq!(values("B"), ["W22", "5"]);
        assert_eq!(values("C"), ["", ""]);
    }
}
