//! Bands of a raster by name, and indices of them.
//!
//! The value of a band is a reflectance, from 0 to 1, or what the raster has in its place (8-bit colours over 255). Indices that are
//! ratios of sums of bands are the same in any unit; those with constants in them (SAVI, OSAVI, EVI2) are defined for reflectances.

mod index;

pub use index::{Formula, Index, IndexError, KNOWN, KnownIndex};

use serde::{Deserialize, Serialize};

/// What a band shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Band {
    /// Blue, about 450 to 510 nm.
    Blue,
    /// Green, about 520 to 600 nm.
    Green,
    /// Red, about 630 to 690 nm.
    Red,
    /// Red edge, about 700 to 750 nm.
    RedEdge,
    /// Near infrared, about 770 to 900 nm.
    Nir,
    /// 0 where nothing is shown.
    Alpha,
    /// Anything else: panchromatic, thermal.
    Other,
}

rowgram_base::choices!(Band: Blue, Green, Red, RedEdge, Nir, Alpha, Other);

impl Band {
    /// By the name that a file gives it: `Red`, `B`, `Band 3: NIR`, `rededge_717`; `None` where that says nothing.
    pub fn named(name: &str) -> Option<Band> {
        let letters: String =
            name.to_lowercase().chars().map(|c| if c.is_alphabetic() { c } else { ' ' }).collect();
        let is_said = |word: &&str| {
            !["band", "bands", "channel", "layer", "reflectance", "nm", "sr"].contains(word)
        };
        let word = letters.split_whitespace().filter(is_said).collect::<Vec<_>>().concat();
        Some(match word.as_str() {
            "r" | "red" => Band::Red,
            "g" | "green" => Band::Green,
            "b" | "blue" => Band::Blue,
            "a" | "alpha" => Band::Alpha,
            "n" | "nir" | "ir" => Band::Nir,
            "re" => Band::RedEdge,
            "lwir" | "pan" | "panchromatic" => Band::Other,
            _ if ["thermal", "coastal", "longwave", "shortwave"]
                .iter()
                .any(|of| word.contains(of)) =>
            {
                Band::Other
            }
            _ if word.contains("edge") => Band::RedEdge,
            _ if word.contains("infrared") || word.contains("nir") => Band::Nir,
            // After the name of a camera: `MicaSense blue`.
            _ => match letters.split_whitespace().rfind(is_said) {
                Some(last) if last != word && last.len() > 2 => return Band::named(last),
                _ => return None,
            },
        })
    }
}

/// The bands of a raster as one line: `1 blue, 2 red-edge, 3 without a name`.
pub fn listed(bands: &[Option<Band>]) -> String {
    let one = |(number, band): (usize, &Option<Band>)| match band {
        Some(band) => format!("{} {band}", number + 1),
        None => format!("{} without a name", number + 1),
    };
    bands.iter().enumerate().map(one).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_bands_are_understood() {
        for (name, expected) in [
            ("Red", Some(Band::Red)),
            ("MicaSense blue", Some(Band::Blue)),
            ("Band 1: Blue", Some(Band::Blue)),
            ("green_560", Some(Band::Green)),
            ("Red edge", Some(Band::RedEdge)),
            ("red-edge", Some(Band::RedEdge)),
            ("rededge_717", Some(Band::RedEdge)),
            ("NIR", Some(Band::Nir)),
            ("Near infrared (842 nm)", Some(Band::Nir)),
            ("thermal infrared", Some(Band::Other)),
            ("B", Some(Band::Blue)),
            ("Alpha", Some(Band::Alpha)),
            ("Gray", None),
            ("Band 4", None),
            ("Undefined", None),
        ] {
            assert_eq!(Band::named(name), expected, "{name}");
        }
        assert_eq!(listed(&[Some(Band::RedEdge), None]), "1 red-edge, 2 without a name");
    }
}
