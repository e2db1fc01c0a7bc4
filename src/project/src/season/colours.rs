//! One scale of colours for all dates: what the linear light of a date's map is multiplied by, channel by channel.
//!
//! ```text
//! y = g x + o        x linear light of the map of a date, y light in the scale of the season
//! ```
//!
//! Panels of known reflectance `r` give `g` (and `o`, from three panels on, where it is significant), by least squares of `(g x + o) / r - 1`;
//! the scale of the season is then that of reflectance. A date without panels is compared with the dates nearest in time that have a scale, over
//! squares of ground without leaf on both: `log g` is a robust mean (Tukey's biweight) of the differences of `log x`, by brightness and colour as
//! photos of a mosaic are compared ([`rowgram_survey::problems::radiometry`]). There only the gain is estimated, as
//! soil that differs in both has a slope below 1, which would pass for an offset. Without any panel the first flight gives the scale.
//!
//! Reference: G. M. Smith and E. J. Milton, *The use of the empirical line method to calibrate remotely sensed data to
//! reflectance*, Int. J. Remote Sens. 20, 1999; D. Yuan and C. D. Elvidge, *Comparison of relative radiometric normalization
//! techniques*, ISPRS J. 51, 1996.

use super::{SeasonFile, register::DateMap};
use crate::record::{Key, Store};
use bare_ground::Ground;
use panels::Measurement;
use rowgram_base::{
    error::Error,
    monitor::{Counter, Diagnostic, Monitor},
};
use rowgram_optim::robust::median_and_sigma;
use rowgram_plants::phenotype::plot_scatter::{PARTS, PlotParts, jackknife};
use rowgram_raster::{polygon::Polygon, srgb::LightScale};
use rowgram_survey::problems::map_transform::MapTransform;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};
use std::{f64::consts::FRAC_1_SQRT_2, path::PathBuf};

mod bare_ground;
mod panels;

/// Where the scale of the colours of dates comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ColourScale {
    /// From panels where there are any, else from ground without leaf.
    Auto,
    /// From ground without leaf.
    Ground,
    /// Colours stay as they are.
    Off,
}

rowgram_base::choices!(ColourScale: Auto, Ground, Off);

/// Where the colours of a date have their scale from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ColourSource {
    /// Panels of known reflectance.
    Panels,
    /// Ground without leaf that other dates show, too.
    Ground,
    /// The others are compared with it.
    Reference,
}

rowgram_base::choices!(ColourSource: Panels, Ground, Reference);

/// The scale of the colours of a date.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DateColours {
    /// Where it comes from.
    pub source: ColourSource,
    /// Dates that it was compared with.
    pub compared_with: Vec<String>,
    /// Panels, or squares of ground.
    pub places: usize,
    /// What linear light is multiplied by: red, green, blue.
    pub gain: [f64; 3],
    /// Standard deviations of these.
    pub gain_sigma: [f64; 3],
    /// What is added then.
    pub offset: [f64; 3],
    /// Standard deviations of these; 0 where none was estimated.
    pub offset_sigma: [f64; 3],
    /// How far one place is off the scale: standard deviation, as a share of its light. `None` where there is no more than one.
    pub scatter: [Option<f64>; 3],
}

impl DateColours {
    const REFERENCE: DateColours = DateColours {
        source: ColourSource::Reference,
        compared_with: Vec::new(),
        places: 0,
        gain: [1.0; 3],
        gain_sigma: [0.0; 3],
        offset: [0.0; 3],
        offset_sigma: [0.0; 3],
        scatter: [None; 3],
    };

    fn scale(&self) -> LightScale {
        LightScale { gain: self.gain, offset: self.offset }
    }
}

/// A map that has its place in the frame of the season.
pub(super) struct PlacedMap<'a> {
    pub(super) map: &'a DateMap,
    pub(super) transform: MapTransform,
    /// Its own panels, drawn on its own map.
    pub(super) panels: Option<PathBuf>,
    /// Whether its frame is its own.
    pub(super) is_own: bool,
}

/// Panels that are off their common line by more than this share of their reflectance (standard deviation) are not where they are drawn, or not
/// what they are said to be: photos of a mosaic agree to about .02 (docs/season.md), polygons beside their panels gave .84 (third date of `rowgram synth season --preset tiny
/// --seed 3 --light-spread 0.2 --cast-spread 0.1 --panels 0.5`). Assumed between the two.
const MAX_SCATTER: f64 = 0.2;
/// Scaled dates that another one is compared with.
const NEIGHBOURS: usize = 2;
/// Squares of ground that two dates have to share: from fewer a standard deviation of 15 % of one of them, as of moist patches, leaves
/// more than 2 %.
const MIN_GROUND: usize = 50;

/// Whether the panels of a season can be used, as far as that shows before there are maps.
///
/// # Errors
/// A file that cannot be read, and a panel without reflectances.
pub(super) fn check_panels(file: &SeasonFile) -> Result<(), Error> {
    if file.options.colours != ColourScale::Auto {
        return Ok(());
    }
    let of_flights = file.flights.iter().filter_map(|flight| flight.panels.as_ref());
    let own = of_flights.map(|path| file.root().join(path));
    own.chain(file.panels.clone()).try_for_each(|path| panels::check(&path))
}

/// The scale of each map; `None` for one that shares too little with the others.
///
/// # Errors
/// Panels that cannot be understood, maps that cannot be read.
pub(super) fn scale(
    file: &SeasonFile,
    maps: &[PlacedMap<'_>],
    store: &Store,
    monitor: &mut dyn Monitor,
) -> Result<Vec<Option<DateColours>>, Error> {
    let mut found: Vec<Option<DateColours>> = vec![None; maps.len()];
    if file.options.colours == ColourScale::Off || maps.is_empty() {
        return Ok(found);
    }
    let mut usable = vec![true; maps.len()];
    for (of, usable) in maps.iter().zip(&mut usable) {
        *usable = of.map.is_plain_rgb()?;
        if !*usable {
            let message =
                "its map has other bands than red, green and blue: its colours stay as they are";
            monitor.diagnostic(&Diagnostic::info("season-colours-kept", &of.map.date, message));
        }
    }
    if file.options.colours == ColourScale::Auto {
        for ((of, found), _) in
            maps.iter().zip(&mut found).zip(&usable).filter(|(_, usable)| **usable)
        {
            *found = by_panels(file, of, monitor)?;
        }
    }
    if found.iter().all(Option::is_none) {
        let own = (0..maps.len()).find(|&k| usable[k] && maps[k].is_own);
        let Some(first) = own.or_else(|| (0..maps.len()).find(|&k| usable[k])) else {
            return Ok(found);
        };
        found[first] = Some(DateColours::REFERENCE);
    }
    let block_m = bare_ground::block_m(maps[0].map.gsd_m);
    let waiting: Vec<usize> =
        (0..maps.len()).filter(|&k| usable[k] && found[k].is_none()).collect();
    if waiting.is_empty() {
        return Ok(found);
    }
    let mut ground = Vec::new();
    {
        let counter = Counter::new(monitor, "ground without leaf", maps.len(), "flights");
        for (of, usable) in maps.iter().zip(&usable) {
            ground.push(if *usable {
                stored_ground(of, block_m, store)?
            } else {
                Ground::default()
            });
            counter.tick();
        }
    }
    let mut has_failed = vec![false; maps.len()];
    loop {
        let scaled: Vec<usize> = (0..maps.len()).filter(|&k| found[k].is_some()).collect();
        let apart = |a: usize, b: usize| (maps[a].map.day - maps[b].map.day).abs();
        let nearest =
            |k: usize| scaled.iter().map(|&other| apart(k, other)).fold(f64::INFINITY, f64::min);
        let waiting = waiting.iter().copied().filter(|&k| found[k].is_none() && !has_failed[k]);
        let Some(next) = waiting.min_by(|&a, &b| nearest(a).total_cmp(&nearest(b)).then(a.cmp(&b)))
        else {
            break;
        };
        let mut near = scaled.clone();
        near.sort_by(|&a, &b| apart(a, next).total_cmp(&apart(b, next)).then(a.cmp(&b)));
        near.truncate(NEIGHBOURS);
        let others: Vec<(&str, &Ground, &DateColours)> = near
            .iter()
            .filter_map(|&k| Some((maps[k].map.date.as_str(), &ground[k], found[k].as_ref()?)))
            .collect();
        match by_ground(&ground[next], &others) {
            Ok(colours) => found[next] = Some(colours),
            Err(shared) => {
                has_failed[next] = true;
                monitor.diagnostic(
                    &Diagnostic::warning(
                        "season-colours-unscaled",
                        &maps[next].map.date,
                        format!(
                            "its map shares {shared} squares of ground without leaf with the flights before and after, expected {MIN_GROUND}: \
                             its colours are not comparable with those of other dates"
                        ),
                    )
                    .with_remedy("lay out panels of known reflectance and name their polygons as panels in the list of flights"),
                );
            }
        }
    }
    Ok(found)
}

/// The scale that the panels of a date give; `None` where it shows none.
fn by_panels(
    file: &SeasonFile,
    of: &PlacedMap<'_>,
    monitor: &mut dyn Monitor,
) -> Result<Option<DateColours>, Error> {
    let Some((path, is_own)) = of
        .panels
        .as_deref()
        .map(|path| (path, true))
        .or(file.panels.as_deref().map(|path| (path, false)))
    else {
        return Ok(None);
    };
    let measured = panels::measure(path, of, is_own, monitor)?;
    let channels = [0, 1, 2].map(|channel| {
        let light: Vec<(Measurement, f64)> = measured
            .iter()
            .map(|panel| (panel.light[channel], panel.reflectance[channel]))
            .collect();
        panels::fit(&light)
    });
    let [Some(red), Some(green), Some(blue)] = channels else { return Ok(None) };
    let all = [red, green, blue];
    if let Some(scatter) = all.iter().filter_map(|of| of.scatter).find(|of| *of > MAX_SCATTER) {
        let message = format!(
            "the panels of {} contradict each other by {:.0} %, expected at most {:.0} %: they are left out",
            path.display(),
            100.0 * scatter,
            100.0 * MAX_SCATTER
        );
        monitor.diagnostic(
            &Diagnostic::warning("season-panel-unusable", &of.map.date, message).with_remedy(
                "see that the polygons lie on the panels on the map of this date, and their reflectances; draw them on that map and name them below its flight",
            ),
        );
        return Ok(None);
    }
    Ok(Some(DateColours {
        source: ColourSource::Panels,
        compared_with: Vec::new(),
        places: measured.len(),
        gain: all.map(|of| rounded(of.gain)),
        gain_sigma: all.map(|of| of.gain_sigma),
        offset: all.map(|of| rounded(of.offset)),
        offset_sigma: all.map(|of| of.offset_sigma),
        scatter: all.map(|of| of.scatter),
    }))
}

/// A number that the last bits of its estimate do not change.
fn rounded(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}

fn stored_ground(of: &PlacedMap<'_>, block_m: f64, store: &Store) -> Result<Ground, Error> {
    let transform = serde_json::to_string(&of.transform).unwrap_or_default();
    let key = Key::begin().text(&of.map.key).text(&transform).text(&block_m.to_string()).finish();
    let name = format!("ground-{}", of.map.date);
    if let Some(stored) = store.load(&name, key).filter(|_| !of.map.key.is_empty()) {
        return Ok(stored);
    }
    let found = bare_ground::sample(of.map, &of.transform, block_m)?;
    store.save(&name, key, &found)?;
    Ok(found)
}

/// The scale by ground that scaled dates show, too; else how many squares are shared.
fn by_ground(own: &Ground, others: &[(&str, &Ground, &DateColours)]) -> Result<DateColours, usize> {
    let mut places = Vec::new();
    let mut compared_with = Vec::new();
    let mut inherited = [0.0f64; 3];
    for (date, ground, colours) in others {
        let shared = own.shared(ground);
        if shared.is_empty() {
            continue;
        }
        let scale = colours.scale();
        compared_with.push((*date).to_owned());
        for channel in 0..3 {
            let sigma = colours.gain_sigma[channel] / colours.gain[channel];
            inherited[channel] = inherited[channel].max(sigma);
        }
        places.extend(shared.into_iter().filter_map(|(at, from, to)| {
            let to = scale.apply(to);
            let logs = [0, 1, 2].map(|c| to[c].ln() - from[c].ln());
            logs.iter().all(|log| log.is_finite()).then_some((at, logs))
        }));
    }
    if places.len() < MIN_GROUND {
        return Err(places.len());
    }
    let ring = places.iter().map(|(at, _)| *at).collect();
    let parts = PlotParts::of(&Polygon { rings: vec![ring] });
    let part_of: Vec<usize> = places.iter().map(|(at, _)| parts.at(*at)).collect();
    let mut has_data = [false; PARTS];
    part_of.iter().for_each(|&part| has_data[part] = true);
    // Brightness and two colours, whose errors are nearly independent: soil differs in brightness much more than in colour.
    let combination = |row: &[f64; 3]| -> Option<[f64; 2]> {
        let without = |left_out: Option<usize>| {
            let retained = places.iter().zip(&part_of).filter(|(_, part)| Some(**part) != left_out);
            let dot = |logs: &[f64; 3]| (0..3).map(|c| row[c] * logs[c]).sum::<f64>();
            biweight_mean(&retained.map(|((_, logs), _)| dot(logs)).collect::<Vec<_>>())
        };
        Some([without(None)?, jackknife(|part| has_data[part], |part| without(Some(part)))?])
    };
    let [Some(light), Some(red_blue), Some(green)] = COMBINATIONS.each_ref().map(combination)
    else {
        return Err(places.len());
    };
    let found = [light, red_blue, green];
    let sum = |f: &dyn Fn(usize) -> f64| (0..3).map(f).sum::<f64>();
    let gain = [0, 1, 2].map(|c| rounded(sum(&|k| COMBINATIONS[k][c] * found[k][0]).exp()));
    let gain_sigma = [0, 1, 2].map(|c| {
        let own = sum(&|k| (COMBINATIONS[k][c] * found[k][1]).powi(2)).sqrt();
        gain[c] * own.hypot(inherited[c])
    });
    let scatter = [0, 1, 2].map(|c| {
        let logs: Vec<f64> = places.iter().map(|(_, logs)| logs[c]).collect();
        median_and_sigma(&logs).map(|(_, sigma)| sigma)
    });
    Ok(DateColours {
        source: ColourSource::Ground,
        compared_with,
        places: places.len(),
        gain,
        gain_sigma,
        offset: [0.0; 3],
        offset_sigma: [0.0; 3],
        scatter,
    })
}

/// Orthonormal combinations of red, green and blue: brightness, red against blue, both against green.
const COMBINATIONS: [[f64; 3]; 3] = {
    const THIRD: f64 = 0.577_350_269_189_625_8;
    const SIXTH: f64 = 0.408_248_290_463_863;
    [[THIRD; 3], [FRAC_1_SQRT_2, 0.0, -FRAC_1_SQRT_2], [SIXTH, -2.0 * SIXTH, SIXTH]]
};

/// Tukey's biweight mean of numbers. What is far off, such as wet soil, has no weight,
/// as it is off in one direction.
fn biweight_mean(values: &[f64]) -> Option<f64> {
    /// 95 % as efficient as the mean where errors are normal.
    const REACH: f64 = 4.685;
    let (mut mean, sigma) = median_and_sigma(values)?;
    if sigma == 0.0 {
        return Some(mean);
    }
    for _ in 0..50 {
        let weight = |x: f64| {
            let r = (x - mean) / (REACH * sigma);
            (1.0 - r * r).max(0.0).powi(2)
        };
        let (sum, weights) =
            values.iter().fold((0.0, 0.0), |(s, w), &x| (s + weight(x) * x, w + weight(x)));
        let step = sum / weights - mean;
        mean += step;
        if step.abs() < 1e-10 {
            break;
        }
    }
    Some(mean)
}

/// The quantile of Student's t beyond which an estimate with so many degrees of freedom is significant at 1 %.
fn significant(degrees_of_freedom: usize) -> f64 {
    StudentsT::new(0.0, 1.0, degrees_of_freedom as f64)
        .map_or(f64::INFINITY, |t| t.inverse_cdf(0.995))
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    fn ground(light: impl Fn(i32, i32) -> [f64; 3]) -> Ground {
        let cells = (0..20).flat_map(|i| (0..20).map(move |j| [i, j]));
        Ground { block_m: 0.3, squares: cells.map(|at| (at, light(at[0], at[1]))).collect() }
    }

    #[test]
    fn ground_gives_the_gain_of_each_channel_with_its_standard_deviation() {
        // Soil in patches, an even scatter of 5 %, and a fifth of squares that changed.
        let noise = |i: i32, j: i32| 1.0 + 0.05 * (f64::from(i * 7919 + j * 104_729).sin());
        let soil = |i: i32, _: i32| 0.2 + 0.004 * f64::from(i);
        let reference = ground(|i, j| [soil(i, j), 0.8 * soil(i, j), 0.6 * soil(i, j)]);
        let truth = [0.8, 1.25, 1.1];
        let own = ground(|i, j| {
            let wet = if (i + 2 * j) % 5 == 0 { 0.5 } else { 1.0 };
            let light = soil(i, j) * noise(i, j) * wet;
            [light / truth[0], 0.8 * light / truth[1], 0.6 * light / truth[2]]
        });
        let found = by_ground(&own, &[("a", &reference, &DateColours::REFERENCE)]).unwrap();
        for c in 0..3 {
            let error = found.gain[c] / truth[c] - 1.0;
            assert!(error.abs() < 0.006, "{found:?}");
            let sigma = found.gain_sigma[c] / found.gain[c];
            assert!((0.0005..0.01).contains(&sigma), "{found:?}");
        }
        // The standard deviation of the date that it is compared with is inherited.
        let unsure = DateColours { gain_sigma: [0.03; 3], ..DateColours::REFERENCE };
        let found = by_ground(&own, &[("a", &reference, &unsure)]).unwrap();
        assert!(found.gain_sigma[0] / found.gain[0] > 0.03);
    }

    #[test]
    fn too_little_ground_gives_no_scale() {
        let reference = ground(|_, _| [0.2; 3]);
        let mut own = reference.clone();
        own.squares.truncate(MIN_GROUND - 1);
        let found = by_ground(&own, &[("a", &reference, &DateColours::REFERENCE)]);
        assert_eq!(found, Err(MIN_GROUND - 1));
    }

    #[test]
    fn the_biweight_mean_bears_outliers() {
        let mut values: Vec<f64> = (0..100).map(|k| 1.0 + 0.001 * f64::from(k - 50)).collect();
        values.extend([50.0; 20]);
        assert_abs_diff_eq!(biweight_mean(&values).unwrap(), 1.0, epsilon = 1e-3);
        assert_eq!(biweight_mean(&[2.0, 2.0, 2.0, 7.0]), Some(2.0));
        assert_eq!(biweight_mean(&[]), None);
    }
}
