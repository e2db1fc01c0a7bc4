//! Traits as BrAPI 2.1 says them: observations, their variables, the plots as observation units, the study.
//!
//! Each file is the answer that a server gives to the GET request of its name, with the fields of the standard and no others:
//!
//! | file | request | what is in it |
//! |---|---|---|
//! | `traits.brapi.json` | `/observations` | a value: `observationUnitDbId`, `observationVariableDbId`, `studyDbId`, `observationTimeStamp`, `value` |
//! | `variables.brapi.json` | `/variables` | a trait: trait, method with reference, scale with unit (UCUM) |
//! | `units.brapi.json` | `/observationunits` | a plot and its level |
//! | `study.brapi.json` | `/studies` | the flight as MIAPPE 1.1 describes an observation: facility and environment are not known here |
//!
//! `observationTimeStamp` is the time of the first photo where the photos tell it together with their time zone; without a zone the
//! local time is in `additionalInfo`, as standard deviations are, for which BrAPI has no field. Variables have the names of the traits, or the
//! identifiers that a table gives (those of the Crop Ontology differ by crop).
//!
//! Reference: BrAPI 2.1 (P. Selby et al., *BrAPI: an application programming interface for plant breeding applications*,
//! Bioinformatics 35, 2019); MIAPPE 1.1 (E. Papoutsoglou et al., New Phytologist 227, 2020).

use super::{Plot, variable_ids::VariableIds};
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
    /// Time of the first photo, ISO 8601; with its offset from UTC where that is known.
    pub(super) time: Option<String>,
    /// What its variables are called.
    pub(super) ids: VariableIds,
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
        ("study.brapi.json", vec![self::study(all, study)]),
    ];
    for (name, data) in files {
        let answer = answer(data);
        output::write(&folder.join(name), true, |out| {
            serde_json::to_writer_pretty(&mut *out, &answer)?;
            writeln!(out)
        })?;
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
    let has_zone = |time: &str| {
        time.ends_with('Z') || time.get(19..).is_some_and(|rest| rest.contains(['+', '-']))
    };
    let stamp = study.time.as_deref().filter(|time| has_zone(time));
    let local = study.time.as_deref().filter(|time| !has_zone(time));
    let known = plots.iter().flat_map(|plot| {
        all.iter().filter_map(move |of| Some((plot, of, of.value(&plot.traits)?)))
    });
    known
        .map(|(Plot { traits, .. }, of, value)| {
            let unit = unit_id(study, &traits.plot);
            let mut info = local.map_or(json!({}), |time| json!({"localTime": time}));
            if let Some(sd) = of.standard_deviation(traits) {
                info["standardDeviation"] = json!(sd.to_string());
            }
            json!({
                "additionalInfo": info,
                "observationDbId": format!("{unit}-{}", of.name),
                "observationTimeStamp": stamp,
                "observationUnitDbId": unit,
                "observationUnitName": traits.plot,
                "observationVariableDbId": study.ids.of(of),
                "observationVariableName": of.name,
                "studyDbId": study.name,
                "uploadedBy": concat!("rowgram ", env!("CARGO_PKG_VERSION")),
                "value": value.to_string(),
            })
        })
        .collect()
}

/// The traits that some plot has.
fn variables(plots: &[Plot], all: &[Trait], study: &Study) -> Vec<Value> {
    let is_known = |of: &&Trait| plots.iter().any(|plot| of.value(&plot.traits).is_some());
    let variable = |of: &Trait| {
        json!({
            "observationVariableDbId": study.ids.of(of),
            "observationVariableName": of.name,
            "trait": {
                "traitDbId": of.name,
                "traitName": of.name,
                "traitDescription": of.meaning,
                "traitClass": "phenotypic",
            },
            "method": {
                "methodDbId": format!("{}-method", of.name),
                "methodName": format!("{} from photos", of.name),
                "methodDescription": of.method,
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
    all.iter().filter(is_known).map(variable).collect()
}

fn units(plots: &[Plot], study: &Study) -> Vec<Value> {
    let unit = |plot: &Plot| {
        let name = &plot.traits.plot;
        // What the polygons say of a plot, under the names that field maps have.
        let attribute = |wanted: &str| {
            let found =
                plot.attributes.iter().find(|(name, _)| name.eq_ignore_ascii_case(wanted))?;
            match &found.1 {
                Value::Null => None,
                Value::String(text) => Some(text.clone()),
                other => Some(other.to_string()),
            }
        };
        let block = attribute("block")
            .map(|code| json!({"levelName": "block", "levelOrder": 1, "levelCode": code}));
        let treatment =
            attribute("treatment").map(|value| json!({"factor": "treatment", "modality": value}));
        json!({
            "germplasmName": attribute("genotype"),
            "observationUnitDbId": unit_id(study, name),
            "observationUnitName": name,
            "observationUnitPosition": {
                "observationLevel": {"levelName": "plot", "levelOrder": 2, "levelCode": name},
                "observationLevelRelationships": block.into_iter().collect::<Vec<_>>(),
            },
            "studyDbId": study.name,
            "studyName": study.name,
            "treatments": treatment.into_iter().collect::<Vec<_>>(),
        })
    };
    plots.iter().map(unit).collect()
}

fn study(all: &[Trait], of: &Study) -> Value {
    json!({
        "studyDbId": of.name,
        "studyName": of.name,
        "studyType": "UAV phenotyping",
        "startDate": of.time.as_deref().and_then(|time| time.get(..10)),
        "observationLevels": [{"levelName": "plot", "levelOrder": 2}],
        "observationVariableDbIds": all.iter().map(|own| of.ids.of(own)).collect::<Vec<_>>(),
        "experimentalDesign": {"description": "not known to this program"},
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_plants::phenotype::traits::{PlotTraits, TRAITS};
    use rowgram_raster::polygon::Polygon;
    use serde::Deserialize;

    /// An observation as BrAPI 2.1 has it: what is not named here is not part of the standard.
    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase", deny_unknown_fields)]
    #[expect(dead_code, reason = "the fields of the standard")]
    struct Observation {
        additional_info: Option<serde_json::Map<String, Value>>,
        collector: Option<String>,
        external_references: Option<Vec<Value>>,
        geo_coordinates: Option<Value>,
        germplasm_db_id: Option<String>,
        germplasm_name: Option<String>,
        observation_db_id: String,
        observation_time_stamp: Option<String>,
        observation_unit_db_id: String,
        observation_unit_name: Option<String>,
        observation_variable_db_id: String,
        observation_variable_name: Option<String>,
        season: Option<Value>,
        study_db_id: Option<String>,
        uploaded_by: Option<String>,
        value: String,
    }

    fn plots() -> Vec<Plot> {
        ["A", "B"]
            .map(|name| Plot {
                polygon: Polygon { rings: Vec::new() },
                traits: PlotTraits {
                    plot: name.into(),
                    plants: Some(7.0),
                    ..PlotTraits::default()
                },
                attributes: vec![("Genotype".into(), "B73".into()), ("block".into(), 2.into())],
            })
            .into()
    }

    #[test]
    fn observations_have_the_fields_of_the_standard() {
        for (time, stamp) in [
            (Some("2026-06-01T10:20:30+02:00"), Some("2026-06-01T10:20:30+02:00")),
            (Some("2026-06-01T10:20:30Z"), Some("2026-06-01T10:20:30Z")),
            (Some("2026-06-01T10:20:30"), None),
            (None, None),
        ] {
            let study = Study {
                name: "north".into(),
                time: time.map(str::to_owned),
                ids: VariableIds::default(),
            };
            let found = observations(&plots(), TRAITS, &study);
            assert_eq!(found.len(), 2);
            for (value, plot) in found.into_iter().zip(["A", "B"]) {
                let local = value["additionalInfo"]["localTime"].clone();
                assert_eq!(local.is_string(), time.is_some() && stamp.is_none(), "{value}");
                let of: Observation = serde_json::from_value(value).unwrap();
                assert_eq!(of.observation_time_stamp.as_deref(), stamp);
                assert_eq!(of.observation_unit_db_id, format!("north-{plot}"));
                assert_eq!(
                    (of.observation_variable_db_id.as_str(), of.value.as_str()),
                    ("plants", "7")
                );
            }
        }
    }

    #[test]
    fn files_refer_to_each_other() {
        let folder = tempfile::tempdir().unwrap();
        let study = Study {
            name: "north".into(),
            time: Some("2026-06-01T10:20:30".into()),
            ids: VariableIds::default(),
        };
        write(&plots(), TRAITS, &study, folder.path()).unwrap();
        let read = |name: &str| -> Vec<Value> {
            let text = std::fs::read(folder.path().join(name)).unwrap();
            let answer: Value = serde_json::from_slice(&text).unwrap();
            assert_eq!(answer["metadata"]["pagination"]["totalPages"], 1, "{name}");
            answer["result"]["data"].as_array().unwrap().clone()
        };
        let [observations, variables, units, study] = ["traits", "variables", "units", "study"]
            .map(|name| read(&format!("{name}.brapi.json")));
        assert_eq!(variables.len(), 1, "only what was measured");
        assert_eq!(variables[0]["scale"]["units"], "1");
        assert_eq!(study[0]["startDate"], "2026-06-01");
        assert_eq!(units[0]["germplasmName"], "B73");
        let relation = &units[0]["observationUnitPosition"]["observationLevelRelationships"][0];
        assert_eq!(
            (&relation["levelName"], &relation["levelCode"]),
            (&json!("block"), &json!("2"))
        );
        assert_eq!(units[0]["treatments"], json!([]));
        for of in observations {
            assert!(
                units.iter().any(|unit| unit["observationUnitDbId"] == of["observationUnitDbId"])
            );
            assert_eq!(of["observationVariableDbId"], variables[0]["observationVariableDbId"]);
            assert_eq!(of["studyDbId"], study[0]["studyDbId"]);
        }
    }
}
