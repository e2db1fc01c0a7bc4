//! Which samples of a pixel are red, green, blue and alpha: by the names and the colour interpretation of the bands.

use rowgram_raster::{
    crs,
    spectral::{Band, listed},
};
use tiff_reader::{ExtraSample, Ifd};

/// `GDAL_METADATA`: names and colour interpretation of bands among others, as XML.
const METADATA: u16 = 42_112;
/// `ExtraSamples`.
const EXTRA_SAMPLES: u16 = 338;

/// What the samples of a pixel are.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Bands {
    /// What each sample shows, where that is known.
    pub(super) roles: Vec<Option<Band>>,
    /// The samples that are red, green and blue; one sample three times where the picture is grey. An error says why it
    /// is not known which.
    pub(super) colours: Result<[usize; 3], String>,
    /// The sample that is 0 where nothing is shown.
    pub(super) alpha: Option<usize>,
    /// Whether pixels are colours rather than single values.
    pub(super) is_colour: bool,
    /// What told which bands are the colours.
    pub(super) told_by: ToldBy,
    /// What a sample has to be multiplied with, and what is then added, to be a reflectance, where the file says so.
    pub(super) scales: Option<Vec<[f64; 2]>>,
    /// Metres of the unit of the samples, where the file says that they are feet.
    pub(super) unit_m: Option<f64>,
}

/// What tells which bands are the colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ToldBy {
    /// Their place.
    Order,
    /// Their names in the file.
    Names,
    /// The settings.
    Settings,
}

impl Bands {
    /// Of pixels that are decoded into colours: palettes, YCbCr.
    pub(super) fn decoded() -> Bands {
        Bands {
            roles: COLOURS.map(Some).to_vec(),
            colours: Ok([0, 1, 2]),
            alpha: None,
            is_colour: true,
            told_by: ToldBy::Order,
            scales: None,
            unit_m: None,
        }
    }

    /// Of a directory whose pixels have so many samples; `beside` is the text of an `.aux.xml` file, if there is one,
    /// `is_rgb` whether the file says that the first three are red, green and blue. `given` are the bands by the settings, none
    /// where these say nothing.
    ///
    /// # Errors
    /// Bands by the settings that cannot be those of the file.
    pub(super) fn of(
        ifd: &Ifd,
        samples: usize,
        is_rgb: bool,
        beside: Option<&str>,
        given: &[Band],
    ) -> Result<Bands, String> {
        let metadata = ifd.tag(METADATA).and_then(|tag| tag.value.as_str());
        let of_file = metadata.map(items).unwrap_or_default();
        let of_beside = beside.map(items_beside).unwrap_or_default();
        let items = || of_beside.iter().chain(&of_file);
        let mut roles: Vec<Option<Band>> = vec![None; samples];
        let mut names: Vec<&str> = vec![""; samples];
        // Names of bands say more than colour interpretations, which programs make up from the order.
        for wanted in ["colorinterp", "description"] {
            for (sample, _, name) in items().filter(|item| item.1 == wanted) {
                if let (Some(place), Some(band)) = (roles.get_mut(*sample), Band::named(name)) {
                    *place = Some(band);
                    names[*sample] = name;
                }
            }
        }
        let named = roles.iter().position(|band| *band == Some(Band::Alpha));
        let extra = named.or_else(|| alpha(ifd, samples));
        let is_told = if given.is_empty() { ToldBy::Names } else { ToldBy::Settings };
        if is_told == ToldBy::Settings {
            roles = self::given(given, samples, extra)?;
        }
        let with = |what: Band| roles.iter().position(|band| *band == Some(what));
        let alpha = with(Band::Alpha).or(extra.filter(|_| given.len() < samples));
        let rest = samples - usize::from(alpha.is_some());
        let is_colour = rest >= 3;
        let of_names = match COLOURS.map(with) {
            [Some(red), Some(green), Some(blue)] => Some([red, green, blue]),
            _ => None,
        };
        let others = roles.iter().flatten().any(|band| *band != Band::Alpha);
        let colours = match (is_colour, of_names) {
            (false, _) => Ok([usize::from(alpha == Some(0)); 3]),
            (true, Some(rgb)) => Ok(rgb),
            (true, None) if others => Err(format!(
                "its bands are {}, expected red, green and blue among them; say which they are with [project] bands",
                match is_told {
                    ToldBy::Settings => listed(&roles),
                    _ => names
                        .into_iter()
                        .filter(|name| !name.is_empty())
                        .collect::<Vec<_>>()
                        .join(", "),
                }
            )),
            (true, None) if rest <= 4 || is_rgb => Ok([0, 1, 2]),
            (true, None) => Err(format!(
                "it has {rest} bands without names, and which are red, green and blue is not known; say so ([project] bands = \
                 [\"blue\", \"green\", \"red\", ...]) or name them in the file (QGIS, or gdal_edit.py -colorinterp_3 red \
                 -colorinterp_2 green -colorinterp_1 blue)"
            )),
        };
        let told_by = if is_colour && of_names.is_some() { is_told } else { ToldBy::Order };
        if let (true, ToldBy::Order, Ok(places)) = (is_colour, told_by, &colours) {
            places.iter().zip(COLOURS).for_each(|(&place, band)| roles[place] = Some(band));
        }
        if let Some(alpha) = alpha {
            roles[alpha] = Some(Band::Alpha);
        }
        let scales = scales(items(), samples);
        let mut units = items().filter(|item| item.1 == "unittype");
        let unit_m = units.find_map(|(.., text)| match text.to_lowercase().as_str() {
            "ft" | "foot" | "feet" => Some(crs::FOOT_M),
            "us-ft" | "ftus" | "us survey foot" | "us_survey_foot" => Some(crs::US_SURVEY_FOOT_M),
            _ => None,
        });
        Ok(Bands { roles, colours, alpha, is_colour, told_by, scales, unit_m })
    }
}

/// The colours of a picture in their order.
const COLOURS: [Band; 3] = [Band::Red, Band::Green, Band::Blue];

/// The bands of a file by the settings; alpha, where the file says which it is, need not be among them.
fn given(
    bands: &[Band],
    samples: usize,
    alpha: Option<usize>,
) -> Result<Vec<Option<Band>>, String> {
    let is_twice = |band: &&Band| {
        **band != Band::Other && bands.iter().filter(|other| other == band).count() > 1
    };
    if let Some(band) = bands.iter().find(is_twice) {
        return Err(format!("[project] bands: {band} stands twice"));
    }
    let mut roles: Vec<Option<Band>> = bands.iter().copied().map(Some).collect();
    match alpha {
        Some(place) if bands.len() + 1 == samples && !bands.contains(&Band::Alpha) => {
            roles.insert(place, Some(Band::Alpha));
        }
        _ if bands.len() == samples => {}
        _ => {
            let number = bands.len();
            return Err(format!(
                "[project] bands names {number} bands, the file has {samples}: name each, those without use as other"
            ));
        }
    }
    Ok(roles)
}

/// Scale and offset of every sample, where some have them.
fn scales<'a>(
    items: impl Iterator<Item = &'a (usize, String, String)>,
    samples: usize,
) -> Option<Vec<[f64; 2]>> {
    let mut found = None;
    for (sample, role, text) in items {
        let which = ["scale", "offset"].iter().position(|of| role == of);
        let (Some(which), Ok(value)) = (which, text.parse::<f64>()) else { continue };
        let all = found.get_or_insert_with(|| vec![[1.0, 0.0]; samples]);
        if let Some(of_sample) = all.get_mut(*sample).filter(|_| value.is_finite()) {
            of_sample[which] = value;
        }
    }
    // What leaves every sample as it is says nothing.
    found.filter(|all| all.iter().any(|of| *of != [1.0, 0.0]))
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

/// The value that stands for no data by an `.aux.xml` file; that of the first band that has one.
pub(super) fn nodata_beside(xml: &str) -> Option<String> {
    items_beside(xml).into_iter().find(|(_, role, _)| role == "nodata").map(|(.., text)| text)
}

/// The same of an `.aux.xml` file, where bands count from 1.
fn items_beside(xml: &str) -> Vec<(usize, String, String)> {
    let mut found = Vec::new();
    for part in xml.split("<PAMRasterBand band=\"").skip(1) {
        let part = part.split("</PAMRasterBand>").next().unwrap_or(part);
        let number = part.split('"').next().and_then(|text| text.parse::<usize>().ok());
        let Some(sample) = number.and_then(|number| number.checked_sub(1)) else { continue };
        for (tag, role) in [
            ("Description", "description"),
            ("ColorInterp", "colorinterp"),
            ("Scale", "scale"),
            ("Offset", "offset"),
            ("NoDataValue", "nodata"),
            ("UnitType", "unittype"),
        ] {
            // There may be attributes.
            let begin = format!("<{tag}");
            let after = part.split(&begin).skip(1).find(|after| after.starts_with(['>', ' ']));
            let after = after.and_then(|after| after.split_once('>'));
            let text = after.and_then(|(_, text)| text.split(&format!("</{tag}>")).next());
            found.extend(text.map(|text| (sample, role.to_owned(), text.trim().to_owned())));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metadata_of_both_kinds_are_read() {
        let xml = "<GDALMetadata>\n  <Item name=\"DESCRIPTION\" sample=\"2\" role=\"description\">Red</Item>\n \
                   <Item name=\"AREA_OR_POINT\">Area</Item></GDALMetadata>";
        assert_eq!(items(xml), [(2, "description".to_owned(), "Red".to_owned())]);
        let xml = "<PAMDataset><PAMRasterBand band=\"3\"><Description>Red</Description></PAMRasterBand></PAMDataset>";
        assert_eq!(items_beside(xml), [(2, "description".to_owned(), "Red".to_owned())]);
        assert_eq!(nodata_beside(xml), None);
        let xml = "<PAMRasterBand band=\"1\"><NoDataValue le_hex_equiv=\"00\">-32767</NoDataValue></PAMRasterBand>";
        assert_eq!(nodata_beside(xml).as_deref(), Some("-32767"));
    }

    #[test]
    fn settings_name_all_bands() {
        let order = [Band::Nir, Band::Red, Band::Green, Band::Blue];
        assert_eq!(given(&order, 4, None).unwrap(), order.map(Some));
        let with_alpha = given(&order, 5, Some(4)).unwrap();
        assert_eq!(with_alpha[4], Some(Band::Alpha));
        assert!(given(&order, 5, None).unwrap_err().contains("names 4 bands, the file has 5"));
        let twice = [Band::Red, Band::Red, Band::Other, Band::Other];
        assert!(given(&twice, 4, None).unwrap_err().contains("red stands twice"));
    }

    #[test]
    fn scales_are_those_of_the_file() {
        let item = |sample, role: &str, text: &str| (sample, role.to_owned(), text.to_owned());
        let all =
            [item(0, "scale", "0.0001"), item(1, "scale", "0.0001"), item(1, "offset", "-0.1")];
        assert_eq!(scales(all.iter(), 2), Some(vec![[0.0001, 0.0], [0.0001, -0.1]]));
        let none = [item(0, "scale", "1"), item(0, "description", "Red"), item(1, "offset", "0")];
        assert_eq!(scales(none.iter(), 2), None);
    }
}
