//! Traits as BrAPI 2.1 says them: observations, their variables, the plots as observation units, the study.
//!
//! Each file is the answer that a server gives to the GET request of its name, with the fields of the standard and no others:
//!
//! | file | request | what is in it |
//! |---|---|---|
//! | `traits.brapi.json` | `/observations` | a value: `observationUnitDbId`, `observationVariableDbId`, `studyDbId`, `observationTimeStamp`, `value` |
//! | `variables.brapi.json` | `/variables` | a trait: trait, method with reference, scale with unit (UCUM) |
//! | `units.brapi.json` | `/observationunits` | a plot and its level |
//! | `study.brapi.json` | `/studies` | the flight: facility and environment are not known here |
//!
//! `observationTimeStamp` is the time of the first photo where the photos tell it together with their time zone; without a zone the
//! local time is in `additionalInfo`, as standard deviations are, for which BrAPI has no field. Variables have the names of the traits, or the
//! identifiers that a table gives; traits have those of the [Crop Ontology](crop_ontology) where the crop is named.
//!
//! Reference: BrAPI 2.1 (P. Selby et al., *BrAPI: an application programming interface for plant breeding applications*,
//! Bioinformatics 35, 2019). `brapi-2.1.schema.json` has the fields of the standard, which the tests hold the files against.

use super::{Plot, crop_ontology, variable_ids::VariableIds};
use rowgram_base::error::Error;
use rowgram_optim::output;
use rowgram_plants::phenotype::traits::Trait;
use serde_json::{Value, json};
use std::path::Path;

/// The study that values belong to.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Study {
    /// Name of the field.
    pub(super) name: String,
    /// Time of the first photo, ISO 8601, with its offset from UTC where that is known; else the day that a season gives.
    pub(super) time: Option<String>,
    /// The crop, where it is named.
    pub(super) crop: Option<String>,
    /// What its variables are called.
    pub(super) ids: VariableIds,
}

impl Study {
    /// The time, where it is a moment: with its time zone.
    fn moment(&self) -> Option<&str> {
        self.time.as_deref().filter(|time| {
            time.ends_with('Z') || time.get(19..).is_some_and(|rest| rest.contains(['+', '-']))
        })
    }

    /// What BrAPI has no field for: the local time, where its time zone is not known.
    fn more(&self) -> serde_json::Map<String, Value> {
        let is_time = |time: &&String| self.moment().is_none() && time.contains('T');
        let local = self.time.as_ref().filter(is_time);
        local.map(|time| ("localTime".to_owned(), json!(time))).into_iter().collect()
    }

    /// The year in which the crop grew.
    fn season(&self) -> Option<Value> {
        let year: u16 = self.time.as_deref()?.get(..4)?.parse().ok()?;
        let name = year.to_string();
        Some(json!({"seasonDbId": name, "seasonName": name, "year": year}))
    }
}

/// Writes the four files.
///
/// # Errors
/// Where one cannot be written.
pub(super) fn write(
    plots: &[Plot],
    all: &[Trait],
    study: &Study,
    folder: &Path,
) -> Result<(), Error> {
    let files = [
        ("traits.brapi.json", observations(plots, all, study)),
        ("variables.brapi.json", variables(plots, all, study)),
        ("units.brapi.json", units(plots, study)),
        ("study.brapi.json", vec![self::study(plots, all, study)]),
    ];
    for (name, data) in files {
        let answer = answer(data);
        output::write_json(&folder.join(name), true, &answer)?;
    }
    Ok(())
}

fn answer(data: Vec<Value>) -> Value {
    let total = data.len();
    json!({
        "metadata": {
            "datafiles": [],
            "status": [],
            "pagination": {"currentPage": 0, "pageSize": total.max(1), "totalCount": total, "totalPages": 1},
        },
        "result": {"data": data},
    })
}

fn unit_id(study: &Study, plot: &str) -> String {
    format!("{}-{plot}", study.name)
}

fn observations(plots: &[Plot], all: &[Trait], study: &Study) -> Vec<Value> {
    let known = plots.iter().flat_map(|plot| {
        all.iter().filter_map(move |of| Some((plot, of, of.value(&plot.traits)?)))
    });
    // Another date is another observation of the same unit.
    let date = study.time.as_deref().and_then(|time| time.get(..10));
    let date = date.map(|date| format!("-{date}")).unwrap_or_default();
    known
        .map(|(plot, of, value)| {
            let traits = &plot.traits;
            let unit = unit_id(study, &traits.plot);
            let mut info = study.more();
            if let Some(sd) = of.standard_deviation(traits) {
                info.insert("standardDeviation".to_owned(), json!(sd.to_string()));
            }
            json!({
                "additionalInfo": info,
                "germplasmName": attribute(plot, GERMPLASM),
                "observationDbId": format!("{unit}-{}{date}", of.name),
                "observationTimeStamp": study.moment(),
                "observationUnitDbId": unit,
                "observationUnitName": traits.plot,
                "observationVariableDbId": study.ids.of(of),
                "observationVariableName": of.name,
                "season": study.season(),
                "studyDbId": study.name,
                "uploadedBy": concat!("rowgram ", env!("CARGO_PKG_VERSION")),
                "value": value.to_string(),
            })
        })
        .collect()
}

/// The traits that some plot has.
pub(super) fn measured<'a>(plots: &'a [Plot], all: &'a [Trait]) -> impl Iterator<Item = &'a Trait> {
    all.iter().filter(|of| plots.iter().any(|plot| of.value(&plot.traits).is_some()))
}

/// What the method of a trait is called.
pub(super) fn method_name(of: &Trait) -> String {
    format!("{} from photos", of.name)
}

fn variables(plots: &[Plot], all: &[Trait], study: &Study) -> Vec<Value> {
    let variable = |of: &Trait| {
        let term = crop_ontology::find(study.crop.as_deref(), &of.name);
        let trait_id = term.and_then(|term| term.trait_id);
        let comparable: Vec<Value> = term
            .and_then(|term| term.variable_id)
            .map(|id| json!({"referenceId": crop_ontology::page(id), "referenceSource": "Crop Ontology"}))
            .into_iter()
            .collect();
        json!({
            "commonCropName": study.crop,
            "externalReferences": comparable,
            "observationVariableDbId": study.ids.of(of),
            "observationVariableName": of.name,
            "trait": {
                "ontologyReference": trait_id.map(crop_ontology::reference),
                "traitDbId": of.name,
                "traitName": of.name,
                "traitDescription": of.meaning,
                "traitClass": "phenotypic",
                "traitPUI": trait_id.map(crop_ontology::page),
            },
            "method": {
                "methodDbId": format!("{}-method", of.name),
                "methodName": method_name(of),
                "description": of.method,
                "methodClass": "Computation",
                "bibliographicalReference": of.reference,
            },
            "scale": {
                "scaleDbId": of.unit,
                "scaleName": of.unit,
                "dataType": "Numerical",
                "units": of.unit,
            },
        })
    };
    measured(plots, all).map(variable).collect()
}

/// The levels of observation units that BrAPI names, from the largest to the smallest.
const LEVELS: [&str; 11] = [
    "study",
    "field",
    "entry",
    "rep",
    "block",
    "sub-block",
    "plot",
    "sub-plot",
    "plant",
    "pot",
    "sample",
];

/// Columns of field maps that name a level above the plot.
const RELATIONS: [(&str, &[&str]); 4] = [
    ("entry", &["entry"]),
    ("rep", &["rep", "replicate", "replication"]),
    ("block", &["block"]),
    ("sub-block", &["sub-block", "sub_block", "subblock"]),
];

/// Columns of field maps that name what grows on a plot.
pub(super) const GERMPLASM: &[&str] = &["genotype", "germplasm", "variety"];
/// Columns of field maps with the row of a plot in the grid of plots.
pub(super) const ROW: &[&str] = &["row", "range"];
/// Columns of field maps with its column.
pub(super) const COLUMN: &[&str] = &["column", "col"];

fn level(name: &str, code: Option<&str>) -> Value {
    let order = LEVELS.iter().position(|known| *known == name);
    match code {
        Some(code) => json!({"levelName": name, "levelOrder": order, "levelCode": code}),
        None => json!({"levelName": name, "levelOrder": order}),
    }
}

fn text(value: &Value) -> Option<String> {
    match value {
        Value::Null => None,
        Value::String(text) => Some(text.clone()),
        other => Some(other.to_string()),
    }
}

/// What the polygon of a plot says under the first of these names that it has.
pub(super) fn attribute(plot: &Plot, names: &[&str]) -> Option<String> {
    let named = |wanted: &&str| {
        let mut own = plot.attributes.iter();
        own.find(|(name, _)| name.eq_ignore_ascii_case(wanted)).and_then(|(_, value)| text(value))
    };
    names.iter().find_map(named)
}

/// The levels above a plot that it names, with what it names them.
pub(super) fn relations(plot: &Plot) -> Vec<(&'static str, String)> {
    let named = |(level, names): (&'static str, &[&str])| Some((level, attribute(plot, names)?));
    RELATIONS.into_iter().filter_map(named).collect()
}

/// The levels that a field has.
pub(super) fn levels(plots: &[Plot]) -> Vec<&'static str> {
    let is_named =
        |level: &&str| plots.iter().any(|plot| relations(plot).iter().any(|(own, _)| own == level));
    RELATIONS.iter().map(|(level, _)| *level).filter(is_named).chain(["plot"]).collect()
}

/// Factors and modalities: the column `treatment`, and those that start with `treatment_`, behind which the factor stands.
pub(super) fn treatments(plot: &Plot) -> Vec<(String, String)> {
    let treatment = |(name, value): &(String, Value)| {
        let name = name.to_lowercase();
        let factor = match name.strip_prefix("treatment_") {
            Some(factor) if !factor.is_empty() => factor,
            _ if name == "treatment" => "treatment",
            _ => return None,
        };
        Some((factor.to_owned(), text(value)?))
    };
    plot.attributes.iter().filter_map(treatment).collect()
}

fn units(plots: &[Plot], study: &Study) -> Vec<Value> {
    let unit = |plot: &Plot| {
        let name = &plot.traits.plot;
        let above = relations(plot).into_iter().map(|(name, code)| level(name, Some(&code)));
        let treatments = treatments(plot)
            .into_iter()
            .map(|(factor, modality)| json!({"factor": factor, "modality": modality}));
        let mut position = json!({
            "observationLevel": level("plot", Some(name)),
            "observationLevelRelationships": above.collect::<Vec<_>>(),
        });
        for (axis, names, kind) in [("X", COLUMN, "GRID_COL"), ("Y", ROW, "GRID_ROW")] {
            if let Some(at) = attribute(plot, names) {
                position[format!("positionCoordinate{axis}")] = json!(at);
                position[format!("positionCoordinate{axis}Type")] = json!(kind);
            }
        }
        json!({
            "germplasmName": attribute(plot, GERMPLASM),
            "observationUnitDbId": unit_id(study, name),
            "observationUnitName": name,
            "observationUnitPosition": position,
            "studyDbId": study.name,
            "studyName": study.name,
            "treatments": treatments.collect::<Vec<_>>(),
        })
    };
    plots.iter().map(unit).collect()
}

fn study(plots: &[Plot], all: &[Trait], of: &Study) -> Value {
    let levels = levels(plots).into_iter().map(|name| level(name, None));
    let season = of.season().map(|season| season["seasonDbId"].clone());
    json!({
        "additionalInfo": of.more(),
        "commonCropName": of.crop,
        "studyDbId": of.name,
        "studyName": of.name,
        "studyType": "UAV phenotyping",
        "startDate": of.moment(),
        "seasons": season.into_iter().collect::<Vec<_>>(),
        "observationLevels": levels.collect::<Vec<_>>(),
        "observationVariableDbIds": measured(plots, all).map(|own| of.ids.of(own)).collect::<Vec<_>>(),
        "experimentalDesign": {"description": "unknown"},
    })
}

#[cfg(test)]
pub(super) use tests::plots as examples;

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_plants::phenotype::traits::{PlotTraits, TRAITS};
    use rowgram_raster::polygon::Polygon;

    /// Two plots of a field map with everything that it can say.
    pub(in super::super) fn plots() -> Vec<Plot> {
        let attributes = [
            ("Genotype", json!("B73")),
            ("rep", json!(1)),
            ("block", json!(2)),
            ("range", json!(3)),
            ("column", json!(4)),
            ("Treatment", json!("dry")),
            ("treatment_nitrogen", json!(80)),
            ("treatment_irrigation", Value::Null),
        ];
        ["A", "B"]
            .map(|name| Plot {
                polygon: Polygon { rings: Vec::new() },
                traits: PlotTraits {
                    plot: name.into(),
                    plants: Some(7.0),
                    canopy_height_m: Some(1.25),
                    ..PlotTraits::default()
                },
                attributes: attributes
                    .iter()
                    .map(|(key, of)| ((*key).into(), of.clone()))
                    .collect(),
            })
            .into()
    }

    fn study_at(time: Option<&str>, crop: Option<&str>) -> Study {
        Study {
            name: "north".into(),
            time: time.map(str::to_owned),
            crop: crop.map(str::to_owned),
            ids: VariableIds::default(),
        }
    }

    /// What of an entity contradicts the standard.
    fn faults(entity: &str, value: &Value) -> Vec<String> {
        let mut schema: Value =
            serde_json::from_str(include_str!("brapi-2.1.schema.json")).unwrap();
        schema["$ref"] = json!(format!("#/$defs/{entity}"));
        let options = jsonschema::options().should_validate_formats(true);
        let validator = options.build(&schema).unwrap();
        let faults = validator.iter_errors(value);
        faults.map(|fault| format!("{}: {fault}", fault.instance_path())).collect()
    }

    /// The entities of the files that are written, by their file.
    fn files(study: &Study) -> [(&'static str, Vec<Value>); 4] {
        let folder = tempfile::tempdir().unwrap();
        write(&plots(), TRAITS, study, folder.path()).unwrap();
        let entities = [
            ("traits", "Observation"),
            ("variables", "ObservationVariable"),
            ("units", "ObservationUnit"),
            ("study", "Study"),
        ];
        entities.map(|(file, entity)| {
            let text = std::fs::read(folder.path().join(format!("{file}.brapi.json"))).unwrap();
            let answer: Value = serde_json::from_slice(&text).unwrap();
            assert_eq!(answer["metadata"]["pagination"]["totalPages"], 1, "{file}");
            (entity, answer["result"]["data"].as_array().unwrap().clone())
        })
    }

    #[test]
    fn files_are_valid_by_the_schema_of_the_standard() {
        for time in [
            Some("2026-06-01T10:20:30+02:00"),
            Some("2026-06-01T10:20:30Z"),
            Some("2026-06-01T10:20:30"),
            None,
        ] {
            for crop in [None, Some("sorghum"), Some("Maize"), Some("wheat")] {
                for (entity, data) in files(&study_at(time, crop)) {
                    assert!(!data.is_empty(), "{entity}");
                    for value in data {
                        assert_eq!(faults(entity, &value), [""; 0], "{value:#}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_schema_refuses_what_the_standard_does() {
        let [(_, observations), (_, variables), (_, units), (_, studies)] =
            files(&study_at(Some("2026-06-01T10:20:30Z"), Some("maize")));
        let refused = |entity: &str, value: &Value, pointer: &str, with: Value, says: &str| {
            let mut wrong = value.clone();
            *wrong.pointer_mut(pointer).unwrap() = with;
            let faults = faults(entity, &wrong);
            assert!(faults.iter().any(|fault| fault.contains(says)), "{pointer}: {faults:?}");
        };
        let observation = &observations[0];
        refused("Observation", observation, "/value", json!(7), "not of type");
        refused("Observation", observation, "/observationTimeStamp", json!("1 June"), "date-time");
        refused("Observation", observation, "/season", json!("2026"), "not of type");
        refused(
            "ObservationVariable",
            &variables[0],
            "/scale/dataType",
            json!("Number"),
            "is not one of",
        );
        refused(
            "ObservationVariable",
            &variables[0],
            "/method",
            json!({"methodDescription": ""}),
            "methodName",
        );
        let level = "/observationUnitPosition/observationLevel/levelName";
        refused("ObservationUnit", &units[0], level, json!("parcel"), "is not one of");
        refused("ObservationUnit", &units[0], "/treatments/0", json!({"name": "dry"}), "name");
        refused("Study", &studies[0], "/startDate", json!("2026-06-01"), "date-time");
    }

    #[test]
    fn files_refer_to_each_other() {
        let [(_, observations), (_, variables), (_, units), (_, studies)] =
            files(&study_at(Some("2026-06-01T10:20:30"), Some("sorghum")));
        let names: Vec<&Value> =
            variables.iter().map(|of| &of["observationVariableDbId"]).collect();
        assert_eq!(names, ["plants", "canopy_height_m"], "only what was measured");
        assert_eq!(studies[0]["observationVariableDbIds"], json!(names));
        let reference = &variables[1]["externalReferences"][0]["referenceId"];
        assert_eq!(reference, "https://cropontology.org/term/CO_324:0000623");
        assert_eq!(variables[0]["scale"]["units"], "1");
        assert_eq!(studies[0]["additionalInfo"]["localTime"], "2026-06-01T10:20:30");
        let levels = studies[0]["observationLevels"].as_array().unwrap();
        let levels: Vec<&Value> = levels.iter().map(|level| &level["levelName"]).collect();
        assert_eq!(levels, ["rep", "block", "plot"]);
        assert_eq!(units[0]["germplasmName"], "B73");
        let position = &units[0]["observationUnitPosition"];
        assert_eq!(position["observationLevelRelationships"][1]["levelCode"], "2");
        assert_eq!(
            (&position["positionCoordinateX"], &position["positionCoordinateY"]),
            (&json!("4"), &json!("3"))
        );
        let treatments = json!([
            {"factor": "treatment", "modality": "dry"},
            {"factor": "nitrogen", "modality": "80"},
        ]);
        assert_eq!(units[0]["treatments"], treatments);
        assert_eq!(observations.len(), 4);
        for of in &observations {
            assert!(
                units.iter().any(|unit| unit["observationUnitDbId"] == of["observationUnitDbId"])
            );
            assert!(names.contains(&&of["observationVariableDbId"]));
            assert_eq!(of["studyDbId"], studies[0]["studyDbId"]);
        }
        let ids: std::collections::BTreeSet<String> =
            observations.iter().map(|of| of["observationDbId"].to_string()).collect();
        assert_eq!(ids.len(), observations.len());
        assert!(ids.iter().all(|id| id.contains("2026-06-01")), "{ids:?}");
    }
}
