//! Where a raster lies: by the tags of the file, by a world file and a `.prj` file beside it.

use super::{FOOT, METRE, SURVEY_FOOT};
use crate::{FileError, side_files::added, table::decode};
use geotiff_reader::GeoTiffFile;
use rowgram_raster::{
    crs,
    georeference::{Crs, CrsKind, Georeference},
};
use std::path::{Path, PathBuf};
use tiff_reader::Ifd;

/// `ProjLinearUnitsGeoKey` and `ProjLinearUnitSizeGeoKey`.
const LINEAR_UNITS: u16 = 3076;
const LINEAR_UNIT_SIZE: u16 = 3077;
/// `VerticalGeoKey`, and the first code that is not of the registry.
const VERTICAL: u16 = 4096;
const USER_DEFINED: u16 = 32767;
/// Tags of a place without a reference system.
const PIXEL_SCALE: u16 = 33_550;
const TIE_POINT: u16 = 33_922;
const TRANSFORMATION: u16 = 34_264;

/// `VerticalUnitsGeoKey`.
const VERTICAL_UNITS: u16 = 4099;

/// The endings of files with the reference system of a raster.
const PROJECTIONS: [&str; 2] = ["prj", "PRJ"];

const NOWHERE: Crs = Crs { kind: CrsKind::Unknown, ..Crs::LOCAL };

/// By the tags of the file; what they do not say of the reference system, a `.prj` file beside it says.
pub(super) fn of_file(file: &GeoTiffFile, path: &Path) -> Result<Option<Georeference>, FileError> {
    let Some(transform) = file.transform() else { return Ok(None) };
    let (x, y) = transform.pixel_to_geo(0.5, 0.5);
    let mut crs = system(file);
    if crs.kind == CrsKind::Unknown && crs.epsg.is_none() {
        let vertical_epsg = crs.vertical_epsg;
        crs = Crs { vertical_epsg, ..projection_beside(path)?.unwrap_or(crs) };
    }
    Ok(Some(Georeference {
        origin: [x, y],
        per_column: [transform.pixel_width, transform.skew_y],
        per_row: [transform.skew_x, transform.pixel_height],
        crs,
    }))
}

/// By tags without a reference system, else by a world file beside the picture; the system by a `.prj` file.
pub(super) fn of_plain(ifd: &Ifd, path: &Path) -> Result<Option<Georeference>, FileError> {
    let numbers = |tag: u16| ifd.tag(tag).and_then(|tag| tag.value.as_f64_vec());
    let affine = match (numbers(TRANSFORMATION), numbers(TIE_POINT).zip(numbers(PIXEL_SCALE))) {
        (Some(m), _) if m.len() >= 8 => Some([[m[0], m[4]], [m[1], m[5]], [m[3], m[7]]]),
        (_, Some((tie, scale))) if tie.len() >= 6 && scale.len() >= 2 => {
            let corner = [tie[3] - tie[0] * scale[0], tie[4] + tie[1] * scale[1]];
            Some([[scale[0], 0.0], [0.0, -scale[1]], corner])
        }
        _ => None,
    };
    let Some([per_column, per_row, corner]) = affine else { return beside(path) };
    let corner = Georeference { origin: corner, per_column, per_row, crs: NOWHERE };
    let crs = projection_beside(path)?.unwrap_or(NOWHERE);
    Ok(Some(Georeference { origin: corner.map([0.5, 0.5]), crs, ..corner }))
}

/// The endings of world files of pictures.
fn world_endings(path: &Path) -> Vec<String> {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or("").to_lowercase();
    let short = match (ending.chars().next(), ending.chars().last()) {
        (Some(first), Some(last)) => format!("{first}{last}w"),
        _ => String::new(),
    };
    let usual = [short, format!("{ending}w"), "wld".to_owned()];
    usual.iter().cloned().chain(usual.iter().map(|ending| ending.to_uppercase())).collect()
}

/// The files that a raster may have beside it: its place, and of a TIFF its bands and its mask.
pub(crate) fn side_files(path: &Path) -> Vec<PathBuf> {
    let places = world_endings(path).into_iter().chain(PROJECTIONS.map(str::to_owned));
    let mut files: Vec<PathBuf> = places.map(|ending| path.with_extension(ending)).collect();
    if path.extension().is_some_and(|of| of.to_string_lossy().to_lowercase().starts_with("tif")) {
        files.extend(metadata_beside(path));
        files.push(mask_beside(path));
    }
    files
}

/// Where GDAL writes what a TIFF has no tags for.
pub(super) fn metadata_beside(path: &Path) -> [PathBuf; 2] {
    [path.with_extension("aux.xml"), added(path, ".aux.xml")]
}

/// Where GDAL writes the mask of a TIFF that is not in the file.
pub(super) fn mask_beside(path: &Path) -> PathBuf {
    added(path, ".msk")
}

/// By a world file beside a picture, and a `.prj` file where there is one.
///
/// # Errors
/// A world file that has not six numbers, a `.prj` file that cannot be understood.
pub fn beside(path: &Path) -> Result<Option<Georeference>, FileError> {
    let world = world_endings(path).into_iter().map(|ending| path.with_extension(ending));
    let Some(world) = world.filter(|world| world != path).find(|world| world.is_file()) else {
        return Ok(None);
    };
    let text = std::fs::read_to_string(&world).map_err(|error| FileError::read(&world, error))?;
    let numbers: Result<Vec<f64>, _> =
        text.split_whitespace().map(|word| word.replace(',', ".").parse::<f64>()).collect();
    let numbers = numbers.ok().filter(|all| all.iter().all(|x| x.is_finite()));
    let Some([a, d, b, e, x, y]) = numbers.and_then(|all| <[f64; 6]>::try_from(all).ok()) else {
        let message = "expected the six numbers of a world file, a line each";
        return Err(FileError::malformed(&world, None, message));
    };
    let crs = projection_beside(path)?.unwrap_or(NOWHERE);
    Ok(Some(Georeference { origin: [x, y], per_column: [a, d], per_row: [b, e], crs }))
}

/// The system of a `.prj` file beside a raster.
fn projection_beside(path: &Path) -> Result<Option<Crs>, FileError> {
    let named = PROJECTIONS.map(|ending| path.with_extension(ending));
    let Some(projection) = named.into_iter().find(|path| path.is_file()) else { return Ok(None) };
    match std::fs::read(&projection).map(decode) {
        Err(error) => Err(FileError::read(&projection, error)),
        Ok(text) => {
            let system = crs::Crs::of_well_known_text(&text)
                .map_err(|error| FileError::malformed(&projection, None, error.to_string()))?;
            Ok(Some(Crs::from(&system)))
        }
    }
}

/// Metres of the unit that the keys of the file give to heights.
pub(super) fn vertical_unit_m(file: &GeoTiffFile) -> Option<f64> {
    match file.geokeys().get_short(VERTICAL_UNITS)? {
        FOOT => Some(crs::FOOT_M),
        SURVEY_FOOT => Some(crs::US_SURVEY_FOOT_M),
        METRE => Some(1.0),
        _ => None,
    }
}

/// The reference system by the keys of the file.
fn system(file: &GeoTiffFile) -> Crs {
    let keys = file.geokeys();
    let code = keys.get_short(VERTICAL);
    let vertical_epsg = code.filter(|code| (1..USER_DEFINED).contains(code)).map(u32::from);
    let epsg = file.epsg();
    let kind = match file.crs().model_type {
        1 => kind_of_unit(file),
        2 => CrsKind::Geographic,
        _ => CrsKind::Unknown,
    };
    let known = Crs { epsg, kind, vertical_epsg, definition: None };
    if epsg.is_some() {
        return known;
    }
    // A system without a code: by its well-known text in a citation, as Esri's programs write it, or by its parameters.
    let citation = [3073, 1026, 2049].into_iter().find_map(|key| {
        let text = keys.get_ascii(key)?;
        let start = text.find("PROJCS[").or_else(|| text.find("GEOGCS["))?;
        let end = text.rfind(']')?;
        crs::Crs::of_well_known_text(text.get(start..=end)?).ok()
    });
    // As this program writes it.
    let citation = citation.or_else(|| {
        let text = keys.get_ascii(1026)?;
        let text = text.trim_end_matches(['|', '\0']);
        text.starts_with("+proj").then(|| crs::Crs::of_definition(text).ok())?
    });
    let by_parameters = || crs::Crs::of_definition(&parameters(file)?).ok();
    match citation.or_else(by_parameters) {
        Some(system) => Crs { vertical_epsg, ..Crs::from(&system) },
        None => known,
    }
}

/// The PROJ string of a projection that is given by its parameters.
fn parameters(file: &GeoTiffFile) -> Option<String> {
    let keys = file.geokeys();
    let number = |key: u16| keys.get_double(key).and_then(|all| all.first().copied());
    let any = |of: &[u16]| of.iter().find_map(|&key| number(key));
    let unit = match keys.get_short(LINEAR_UNITS) {
        Some(FOOT) => crs::FOOT_M,
        Some(SURVEY_FOOT) => crs::US_SURVEY_FOOT_M,
        Some(METRE) | None => 1.0,
        Some(_) => number(LINEAR_UNIT_SIZE)?,
    };
    let longitude = any(&[3080, 3084, 3088, 3095]).unwrap_or(0.0);
    let latitude = any(&[3081, 3085, 3089]).unwrap_or(0.0);
    let scale = any(&[3092, 3093]);
    let parallel = |key: u16| number(key).unwrap_or(latitude);
    let (name, of_kind) = match keys.get_short(3075)? {
        1 => ("tmerc", format!("+lat_0={latitude} +k={}", scale.unwrap_or(1.0))),
        7 => ("merc", format!("+k={}", scale.unwrap_or(1.0))),
        8 => (
            "lcc",
            format!("+lat_0={latitude} +lat_1={} +lat_2={}", parallel(3078), parallel(3079)),
        ),
        9 => ("lcc", format!("+lat_0={latitude} +lat_1={latitude} +k_0={}", scale.unwrap_or(1.0))),
        10 => ("laea", format!("+lat_0={latitude}")),
        11 => (
            "aea",
            format!("+lat_0={latitude} +lat_1={} +lat_2={}", parallel(3078), parallel(3079)),
        ),
        15 => ("stere", format!("+lat_0={} +lat_ts={latitude}", 90f64.copysign(latitude))),
        16 => ("sterea", format!("+lat_0={latitude} +k={}", scale.unwrap_or(1.0))),
        _ => return None,
    };
    let east = any(&[3082, 3086, 3090]).unwrap_or(0.0) * unit;
    let north = any(&[3083, 3087, 3091]).unwrap_or(0.0) * unit;
    let base = keys.get_short(2048).filter(|&code| code != USER_DEFINED);
    let base = base.and_then(|code| crs::Crs::of_code(code.into()).ok());
    let ellipsoid = match (base, number(2057), number(2059), number(2058)) {
        (Some(base), ..) => {
            let own = ["+ellps=", "+datum=", "+towgs84=", "+a=", "+b=", "+rf="];
            let words = base.definition().split_whitespace();
            words
                .filter(|word| own.iter().any(|key| word.starts_with(key)))
                .collect::<Vec<_>>()
                .join(" ")
        }
        (None, Some(a), Some(rf), _) => format!("+a={a} +rf={rf}"),
        (None, Some(a), None, Some(b)) => format!("+a={a} +b={b}"),
        _ => "+ellps=WGS84".to_owned(),
    };
    Some(format!(
        "+proj={name} {of_kind} +lon_0={longitude} +x_0={east} +y_0={north} {ellipsoid} +to_meter={unit} +no_defs"
    ))
}

/// By the unit that the file states, else by that of its code.
fn kind_of_unit(file: &GeoTiffFile) -> CrsKind {
    let by_code = || match file.epsg() {
        None => CrsKind::Projected,
        Some(code) => {
            crs::Crs::of_code(code).map_or(CrsKind::Unknown, |system| CrsKind::of(&system))
        }
    };
    match file.geokeys().get_short(LINEAR_UNITS) {
        Some(METRE) => CrsKind::Projected,
        Some(FOOT) => CrsKind::Feet,
        Some(SURVEY_FOOT) => CrsKind::SurveyFeet,
        Some(USER_DEFINED) if file.epsg().is_some() => by_code(),
        Some(_) => CrsKind::Unknown,
        None => by_code(),
    }
}
