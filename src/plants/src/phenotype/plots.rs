//! Traits of plots.
//!
//! Positions are pixels of the raster that the mask has; traits are per plot, in SI units.

use super::{
    colour_indices::ColourIndices,
    field_measurements::{FieldMeasurements, MeasuredLeaf, RowGap},
    plot_scatter::{ColourParts, HeightParts, PARTS, PlotParts, ValueParts, jackknife},
    row_plots::along_the_row,
    traits::{PlotTraits, deviation_name, leaf_name, put},
};
use rowgram_raster::{
    Mask,
    polygon::{Polygon, Positions},
};
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
    /// Area of the cells that have a height, square metres; `None` where cells have no area.
    pub area_m2: Option<f64>,
}

impl CanopyHeights {
    /// Of the heights of cells in a plot, each a square of this side; `None` without any.
    pub fn of(parts: &HeightParts, cell_m: Option<f64>) -> Option<CanopyHeights> {
        let mean_m = parts.means.mean()?;
        let p95_m = parts.percentile_m(0.95)?;
        let common_m = HEIGHT_SIGMA_CELLS * cell_m.unwrap_or(0.0);
        Some(CanopyHeights {
            p95_m: Measured { sd: p95_m.sd.map(|sd| sd.hypot(common_m)), ..p95_m },
            mean_m,
            area_m2: cell_m.map(|cell_m| parts.means.pixels() as f64 * cell_m * cell_m),
        })
    }
}

/// Standard deviation of where the edge of a leaf is taken to be, the same for all leaves of a picture, pixels: a mask of whole pixels
/// says no more than to half a pixel, `1 / sqrt(12)`.
const EDGE_SIGMA_PX: f64 = 0.288_675;

/// Standard deviation of what the 95th percentile of all plots of a flight is off by, cells of the surface. Root mean square of six mean errors on
/// synthetic flights: the four of docs/accuracy.md (`benches/surface/compare.py twin`; 4.0, 3.0, 1.1, 0.0 cm at 1.5 cm a cell), and bare soil and
/// the plants of day 21 in `rowgram synth season` (1.1 and 2.4 cm at 7 mm). Noise of heights makes most of it.
const HEIGHT_SIGMA_CELLS: f64 = 2.0;

/// What a raster shows of a field.
#[derive(Debug, Clone, Copy)]
pub struct SeenField<'a> {
    /// The leaf mask.
    pub mask: &'a Mask,
    /// Pixels that show something; `None` where all do.
    pub valid: Option<&'a Mask>,
    /// Share of a plot that has to be seen for numbers of the whole plot.
    pub min_valid_share: f64,
}

/// An area whose traits are measured.
#[derive(Debug, Clone, Copy)]
pub struct Area<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its outline, pixels.
    pub polygon: &'a Polygon,
    /// Whether it is the whole field, which ends where the raster shows nothing more.
    pub is_field: bool,
}

/// A spectral index over the pixels of a plot.
#[derive(Debug, Clone, Copy)]
pub struct PlotIndex<'a> {
    /// Its name.
    pub name: &'a str,
    /// Over all pixels with data.
    pub ground: &'a ValueParts,
    /// Over the leaf pixels.
    pub leaf: &'a ValueParts,
}

impl PlotIndex<'_> {
    fn add(&self, found: &mut PlotTraits) {
        for (name, parts) in
            [(self.name.to_owned(), self.ground), (leaf_name(self.name), self.leaf)]
        {
            let mean = parts.mean();
            // A colour index of this name is another one.
            found.more.remove(&deviation_name(&name));
            found.set(&name, mean.map(|of| of.value));
            put(found, &name, mean.and_then(|of| of.sd));
        }
    }
}

/// Measurements of a field with their places sorted, from which the traits of many plots are taken.
pub struct FieldIndex<'a> {
    field: &'a FieldMeasurements,
    plants: Positions,
    gaps: Positions,
    weeds: Positions,
    rows: Positions,
    leaves: Positions,
}

impl FieldMeasurements {
    /// Sorts the places.
    pub fn index(&self) -> FieldIndex<'_> {
        FieldIndex {
            field: self,
            plants: Positions::new(self.plants.iter().flatten().copied()),
            gaps: Positions::new(self.gaps.iter().flatten().map(|gap| gap.at_px)),
            weeds: Positions::new(self.weeds.iter().flatten().map(|weed| weed.position_px)),
            rows: Positions::new(self.rows.iter().flat_map(|rows| &rows.places_px).copied()),
            leaves: Positions::new(self.leaves.iter().flatten().map(|leaf| leaf.at_px)),
        }
    }
}

impl FieldIndex<'_> {
    /// The traits of a plot, and how many pixels of it the raster shows. `colours` are the sums of the colours of its
    /// leaf pixels, where there is a picture, `canopy` its heights, where there is a dense surface, `indices` its spectral indices.
    pub fn traits(
        &self,
        area: Area<'_>,
        seen: SeenField<'_>,
        colours: Option<&ColourParts>,
        canopy: Option<CanopyHeights>,
        indices: &[PlotIndex<'_>],
    ) -> (PlotTraits, usize) {
        let mut found = PlotTraits { plot: area.name.to_owned(), ..PlotTraits::default() };
        let pixels = self.add_cover(&mut found, area.polygon, seen);
        let all = if area.is_field { pixels } else { area.polygon.pixels() };
        found.valid_share = (all > 0).then(|| pixels as f64 / all as f64);
        self.add_plants(&mut found, area.polygon, seen.valid);
        if let Some(rows) = &self.field.rows {
            rows.add(&mut found, area, &self.rows.inside(area.polygon));
        }
        self.add_leaves(&mut found, area.polygon);
        add_heights(&mut found, canopy, seen.min_valid_share);
        add_colours(&mut found, colours);
        indices.iter().for_each(|index| index.add(&mut found));
        if found.valid_share.is_none_or(|share| share < seen.min_valid_share) {
            found.without_totals();
        }
        (found.rounded(), pixels)
    }

    /// Area and cover; gives the number of pixels that show something.
    fn add_cover(&self, found: &mut PlotTraits, polygon: &Polygon, seen: SeenField<'_>) -> usize {
        let SeenField { mask, valid, .. } = seen;
        let parts = PlotParts::of(polygon);
        // Pixels and leaf pixels.
        let mut counts = [[0usize; 2]; PARTS];
        // Pairs of neighbours along rows and columns of which one is leaf.
        let mut edges = 0usize;
        for (v, run) in polygon.runs(mask.width, mask.height) {
            let row = mask.row(v);
            let above = v.checked_sub(1).map(|v| mask.row(v));
            let shown = valid.map(|valid| valid.row(v));
            for u in run {
                if shown.is_some_and(|shown| shown[u] == 0) {
                    continue;
                }
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
        found.area_m2 = self.field.gsd_m.map(|gsd| pixels as f64 * gsd * gsd);
        found.canopy_cover = share(pixels, leaf);
        let without = |k: usize| share(pixels - counts[k][0], leaf - counts[k][1]);
        // Steps along the axes are 4/pi times as long as an edge in any direction.
        let edge_px = std::f64::consts::FRAC_PI_4 * edges as f64;
        let edge_sd = EDGE_SIGMA_PX * edge_px / pixels.max(1) as f64;
        let scatter = jackknife(|k| counts[k][0] > 0, without);
        put(found, "canopy_cover", scatter.map(|scatter| scatter.hypot(edge_sd)));
        if let Some(weeds) = &self.field.weeds {
            let members = self.weeds.inside(polygon);
            let mut weed_px = [0.0; PARTS];
            for weed in members.iter().map(|&k| weeds[k]) {
                weed_px[parts.at(weed.position_px)] += weed.leaf_px;
            }
            found.weeds = Some(members.len() as f64);
            // A weed at the edge of the plot is counted in whole where its middle is.
            let crop = |pixels: usize, leaf: usize, weed_px: f64| {
                (pixels > 0).then(|| (leaf as f64 - weed_px).max(0.0) / pixels as f64)
            };
            let all_px = weed_px.iter().sum::<f64>();
            found.crop_cover = crop(pixels, leaf, all_px);
            let without =
                |k: usize| crop(pixels - counts[k][0], leaf - counts[k][1], all_px - weed_px[k]);
            let scatter = jackknife(|k| counts[k][0] > 0, without);
            put(found, "crop_cover", scatter.map(|scatter| scatter.hypot(edge_sd)));
        }
        pixels
    }

    /// Plants, gaps and spacing; after the area.
    fn add_plants(&self, found: &mut PlotTraits, polygon: &Polygon, valid: Option<&Mask>) {
        let field = self.field;
        let members = self.plants.inside(polygon);
        let area_m2 = found.area_m2.filter(|&area| area > 0.0);
        if field.plants.is_some() {
            let count = members.len() as f64;
            found.plants = Some(count);
            // The density is that of the area that shows something, so that only its plants are in it.
            let is_seen = |k: &&usize| {
                let at = field.plants.as_ref().and_then(|plants| plants.get(**k));
                at.is_none_or(|at| is_seen(valid, *at))
            };
            let seen = members.iter().filter(is_seen).count() as f64;
            found.plants_per_ha = area_m2.map(|area| seen / area * 1e4);
            let variance =
                members.iter().map(|&k| field.count_variance.get(k).copied()).sum::<Option<f64>>();
            let sd = variance.filter(|_| !field.count_variance.is_empty()).map(f64::sqrt);
            put(found, "plants", sd);
            let share = if count > 0.0 { seen / count } else { 0.0 };
            let per_ha = |(sd, area)| share * sd / area * 1e4;
            put(found, "plants_per_ha", sd.zip(area_m2).map(per_ha));
        }
        if let Some(gaps) = &field.gaps {
            let of_plot = self.gaps.inside(polygon);
            let gaps = || of_plot.iter().map(|&k| &gaps[k]);
            found.missing_plants = Some(gaps().map(|gap| gap.plants).sum());
            let variance =
                |gap: &RowGap| gap.plants.powi(2) * gap.probability * (1.0 - gap.probability);
            let variance: f64 = gaps().map(variance).sum();
            put(found, "missing_plants", variance.is_finite().then(|| variance.max(0.0).sqrt()));
        }
        let steps = self.steps_m(&members, valid);
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
        if let Some(count) =
            self.field.by_area.iter().flatten().find(|count| count.plot == found.plot)
        {
            let [number, low, high] =
                count.leaves.map(|number| Some(number).filter(|x| x.is_finite()));
            (found.leaves_by_area, found.leaves_by_area_low, found.leaves_by_area_high) =
                (number, low, high);
            // The interval reaches two standard deviations to either side.
            put(found, "leaves_by_area", low.zip(high).map(|(low, high)| (high - low) / 4.0));
        }
        let Some(leaves) = &self.field.leaves else { return };
        let leaves: Vec<&MeasuredLeaf> =
            self.leaves.inside(polygon).into_iter().map(|k| &leaves[k]).collect();
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
        let hues: Vec<f64> = leaves.iter().map(|leaf| leaf.hue_deg).collect();
        let hue_deg = mean_hue_deg(&hues).map(|(mean, sd)| {
            put(found, "leaf_hue_deg", sd);
            mean
        });
        (found.leaf_length_m, found.leaf_width_m, found.leaf_hue_deg) =
            (length_m, width_m, hue_deg);
    }

    /// Distances from each plant of an area to the next of its row, metres, each with its standard deviation where that of
    /// the plants is known; none across what the raster does not show, where other plants may stand.
    fn steps_m(&self, members: &[usize], valid: Option<&Mask>) -> Vec<(f64, Option<f64>)> {
        let field = self.field;
        let (Some(plants), Some(gsd_m)) = (&field.plants, field.gsd_m) else { return Vec::new() };
        let mut rows: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        for &k in members {
            if let Some(row) = field.row_of.get(k).filter(|row| row.is_finite()) {
                rows.entry(*row as u64).or_default().push(k);
            }
        }
        let steps = rows.values().flat_map(|row| {
            let places: Vec<[f64; 2]> = row.iter().map(|&k| plants[k]).collect();
            let order = along_the_row(&places);
            let step = |pair: &[usize]| {
                let [a, b] = [0, 1].map(|end| row[pair[end]]);
                if !is_seen_between(valid, plants[a], plants[b]) {
                    return None;
                }
                let sigma = |k: usize| field.along_sigma_px.get(k).filter(|x| x.is_finite());
                let sd = sigma(a).zip(sigma(b)).map(|(a, b)| gsd_m * a.hypot(*b));
                let apart = [0, 1].map(|axis| plants[a][axis] - plants[b][axis]);
                Some((gsd_m * apart[0].hypot(apart[1]), sd))
            };
            order.windows(2).filter_map(step).collect::<Vec<_>>()
        });
        steps.collect()
    }
}

/// Whether the raster shows something at a position.
fn is_seen(valid: Option<&Mask>, at: [f64; 2]) -> bool {
    valid.is_none_or(|valid| {
        let [u, v] = at.map(|x| x.round().max(0.0) as usize);
        u < valid.width && v < valid.height && valid.get(u, v)
    })
}

/// Whether the raster shows something all the way from one position to another.
fn is_seen_between(valid: Option<&Mask>, a: [f64; 2], b: [f64; 2]) -> bool {
    let [du, dv] = [0, 1].map(|axis| b[axis] - a[axis]);
    let steps = du.hypot(dv).ceil().max(1.0);
    (0..=steps as usize)
        .map(|k| k as f64 / steps)
        .all(|share| is_seen(valid, [a[0] + share * du, a[1] + share * dv]))
}

/// The mean direction of hues on the circle, degrees from 0 to 360, and its standard deviation where there are several:
/// the circular standard deviation over the root of their number. `None` without any, or where they cancel out.
///
/// Reference: K. V. Mardia and P. E. Jupp, "Directional Statistics", 2000, 2.2 and 2.3.
fn mean_hue_deg(hues_deg: &[f64]) -> Option<(f64, Option<f64>)> {
    let known = || hues_deg.iter().filter(|hue| hue.is_finite()).map(|hue| hue.to_radians());
    let n = known().count() as f64;
    let (sin, cos) = known().fold((0.0, 0.0), |sum, hue| (sum.0 + hue.sin(), sum.1 + hue.cos()));
    let length = (sin.hypot(cos) / n).min(1.0);
    // Directions that cancel out have no mean; rounding leaves some of them.
    if n == 0.0 || length <= 1e-9 {
        return None;
    }
    let sd = (n > 1.0).then(|| (-2.0 * length.ln()).max(0.0).sqrt().to_degrees() / n.sqrt());
    Some((sin.atan2(cos).to_degrees().rem_euclid(360.0), sd))
}

/// The volume is that of the whole area, where heights are known of `min_share` of it.
fn add_heights(found: &mut PlotTraits, canopy: Option<CanopyHeights>, min_share: f64) {
    let Some(canopy) = canopy else { return };
    found.canopy_height_m = Some(canopy.p95_m.value);
    found.canopy_height_mean_m = Some(canopy.mean_m.value);
    let known = canopy.area_m2.zip(found.area_m2);
    let area = known.filter(|(known, area)| *known >= min_share * area).map(|(_, area)| area);
    found.canopy_volume_m3 = area.map(|area| area * canopy.mean_m.value);
    put(found, "canopy_height_m", canopy.p95_m.sd);
    put(found, "canopy_height_mean_m", canopy.mean_m.sd);
    put(found, "canopy_volume_m3", area.zip(canopy.mean_m.sd).map(|(area, sd)| area * sd));
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

#[cfg(test)]
mod tests {
    use super::{
        super::{
            colour_indices::ColourSum, field_measurements::LeavesByArea, stand::Weed,
            traits::rounded,
        },
        *,
    };

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
            weeds: Some(vec![
                Weed { position_px: [1.0, 1.0], leaf_px: 2.0 },
                Weed { position_px: [8.0, 1.0], leaf_px: 5.0 },
            ]),
            rows: None,
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
        let seen = SeenField { mask: &mask, valid: None, min_valid_share: 0.5 };
        let area = |name| Area { name, polygon: &square, is_field: false };
        let (of_a, pixels) = field.index().traits(area("A"), seen, Some(&colours), None, &[]);
        assert_eq!(of_a.valid_share, Some(1.0));
        assert_eq!(pixels, 25);
        assert_eq!((of_a.area_m2, of_a.plants), (Some(6.25), Some(3.0)));
        assert_eq!(of_a.plants_per_ha, Some(4800.0));
        assert_eq!((of_a.missing_plants, of_a.canopy_cover), (Some(1.5), Some(0.4)));
        assert_eq!((of_a.weeds, of_a.crop_cover), (Some(1.0), Some(0.32)));
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
        let sd = |name: &str| of_a.more.get(&deviation_name(name)).copied();
        assert_eq!((sd("plants"), sd("plants_per_ha")), (Some(1.0), Some(1600.0)));
        assert_eq!(sd("missing_plants"), Some(rounded(1.5 * 0.16f64.sqrt())));
        assert_eq!(sd("longest_gap_m"), Some(0.25));
        assert_eq!(sd("plant_spacing_m"), Some(0.25));
        assert_eq!(sd("leaf_length_m"), Some(rounded(0.1)));
        // Only one part has leaf pixels with a colour, and one leaf a hue.
        assert_eq!((sd("exg"), sd("leaf_hue_deg"), sd("area_m2")), (None, None, None));
        assert!(sd("canopy_cover").unwrap() > 0.0);
        // Nothing was measured: what is not known is not zero.
        let (of_b, _) =
            FieldMeasurements::default().index().traits(area("B"), seen, None, None, &[]);
        assert_eq!((of_b.plant_spacing_m, of_b.exg), (None, None));
        assert_eq!((of_b.plants, of_b.area_m2, of_b.leaves_single), (None, None, None));
        assert_eq!(of_b.canopy_cover, Some(0.4));
        assert_eq!((of_b.weeds, of_b.crop_cover), (None, None));
    }

    /// Where heights are missing in a part of a plot, its volume is not smaller for that.
    #[test]
    fn volume_is_that_of_the_whole_area() {
        let volume = |known: f64| {
            let measured = Measured { value: 0.5, sd: Some(0.1) };
            let canopy =
                CanopyHeights { p95_m: measured, mean_m: measured, area_m2: Some(8.0 * known) };
            let mut found = PlotTraits { area_m2: Some(8.0), ..PlotTraits::default() };
            add_heights(&mut found, Some(canopy), 0.5);
            (found.canopy_volume_m3, found.more.get(&deviation_name("canopy_volume_m3")).copied())
        };
        assert_eq!(volume(1.0), (Some(4.0), Some(0.8)));
        assert_eq!(volume(0.6), volume(1.0));
        assert_eq!(volume(0.4), (None, None));
    }

    /// Of a plot of 10 x 10 pixels a part has no data.
    #[test]
    fn only_what_was_seen_counts() {
        let mask = Mask::from_fn(10, 10, |u, v| u == 2 && v < 8);
        let valid = Mask::from_fn(10, 10, |u, v| u < 4 && v < 8);
        let at = (0..4).map(|v| [2.0, 2.0 * f64::from(v)]).collect();
        let field = FieldMeasurements {
            gsd_m: Some(0.5),
            plants: Some(at),
            ..FieldMeasurements::default()
        };
        let square =
            Polygon { rings: vec![vec![[-0.5, -0.5], [9.5, -0.5], [9.5, 9.5], [-0.5, 9.5]]] };
        let traits = |min_valid_share: f64, is_field: bool| {
            let seen = SeenField { mask: &mask, valid: Some(&valid), min_valid_share };
            let area = Area { name: "A", polygon: &square, is_field };
            field.index().traits(area, seen, None, None, &[]).0
        };
        let of = traits(0.3, false);
        assert_eq!(
            (of.area_m2, of.valid_share, of.canopy_cover),
            (Some(8.0), Some(0.32), Some(0.25))
        );
        assert_eq!((of.plants, of.plants_per_ha), (Some(4.0), Some(5000.0)));
        // Too little of it for a number of plants, enough for one per area.
        let of = traits(0.5, false);
        assert_eq!((of.plants, of.plants_per_ha, of.leaves_single), (None, Some(5000.0), None));
        let of = traits(0.5, true);
        assert_eq!((of.plants, of.valid_share, of.area_m2), (Some(4.0), Some(1.0), Some(8.0)));
        // Nothing is known of a sliver without a pixel.
        let sliver = Polygon { rings: vec![vec![[2.1, 0.0], [2.3, 0.0], [2.3, 9.0], [2.1, 9.0]]] };
        let seen = SeenField { mask: &mask, valid: None, min_valid_share: 0.5 };
        let area = Area { name: "A", polygon: &sliver, is_field: false };
        assert_eq!(field.index().traits(area, seen, None, None, &[]).0.plants, None);
    }

    #[test]
    fn plants_on_both_sides_of_a_hole_are_no_neighbours() {
        let mask = Mask::from_fn(20, 3, |_, _| true);
        let valid = Mask::from_fn(20, 3, |u, _| !(6..9).contains(&u));
        let field = FieldMeasurements {
            gsd_m: Some(0.5),
            plants: Some([1.0, 3.0, 11.0, 15.0].map(|u| [u, 1.0]).to_vec()),
            row_of: vec![0.0; 4],
            ..FieldMeasurements::default()
        };
        let polygon =
            Polygon { rings: vec![vec![[-0.5, -0.5], [19.5, -0.5], [19.5, 2.5], [-0.5, 2.5]]] };
        let longest_m = |valid| {
            let seen = SeenField { mask: &mask, valid, min_valid_share: 0.5 };
            let area = Area { name: "A", polygon: &polygon, is_field: false };
            field.index().traits(area, seen, None, None, &[]).0.longest_gap_m
        };
        assert_eq!(longest_m(None), Some(4.0));
        assert_eq!(longest_m(Some(&valid)), Some(2.0));
    }

    #[test]
    fn hues_have_a_mean_on_the_circle() {
        let (mean, sd) = mean_hue_deg(&[355.0, 5.0, f64::NAN]).unwrap();
        assert!(mean.min(360.0 - mean) < 1e-9, "{mean}");
        // Half of ten degrees to either side.
        assert!((sd.unwrap() - 5.0 / 2f64.sqrt()).abs() < 0.01, "{sd:?}");
        assert_eq!(mean_hue_deg(&[90.0]).map(|(mean, sd)| (mean.round(), sd)), Some((90.0, None)));
        assert_eq!(mean_hue_deg(&[0.0, 180.0]), None);
        assert_eq!(mean_hue_deg(&[]), None);
    }
}
