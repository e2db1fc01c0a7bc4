//! Spectral indices: known ones by name, and any formula of bands.
//!
//! Variables of a formula are the bands `blue`, `green`, `red`, `red_edge` (also `red-edge`, `rededge`), `nir`, and every band by its
//! number, `b1`, `b2`, ...; with `+ - * / ^`, brackets, numbers, `min(a, b)`, `max(a, b)`, `sqrt`, `ln`, `exp`, `abs` and the like.
//! Formulas are parsed by the crate `exmex` once and evaluated for every pixel.

use super::{Band, listed};
use exmex::{Express, FlatEx};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// An index that has a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct KnownIndex {
    /// Its name, in lower case.
    pub name: &'static str,
    /// Its formula.
    pub formula: &'static str,
    /// What it is.
    pub meaning: &'static str,
    /// What defines it.
    pub reference: &'static str,
}

macro_rules! known {
    ($($name:literal, $formula:literal, $meaning:literal, $reference:literal;)*) => {
        /// The indices that go by their names.
        pub const KNOWN: &[KnownIndex] = &[$(KnownIndex {
            name: $name,
            formula: $formula,
            meaning: $meaning,
            reference: $reference,
        }),*];
    };
}

known! {
    "ndvi", "(nir - red) / (nir + red)", "normalized difference vegetation index",
        "Rouse et al. 1974, NASA SP-351, 309-317";
    "ndre", "(nir - red_edge) / (nir + red_edge)", "normalized difference red edge index",
        "Barnes et al. 2000, Proc. 5th Int. Conf. Precision Agriculture";
    "gndvi", "(nir - green) / (nir + green)", "green normalized difference vegetation index",
        "Gitelson et al. 1996, Remote Sens. Environ. 58, 289-298";
    "savi", "1.5 * (nir - red) / (nir + red + 0.5)", "soil-adjusted vegetation index",
        "Huete 1988, Remote Sens. Environ. 25, 295-309";
    "osavi", "(nir - red) / (nir + red + 0.16)", "optimized soil-adjusted vegetation index",
        "Rondeaux et al. 1996, Remote Sens. Environ. 55, 95-107";
    "evi2", "2.5 * (nir - red) / (nir + 2.4 * red + 1)", "enhanced vegetation index of two bands",
        "Jiang et al. 2008, Remote Sens. Environ. 112, 3833-3845";
    "ci_green", "nir / green - 1", "green chlorophyll index",
        "Gitelson et al. 2003, J. Plant Physiol. 160, 271-282";
    "ci_red_edge", "nir / red_edge - 1", "red edge chlorophyll index",
        "Gitelson et al. 2003, J. Plant Physiol. 160, 271-282";
}

/// An index: its name, which is a column of tables, and its formula.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Index {
    /// Its name: lower-case letters, digits and `_`.
    pub name: String,
    /// Its formula.
    pub formula: String,
}

/// Why there is no such index of a raster.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum IndexError {
    /// It is no formula.
    #[error("{text:?} is no formula: {why}")]
    Syntax {
        /// What was given.
        text: String,
        /// What the parser says.
        why: String,
    },
    /// It has no band in it.
    #[error(
        "{text:?} is neither a known index ({}) nor a formula of bands (blue, green, red, red_edge, nir, b1, b2, ...)",
        known_names()
    )]
    Unknown {
        /// What was given.
        text: String,
    },
    /// A variable that is no band.
    #[error(
        "{variable:?} in {text:?} is no band; bands are blue, green, red, red_edge, nir, and by number b1, b2, ..."
    )]
    Variable {
        /// The variable.
        variable: String,
        /// The formula.
        text: String,
    },
    /// A name that no column can have.
    #[error(
        "{name:?} cannot be the name of an index: expected lower-case letters, digits and _, from a letter on{why}"
    )]
    Name {
        /// The name.
        name: String,
        /// What is wrong with it besides.
        why: String,
    },
    /// Two indices of one name.
    #[error(
        "{name} stands twice, expected each index once, or another name for one (NAME = FORMULA)"
    )]
    Twice {
        /// The name.
        name: String,
    },
    /// A band that the raster has not.
    #[error("{name} needs the band {band}, and the orthomosaic has {}", listed(there))]
    Band {
        /// The index.
        name: String,
        /// The band that is missing.
        band: String,
        /// The bands that there are.
        there: Vec<Option<Band>>,
    },
}

fn known_names() -> String {
    KNOWN.iter().map(|of| of.name).collect::<Vec<_>>().join(", ")
}

/// A variable of a formula.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Variable {
    Named(Band),
    /// From 0.
    Number(usize),
}

impl Variable {
    fn of(name: &str) -> Option<Variable> {
        let named = match name.to_lowercase().as_str() {
            "blue" => Band::Blue,
            "green" => Band::Green,
            "red" => Band::Red,
            "red_edge" | "rededge" => Band::RedEdge,
            "nir" => Band::Nir,
            other => {
                let number: usize = other.strip_prefix('b')?.parse().ok()?;
                return number.checked_sub(1).map(Variable::Number);
            }
        };
        Some(Variable::Named(named))
    }
}

/// A formula without what does not matter to it.
fn plain(formula: &str) -> String {
    let joined: String = formula.split_whitespace().collect();
    joined.to_lowercase().replace("red-edge", "red_edge").replace("rededge", "red_edge")
}

fn parse(formula: &str) -> Result<(FlatEx<f64>, Vec<Variable>), IndexError> {
    let text = || formula.trim().to_owned();
    let lower = formula.to_lowercase().replace("red-edge", "red_edge");
    let parsed = FlatEx::<f64>::parse(&lower)
        .map_err(|why| IndexError::Syntax { text: text(), why: why.msg().to_owned() })?;
    let variable = |name: &String| {
        let of = Variable::of(name);
        of.ok_or_else(|| IndexError::Variable { variable: name.clone(), text: text() })
    };
    let variables: Vec<Variable> =
        parsed.var_names().iter().map(variable).collect::<Result<_, _>>()?;
    match variables.is_empty() {
        true => Err(IndexError::Unknown { text: text() }),
        false => Ok((parsed, variables)),
    }
}

impl Index {
    /// Indices from words: the name of a known one, `name = formula`, or a formula alone, which has the name of the known index whose
    /// formula it is, else `index_1`, `index_2` by its place in the list.
    ///
    /// # Errors
    /// The first that is none of these, or has a name that stands twice.
    pub fn list(words: &[String]) -> Result<Vec<Index>, IndexError> {
        let mut found: Vec<Index> = Vec::with_capacity(words.len());
        for (place, text) in words.iter().enumerate() {
            let index = Index::read(text, place + 1)?;
            if found.iter().any(|other| other.name == index.name) {
                return Err(IndexError::Twice { name: index.name });
            }
            found.push(index);
        }
        Ok(found)
    }

    fn read(text: &str, place: usize) -> Result<Index, IndexError> {
        let known = |wanted: &dyn Fn(&KnownIndex) -> bool| KNOWN.iter().find(|of| wanted(of));
        let word = text.trim();
        if let Some(of) = known(&|of| of.name == word.to_lowercase()) {
            return Ok(Index { name: of.name.to_owned(), formula: of.formula.to_owned() });
        }
        let (name, formula) = match word.split_once('=') {
            Some((name, formula)) => (Some(name.trim()), formula.trim()),
            None => (None, word),
        };
        let is_word = !word.is_empty() && word.chars().all(|c| c.is_alphanumeric() || c == '_');
        if name.is_none() && is_word && Variable::of(word).is_none() {
            return Err(IndexError::Unknown { text: word.to_owned() });
        }
        parse(formula)?;
        let name = match name {
            Some(name) => name.to_owned(),
            None => known(&|of| plain(of.formula) == plain(formula))
                .map_or_else(|| format!("index_{place}"), |of| of.name.to_owned()),
        };
        let is_column = name.starts_with(|c: char| c.is_ascii_lowercase())
            && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
        let ending = ["_sd", "_leaf"].into_iter().find(|end| name.ends_with(end));
        match (is_column, ending) {
            (true, None) => Ok(Index { name, formula: formula.to_owned() }),
            (_, ending) => {
                let why = ending.map_or(String::new(), |end| format!(", and not {end} at its end"));
                Err(IndexError::Name { name, why })
            }
        }
    }

    /// The indices that are taken where nothing is said: NDVI where there is near infrared, NDRE where there is red edge too.
    pub fn usual(bands: &[Option<Band>]) -> Vec<Index> {
        let of = ["ndvi", "ndre"].map(|name| Index::read(name, 0));
        of.into_iter().flatten().filter(|index| index.bind(bands).is_ok()).collect()
    }

    /// The known index that it is.
    pub fn known(&self) -> Option<&'static KnownIndex> {
        KNOWN.iter().find(|of| of.name == self.name && plain(of.formula) == plain(&self.formula))
    }

    /// Its formula for rasters with these bands.
    ///
    /// # Errors
    /// A formula that is none, a band that is not there.
    pub fn bind(&self, bands: &[Option<Band>]) -> Result<Formula, IndexError> {
        let (expression, variables) = parse(&self.formula)?;
        let place = |variable: Variable| {
            let (place, band) = match variable {
                Variable::Named(band) => {
                    (bands.iter().position(|of| *of == Some(band)), band.to_string())
                }
                Variable::Number(number) => {
                    (Some(number).filter(|&at| at < bands.len()), format!("b{}", number + 1))
                }
            };
            let missing =
                || IndexError::Band { name: self.name.clone(), band, there: bands.to_vec() };
            place.ok_or_else(missing)
        };
        let places = variables.into_iter().map(place).collect::<Result<_, _>>()?;
        Ok(Formula { expression, places, bands: bands.len() })
    }
}

/// A formula over the bands of a raster.
#[derive(Debug, Clone)]
pub struct Formula {
    expression: FlatEx<f64>,
    /// The place of each variable among the samples of a pixel.
    places: Vec<usize>,
    bands: usize,
}

/// Pixels of one task; any number gives the same.
const TASK_PX: usize = 1 << 14;

impl Formula {
    /// The index of every pixel, from samples that stand pixel by pixel. NaN where it is not defined or a band has no data.
    pub fn evaluate(&self, samples: &[f32]) -> Vec<f32> {
        let bands = self.bands.max(1);
        let mut values = vec![f32::NAN; samples.len() / bands];
        let tasks = values.par_chunks_mut(TASK_PX).zip(samples.par_chunks(TASK_PX * bands));
        tasks.for_each(|(values, samples)| {
            let mut of_pixel = vec![0.0; self.places.len()];
            for (value, pixel) in values.iter_mut().zip(samples.chunks_exact(bands)) {
                for (variable, &place) in of_pixel.iter_mut().zip(&self.places) {
                    *variable = f64::from(pixel[place]);
                }
                let found = self.expression.eval(&of_pixel).unwrap_or(f64::NAN) as f32;
                if found.is_finite() {
                    *value = found;
                }
            }
        });
        values
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FIVE: [Option<Band>; 5] = [
        Some(Band::Blue),
        Some(Band::Green),
        Some(Band::Red),
        Some(Band::RedEdge),
        Some(Band::Nir),
    ];
    const PIXEL: [f32; 5] = [0.04, 0.10, 0.05, 0.30, 0.45];

    fn one(text: &str) -> Result<Index, IndexError> {
        Index::list(&[text.to_owned()]).map(|mut list| list.remove(0))
    }

    fn value(text: &str) -> f32 {
        one(text).unwrap().bind(&FIVE).unwrap().evaluate(&PIXEL)[0]
    }

    #[test]
    fn known_indices_are_what_their_references_define() {
        // By hand from the equations.
        for (name, expected) in [
            ("ndvi", 0.40 / 0.50),
            ("ndre", 0.15 / 0.75),
            ("gndvi", 0.35 / 0.55),
            ("savi", 1.5 * 0.40 / 1.0),
            ("osavi", 0.40 / 0.66),
            ("evi2", 2.5 * 0.40 / (0.45 + 0.12 + 1.0)),
            ("ci_green", 3.5),
            ("ci_red_edge", 0.5),
        ] {
            assert!((value(name) - expected).abs() < 1e-5, "{name}: {}", value(name));
        }
        assert_eq!(KNOWN.len(), 8, "each has its line above");
    }

    #[test]
    fn formulas_are_of_bands_by_name_and_by_number() {
        for text in [
            "(nir - red) / (nir + red)",
            "(NIR-Red)/(NIR+Red)",
            "(b5 - b3) / (b5 + b3)",
            "mine = (nir - red) / (nir + red)",
        ] {
            assert!((value(text) - 0.8).abs() < 1e-6, "{text}");
        }
        assert!((value("x = 2 * red-edge ^ 2 - max(blue, green)") - 0.08).abs() < 1e-6);
        assert!((value("sqrt(nir - rededge)") - 0.15f32.sqrt()).abs() < 1e-6);
        let names: Vec<String> =
            Index::list(&["(nir-red)/(nir+red)", "NDRE", "nir / blue", "x=nir"].map(str::to_owned))
                .unwrap()
                .into_iter()
                .map(|index| index.name)
                .collect();
        assert_eq!(names, ["ndvi", "ndre", "index_3", "x"]);
    }

    #[test]
    fn what_is_no_index_is_named() {
        for (text, expected) in [
            ("ndwvi", "neither a known index (ndvi, ndre"),
            ("", "is no formula"),
            ("(nir - red", "is no formula"),
            ("nir - - / red", "is no formula"),
            ("nir - swir", "\"swir\" in \"nir - swir\" is no band"),
            ("1 + 1", "neither a known index"),
            ("My Index = nir", "cannot be the name"),
            ("x_sd = nir", "not _sd at its end"),
            ("b0 / nir", "\"b0\""),
        ] {
            let error = one(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
        let twice = Index::list(&["ndvi".to_owned(), "ndvi = nir".to_owned()]).unwrap_err();
        assert!(twice.to_string().contains("ndvi stands twice"), "{twice}");
        let rgb = [Band::Red, Band::Green, Band::Blue].map(Some);
        let missing = one("ndvi").unwrap().bind(&rgb).unwrap_err().to_string();
        assert_eq!(
            missing,
            "ndvi needs the band nir, and the orthomosaic has 1 red, 2 green, 3 blue"
        );
        assert!(one("b4 - b1").unwrap().bind(&rgb).is_err());
    }

    #[test]
    fn pixels_without_value_are_not_numbers() {
        let formula = one("ndvi").unwrap().bind(&FIVE).unwrap();
        let black = [0.0; 5];
        let empty = [f32::NAN, 0.1, 0.1, 0.1, f32::NAN];
        let samples = [PIXEL, black, empty, PIXEL].concat();
        let found = formula.evaluate(&samples);
        assert!((found[0] - 0.8).abs() < 1e-6 && found[3] == found[0]);
        assert!(found[1].is_nan() && found[2].is_nan());
    }

    #[test]
    fn the_usual_ones_are_those_whose_bands_are_there() {
        let names = |bands: &[Option<Band>]| -> Vec<String> {
            Index::usual(bands).into_iter().map(|index| index.name).collect()
        };
        assert_eq!(names(&FIVE), ["ndvi", "ndre"]);
        assert_eq!(names(&[Some(Band::Red), None, Some(Band::Nir)]), ["ndvi"]);
        assert!(names(&[Some(Band::Red), Some(Band::Green), Some(Band::Blue)]).is_empty());
    }
}
