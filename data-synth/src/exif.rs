//! Photos as JPEG files with the EXIF that a camera with a receiver would write.

use crate::{camera::CameraConfig, flight::Shot, site::Site};
use exif::{Field, In, Rational, Tag, Value, experimental::Writer};
use image::{ExtendedColorType, ImageEncoder, RgbImage, codecs::jpeg::JpegEncoder};
use std::io;

/// The bytes of a photo: JPEG of a quality from 1 to 100 with EXIF (maker, model, moment, exposure time, focal
/// length, its equivalent in pixels as that of a frame 36 mm wide, and the receiver's position: WGS84, height above the ellipsoid).
///
/// # Errors
/// Where the position has no latitude and longitude, or the picture is too large for a JPEG.
pub fn jpeg(
    image: &RgbImage,
    quality: u8,
    shot: &Shot,
    camera: &CameraConfig,
    site: &Site,
) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, quality);
    encoder.set_exif_metadata(metadata(shot, camera, site)?).map_err(io::Error::other)?;
    encoder
        .write_image(image.as_raw(), image.width(), image.height(), ExtendedColorType::Rgb8)
        .map_err(io::Error::other)?;
    Ok(bytes)
}

/// Sensitivity and aperture of a camera that reports them.
const USUAL_ISO: f64 = 100.0;
const USUAL_F_NUMBER: f64 = 2.8;

/// The TIFF structure inside EXIF.
fn metadata(shot: &Shot, camera: &CameraConfig, site: &Site) -> io::Result<Vec<u8>> {
    let [latitude_deg, longitude_deg, height_m] =
        site.geographic(shot.gnss_m).map_err(io::Error::other)?;
    let (moment, thousandths) = site.moment(shot.time_s);
    let text = |value: &str| Value::Ascii(vec![value.as_bytes().to_vec()]);
    let ratio = |value: f64, parts: u32| Rational {
        num: (value * f64::from(parts)).round() as u32,
        denom: parts,
    };
    let sexagesimal = |degrees: f64| {
        // Hundred-thousandths of a second are 0.3 mm; whole units first, so that none reaches 60.
        let units = (degrees.abs() * 3600.0 * 1e5).round() as u64;
        let (whole, rest) = (units / 360_000_000, units % 360_000_000);
        let part = |num: u64, denom: u32| Rational { num: num as u32, denom };
        Value::Rational(vec![
            part(whole, 1),
            part(rest / 6_000_000, 1),
            part(rest % 6_000_000, 100_000),
        ])
    };
    let half = |positive: &str, negative: &str, value: f64| {
        text(if value < 0.0 { negative } else { positive })
    };
    // Of a frame 36 mm wide: what says how long the focal length is in pixels.
    let full_frame_mm = (36.0 * camera.c_px / f64::from(camera.width_px)).round();
    let below = u8::from(height_m < 0.0);
    let mut fields: Vec<Field> = [
        (Tag::Make, text(&camera.make)),
        (Tag::Model, text(&camera.model)),
        (Tag::Orientation, Value::Short(vec![1])),
        (Tag::Software, text("data-synth")),
        (Tag::DateTime, text(&moment)),
        (Tag::ExposureTime, Value::Rational(vec![ratio(shot.exposure_s, 1_000_000)])),
        (Tag::ExifVersion, Value::Undefined(b"0230".to_vec(), 0)),
        (Tag::DateTimeOriginal, text(&moment)),
        (Tag::SubSecTimeOriginal, text(&format!("{thousandths:03}"))),
        (Tag::FocalLength, Value::Rational(vec![ratio(camera.focal_mm, 1000)])),
        (Tag::FocalLengthIn35mmFilm, Value::Short(vec![full_frame_mm as u16])),
        (Tag::PixelXDimension, Value::Long(vec![camera.width_px])),
        (Tag::PixelYDimension, Value::Long(vec![camera.height_px])),
        (Tag::GPSVersionID, Value::Byte(vec![2, 3, 0, 0])),
        (Tag::GPSLatitudeRef, half("N", "S", latitude_deg)),
        (Tag::GPSLatitude, sexagesimal(latitude_deg)),
        (Tag::GPSLongitudeRef, half("E", "W", longitude_deg)),
        (Tag::GPSLongitude, sexagesimal(longitude_deg)),
        (Tag::GPSAltitudeRef, Value::Byte(vec![below])),
        (Tag::GPSAltitude, Value::Rational(vec![ratio(height_m.abs(), 1000)])),
        (Tag::GPSMapDatum, text("WGS-84")),
    ]
    .into_iter()
    .map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value })
    .collect();
    if let Some(sensitivity) = shot.sensitivity {
        let iso = (USUAL_ISO * sensitivity).round() as u16;
        for (tag, value) in [
            (Tag::PhotographicSensitivity, Value::Short(vec![iso])),
            (Tag::FNumber, Value::Rational(vec![ratio(USUAL_F_NUMBER, 10)])),
        ] {
            fields.push(Field { tag, ifd_num: In::PRIMARY, value });
        }
    }
    let mut writer = Writer::new();
    for field in &fields {
        writer.push_field(field);
    }
    let mut bytes = io::Cursor::new(Vec::new());
    writer.write(&mut bytes, true).map_err(io::Error::other)?;
    Ok(bytes.into_inner())
}
