//! Panels of known reflectance: polygons with the columns `red`, `green`, `blue`.

use super::{PlacedMap, significant};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{
    geotiff::Reader,
    polygons::{self, Named},
};
use rowgram_optim::output::FileError;
use rowgram_plants::phenotype::plot_scatter::{PlotParts, ValueParts};
use rowgram_raster::{polygon::Polygon, srgb::linear_light, window::Window};
use std::path::Path;

/// A number with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Measurement {
    pub(super) value: f64,
    pub(super) sigma: f64,
}

/// A panel on the map of a date.
pub(super) struct MeasuredPanel {
    /// Its linear light there, red, green, blue.
    pub(super) light: [Measurement; 3],
    /// Its reflectance.
    pub(super) reflectance: [f64; 3],
}

/// The columns of the polygons.
const COLUMNS: [&str; 3] = ["red", "green", "blue"];
/// The least pixels of a panel.
const MIN_PIXELS: u64 = 20;
/// The byte from which on a pixel may be saturated, and the share of such pixels that a panel can have.
const BRIGHT: u8 = 253;
const MAX_BRIGHT: f64 = 0.02;

/// Whether all panels of a file have reflectances.
///
/// # Errors
/// A file that cannot be read, and a panel without reflectances.
pub(super) fn check(path: &Path) -> Result<(), Error> {
    for panel in polygons::check(path, None)?.polygons {
        reflectance(path, &panel)?;
    }
    Ok(())
}

/// The panels of a file that the map of a date shows.
///
/// # Errors
/// A file that cannot be read, and a panel without reflectances.
pub(super) fn measure(
    path: &Path,
    of: &PlacedMap<'_>,
    is_own: bool,
    monitor: &mut dyn Monitor,
) -> Result<Vec<MeasuredPanel>, Error> {
    let mut found = Vec::new();
    let reader = Reader::open_with(&of.map.ortho, &of.map.reading)?;
    for panel in polygons::read(path, Some(&of.map.place))? {
        let reflectance = reflectance(path, &panel)?;
        // Pixels of this map are those of the frame of the season too, until the map is moved.
        let moved = |at: &[f64; 2]| {
            let place = of.transform.invert(of.map.place.map(*at));
            of.map.place.pixel(place).unwrap_or([f64::NAN; 2])
        };
        let rings = &panel.polygon.rings;
        let polygon = if is_own {
            panel.polygon.clone()
        } else {
            Polygon { rings: rings.iter().map(|ring| ring.iter().map(moved).collect()).collect() }
        };
        let unusable = match light(&reader, of.map.size, &polygon)? {
            Light::Known(light) => {
                found.push(MeasuredPanel { light, reflectance });
                continue;
            }
            Light::Outside => continue,
            Light::TooSmall(pixels) => format!("{pixels} pixels, expected {MIN_PIXELS}"),
            Light::Saturated(share) => {
                format!("{:.0} % of its pixels are saturated", 100.0 * share)
            }
        };
        monitor.diagnostic(
            &Diagnostic::warning(
                "season-panel-unusable",
                &of.map.date,
                format!("the panel {} of {} is left out: {unusable}", panel.name, path.display()),
            )
            .with_remedy(
                "take larger or darker panels, and draw their polygons within their edges",
            ),
        );
    }
    Ok(found)
}

fn reflectance(path: &Path, panel: &Named) -> Result<[f64; 3], FileError> {
    let of = |name: &str| {
        let value = panel.attributes.iter().find(|(own, _)| own.eq_ignore_ascii_case(name));
        let number = value.and_then(|(_, value)| {
            value.as_f64().or_else(|| value.as_str().and_then(|text| text.trim().parse().ok()))
        });
        number.filter(|r| *r > 0.0 && *r <= 1.0).ok_or_else(|| {
            let message = format!(
                "panel {}: expected the columns red, green and blue with its reflectances, greater than 0 and at most 1; {name} is {}",
                panel.name,
                value.map_or("missing".to_owned(), |(_, value)| value.to_string())
            );
            FileError::malformed(path, None, message)
        })
    };
    let [red, green, blue] = COLUMNS.map(of);
    Ok([red?, green?, blue?])
}

enum Light {
    Known([Measurement; 3]),
    Outside,
    TooSmall(u64),
    Saturated(f64),
}

fn light(
    reader: &Reader,
    (width, height): (usize, usize),
    polygon: &Polygon,
) -> Result<Light, FileError> {
    let runs = polygon.runs(width, height);
    let (Some((first, _)), Some((last, _))) = (runs.first(), runs.last()) else {
        return Ok(Light::Outside);
    };
    let columns = || runs.iter().map(|(_, run)| run);
    let left = columns().map(|run| run.start).min().unwrap_or(0);
    let right = columns().map(|run| run.end).max().unwrap_or(left);
    let window = Window { u: left, v: *first, width: right - left, height: last + 1 - first };
    let (rgb, gaps) = reader.read_rgb_and_gaps(window)?;
    let parts = PlotParts::of(polygon);
    let mut sums = [ValueParts::default(); 3];
    let mut bright = 0.0;
    for (v, run) in &runs {
        for u in run.clone() {
            let (column, row) = (u - left, v - first);
            if gaps.as_ref().is_some_and(|gaps| gaps[row * window.width + column]) {
                continue;
            }
            let pixel = rgb.get_pixel(column as u32, row as u32).0;
            bright += f64::from(u8::from(pixel.iter().any(|&value| value >= BRIGHT)));
            let part = parts.at([u as f64, *v as f64]);
            for (sum, value) in sums.iter_mut().zip(pixel) {
                sum.add(part, linear_light(f64::from(value)) as f32);
            }
        }
    }
    let pixels = sums[0].pixels();
    if pixels == 0 {
        return Ok(Light::Outside);
    }
    if pixels < MIN_PIXELS {
        return Ok(Light::TooSmall(pixels));
    }
    let share = bright / pixels as f64;
    if share > MAX_BRIGHT {
        return Ok(Light::Saturated(share));
    }
    let mean = |sum: &ValueParts| {
        let mean = sum.mean()?;
        Some(Measurement { value: mean.value, sigma: mean.sd? }).filter(|of| of.value > 0.0)
    };
    let [red, green, blue] = sums.each_ref().map(mean);
    Ok(match (red, green, blue) {
        (Some(red), Some(green), Some(blue)) => Light::Known([red, green, blue]),
        _ => Light::TooSmall(pixels),
    })
}

/// A line from light to reflectance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Line {
    pub(super) gain: f64,
    pub(super) gain_sigma: f64,
    pub(super) offset: f64,
    pub(super) offset_sigma: f64,
    /// Standard deviation of a panel, as a share of its reflectance.
    pub(super) scatter: Option<f64>,
}

/// Fits the line to light and reflectance of panels, by least squares of `(g x + o) / r - 1`; the offset only where it is significant.
pub(super) fn fit(panels: &[(Measurement, f64)]) -> Option<Line> {
    let n = panels.len();
    // a g + b o = 1 in each row.
    let rows: Vec<[f64; 2]> = panels.iter().map(|(x, r)| [x.value / r, 1.0 / r]).collect();
    let sum = |f: &dyn Fn(&[f64; 2]) -> f64| rows.iter().map(f).sum::<f64>();
    let (aa, ab, bb) = (sum(&|[a, _]| a * a), sum(&|[a, b]| a * b), sum(&|[_, b]| b * b));
    let (a1, b1) = (sum(&|[a, _]| *a), sum(&|[_, b]| *b));
    if n == 0 || aa == 0.0 {
        return None;
    }
    // What pixels of a panel scatter by is the least that is unknown of it.
    let of_pixels = panels.iter().map(|(x, _)| (x.sigma / x.value).powi(2)).sum::<f64>() / n as f64;
    let scatter = |gain: f64, offset: f64, unknowns: usize| {
        let squares = sum(&|[a, b]| (gain * a + offset * b - 1.0).powi(2));
        (n > unknowns).then(|| (squares / (n - unknowns) as f64).sqrt())
    };
    let sigma = |scatter: Option<f64>| scatter.unwrap_or(0.0).max(of_pixels.sqrt());
    let determinant = aa * bb - ab * ab;
    if n >= 3 && determinant > 1e-9 * aa * bb {
        let gain = (bb * a1 - ab * b1) / determinant;
        let offset = (aa * b1 - ab * a1) / determinant;
        let found = scatter(gain, offset, 2);
        let unit = sigma(found);
        let (gain_sigma, offset_sigma) =
            (unit * (bb / determinant).sqrt(), unit * (aa / determinant).sqrt());
        if gain > 0.0 && offset.abs() > significant(n - 2) * offset_sigma {
            return Some(Line { gain, gain_sigma, offset, offset_sigma, scatter: found });
        }
    }
    let gain = a1 / aa;
    let found = scatter(gain, 0.0, 1);
    let gain_sigma = sigma(found) / aa.sqrt();
    Some(Line { gain, gain_sigma, offset: 0.0, offset_sigma: 0.0, scatter: found })
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::{assert_abs_diff_eq, assert_relative_eq};
    use serde_json::json;

    fn panels(of: &[(f64, f64)]) -> Vec<(Measurement, f64)> {
        of.iter().map(|&(value, r)| (Measurement { value, sigma: 0.002 * value }, r)).collect()
    }

    #[test]
    fn one_panel_gives_a_gain_and_its_pixels_the_standard_deviation() {
        let line = fit(&panels(&[(0.4, 0.5)])).unwrap();
        assert_relative_eq!(line.gain, 1.25, epsilon = 1e-12);
        assert_relative_eq!(line.gain_sigma, 1.25 * 0.002, epsilon = 1e-9);
        assert_eq!((line.offset, line.scatter), (0.0, None));
        assert_eq!(fit(&[]), None);
    }

    #[test]
    fn an_offset_is_estimated_only_where_four_panels_show_it() {
        let [gain, offset] = [1.25, -0.02];
        let r = [0.05, 0.2, 0.4, 0.6];
        let errors = [1.002, 0.998, 1.001, 0.999];
        let of = |offset: f64| {
            let all: Vec<(f64, f64)> =
                r.iter().zip(errors).map(|(r, e)| (e * (r - offset) / gain, *r)).collect();
            fit(&panels(&all)).unwrap()
        };
        let with = of(offset);
        assert_abs_diff_eq!(with.offset, offset, epsilon = 1e-3);
        assert_relative_eq!(with.gain, gain, epsilon = 5e-3);
        assert!(with.offset_sigma > 0.0 && with.scatter.unwrap() < 0.01);
        let without = of(0.0);
        assert_eq!((without.offset, without.offset_sigma), (0.0, 0.0));
        assert_relative_eq!(without.gain, gain, epsilon = 2e-3);
        // Two panels leave nothing over to tell an offset from an error.
        let two = fit(&panels(&[(0.1, 0.1), (0.5, 0.4)])).unwrap();
        assert_eq!(two.offset, 0.0);
        assert!(two.scatter.unwrap() > 0.05 && two.gain_sigma > 0.02, "{two:?}");
    }

    #[test]
    fn reflectances_are_read_and_mistakes_named() {
        let panel = |red: serde_json::Value| Named {
            name: "grey".to_owned(),
            polygon: Polygon { rings: Vec::new() },
            leaves: None,
            attributes: vec![
                ("Red".to_owned(), red),
                ("green".to_owned(), json!("0.21")),
                ("blue".to_owned(), json!(0.2)),
            ],
        };
        let path = Path::new("panels.geojson");
        assert_eq!(reflectance(path, &panel(json!(0.22))).unwrap(), [0.22, 0.21, 0.2]);
        for wrong in [json!(22), json!(0), json!(null), json!("dark")] {
            let error = reflectance(path, &panel(wrong.clone())).unwrap_err().to_string();
            assert!(
                error.contains("panels.geojson") && error.contains("at most 1; red is"),
                "{error}"
            );
        }
        let mut without = panel(json!(0.2));
        without.attributes.remove(0);
        assert!(reflectance(path, &without).unwrap_err().to_string().contains("red is missing"));
    }
}
