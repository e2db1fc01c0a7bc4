//! What is known of a project on the ground and in the air, in one frame.

use super::{
    geotags::{self, photos_deg},
    inputs::{Frame, Photo, Sources, names},
    marks, place as places,
};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::{
    control::{self, Control, Defaults},
    gcp_list,
    photo::Geotag,
};
use rowgram_optim::output::name_of;
use rowgram_raster::crs::{Crs, LocalPlane};
use rowgram_survey::{
    scene::{
        Axes, CameraOrientation, CameraPosition, GroundObservation, GroundPoint, Role,
        gimbal_rotation,
    },
    sfm::georeference::Known,
};
use std::path::Path;

/// Control as it was read.
struct Ground {
    control: Control,
    marks: Vec<GroundObservation>,
}

/// Whether a file of control is a table whose image measurements are in another.
pub(super) fn is_table(path: &Path) -> bool {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let named = path.file_stem().is_some_and(|stem| stem.eq_ignore_ascii_case("gcp_list"));
    ending.eq_ignore_ascii_case("csv")
        || !named
            && !ending.eq_ignore_ascii_case("json")
            && gcp_list::read(path, &Defaults::default(), None).is_err()
}

fn control(
    photos: &[Photo],
    sources: &Sources<'_>,
    monitor: &mut dyn Monitor,
) -> Result<Option<Ground>, Error> {
    let Some(path) = &sources.control else { return Ok(None) };
    let subject = name_of(path);
    let photos_deg = photos_deg(photos);
    let ground = if is_table(path) {
        let read = control::read(path, &sources.defaults, photos_deg, sources.crs.is_some())?;
        if read.ground.is_empty() && sources.marks.is_none() {
            monitor.diagnostic(&geotags::empty_table(path, "ground points"));
            return Ok(None);
        }
        let Some(marks) = &sources.marks else {
            let message =
                "there is no marks.csv that says where the points are in the photos: not used";
            monitor.diagnostic(&Diagnostic::warning("no-marks", subject, message));
            return Ok(None);
        };
        let (marks, aside) =
            control::marks(marks, &names(photos), &read.ground, &sources.defaults)?;
        for excluded in &aside {
            let diagnostic = Diagnostic::warning("mark-excluded", "marks", excluded.to_string());
            monitor.diagnostic(&diagnostic);
        }
        Ground { control: read, marks }
    } else {
        listed(path, photos, sources, monitor)?
    };
    let empty = [(Some(path), ground.control.ground.is_empty(), "ground points")];
    let marks_file = if is_table(path) { sources.marks.as_ref() } else { None };
    let of_marks = [(marks_file, ground.marks.is_empty(), "marks")];
    for (path, is_empty, what) in empty.into_iter().chain(of_marks) {
        if let Some(path) = path.filter(|_| is_empty) {
            monitor.diagnostic(&geotags::empty_table(path, what));
        }
    }
    if let Some(choice) = &ground.control.choice {
        let found = Diagnostic::info("columns-assumed", subject.as_str(), choice.as_str());
        let remedy = "gcps.csv with a first row label, easting_m, northing_m, height_m (or latitude, longitude) says otherwise";
        monitor.diagnostic(&found.with_remedy(remedy));
    }
    let mut ground = ground;
    without_heights(&mut ground.control, &subject, monitor);
    marks::outside(&ground.marks, photos, monitor);
    Ok(Some(ground))
}

/// Control of a file that has the image measurements too.
fn listed(
    path: &Path,
    photos: &[Photo],
    sources: &Sources<'_>,
    monitor: &mut dyn Monitor,
) -> Result<Ground, Error> {
    let names = names(photos);
    let is_json = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    let read = if is_json {
        let size = |name: &str| names.find(name).map(|k| photos[k as usize].size_px);
        gcp_list::read_opensfm(path, &sources.defaults, size)?
    } else {
        gcp_list::read(path, &sources.defaults, photos_deg(photos))?
    };
    let mut marks = Vec::new();
    let mut unmatched = std::collections::BTreeSet::new();
    for mark in &read.marks {
        match names.find(&mark.image) {
            Some(image) => marks.push(GroundObservation {
                image,
                ground: mark.ground as u32,
                image_px: mark.image_px,
                sigma_px: sources.defaults.mark_px,
            }),
            None => {
                unmatched.insert(mark.image.clone());
            }
        }
    }
    if !unmatched.is_empty() {
        let names: Vec<String> = unmatched.into_iter().collect();
        let message = format!("marks in images that are not here: {}", names.join(", "));
        let subject = path.display().to_string();
        monitor.diagnostic(&Diagnostic::warning("mark-excluded", subject, message));
    }
    Ok(Ground { control: read, marks })
}

/// Says which points have no heights, those at 0 among them.
pub(crate) fn without_heights(control: &mut Control, subject: &str, monitor: &mut dyn Monitor) {
    if control.drop_zero_heights() {
        let message = "the heights of all points are 0, as where they were not measured: the points are used in plan only";
        let found = Diagnostic::warning("control-without-heights", subject, message);
        let remedy =
            "give their heights; where 0 is meant, gcps.csv with a column axes that says xyz";
        monitor.diagnostic(&found.with_remedy(remedy));
        return;
    }
    let flat = control.ground.iter().filter(|point| point.axes == Axes::Xy);
    let names: Vec<&str> = flat.map(|point| point.name.as_str()).collect();
    if !names.is_empty() {
        let message =
            format!("points without a height are used in plan only: {}", names.join(", "));
        monitor.diagnostic(&Diagnostic::info("control-without-heights", subject, message));
    }
}

/// A flight is no wider than this; control farther from its photos is in another system.
pub(super) const REACH_M: f64 = 20_000.0;

/// Control and camera positions in the frame of the project.
pub(super) fn read(
    photos: &[Photo],
    tags: &[Option<Geotag>],
    sources: &Sources<'_>,
    monitor: &mut dyn Monitor,
) -> Result<(Frame, Known, Vec<bool>), Error> {
    let read = control(photos, sources, monitor)?;
    let control = read.as_ref().map(|read| &read.control);
    let mut known = Known::default();
    let tagged: Vec<(usize, Geotag)> =
        tags.iter().enumerate().filter_map(|(k, tag)| tag.map(|tag| (k, tag))).collect();
    let bad = |e: rowgram_raster::crs::CrsError| Error::Argument(format!("--crs: {e}"));
    let geographic = control.is_some_and(|c| c.geographic);
    let mut crs = match sources.crs {
        Some(words) => Some(Crs::from_words(words).map_err(bad)?),
        None => match control.and_then(|c| c.crs.as_deref()) {
            // Degrees may be of the system that the file names.
            Some(words) if geographic => Crs::from_words(words).ok(),
            Some(words) => Some(Crs::from_words(words).map_err(|e| {
                Error::Argument(format!("the control points' reference system: {e}"))
            })?),
            None => None,
        },
    };
    if let Some(read) = read {
        known.ground = read.control.ground;
        known.marks = read.marks;
    }
    for name in sources.check {
        let point = known.ground.iter_mut().find(|point| point.name == *name);
        let point = point.ok_or_else(|| {
            Error::Argument(format!("--check {name}: there is no such ground point"))
        })?;
        point.role = Role::Check;
    }
    for name in sources.keep {
        let point = known.ground.iter().find(|point| point.name == *name);
        let point = point.ok_or_else(|| {
            Error::Argument(format!("--keep {name}: there is no such ground point"))
        })?;
        if point.role != Role::Control {
            let message = format!("--keep {name}: it is a check point, and no control to keep");
            return Err(Error::Argument(message));
        }
    }
    known.keep = sources.keep.to_vec();
    let taken: Vec<Geotag> = tagged.iter().map(|(_, tag)| *tag).collect();
    places::check_numbers(&known.ground)?;
    if geographic && sources.use_positions {
        places::check_degrees(&known.ground, &taken)?;
    }
    if let Some(crs) = &crs {
        places::check_crs(crs, &taken)?;
        if !geographic && sources.use_positions {
            places::check_control(crs, &known.ground, &taken)?;
        }
    }
    // Control that lies where the photos were taken in the UTM zone of those is in that zone.
    if let (None, Some((_, tag)), false, false) =
        (&crs, tagged.first(), known.ground.is_empty(), geographic)
        && let Ok(zone) = Crs::utm_of(tag.latitude_deg, tag.longitude_deg)
        && let Ok([east, north]) = zone.from_wgs84(tag.latitude_deg, tag.longitude_deg)
    {
        let near =
            |p: &GroundPoint| (p.position_m[0] - east).hypot(p.position_m[1] - north) < REACH_M;
        if known.ground.iter().filter(|p| near(p)).count() * 2 > known.ground.len() {
            let message = format!(
                "none was given; using {}, in which the control points lie among the photos",
                zone.name()
            );
            let diagnostic = Diagnostic::info("crs-assumed", "coordinate system", message);
            monitor.diagnostic(&diagnostic.with_remedy("change it with [project] crs"));
            crs = Some(zone);
        }
    }
    // Where the photos were taken, or control in degrees lies.
    let mut places_deg: Vec<[f64; 2]> =
        tagged.iter().map(|(_, tag)| [tag.latitude_deg, tag.longitude_deg]).collect();
    if places_deg.is_empty() && geographic {
        places_deg = known.ground.iter().map(|p| [p.position_m[0], p.position_m[1]]).collect();
    }
    let frame = match (crs, places_deg.first()) {
        (Some(crs), _) => Frame::Map(Box::new(crs)),
        (None, Some(_)) if known.ground.is_empty() || geographic => {
            let n = places_deg.len() as f64;
            let [lat, lon] = [0, 1].map(|k| places_deg.iter().map(|at| at[k]).sum::<f64>() / n);
            match Crs::utm_of(lat, lon) {
                // Poleward of it there is no zone.
                Ok(zone) if lat.abs() < 84.0 => {
                    let message =
                        format!("none was given; using {}, the zone of the photos", zone.name());
                    let diagnostic = Diagnostic::info("crs-assumed", "coordinate system", message);
                    monitor.diagnostic(&diagnostic.with_remedy("change it with [project] crs"));
                    Frame::Map(Box::new(zone))
                }
                _ => Frame::Local(LocalPlane::at([lat, lon, 0.0])),
            }
        }
        (None, _) if !known.ground.is_empty() && !geographic => {
            if !tagged.is_empty() {
                if sources.use_positions {
                    places::check_unnamed(&known.ground, &taken)?;
                }
                let message = "that of the control points is not known: camera positions only tell which photos are neighbours";
                let diagnostic = Diagnostic::warning("crs-unknown", "coordinate system", message);
                let remedy = "name it with [project] crs = \"EPSG:<code>\" to use them";
                monitor.diagnostic(&diagnostic.with_remedy(remedy));
            }
            Frame::Unnamed
        }
        (None, Some(_)) | (None, None) => Frame::Free,
    };
    if geographic {
        for point in &mut known.ground {
            let [lat, lon, height] = point.position_m;
            point.position_m = place(&frame, lat, lon, height).map_err(bad)?;
        }
    }
    if let Frame::Map(crs) = &frame
        && !crs.knows_datum()
    {
        let message = "its definition does not tell how its datum differs from WGS84: positions of receivers may be off by up to some hundred metres, all alike; ground control corrects that";
        monitor.diagnostic(&Diagnostic::warning("datum-unknown", crs.name(), message));
    }
    let mut has_sigma = vec![false; photos.len()];
    if sources.use_positions && !matches!(frame, Frame::Unnamed | Frame::Free) {
        for (k, tag) in tagged {
            let Some(height) = tag.height_m else { continue };
            let position_m =
                place(&frame, tag.latitude_deg, tag.longitude_deg, height).map_err(bad)?;
            let default = sources.defaults.position_m;
            has_sigma[k] = tag.sigma_m.is_some();
            known.positions.push(CameraPosition {
                image: k as u32,
                position_m,
                sigma_m: tag.sigma_m.unwrap_or([default, default, default]),
            });
        }
    }
    if matches!(frame, Frame::Map(_) | Frame::Local(_)) {
        known.orientations = orientations(photos, sources.gimbal_sigma_deg);
    }
    Ok((frame, known, has_sigma))
}

/// Standard deviation of a heading over that of roll and pitch: compasses are worse than levels. Assumed.
const HEADING_RATIO: f64 = 5.0;

/// Orientations in the photos. Angles that are all 0 stand for none.
fn orientations(photos: &[Photo], sigma_deg: f64) -> Vec<CameraOrientation> {
    let angles = |photo: &Photo| photo.metadata.gimbal_deg.filter(|angles| *angles != [0.0; 3]);
    if sigma_deg <= 0.0 {
        return Vec::new();
    }
    let sigma_rad = sigma_deg.to_radians();
    let known = photos.iter().zip(0..).filter_map(|(photo, image)| {
        Some(CameraOrientation {
            image,
            rotation: gimbal_rotation(angles(photo)?),
            sigma_rad: [sigma_rad, sigma_rad, HEADING_RATIO * sigma_rad],
        })
    });
    known.collect()
}

pub(super) fn place(
    frame: &Frame,
    latitude_deg: f64,
    longitude_deg: f64,
    height_m: f64,
) -> Result<[f64; 3], rowgram_raster::crs::CrsError> {
    match frame {
        Frame::Map(crs) => {
            let [east, north] = crs.from_wgs84(latitude_deg, longitude_deg)?;
            Ok([east, north, height_m])
        }
        Frame::Local(plane) => Ok(plane.from_wgs84([latitude_deg, longitude_deg, height_m])),
        Frame::Unnamed | Frame::Free => Ok([f64::NAN; 3]),
    }
}

/// Positions in a plane for choosing neighbours, metres; NaN where there is none.
pub(crate) fn plan_m(tags: &[Option<Geotag>]) -> Vec<[f64; 2]> {
    let Some(first) = tags.iter().flatten().next() else {
        return vec![[f64::NAN; 2]; tags.len()];
    };
    let plane = LocalPlane::at([first.latitude_deg, first.longitude_deg, 0.0]);
    tags.iter()
        .map(|tag| match tag {
            Some(tag) => {
                let [east, north, _] = plane.from_wgs84([tag.latitude_deg, tag.longitude_deg, 0.0]);
                [east, north]
            }
            None => [f64::NAN; 2],
        })
        .collect()
}
