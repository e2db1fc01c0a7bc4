//! The map of a project in full resolution and its marks, for a browser on the same machine.
//!
//! [`Viewer::answer`] turns the target of a request into an answer; [`serve`] brings both over HTTP. A target names a tile, a
//! place, the number of a photo or one of the rasters of the project, never a path, so that nothing outside of the project can be
//! asked for. Targets are relative to the address that [`Server::url`] gives.
//!
//! | target | answer |
//! |---|---|
//! | (empty) | the page; `style.css`, `map.js` and `photos.js` are its parts |
//! | `rasters/NAME.tif` | a raster of the project as it is, whole or in ranges of bytes, for QGIS and GDAL (`/vsicurl/`) |
//! | `tiles/LEVEL/COLUMN/ROW.jpg` | 512 x 512 pixels of the orthomosaic, each of 2^LEVEL x 2^LEVEL of its own |
//! | `photos?u=U&v=V` | the photos in whose frame a place of the orthomosaic (pixels) lies, as JSON |
//! | `photos/NUMBER.jpg?u=U&v=V&side=S` | S x S pixels of a photo around a place |
//! | `marks` | the page of marks ([`crate::targets::MarkEditor`]), which is the first where there is no map; `marks.css` and `marks.js` are its parts |
//! | `marks.json` | the marks; what is put there changes their file, and nothing else can be written |
//! | `marks/NUMBER.jpg?u=U&v=V&side=S` | as for `photos`, of the photos of the block |

mod marks;
mod serve;

use super::{Facts, map, page, pictures::on_paper};
use crate::{
    Project,
    ortho::ORTHOMOSAIC,
    query::{OrthophotoOrigins, Sighting, query},
    run::RunOutcome,
    stac,
    targets::MarkEditor,
};
use image::{Rgb, RgbImage, codecs::jpeg::JpegEncoder, imageops};
use rowgram_base::error::Error;
use rowgram_files::{geotiff::Reader, images};
use rowgram_optim::output::FileError;
use rowgram_raster::{georeference::Georeference, window::Window};
pub use serve::{Server, serve};
use std::{
    collections::BTreeMap,
    fmt::Display,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
};

/// Side of a tile, pixels.
pub(super) const TILE_PX: usize = 512;
/// Quality of the JPEGs.
const QUALITY: u8 = 88;
/// Photos that are kept decoded: as many as are looked at side by side.
const PHOTOS_KEPT: usize = 8;
/// The largest part of a photo that is sent, pixels.
const LARGEST_PX: u32 = 2048;

/// A picture, and which of its pixels (row by row) show nothing.
type WithGaps = (RgbImage, Option<Vec<bool>>);

/// What is sent back.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// Status of HTTP: 200, 400 to 415 (a request that is refused), 404 (nothing there), 500.
    pub status: u16,
    /// Media type of the body.
    pub media_type: &'static str,
    /// What is sent.
    pub body: Vec<u8>,
}

impl Answer {
    fn found(media_type: &'static str, body: Vec<u8>) -> Answer {
        Answer { status: 200, media_type, body }
    }

    fn failed(status: u16, message: &str) -> Answer {
        Answer { status, media_type: "text/plain; charset=utf-8", body: message.into() }
    }

    /// What cannot be read. Which file that is stands in the messages of the program, not in the answer.
    fn unreadable(error: &impl Display) -> Answer {
        tracing::warn!("not shown: {error}");
        Answer::failed(500, "it cannot be read")
    }
}

/// What a project is looked at with.
#[derive(Default)]
pub struct Viewer {
    /// The first page.
    page: String,
    marks_page: String,
    editor: Option<MarkEditor>,
    orthomosaic: Option<Reader>,
    place: Option<Georeference>,
    origins: Option<OrthophotoOrigins>,
    photos: Mutex<Vec<(PathBuf, Arc<RgbImage>)>>,
    /// Files that are sent as they are, by name.
    rasters: BTreeMap<&'static str, PathBuf>,
}

impl Viewer {
    /// Opens the results of the last run of a project, and its marks where it is aligned and has surveyed points.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where there is neither an orthomosaic nor anything to mark; results that cannot be read.
    pub fn open(project: &Project) -> Result<Viewer, Error> {
        let editor = MarkEditor::open(project);
        if let Err(error) = &editor {
            tracing::info!("no page of marks: {error}");
        }
        let (editor, name) = (editor.ok(), project.name());
        match Viewer::of_map(project, editor.is_some()) {
            Ok(viewer) => Ok(Viewer { marks_page: marks::page(&name, true), editor, ..viewer }),
            Err(error) if editor.is_some() => {
                tracing::info!("no map: {error}");
                let page = marks::page(&name, false);
                Ok(Viewer { marks_page: page.clone(), page, editor, ..Viewer::default() })
            }
            Err(error) => Err(error),
        }
    }

    fn of_map(project: &Project, has_marks: bool) -> Result<Viewer, Error> {
        let outcome = RunOutcome::of_last_run(project)?;
        let facts = Facts::gather(project, &outcome)?;
        let Some(path) = facts.orthomosaic() else {
            return Err(Error::NothingToDo(format!(
                "{}: there is no orthomosaic with a leaf mask yet; make them with rowgram run",
                project.results().display()
            )));
        };
        // Plain pictures are in the page in a size that can be looked at.
        let orthomosaic = Reader::open_with(&path, &project.reading(&path)).ok();
        // An orthomosaic from elsewhere has no photos.
        let origins = match query(project, None) {
            Ok(origins) => Some(origins),
            Err(Error::NothingToDo(_)) => None,
            Err(error) => return Err(error),
        };
        let place = orthomosaic.as_ref().and_then(Reader::georeference);
        let served = map::Served { tiles: orthomosaic.is_some(), photos: origins.is_some() };
        let page = page::viewer(&outcome.project, &map::served(&facts, served)?, has_marks);
        let mut rasters: BTreeMap<&str, PathBuf> = stac::rasters()
            .filter_map(|(stage, name)| Some((name, facts.file(stage, name)?)))
            .collect();
        if orthomosaic.is_some() {
            // One that was given is no result of a stage.
            rasters.entry(ORTHOMOSAIC).or_insert(path);
        }
        Ok(Viewer { page, orthomosaic, place, origins, rasters, ..Viewer::default() })
    }

    /// The raster that a target names.
    pub fn raster(&self, target: &str) -> Option<&Path> {
        self.rasters.get(target.strip_prefix("rasters/")?).map(PathBuf::as_path)
    }

    /// The answer to the target of a GET request: path and query, as in `tiles/0/3/4.jpg`.
    pub fn answer(&self, target: &str) -> Answer {
        let (path, query) = target.split_once('?').unwrap_or((target, ""));
        let parts: Vec<&str> = path.split('/').collect();
        let script =
            |text: &str| Some(Answer::found("text/javascript; charset=utf-8", text.into()));
        let page = |text: &str| Some(Answer::found("text/html; charset=utf-8", text.into()));
        let style = |text: &str| Some(Answer::found("text/css; charset=utf-8", text.into()));
        let answer = match parts[..] {
            [""] => page(&self.page),
            ["style.css"] => style(page::STYLE),
            ["marks.css"] => style(marks::STYLE),
            ["marks.js"] => script(marks::SCRIPT),
            ["marks"] if self.editor.is_some() => page(&self.marks_page),
            [marks::TARGET] => self.editor.as_ref().map(Viewer::marks),
            ["map.js"] => script(map::SCRIPT),
            ["photos.js"] => script(map::PHOTOS_SCRIPT),
            ["tiles", level, column, row] => numbers([level, column, jpeg_name(row)])
                .and_then(|[level, column, row]| self.tile(level, column, row)),
            ["photos"] => values(query, ["u", "v"]).map(|at| self.sightings(at)),
            [photos @ ("photos" | "marks"), name] => numbers([jpeg_name(name)])
                .zip(values(query, ["u", "v", "side"]))
                .and_then(|([number], [u, v, side])| {
                    let path = match photos {
                        "photos" => self.origins.as_ref()?.photo(number),
                        _ => self.editor.as_ref()?.photo(number),
                    };
                    Some(self.part(path?, [u, v], side))
                }),
            _ => None,
        };
        answer.unwrap_or_else(|| Answer::failed(404, "there is nothing here"))
    }

    fn tile(&self, level: usize, column: usize, row: usize) -> Option<Answer> {
        let reader = self.orthomosaic.as_ref()?;
        let step =
            1_usize.checked_shl(u32::try_from(level).ok()?).filter(|&step| step <= 1 << 20)?;
        let whole = [reader.width(), reader.height()];
        let size = whole.map(|length| length.div_ceil(step));
        let first = [column, row].map(|k| k.checked_mul(TILE_PX));
        let [Some(u), Some(v)] = first else { return None };
        if u >= size[0] || v >= size[1] {
            return None;
        }
        let part = [(size[0] - u).min(TILE_PX), (size[1] - v).min(TILE_PX)];
        let window = Window { u, v, width: part[0], height: part[1] };
        let stored = reader.overviews().iter().position(|&of| of == size);
        let picture = match (level, stored) {
            (0, _) => reader.read_rgb_and_gaps(window),
            (_, Some(overview)) => reader.read_overview_rgb_and_gaps(overview, window),
            (_, None) => every(reader, window, step),
        };
        let states_gaps = reader.states_gaps();
        Some(match picture {
            Ok((picture, gaps)) => encoded(&on_paper(picture, gaps.as_deref(), states_gaps)),
            Err(error) => Answer::unreadable(&error),
        })
    }

    fn sightings(&self, [u, v]: [f64; 2]) -> Answer {
        let found: Result<Vec<Sighting>, Error> = match (&self.origins, self.place) {
            (Some(origins), Some(place)) => origins.sightings(place.map([u, v])),
            _ => Ok(Vec::new()),
        };
        match found.map(|found| serde_json::to_vec(&found)) {
            Ok(Ok(body)) => Answer::found("application/json", body),
            Ok(Err(error)) => Answer::unreadable(&error),
            // A place outside of the map.
            Err(_) => Answer::failed(404, "there is nothing here"),
        }
    }

    /// A square of a photo around a place; what lies outside of the photo is left out.
    fn part(&self, path: &Path, [u, v]: [f64; 2], side: f64) -> Answer {
        let side = side.clamp(1.0, f64::from(LARGEST_PX));
        let photo = match self.read(path) {
            Ok(photo) => photo,
            Err(error) => return Answer::unreadable(&error),
        };
        let first = |at: f64, length: u32| (at - 0.5 * side).round().clamp(0.0, f64::from(length));
        let last = |at: f64, length: u32| (at + 0.5 * side).round().clamp(0.0, f64::from(length));
        let (width, height) = photo.dimensions();
        let (left, top) = (first(u, width) as u32, first(v, height) as u32);
        let (right, bottom) = (last(u, width) as u32, last(v, height) as u32);
        if left >= right || top >= bottom {
            return Answer::failed(404, "that photo does not show the place");
        }
        encoded(&imageops::crop_imm(&*photo, left, top, right - left, bottom - top).to_image())
    }

    fn read(&self, path: &Path) -> Result<Arc<RgbImage>, Error> {
        let kept = || self.photos.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, photo)) = kept().iter().find(|(of, _)| of == path) {
            return Ok(Arc::clone(photo));
        }
        let photo = Arc::new(images::read_colour(path)?);
        let mut kept = kept();
        if kept.len() >= PHOTOS_KEPT {
            kept.remove(0);
        }
        kept.push((path.to_owned(), Arc::clone(&photo)));
        Ok(photo)
    }
}

/// One pixel of `step` x `step`, for files without a picture of that resolution, and which show nothing.
fn every(reader: &Reader, window: Window, step: usize) -> Result<WithGaps, FileError> {
    let mut picture = RgbImage::new(window.width as u32, window.height as u32);
    let mut gaps = Vec::new();
    let width = ((window.width - 1) * step + 1).min(reader.width() - window.u * step);
    for v in 0..window.height {
        let row = Window { u: window.u * step, v: (window.v + v) * step, width, height: 1 };
        let (row, missing) = reader.read_rgb_and_gaps(row)?;
        for (u, Rgb(pixel)) in row.pixels().step_by(step).enumerate() {
            picture.put_pixel(u as u32, v as u32, Rgb(*pixel));
            gaps.push(missing.as_ref().is_some_and(|missing| missing[u * step]));
        }
    }
    Ok((picture, Some(gaps)))
}

fn encoded(picture: &RgbImage) -> Answer {
    let mut body = Vec::new();
    match JpegEncoder::new_with_quality(&mut body, QUALITY).encode_image(picture) {
        Ok(()) => Answer::found("image/jpeg", body),
        Err(error) => Answer::unreadable(&error),
    }
}

fn jpeg_name(name: &str) -> &str {
    name.strip_suffix(".jpg").unwrap_or("")
}

fn numbers<const N: usize>(texts: [&str; N]) -> Option<[usize; N]> {
    let found = texts.map(|text| text.parse().ok());
    found.iter().all(Option::is_some).then(|| found.map(Option::unwrap_or_default))
}

/// Finite numbers of a query by their names.
fn values<const N: usize>(query: &str, names: [&str; N]) -> Option<[f64; N]> {
    let of = |name: &str| {
        let mut pairs = query.split('&').filter_map(|pair| pair.split_once('='));
        let (_, text) = pairs.find(|(key, _)| *key == name)?;
        text.parse().ok().filter(|value: &f64| value.is_finite())
    };
    let found = names.map(of);
    found.iter().all(Option::is_some).then(|| found.map(Option::unwrap_or_default))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_are_numbers() {
        assert_eq!(numbers(["3", "14"]), Some([3, 14]));
        for bad in ["", "-1", "1.5", "..", "%2e", "99999999999999999999999"] {
            assert_eq!(numbers([bad]), None, "{bad}");
        }
        assert_eq!(values("u=1.5&v=-2", ["v", "u"]), Some([-2.0, 1.5]));
        for bad in ["", "u=1", "u=1&v=", "u=1&v=NaN", "u=inf&v=1", "u=1&w=2", "uv"] {
            assert_eq!(values(bad, ["u", "v"]), None, "{bad}");
        }
    }

    #[test]
    fn what_is_not_there_is_said() {
        let nothing = Viewer {
            page: "page".into(),
            rasters: BTreeMap::from([("ortho.tif", PathBuf::from("/field/ortho.tif"))]),
            ..Viewer::default()
        };
        assert_eq!(nothing.answer("").body, b"page");
        assert_eq!(nothing.answer("photos?u=1&v=2").body, b"[]");
        for target in ["style.css", "map.js", "photos.js", "marks.css", "marks.js"] {
            assert_eq!(nothing.answer(target).status, 200, "{target}");
        }
        for target in [
            "/",
            "//",
            "../../etc/passwd",
            "tiles/0/0/0.jpg",
            "tiles/99/0/0.jpg",
            "photos/0.jpg?u=1&v=1&side=10",
            "photos/..%2f..%2fetc%2fpasswd",
            "photos?u=1",
            "marks",
            "marks.json",
            "marks/0.jpg?u=1&v=1&side=10",
        ] {
            let answer = nothing.answer(target);
            assert_eq!(answer.status, 404, "{target}");
            let said = String::from_utf8(answer.body).unwrap();
            assert!(!said.contains('/') && !said.contains(".."), "{target}: {said}");
        }
        assert!(nothing.put("marks.json", b"{}").is_none(), "without marks nothing can be written");
        assert!(nothing.raster("rasters/ortho.tif").is_some());
        for target in ["rasters/", "rasters/../ortho.tif", "rasters//field/ortho.tif", "ortho.tif"]
        {
            assert!(nothing.raster(target).is_none(), "{target}");
        }
    }
}
