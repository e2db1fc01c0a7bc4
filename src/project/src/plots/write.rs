//! Traits as files: CSV wide and tidy, GeoJSON, GeoPackage, GeoParquet.

use super::Plot;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{
    csv_table::CsvWriter,
    geoparquet,
    gpkg::{self, Column, ColumnKind, Feature, Geometry, GeometryKind, Layer},
    polygons,
    qgis::{self, Style},
};
use rowgram_optim::output;
use rowgram_plants::phenotype::traits::{PlotTraits, Trait};
use rowgram_raster::{
    georeference::{CrsKind, Georeference},
    polygon::Polygon,
};
use serde_json::{Value, json};
use std::path::Path;

/// Writes all of them into a folder.
///
/// # Errors
/// Where a file cannot be written.
pub(super) fn traits(
    plots: &[Plot],
    all: &[Trait],
    place: Option<Georeference>,
    folder: &Path,
    monitor: &mut dyn Monitor,
) -> Result<(), Error> {
    let text = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
    let columns = columns(all);
    let attributes = attributes(plots, &columns, monitor);
    output::write(&folder.join("traits.csv"), true, |out| {
        let mut csv = CsvWriter::new(out);
        let own = attributes.iter().map(|of| of.name.as_str());
        let names = columns.iter().map(|column| column.name.as_str());
        csv.write_record(std::iter::once("plot").chain(names).chain(own))?;
        for plot in plots {
            let values = columns.iter().map(|column| text(column.value(&plot.traits)));
            let own = attributes.iter().map(|of| match of.value(plot) {
                Value::Null => String::new(),
                Value::String(text) => text.clone(),
                other => other.to_string(),
            });
            let name = plot.traits.plot.clone();
            csv.write_record(std::iter::once(name).chain(values).chain(own))?;
        }
        csv.flush()
    })?;
    output::write(&folder.join("traits_long.csv"), true, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record(["plot", "trait", "value", "unit", "standard_deviation"])?;
        for Plot { traits, .. } in plots {
            for of in all {
                if let Some(value) = of.value(traits) {
                    let sd = text(of.standard_deviation(traits));
                    csv.write_record([&traits.plot, &*of.name, &value.to_string(), of.unit, &sd])?;
                }
            }
        }
        csv.flush()
    })?;
    output::write(&folder.join("trait_dictionary.csv"), true, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record([
            "trait",
            "unit",
            "meaning",
            "method",
            "standard_deviation",
            "reference",
        ])?;
        for of in all {
            csv.write_record([
                &*of.name,
                of.unit,
                &of.meaning,
                &of.method,
                of.deviation,
                of.reference,
            ])?;
        }
        csv.flush()
    })?;
    let rings: Vec<Rings> = plots.iter().map(|plot| on_map(&plot.polygon, place)).collect();
    let layer = layer(plots, &columns, &attributes, &rings, place);
    if gpkg::IS_AVAILABLE {
        gpkg::write(&folder.join("traits.gpkg"), true, std::slice::from_ref(&layer))?;
    } else {
        left_out(monitor);
    }
    if geoparquet::IS_AVAILABLE {
        geoparquet::write(&folder.join("traits.parquet"), true, &layer)?;
    }
    let features = plots
        .iter()
        .zip(&rings)
        .map(|(plot, rings)| {
            let mut properties = json!(plot.traits);
            for of in attributes.iter().filter(|of| !of.value(plot).is_null()) {
                properties[&of.name] = of.value(plot).clone();
            }
            json!({
                "type": "Feature",
                "properties": properties,
                "geometry": polygons::geometry(rings),
            })
        })
        .collect();
    let crs = place.map(|place| place.crs);
    polygons::write_features(&folder.join(super::POLYGONS), true, features, crs)?;
    style(plots, all, folder)?;
    Ok(())
}

/// A column of numbers: a trait, or its standard deviation, which stands behind it.
struct NumberColumn<'a> {
    name: String,
    of: &'a Trait,
    is_deviation: bool,
}

impl NumberColumn<'_> {
    fn value(&self, plot: &PlotTraits) -> Option<f64> {
        if self.is_deviation { self.of.standard_deviation(plot) } else { self.of.value(plot) }
    }
}

/// The columns of numbers of every table of plots.
fn columns(all: &[Trait]) -> Vec<NumberColumn<'_>> {
    let both = |of| {
        let of: &Trait = of;
        let own = NumberColumn { name: of.name.to_string(), of, is_deviation: false };
        let sd = of.deviation_name().map(|name| NumberColumn { name, of, is_deviation: true });
        std::iter::once(own).chain(sd)
    };
    all.iter().flat_map(both).collect()
}

/// What polygons say of plots beside their names: genotype, treatment, block.
struct Attribute {
    /// Its name as the plots have it.
    own: String,
    /// Its name as a column of the tables.
    name: String,
    kind: ColumnKind,
}

impl Attribute {
    /// Its value for a plot.
    fn value<'a>(&self, plot: &'a Plot) -> &'a Value {
        let found = plot.attributes.iter().find(|(name, _)| is_same(name, &self.own));
        found.map_or(&Value::Null, |(_, value)| value)
    }
}

/// Columns that every table of plots has beside traits and attributes.
const OWN_COLUMNS: [&str; 3] = ["fid", "geom", "plot"];

/// Whether two names are one column: in tables of SQL upper and lower case are the same.
fn is_same(one: &str, other: &str) -> bool {
    one.to_lowercase() == other.to_lowercase()
}

/// The attributes of the plots in the order in which they first appear. One with the name of a trait is left out: it
/// is of an earlier table of traits. One with the name of another column gets another one.
fn attributes(
    plots: &[Plot],
    columns: &[NumberColumn<'_>],
    monitor: &mut dyn Monitor,
) -> Vec<Attribute> {
    let mut found: Vec<Attribute> = Vec::new();
    let mut taken: Vec<String> = Vec::new();
    for (name, value) in plots.iter().flat_map(|plot| &plot.attributes) {
        let is_taken = |other: &str| is_same(other, name);
        if columns.iter().any(|column| is_taken(&column.name)) {
            if !taken.contains(name) {
                taken.push(name.clone());
            }
            continue;
        }
        let kind = if value.is_number() { ColumnKind::Real } else { ColumnKind::Text };
        match found.iter_mut().find(|of| is_taken(&of.own)) {
            Some(of) if of.kind != kind => of.kind = ColumnKind::Text,
            Some(_) => {}
            None => found.push(Attribute { own: name.clone(), name: name.clone(), kind }),
        }
    }
    let mut renamed = Vec::new();
    for k in 0..found.len() {
        let is_free = |name: &str| {
            let others = found.iter().enumerate().filter(|(j, _)| *j != k);
            !OWN_COLUMNS.iter().any(|own| is_same(own, name))
                && !columns.iter().any(|column| is_same(&column.name, name))
                && !others.into_iter().any(|(_, other)| is_same(&other.name, name))
        };
        let mut name = found[k].name.clone();
        if name.trim().is_empty() {
            name = "attribute".to_owned();
        }
        while !is_free(&name) {
            name += "_of_plot";
        }
        if name != found[k].name {
            renamed.push(format!("{:?} to {name:?}", found[k].own));
            found[k].name = name;
        }
    }
    if !renamed.is_empty() {
        let message = format!(
            "attributes with the names of other columns are renamed: {}",
            renamed.join(", ")
        );
        monitor.diagnostic(&Diagnostic::info("attributes-renamed", "plots", message));
    }
    if !taken.is_empty() {
        let message =
            format!("attributes with the names of traits are not kept: {}", taken.join(", "));
        monitor.diagnostic(&Diagnostic::info("attributes-left-out", "plots", message));
    }
    found
}

/// How the layers of plots open in QGIS: coloured by the first of some traits that was measured.
fn style(plots: &[Plot], all: &[Trait], folder: &Path) -> Result<(), Error> {
    let values = |of: &Trait| -> Vec<f64> {
        plots.iter().filter_map(|plot| of.value(&plot.traits)).filter(|x| x.is_finite()).collect()
    };
    let by = ["plants_per_ha", "plants", "canopy_cover"];
    let known = by.iter().filter_map(|name| {
        let values = values(all.iter().find(|of| of.name == *name)?);
        (!values.is_empty()).then_some((*name, values))
    });
    let Some((by, values)) = known.into_iter().next() else { return Ok(()) };
    let range = [
        values.iter().copied().fold(f64::INFINITY, f64::min),
        values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
    ];
    let style = Style::Polygons { by, range, label: "plot" };
    Ok(qgis::write(&folder.join("traits.qml"), true, &style)?)
}

/// Closed rings of map positions.
type Rings = Vec<Vec<[f64; 2]>>;

fn on_map(polygon: &Polygon, place: Option<Georeference>) -> Rings {
    let kind = place.map_or(CrsKind::Unknown, |place| place.crs.kind);
    let ring = |ring: &Vec<[f64; 2]>| {
        let closed = ring.iter().chain(ring.first());
        closed.map(|&at| kind.rounded(place.map_or(at, |place| place.map(at)))).collect()
    };
    polygon.rings.iter().map(ring).collect()
}

fn left_out(monitor: &mut dyn Monitor) {
    let message = "not written: this build of rowgram has no GeoPackages";
    let remedy = "take traits.geojson, or build with the Cargo feature geopackage";
    let found = Diagnostic::info("output-left-out", "traits.gpkg", message).with_remedy(remedy);
    monitor.diagnostic(&found);
}

/// The same as a layer; the unit of a trait is in its name.
fn layer(
    plots: &[Plot],
    numbers: &[NumberColumn<'_>],
    attributes: &[Attribute],
    rings: &[Rings],
    place: Option<Georeference>,
) -> Layer {
    let columns = std::iter::once(Column::new("plot", ColumnKind::Text))
        .chain(numbers.iter().map(|column| Column::new(&column.name, ColumnKind::Real)))
        .chain(attributes.iter().map(|of| Column::new(&of.name, of.kind)));
    let feature = |(plot, rings): (&Plot, &Rings)| {
        let number = |value: Option<f64>| value.map_or(gpkg::Value::Null, gpkg::Value::Real);
        let values = numbers.iter().map(|column| number(column.value(&plot.traits)));
        let own = attributes.iter().map(|of| match (of.value(plot), of.kind) {
            (Value::Null, _) => gpkg::Value::Null,
            (value, ColumnKind::Real) => number(value.as_f64()),
            (Value::String(text), _) => gpkg::Value::Text(text.clone()),
            (other, _) => gpkg::Value::Text(other.to_string()),
        });
        let name = gpkg::Value::Text(plot.traits.plot.clone());
        Feature {
            geometry: Some(Geometry::Polygon(rings.clone())),
            values: std::iter::once(name).chain(values).chain(own).collect(),
        }
    };
    Layer {
        name: "plots".to_owned(),
        description: "Traits of plots".to_owned(),
        kind: GeometryKind::Polygon,
        crs: place.map(|place| place.crs),
        columns: columns.collect(),
        features: plots.iter().zip(rings).map(feature).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_base::monitor::Collector;
    use rowgram_plants::phenotype::traits::TRAITS;

    #[test]
    fn attributes_with_the_names_of_columns_are_renamed_and_keep_their_values() {
        let names = ["geom", "FID", "Plot", "", "genotype", "area_m2", "É", "geom_of_plot"];
        let of = |names: &[&str]| {
            let attributes = names.iter().map(|&name| (name.to_owned(), json!(name))).collect();
            Plot { traits: PlotTraits::default(), polygon: Polygon::default(), attributes }
        };
        let plots = [of(&names), of(&["é", "GEOM"])];
        let mut collector = Collector::default();
        let found = attributes(&plots, &columns(TRAITS), &mut collector);
        let columns: Vec<&str> = found.iter().map(|of| of.name.as_str()).collect();
        assert_eq!(
            columns,
            [
                "geom_of_plot_of_plot",
                "FID_of_plot",
                "Plot_of_plot",
                "attribute",
                "genotype",
                "É",
                "geom_of_plot"
            ]
        );
        assert_eq!(found[0].value(&plots[0]), "geom");
        assert_eq!(found[0].value(&plots[1]), "GEOM");
        let codes: Vec<&str> = collector.diagnostics.iter().map(|of| &*of.code).collect();
        assert_eq!(codes, ["attributes-renamed", "attributes-left-out"]);
    }
}
