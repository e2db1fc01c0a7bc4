//! The plan that polygons give: each has rows along the heading, spread over its width.
//!
//! Along the heading `h` a polygon of area `A` is cut by lines across at a quarter and three quarters of its extent; the
//! middles of the cuts are the line that its rows are parallel to, their mean length is the width `w`, and `A / w` is the
//! length about the centre of gravity. That is exact for parallelograms, and near enough for anything that is a plot.

use super::{Plan, PlannedPlot, PlannedRow};
use rowgram_base::error::Error;
use rowgram_raster::polygon::Polygon;

/// A polygon with its name, metres on the map.
#[derive(Debug, Clone, PartialEq)]
pub struct Drawn {
    /// Its name.
    pub name: String,
    /// Its rings.
    pub rings: Vec<Vec<[f64; 2]>>,
}

/// The middle of the extent of some polygons, metres on the map.
pub fn middle(drawn: &[Drawn]) -> [f64; 2] {
    let points = || drawn.iter().flat_map(|plot| plot.rings.iter().flatten());
    [0, 1].map(|axis| {
        let low = points().map(|at| at[axis]).fold(f64::INFINITY, f64::min);
        let high = points().map(|at| at[axis]).fold(f64::NEG_INFINITY, f64::max);
        0.5 * (low + high)
    })
}

/// The direction of the sides, radians counter-clockwise from east: by their lengths, sides at right angles being one.
pub fn direction(drawn: &[Drawn]) -> f64 {
    let (mut sin, mut cos) = (0.0, 0.0);
    for ring in drawn.iter().flat_map(|plot| &plot.rings) {
        for k in 0..ring.len() {
            let (from, to) = (ring[k], ring[(k + 1) % ring.len()]);
            let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
            let angle = 4.0 * dy.atan2(dx);
            sin += dx.hypot(dy) * angle.sin();
            cos += dx.hypot(dy) * angle.cos();
        }
    }
    0.25 * sin.atan2(cos)
}

/// The plan of polygons whose rows run along `heading_rad`, about `origin_m`. Each has `rows_per_plot` rows, or as many as
/// fit into its width at `row_spacing_m`.
///
/// # Errors
/// A polygon without an area.
pub fn plan(
    drawn: &[Drawn],
    origin_m: [f64; 2],
    heading_rad: f64,
    rows_per_plot: Option<usize>,
    row_spacing_m: f64,
) -> Result<Plan, Error> {
    let (sin, cos) = heading_rad.sin_cos();
    let along = |at: &[f64; 2]| {
        let [x, y] = [at[0] - origin_m[0], at[1] - origin_m[1]];
        [cos * x + sin * y, cos * y - sin * x]
    };
    let plots = drawn.iter().map(|plot| {
        let rings: Vec<Vec<[f64; 2]>> =
            plot.rings.iter().map(|ring| ring.iter().map(along).collect()).collect();
        let rows = rows(&rings, rows_per_plot, row_spacing_m).ok_or_else(|| {
            Error::Argument(format!("plot {}: its polygon has no area", plot.name))
        })?;
        Ok(PlannedPlot { name: plot.name.clone(), range: 0, column: 0, rings, rows })
    });
    Ok(Plan { plots: plots.collect::<Result<_, Error>>()?, row_spacing_m })
}

fn rows(
    rings: &[Vec<[f64; 2]>],
    rows_per_plot: Option<usize>,
    row_spacing_m: f64,
) -> Option<Vec<PlannedRow>> {
    let low = rings.iter().flatten().map(|at| at[0]).fold(f64::INFINITY, f64::min);
    let high = rings.iter().flatten().map(|at| at[0]).fold(f64::NEG_INFINITY, f64::max);
    let cuts = [0.25, 0.75].map(|share| {
        let s = low + share * (high - low);
        cut(rings, s).map(|[from, to]| (s, 0.5 * (from + to), to - from))
    });
    let [Some((s0, t0, w0)), Some((s1, t1, w1))] = cuts else { return None };
    let outer = rings.first()?;
    let (area, middle) = area_and_middle(outer);
    let width = 0.5 * (w0 + w1);
    if !(area > 0.0 && width > 0.0 && s1 > s0) {
        return None;
    }
    let count = rows_per_plot.unwrap_or((width / row_spacing_m).round().max(1.0) as usize);
    let slope = (t1 - t0) / (s1 - s0);
    let half = 0.5 * area / width;
    let of = |k: usize| {
        let beside = ((k as f64 + 0.5) / count as f64 - 0.5) * width;
        let end = |s: f64| [s, t0 + slope * (s - s0) + beside];
        PlannedRow { ends: [end(middle - half), end(middle + half)] }
    };
    Some((0..count).map(of).collect())
}

/// The outermost crossings with the line across at `s`.
fn cut(rings: &[Vec<[f64; 2]>], s: f64) -> Option<[f64; 2]> {
    let mut range = [f64::INFINITY, f64::NEG_INFINITY];
    for ring in rings {
        for k in 0..ring.len() {
            let (a, b) = (ring[k], ring[(k + 1) % ring.len()]);
            if (a[0] <= s) != (b[0] <= s) {
                let t = a[1] + (s - a[0]) / (b[0] - a[0]) * (b[1] - a[1]);
                range = [range[0].min(t), range[1].max(t)];
            }
        }
    }
    (range[0] < range[1]).then_some(range)
}

/// Area, and the centre of gravity along, by the shoelace formula.
fn area_and_middle(ring: &[[f64; 2]]) -> (f64, f64) {
    let (mut twice, mut moment) = (0.0, 0.0);
    for k in 0..ring.len() {
        let (a, b) = (ring[k], ring[(k + 1) % ring.len()]);
        let cross = a[0] * b[1] - b[0] * a[1];
        twice += cross;
        moment += cross * (a[0] + b[0]);
    }
    (0.5 * twice.abs(), moment / (3.0 * twice))
}

/// Polygons of pixels as polygons in metres: `map` puts a pixel on the map.
pub fn drawn<'a>(
    named: impl Iterator<Item = (&'a str, &'a Polygon)>,
    map: impl Fn([f64; 2]) -> [f64; 2],
) -> Vec<Drawn> {
    let of = |(name, polygon): (&str, &Polygon)| Drawn {
        name: name.to_owned(),
        rings: polygon.rings.iter().map(|ring| ring.iter().map(|&at| map(at)).collect()).collect(),
    };
    named.map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{phenotype::layout::design::tests::small, problems::plot_layout::Placement};
    use approx::assert_abs_diff_eq;

    /// The polygons of a design give the plan of the design.
    #[test]
    fn a_plan_comes_back_from_its_polygons() {
        let plan_of_design = small().plan().unwrap();
        let placement = Placement::nominal([1000.0, 2000.0], 0.6, 9.0);
        let drawn: Vec<Drawn> = plan_of_design
            .plots
            .iter()
            .map(|plot| Drawn { name: plot.name.clone(), rings: plot.on_map(&placement) })
            .collect();
        assert_abs_diff_eq!(direction(&drawn), 0.6, epsilon = 1e-9);
        let found = plan(&drawn, middle(&drawn), 0.6, None, 0.75).unwrap();
        let [[s, _], _] = found.extent();
        assert_abs_diff_eq!(s, -9.0, epsilon = 1e-9);
        for (a, b) in found.plots.iter().zip(&plan_of_design.plots) {
            assert_eq!((a.name.as_str(), a.rows.len()), (b.name.as_str(), 5));
            for row in &b.rows {
                let same = |other: &PlannedRow| {
                    let off = |k: usize| {
                        (0..2)
                            .map(|axis| (other.ends[k][axis] - row.ends[k][axis]).abs())
                            .sum::<f64>()
                    };
                    off(0) + off(1) < 1e-6
                };
                assert!(a.rows.iter().any(same), "{row:?} in {:?}", a.rows);
            }
        }
        let flat =
            Drawn { name: "7".into(), rings: vec![vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]] };
        let error = plan(&[flat], [0.0; 2], 0.0, None, 0.75).unwrap_err().to_string();
        assert!(error.contains("plot 7") && error.contains("no area"), "{error}");
    }
}
