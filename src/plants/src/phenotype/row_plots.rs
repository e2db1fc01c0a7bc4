//! Rows of plants and plots: plots that rows define where nobody drew any, and plots without their outer rows.

use super::principal_axis::{main_axis_rad, middle};
use rowgram_optim::robust::median;
use rowgram_raster::{clip, polygon::Polygon};
use std::collections::BTreeMap;

/// The plants of a row in their order along it, as indices: along the main axis of their places, towards larger `u` (in rows
/// along `v`, larger `v`).
pub fn along_the_row(row: &[[f64; 2]]) -> Vec<usize> {
    let (sin, cos) = main_axis_rad([row.iter().copied()]).sin_cos();
    let (sin, cos) = if cos < 1e-9 { (sin.abs(), cos) } else { (sin, cos) };
    let mut order: Vec<usize> = (0..row.len()).collect();
    order.sort_by(|&i, &j| {
        let along = |at: [f64; 2]| cos * at[0] + sin * at[1];
        along(row[i]).total_cmp(&along(row[j]))
    });
    order
}

/// The plants of each row that has several.
fn rows_of(plants: &[[f64; 2]], rows: &[f64]) -> Vec<Vec<[f64; 2]>> {
    let mut of_row: BTreeMap<u64, Vec<[f64; 2]>> = BTreeMap::new();
    for (at, row) in plants.iter().zip(rows).filter(|(_, row)| row.is_finite()) {
        of_row.entry(*row as u64).or_default().push(*at);
    }
    of_row.into_values().filter(|row| row.len() > 1).collect()
}

/// Direction of rows, radians: the main axis of what is left of each row about its own middle.
fn row_angle(of_row: &[Vec<[f64; 2]>]) -> f64 {
    main_axis_rad(of_row.iter().map(|row| row.iter().copied()))
}

/// The direction of the rows of plants, a vector of length 1; `None` where no row has two plants.
pub fn row_direction(plants: &[[f64; 2]], rows: &[f64]) -> Option<[f64; 2]> {
    let of_row = rows_of(plants, rows);
    let (sin, cos) = row_angle(&of_row).sin_cos();
    (!of_row.is_empty()).then_some([cos, sin])
}

/// A row in a plot has at least this share of the plants of its middle row; what has fewer is the end of a row of the neighbour. Assumed, not compared with others.
const LEAST_OF_ROW: f64 = 1.0 / 3.0;

/// A plot without its outer rows of plants, so many on either side: cut in the middle between the last row that is left out
/// and the first that stays. Rows of which it has only a corner are none of its own. `members` are its plants; `None` where no row would be left.
pub fn without_border_rows(
    polygon: &Polygon,
    members: &[([f64; 2], f64)],
    direction: [f64; 2],
    border_rows: usize,
) -> Option<Polygon> {
    let across = [-direction[1], direction[0]];
    let mut rows: BTreeMap<u64, (f64, f64)> = BTreeMap::new();
    for (at, row) in members.iter().filter(|(_, row)| row.is_finite()) {
        let of = rows.entry(*row as u64).or_default();
        *of = (of.0 + across[0] * at[0] + across[1] * at[1], of.1 + 1.0);
    }
    let usual = median(rows.values().map(|(_, n)| *n)).unwrap_or(0.0);
    let own = rows.values().filter(|(_, n)| *n >= LEAST_OF_ROW * usual);
    let mut middles: Vec<f64> = own.map(|(sum, n)| sum / n).collect();
    middles.sort_by(f64::total_cmp);
    let last = middles.len().checked_sub(border_rows + 1)?;
    if border_rows == 0 || last < border_rows {
        return (border_rows == 0).then(|| polygon.clone());
    }
    let low = 0.5 * (middles[border_rows - 1] + middles[border_rows]);
    let high = 0.5 * (middles[last] + middles[last + 1]);
    let above = clip::half_plane(polygon, across.map(|x| -x), -low);
    Some(clip::half_plane(&above, across, high))
}

/// Plots as the rows of plants give them: groups of `rows_per_plot` neighbouring rows, cut where all of a group have
/// an alley of at least `alley_px` pixels. `rows` has the row of each plant, NaN where it stands in none. Names are
/// `R01C02`: group of rows, then number along the rows.
pub fn plots_from_rows(
    plants: &[[f64; 2]],
    rows: &[f64],
    rows_per_plot: usize,
    alley_px: f64,
) -> Vec<(String, Polygon)> {
    let mut of_row = rows_of(plants, rows);
    let angle = row_angle(&of_row);
    let middle = |row: &[[f64; 2]]| middle(row.iter().copied());
    let (sin, cos) = angle.sin_cos();
    let along = |at: &[f64; 2]| cos * at[0] + sin * at[1];
    let across = |at: &[f64; 2]| cos * at[1] - sin * at[0];
    of_row.sort_by(|a, b| across(&middle(a)).total_cmp(&across(&middle(b))));
    let middles: Vec<f64> = of_row.iter().map(|row| across(&middle(row))).collect();
    let mut steps: Vec<f64> = middles.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_by(f64::total_cmp);
    let half = 0.5 * steps.get(steps.len() / 2).copied().unwrap_or(alley_px);
    let mut plots = Vec::new();
    for (group, rows) in of_row.chunks(rows_per_plot.max(1)).enumerate() {
        let mut at: Vec<f64> = rows.iter().flatten().map(along).collect();
        at.sort_by(f64::total_cmp);
        let (low, high) = rows
            .iter()
            .map(|row| across(&middle(row)))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), s| (low.min(s), high.max(s)));
        let mut begin = 0;
        let mut range = 0;
        for k in 1..=at.len() {
            if k < at.len() && at[k] - at[k - 1] < alley_px {
                continue;
            }
            // Plots end where their plants end; neighbours across share the line between their rows.
            let margin = (0.25 * alley_px).min(half);
            let (t0, t1) = (at[begin] - margin, at[k - 1] + margin);
            let corner = |t: f64, s: f64| [cos * t - sin * s, sin * t + cos * s];
            let ring = vec![
                corner(t0, low - half),
                corner(t1, low - half),
                corner(t1, high + half),
                corner(t0, high + half),
            ];
            range += 1;
            plots.push((format!("R{:02}C{range:02}", group + 1), Polygon { rings: vec![ring] }));
            begin = k;
        }
    }
    plots
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_with_an_alley_give_four_plots() {
        // Four rows 20 px apart along u, plants 5 px apart, an alley of 30 px in the middle.
        let mut plants = Vec::new();
        let mut rows = Vec::new();
        for row in 0..4 {
            for k in (0..10).chain(16..26) {
                plants.push([5.0 * f64::from(k), 20.0 * f64::from(row)]);
                rows.push(f64::from(row));
            }
        }
        let plots = plots_from_rows(&plants, &rows, 2, 30.0);
        let names: Vec<&str> = plots.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["R01C01", "R01C02", "R02C01", "R02C02"]);
        for (name, polygon) in &plots {
            let count = polygon.inside(&plants).len();
            assert_eq!(count, 20, "{name}");
        }
        // A plant in no row belongs to no group; without rows there is no plot.
        assert!(plots_from_rows(&[[0.0, 0.0]], &[f64::NAN], 2, 30.0).is_empty());
    }

    #[test]
    fn a_row_has_one_order_whatever_its_direction() {
        let place = |k: f64, [du, dv]: [f64; 2]| [50.0 + du * k, 50.0 + dv * k];
        for step in [[5.0, 0.0], [0.0, 5.0], [0.01, 5.0], [3.0, -4.0]] {
            let row: Vec<[f64; 2]> = [2.0, 0.0, 3.0, 1.0].map(|k| place(k, step)).to_vec();
            let order = along_the_row(&row);
            assert_eq!(order, [1, 3, 0, 2], "{step:?}");
        }
        assert!(along_the_row(&[]).is_empty());
    }

    #[test]
    fn outer_rows_are_left_out() {
        let ring = vec![[-0.5, -10.5], [99.5, -10.5], [99.5, 69.5], [-0.5, 69.5]];
        let plot = Polygon { rings: vec![ring] };
        let plants: Vec<([f64; 2], f64)> = (0..40)
            .map(|k| ([10.0 * f64::from(k % 10), 20.0 * f64::from(k / 10)], f64::from(k / 10)))
            .collect();
        let inner = without_border_rows(&plot, &plants, [1.0, 0.0], 1).unwrap();
        assert_eq!(inner.bounds().unwrap(), [[-0.5, 10.0], [99.5, 50.0]]);
        assert_eq!(without_border_rows(&plot, &plants, [1.0, 0.0], 2), None);
        // The end of the neighbour's row in a corner is no row of the plot.
        let corner = (0..3).map(|k| ([10.0 * f64::from(k), 69.0], 4.0));
        let with_corner: Vec<_> = plants.iter().copied().chain(corner).collect();
        assert_eq!(without_border_rows(&plot, &with_corner, [1.0, 0.0], 1), Some(inner));
        assert_eq!(without_border_rows(&plot, &plants, [1.0, 0.0], 0), Some(plot));
    }
}
