//! Plants that were found, as pieces and ends of the rows of a plan.
//!
//! A row that was found is cut into pieces of a given length within each plot; a piece is the mean position of its plants. The
//! outermost plants of a row of a plot are its ends, where an alley or the edge of the field lets them show.

use super::{
    super::principal_axis::{main_axis_rad, middle},
    Plan, PlannedRow,
};
use crate::problems::plot_layout::{
    AFFINE, BEND, Placement,
    fit::{EndSample, Observations, RowSample},
};
use rowgram_optim::robust::median;
use std::collections::BTreeMap;

/// A plant on the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundPlant {
    /// Where it stands, metres.
    pub at_m: [f64; 2],
    /// Number of the row that it was found in.
    pub row: usize,
}

/// Plants of the rows that were found, in the frame of a nominal placement.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundRows {
    /// `q` of the plants of each row, by their place along the heading, metres.
    pub rows: Vec<Vec<[f64; 2]>>,
    /// Median distance of neighbouring plants of a row, metres.
    pub plant_spacing_m: f64,
}

/// Rows with fewer plants say nothing of a direction.
const LEAST_PLANTS: usize = 8;

impl FoundRows {
    /// Of plants; rows with next to no plants are left out.
    pub fn new(plants: &[FoundPlant], nominal: &Placement) -> FoundRows {
        let mut groups: BTreeMap<usize, Vec<[f64; 2]>> = BTreeMap::new();
        for plant in plants {
            groups.entry(plant.row).or_default().push(nominal.frame(plant.at_m));
        }
        let mut rows: Vec<Vec<[f64; 2]>> =
            groups.into_values().filter(|row| row.len() >= LEAST_PLANTS).collect();
        let turn = direction(&rows);
        let (sin, cos) = turn.sin_cos();
        for row in &mut rows {
            row.sort_by(|a, b| {
                let along = |q: &[f64; 2]| cos * q[0] + sin * q[1];
                along(a).total_cmp(&along(b))
            });
        }
        let steps = rows
            .iter()
            .flat_map(|row| row.windows(2).map(|p| (p[1][0] - p[0][0]).hypot(p[1][1] - p[0][1])));
        let plant_spacing_m = median(steps).unwrap_or(0.0);
        FoundRows { rows, plant_spacing_m }
    }

    /// Direction of the rows against the heading of the frame, radians within a quarter turn.
    pub fn turn_rad(&self) -> f64 {
        direction(&self.rows)
    }

    /// The median distance of neighbouring rows, metres; `None` where there are fewer than two.
    pub fn row_spacing_m(&self) -> Option<f64> {
        let (sin, cos) = self.turn_rad().sin_cos();
        let across = |row: &Vec<[f64; 2]>| {
            row.iter().map(|q| cos * q[1] - sin * q[0]).sum::<f64>() / row.len() as f64
        };
        let mut places: Vec<f64> = self.rows.iter().map(across).collect();
        places.sort_by(f64::total_cmp);
        median(places.windows(2).map(|pair| pair[1] - pair[0]))
    }
}

/// The main axis of the plants about the middles of their rows.
fn direction(rows: &[Vec<[f64; 2]>]) -> f64 {
    main_axis_rad(rows.iter().map(|row| row.iter().copied()))
}

/// The rows of a plan, found by place.
#[derive(Debug, Clone)]
pub struct Lookup {
    /// Plot and row, in the order of the plan.
    pub rows: Vec<(usize, PlannedRow)>,
    /// Rows that cross each strip of a metre along, with `t` in its middle, sorted by it.
    strips: Vec<Vec<(f64, usize)>>,
    first_m: f64,
}

impl Lookup {
    /// Of a plan.
    pub fn new(plan: &Plan) -> Lookup {
        let of = |(plot, planned): (usize, &super::PlannedPlot)| {
            planned.rows.iter().map(move |row| (plot, *row)).collect::<Vec<_>>()
        };
        let rows: Vec<(usize, PlannedRow)> = plan.plots.iter().enumerate().flat_map(of).collect();
        let first_m = rows.iter().map(|(_, row)| row.ends[0][0]).fold(f64::INFINITY, f64::min);
        let last_m = rows.iter().map(|(_, row)| row.ends[1][0]).fold(first_m, f64::max);
        let mut strips = vec![Vec::new(); (last_m - first_m).ceil() as usize + 1];
        for (index, (_, row)) in rows.iter().enumerate() {
            let strip = |s: f64| (s - first_m).floor() as usize;
            for at in strip(row.ends[0][0])..=strip(row.ends[1][0]).min(strips.len() - 1) {
                strips[at].push((row.across(first_m + at as f64 + 0.5), index));
            }
        }
        strips.iter_mut().for_each(|strip| strip.sort_by(|a, b| a.0.total_cmp(&b.0)));
        Lookup { rows, strips, first_m }
    }

    /// The row nearest to a place among those that reach it, and how far the place is from it across.
    pub fn nearest(&self, [s, t]: [f64; 2]) -> Option<(usize, f64)> {
        let strip = self.strips.get(usize::try_from((s - self.first_m).floor() as i64).ok()?)?;
        let at = strip.partition_point(|(other, _)| *other < t);
        // Rows that begin or end within the strip, and slanted ones, need not be the next in order.
        let near = at.saturating_sub(4)..(at + 4).min(strip.len());
        near.map(|k| strip[k].1)
            .filter(|&index| {
                let [from, to] = self.rows[index].1.ends;
                from[0] <= s && s <= to[0]
            })
            .map(|index| (index, t - self.rows[index].1.across(s)))
            .min_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))
    }

    /// For each row the bare length before its beginning and after its end on its own line; infinite at the edge of the
    /// field.
    fn bare_m(&self, row_spacing_m: f64) -> Vec<[f64; 2]> {
        // Rows on one line: across, then along.
        let mut order: Vec<(f64, f64, usize)> = self
            .rows
            .iter()
            .enumerate()
            .map(|(index, (_, row))| (row.ends[0][1], row.ends[0][0], index))
            .collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut bare = vec![[f64::INFINITY; 2]; self.rows.len()];
        for (place, &(t, s, index)) in order.iter().enumerate() {
            let near = |other: &&(f64, f64, usize)| (other.0 - t).abs() < 0.25 * row_spacing_m;
            let before = order[..place].iter().rev().take_while(near);
            let after = order[place + 1..].iter().take_while(near);
            for &(_, other_s, other) in before.chain(after) {
                let (own, next) = (self.rows[index].1.ends, self.rows[other].1.ends);
                if other_s > s {
                    bare[index][1] = bare[index][1].min(next[0][0] - own[1][0]);
                } else {
                    bare[index][0] = bare[index][0].min(own[0][0] - next[1][0]);
                }
            }
        }
        bare
    }
}

/// How plants become observations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cutting {
    /// Length of a piece of a row, metres.
    pub segment_m: f64,
    /// Plants farther from the row of the plan are no part of it, metres.
    pub gate_m: f64,
}

/// From so many spacings of plants on a bare stretch shows where a row ends.
const BARE_SPACINGS: f64 = 3.0;
/// How far beyond the end of a plot its plants are looked for, metres, where no alley says less.
const BEYOND_M: f64 = 1.0;
/// Lines of ends that are nearer than this are one, metres.
const ONE_LINE_M: f64 = 0.3;
/// A piece of a row has so many plants or more.
const PLANTS_OF_PIECE: usize = 2;

/// The observations of a plan at a placement, and how many plants stand in each plot. `is_visible` says whether a map
/// position is on the picture that plants were looked for in.
pub fn observe(
    found: &FoundRows,
    plan: &Plan,
    lookup: &Lookup,
    placement: &Placement,
    cutting: &Cutting,
    is_visible: &dyn Fn([f64; 2]) -> bool,
) -> (Observations, Vec<usize>) {
    let nominal = Placement { affine: [0.0; AFFINE], bend_m: [0.0; BEND], ..*placement };
    let place_of = |q: [f64; 2]| placement.plan(nominal.map(q));
    let mut seen = Observations {
        found_rows: found.rows.len(),
        plots: plan.plots.len(),
        ..Observations::default()
    };
    let mut plants = vec![0; plan.plots.len()];
    let bare = lookup.bare_m(plan.row_spacing_m);
    let inner = bare.iter().flatten().copied().filter(|gap| gap.is_finite() && *gap > 0.0);
    let outer_m = inner.fold(2.0 * BEYOND_M, f64::min) / 2.0;
    let window = |gap: f64| match gap.is_finite() {
        true => (0.5 * gap).min(BEYOND_M),
        false => outer_m,
    };
    let shows = |gap: f64| gap > BARE_SPACINGS * found.plant_spacing_m;
    let mut pieces: BTreeMap<(usize, usize, i64), Vec<[f64; 2]>> = BTreeMap::new();
    for (found_row, row) in found.rows.iter().enumerate() {
        let mut of_rows: BTreeMap<usize, usize> = BTreeMap::new();
        let places: Vec<[f64; 2]> = row.iter().map(|&q| place_of(q)).collect();
        for (&q, &at) in row.iter().zip(&places) {
            let Some((index, off)) = lookup.nearest(at) else { continue };
            if off.abs() > cutting.gate_m {
                continue;
            }
            let (plot, planned) = &lookup.rows[index];
            plants[*plot] += 1;
            *of_rows.entry(index).or_default() += 1;
            let piece = ((at[0] - planned.ends[0][0]) / cutting.segment_m).floor() as i64;
            pieces.entry((found_row, index, piece)).or_default().push(q);
        }
        for (&index, _) in of_rows.iter().filter(|(_, count)| **count >= LEAST_PLANTS / 2) {
            let (plot, planned) = lookup.rows[index];
            let near = |at: &[f64; 2]| {
                let [from, to] = planned.ends;
                let within = from[0] - window(bare[index][0])..=to[0] + window(bare[index][1]);
                within.contains(&at[0]) && (at[1] - planned.across(at[0])).abs() < cutting.gate_m
            };
            let own = || (0..row.len()).filter(|&k| near(&places[k]));
            let order = |a: &usize, b: &usize| places[*a][0].total_cmp(&places[*b][0]);
            for (begins, outermost) in [(true, own().min_by(order)), (false, own().max_by(order))] {
                let side = usize::from(!begins);
                let [s, t] = planned.ends[side];
                let sign = if begins { -1.0 } else { 1.0 };
                let beyond = [s + sign * window(bare[index][side]), t];
                let (Some(k), true) =
                    (outermost, shows(bare[index][side]) && is_visible(placement.map(beyond)))
                else {
                    continue;
                };
                seen.ends.push(EndSample { q: row[k], s, begins, line: 0, plot });
            }
        }
    }
    let usual = {
        let counts: Vec<usize> = pieces.values().map(Vec::len).collect();
        counts.iter().sum::<usize>() as f64 / counts.len().max(1) as f64
    };
    for ((found_row, index, _), piece) in pieces {
        if piece.len() < PLANTS_OF_PIECE {
            continue;
        }
        let (plot, planned) = lookup.rows[index];
        seen.rows.push(RowSample {
            q: middle(piece.iter().copied()),
            row: planned.ends,
            found_row,
            plot,
            weight: piece.len() as f64 / usual,
        });
    }
    seen.lines = lines_of_ends(&mut seen.ends);
    (seen, plants)
}

/// Numbers the lines that ends of plots lie on; how many there are.
fn lines_of_ends(ends: &mut [EndSample]) -> usize {
    let mut order: Vec<usize> = (0..ends.len()).collect();
    order.sort_by(|&a, &b| {
        ends[a].begins.cmp(&ends[b].begins).then(ends[a].s.total_cmp(&ends[b].s))
    });
    let mut lines = 0;
    for k in 0..order.len() {
        let own = ends[order[k]];
        let goes_on = k > 0 && {
            let last = ends[order[k - 1]];
            last.begins == own.begins && own.s - last.s < ONE_LINE_M
        };
        lines += usize::from(!goes_on);
        ends[order[k]].line = lines - 1;
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phenotype::layout::design::tests::small;

    #[test]
    fn rows_of_the_plan_are_found_by_place() {
        let plan = small().plan().unwrap();
        let lookup = Lookup::new(&plan);
        assert_eq!(lookup.rows.len(), 40);
        for (index, (_, row)) in lookup.rows.iter().enumerate() {
            let s = row.ends[0][0] + 3.0;
            let (found, off) = lookup.nearest([s, row.across(s) + 0.1]).unwrap();
            assert_eq!(found, index);
            assert!((off - 0.1).abs() < 1e-9);
        }
        assert!(lookup.nearest([0.0, 0.0]).is_none(), "on the alley");
        let bare = lookup.bare_m(0.76);
        let alleys = bare.iter().flatten().filter(|gap| (**gap - 1.5).abs() < 1e-9).count();
        assert_eq!(alleys, 40);
        assert_eq!(bare.iter().flatten().filter(|gap| gap.is_infinite()).count(), 40);
    }

    #[test]
    fn pieces_and_ends_are_where_the_plants_are() {
        let plan = small().plan().unwrap();
        let placement = Placement::nominal([100.0, 200.0], 0.5, 9.0);
        let mut plants = Vec::new();
        for (row, (_, planned)) in Lookup::new(&plan).rows.iter().enumerate() {
            // Both plots of a line are one row that was found.
            let line = (planned.ends[0][1] / 0.76 + 100.0).floor();
            assert!(row < 40);
            for k in 0..40 {
                let s = planned.ends[0][0] + 0.1 + 0.2 * f64::from(k);
                let at_m = placement.map([s, planned.across(s)]);
                plants.push(FoundPlant { at_m, row: line as usize });
            }
        }
        let found = FoundRows::new(&plants, &placement);
        assert_eq!(found.rows.len(), 20);
        assert!((found.plant_spacing_m - 0.2).abs() < 1e-9 && found.turn_rad().abs() < 1e-9);
        let cutting = Cutting { segment_m: 2.0, gate_m: 0.25 };
        let lookup = Lookup::new(&plan);
        let (seen, of_plots) = observe(&found, &plan, &lookup, &placement, &cutting, &|_| true);
        assert_eq!(of_plots, [200; 8]);
        assert_eq!((seen.ends.len(), seen.lines), (80, 4));
        // 7.9 m of plants are three whole pieces and a part.
        assert_eq!(seen.rows.len(), 160);
        for end in &seen.ends {
            let margin = if end.begins { 0.1 } else { -(8.25 - 7.9) };
            assert!((end.q[0] - end.s - margin).abs() < 1e-6, "{end:?}");
        }
        // What the picture does not show has no end.
        let (half, _) = observe(&found, &plan, &lookup, &placement, &cutting, &|at| {
            placement.plan(at)[0] < 0.0
        });
        assert!(half.ends.len() < 60, "{}", half.ends.len());
    }
}
