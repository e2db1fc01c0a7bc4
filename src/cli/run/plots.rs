//! Traits of every plot: from polygons, from a grid that the rows give, or of the whole field.
//!
//! Written as a wide table (`traits.csv`), a tidy one (`traits_long.csv`: plot, trait, value, unit), polygons with
//! the traits (`traits.geojson`), and observations after BrAPI's names (`traits.brapi.json`).

use super::step::Place;
use crate::{
    error::Error,
    io::{
        FileError,
        csv_table::CsvTable,
        gpkg::{self, Column, ColumnKind, Feature, Geometry, GeometryKind, Layer},
        output, polygons,
        rasters::Source,
    },
    raster::{georeference::Georeference, polygon::Polygon},
};
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};

/// Why there are no plots.
pub(super) enum Missing {
    /// There is nothing to be said of them.
    Nothing(String),
    /// Something is wrong.
    Fault(Error),
}

/// What is read.
pub(super) struct Inputs {
    mask: PathBuf,
    polygons: Option<PathBuf>,
    plants: Option<PathBuf>,
    gaps: Option<PathBuf>,
    leaves: Option<PathBuf>,
    counts: Option<PathBuf>,
    grid: Option<(usize, f64)>,
    name: String,
}

impl Inputs {
    pub(super) fn of(place: &Place<'_>) -> Result<Inputs, Missing> {
        let file = |stage: &str, name: &str| Some(place.at(stage, name)).filter(|p| p.is_file());
        let Some(mask) = file("segment", "mask.tif") else {
            return Err(Missing::Nothing("there is no mask".to_owned()));
        };
        let config = &place.config.plots;
        let grid = match (config.rows_per_plot, config.alley_m) {
            (Some(rows), Some(alley)) if rows > 0 && alley > 0.0 => Some((rows, alley)),
            (None, None) => None,
            _ => {
                let message = "[plots]: expected both rows_per_plot (1 or more) and alley_m (metres), or neither";
                return Err(Missing::Fault(Error::Argument(message.into())));
            }
        };
        Ok(Inputs {
            mask,
            polygons: place.polygons(place.config.project.plots.as_ref(), "plots"),
            plants: file("locate", "plants.csv"),
            gaps: file("locate", "gaps.csv"),
            leaves: file("leaves", "leaves.csv"),
            counts: file("count", "counts.csv"),
            grid,
            // Not the folder's name: a project that moves keeps its bytes.
            name: place.config.project.name.clone().unwrap_or_else(|| "field".into()),
        })
    }

    pub(super) fn files(&self) -> Vec<PathBuf> {
        let optional = [&self.plants, &self.gaps, &self.leaves, &self.counts];
        let tables = optional.into_iter().flatten().cloned();
        let polygons = self.polygons.iter().flat_map(|path| polygons::files(path));
        std::iter::once(self.mask.clone()).chain(polygons).chain(tables).collect()
    }

    pub(super) fn key(&self) -> String {
        format!("{}, grid {:?}", self.name, self.grid)
    }
}

/// A plot, and its traits as name, unit, value.
struct Plot {
    name: String,
    polygon: Polygon,
    traits: Vec<Trait>,
}

/// Name, unit, what it is, value.
type Trait = (&'static str, &'static str, &'static str, Option<f64>);

/// Measures and writes.
///
/// # Errors
/// Where a file cannot be read or written.
pub(super) fn work(inputs: &Inputs, folder: &Path) -> Result<Value, Error> {
    let source = Source::open(&inputs.mask)?;
    let place = source.georeference();
    let (width, height) = source.size();
    let mask = source.mask(|photo| crate::raster::mask::Thresholds::default().mask(photo))?;
    let table = |path: &Option<PathBuf>| path.as_deref().map(CsvTable::read).transpose();
    let (plants, gaps) = (table(&inputs.plants)?, table(&inputs.gaps)?);
    let (leaves, counts) = (table(&inputs.leaves)?, table(&inputs.counts)?);
    let gsd_m = place.and_then(|place| place.gsd_m());
    let whole = || {
        let [u, v] = [width as f64, height as f64];
        let ring = vec![[-0.5, -0.5], [u - 0.5, -0.5], [u - 0.5, v - 0.5], [-0.5, v - 0.5]];
        vec![("field".to_owned(), Polygon { rings: vec![ring] })]
    };
    let (from, areas) = match (&inputs.polygons, inputs.grid, &plants) {
        (Some(path), _, _) => {
            let named = polygons::read(path, place.as_ref())?;
            ("polygons", named.into_iter().map(|plot| (plot.name, plot.polygon)).collect())
        }
        (None, Some((rows, alley_m)), Some(plants)) => {
            let gsd_m = gsd_m.ok_or_else(|| {
                Error::Argument("[plots] alley_m: the orthomosaic has no scale in metres".into())
            })?;
            ("grid", grid(plants, rows, alley_m / gsd_m))
        }
        _ => ("whole field", whole()),
    };
    let measured = Measured {
        plants: plants.as_ref().and_then(|table| table.pairs("u_px", "v_px")),
        gaps: gaps
            .as_ref()
            .and_then(|table| table.pairs("u_px", "v_px").zip(table.numbers("plants"))),
        leaves: leaves.as_ref(),
        counts: counts.as_ref(),
        gsd_m,
    };
    let mut outside = Vec::new();
    let plots: Vec<Plot> = areas
        .into_iter()
        .map(|(name, polygon)| {
            let runs = polygon.runs(width, height);
            let pixels: usize = runs.iter().map(|(_, run)| run.len()).sum();
            let covered: usize = runs
                .iter()
                .map(|(v, run)| mask.row(*v)[run.clone()].iter().filter(|&&p| p != 0).count())
                .sum();
            if pixels == 0 {
                outside.push(name.clone());
            }
            let traits = measured.traits(&name, &polygon, pixels, covered);
            Plot { name, polygon, traits }
        })
        .collect();
    if let (Some(path), false) = (&inputs.polygons, outside.is_empty()) {
        if outside.len() == plots.len() {
            let message = "none of its plots lies on the mosaic: is it of another field, or in \
                           another reference system than it says?";
            return Err(FileError::malformed(path, None, message).into());
        }
        tracing::warn!("plots outside of the mosaic: {}", outside.join(", "));
    }
    write(inputs, &plots, place, folder)?;
    let rows: Vec<Value> = plots.iter().map(properties).map(Value::Object).collect();
    Ok(json!({"from": from, "plots": rows}))
}

struct Measured<'a> {
    plants: Option<Vec<[f64; 2]>>,
    gaps: Option<(Vec<[f64; 2]>, Vec<f64>)>,
    leaves: Option<&'a CsvTable>,
    counts: Option<&'a CsvTable>,
    gsd_m: Option<f64>,
}

impl Measured<'_> {
    fn traits(&self, name: &str, polygon: &Polygon, pixels: usize, covered: usize) -> Vec<Trait> {
        let inside = |at: &[f64; 2]| polygon.holds(*at);
        let area_m2 = self.gsd_m.map(|gsd| pixels as f64 * gsd * gsd);
        let plants =
            self.plants.as_ref().map(|plants| plants.iter().filter(|at| inside(at)).count() as f64);
        let missing = self.gaps.as_ref().map(|(places, counts)| {
            places.iter().zip(counts).filter(|(at, _)| inside(at)).map(|(_, count)| count).sum()
        });
        let by_area = |column: &str| {
            let counts = self.counts?;
            let row = counts.texts("plot")?.iter().position(|plot| *plot == name)?;
            counts.numbers(column).map(|numbers| numbers[row]).filter(|x| x.is_finite())
        };
        let of_leaves = self.leaves.and_then(|table| {
            let places = table.pairs("u_px", "v_px")?;
            Some((table, (0..places.len()).filter(|&k| inside(&places[k])).collect::<Vec<_>>()))
        });
        let mean = |column: &str| {
            let (table, leaves) = of_leaves.as_ref()?;
            let numbers = table.numbers(column)?;
            let known: Vec<f64> =
                leaves.iter().map(|&k| numbers[k]).filter(|x| x.is_finite()).collect();
            (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
        };
        let per_ha = plants.zip(area_m2.filter(|&a| a > 0.0)).map(|(n, a)| n / a * 1e4);
        vec![
            ("area_m2", "m2", "area of the plot on the map", area_m2),
            ("plants", "1", "plants that were located", plants),
            ("plants_per_ha", "1/ha", "plants by area", per_ha),
            ("missing_plants", "1", "plants that gaps in the rows lack", missing),
            (
                "canopy_cover",
                "1",
                "share of the area that leaves cover",
                (pixels > 0).then(|| covered as f64 / pixels as f64),
            ),
            ("leaves_by_area", "1", "leaf pixels over leaf pixels per leaf", by_area("leaves")),
            ("leaves_by_area_low", "1", "lower end of the 95 % interval", by_area("low")),
            ("leaves_by_area_high", "1", "upper end of the 95 % interval", by_area("high")),
            (
                "leaves_single",
                "1",
                "leaves that were told apart",
                of_leaves.as_ref().map(|(_, leaves)| leaves.len() as f64),
            ),
            ("leaf_length_m", "m", "mean length of these leaves", mean("length_m")),
            ("leaf_width_m", "m", "mean width of these leaves", mean("mean_width_m")),
            ("leaf_hue_deg", "deg", "mean hue of these leaves", mean("hue_deg")),
        ]
    }
}

/// Plots as the rows give them: groups of neighbouring rows, cut where all of them have a gap.
fn grid(plants: &CsvTable, rows_per_plot: usize, alley_px: f64) -> Vec<(String, Polygon)> {
    let (Some(places), Some(rows)) = (plants.pairs("u_px", "v_px"), plants.numbers("row")) else {
        return Vec::new();
    };
    let count = rows.iter().filter(|r| r.is_finite()).fold(0.0, |a: f64, &r| a.max(r + 1.0));
    let mut of_row: Vec<Vec<[f64; 2]>> = vec![Vec::new(); count as usize];
    for (at, row) in places.iter().zip(&rows).filter(|(_, row)| row.is_finite()) {
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
    for (group, rows) in of_row.chunks(rows_per_plot).enumerate() {
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

/// The traits of a plot by name.
fn properties(plot: &Plot) -> Map<String, Value> {
    let mut map = Map::new();
    map.insert("plot".to_owned(), json!(plot.name));
    for (name, _, _, value) in &plot.traits {
        map.insert((*name).to_owned(), value.map_or(Value::Null, |value| json!(rounded(value))));
    }
    map
}

/// Six significant digits.
fn rounded(value: f64) -> f64 {
    if value == 0.0 || !value.is_finite() {
        return value;
    }
    let unit = 10f64.powi(5 - value.abs().log10().floor() as i32);
    (value * unit).round() / unit
}

fn write(
    inputs: &Inputs,
    plots: &[Plot],
    place: Option<Georeference>,
    folder: &Path,
) -> Result<(), Error> {
    let text =
        |value: Option<f64>| value.map(|value| rounded(value).to_string()).unwrap_or_default();
    let names: Vec<&str> = plots
        .first()
        .map(|plot| plot.traits.iter().map(|(name, ..)| *name).collect())
        .unwrap_or_default();
    output::write(&folder.join("traits.csv"), true, |out| {
        let mut csv = csv::Writer::from_writer(out);
        csv.write_record(std::iter::once("plot").chain(names.iter().copied()))?;
        for plot in plots {
            let values = plot.traits.iter().map(|(.., value)| text(*value));
            csv.write_record(std::iter::once(plot.name.clone()).chain(values))?;
        }
        csv.flush()
    })?;
    output::write(&folder.join("traits_long.csv"), true, |out| {
        let mut csv = csv::Writer::from_writer(out);
        csv.write_record(["plot", "trait", "value", "unit"])?;
        for plot in plots {
            for (name, unit, _, value) in plot.traits.iter().filter(|(.., v)| v.is_some()) {
                csv.write_record([&plot.name, *name, &text(*value), *unit])?;
            }
        }
        csv.flush()
    })?;
    let rings: Vec<Rings> = plots.iter().map(|plot| on_map(&plot.polygon, place)).collect();
    package(plots, &rings, place, folder)?;
    let crs = place.and_then(|place| place.crs.epsg);
    let features: Vec<Value> = plots
        .iter()
        .zip(&rings)
        .map(|(plot, rings)| {
            json!({
                "type": "Feature",
                "properties": properties(plot),
                "geometry": {"type": "Polygon", "coordinates": rings},
            })
        })
        .collect();
    let mut collection = json!({"type": "FeatureCollection", "features": features});
    if let Some(code) = crs {
        let name = format!("urn:ogc:def:crs:EPSG::{code}");
        collection["crs"] = json!({"type": "name", "properties": {"name": name}});
    }
    output::write(&folder.join("traits.geojson"), true, |out| writeln!(out, "{collection}"))?;
    let observations = brapi(inputs, plots);
    output::write(&folder.join("traits.brapi.json"), true, |out| {
        serde_json::to_writer_pretty(&mut *out, &observations)?;
        writeln!(out)
    })
    .map_err(|error: FileError| error.into())
}

/// Closed rings of map positions, to a tenth of a millimetre.
type Rings = Vec<Vec<[f64; 2]>>;

fn on_map(polygon: &Polygon, place: Option<Georeference>) -> Rings {
    let ring = |ring: &Vec<[f64; 2]>| {
        let closed = ring.iter().chain(ring.first());
        let map = closed.map(|&at| place.map_or(at, |place| place.map(at)));
        map.map(|at| at.map(|x| (x * 1e4).round() / 1e4)).collect()
    };
    polygon.rings.iter().map(ring).collect()
}

/// The same as a layer of a GeoPackage; the unit of a trait is in its name.
fn package(
    plots: &[Plot],
    rings: &[Rings],
    place: Option<Georeference>,
    folder: &Path,
) -> Result<(), Error> {
    let traits = plots.first().map(|plot| &plot.traits[..]).unwrap_or_default();
    let columns = std::iter::once(Column::new("plot", ColumnKind::Text))
        .chain(traits.iter().map(|(name, ..)| Column::new(name, ColumnKind::Real)));
    let feature = |(plot, rings): (&Plot, &Rings)| {
        let number =
            |value: Option<f64>| value.map_or(gpkg::Value::Null, |x| gpkg::Value::Real(rounded(x)));
        let values = plot.traits.iter().map(|(.., value)| number(*value));
        Feature {
            geometry: Some(Geometry::Polygon(rings.clone())),
            values: std::iter::once(gpkg::Value::Text(plot.name.clone())).chain(values).collect(),
        }
    };
    let layer = Layer {
        name: "plots".to_owned(),
        description: "Traits of plots".to_owned(),
        kind: GeometryKind::Polygon,
        crs: place.map(|place| place.crs),
        columns: columns.collect(),
        features: plots.iter().zip(rings).map(feature).collect(),
    };
    Ok(gpkg::write(&folder.join("traits.gpkg"), true, &[layer])?)
}

/// Observations with the names of BrAPI 2.1, and what MIAPPE asks of a study as far as it is known here.
fn brapi(inputs: &Inputs, plots: &[Plot]) -> Value {
    let mut data = Vec::new();
    for plot in plots {
        for (name, unit, what, value) in &plot.traits {
            let Some(value) = value else { continue };
            data.push(json!({
                "observationUnitDbId": plot.name,
                "observationUnitName": plot.name,
                "observationLevel": "plot",
                "observationVariableName": name,
                "observationVariableDescription": what,
                "scale": unit,
                "value": rounded(*value).to_string(),
            }));
        }
    }
    json!({
        "metadata": {
            "pagination": {"currentPage": 0, "pageSize": data.len(), "totalCount": data.len(), "totalPages": 1},
        },
        "study": {
            "studyName": inputs.name,
            "studyType": "UAV phenotyping",
            "method": format!("rowgram {}", env!("CARGO_PKG_VERSION")),
            "observationUnitLevel": "plot",
        },
        "result": {"data": data},
    })
}
