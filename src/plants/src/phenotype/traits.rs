//! The traits of plots: what each is, how it comes about, and the values of one plot.

use rowgram_raster::spectral::{Index, KNOWN, KnownIndex};
use serde::{Deserialize, Serialize};
use std::{borrow::Cow, collections::BTreeMap};

/// Traits of one plot, rounded to six significant digits; `None` where the trait is not known.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PlotTraits {
    /// Name of the plot.
    pub plot: String,
    /// Area of what the map shows of the plot, square metres on the ground.
    pub area_m2: Option<f64>,
    /// Share of the plot that the map shows.
    pub valid_share: Option<f64>,
    /// Plants that were located.
    pub plants: Option<f64>,
    /// Plants by area, per hectare.
    pub plants_per_ha: Option<f64>,
    /// Plants that gaps in the rows lack.
    pub missing_plants: Option<f64>,
    /// Share of the area that leaves cover.
    pub canopy_cover: Option<f64>,
    /// The same without weeds between the rows.
    pub crop_cover: Option<f64>,
    /// Weeds between the rows.
    pub weeds: Option<f64>,
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
    /// Share of the rows' length that leaf covers.
    pub row_cover: Option<f64>,
    /// Share of the rows' length in long gaps.
    pub row_gap_share: Option<f64>,
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
    /// Spectral indices under their names, and standard deviations in the units of the traits, under the names of the traits with
    /// `_sd` behind.
    #[serde(flatten)]
    pub more: BTreeMap<String, f64>,
}

/// The name of the standard deviation of a trait.
pub fn deviation_name(of: &str) -> String {
    format!("{of}_sd")
}

/// Notes a standard deviation where there is one.
pub(super) fn put(found: &mut PlotTraits, name: &str, sd: Option<f64>) {
    if let Some(sd) = sd.filter(|sd| sd.is_finite()) {
        found.more.insert(deviation_name(name), sd);
    }
}

/// A trait of plots.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trait {
    /// Its name, with its unit.
    pub name: Cow<'static, str>,
    /// Its unit after UCUM; `1` for numbers and shares.
    pub unit: &'static str,
    /// What it is.
    pub meaning: Cow<'static, str>,
    /// How it comes about.
    pub method: Cow<'static, str>,
    /// What defines it; empty where the method says it all.
    pub reference: &'static str,
    /// How its standard deviation comes about; empty where it has none.
    pub deviation: &'static str,
}

impl Trait {
    /// Its value in a plot, in its unit.
    pub fn value(&self, plot: &PlotTraits) -> Option<f64> {
        plot.value(&self.name)
    }

    /// Its standard deviation in a plot, in its unit.
    pub fn standard_deviation(&self, plot: &PlotTraits) -> Option<f64> {
        plot.more.get(&deviation_name(&self.name)).copied()
    }

    /// The name of its standard deviation; `None` where it has none.
    pub fn deviation_name(&self) -> Option<String> {
        (!self.deviation.is_empty()).then(|| deviation_name(&self.name))
    }
}

impl Trait {
    /// A number as near as the trait can be to it: shares lie between 0 and 1, numbers, lengths and areas are not negative.
    pub fn within_range(&self, value: f64) -> f64 {
        let is_height = self.name.starts_with("canopy_height") || self.unit == "m3";
        match (&*self.name, self.unit) {
            ("valid_share" | "canopy_cover" | "crop_cover" | "row_cover" | "row_gap_share", _) => {
                value.clamp(0.0, 1.0)
            }
            ("plants" | "missing_plants" | "weeds" | "plant_spacing_cv", _) => value.max(0.0),
            (name, _) if name.starts_with("leaves_") => value.max(0.0),
            // The surface may lie below the ground by its noise.
            (_, "m2" | "m" | "1/ha") if !is_height => value.max(0.0),
            _ => value,
        }
    }
}

impl PlotTraits {
    /// Leaves out the numbers of the whole plot, where too little of it was seen.
    pub(super) fn without_totals(&mut self) {
        let totals = [
            ("plants", &mut self.plants),
            ("missing_plants", &mut self.missing_plants),
            ("weeds", &mut self.weeds),
            ("leaves_by_area", &mut self.leaves_by_area),
            ("leaves_by_area_low", &mut self.leaves_by_area_low),
            ("leaves_by_area_high", &mut self.leaves_by_area_high),
            ("leaves_single", &mut self.leaves_single),
            ("canopy_volume_m3", &mut self.canopy_volume_m3),
        ];
        for (name, value) in totals {
            *value = None;
            self.more.remove(&deviation_name(name));
        }
    }
}

/// From the scatter between parts of the plot.
const PARTS_SD: &str = "scatter between 16 parts of the plot (jackknife)";
/// Of a cover.
const COVER_SD: &str = "scatter between 16 parts of the plot (jackknife), and the edges of all leaves off by 0.29 pixels";
/// Of a mean.
const MEAN_SD: &str = "scatter of the single values over the root of their number";

macro_rules! traits {
    ($($name:ident, $unit:literal, $meaning:literal, $method:literal, $reference:literal, $deviation:expr;)*) => {
        /// All traits of plots in their order.
        pub const TRAITS: &[Trait] = &[
            $(Trait {
                name: Cow::Borrowed(stringify!($name)),
                unit: $unit,
                meaning: Cow::Borrowed($meaning),
                method: Cow::Borrowed($method),
                reference: $reference,
                deviation: $deviation,
            },)*
        ];

        impl PlotTraits {
            pub(super) fn rounded(mut self) -> PlotTraits {
                $(self.$name = self.$name.map(rounded);)*
                self.more.values_mut().for_each(|value| *value = rounded(*value));
                self
            }

            /// The value of a trait or index by its name.
            pub fn value(&self, name: &str) -> Option<f64> {
                match name {
                    $(stringify!($name) => self.$name,)*
                    other => self.more.get(other).copied(),
                }
            }

            /// Notes the value of an index, which may go by the name of a colour index.
            pub(super) fn set(&mut self, name: &str, value: Option<f64>) {
                match name {
                    $(stringify!($name) => self.$name = value,)*
                    other => {
                        if let Some(value) = value {
                            self.more.insert(other.to_owned(), value);
                        }
                    }
                }
            }
        }
    };
}

traits! {
    area_m2, "m2", "area of what the map shows of the plot",
        "pixels with data whose centre is in the polygon, times the area of a pixel on the ground", "", "";
    valid_share, "1", "share of the plot that the map shows",
        "pixels with data over all pixels of the polygon; below [plots] min_valid_share numbers of the whole plot are left empty", "", "";
    plants, "1", "plants that were located",
        "plants of the stage locate that stand in the polygon", "", "intervals of the rows, each row's variance shared out by its plants in the plot; without rows from the confidence of the plants";
    plants_per_ha, "1/ha", "plants by area",
        "plants over area_m2, times 10,000; the stage locate and the report divide by the row area instead, length of the rows times the distance between them", "", "that of plants over area_m2, times 10,000";
    missing_plants, "1", "plants that gaps in the rows lack",
        "most probable number of missing plants of each gap whose middle is in the polygon; the ends of rows, and stretches that neighbouring rows share, are left out", "", "probabilities of the gaps";
    canopy_cover, "1", "share of the area that leaves cover",
        "leaf pixels over pixels with data of the polygon", "", COVER_SD;
    crop_cover, "1", "share of the area that leaves cover, without weeds between the rows",
        "the same without the leaf pixels of weeds that the stage locate left out; weeds within rows count as crop", "", COVER_SD;
    weeds, "1", "weeds between the rows",
        "patches that the stage locate left out, as they stand between rows more probably than in them", "", "";
    leaves_by_area, "1", "leaf pixels over leaf pixels per leaf",
        "stage leaf-count", "Ribera et al. 2016, KDD workshop on data science for food, energy and water", "interval of 95 %, a quarter of its width";
    leaves_by_area_low, "1", "lower end of the 95 % interval",
        "stage leaf-count", "", "";
    leaves_by_area_high, "1", "upper end of the 95 % interval",
        "stage leaf-count", "", "";
    leaves_single, "1", "leaves that were told apart",
        "leaves of the stage leaves whose middle is in the polygon", "", "";
    leaf_length_m, "m", "mean length of these leaves",
        "along the axis of the leaf in the plane of the map", "", MEAN_SD;
    leaf_width_m, "m", "mean width of these leaves",
        "mean of the widths across the axis of the leaf, at each point of it", "", MEAN_SD;
    leaf_hue_deg, "deg", "mean hue of these leaves",
        "mean direction on the circle of the hues of the leaves", "", MEAN_SD;
    plant_spacing_m, "m", "mean distance of neighbouring plants of a row",
        "from each plant to the next of its row within the polygon", "", MEAN_SD;
    plant_spacing_cv, "1", "standard deviation of that distance over its mean",
        "of the same distances, from two on", "", "of the coefficient of variation of n normal distances, cv sqrt((1 + 2 cv^2) / 2n)";
    longest_gap_m, "m", "greatest distance of neighbouring plants of a row",
        "of the same distances", "", "standard deviations of the two plants along the row";
    row_cover, "1", "share of the rows' length that leaf covers",
        "places along the rows, a pixel apart, with leaf within a quarter of the distance between rows, over all of them in the polygon; a row goes on to where its line leaves the polygon, and where the map shows nothing has no places", "", PARTS_SD;
    row_gap_share, "1", "share of the rows' length in gaps of [plots] min_gap_m and more",
        "places in stretches without leaf that are so long within the polygon, over all of them", "Stolf 1986, STAB 4(6), 22-36", PARTS_SD;
    canopy_height_m, "m", "height of the canopy over the ground",
        "95th percentile of the cells of the raster chm.tif inside the polygon (stage surface)", "",
        "scatter between 16 parts of the plot (jackknife), and two cells of the surface, by which all plots of a flight may be off";
    canopy_height_mean_m, "m", "mean height over the ground",
        "mean of the same cells, soil between plants among them", "", PARTS_SD;
    canopy_volume_m3, "m3", "volume between surface and ground",
        "canopy_height_mean_m times area_m2, where heights are known of [plots] min_valid_share of it", "", PARTS_SD;
    exg, "1", "excess green of the leaf pixels, 2 g - r - b",
        "of the mean colour of the leaf pixels in the orthomosaic", "Woebbecke et al. 1995, Trans. ASAE 38, 259-269", PARTS_SD;
    gli, "1", "green leaf index of the leaf pixels, (2 G - R - B) / (2 G + R + B)",
        "of the mean colour of the leaf pixels in the orthomosaic", "Louhaichi et al. 2001, Geocarto Int. 16, 65-70", PARTS_SD;
    ngrdi, "1", "normalized green-red difference index of the leaf pixels, (G - R) / (G + R)",
        "of the mean colour of the leaf pixels in the orthomosaic", "Tucker 1979, Remote Sens. Environ. 8, 127-150", PARTS_SD;
    vari, "1", "visible atmospherically resistant index of the leaf pixels, (G - R) / (G + R - B)",
        "of the mean colour of the leaf pixels in the orthomosaic", "Gitelson et al. 2002, Remote Sens. Environ. 80, 76-87", PARTS_SD;
    tgi, "1", "triangular greenness index of the leaf pixels, (G - 0.39 R - 0.61 B) / 255",
        "of the mean colour of the leaf pixels in the orthomosaic", "Hunt et al. 2011, Agron. J. 103, 1090-1099", PARTS_SD;
    a_star, "1", "a* (CIELAB, D65) of the leaf pixels; green is negative",
        "of the mean colour of the leaf pixels in the orthomosaic", "CIE 15; IEC 61966-2-1", PARTS_SD;
}

/// Traits of leaf pixels by their colours, whose names an index of the same name takes over.
const COLOUR_TRAITS: [&str; 6] = ["exg", "gli", "ngrdi", "vari", "tgi", "a_star"];

/// The column of an index over leaf pixels alone.
pub fn leaf_name(index: &str) -> String {
    format!("{index}_leaf")
}

/// All traits of plots of which these indices were measured, in their order.
pub fn traits_with(indices: &[Index]) -> Vec<Trait> {
    let is_index = |of: &&Trait| indices.iter().any(|index| index.name == of.name);
    let own = TRAITS.iter().filter(|of| !is_index(of)).cloned();
    own.chain(indices.iter().flat_map(of_index)).collect()
}

/// All traits that are the same in every project: those without indices, and the known indices.
pub fn known_traits() -> Vec<Trait> {
    let index =
        |of: &KnownIndex| Index { name: of.name.to_owned(), formula: of.formula.to_owned() };
    traits_with(&KNOWN.iter().map(index).collect::<Vec<_>>())
}

/// Whether an index can have its name: no other column of the tables of plots has it.
///
/// # Errors
/// The column that it would be.
pub fn check_index_name(index: &Index) -> Result<(), String> {
    let taken = TRAITS.iter().find(|of| {
        let is_own = |name: &str| name == index.name || name == leaf_name(&index.name);
        let is_colour = COLOUR_TRAITS.contains(&&*of.name);
        !is_colour && (is_own(&of.name) || of.deviation_name().is_some_and(|name| is_own(&name)))
    });
    let others =
        ["plot", "plant", "row", "fid", "geom"].into_iter().find(|name| *name == index.name);
    match taken.map(|of| &*of.name).or(others) {
        None => Ok(()),
        Some(name) => Err(format!("{name:?} is a column already: give the index another name")),
    }
}

fn of_index(index: &Index) -> [Trait; 2] {
    let Index { name, formula } = index;
    let known = index.known();
    let what = known.map_or_else(|| formula.clone(), |of| format!("{}, {formula}", of.meaning));
    let reference = known.map_or("", |of| of.reference);
    let of = |name: String, area: &str, pixels: &str| Trait {
        name: name.into(),
        unit: "1",
        meaning: format!("{what}; {area}").into(),
        method: format!("mean of its value in each {pixels} where it is defined").into(),
        reference,
        deviation: PARTS_SD,
    };
    [
        of(name.clone(), "of all ground", "pixel with data of the polygon"),
        of(leaf_name(name), "of the leaves", "leaf pixel of the polygon"),
    ]
}

/// The traits as a page: a table of name, unit, meaning, method and reference.
///
/// `docs/traits.md` is this text, and a test compares the two.
pub fn dictionary_page() -> String {
    let mut page = String::from(
        "# Traits of plots\n\n\
         Every column of `traits.csv`, of the layer `plots` in `traits.gpkg` and of `traits.geojson`. The same table is written beside them as\n\
         `trait_dictionary.csv`. Units are after UCUM; 1 stands for numbers and shares. A trait without a value was not measured: a map without\n\
         scale has no areas, a mask without picture no colours. Colour indices are those of the map as it is; only dates of a season have one scale of colours.\n\n\
         The standard deviation of a trait is in the column with `_sd` behind its name, in the same unit. It says how far another map of the same\n\
         plot, or another part of the same stand, may differ; what is common to the whole plot is in it only\n\
         where the table names it.\n\n\
         | trait | unit | what it is | how | standard deviation | reference |\n|---|---|---|---|---|---|\n",
    );
    for of in TRAITS {
        page += &format!(
            "| `{}` | {} | {} | {} | {} | {} |\n",
            of.name, of.unit, of.meaning, of.method, of.deviation, of.reference
        );
    }
    page += "\n## Spectral indices\n\n\
         Where the orthomosaic has more bands than three, `[plots] indices` says which indices are measured ([how](guide.md#bands-beyond-colours)). An index\n\
         `ndvi` has two columns, each with a standard deviation (scatter between 16 parts of the plot, jackknife): `ndvi`, the mean over all\n\
         pixels with data, and `ndvi_leaf`, the mean over the leaf pixels. An index that has the name of a colour index (`vari`) takes its place.\n\n\
         | index | formula | what it is | reference |\n|---|---|---|---|\n";
    for of in KNOWN {
        page +=
            &format!("| `{}` | {} | {} | {} |\n", of.name, of.formula, of.meaning, of.reference);
    }
    page
}

/// Six significant digits; zero without a sign, which a sum of nothing has.
pub(super) fn rounded(value: f64) -> f64 {
    if value == 0.0 {
        return 0.0;
    }
    if !value.is_finite() {
        return value;
    }
    let unit = 10f64.powi(5 - value.abs().log10().floor() as i32);
    (value * unit).round() / unit
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_dictionary_page_is_what_is_measured() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/traits.md");
        let page = std::fs::read_to_string(path).unwrap();
        assert_eq!(page, dictionary_page(), "cargo run -p experiments -- pages");
        assert!(TRAITS.iter().all(|of| !of.method.is_empty()));
    }

    #[test]
    fn ranges_are_those_of_the_traits() {
        let range = |name: &str| {
            let of = TRAITS.iter().find(|of| of.name == name).unwrap();
            [-2.0, 2.0].map(|value| of.within_range(value))
        };
        assert_eq!(range("row_cover"), [0.0, 1.0]);
        assert_eq!(range("plants_per_ha"), [0.0, 2.0]);
        assert_eq!(range("leaves_by_area"), [0.0, 2.0]);
        assert_eq!(range("canopy_height_m"), [-2.0, 2.0]);
        assert_eq!(range("ngrdi"), [-2.0, 2.0]);
    }

    #[test]
    fn standard_deviations_stand_beside_the_traits() {
        let sd = [(deviation_name("plants"), 2.345_678_9)];
        let plot = PlotTraits {
            plot: "A".to_owned(),
            plants: Some(30.0),
            missing_plants: Some(-0.0),
            more: sd.into_iter().collect(),
            ..PlotTraits::default()
        }
        .rounded();
        let json = serde_json::to_string(&plot).unwrap();
        assert!(json.contains("\"missing_plants\":0.0"), "{json}");
        assert!(json.contains("\"plants_sd\":2.34568"), "{json}");
        assert_eq!(serde_json::from_str::<PlotTraits>(&json).unwrap(), plot);
        let of = TRAITS.iter().find(|of| of.name == "plants").unwrap();
        assert_eq!(of.standard_deviation(&plot), Some(2.345_68));
        let area = TRAITS.iter().find(|of| of.name == "area_m2").unwrap();
        assert_eq!((area.deviation_name(), area.standard_deviation(&plot)), (None, None));
    }

    #[test]
    fn indices_are_traits_like_the_others() {
        let list = |words: &[&str]| {
            Index::list(&words.iter().map(|&word| word.to_owned()).collect::<Vec<_>>()).unwrap()
        };
        let all = traits_with(&list(&["ndvi", "vari = (green - red) / (green + red - blue)"]));
        let names: Vec<&str> = all.iter().skip(TRAITS.len() - 1).map(|of| &*of.name).collect();
        assert_eq!(names, ["ndvi", "ndvi_leaf", "vari", "vari_leaf"]);
        assert_eq!(all.iter().filter(|of| of.name == "vari").count(), 1);
        assert!(all[TRAITS.len() - 1].reference.starts_with("Rouse"));
        let mut plot = PlotTraits { plot: "A".to_owned(), ..PlotTraits::default() };
        plot.set("ndvi", Some(0.5));
        plot.set("vari", Some(0.25));
        plot.set("ndvi_leaf", None);
        let read: PlotTraits =
            serde_json::from_str(&serde_json::to_string(&plot).unwrap()).unwrap();
        let values: Vec<_> = names.iter().map(|name| read.value(name)).collect();
        assert_eq!(values, [Some(0.5), None, Some(0.25), None]);
        for (index, is_free) in
            [("ndvi", true), ("vari = nir", true), ("plants = nir", false), ("plot = red", false)]
        {
            assert_eq!(check_index_name(&list(&[index])[0]).is_ok(), is_free, "{index}");
        }
    }
}
