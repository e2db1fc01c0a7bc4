//! The orthomosaic that a project begins with: which raster of a folder it is, and what is odd about it.

use super::{Config, Project, config::ProjectOptions, layers, photo_folder::photos_in};
use rowgram_base::{error::Error, monitor::Diagnostic};
use rowgram_files::{
    photo,
    polygons::{self, Layer},
    rasters::{self, Source},
};
use rowgram_optim::output::{FileError, name_of};
use rowgram_raster::{
    crs,
    georeference::{Crs, CrsKind, Georeference},
    spectral::Band,
};
use std::path::{Path, PathBuf};

/// Where other programs put their orthomosaic, from the folder of their results.
const FOLDERS: [&str; 3] = ["odm_orthophoto", "3_dsm_ortho/2_mosaic", "exports"];
/// What the names of orthomosaics have in them, where there are several rasters in colours.
const WORDS: [&str; 3] = ["ortho", "mosaic", "rgb"];

/// The rasters of a folder.
pub(super) struct Rasters {
    /// The one that is the orthomosaic.
    pub(super) ortho: PathBuf,
    /// The others: heights, index maps, other mosaics.
    pub(super) others: Vec<PathBuf>,
}

/// The orthomosaic among pictures, where all of them are rasters on a map: the only one, the only one in colours, or the
/// only one of these that is called so.
pub(super) fn among(pictures: &[PathBuf]) -> Option<Rasters> {
    let mut rasters = Vec::with_capacity(pictures.len());
    for path in pictures {
        // A preview has the name of its raster.
        let is_preview = || {
            let stem = path.file_stem();
            pictures.iter().any(|other| rasters::is_tiff_name(other) && other.file_stem() == stem)
        };
        if !rasters::is_tiff_name(path) {
            if is_preview() {
                continue;
            }
            return None;
        }
        let source = Source::open(path).ok()?;
        source.georeference()?;
        rasters.push((path, source.is_photo()));
    }
    let colours: Vec<&PathBuf> =
        rasters.iter().filter(|(_, is)| *is).map(|(path, _)| *path).collect();
    let ortho = match (&rasters[..], &colours[..]) {
        ([(only, _)], _) => *only,
        (_, [only]) => only,
        (_, several) => {
            let is_called_so = |path: &&&PathBuf| {
                let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
                WORDS.iter().any(|word| name.contains(word))
            };
            let mut called = several.iter().filter(is_called_so);
            match (called.next(), called.next()) {
                (Some(only), None) => only,
                _ => return None,
            }
        }
    };
    let others = rasters.iter().map(|(path, _)| *path).filter(|path| *path != ortho);
    Some(Rasters { ortho: ortho.clone(), others: others.cloned().collect() })
}

/// The orthomosaic in the folders of other programs' results, where the folder itself has no pictures.
pub(super) fn below(root: &Path) -> Option<Rasters> {
    FOLDERS.iter().find_map(|folder| {
        let pictures = photos_in(&root.join(folder));
        (!pictures.is_empty()).then(|| among(&pictures)).flatten()
    })
}

/// Heights that lie beside an orthomosaic.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub(super) struct HeightsBeside {
    /// Of the first surface.
    pub(super) dsm: Option<PathBuf>,
    /// Of the ground.
    pub(super) dtm: Option<PathBuf>,
}

/// Where other programs put heights, from the folder of their results.
const HEIGHT_FOLDERS: [&str; 5] =
    ["odm_dem", "3_dsm_ortho/1_dsm", "3_dsm_ortho/1_dtm", "3_dsm_ortho/extras/dtm", "exports"];

/// The heights among the rasters beside an orthomosaic, or else in the folders of other programs' results: by their names, where one only is
/// called so and holds single values.
pub(super) fn heights(root: &Path, others: &[PathBuf]) -> HeightsBeside {
    let own = by_name(others);
    if own != HeightsBeside::default() {
        return own;
    }
    let below: Vec<PathBuf> =
        HEIGHT_FOLDERS.iter().flat_map(|folder| photos_in(&root.join(folder))).collect();
    by_name(&below)
}

fn by_name(rasters: &[PathBuf]) -> HeightsBeside {
    let called = |words: &[&str], but: &str| {
        let is = |path: &&PathBuf| {
            let name = path.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
            words.iter().any(|word| name.contains(word)) && (but.is_empty() || !name.contains(but))
        };
        let mut named = rasters.iter().filter(is).filter(|path| holds_values(path));
        named.next().filter(|_| named.next().is_none()).cloned()
    };
    HeightsBeside {
        dsm: called(&["dsm"], "dtm").or_else(|| called(&["dem"], "dtm")),
        dtm: called(&["dtm"], "dsm"),
    }
}

/// Whether it is a raster on a map with one band of what may be heights.
fn holds_values(path: &Path) -> bool {
    match Source::open(path) {
        Ok(Source::File(reader)) => {
            reader.bands() == 1 && !reader.holds::<u8>() && reader.georeference().is_some()
        }
        _ => false,
    }
}

/// Why a folder whose pictures are all rasters on a map has no orthomosaic that can be told.
pub(super) fn undecided(pictures: &[PathBuf]) -> Option<String> {
    let mut rasters = Vec::new();
    for path in pictures.iter().filter(|path| rasters::is_tiff_name(path)) {
        let source = Source::open(path).ok().filter(|source| source.georeference().is_some())?;
        let kind = if source.is_photo() { "colours" } else { "single values" };
        rasters.push(format!("{} ({kind})", name_of(path)));
    }
    (!rasters.is_empty()).then(|| {
        format!(
            "rasters on a map are there: {}; say with [project] ortho which is the orthomosaic",
            rasters.join(", ")
        )
    })
}

/// Whether the orthomosaic is one, and the plots lie on it or, where it will be made, among the photos; before anything is
/// computed. `None` where there is nothing to compare.
///
/// # Errors
/// A raster that is no picture in colours, polygons that cannot be read or lie elsewhere.
pub(super) fn check(project: &Project) -> Result<Option<Layer>, Error> {
    let Some(path) = project.given_orthomosaic() else { return among_photos(project) };
    let source = project.open_picture(&path)?;
    colours(&source, &path)?;
    let Some(plots) = project.plots() else { return Ok(None) };
    let place = source.georeference();
    Ok(Some(layers::layer(project, &plots, place.as_ref(), Some(source.size()))?))
}

/// Whether the orthomosaic has the bands that the settings name, and those that the indices of plots need.
///
/// # Errors
/// Bands that cannot be those of the file, or of an orthomosaic that photos make; an index that needs another.
pub(super) fn check_bands(project: &Project) -> Result<(), Error> {
    let Config { project: ProjectOptions { bands, reflectance_scale, .. }, plots, .. } =
        project.config();
    let roles = match project.given_orthomosaic() {
        Some(path) => {
            let source = project.open_picture(&path)?;
            if !source.is_photo() {
                return Ok(());
            }
            source.roles()?
        }
        None if !bands.is_empty() || reflectance_scale.is_some() => {
            let message = "[project] bands, reflectance_scale: they are of an orthomosaic that is given ([project] ortho); the \
                           one that photos make is red, green, blue";
            return Err(Error::Argument(message.to_owned()));
        }
        None => [Band::Red, Band::Green, Band::Blue].map(Some).to_vec(),
    };
    plots.indices_of(&roles).map(drop)
}

/// Photos that are looked at for where a flight was.
const LOOKS: usize = 16;
/// Beyond the photos there may be plots; not so far away.
const MARGIN_M: f64 = 500.0;

/// Whether the plots lie among the photos, by the positions in these.
///
/// # Errors
/// Polygons that cannot be read or lie elsewhere.
pub(super) fn among_photos(project: &Project) -> Result<Option<Layer>, Error> {
    let (Some(plots), photos) = (project.plots(), project.photos()) else { return Ok(None) };
    let step = photos.len().div_ceil(LOOKS).max(1);
    let tags: Vec<_> =
        photos.iter().step_by(step).filter_map(|path| photo::read(path).ok()?.geotag).collect();
    let Some(first) = tags.first() else { return Ok(None) };
    if !polygons::is_placed(&plots)? {
        return Ok(None);
    }
    let Ok(zone) = crs::Crs::utm_of(first.latitude_deg, first.longitude_deg) else {
        return Ok(None);
    };
    let at =
        tags.iter().filter_map(|tag| zone.from_wgs84(tag.latitude_deg, tag.longitude_deg).ok());
    let bounds = at.fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], at| {
        [[0, 1].map(|k| at[k].min(low[k])), [0, 1].map(|k| at[k].max(high[k]))]
    });
    let [low, high] = bounds;
    // A map of a pixel for each metre.
    let corner = [low[0] - MARGIN_M, high[1] + MARGIN_M];
    let place = Georeference::north_up(corner, 1.0, Crs::from(&zone));
    let size = [0, 1].map(|k| (high[k] - low[k] + 2.0 * MARGIN_M).clamp(1.0, 1e9) as usize);
    Ok(Some(layers::layer(project, &plots, Some(&place), Some((size[0], size[1])))?))
}

/// How a picture's samples become colours.
fn colours(source: &Source, path: &Path) -> Result<Vec<String>, FileError> {
    match source {
        Source::File(reader) if reader.is_colour() => reader.colour_notes(),
        Source::File(reader) if !reader.holds::<u8>() && !reader.holds::<u16>() => {
            let message = "its pixels are single values (a vegetation index, heights), expected an orthomosaic in colours";
            Err(FileError::malformed(path, None, message))
        }
        _ => Ok(Vec::new()),
    }
}

/// What the bands of an orthomosaic are taken for, where that has to be said.
pub(super) fn bands(source: &Source, path: &Path) -> Vec<Diagnostic> {
    let name = name_of(path);
    match colours(source, path) {
        Ok(notes) => {
            let info = |note| Diagnostic::info("orthomosaic-bands", &name, note);
            notes.into_iter().map(info).collect()
        }
        Err(error) => {
            let message = error.to_string();
            vec![Diagnostic::error("orthomosaic-no-colours", name, message)]
        }
    }
}

/// What is odd about an orthomosaic: its reference system, its pixels, its bands.
pub(super) fn oddities(source: &Source, path: &Path) -> Vec<Diagnostic> {
    let name = name_of(path);
    let mut found = bands(source, path);
    if let Some(place) = source.georeference() {
        let stored = match source {
            Source::File(reader) => reader.stored_size(),
            Source::Picture { .. } => None,
        };
        found.extend(of_place(&place, stored, source.size()).into_iter().map(
            |(code, message, is_warning)| match is_warning {
                true => Diagnostic::warning(code, &name, message),
                false => Diagnostic::info(code, &name, message),
            },
        ));
    }
    found
}

/// Code, sentence, and whether it is a warning.
fn of_place(
    place: &Georeference,
    stored: Option<[usize; 2]>,
    (width, height): (usize, usize),
) -> Vec<(&'static str, String, bool)> {
    let mut found = Vec::new();
    let code = place.crs.epsg.map_or("its system".to_owned(), |code| format!("EPSG:{code}"));
    match place.crs.kind {
        CrsKind::Geographic => {
            let message =
                format!("{code} is in degrees; lengths and areas are computed on the ground");
            found.push(("map-in-degrees", message, false));
        }
        CrsKind::Feet | CrsKind::SurveyFeet => {
            let feet = if place.crs.kind == CrsKind::Feet { "international" } else { "US survey" };
            found.push((
                "map-in-feet",
                format!("{code} is in {feet} feet; lengths and areas are in metres"),
                false,
            ));
        }
        CrsKind::Projected | CrsKind::Unknown => {}
    }
    if let Some(scale) = place.map_scale().filter(|scale| (scale - 1.0).abs() > 1e-3) {
        let message = format!(
            "a length of 1 in {code} is {scale:.3} on the ground here; lengths and areas are those on the ground"
        );
        found.push(("map-scale", message, false));
    }
    if let Some([columns, rows]) = stored {
        let message = format!(
            "its pixels are oblong on the ground; its {columns} x {rows} pixels are read as {width} x {height} square ones"
        );
        found.push(("pixels-oblong", message, false));
    }
    if let Some(shear) = place.shear_rad().filter(|shear| *shear > 0.005) {
        let message = format!(
            "its columns and rows are {:.1} degrees off a right angle on the ground: lengths are off by up to {:.0} %; save it in \
             a projected system",
            shear.to_degrees(),
            100.0 * shear.sin()
        );
        found.push(("pixels-sheared", message, true));
    }
    let [[a, c], [b, d]] = [place.per_column, place.per_row];
    if a * d - b * c > 0.0 {
        let message = "its rows run from south to north; that is taken into account".to_owned();
        found.push(("map-south-up", message, false));
    } else if b != 0.0 || c != 0.0 {
        let turned = c.atan2(a).to_degrees();
        found.push((
            "map-turned",
            format!("it is turned by {turned:.1} degrees; that is taken into account"),
            false,
        ));
    }
    found
}
