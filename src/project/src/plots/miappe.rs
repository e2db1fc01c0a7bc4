//! Traits as MIAPPE 1.1 describes data: sections of its checklist as tables, whose columns are the checklist's fields.
//!
//! | file | section | fields |
//! |---|---|---|
//! | `miappe_study.csv` | Study | DM-11 to DM-29; what no photo says is empty, for whoever submits the data |
//! | `miappe_observation_units.csv` | Observation unit | DM-70 to DM-74, and the biological material of the plot |
//! | `miappe_variables.csv` | Observed variable | DM-83 to DM-94 |
//! | `miappe_data_files.csv` | Data file | DM-37 to DM-39 |
//!
//! Observation units and variables have the names that stand in the data file, `traits_long.csv`.
//!
//! Reference: MIAPPE 1.1 (E. Papoutsoglou et al., *Enabling reusability of plant phenomic datasets with MIAPPE 1.1*, New
//! Phytologist 227, 2020), checklist and data model.

use super::{
    Plot,
    brapi::{self, Study},
    crop_ontology,
};
use rowgram_base::error::Error;
use rowgram_files::csv_table::CsvWriter;
use rowgram_optim::output;
use rowgram_plants::phenotype::traits::Trait;
use std::path::Path;

/// A section: its file, the fields, and the rows.
type Section<'a> = (&'a str, &'a [&'a str], Vec<Vec<String>>);

/// Writes the four tables.
///
/// # Errors
/// Where one cannot be written.
pub(super) fn write(
    plots: &[Plot],
    all: &[Trait],
    study: &Study,
    folder: &Path,
) -> Result<(), Error> {
    let variables = brapi::measured(plots, all).map(|of| variable(of, study)).collect();
    let units = plots.iter().map(|plot| unit(plot, study)).collect();
    let version = env!("CARGO_PKG_VERSION");
    let data = [
        "traits_long.csv",
        "a row per plot and trait: plot, trait, value, unit, standard_deviation",
        version,
    ];
    let tables: [Section<'_>; 4] = [
        ("miappe_study.csv", STUDY, vec![self::study(plots, study)]),
        ("miappe_observation_units.csv", UNIT, units),
        ("miappe_variables.csv", VARIABLE, variables),
        ("miappe_data_files.csv", DATA_FILE, vec![data.map(str::to_owned).into()]),
    ];
    for (name, header, rows) in tables {
        output::write(&folder.join(name), true, |out| {
            let mut csv = CsvWriter::new(out);
            csv.write_record(header.iter().copied())?;
            for row in &rows {
                csv.write_record(row)?;
            }
            csv.flush()
        })?;
    }
    Ok(())
}

const STUDY: &[&str] = &[
    "Study unique ID",
    "Study title",
    "Study description",
    "Start date of study",
    "End date of study",
    "Contact institution",
    "Geographic location (country)",
    "Experimental site name",
    "Geographic location (latitude)",
    "Geographic location (longitude)",
    "Geographic location (altitude)",
    "Description of the experimental design",
    "Type of experimental design",
    "Observation unit level hierarchy",
    "Observation unit description",
    "Description of growth facility",
    "Type of growth facility",
    "Cultural practices",
    "Map of experimental design",
];

fn study(plots: &[Plot], of: &Study) -> Vec<String> {
    let time = of.time.clone().unwrap_or_default();
    let levels: Vec<&str> = brapi::levels(plots);
    let crop = of.crop.as_deref().map(|crop| format!(" of {crop}")).unwrap_or_default();
    STUDY
        .iter()
        .map(|field| match *field {
            "Study unique ID" | "Study title" => of.name.clone(),
            "Study description" => "plant traits from overlapping photos of a drone".to_owned(),
            "Start date of study" | "End date of study" => time.clone(),
            "Description of the experimental design" => "unknown".to_owned(),
            "Observation unit level hierarchy" => levels.join(">"),
            "Observation unit description" => format!("plots{crop}; {} in number", plots.len()),
            "Description of growth facility" => "field environment condition".to_owned(),
            "Map of experimental design" => super::POLYGONS.to_owned(),
            _ => String::new(),
        })
        .collect()
}

const DATA_FILE: &[&str] = &["Data file link", "Data file description", "Data file version"];

const UNIT: &[&str] = &[
    "Study unique ID",
    "Observation unit ID",
    "Observation unit type",
    "External ID",
    "Spatial distribution",
    "Observation unit factor value",
    "Biological material ID",
];

fn unit(plot: &Plot, study: &Study) -> Vec<String> {
    let name = &plot.traits.plot;
    let mut places: Vec<String> = brapi::relations(plot)
        .into_iter()
        .map(|(level, code)| format!("{level}:{code}"))
        .chain([format!("plot:{name}")])
        .collect();
    let position =
        |axis: &str, names| brapi::attribute(plot, names).map(|at| format!("{axis}:{at}"));
    places.extend(position("row", brapi::ROW));
    places.extend(position("column", brapi::COLUMN));
    let factors: Vec<String> = brapi::treatments(plot)
        .into_iter()
        .map(|(factor, value)| format!("{factor}:{value}"))
        .collect();
    vec![
        study.name.clone(),
        name.clone(),
        "plot".to_owned(),
        String::new(),
        places.join("; "),
        factors.join("; "),
        brapi::attribute(plot, brapi::GERMPLASM).unwrap_or_default(),
    ]
}

const VARIABLE: &[&str] = &[
    "Variable ID",
    "Variable name",
    "Variable accession number",
    "Trait",
    "Trait accession number",
    "Method",
    "Method accession number",
    "Method description",
    "Reference associated to the method",
    "Scale",
    "Scale accession number",
    "Time scale",
];

fn variable(of: &Trait, study: &Study) -> Vec<String> {
    let term = crop_ontology::find(study.crop.as_deref(), &of.name);
    let given = study.ids.of(of);
    let of_ontology = term.filter(|term| term.has_same_scale).and_then(|term| term.variable_id);
    let accession = if given == of.name { of_ontology.unwrap_or_default() } else { given };
    let cells = [
        &*of.name,
        &*of.name,
        accession,
        &*of.meaning,
        term.and_then(|term| term.trait_id).unwrap_or_default(),
        &brapi::method_name(of),
        "",
        &*of.method,
        of.reference,
        of.unit,
        "",
        "Date/Time",
    ];
    cells.map(str::to_owned).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_files::csv_table::CsvTable;
    use rowgram_plants::phenotype::traits::TRAITS;

    #[test]
    fn tables_have_the_fields_of_the_checklist_and_the_names_of_the_data_file() {
        let folder = tempfile::tempdir().unwrap();
        let study = Study {
            name: "north".to_owned(),
            time: Some("2026-06-01T10:20:30".to_owned()),
            crop: Some("Maize".to_owned()),
            ..Study::default()
        };
        write(&brapi::examples(), TRAITS, &study, folder.path()).unwrap();
        let read = |name: &str| CsvTable::read(&folder.path().join(name)).unwrap();
        let table = read("miappe_study.csv");
        assert_eq!(table.header(), STUDY);
        assert_eq!(table.texts("Start date of study").unwrap(), ["2026-06-01T10:20:30"]);
        assert_eq!(table.texts("Observation unit level hierarchy").unwrap(), ["rep>block>plot"]);
        assert_eq!(table.texts("Contact institution").unwrap(), [""]);
        let units = read("miappe_observation_units.csv");
        assert_eq!(units.texts("Observation unit ID").unwrap(), ["A", "B"]);
        assert_eq!(units.texts("Biological material ID").unwrap(), ["B73", "B73"]);
        assert_eq!(
            units.texts("Spatial distribution").unwrap()[0],
            "rep:1; block:2; plot:A; row:3; column:4"
        );
        let factors = units.texts("Observation unit factor value").unwrap();
        assert_eq!(factors[0], "treatment:dry; nitrogen:80");
        let variables = read("miappe_variables.csv");
        assert_eq!(variables.texts("Variable ID").unwrap(), ["plants", "canopy_height_m"]);
        let accessions = variables.texts("Variable accession number").unwrap();
        // A height in centimetres is another variable of the same trait.
        assert_eq!(accessions, ["CO_322:0000891", ""]);
        let traits = variables.texts("Trait accession number").unwrap();
        assert_eq!(traits, ["CO_322:0000008", "CO_322:0000994"]);
        assert_eq!(
            read("miappe_data_files.csv").texts("Data file link").unwrap(),
            ["traits_long.csv"]
        );
    }
}
