//! What a photo's file says of how it was taken: EXIF, and the XMP of drones.
//!
//! EXIF is read by `kamadak-exif`. XMP is text inside the file; of it only the numbers that drones write as
//! attributes or elements are read (`drone-dji:GimbalPitchDegree`, `drone-dji:RtkFlag`,
//! `drone-dji:RtkStdLon` and their like).

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
    let bytes = std::fs::read(path).map_err(|e| FileError::read(path, e))?;
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
    if let Ok(exif) = Reader::new().read_from_container(&mut Cursor::new(bytes)) {
        from_exif(&exif, &mut found);
    }
    from_xmp(bytes, &mut found);
    found
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

fn from_exif(exif: &exif::Exif, found: &mut Metadata) {
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
    let degrees = |tag: Tag, sign: Tag, negative: &str| -> Option<f64> {
        let v = value(tag)?;
        let parts = [number(v, 0)?, number(v, 1).unwrap_or(0.0), number(v, 2).unwrap_or(0.0)];
        let whole = parts[0] + parts[1] / 60.0 + parts[2] / 3600.0;
        Some(if text(sign).eq_ignore_ascii_case(negative) { -whole } else { whole })
    };
    let place = degrees(Tag::GPSLatitude, Tag::GPSLatitudeRef, "S").zip(degrees(
        Tag::GPSLongitude,
        Tag::GPSLongitudeRef,
        "W",
    ));
    // Exactly 0, 0 is what receivers write that know nothing.
    found.geotag = place
        .filter(|(latitude, longitude)| {
            latitude.abs() <= 90.0
                && longitude.abs() <= 180.0
                && (*latitude, *longitude) != (0.0, 0.0)
        })
        .map(|(latitude_deg, longitude_deg)| {
            let below = value(Tag::GPSAltitudeRef).and_then(|v| v.get_uint(0)) == Some(1);
            let height = value(Tag::GPSAltitude).and_then(|v| number(v, 0));
            let height_m = height.map(|h| if below { -h } else { h });
            Geotag { latitude_deg, longitude_deg, height_m, sigma_m: None }
        });
}

/// Where XMP begins.
const XMP: &[u8] = b"<x:xmpmeta";
const XMP_END: &[u8] = b"</x:xmpmeta>";

fn position(bytes: &[u8], what: &[u8]) -> Option<usize> {
    bytes.windows(what.len()).position(|window| window == what)
}

fn from_xmp(bytes: &[u8], found: &mut Metadata) {
    // It stands before the picture.
    let head = &bytes[..bytes.len().min(1 << 18)];
    let Some(begin) = position(head, XMP) else { return };
    let Some(end) = position(&head[begin..], XMP_END) else { return };
    let text = String::from_utf8_lossy(&head[begin..begin + end]);
    let number = |name: &str| -> Option<f64> {
        let at = text.find(&format!("drone-dji:{name}"))? + "drone-dji:".len() + name.len();
        let rest = text[at..].trim_start();
        // An attribute `name="1.0"` or an element `<name>1.0</name>`.
        let value = match rest.strip_prefix('=') {
            Some(rest) => rest.trim_start().strip_prefix(['"', '\''])?,
            None => rest.strip_prefix('>')?,
        };
        let end = value.find(['"', '\'', '<'])?;
        value[..end].trim().parse::<f64>().ok().filter(|v| v.is_finite())
    };
    found.gimbal_deg = number("GimbalYawDegree")
        .zip(number("GimbalPitchDegree"))
        .zip(number("GimbalRollDegree"))
        .map(|((yaw, pitch), roll)| [yaw, pitch, roll]);
    found.height_above_take_off_m = number("RelativeAltitude");
    let Some(geotag) = &mut found.geotag else { return };
    // 50: fixed ambiguities; only then are the standard deviations those of a solution.
    if number("RtkFlag").is_some_and(|flag| flag >= 50.0)
        && let (Some(east), Some(north), Some(up)) =
            (number("RtkStdLon"), number("RtkStdLat"), number("RtkStdHgt"))
        && east > 0.0
        && north > 0.0
        && up > 0.0
    {
        geotag.sigma_m = Some([east, north, up]);
    }
    if let Some(height) = number("AbsoluteAltitude") {
        geotag.height_m = Some(height);
    }
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
mod tests {
    use super::*;

    #[test]
    fn numbers_of_a_drone_are_read_in_both_forms() {
        let text = br#"....<x:xmpmeta><rdf:Description drone-dji:GimbalYawDegree="+12.5" drone-dji:GimbalPitchDegree="-90.0"
            drone-dji:RelativeAltitude="+40.1"><drone-dji:GimbalRollDegree>0.0</drone-dji:GimbalRollDegree></x:xmpmeta>..."#;
        let found = parse(text);
        assert_eq!(found.gimbal_deg, Some([12.5, -90.0, 0.0]));
        assert_eq!(found.height_above_take_off_m, Some(40.1));
        assert_eq!(found.geotag, None);
    }

    #[test]
    fn the_principal_distance_is_taken_from_what_there_is() {
        let plain = Metadata { focal_35mm: Some(24.0), ..Metadata::default() };
        let (c, _) = plain.principal_distance_px([4000, 3000]).unwrap();
        assert!((c - 24.0 / DIAGONAL_35MM * 5000.0).abs() < 1e-9);
        let canon = Metadata {
            make: "Canon".into(),
            model: "Canon IXUS 220 HS".into(),
            focal_mm: Some(4.3),
            ..Metadata::default()
        };
        let (c, _) = canon.principal_distance_px([2000, 1500]).unwrap();
        assert!((c - 4.3 / 6.17 * 2000.0).abs() < 1e-9);
        assert_eq!(Metadata::default().principal_distance_px([10, 10]), None);
    }
}
