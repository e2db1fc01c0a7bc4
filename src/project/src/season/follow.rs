//! Plots and plants through the dates: series of traits, their growth curves, outliers, emergence, tracks.

use super::{Placement, SeasonFlight};
use crate::{Project, Stage};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::csv_table::CsvTable;
use rowgram_plants::{
    phenotype::{
        plant_tracks::{self, Sighting, Tracks},
        stand::NORMAL_95,
        traits::{PlotTraits, known_traits},
    },
    problems::growth_curve::{self, Estimate, GrowthCurve, GrowthModel, Sample, Untold},
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The trait whose growth says when a plot emerged.
const PLANTS: &str = "plants";

/// A plant of one date.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct DayPlant {
    /// In the frame of the season, metres.
    pub(super) at_m: [f64; 2],
    pub(super) plot: String,
    pub(super) confidence: Option<f64>,
}

/// What a date says.
pub(super) struct Day {
    pub(super) date: String,
    pub(super) day: f64,
    pub(super) plants: Option<Vec<DayPlant>>,
    pub(super) traits: BTreeMap<String, PlotTraits>,
    /// The plots in the order of their source.
    plots: Vec<String>,
}

impl Day {
    /// Plants and traits of a flight.
    ///
    /// # Errors
    /// Tables that cannot be read.
    pub(super) fn read(
        project: &Project,
        flight: &SeasonFlight,
        placement: &Placement,
        traits: &[PlotTraits],
    ) -> Result<Day, Error> {
        let table = project.finished(Stage::Plots, "plants.csv");
        let plants = match table.map(|path| CsvTable::read(&path)).transpose()? {
            Some(table) => table.pairs("easting_m", "northing_m").map(|at| {
                let plots = table.texts("plot").unwrap_or_else(|| vec![""; at.len()]);
                let confidence = table.numbers("confidence");
                let plant = |k: usize| DayPlant {
                    at_m: placement.transform.apply(at[k]),
                    plot: plots[k].to_owned(),
                    confidence: confidence.as_ref().map(|all| all[k]).filter(|c| c.is_finite()),
                };
                (0..at.len()).map(plant).collect()
            }),
            None => None,
        };
        Ok(Day {
            date: flight.date.clone(),
            day: flight.day,
            plants,
            plots: traits.iter().map(|plot| plot.plot.clone()).collect(),
            traits: traits.iter().map(|plot| (plot.plot.clone(), plot.clone())).collect(),
        })
    }
}

/// A trait of one plot through the season.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlotSeries {
    /// The plot.
    pub plot: String,
    /// The values that there are.
    pub samples: Vec<Sample>,
    /// Its growth curve.
    pub curve: Option<GrowthCurve>,
    /// Why there is none.
    pub untold: Option<Untold>,
}

/// A trait of all plots through the season.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SeasonTrait {
    /// Its name.
    pub name: String,
    /// Its unit after UCUM.
    pub unit: String,
    /// Form of the curves.
    pub model: GrowthModel,
    /// Standard deviation of a value about its curve, in the unit of the trait.
    pub scatter: Option<f64>,
    /// Degrees of freedom of that.
    pub degrees_of_freedom: usize,
    /// Half the width of the 95 % interval of a value by its scatter alone: that times the quantile of Student's t.
    pub half_interval: Option<f64>,
    /// The plots.
    pub plots: Vec<PlotSeries>,
}

impl SeasonTrait {
    /// Half the width of the 95 % interval of a value of which its flight gives this standard deviation: scatter about the curve and what
    /// the flight does not know, as far as each is known.
    pub(super) fn half_interval_with(&self, flight_sd: Option<f64>) -> Option<f64> {
        match (self.half_interval, self.scatter.filter(|&scatter| scatter > 0.0), flight_sd) {
            (Some(half), Some(scatter), Some(sd)) => Some(half * (sd / scatter).hypot(1.0)),
            (half, _, None) => half,
            (_, _, Some(sd)) => Some(NORMAL_95 * sd),
        }
    }
}

/// When a plot emerged: the day on which half of its final number of plants was there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EmergenceDate {
    /// The plot.
    pub plot: String,
    /// Day, with its interval.
    pub day: Option<Estimate>,
    /// Why it cannot be told.
    pub untold: Option<Untold>,
}

/// A value that contradicts the growth of its plot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Outlier {
    /// The plot.
    pub plot: String,
    /// The trait.
    pub name: String,
    /// The date.
    pub date: String,
    /// The value.
    pub value: f64,
    /// What the other dates of the plot say.
    pub expected: f64,
}

/// All of it.
pub(super) struct Found {
    pub(super) plots: Vec<String>,
    pub(super) traits: Vec<SeasonTrait>,
    pub(super) emergence: Vec<EmergenceDate>,
    pub(super) outliers: Vec<Outlier>,
    pub(super) tracks: Tracks,
}

/// Series, curves and tracks of all dates.
pub(super) fn follow(
    days: &[Day],
    plots: Option<Vec<String>>,
    traits: &[String],
    model: Option<GrowthModel>,
) -> Found {
    let plots = plots.unwrap_or_else(|| {
        let mut names: Vec<String> = Vec::new();
        for name in days.iter().flat_map(|day| &day.plots) {
            if !names.contains(name) {
                names.push(name.clone());
            }
        }
        names
    });
    let mut outliers = Vec::new();
    let fitted: Vec<SeasonTrait> = traits
        .iter()
        .filter_map(|name| {
            let of = known_traits().into_iter().find(|of| of.name == *name)?;
            let series: Vec<Vec<Sample>> = plots
                .iter()
                .map(|plot| {
                    let sample = |day: &Day| {
                        let value = of.value(day.traits.get(plot)?)?;
                        value.is_finite().then_some(Sample { day: day.day, value })
                    };
                    days.iter().filter_map(sample).collect()
                })
                .collect();
            let fits = growth_curve::fit(&series, model);
            let mut of_plots = Vec::new();
            for ((plot, samples), curve) in plots.iter().zip(series).zip(fits.curves) {
                if let Ok(curve) = &curve {
                    outliers.extend(curve.outliers.iter().map(|&k| Outlier {
                        plot: plot.clone(),
                        name: name.clone(),
                        date: date_of(days, samples[k].day),
                        value: samples[k].value,
                        expected: curve.at(samples[k].day)[0],
                    }));
                }
                let untold = curve.as_ref().err().copied();
                let plot = plot.clone();
                of_plots.push(PlotSeries { plot, samples, curve: curve.ok(), untold });
            }
            let t95 = of_plots.iter().find_map(|plot| plot.curve.as_ref()).map(|curve| curve.t95);
            Some(SeasonTrait {
                name: name.clone(),
                unit: of.unit.to_owned(),
                model: fits.model,
                scatter: fits.scatter,
                degrees_of_freedom: fits.degrees_of_freedom,
                half_interval: fits.scatter.zip(t95).map(|(scatter, t)| scatter * t),
                plots: of_plots,
            })
        })
        .collect();
    let emergence = fitted.iter().find(|of| of.name == PLANTS).map(|of| {
        let date = |plot: &PlotSeries| EmergenceDate {
            plot: plot.plot.clone(),
            day: plot.curve.as_ref().map(|curve| curve.half_day),
            untold: plot.untold,
        };
        of.plots.iter().map(date).collect()
    });
    let sightings: Vec<Vec<Sighting>> = days
        .iter()
        .map(|day| {
            let sighting = |plant: &DayPlant| Sighting {
                at_m: plant.at_m,
                plot: plots.iter().position(|name| *name == plant.plot),
            };
            day.plants.iter().flatten().map(sighting).collect()
        })
        .collect();
    let tracks = plant_tracks::follow(&sightings, plots.len());
    Found { plots, traits: fitted, emergence: emergence.unwrap_or_default(), outliers, tracks }
}

fn date_of(days: &[Day], day: f64) -> String {
    let found = days.iter().find(|other| other.day == day);
    found.map_or_else(String::new, |found| found.date.clone())
}

/// Says which values contradict the growth of their plots.
pub(super) fn report_outliers(outliers: &[Outlier], monitor: &mut dyn Monitor) {
    for outlier in outliers {
        let Outlier { plot, name, date, value, expected } = outlier;
        let message = format!(
            "{name} on {date} is {value:.4}, where the other dates of the plot say {expected:.4}; the curve is fitted without it"
        );
        monitor.diagnostic(
            &Diagnostic::warning("season-outlier", plot, message)
                .with_remedy("look at the plot on the map of that date"),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_base::monitor::Collector;

    fn day(day: f64, values: &[(&str, f64, f64)]) -> Day {
        let traits = values.iter().map(|&(plot, cover, plants)| {
            let traits = PlotTraits {
                plot: plot.to_owned(),
                canopy_cover: Some(cover),
                plants: Some(plants),
                ..PlotTraits::default()
            };
            (plot.to_owned(), traits)
        });
        Day {
            date: format!("2020-05-{day:02.0}"),
            day,
            plants: None,
            plots: values.iter().map(|value| value.0.to_owned()).collect(),
            traits: traits.collect(),
        }
    }

    #[test]
    fn plots_are_followed_and_what_contradicts_is_named() {
        let logistic = |t: f64, k: f64, r: f64, h: f64| k / (1.0 + (-r * (t - h)).exp());
        let days: Vec<Day> = [6.0, 8.0, 10.0, 13.0, 17.0, 22.0, 28.0]
            .into_iter()
            .map(|t| {
                let wrong = if t == 17.0 { 0.3 } else { 0.0 };
                let wiggle = |k: f64| 0.004 * (7.0 * t + k).sin();
                let plot = |late: f64| {
                    (
                        logistic(t, 0.6, 0.4, 15.0 + late) + wiggle(late),
                        logistic(t, 50.0, 1.5, 8.0 + late).round(),
                    )
                };
                let values: Vec<(&str, f64, f64)> = ["a", "b", "c", "d", "e", "f"]
                    .into_iter()
                    .enumerate()
                    .map(|(k, name)| {
                        let (cover, plants) = plot(0.5 * k as f64);
                        (name, cover + if name == "b" { wrong } else { 0.0 }, plants)
                    })
                    .collect();
                day(t, &values)
            })
            .collect();
        let traits = ["canopy_cover".to_owned(), "plants".to_owned()];
        let found = follow(&days, None, &traits, None);
        assert_eq!(found.plots.len(), 6);
        // Whole plants on a few dates leave a third of a day open.
        for (found, truth) in found.emergence.iter().zip([8.0, 8.5, 9.0, 9.5, 10.0, 10.5]) {
            let day = found.day.unwrap();
            assert!((day.value - truth).abs() < 0.4, "{truth}: {day:?}");
        }
        let [outlier] = &found.outliers[..] else { panic!("{:?}", found.outliers) };
        assert_eq!((outlier.plot.as_str(), outlier.date.as_str()), ("b", "2020-05-17"));
        let mut collector = Collector::default();
        report_outliers(&found.outliers, &mut collector);
        assert!(collector.diagnostics[0].message.contains("canopy_cover on 2020-05-17"));
    }
}
