//! Traits of plots, and plots that the rows of plants define where nobody drew any.
//!
//! Positions are pixels of the raster that the mask has; traits are per plot, in SI units.

use crate::raster::{Mask, polygon::Polygon};
use serde::{Deserialize, Serialize};

/// Traits of one plot, rounded to six significant digits; `None` where the trait is not known.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PlotTraits {
    /// Name of the plot.
    pub plot: String,
    /// Area of the plot on the map, square metres.
    pub area_m2: Option<f64>,
    /// Plants that were located.
    pub plants: Option<f64>,
    /// Plants by area, per hectare.
    pub plants_per_ha: Option<f64>,
    /// Plants that gaps in the rows lack.
    pub missing_plants: Option<f64>,
    /// Share of the area that leaves cover.
    pub canopy_cover: Option<f64>,
    /// Leaf pixels over leaf pixels per leaf.
    pub leaves_by_area: Option<f64>,
    /// Lower end of the 95 % interval of `leaves_by_area`.
    pub leaves_by_area_low: Option<f64>,
    /// Upper end of the 95 % interval of `leaves_by_area`.
    pub leaves_by_area_high: Option<f64>,
    /// Leaves that were told apart.
    pub leaves_single: Option<f64>,
    /// Mean length of these leaves, metres.
    pub leaf_length_m: Option<f64>,
    /// Mean width of these leaves, metres.
    pub leaf_width_m: Option<f64>,
    /// Mean hue of these leaves, degrees.
    pub leaf_hue_deg: Option<f64>,
}

/// A trait of plots.
#[derive(Debug, Clone, Copy)]
pub struct Trait {
    /// Its name, with its unit.
    pub name: &'static str,
    /// Its unit after UCUM; `1` for numbers and shares.
    pub unit: &'static str,
    /// What it is.
    pub meaning: &'static str,
    /// Its value in a plot.
    pub value: fn(&PlotTraits) -> Option<f64>,
}

macro_rules! traits {
    ($($name:ident, $unit:literal, $meaning:literal;)*) => {
        /// All traits of plots in their order.
        pub const TRAITS: &[Trait] = &[
            $(Trait { name: stringify!($name), unit: $unit, meaning: $meaning, value: |plot| plot.$name },)*
        ];

        impl PlotTraits {
            fn rounded(mut self) -> PlotTraits {
                $(self.$name = self.$name.map(rounded);)*
                self
            }
        }
    };
}

traits! {
    area_m2, "m2", "area of the plot on the map";
    plants, "1", "plants that were located";
    plants_per_ha, "1/ha", "plants by area";
    missing_plants, "1", "plants that gaps in the rows lack";
    canopy_cover, "1", "share of the area that leaves cover";
    leaves_by_area, "1", "leaf pixels over leaf pixels per leaf";
    leaves_by_area_low, "1", "lower end of the 95 % interval";
    leaves_by_area_high, "1", "upper end of the 95 % interval";
    leaves_single, "1", "leaves that were told apart";
    leaf_length_m, "m", "mean length of these leaves";
    leaf_width_m, "m", "mean width of these leaves";
    leaf_hue_deg, "deg", "mean hue of these leaves";
}

/// Six significant digits.
fn rounded(value: f64) -> f64 {
    if value == 0.0 || !value.is_finite() {
        return value;
    }
    let unit = 10f64.powi(5 - value.abs().log10().floor() as i32);
    (value * unit).round() / unit
}

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
    /// Middles of gaps in the rows, pixels, and how many plants each lacks.
    pub gaps: Option<Vec<([f64; 2], f64)>>,
    /// Leaves that were told apart.
    pub leaves: Option<Vec<MeasuredLeaf>>,
    /// Leaves by area, by plot.
    pub by_area: Option<Vec<LeavesByArea>>,
}

impl FieldMeasurements {
    /// The traits of a plot, and how many pixels of the mask's raster it has.
    pub fn traits(&self, name: &str, polygon: &Polygon, mask: &Mask) -> (PlotTraits, usize) {
        let runs = polygon.runs(mask.width, mask.height);
        let pixels: usize = runs.iter().map(|(_, run)| run.len()).sum();
        let covered: usize = runs
            .iter()
            .map(|(v, run)| mask.row(*v)[run.clone()].iter().filter(|&&pixel| pixel != 0).count())
            .sum();
        let area_m2 = self.gsd_m.map(|gsd| pixels as f64 * gsd * gsd);
        let inside = |at: &[f64; 2]| polygon.holds(*at);
        let plants =
            self.plants.as_ref().map(|plants| plants.iter().filter(|at| inside(at)).count() as f64);
        let missing = self.gaps.as_ref().map(|gaps| {
            gaps.iter().filter(|(at, _)| inside(at)).map(|(_, count)| count).sum::<f64>()
        });
        let leaves: Option<Vec<&MeasuredLeaf>> = self
            .leaves
            .as_ref()
            .map(|leaves| leaves.iter().filter(|leaf| inside(&leaf.at_px)).collect());
        let mean = |value: fn(&MeasuredLeaf) -> f64| {
            let known = leaves.iter().flatten().map(|leaf| value(leaf)).filter(|x| x.is_finite());
            let known: Vec<f64> = known.collect();
            (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
        };
        let by_area = self.by_area.iter().flatten().find(|count| count.plot == name);
        let [number, low, high] = [0, 1, 2]
            .map(|k| by_area.map(|count| count.leaves[k]).filter(|number| number.is_finite()));
        let found = PlotTraits {
            plot: name.to_owned(),
            area_m2,
            plants,
            plants_per_ha: plants.zip(area_m2.filter(|&a| a > 0.0)).map(|(n, a)| n / a * 1e4),
            missing_plants: missing,
            canopy_cover: (pixels > 0).then(|| covered as f64 / pixels as f64),
            leaves_by_area: number,
            leaves_by_area_low: low,
            leaves_by_area_high: high,
            leaves_single: leaves.as_ref().map(|leaves| leaves.len() as f64),
            leaf_length_m: mean(|leaf| leaf.length_m),
            leaf_width_m: mean(|leaf| leaf.width_m),
            leaf_hue_deg: mean(|leaf| leaf.hue_deg),
        };
        (found.rounded(), pixels)
    }
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
            let count = plants.iter().filter(|at| polygon.holds(**at)).count();
            assert_eq!(count, 20, "{name}");
        }
        // A plant in no row belongs to no group; without rows there is no plot.
        assert!(plots_from_rows(&[[0.0, 0.0]], &[f64::NAN], 2, 30.0).is_empty());
    }

    #[test]
    fn traits_of_a_square() {
        let data = (0..100).map(|k| u8::from(k % 10 < 2)).collect();
        let mask = Mask { width: 10, height: 10, data };
        let field = FieldMeasurements {
            gsd_m: Some(0.5),
            plants: Some(vec![[1.0, 1.0], [3.0, 3.0], [8.0, 8.0]]),
            gaps: Some(vec![([2.0, 2.0], 1.5), ([9.0, 9.0], 4.0)]),
            leaves: Some(vec![
                MeasuredLeaf { at_px: [1.0, 2.0], length_m: 0.2, width_m: 0.05, hue_deg: f64::NAN },
                MeasuredLeaf { at_px: [2.0, 2.0], length_m: 0.4, width_m: 0.07, hue_deg: 90.0 },
            ]),
            by_area: Some(vec![LeavesByArea { plot: "A".into(), leaves: [7.0, 6.0, f64::NAN] }]),
        };
        let ring = vec![[-0.5, -0.5], [4.5, -0.5], [4.5, 4.5], [-0.5, 4.5]];
        let square = Polygon { rings: vec![ring] };
        let (of_a, pixels) = field.traits("A", &square, &mask);
        assert_eq!(pixels, 25);
        assert_eq!((of_a.area_m2, of_a.plants), (Some(6.25), Some(2.0)));
        assert_eq!(of_a.plants_per_ha, Some(3200.0));
        assert_eq!((of_a.missing_plants, of_a.canopy_cover), (Some(1.5), Some(0.4)));
        assert_eq!((of_a.leaves_by_area, of_a.leaves_by_area_high), (Some(7.0), None));
        assert_eq!((of_a.leaves_single, of_a.leaf_hue_deg), (Some(2.0), Some(90.0)));
        assert_eq!(of_a.leaf_length_m, Some(0.3));
        // Nothing was measured: what is not known is not zero.
        let (of_b, _) = FieldMeasurements::default().traits("B", &square, &mask);
        assert_eq!((of_b.plants, of_b.area_m2, of_b.leaves_single), (None, None, None));
        assert_eq!(of_b.canopy_cover, Some(0.4));
    }
}
