//! Whether camera positions and control are where they can be: beyond what a receiver can be wrong by, columns are
//! exchanged, a zone is another one, or units are.

use super::{ground::REACH_M, inputs::Photo};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::photo::Geotag;
use rowgram_optim::robust::median;
use rowgram_raster::crs::{Crs, FOOT_M, US_SURVEY_FOOT_M};
use rowgram_survey::scene::GroundPoint;

/// No flight is wider, metres: what is farther from the others is none of its positions.
const FLIGHT_M: f64 = 20_000.0;
/// Control is no farther from the photos that show it, by flying height and by a receiver's error, metres.
const APART_M: f64 = 1_500.0;
/// No map is so wide, metres.
const MAP_M: f64 = 5e7;
/// A transverse projection is of no use so far from its central meridian, degrees.
const MERIDIAN_DEG: f64 = 12.0;
/// The same of other projections.
const LONGITUDE_DEG: f64 = 60.0;
/// The metre in feet: international and of the US survey.
const FEET: [f64; 2] = [FOOT_M, US_SURVEY_FOOT_M];

/// Metres between two places on a sphere.
fn distance_m([lat, lon]: [f64; 2], [lat2, lon2]: [f64; 2]) -> f64 {
    let [a, b] = [lat, lat2].map(f64::to_radians);
    let half = [(b - a) / 2.0, (lon2 - lon).to_radians() / 2.0].map(f64::sin);
    let h = half[0] * half[0] + a.cos() * b.cos() * half[1] * half[1];
    2.0 * 6_371_000.0 * h.sqrt().min(1.0).asin()
}

/// Metres between two positions in the plan.
pub(super) fn apart_m(a: &Geotag, b: &Geotag) -> f64 {
    distance_m([a.latitude_deg, a.longitude_deg], [b.latitude_deg, b.longitude_deg])
}

fn middle(tags: &[Geotag]) -> [f64; 2] {
    [
        median(tags.iter().map(|tag| tag.latitude_deg)).unwrap_or(0.0),
        median(tags.iter().map(|tag| tag.longitude_deg)).unwrap_or(0.0),
    ]
}

/// The scale of a block and that of its camera positions differ by this share at most: positions of a flight 20 m wide that are off by 3 m. Assumed.
const MAX_SCALE_ERROR: f64 = 0.15;

/// Whether the cameras of a block are as far apart as their positions say, both in the plan. Control in unnamed feet makes a block too large that looks right in itself.
pub(super) fn scale_contradiction(cameras: &[[[f64; 2]; 2]]) -> Option<Diagnostic> {
    let spread = |of: usize| {
        let places = || cameras.iter().map(|camera| camera[of]);
        let [x, y] = [median(places().map(|at| at[0]))?, median(places().map(|at| at[1]))?];
        median(places().map(|at| (at[0] - x).hypot(at[1] - y))).filter(|&spread| spread > 0.0)
    };
    let ratio = spread(0)? / spread(1)?;
    if cameras.len() < 4 || (1.0 / (1.0 + MAX_SCALE_ERROR)..=1.0 + MAX_SCALE_ERROR).contains(&ratio)
    {
        return None;
    }
    let is_feet = FEET.iter().any(|foot| (ratio * foot - 1.0).abs() < MAX_SCALE_ERROR);
    let feet = if is_feet { ", as if its control were in feet" } else { "" };
    let message =
        format!("the block is {ratio:.2} times as large as the positions of its cameras say{feet}");
    let remedy = "give control in metres, or name its unit in the titles of the table";
    Some(Diagnostic::warning("position-scale", "camera positions", message).with_remedy(remedy))
}

/// Takes out positions that are far from those of all others.
pub(super) fn drop_far(photos: &[Photo], tags: &mut [Option<Geotag>], monitor: &mut dyn Monitor) {
    let there: Vec<Geotag> = tags.iter().flatten().copied().collect();
    let at = middle(&there);
    for (photo, tag) in photos.iter().zip(tags) {
        let Some(Geotag { latitude_deg, longitude_deg, .. }) = *tag else { continue };
        let far_m = distance_m(at, [latitude_deg, longitude_deg]);
        if far_m > FLIGHT_M {
            let message = format!(
                "its position, latitude {latitude_deg:.5}, longitude {longitude_deg:.5}, is {:.0} km from those of the other photos: not used",
                far_m / 1000.0
            );
            monitor.diagnostic(&Diagnostic::warning("position-far", photo.name.as_str(), message));
            *tag = None;
        }
    }
}

/// Positions of a file against those that the photos have themselves.
///
/// # Errors
/// Where they are of another place.
pub(super) fn check_tables(own: &[Option<Geotag>], read: &[Option<Geotag>]) -> Result<(), Error> {
    let both: Vec<(Geotag, Geotag)> =
        own.iter().zip(read).filter_map(|(own, read)| Some(((*own)?, (*read)?))).collect();
    if both.is_empty() {
        return Ok(());
    }
    let (own, read): (Vec<Geotag>, Vec<Geotag>) = both.into_iter().unzip();
    let (own, read) = (middle(&own), middle(&read));
    let far_m = distance_m(own, read);
    if far_m < FLIGHT_M {
        return Ok(());
    }
    let cause = if distance_m(own, [read[1], read[0]]) < FLIGHT_M {
        "latitude and longitude are exchanged in the file: exchange its columns"
    } else {
        "they are of another flight or hold wrong numbers: correct the file, or name another with [project] positions"
    };
    Err(Error::Argument(format!(
        "the positions of the file are {:.0} km from those in the photos; {cause}",
        far_m / 1000.0
    )))
}

/// Whether a coordinate reference system can be that of photos taken there.
///
/// # Errors
/// Where they are far outside of it.
pub(super) fn check_crs(crs: &Crs, tags: &[Geotag]) -> Result<(), Error> {
    if tags.is_empty() {
        return Ok(());
    }
    let [lat, lon] = middle(tags);
    let definition = crs.definition();
    let value = |key: &str| -> Option<f64> {
        definition.split_whitespace().find_map(|word| word.strip_prefix(key)?.parse().ok())
    };
    let zone = value("+zone=").map(|zone| 6.0 * zone - 183.0);
    let transverse = zone.is_some() || definition.contains("+proj=tmerc");
    let most = if transverse { MERIDIAN_DEG } else { LONGITUDE_DEG };
    let meridian = zone.or_else(|| value("+lon_0="));
    let off =
        |lon: f64| meridian.map_or(0.0, |m| ((lon - m + 540.0).rem_euclid(360.0) - 180.0).abs());
    if off(lon) <= most {
        return Ok(());
    }
    let cause = if off(lat) <= most && lon.abs() <= 90.0 {
        "latitude and longitude of the camera positions seem to be exchanged".to_owned()
    } else {
        let utm = Crs::utm_of(lat, lon)
            .map_or(String::new(), |utm| format!(", which is {} there", utm.name()));
        format!("name the system of that place{utm} with [project] crs (--crs)")
    };
    Err(Error::Argument(format!(
        "{} cannot be the system of photos taken at latitude {lat:.4}, longitude {lon:.4}: its middle is {:.0} degrees of longitude away; {cause}",
        crs.name(),
        off(lon)
    )))
}

/// Whether coordinates can be coordinates.
///
/// # Errors
/// The first that cannot.
pub(super) fn check_numbers(ground: &[GroundPoint]) -> Result<(), Error> {
    let wrong =
        |point: &&GroundPoint| point.position_m.iter().any(|v| v.is_nan() || v.abs() > MAP_M);
    match ground.iter().find(wrong) {
        None => Ok(()),
        Some(point) => {
            let [x, y, z] = point.position_m;
            Err(Error::Argument(format!(
                "ground point {}: {x:e} {y:e} {z:e} are no coordinates in metres; check its row and the unit of the file",
                point.name
            )))
        }
    }
}

/// Least distance in the plan between control and photos, metres.
fn control_apart_m(ground: &[GroundPoint], photos: &[[f64; 2]], factor: f64) -> f64 {
    let of = |point: &GroundPoint| {
        let [x, y, _] = point.position_m.map(|v| v * factor);
        photos.iter().map(|p| (p[0] - x).hypot(p[1] - y)).fold(f64::INFINITY, f64::min)
    };
    median(ground.iter().map(of)).unwrap_or(0.0)
}

/// Why control lies far from the photos in a system, if it does.
fn cause(crs: &Crs, ground: &[GroundPoint], tags: &[Geotag]) -> Option<(f64, Option<String>)> {
    let within = |crs: &Crs, exchange: bool| -> Vec<[f64; 2]> {
        let of = |tag: &Geotag| {
            let (lat, lon) = (tag.latitude_deg, tag.longitude_deg);
            let (lat, lon) = if exchange { (lon, lat) } else { (lat, lon) };
            (lat.abs() <= 90.0).then(|| crs.from_wgs84(lat, lon).ok()).flatten()
        };
        tags.iter().filter_map(of).collect()
    };
    let photos = within(crs, false);
    let far_m = control_apart_m(ground, &photos, 1.0);
    if far_m < APART_M {
        return None;
    }
    let swapped: Vec<[f64; 2]> = photos.iter().map(|p| [p[1], p[0]]).collect();
    if control_apart_m(ground, &swapped, 1.0) < APART_M {
        // Found by the block itself, and put right.
        return None;
    }
    if control_apart_m(ground, &within(crs, true), 1.0) < APART_M {
        let cause = "latitude and longitude of the camera positions are exchanged: exchange the columns of their file";
        return Some((far_m, Some(cause.to_owned())));
    }
    if FEET.iter().any(|feet| control_apart_m(ground, &photos, *feet) < APART_M) {
        let cause = "the control points are in feet: convert them to metres";
        return Some((far_m, Some(cause.to_owned())));
    }
    let zones = (1..=60).flat_map(|zone| [32600 + zone, 32700 + zone]);
    let nearest = tags.first().map_or(0.0, |tag| tag.longitude_deg);
    let near = |code: &u32| {
        let meridian = f64::from(code % 100) * 6.0 - 183.0;
        ((nearest - meridian + 540.0).rem_euclid(360.0) - 180.0).abs() < MERIDIAN_DEG
    };
    let other = zones.filter(near).filter_map(|code| Crs::from_epsg(code).ok());
    let other = other.into_iter().find(|other| {
        other.name() != crs.name() && control_apart_m(ground, &within(other, false), 1.0) < APART_M
    });
    let cause = other.map(|other| {
        format!("they lie among the photos in {0}: set [project] crs = \"{0}\"", other.name())
    });
    Some((far_m, cause))
}

/// Whether control lies where the photos were taken.
///
/// # Errors
/// Where it does not, with the likely cause.
pub(super) fn check_control(
    crs: &Crs,
    ground: &[GroundPoint],
    tags: &[Geotag],
) -> Result<(), Error> {
    if ground.is_empty() || tags.is_empty() {
        return Ok(());
    }
    let Some((far_m, cause)) = cause(crs, ground, tags) else { return Ok(()) };
    let cause = cause.unwrap_or_else(|| {
        "check [project] crs and the columns of the control points; where the camera positions are wrong, leave them out with [align] use_positions = false".to_owned()
    });
    Err(Error::Argument(format!(
        "the control points are {} from the photos in {}; {cause}",
        if far_m < 1e4 { format!("{far_m:.0} m") } else { format!("{:.0} km", far_m / 1e3) },
        crs.name()
    )))
}

/// Whether control in latitude and longitude lies where the photos were taken.
///
/// # Errors
/// Where it does not, with the likely cause.
pub(super) fn check_degrees(ground: &[GroundPoint], tags: &[Geotag]) -> Result<(), Error> {
    if ground.is_empty() || tags.is_empty() {
        return Ok(());
    }
    let photos = middle(tags);
    let far_m = |read: &dyn Fn([f64; 2]) -> [f64; 2]| {
        let away = |p: &GroundPoint| distance_m(photos, read([p.position_m[0], p.position_m[1]]));
        median(ground.iter().map(away)).unwrap_or(0.0)
    };
    let own_m = far_m(&|place| place);
    if own_m <= REACH_M {
        return Ok(());
    }
    let cause = if far_m(&|[lat, lon]| [lon, lat]) <= REACH_M {
        "latitude and longitude are exchanged in the file: exchange its columns"
    } else if far_m(&|[lat, lon]| [lat, -lon]) <= REACH_M {
        "longitudes west of Greenwich are negative"
    } else if far_m(&|[lat, lon]| [-lat, lon]) <= REACH_M {
        "latitudes south of the equator are negative"
    } else {
        "check the columns of the control points; where the camera positions are wrong, leave them out with [align] use_positions = false"
    };
    let far_km = own_m / 1e3;
    Err(Error::Argument(format!("the control points are {far_km:.0} km from the photos; {cause}")))
}

/// The likely cause where control of a system that nobody named lies far from the photos.
///
/// # Errors
/// Where a cause is found.
pub(super) fn check_unnamed(ground: &[GroundPoint], tags: &[Geotag]) -> Result<(), Error> {
    let Some(tag) = tags.first() else { return Ok(()) };
    let Ok(zone) = Crs::utm_of(tag.latitude_deg, tag.longitude_deg) else { return Ok(()) };
    let exchanged = || {
        let usable = tag.longitude_deg.abs() <= 90.0;
        usable.then(|| Crs::utm_of(tag.longitude_deg, tag.latitude_deg).ok()).flatten()
    };
    let found = cause(&zone, ground, tags).and_then(|(_, cause)| cause);
    let found = found.or_else(|| {
        let (_, cause) = cause(&exchanged()?, ground, tags)?;
        cause.filter(|cause| cause.contains("exchanged"))
    });
    match found {
        None => Ok(()),
        Some(cause) => Err(Error::Argument(format!(
            "the control points are not where the photos are; {cause}"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_survey::scene::{Axes, Role};

    #[test]
    fn a_block_in_feet_is_told_from_one_that_drifts() {
        let flight = |scale: f64| -> Vec<[[f64; 2]; 2]> {
            let at = |k: usize| [10.0 * (k / 4) as f64, 5.0 * (k % 4) as f64];
            (0..20).map(|k| [at(k).map(|x| scale * x), at(k)]).collect()
        };
        let said = |scale: f64| scale_contradiction(&flight(scale)).map(|d| d.message);
        assert_eq!([0.9, 1.1].map(said), [None, None]);
        assert!(said(1.0 / FOOT_M).unwrap().ends_with("as if its control were in feet"));
        assert!(said(0.7).unwrap().starts_with("the block is 0.70 times as large"));
    }

    #[test]
    fn control_in_degrees_lies_where_the_photos_are() {
        let tag =
            Geotag { latitude_deg: 40.47, longitude_deg: -86.99, height_m: None, sigma_m: None };
        let check = |[lat, lon]: [f64; 2]| {
            let point = GroundPoint {
                name: "A".into(),
                position_m: [lat, lon, 180.0],
                sigma_m: [0.02; 3],
                role: Role::Control,
                axes: Axes::Xyz,
            };
            check_degrees(&[point], &[tag]).map_err(|error| error.to_string())
        };
        assert_eq!(check([40.471, -86.991]), Ok(()));
        for (place, cause) in [
            ([-86.99, 40.47], "exchanged"),
            ([40.47, 86.99], "west of Greenwich are negative"),
            ([-40.47, -86.99], "south of the equator"),
            ([41.47, -86.99], "111 km from the photos; check the columns"),
        ] {
            let error = check(place).unwrap_err();
            assert!(error.contains(cause), "{error}");
        }
    }
}
