//! Which samples of a pixel are red, green, blue and alpha: by the names and the colour interpretation of the bands.

use tiff_reader::{ExtraSample, Ifd};

/// `GDAL_METADATA`: names and colour interpretation of bands among others, as XML.
const METADATA: u16 = 42_112;
/// `ExtraSamples`.
const EXTRA_SAMPLES: u16 = 338;

/// What the samples of a pixel are.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Bands {
    /// The samples that are red, green and blue; one sample three times where the picture is grey. An error says why it
    /// is not known which.
    pub(super) colours: Result<[usize; 3], String>,
    /// The sample that is 0 where nothing is shown.
    pub(super) alpha: Option<usize>,
    /// Whether pixels are colours rather than single values.
    pub(super) is_colour: bool,
    /// Whether names told which bands are the colours, and not their order.
    pub(super) by_name: bool,
}

/// What a band shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Shows {
    Red,
    Green,
    Blue,
    Alpha,
    Grey,
    /// Near infrared, red edge and others.
    Another,
}

impl Bands {
    /// Of pixels that are decoded into colours: palettes, YCbCr.
    pub(super) fn decoded() -> Bands {
        Bands { colours: Ok([0, 1, 2]), alpha: None, is_colour: true, by_name: false }
    }

    /// Of a directory whose pixels have so many samples; `beside` is the text of an `.aux.xml` file, if there is one,
    /// `is_rgb` whether the file says that the first three are red, green and blue.
    pub(super) fn of(ifd: &Ifd, samples: usize, is_rgb: bool, beside: Option<&str>) -> Bands {
        let metadata = ifd.tag(METADATA).and_then(|tag| tag.value.as_str());
        let mut names: Vec<Option<(String, Shows)>> = vec![None; samples];
        let of_file = metadata.map(items).unwrap_or_default();
        let of_beside = beside.map(items_beside).unwrap_or_default();
        // Names of bands say more than colour interpretations, which programs make up from the order.
        for role in ["colorinterp", "description"] {
            for (sample, _, name) in of_beside.iter().chain(&of_file).filter(|item| item.1 == role)
            {
                if let (Some(place), Some(shows)) = (names.get_mut(*sample), shows(name)) {
                    *place = Some((name.clone(), shows));
                }
            }
        }
        let with = |what: Shows| {
            names.iter().position(|name| name.as_ref().is_some_and(|(_, shows)| *shows == what))
        };
        let alpha = with(Shows::Alpha).or_else(|| alpha(ifd, samples));
        let rest = samples - usize::from(alpha.is_some());
        let is_colour = rest >= 3;
        let known: Vec<&str> = names.iter().flatten().map(|(name, _)| name.as_str()).collect();
        let named = [Shows::Red, Shows::Green, Shows::Blue].map(with);
        let of_names = match named {
            [Some(red), Some(green), Some(blue)] => Some([red, green, blue]),
            _ => None,
        };
        let others =
            names.iter().flatten().any(|(_, shows)| !matches!(shows, Shows::Alpha | Shows::Grey));
        let colours = match (is_colour, of_names) {
            (false, _) => Ok([usize::from(alpha == Some(0)); 3]),
            (true, Some(rgb)) => Ok(rgb),
            (true, None) if others => Err(format!(
                "its bands are {}, expected red, green and blue among them",
                known.join(", ")
            )),
            (true, None) if rest <= 4 || is_rgb => Ok([0, 1, 2]),
            (true, None) => Err(format!(
                "it has {rest} bands without names, and which are red, green and blue is not known; name them (QGIS, or \
                 gdal_edit.py -colorinterp_3 red -colorinterp_2 green -colorinterp_1 blue)"
            )),
        };
        Bands { colours, alpha, is_colour, by_name: is_colour && of_names.is_some() }
    }
}

/// By `ExtraSamples`. Where there is no such note, the last of two or four samples is alpha.
fn alpha(ifd: &Ifd, samples: usize) -> Option<usize> {
    if ifd.tag(EXTRA_SAMPLES).is_none() {
        return matches!(samples, 2 | 4).then_some(samples - 1);
    }
    let extra = ifd.extra_samples().ok()?;
    let first = samples.checked_sub(extra.len())?;
    let is_alpha = |of: &ExtraSample| {
        matches!(of, ExtraSample::AssociatedAlpha | ExtraSample::UnassociatedAlpha)
    };
    extra.iter().position(is_alpha).map(|place| first + place)
}

/// What the name of a band says: `Red`, `B`, `Band 3: NIR`, `rededge_717`.
fn shows(name: &str) -> Option<Shows> {
    let letters: String =
        name.to_lowercase().chars().map(|c| if c.is_alphabetic() { c } else { ' ' }).collect();
    let words: Vec<&str> = letters
        .split_whitespace()
        .filter(|word| {
            !["band", "bands", "channel", "layer", "reflectance", "nm", "sr"].contains(word)
        })
        .collect();
    let word = words.concat();
    Some(match word.as_str() {
        "r" | "red" => Shows::Red,
        "g" | "green" => Shows::Green,
        "b" | "blue" => Shows::Blue,
        "a" | "alpha" => Shows::Alpha,
        "gray" | "grey" => Shows::Grey,
        "n" | "nir" | "ir" | "re" | "lwir" | "thermal" | "pan" | "panchromatic" | "coastal" => {
            Shows::Another
        }
        _ if word.contains("edge") || word.contains("infrared") || word.contains("nir") => {
            Shows::Another
        }
        _ => return None,
    })
}

/// Band (from 0), role and text of the items of GDAL's metadata.
fn items(xml: &str) -> Vec<(usize, String, String)> {
    let item = |part: &str| {
        let (head, rest) = part.split_once('>')?;
        let text = rest.split("</Item>").next()?;
        let attribute = |name: &str| {
            let after = head.split(&format!("{name}=\"")).nth(1)?;
            after.split('"').next().map(str::to_owned)
        };
        let sample = attribute("sample")?.parse().ok()?;
        Some((sample, attribute("role")?.to_lowercase(), text.trim().to_owned()))
    };
    xml.split("<Item ").skip(1).filter_map(item).collect()
}

/// The same of an `.aux.xml` file, where bands count from 1.
fn items_beside(xml: &str) -> Vec<(usize, String, String)> {
    let mut found = Vec::new();
    for part in xml.split("<PAMRasterBand band=\"").skip(1) {
        let part = part.split("</PAMRasterBand>").next().unwrap_or(part);
        let number = part.split('"').next().and_then(|text| text.parse::<usize>().ok());
        let Some(sample) = number.and_then(|number| number.checked_sub(1)) else { continue };
        for (tag, role) in [("Description", "description"), ("ColorInterp", "colorinterp")] {
            let after = part.split(&format!("<{tag}>")).nth(1);
            let text = after.and_then(|after| after.split(&format!("</{tag}>")).next());
            found.extend(text.map(|text| (sample, role.to_owned(), text.trim().to_owned())));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_bands_are_understood() {
        for (name, expected) in [
            ("Red", Some(Shows::Red)),
            ("Band 1: Blue", Some(Shows::Blue)),
            ("green_560", Some(Shows::Green)),
            ("Red edge", Some(Shows::Another)),
            ("rededge_717", Some(Shows::Another)),
            ("NIR", Some(Shows::Another)),
            ("B", Some(Shows::Blue)),
            ("Alpha", Some(Shows::Alpha)),
            ("Band 4", None),
            ("Undefined", None),
        ] {
            assert_eq!(shows(name), expected, "{name}");
        }
    }

    #[test]
    fn metadata_of_both_kinds_are_read() {
        let xml = "<GDALMetadata>\n  <Item name=\"DESCRIPTION\" sample=\"2\" role=\"description\">Red</Item>\n \
                   <Item name=\"AREA_OR_POINT\">Area</Item></GDALMetadata>";
        assert_eq!(items(xml), [(2, "description".to_owned(), "Red".to_owned())]);
        let xml = "<PAMDataset><PAMRasterBand band=\"3\"><Description>Red</Description></PAMRasterBand></PAMDataset>";
        assert_eq!(items_beside(xml), [(2, "description".to_owned(), "Red".to_owned())]);
    }
}
