//! Plants and gaps on the map, each with its plot and its place in the row.

use super::{Plot, Tables};
use rowgram_base::error::Error;
use rowgram_files::{
    csv_table::{CsvTable, CsvWriter},
    geoparquet,
    gpkg::{self, Column, ColumnKind, Feature, Geometry, GeometryKind, Layer, Value},
    qgis::{self, Style},
};
use rowgram_optim::output;
use rowgram_plants::phenotype::{
    plot_scatter::ValueParts,
    plots::Measured,
    row_plots::along_the_row,
    traits::{deviation_name, leaf_name},
};
use rowgram_raster::{
    georeference::{CrsKind, Georeference},
    polygon::Positions,
    spectral::Index,
};
use std::{collections::BTreeMap, path::Path};

/// Colour of plants that are sure.
const FOUND: [u8; 3] = [214, 39, 40];
/// Colour of gaps.
const MISSING: [u8; 3] = [31, 119, 180];
/// Classes of the confidence of a plant, as the report draws them.
const CONFIDENCES: [(f64, [u8; 3], &str); 2] =
    [(0.5, [255, 127, 14], "doubtful (confidence below 0.5)"), (1.0, FOUND, "plant")];

/// A layer of points with attributes, as a table and for GIS.
struct Points {
    name: &'static str,
    description: &'static str,
    columns: Vec<Column>,
    at_px: Vec<[f64; 2]>,
    values: Vec<Vec<Value>>,
}

/// Writes `plants.csv`, `gaps.csv` and the same as layers (`.gpkg`, `.parquet`), as far as earlier stages found any. `means` are the
/// indices over the leaf pixels of each plant, none where there are no indices.
///
/// # Errors
/// Tables that cannot be read, files that cannot be written.
pub(super) fn write(
    tables: &Tables,
    plots: &[Plot],
    (indices, means): (&[Index], &[Vec<ValueParts>]),
    place: Option<Georeference>,
    folder: &Path,
) -> Result<(), Error> {
    let plots_of = |at: &[[f64; 2]]| -> Vec<Option<usize>> {
        let places = Positions::new(at.iter().copied());
        let mut of = vec![None; at.len()];
        for (number, plot) in plots.iter().enumerate() {
            for k in places.inside(&plot.polygon) {
                of[k].get_or_insert(number);
            }
        }
        of
    };
    let name_of = |plot: Option<usize>| {
        plot.map_or(Value::Null, |plot| Value::Text(plots[plot].traits.plot.clone()))
    };
    let gsd_m = place.and_then(|place| place.gsd_m());
    if let Some(table) = read(tables.plants.as_deref())?
        && let Some(at_px) = table.pairs("u_px", "v_px")
    {
        let rows = table.numbers("row").unwrap_or_else(|| vec![f64::NAN; at_px.len()]);
        let plot = plots_of(&at_px);
        let places = places_in_row(&at_px, &rows, &plot);
        let mut columns = vec![
            Column::new("plant", ColumnKind::Integer),
            Column::new("plot", ColumnKind::Text),
            Column::new("row", ColumnKind::Integer),
            Column::new("place_in_row", ColumnKind::Integer),
        ];
        let mut numbers: Vec<Vec<f64>> = Vec::new();
        for name in ["confidence", "sigma_along_px", "sigma_across_px"] {
            let Some(mut values) = table.numbers(name) else { continue };
            let in_metres = name.strip_suffix("_px").zip(gsd_m);
            if let Some((_, gsd_m)) = in_metres {
                values.iter_mut().for_each(|value| *value *= gsd_m);
            }
            let name = in_metres.map_or(name.to_owned(), |(stem, _)| format!("{stem}_m"));
            columns.push(Column::new(&name, ColumnKind::Real));
            numbers.push(values);
        }
        for (number, index) in indices.iter().enumerate().filter(|_| means.len() == at_px.len()) {
            let of: Vec<Option<Measured>> =
                means.iter().map(|of_plant| of_plant.get(number)?.mean()).collect();
            let column = |value: fn(&Measured) -> Option<f64>| -> Vec<f64> {
                of.iter().map(|of| of.as_ref().and_then(value).unwrap_or(f64::NAN)).collect()
            };
            let name = leaf_name(&index.name);
            columns.push(Column::new(&name, ColumnKind::Real));
            numbers.push(column(|of| Some(of.value)));
            columns.push(Column::new(&deviation_name(&name), ColumnKind::Real));
            numbers.push(column(|of| of.sd));
        }
        let values = (0..at_px.len())
            .map(|k| {
                let mut values = vec![
                    Value::Integer(k as i64 + 1),
                    name_of(plot[k]),
                    whole(rows[k]),
                    places[k].map_or(Value::Null, |place| Value::Integer(place as i64)),
                ];
                let real = |x: f64| if x.is_nan() { Value::Null } else { Value::Real(x) };
                values.extend(numbers.iter().map(|column| real(column[k])));
                values
            })
            .collect();
        let description = "Plants that were located";
        let style = if table.texts("confidence").is_some() {
            Style::Points { by: "confidence", classes: &CONFIDENCES, size_mm: 1.6 }
        } else {
            Style::LabelledPoints { colour: FOUND, label: "plot" }
        };
        Points { name: "plants", description, columns, at_px, values }.write(place, folder)?;
        qgis::write(&folder.join("plants.qml"), true, &style)?;
    }
    if let Some(table) = read(tables.gaps.as_deref())?
        && let Some(at_px) = table.pairs("u_px", "v_px")
    {
        let numbers =
            |name: &str| table.numbers(name).unwrap_or_else(|| vec![f64::NAN; at_px.len()]);
        let (rows, missing, probability) =
            (numbers("row"), numbers("plants"), numbers("probability"));
        let length_px = numbers("length_px");
        let plot = plots_of(&at_px);
        let (length, unit) = gsd_m.map_or((1.0, "length_px"), |gsd_m| (gsd_m, "length_m"));
        let columns = vec![
            Column::new("plot", ColumnKind::Text),
            Column::new("row", ColumnKind::Integer),
            Column::new("plants", ColumnKind::Integer),
            Column::new(unit, ColumnKind::Real),
            Column::new("probability", ColumnKind::Real),
        ];
        let values = (0..at_px.len())
            .map(|k| {
                vec![
                    name_of(plot[k]),
                    whole(rows[k]),
                    whole(missing[k]),
                    Value::Real(length * length_px[k]),
                    Value::Real(probability[k]),
                ]
            })
            .collect();
        let description = "Gaps in the rows, and how many plants each lacks";
        Points { name: "gaps", description, columns, at_px, values }.write(place, folder)?;
        let style = Style::LabelledPoints { colour: MISSING, label: "plants" };
        qgis::write(&folder.join("gaps.qml"), true, &style)?;
    }
    Ok(())
}

fn read(path: Option<&Path>) -> Result<Option<CsvTable>, Error> {
    Ok(path.map(CsvTable::read).transpose()?)
}

fn whole(value: f64) -> Value {
    if value.is_finite() { Value::Integer(value as i64) } else { Value::Null }
}

/// The place of each plant in its row of its plot, from 1; `None` where it stands in no row.
fn places_in_row(at_px: &[[f64; 2]], rows: &[f64], plots: &[Option<usize>]) -> Vec<Option<usize>> {
    let mut groups: BTreeMap<(Option<usize>, u64), Vec<usize>> = BTreeMap::new();
    for (k, (row, plot)) in rows.iter().zip(plots).enumerate() {
        if row.is_finite() {
            groups.entry((*plot, *row as u64)).or_default().push(k);
        }
    }
    let mut places = vec![None; at_px.len()];
    for group in groups.values() {
        let at: Vec<[f64; 2]> = group.iter().map(|&k| at_px[k]).collect();
        for (place, member) in along_the_row(&at).into_iter().enumerate() {
            places[group[member]] = Some(place + 1);
        }
    }
    places
}

impl Points {
    fn write(self, place: Option<Georeference>, folder: &Path) -> Result<(), Error> {
        let map: Vec<[f64; 2]> = self
            .at_px
            .iter()
            .map(|&at| {
                let kind = place.map_or(CrsKind::Unknown, |place| place.crs.kind);
                kind.rounded(place.map_or(at, |place| place.map(at)))
            })
            .collect();
        let coordinates = match place {
            None => None,
            Some(_) if degrees(place) => Some(["longitude_deg", "latitude_deg"]),
            Some(place) if matches!(place.crs.kind, CrsKind::Feet | CrsKind::SurveyFeet) => {
                Some(["easting_ft", "northing_ft"])
            }
            Some(_) => Some(["easting_m", "northing_m"]),
        };
        let csv_path = folder.join(format!("{}.csv", self.name));
        output::write(&csv_path, true, |out| {
            let mut csv = CsvWriter::new(out);
            let own = self.columns.iter().map(|column| column.name.as_str());
            let header = coordinates.into_iter().flatten().chain(["u_px", "v_px"]).chain(own);
            csv.write_record(header)?;
            for ((at_px, at), values) in self.at_px.iter().zip(&map).zip(&self.values) {
                let at = coordinates.map(|_| at.map(|x| x.to_string()));
                let pixels = at_px.map(|x| format!("{x:.3}"));
                let values = values.iter().map(|value| match value {
                    Value::Null => String::new(),
                    Value::Integer(value) => value.to_string(),
                    Value::Real(value) => format!("{value:.4}"),
                    Value::Text(value) => value.clone(),
                });
                csv.write_record(at.into_iter().flatten().chain(pixels).chain(values))?;
            }
            csv.flush()
        })?;
        let features = map
            .iter()
            .zip(self.values)
            .map(|(&at, values)| Feature { geometry: Some(Geometry::Point(at)), values });
        let layer = Layer {
            name: self.name.to_owned(),
            description: self.description.to_owned(),
            kind: GeometryKind::Point,
            crs: place.map(|place| place.crs),
            columns: self.columns,
            features: features.collect(),
        };
        let path = |ending: &str| folder.join(format!("{}.{ending}", self.name));
        if geoparquet::IS_AVAILABLE {
            geoparquet::write(&path("parquet"), true, &layer)?;
        }
        if gpkg::IS_AVAILABLE {
            gpkg::write(&path("gpkg"), true, &[layer])?;
        }
        Ok(())
    }
}

fn degrees(place: Option<Georeference>) -> bool {
    place.is_some_and(|place| place.crs.kind == CrsKind::Geographic)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_count_within_the_row_of_the_plot() {
        let at = [[10.0, 0.0], [0.0, 0.0], [5.0, 0.1], [5.0, 20.0], [9.0, 9.0]];
        let rows = [0.0, 0.0, 0.0, 1.0, f64::NAN];
        let plots = [Some(1), Some(0), Some(0), Some(0), Some(0)];
        let places = places_in_row(&at, &rows, &plots);
        assert_eq!(places, [Some(1), Some(1), Some(2), Some(1), None]);
    }
}
