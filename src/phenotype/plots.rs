//! Traits of plots, and plots that the rows of plants define where nobody drew any.
//!
//! Positions are pixels of the raster that the mask has; traits are per plot, in SI units.

use super::colour_indices::ColourSum;
use crate::raster::{Mask, polygon::Polygon};
use serde::{Deserialize, Serialize};
use statrs::statistics::Statistics;
use std::collections::BTreeMap;

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
    /// Mean distance of neighbouring plants of a row, metres.
    pub plant_spacing_m: Option<f64>,
    /// Standard deviation of that distance over its mean.
    pub plant_spacing_cv: Option<f64>,
    /// The greatest of these distances, metres.
    pub longest_gap_m: Option<f64>,
    /// Height over the ground that 95 % of the cells do not exceed, metres.
    pub canopy_height_m: Option<f64>,
    /// Mean height over the ground, metres.
    pub canopy_height_mean_m: Option<f64>,
    /// Height over the ground times area, summed over the cells, cubic metres.
    pub canopy_volume_m3: Option<f64>,
    /// Excess green of the leaf pixels.
    pub exg: Option<f64>,
    /// Green leaf index of the leaf pixels.
    pub gli: Option<f64>,
    /// Normalized green-red difference index of the leaf pixels.
    pub ngrdi: Option<f64>,
    /// Visible atmospherically resistant index of the leaf pixels.
    pub vari: Option<f64>,
    /// Triangular greenness index of the leaf pixels.
    pub tgi: Option<f64>,
    /// a* of the mean colour of the leaf pixels.
    pub a_star: Option<f64>,
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
    /// How it comes about.
    pub method: &'static str,
    /// What defines it; empty where the method says it all.
    pub reference: &'static str,
    /// Its value in a plot.
    pub value: fn(&PlotTraits) -> Option<f64>,
}

macro_rules! traits {
    ($($name:ident, $unit:literal, $meaning:literal, $method:literal, $reference:literal;)*) => {
        /// All traits of plots in their order.
        pub const TRAITS: &[Trait] = &[
            $(Trait {
                name: stringify!($name),
                unit: $unit,
                meaning: $meaning,
                method: $method,
                reference: $reference,
                value: |plot| plot.$name,
            },)*
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
    area_m2, "m2", "area of the plot on the map",
        "pixels whose centre is in the polygon, times the area of a pixel", "";
    plants, "1", "plants that were located",
        "plants of the stage locate that stand in the polygon", "";
    plants_per_ha, "1/ha", "plants by area",
        "plants over area_m2, times 10,000", "";
    missing_plants, "1", "plants that gaps in the rows lack",
        "most probable number of missing plants of each gap whose middle is in the polygon", "";
    canopy_cover, "1", "share of the area that leaves cover",
        "leaf pixels over pixels of the polygon", "";
    leaves_by_area, "1", "leaf pixels over leaf pixels per leaf",
        "stage leaf-count", "Ribera et al. 2016, KDD workshop on data science for food, energy and water";
    leaves_by_area_low, "1", "lower end of the 95 % interval",
        "stage leaf-count", "";
    leaves_by_area_high, "1", "upper end of the 95 % interval",
        "stage leaf-count", "";
    leaves_single, "1", "leaves that were told apart",
        "leaves of the stage leaves whose middle is in the polygon", "";
    leaf_length_m, "m", "mean length of these leaves",
        "along the axis of the leaf in the plane of the map", "";
    leaf_width_m, "m", "mean width of these leaves",
        "area over length", "";
    leaf_hue_deg, "deg", "mean hue of these leaves",
        "mean over leaves of the hue of their pixels", "";
    plant_spacing_m, "m", "mean distance of neighbouring plants of a row",
        "from each plant to the next of its row within the polygon", "";
    plant_spacing_cv, "1", "standard deviation of that distance over its mean",
        "of the same distances, from two on", "";
    longest_gap_m, "m", "greatest distance of neighbouring plants of a row",
        "of the same distances", "";
    canopy_height_m, "m", "height of the canopy over the ground",
        "95th percentile of the cells of the raster chm.tif inside the polygon (stage surface)", "";
    canopy_height_mean_m, "m", "mean height over the ground",
        "mean of the same cells, soil between plants among them", "";
    canopy_volume_m3, "m3", "volume between surface and ground",
        "sum of the same cells times the area of a cell", "";
    exg, "1", "excess green of the leaf pixels, 2 g - r - b",
        "of the mean colour of the leaf pixels in the orthomosaic", "Woebbecke et al. 1995, Trans. ASAE 38, 259-269";
    gli, "1", "green leaf index of the leaf pixels, (2 G - R - B) / (2 G + R + B)",
        "of the mean colour of the leaf pixels in the orthomosaic", "Louhaichi et al. 2001, Geocarto Int. 16, 65-70";
    ngrdi, "1", "normalized green-red difference index of the leaf pixels, (G - R) / (G + R)",
        "of the mean colour of the leaf pixels in the orthomosaic", "Tucker 1979, Remote Sens. Environ. 8, 127-150";
    vari, "1", "visible atmospherically resistant index of the leaf pixels, (G - R) / (G + R - B)",
        "of the mean colour of the leaf pixels in the orthomosaic", "Gitelson et al. 2002, Remote Sens. Environ. 80, 76-87";
    tgi, "1", "triangular greenness index of the leaf pixels, (G - 0.39 R - 0.61 B) / 255",
        "of the mean colour of the leaf pixels in the orthomosaic", "Hunt et al. 2011, Agron. J. 103, 1090-1099";
    a_star, "1", "a* (CIELAB, D65) of the leaf pixels; green is negative",
        "of the mean colour of the leaf pixels in the orthomosaic", "CIE 15; IEC 61966-2-1";
}

/// The traits as a page: a table of name, unit, meaning, method and reference.
///
/// `docs/traits.md` is this text, and a test compares the two.
pub fn dictionary_page() -> String {
    let mut page = String::from(
        "# Traits of plots\n\n\
         Every column of `traits.csv`, of the layer `plots` in `traits.gpkg` and of `traits.geojson`. The same table is written beside them as\n\
         `trait_dictionary.csv`. Units are after UCUM; 1 stands for numbers and shares. A trait without a value was not measured: a map without\n\
         scale has no areas, a mask without picture no colours. Colour indices are not corrected for the light of the day.\n\n\
         | trait | unit | what it is | how | reference |\n|---|---|---|---|---|\n",
    );
    for of in TRAITS {
        page += &format!(
            "| `{}` | {} | {} | {} | {} |\n",
            of.name, of.unit, of.meaning, of.method, of.reference
        );
    }
    page
}

/// Six significant digits.
fn rounded(value: f64) -> f64 {
    if value == 0.0 || !value.is_finite() {
        return value;
    }
    let unit = 10f64.powi(5 - value.abs().log10().floor() as i32);
    (value * unit).round() / unit
}

/// Heights of the canopy over the ground in a plot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CanopyHeights {
    /// Height that 95 % of the cells do not exceed, metres.
    pub p95_m: f64,
    /// Mean height, metres.
    pub mean_m: f64,
    /// Sum of height times area, cubic metres; `None` where cells have no area.
    pub volume_m3: Option<f64>,
}

impl CanopyHeights {
    /// Of the heights of cells, metres, each a square of this side; `None` without any.
    pub fn of(mut heights_m: Vec<f32>, cell_m: Option<f64>) -> Option<CanopyHeights> {
        let last = heights_m.len().checked_sub(1)?;
        let sum: f64 = heights_m.iter().map(|&height| f64::from(height)).sum();
        let at = (0.95 * last as f64).round() as usize;
        let (_, p95, _) = heights_m.select_nth_unstable_by(at, f32::total_cmp);
        Some(CanopyHeights {
            p95_m: f64::from(*p95),
            mean_m: sum / (last + 1) as f64,
            volume_m3: cell_m.map(|cell_m| sum * cell_m * cell_m),
        })
    }
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
    /// The row of each plant, NaN where it stands in none; empty where there are no rows.
    pub row_of: Vec<f64>,
    /// Middles of gaps in the rows, pixels, and how many plants each lacks.
    pub gaps: Option<Vec<([f64; 2], f64)>>,
    /// Leaves that were told apart.
    pub leaves: Option<Vec<MeasuredLeaf>>,
    /// Leaves by area, by plot.
    pub by_area: Option<Vec<LeavesByArea>>,
}

impl FieldMeasurements {
    /// The traits of a plot, and how many pixels of the mask's raster it has. `colour` is the sum of the colours of its
    /// leaf pixels, where there is a picture, `canopy` its heights, where there is a dense surface.
    pub fn traits(
        &self,
        name: &str,
        polygon: &Polygon,
        mask: &Mask,
        colour: Option<ColourSum>,
        canopy: Option<CanopyHeights>,
    ) -> (PlotTraits, usize) {
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
        let indices = colour.and_then(|sum| sum.indices());
        let steps_m = self.steps_m(&inside);
        let mean_m = (!steps_m.is_empty()).then(|| steps_m.iter().mean());
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
            canopy_height_m: canopy.map(|of| of.p95_m),
            canopy_height_mean_m: canopy.map(|of| of.mean_m),
            canopy_volume_m3: canopy.and_then(|of| of.volume_m3),
            plant_spacing_m: mean_m,
            plant_spacing_cv: mean_m
                .filter(|_| steps_m.len() > 1)
                .map(|mean| steps_m.iter().std_dev() / mean),
            longest_gap_m: steps_m.iter().copied().reduce(f64::max),
            exg: indices.map(|of| of.exg),
            gli: indices.map(|of| of.gli),
            ngrdi: indices.and_then(|of| of.ngrdi),
            vari: indices.and_then(|of| of.vari),
            tgi: indices.map(|of| of.tgi),
            a_star: indices.map(|of| of.a_star),
        };
        (found.rounded(), pixels)
    }

    /// Distances from each plant of an area to the next of its row, metres.
    fn steps_m(&self, inside: &dyn Fn(&[f64; 2]) -> bool) -> Vec<f64> {
        let (Some(plants), Some(gsd_m)) = (&self.plants, self.gsd_m) else { return Vec::new() };
        let mut rows: BTreeMap<u64, Vec<[f64; 2]>> = BTreeMap::new();
        for (at, row) in plants.iter().zip(&self.row_of) {
            if row.is_finite() && inside(at) {
                rows.entry(*row as u64).or_default().push(*at);
            }
        }
        let steps = rows.values().flat_map(|row| {
            let order = along_the_row(row);
            let step = |pair: &[usize]| {
                let [a, b] = [row[pair[0]], row[pair[1]]];
                gsd_m * (a[0] - b[0]).hypot(a[1] - b[1])
            };
            order.windows(2).map(step).collect::<Vec<f64>>()
        });
        steps.collect()
    }
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
    fn the_dictionary_page_is_what_is_measured() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/traits.md");
        let page = std::fs::read_to_string(path).unwrap();
        assert_eq!(page, dictionary_page(), "cargo run -p experiments -- pages");
        assert!(TRAITS.iter().all(|of| !of.method.is_empty()));
    }

    #[test]
    fn traits_of_a_square() {
        let data = (0..100).map(|k| u8::from(k % 10 < 2)).collect();
        let mask = Mask { width: 10, height: 10, data };
        let field = FieldMeasurements {
            gsd_m: Some(0.5),
            plants: Some(vec![[3.0, 1.0], [1.0, 1.0], [4.0, 1.0], [8.0, 8.0]]),
            row_of: vec![0.0; 4],
            gaps: Some(vec![([2.0, 2.0], 1.5), ([9.0, 9.0], 4.0)]),
            leaves: Some(vec![
                MeasuredLeaf { at_px: [1.0, 2.0], length_m: 0.2, width_m: 0.05, hue_deg: f64::NAN },
                MeasuredLeaf { at_px: [2.0, 2.0], length_m: 0.4, width_m: 0.07, hue_deg: 90.0 },
            ]),
            by_area: Some(vec![LeavesByArea { plot: "A".into(), leaves: [7.0, 6.0, f64::NAN] }]),
        };
        let ring = vec![[-0.5, -0.5], [4.5, -0.5], [4.5, 4.5], [-0.5, 4.5]];
        let square = Polygon { rings: vec![ring] };
        let leaf = ColourSum { rgb: [60, 120, 40], pixels: 1 };
        let (of_a, pixels) = field.traits("A", &square, &mask, Some(leaf), None);
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
        // Nothing was measured: what is not known is not zero.
        let (of_b, _) = FieldMeasurements::default().traits("B", &square, &mask, None, None);
        assert_eq!((of_b.plant_spacing_m, of_b.exg), (None, None));
        assert_eq!((of_b.plants, of_b.area_m2, of_b.leaves_single), (None, None, None));
        assert_eq!(of_b.canopy_cover, Some(0.4));
    }
}
