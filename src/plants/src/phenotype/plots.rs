//! Traits of plots, and plots that the rows of plants define where nobody drew any.
//!
//! Positions are pixels of the raster that the mask has; traits are per plot, in SI units.

use super::{
    colour_indices::ColourIndices,
    plot_scatter::{ColourParts, PARTS, PlotParts, jackknife},
    traits::{PlotTraits, deviation_name},
};
use rowgram_optim::robust::median;
use rowgram_raster::{Mask, polygon::Polygon};
use statrs::statistics::Statistics;
use std::collections::BTreeMap;

/// A number and its standard deviation, where that is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// The number.
    pub value: f64,
    /// Its standard deviation.
    pub sd: Option<f64>,
}

/// Heights of the canopy over the ground in a plot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CanopyHeights {
    /// Height that 95 % of the cells do not exceed, metres.
    pub p95_m: Measured,
    /// Mean height, metres.
    pub mean_m: Measured,
    /// Sum of height times area, cubic metres; `None` where cells have no area.
    pub volume_m3: Option<Measured>,
}

impl CanopyHeights {
    /// Of the heights of cells by part of the plot, metres, each cell a square of this side; `None` without any.
    pub fn of(parts: &[Vec<f32>; PARTS], cell_m: Option<f64>) -> Option<CanopyHeights> {
        let has_data = |part: usize| !parts[part].is_empty();
        let rest = |left_out: Option<usize>| -> Vec<f32> {
            let parts = parts.iter().enumerate().filter(|(k, _)| Some(*k) != left_out);
            parts.flat_map(|(_, heights)| heights.iter().copied()).collect()
        };
        let of = |value: fn(Vec<f32>) -> Option<f64>| {
            let sd = jackknife(has_data, |part| value(rest(Some(part))));
            Some(Measured { value: value(rest(None))?, sd })
        };
        let mean_m = of(mean_height)?;
        let cells: usize = parts.iter().map(Vec::len).sum();
        let area = cell_m.map(|cell_m| cells as f64 * cell_m * cell_m);
        let volume =
            |area: f64| Measured { value: mean_m.value * area, sd: mean_m.sd.map(|sd| sd * area) };
        let common_m = HEIGHT_SIGMA_CELLS * cell_m.unwrap_or(0.0);
        let p95_m = of(height_percentile_95)?;
        Some(CanopyHeights {
            p95_m: Measured { sd: p95_m.sd.map(|sd| sd.hypot(common_m)), ..p95_m },
            mean_m,
            volume_m3: area.map(volume),
        })
    }
}

fn mean_height(heights_m: Vec<f32>) -> Option<f64> {
    let sum: f64 = heights_m.iter().map(|&height| f64::from(height)).sum();
    (!heights_m.is_empty()).then(|| sum / heights_m.len() as f64)
}

/// The height that 95 % do not exceed; `None` without any.
pub fn height_percentile_95(mut heights_m: Vec<f32>) -> Option<f64> {
    let last = heights_m.len().checked_sub(1)?;
    let at = (0.95 * last as f64).round() as usize;
    Some(f64::from(*heights_m.select_nth_unstable_by(at, f32::total_cmp).1))
}

/// Standard deviation of where the edge of a leaf is taken to be, the same for all leaves of a picture, pixels: a mask of whole pixels
/// says no more than to half a pixel, `1 / sqrt(12)`.
const EDGE_SIGMA_PX: f64 = 0.288_675;

/// Standard deviation of what the 95th percentile of all plots of a flight is off by, cells of the surface. Root mean square of six mean errors on
/// synthetic flights: the four of docs/accuracy.md (`benches/surface/compare.py twin`; 4.0, 3.0, 1.1, 0.0 cm at 1.5 cm a cell), and bare soil and
/// the plants of day 21 in `rowgram synth season` (1.1 and 2.4 cm at 7 mm). Noise of heights makes most of it.
const HEIGHT_SIGMA_CELLS: f64 = 2.0;

/// A leaf that was told apart; NaN where a number is not known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredLeaf {
    /// Its middle, pixels.
    pub at_px: [f64; 2],
    /// Its length, metres.
    pub length_m: f64,
    /// Its mean width, metres.
    pub width_m: f64,
    /// Its mean hue, degrees.
    pub hue_deg: f64,
}

/// A gap in a row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowGap {
    /// Its middle, pixels.
    pub at_px: [f64; 2],
    /// How many plants it lacks.
    pub plants: f64,
    /// Probability that it lacks any.
    pub probability: f64,
}

/// Leaves of a plot from the area that they cover, with the ends of the 95 % interval.
#[derive(Debug, Clone, PartialEq)]
pub struct LeavesByArea {
    /// Name of the plot.
    pub plot: String,
    /// Number, its lower and its upper end; NaN where an end is not known.
    pub leaves: [f64; 3],
}

/// What is known of a field; `None` for what was not measured.
#[derive(Debug, Clone, Default)]
pub struct FieldMeasurements {
    /// Ground sampling distance, metres; `None` where the raster has no scale.
    pub gsd_m: Option<f64>,
    /// Places of the plants, pixels.
    pub plants: Option<Vec<[f64; 2]>>,
    /// The row of each plant, NaN where it stands in none; empty where there are no rows.
    pub row_of: Vec<f64>,
    /// What each plant adds to the variance of a number of plants; empty where that is not known.
    pub count_variance: Vec<f64>,
    /// Standard deviation of the place of each plant along its row, pixels; empty where that is not known.
    pub along_sigma_px: Vec<f64>,
    /// Gaps in the rows.
    pub gaps: Option<Vec<RowGap>>,
    /// Leaves that were told apart.
    pub leaves: Option<Vec<MeasuredLeaf>>,
    /// Leaves by area, by plot.
    pub by_area: Option<Vec<LeavesByArea>>,
}

impl FieldMeasurements {
    /// The traits of a plot, and how many pixels of the mask's raster it has. `colours` are the sums of the colours of its
    /// leaf pixels, where there is a picture, `canopy` its heights, where there is a dense surface.
    pub fn traits(
        &self,
        name: &str,
        polygon: &Polygon,
        mask: &Mask,
        colours: Option<&ColourParts>,
        canopy: Option<CanopyHeights>,
    ) -> (PlotTraits, usize) {
        let mut found = PlotTraits { plot: name.to_owned(), ..PlotTraits::default() };
        let pixels = self.add_cover(&mut found, polygon, mask);
        self.add_plants(&mut found, polygon);
        self.add_leaves(&mut found, polygon);
        add_heights(&mut found, canopy);
        add_colours(&mut found, colours);
        (found.rounded(), pixels)
    }

    /// Area and cover; gives the number of pixels.
    fn add_cover(&self, found: &mut PlotTraits, polygon: &Polygon, mask: &Mask) -> usize {
        let parts = PlotParts::of(polygon);
        // Pixels and leaf pixels.
        let mut counts = [[0usize; 2]; PARTS];
        // Pairs of neighbours along rows and columns of which one is leaf.
        let mut edges = 0usize;
        for (v, run) in polygon.runs(mask.width, mask.height) {
            let row = mask.row(v);
            let above = v.checked_sub(1).map(|v| mask.row(v));
            for u in run {
                let is_leaf = row[u] != 0;
                let count = &mut counts[parts.at([u as f64, v as f64])];
                count[0] += 1;
                count[1] += usize::from(is_leaf);
                edges += usize::from(u > 0 && (row[u - 1] != 0) != is_leaf);
                edges += usize::from(above.is_some_and(|above| (above[u] != 0) != is_leaf));
            }
        }
        let total = |what: usize| counts.iter().map(|count| count[what]).sum::<usize>();
        let share = |pixels: usize, leaf: usize| (pixels > 0).then(|| leaf as f64 / pixels as f64);
        let (pixels, leaf) = (total(0), total(1));
        found.area_m2 = self.gsd_m.map(|gsd| pixels as f64 * gsd * gsd);
        found.canopy_cover = share(pixels, leaf);
        let without = |k: usize| share(pixels - counts[k][0], leaf - counts[k][1]);
        // Steps along the axes are 4/pi times as long as an edge in any direction.
        let edge_px = std::f64::consts::FRAC_PI_4 * edges as f64;
        let edge_sd = EDGE_SIGMA_PX * edge_px / pixels.max(1) as f64;
        let scatter = jackknife(|k| counts[k][0] > 0, without);
        put(found, "canopy_cover", scatter.map(|scatter| scatter.hypot(edge_sd)));
        pixels
    }

    /// Plants, gaps and spacing; after the area.
    fn add_plants(&self, found: &mut PlotTraits, polygon: &Polygon) {
        let inside = |at: &[f64; 2]| polygon.holds(*at);
        let area_m2 = found.area_m2.filter(|&area| area > 0.0);
        if let Some(plants) = &self.plants {
            let members: Vec<usize> = (0..plants.len()).filter(|&k| inside(&plants[k])).collect();
            let count = members.len() as f64;
            found.plants = Some(count);
            found.plants_per_ha = area_m2.map(|area| count / area * 1e4);
            let variance =
                members.iter().map(|&k| self.count_variance.get(k).copied()).sum::<Option<f64>>();
            let sd = variance.filter(|_| !self.count_variance.is_empty()).map(f64::sqrt);
            put(found, "plants", sd);
            put(found, "plants_per_ha", sd.zip(area_m2).map(|(sd, area)| sd / area * 1e4));
        }
        if let Some(gaps) = &self.gaps {
            let gaps = || gaps.iter().filter(|gap| inside(&gap.at_px));
            found.missing_plants = Some(gaps().map(|gap| gap.plants).sum());
            let variance =
                |gap: &RowGap| gap.plants.powi(2) * gap.probability * (1.0 - gap.probability);
            let variance: f64 = gaps().map(variance).sum();
            put(found, "missing_plants", variance.is_finite().then(|| variance.max(0.0).sqrt()));
        }
        let steps = self.steps_m(&inside);
        let steps_m: Vec<f64> = steps.iter().map(|step| step.0).collect();
        let Some(longest) = steps.iter().copied().reduce(|a, b| if b.0 > a.0 { b } else { a })
        else {
            return;
        };
        let (mean, number) = (steps_m.iter().mean(), steps_m.len() as f64);
        found.plant_spacing_m = Some(mean);
        found.longest_gap_m = Some(longest.0);
        put(found, "longest_gap_m", longest.1);
        if steps_m.len() > 1 {
            let sd = steps_m.iter().std_dev();
            let cv = sd / mean;
            found.plant_spacing_cv = Some(cv);
            put(found, "plant_spacing_m", Some(sd / number.sqrt()));
            let of_cv = cv * ((1.0 + 2.0 * cv * cv) / (2.0 * number)).sqrt();
            put(found, "plant_spacing_cv", Some(of_cv));
        }
    }

    fn add_leaves(&self, found: &mut PlotTraits, polygon: &Polygon) {
        if let Some(count) = self.by_area.iter().flatten().find(|count| count.plot == found.plot) {
            let [number, low, high] =
                count.leaves.map(|number| Some(number).filter(|x| x.is_finite()));
            (found.leaves_by_area, found.leaves_by_area_low, found.leaves_by_area_high) =
                (number, low, high);
            // The interval reaches two standard deviations to either side.
            put(found, "leaves_by_area", low.zip(high).map(|(low, high)| (high - low) / 4.0));
        }
        let Some(leaves) = &self.leaves else { return };
        let leaves: Vec<&MeasuredLeaf> =
            leaves.iter().filter(|leaf| polygon.holds(leaf.at_px)).collect();
        found.leaves_single = Some(leaves.len() as f64);
        let mut mean = |name: &str, value: fn(&MeasuredLeaf) -> f64| {
            let known = leaves.iter().map(|leaf| value(leaf)).filter(|x| x.is_finite());
            let known: Vec<f64> = known.collect();
            if known.len() > 1 {
                put(found, name, Some(known.iter().std_dev() / (known.len() as f64).sqrt()));
            }
            (!known.is_empty()).then(|| known.iter().mean())
        };
        let length_m = mean("leaf_length_m", |leaf| leaf.length_m);
        let width_m = mean("leaf_width_m", |leaf| leaf.width_m);
        let hue_deg = mean("leaf_hue_deg", |leaf| leaf.hue_deg);
        (found.leaf_length_m, found.leaf_width_m, found.leaf_hue_deg) =
            (length_m, width_m, hue_deg);
    }

    /// Distances from each plant of an area to the next of its row, metres, each with its standard deviation where that of
    /// the plants is known.
    fn steps_m(&self, inside: &dyn Fn(&[f64; 2]) -> bool) -> Vec<(f64, Option<f64>)> {
        let (Some(plants), Some(gsd_m)) = (&self.plants, self.gsd_m) else { return Vec::new() };
        let mut rows: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        for (k, (at, row)) in plants.iter().zip(&self.row_of).enumerate() {
            if row.is_finite() && inside(at) {
                rows.entry(*row as u64).or_default().push(k);
            }
        }
        let steps = rows.values().flat_map(|row| {
            let places: Vec<[f64; 2]> = row.iter().map(|&k| plants[k]).collect();
            let order = along_the_row(&places);
            let step = |pair: &[usize]| {
                let [a, b] = [0, 1].map(|end| row[pair[end]]);
                let sigma = |k: usize| self.along_sigma_px.get(k).filter(|x| x.is_finite());
                let sd = sigma(a).zip(sigma(b)).map(|(a, b)| gsd_m * a.hypot(*b));
                let apart = [0, 1].map(|axis| plants[a][axis] - plants[b][axis]);
                (gsd_m * apart[0].hypot(apart[1]), sd)
            };
            order.windows(2).map(step).collect::<Vec<_>>()
        });
        steps.collect()
    }
}

/// Notes a standard deviation where there is one.
fn put(found: &mut PlotTraits, name: &str, sd: Option<f64>) {
    if let Some(sd) = sd.filter(|sd| sd.is_finite()) {
        found.standard_deviations.insert(deviation_name(name), sd);
    }
}

fn add_heights(found: &mut PlotTraits, canopy: Option<CanopyHeights>) {
    let Some(canopy) = canopy else { return };
    found.canopy_height_m = Some(canopy.p95_m.value);
    found.canopy_height_mean_m = Some(canopy.mean_m.value);
    found.canopy_volume_m3 = canopy.volume_m3.map(|of| of.value);
    put(found, "canopy_height_m", canopy.p95_m.sd);
    put(found, "canopy_height_mean_m", canopy.mean_m.sd);
    put(found, "canopy_volume_m3", canopy.volume_m3.and_then(|of| of.sd));
}

/// One of the indices.
type Index = fn(&ColourIndices) -> Option<f64>;

fn add_colours(found: &mut PlotTraits, colours: Option<&ColourParts>) {
    let Some(colours) = colours else { return };
    let Some(indices) = colours.sum(None).indices() else { return };
    let sd = |value: Index| {
        let without = |part: usize| value(&colours.sum(Some(part)).indices()?);
        jackknife(|part| colours.0[part].pixels > 0, without)
    };
    let all: [(&str, Index); 6] = [
        ("exg", |of| Some(of.exg)),
        ("gli", |of| Some(of.gli)),
        ("ngrdi", |of| of.ngrdi),
        ("vari", |of| of.vari),
        ("tgi", |of| Some(of.tgi)),
        ("a_star", |of| Some(of.a_star)),
    ];
    for (name, value) in all {
        put(found, name, sd(value));
    }
    (found.exg, found.gli, found.ngrdi) = (Some(indices.exg), Some(indices.gli), indices.ngrdi);
    (found.vari, found.tgi, found.a_star) = (indices.vari, Some(indices.tgi), Some(indices.a_star));
}

/// The plants of a row in their order along it, as indices: along the main axis of their places, towards larger `u` (in rows
/// along `v`, larger `v`).
pub fn along_the_row(row: &[[f64; 2]]) -> Vec<usize> {
    let n = row.len().max(1) as f64;
    let middle: [f64; 2] = std::array::from_fn(|k| row.iter().map(|at| at[k]).sum::<f64>() / n);
    let [mut uu, mut uv, mut vv] = [0.0; 3];
    for at in row {
        let [a, b] = [at[0] - middle[0], at[1] - middle[1]];
        (uu, uv, vv) = (uu + a * a, uv + a * b, vv + b * b);
    }
    let (sin, cos) = (0.5 * (2.0 * uv).atan2(uu - vv)).sin_cos();
    let (sin, cos) = if cos < 1e-9 { (sin.abs(), cos) } else { (sin, cos) };
    let mut order: Vec<usize> = (0..row.len()).collect();
    order.sort_by(|&i, &j| {
        let along = |at: [f64; 2]| cos * at[0] + sin * at[1];
        along(row[i]).total_cmp(&along(row[j]))
    });
    order
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
    let count = rows.iter().filter(|r| r.is_finite()).fold(0.0, |a: f64, &r| a.max(r + 1.0));
    let mut of_row: Vec<Vec<[f64; 2]>> = vec![Vec::new(); count as usize];
    for (at, row) in plants.iter().zip(rows).filter(|(_, row)| row.is_finite()) {
        of_row[*row as usize].push(*at);
    }
    of_row.retain(|row| row.len() > 1);
    // Direction of the rows: the main axis of what is left of each row about its own middle.
    let middle = |row: &[[f64; 2]]| {
        let n = row.len() as f64;
        [0, 1].map(|k| row.iter().map(|at| at[k]).sum::<f64>() / n)
    };
    let mut moments = [0.0; 3];
    for row in &of_row {
        let m = middle(row);
        for at in row {
            let [a, b] = [at[0] - m[0], at[1] - m[1]];
            moments = [moments[0] + a * a, moments[1] + a * b, moments[2] + b * b];
        }
    }
    let angle = 0.5 * (2.0 * moments[1]).atan2(moments[0] - moments[2]);
    let (sin, cos) = angle.sin_cos();
    let along = |at: &[f64; 2]| cos * at[0] + sin * at[1];
    let across = |at: &[f64; 2]| cos * at[1] - sin * at[0];
    of_row.sort_by(|a, b| across(&middle(a)).total_cmp(&across(&middle(b))));
    let middles: Vec<f64> = of_row.iter().map(|row| across(&middle(row))).collect();
    let half = 0.5 * median(middles.windows(2).map(|pair| pair[1] - pair[0])).unwrap_or(alley_px);
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
    use super::{
        super::{colour_indices::ColourSum, traits::rounded},
        *,
    };

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
            let count = plants.iter().filter(|at| polygon.holds(**at)).count();
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
    fn traits_of_a_square() {
        let gap = |at_px, plants| RowGap { at_px, plants, probability: 0.8 };
        let data = (0..100).map(|k| u8::from(k % 10 < 2)).collect();
        let mask = Mask { width: 10, height: 10, data };
        let field = FieldMeasurements {
            gsd_m: Some(0.5),
            plants: Some(vec![[3.0, 1.0], [1.0, 1.0], [4.0, 1.0], [8.0, 8.0]]),
            row_of: vec![0.0; 4],
            count_variance: vec![0.5, 0.25, 0.25, 9.0],
            along_sigma_px: vec![0.3, 0.4, 0.4, 9.0],
            gaps: Some(vec![gap([2.0, 2.0], 1.5), gap([9.0, 9.0], 4.0)]),
            leaves: Some(vec![
                MeasuredLeaf { at_px: [1.0, 2.0], length_m: 0.2, width_m: 0.05, hue_deg: f64::NAN },
                MeasuredLeaf { at_px: [2.0, 2.0], length_m: 0.4, width_m: 0.07, hue_deg: 90.0 },
            ]),
            by_area: Some(vec![LeavesByArea { plot: "A".into(), leaves: [7.0, 6.0, f64::NAN] }]),
        };
        let ring = vec![[-0.5, -0.5], [4.5, -0.5], [4.5, 4.5], [-0.5, 4.5]];
        let square = Polygon { rings: vec![ring] };
        let mut colours = ColourParts::default();
        colours.0[0] = ColourSum { rgb: [60, 120, 40], pixels: 1 };
        let (of_a, pixels) = field.traits("A", &square, &mask, Some(&colours), None);
        assert_eq!(pixels, 25);
        assert_eq!((of_a.area_m2, of_a.plants), (Some(6.25), Some(3.0)));
        assert_eq!(of_a.plants_per_ha, Some(4800.0));
        assert_eq!((of_a.missing_plants, of_a.canopy_cover), (Some(1.5), Some(0.4)));
        assert_eq!((of_a.leaves_by_area, of_a.leaves_by_area_high), (Some(7.0), None));
        assert_eq!((of_a.leaves_single, of_a.leaf_hue_deg), (Some(2.0), Some(90.0)));
        assert_eq!(of_a.leaf_length_m, Some(0.3));
        // Plants of the row at 1, 3 and 4 px, half a metre each: steps of 1 m and 0.5 m.
        assert_eq!((of_a.plant_spacing_m, of_a.longest_gap_m), (Some(0.75), Some(1.0)));
        assert_eq!(of_a.plant_spacing_cv, Some(rounded(0.125f64.sqrt() / 0.75)));
        assert_eq!(
            (of_a.ngrdi, of_a.exg),
            (Some(rounded(1.0 / 3.0)), Some(rounded(140.0 / 220.0)))
        );
        // Variances of the three plants inside sum to 1; their places give that of the longest gap.
        let sd = |name: &str| of_a.standard_deviations.get(&deviation_name(name)).copied();
        assert_eq!((sd("plants"), sd("plants_per_ha")), (Some(1.0), Some(1600.0)));
        assert_eq!(sd("missing_plants"), Some(rounded(1.5 * 0.16f64.sqrt())));
        assert_eq!(sd("longest_gap_m"), Some(0.25));
        assert_eq!(sd("plant_spacing_m"), Some(0.25));
        assert_eq!(sd("leaf_length_m"), Some(rounded(0.1)));
        // Only one part has leaf pixels with a colour, and one leaf a hue.
        assert_eq!((sd("exg"), sd("leaf_hue_deg"), sd("area_m2")), (None, None, None));
        assert!(sd("canopy_cover").unwrap() > 0.0);
        // Nothing was measured: what is not known is not zero.
        let (of_b, _) = FieldMeasurements::default().traits("B", &square, &mask, None, None);
        assert_eq!((of_b.plant_spacing_m, of_b.exg), (None, None));
        assert_eq!((of_b.plants, of_b.area_m2, of_b.leaves_single), (None, None, None));
        assert_eq!(of_b.canopy_cover, Some(0.4));
    }
}
