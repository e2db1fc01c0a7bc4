//! XMP in photos: text with numbers as attributes, `drone-dji:GimbalPitchDegree="-90.0"`, or as elements,
//! `<drone-dji:GimbalPitchDegree>-90.0</drone-dji:GimbalPitchDegree>`. Makers differ in the prefix, so names are read
//! whatever stands before their colon.

use super::{Geotag, Metadata, is_place};
use crate::images::jpeg;
use exif::{Context, In, Tag, Value};

const BEGIN: &[u8] = b"<x:xmpmeta";
const END: &[u8] = b"</x:xmpmeta>";
/// The tag of TIFF that holds XMP.
const TIFF_TAG: u16 = 700;
/// Ambiguities are fixed from this value of DJI's `RtkFlag` on; only then are the standard deviations those of a solution.
const RTK_FIXED: f64 = 50.0;

/// XMP in a tag of its own, as TIFF files have it.
pub(super) fn of_tiff(exif: &exif::Exif) -> Option<String> {
    match &exif.get_field(Tag(Context::Tiff, TIFF_TAG), In::PRIMARY)?.value {
        Value::Byte(bytes) | Value::Undefined(bytes, _) => cut(bytes),
        Value::Ascii(lines) => cut(lines.first()?),
        _ => None,
    }
}

/// XMP in the head of a picture: in a JPEG it stands before the scan.
pub(super) fn of_file(bytes: &[u8]) -> Option<String> {
    let head = match bytes {
        [0xff, 0xd8, ..] => jpeg::scan(bytes).unwrap_or(bytes.len()),
        _ => bytes.len().min(1 << 18),
    };
    cut(&bytes[..head])
}

fn position(bytes: &[u8], what: &[u8]) -> Option<usize> {
    bytes.windows(what.len()).position(|window| window == what)
}

fn cut(bytes: &[u8]) -> Option<String> {
    let begin = position(bytes, BEGIN)?;
    let end = position(&bytes[begin..], END)?;
    Some(String::from_utf8_lossy(&bytes[begin..begin + end]).into_owned())
}

/// The value of an attribute or element of this name.
fn value<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    let mut from = 0;
    while let Some(found) = text[from..].find(name) {
        let at = from + found;
        from = at + name.len();
        // The whole name: after a prefix, before its value.
        if !text[..at].ends_with(':') {
            continue;
        }
        let rest = text[from..].trim_start();
        let value = match rest.strip_prefix('=') {
            Some(rest) => rest.trim_start().strip_prefix(['"', '\''])?,
            None => match rest.strip_prefix('>') {
                Some(rest) => rest,
                None => continue,
            },
        };
        // A list: its first entry.
        let value = match value.trim_start().strip_prefix("<rdf:") {
            Some(list) => list.split_once("<rdf:li>").map_or("", |(_, entry)| entry),
            None => value,
        };
        let end = value.find(['"', '\'', '<'])?;
        return Some(value[..end].trim());
    }
    None
}

/// A number, or a ratio as EXIF within XMP has it.
fn number(text: &str, name: &str) -> Option<f64> {
    let text = value(text, name)?;
    let number = match text.split_once('/') {
        Some((above, below)) => above.parse::<f64>().ok()? / below.parse::<f64>().ok()?,
        None => text.parse().ok()?,
    };
    number.is_finite().then_some(number)
}

/// Degrees of EXIF within XMP: `40,28.312N` or `40,28,18.7N`.
fn degrees(text: &str, name: &str) -> Option<f64> {
    let text = value(text, name)?;
    let (parts, sign) = match text.char_indices().last()? {
        (end, 'N' | 'E') => (&text[..end], 1.0),
        (end, 'S' | 'W') => (&text[..end], -1.0),
        _ => return None,
    };
    let mut sum = 0.0;
    for (k, part) in parts.split(',').enumerate() {
        sum += part.trim().parse::<f64>().ok()? / 60f64.powi(k as i32);
    }
    Some(sign * sum)
}

/// What XMP tells beyond EXIF, which rounds positions to a step.
pub(super) fn read(text: &str, found: &mut Metadata, step_deg: f64) {
    let of = |name: &str| number(text, name);
    found.gimbal_deg = of("GimbalYawDegree")
        .zip(of("GimbalPitchDegree"))
        .zip(of("GimbalRollDegree"))
        .map(|((yaw, pitch), roll)| [yaw, pitch, roll]);
    found.height_above_take_off_m = of("RelativeAltitude");
    found.band = value(text, "BandName").filter(|name| !name.is_empty()).map(str::to_owned);
    let absolute_m = of("AbsoluteAltitude");
    let latitude = of("GpsLatitude").or_else(|| degrees(text, "GPSLatitude"));
    // One maker's firmware misspells it.
    let longitude = of("GpsLongitude")
        .or_else(|| of("GpsLongtitude"))
        .or_else(|| degrees(text, "GPSLongitude"));
    if let Some((lat, lon)) = latitude.zip(longitude).filter(|(lat, lon)| is_place(*lat, *lon)) {
        match &mut found.geotag {
            // The same position before it was rounded.
            Some(geotag) => {
                let off = (geotag.latitude_deg - lat).abs().max((geotag.longitude_deg - lon).abs());
                if off <= step_deg {
                    (geotag.latitude_deg, geotag.longitude_deg) = (lat, lon);
                }
            }
            None => {
                let below = matches!(value(text, "GPSAltitudeRef"), Some("1" | "3"));
                let height_m = of("GPSAltitude").map(|height| if below { -height } else { height });
                found.geotag =
                    Some(Geotag { latitude_deg: lat, longitude_deg: lon, height_m, sigma_m: None });
            }
        }
    }
    let Some(geotag) = &mut found.geotag else { return };
    if absolute_m.is_some() {
        geotag.height_m = absolute_m;
    }
    if of("RtkFlag").is_some_and(|flag| flag >= RTK_FIXED)
        && let (Some(east), Some(north), Some(up)) =
            (of("RtkStdLon"), of("RtkStdLat"), of("RtkStdHgt"))
        && east > 0.0
        && north > 0.0
        && up > 0.0
    {
        geotag.sigma_m = Some([east, north, up]);
    }
}
