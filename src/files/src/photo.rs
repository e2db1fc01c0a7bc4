//! What a photo's file says of how it was taken: EXIF, and the XMP of drones.
//!
//! EXIF is read by `kamadak-exif`, as far as it can be read: a directory that is damaged leaves the others. XMP (`xmp`)
//! gives what EXIF does not: the position, its accuracy, the angles of the camera mount, the band of a multispectral camera.

mod xmp;

use super::FileError;
use exif::{In, Reader, Tag, Value};
use serde::{Deserialize, Serialize};
use std::{io::Cursor, path::Path};

/// A photo's position as its receiver gave it, WGS84.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Geotag {
    /// Degrees north.
    pub latitude_deg: f64,
    /// Degrees east.
    pub longitude_deg: f64,
    /// Metres, above whatever the receiver takes as zero; `None` where it gave none.
    pub height_m: Option<f64>,
    /// Standard deviations along east, north, up where it gave them, metres.
    pub sigma_m: Option<[f64; 3]>,
}

/// What is known of a photo before it is looked at.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Metadata {
    /// Maker of the camera.
    pub make: String,
    /// Its model.
    pub model: String,
    /// When it was taken, as EXIF writes it with fractions of a second: sorts by time.
    pub moment: String,
    /// Offset of that time from UTC, as EXIF writes it (`+02:00`); empty where it is not told.
    pub utc_offset: String,
    /// When it was taken in UTC by the receiver's clock, written as `moment`; empty where it is not told.
    pub utc: String,
    /// Focal length, millimetres.
    pub focal_mm: Option<f64>,
    /// Focal length of a 36 x 24 mm camera with as wide a view, millimetres.
    pub focal_35mm: Option<f64>,
    /// Pixels per millimetre of the sensor, from the focal plane's resolution, with the width of the
    /// photo that it is for.
    pub sensor_px_per_mm: Option<f64>,
    /// Size that the camera wrote, pixels; differs from the file's where the photo was resized.
    pub written_size_px: Option<[u32; 2]>,
    /// How the picture is to be turned for people (1: not at all).
    pub orientation: u32,
    /// Where it was taken.
    pub geotag: Option<Geotag>,
    /// Yaw, pitch and roll of the camera mount, degrees, as a DJI drone writes them (pitch -90: straight
    /// down).
    pub gimbal_deg: Option<[f64; 3]>,
    /// The band that a camera of several bands says the file is of.
    pub band: Option<String>,
    /// What of EXIF could not be read; empty where all could.
    pub unread: String,
    /// Height above the point of take-off, metres.
    pub height_above_take_off_m: Option<f64>,
    /// How long each pixel was exposed, seconds.
    pub exposure_s: Option<f64>,
    /// Sensitivity of the sensor, ISO.
    pub iso: Option<f64>,
    /// Focal length over the diameter of the aperture.
    pub f_number: Option<f64>,
}

/// Reads what a file says, without decoding the picture. A file without EXIF gives an empty answer.
///
/// # Errors
/// Where the file cannot be read.
pub fn read(path: &Path) -> Result<Metadata, FileError> {
    let bytes = crate::memory::read_file(path)?;
    Ok(parse(&bytes))
}

impl Metadata {
    /// When the photo was taken, after ISO 8601, with the offset from UTC where that is known; `None` where the photo does not
    /// tell a date and a time.
    pub fn time(&self) -> Option<String> {
        let (date, time) = self.moment.split_once(' ')?;
        let digits = |text: &str, lengths: &[usize], by: char| {
            let parts: Vec<&str> = text.split(by).collect();
            parts.len() == lengths.len()
                && parts.iter().zip(lengths).all(|(part, length)| {
                    part.len() == *length && part.bytes().all(|byte| byte.is_ascii_digit())
                })
        };
        let whole = time.split('.').next()?;
        if !digits(date, &[4, 2, 2], ':') || !digits(whole, &[2, 2, 2], ':') {
            return None;
        }
        let offset =
            self.utc_offset.strip_prefix(['+', '-']).is_some_and(|rest| digits(rest, &[2, 2], ':'));
        let offset = if offset { self.utc_offset.as_str() } else { "" };
        Some(format!("{}T{time}{offset}", date.replace(':', "-")))
    }
}

/// As [`read`], from a file's bytes.
pub fn parse(bytes: &[u8]) -> Metadata {
    let mut found = Metadata { orientation: 1, ..Metadata::default() };
    let (mut xmp, mut step_deg) = (None, 0.0);
    match Reader::new().continue_on_error(true).read_from_container(&mut Cursor::new(bytes)) {
        Ok(exif) => {
            step_deg = from_exif(&exif, &mut found);
            xmp = xmp::of_tiff(&exif);
        }
        Err(exif::Error::PartialResult(partial)) => {
            let (exif, errors) = partial.into_inner();
            step_deg = from_exif(&exif, &mut found);
            xmp = xmp::of_tiff(&exif);
            // A file without a thumbnail, or with a wrong one, lacks nothing that counts.
            let lost = errors.iter().map(ToString::to_string);
            let lost: Vec<String> = lost.chain([found.unread]).filter(|s| !s.is_empty()).collect();
            found.unread = lost.join(", ");
        }
        Err(exif::Error::InvalidFormat(why) | exif::Error::BlankValue(why)) => {
            found.unread = why.to_owned();
        }
        Err(_) => {}
    }
    if let Some(text) = xmp.or_else(|| xmp::of_file(bytes)) {
        xmp::read(&text, &mut found, step_deg);
    }
    found
}

/// A place on the globe, if it is one: exactly 0, 0 is what receivers write that know nothing.
fn is_place(latitude_deg: f64, longitude_deg: f64) -> bool {
    latitude_deg.abs() <= 90.0
        && longitude_deg.abs() <= 180.0
        && (latitude_deg, longitude_deg) != (0.0, 0.0)
}

fn number(value: &Value, k: usize) -> Option<f64> {
    let number = match value {
        Value::Rational(list) => list.get(k)?.to_f64(),
        Value::SRational(list) => list.get(k)?.to_f64(),
        Value::Float(list) => f64::from(*list.get(k)?),
        Value::Double(list) => *list.get(k)?,
        other => f64::from(other.get_uint(k)?),
    };
    number.is_finite().then_some(number)
}

/// What EXIF tells; the step to which it rounds positions, degrees.
fn from_exif(exif: &exif::Exif, found: &mut Metadata) -> f64 {
    let value = |tag: Tag| exif.get_field(tag, In::PRIMARY).map(|field| &field.value);
    let text = |tag: Tag| match value(tag) {
        Some(Value::Ascii(lines)) => lines
            .first()
            .map(|line| String::from_utf8_lossy(line).trim_matches(['\0', ' ']).to_owned())
            .unwrap_or_default(),
        _ => String::new(),
    };
    let positive = |tag: Tag| value(tag).and_then(|v| number(v, 0)).filter(|&v| v > 0.0);
    found.make = text(Tag::Make);
    found.model = text(Tag::Model);
    found.moment = text(Tag::DateTimeOriginal);
    let fraction = text(Tag::SubSecTimeOriginal);
    if !found.moment.is_empty() && !fraction.is_empty() {
        found.moment = format!("{}.{fraction}", found.moment);
    }
    found.utc_offset = text(Tag::OffsetTimeOriginal);
    let date = text(Tag::GPSDateStamp);
    let clock = value(Tag::GPSTimeStamp)
        .and_then(|v| Some([number(v, 0)? as u32, number(v, 1)? as u32, number(v, 2)? as u32]));
    if let (false, Some([hour, minute, second])) = (date.is_empty(), clock) {
        found.utc = format!("{date} {hour:02}:{minute:02}:{second:02}");
    }
    found.focal_mm = positive(Tag::FocalLength);
    found.focal_35mm = positive(Tag::FocalLengthIn35mmFilm);
    found.exposure_s = positive(Tag::ExposureTime);
    found.iso = positive(Tag::PhotographicSensitivity);
    found.f_number = positive(Tag::FNumber);
    // Unit 3 is the centimetre, 4 the millimetre, otherwise the inch.
    let unit_mm = match value(Tag::FocalPlaneResolutionUnit).and_then(|v| v.get_uint(0)) {
        Some(3) => 10.0,
        Some(4) => 1.0,
        _ => 25.4,
    };
    found.sensor_px_per_mm = positive(Tag::FocalPlaneXResolution).map(|v| v / unit_mm);
    let side = |tag: Tag| value(tag).and_then(|v| v.get_uint(0)).filter(|&n| n > 0);
    found.written_size_px = side(Tag::PixelXDimension)
        .zip(side(Tag::PixelYDimension))
        .map(|(width, height)| [width, height]);
    found.orientation = value(Tag::Orientation)
        .and_then(|v| v.get_uint(0))
        .filter(|n| (1..=8).contains(n))
        .unwrap_or(1);
    let mut unsigned = Vec::new();
    let mut degrees = |tag: Tag, reference: Tag, [positive, negative]: [char; 2]| -> Option<f64> {
        let v = value(tag)?;
        let parts = [number(v, 0)?, number(v, 1).unwrap_or(0.0), number(v, 2).unwrap_or(0.0)];
        let whole = parts[0] + parts[1] / 60.0 + parts[2] / 3600.0;
        match text(reference).chars().next().map(|side| side.to_ascii_uppercase()) {
            Some(side) if side == positive => Some(whole),
            Some(side) if side == negative => Some(-whole.abs()),
            _ if whole < 0.0 => Some(whole),
            // Without its side a position may be on the other half of the globe.
            _ => {
                unsigned.push(reference);
                None
            }
        }
    };
    let place = degrees(Tag::GPSLatitude, Tag::GPSLatitudeRef, ['N', 'S']).zip(degrees(
        Tag::GPSLongitude,
        Tag::GPSLongitudeRef,
        ['E', 'W'],
    ));
    if let Some(reference) = unsigned.first() {
        found.unread = format!("{reference} does not say to which side degrees count");
    }
    found.geotag = place.filter(|(latitude, longitude)| is_place(*latitude, *longitude)).map(
        |(latitude_deg, longitude_deg)| {
            // Below the sea, below the ellipsoid.
            let reference = value(Tag::GPSAltitudeRef).and_then(|v| v.get_uint(0));
            let below = matches!(reference, Some(1 | 3));
            let height = value(Tag::GPSAltitude).and_then(|v| number(v, 0));
            let height_m = height.map(|h| if below { -h } else { h });
            Geotag { latitude_deg, longitude_deg, height_m, sigma_m: None }
        },
    );
    [Tag::GPSLatitude, Tag::GPSLongitude]
        .into_iter()
        .filter_map(value)
        .map(step_deg)
        .fold(0.0, f64::max)
}

/// The step to which degrees, minutes and seconds are rounded.
fn step_deg(value: &Value) -> f64 {
    let Value::Rational(parts) = value else { return 0.0 };
    let step = |(part, unit): (&exif::Rational, f64)| unit / f64::from(part.denom.max(1));
    parts.iter().zip([1.0, 1.0 / 60.0, 1.0 / 3600.0]).map(step).reduce(f64::min).unwrap_or(0.0)
}

/// Widths of sensors, millimetres, of cameras whose files do not tell them, by parts of maker and
/// model in lower case. From the makers' specifications.
const SENSORS_MM: [(&str, f64); 14] = [
    ("ixus 220", 6.17),
    ("elph 300", 6.17),
    ("powershot sx2", 6.17),
    ("powershot sd", 5.75),
    ("powershot a", 5.75),
    ("powershot s100", 7.44),
    ("powershot s110", 7.44),
    ("fc300", 6.31),
    ("fc330", 6.25),
    ("fc220", 6.17),
    ("fc6310", 13.2),
    ("fc350", 6.25),
    ("hero4", 6.17),
    ("hero3", 6.17),
];

/// The width of a view of 36 x 24 mm: 35 mm equivalents refer to the diagonal.
const DIAGONAL_35MM: f64 = 43.266_615_305_567_87;

impl Metadata {
    /// The principal distance in pixels of photos of this size, and where it comes from; `None` where
    /// the file does not tell.
    pub fn principal_distance_px(&self, size_px: [u32; 2]) -> Option<(f64, &'static str)> {
        let [width, height] = size_px.map(f64::from);
        if let Some(focal) = self.focal_35mm {
            return Some((focal / DIAGONAL_35MM * width.hypot(height), "35 mm equivalent"));
        }
        let focal = self.focal_mm?;
        let name = format!("{} {}", self.make, self.model).to_ascii_lowercase();
        let known = SENSORS_MM.iter().find(|(part, _)| name.contains(part));
        if let Some((_, sensor_mm)) = known {
            return Some((focal / sensor_mm * width.max(height), "focal length and sensor"));
        }
        // The resolution is that of the photo as written.
        let written = self.written_size_px.map_or(width, |[w, _]| f64::from(w));
        let resolution = self.sensor_px_per_mm.filter(|r| (50.0..2000.0).contains(r))?;
        Some((focal * resolution * width / written, "focal length and resolution of the sensor"))
    }
}

#[cfg(test)]
mod tests;
