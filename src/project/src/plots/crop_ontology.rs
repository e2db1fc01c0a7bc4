//! Terms of the Crop Ontology that mean what a trait means: trait and variable identifiers by crop.
//!
//! A variable of the ontology is a trait, a method and a scale, and its methods are those of people in the field. So variables of this program keep
//! identifiers of their own; the *trait* that they measure is named by the ontology's identifier where it has one, and the
//! variable that people measure is referred to. Only terms that mean the same are listed.
//!
//! Reference: Crop Ontology, maize (CO_322) and sorghum (CO_324), trait dictionaries `Maize_TD.csv` and `Sorghum_TD.csv` of
//! the repositories `Planteome/CO_322-maize-traits` and `Planteome/CO_324-sorghum-traits`.

use rowgram_base::options::nearest;
use serde_json::{Value, json};

/// A trait of this program in the ontology of a crop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Term {
    crop: &'static str,
    own: &'static str,
    /// The trait, where its identifier is published.
    pub(super) trait_id: Option<&'static str>,
    /// The variable that people measure.
    pub(super) variable_id: Option<&'static str>,
    /// Whether that variable has the unit of the trait.
    pub(super) has_same_scale: bool,
}

const TERMS: [Term; 6] = [
    // "Plant height", PH_M_cm: centimetres, with a ruler.
    term("maize", "canopy_height_m", Some("CO_322:0000994"), Some("CO_322:0000996"), false),
    // "Plant stand", number of plants per unit area; PStand_Ct_plntPlot: plants per plot.
    term("maize", "plants", Some("CO_322:0000008"), Some("CO_322:0000891"), true),
    term("maize", "plants_per_ha", Some("CO_322:0000008"), None, false),
    // "Normalized difference vegetation index", of the canopy; NDVI_M_idx.
    term("maize", "ndvi", Some("CO_322:0000132"), Some("CO_322:0000880"), true),
    // PH_M_cm.
    term("sorghum", "canopy_height_m", None, Some("CO_324:0000623"), false),
    // PNo_Ct_plntPlot: plants per plot.
    term("sorghum", "plants", None, Some("CO_324:0000488"), true),
];

const fn term(
    crop: &'static str,
    own: &'static str,
    trait_id: Option<&'static str>,
    variable_id: Option<&'static str>,
    has_same_scale: bool,
) -> Term {
    Term { crop, own, trait_id, variable_id, has_same_scale }
}

/// Crops with terms.
const CROPS: [&str; 2] = ["maize", "sorghum"];

/// Whether a crop can be meant as it is spelled.
///
/// # Errors
/// An empty name, and one that is nearly that of a crop with terms.
pub(super) fn check(crop: &str) -> Result<(), String> {
    let name = crop.trim().to_lowercase();
    match nearest(&name, &CROPS) {
        _ if name.is_empty() => Err("crop is empty: expected a name, such as sorghum".to_owned()),
        Some(near) if near != name => Err(format!("crop = {crop:?}: did you mean {near}?")),
        _ => Ok(()),
    }
}

/// The term of a trait in the ontology of a crop.
pub(super) fn find(crop: Option<&str>, own: &str) -> Option<Term> {
    let crop = crop?.trim().to_lowercase();
    TERMS.into_iter().find(|term| term.crop == crop && term.own == own)
}

/// The page of a term, which is its permanent identifier.
pub(super) fn page(id: &str) -> String {
    format!("https://cropontology.org/term/{id}")
}

/// What BrAPI calls the reference to the ontology of a term.
pub(super) fn reference(id: &str) -> Value {
    json!({
        "ontologyDbId": id.split(':').next(),
        "ontologyName": "Crop Ontology",
        "documentationLinks": [{"URL": page(id), "type": "WEBPAGE"}],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_plants::phenotype::traits::known_traits;

    #[test]
    fn terms_belong_to_traits_and_to_the_ontology_of_their_crop() {
        let known = known_traits();
        for term in TERMS {
            assert!(known.iter().any(|of| of.name == term.own), "{}", term.own);
            let prefix = if term.crop == "maize" { "CO_322:" } else { "CO_324:" };
            for id in [term.trait_id, term.variable_id].into_iter().flatten() {
                let number = id.strip_prefix(prefix).unwrap();
                assert!(number.len() == 7 && number.bytes().all(|b| b.is_ascii_digit()), "{id}");
            }
            assert!(CROPS.contains(&term.crop) && find(Some(term.crop), term.own) == Some(term));
        }
        assert_eq!(find(Some(" Maize"), "plants").unwrap().trait_id, Some("CO_322:0000008"));
        assert_eq!((find(Some("wheat"), "plants"), find(None, "plants")), (None, None));
        assert_eq!(find(Some("sorghum"), "exg"), None);
    }

    #[test]
    fn other_crops_are_taken_and_slips_named() {
        for crop in ["maize", "Sorghum", "wheat", "sugar beet"] {
            check(crop).unwrap();
        }
        assert!(check("sorgum").unwrap_err().contains("did you mean sorghum?"));
        assert!(check(" ").unwrap_err().contains("empty"));
    }
}
