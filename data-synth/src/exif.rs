//! Photos as JPEG files with the EXIF that a camera with a receiver would write, and the XMP of one with a gimbal or with
//! corrections for its receiver.

use crate::{camera::CameraConfig, flight::Shot, site::Site};
use exif::{Field, In, Rational, Tag, Value, experimental::Writer};
use image::{ExtendedColorType, ImageEncoder, RgbImage, codecs::jpeg::JpegEncoder};
use std::io;

/// The bytes of a photo: JPEG of a quality from 1 to 100 with EXIF (maker, model, moment, exposure time, focal
/// length, its equivalent in pixels as that of a frame 36 mm wide, and the receiver's position: WGS84, height above the ellipsoid),
/// and with XMP where there is something that EXIF has no place for: angles of the gimbal, accuracies of the receiver.
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
    if let Some(packet) = packet(shot) {
        insert_xmp(&mut bytes, &packet)?;
    }
    Ok(bytes)
}

/// What a receiver with fixed ambiguities says of its state.
const RTK_FIXED: u8 = 50;

/// The XMP of a photo; nothing where it has none.
fn packet(shot: &Shot) -> Option<String> {
    let mut attributes = String::new();
    if let Some([yaw, pitch, roll]) = shot.gimbal_deg {
        for (name, degrees) in [("Yaw", yaw), ("Pitch", pitch), ("Roll", roll)] {
            attributes += &format!(" drone-dji:Gimbal{name}Degree=\"{degrees:+.2}\"");
        }
    }
    if let Some(sigma_m) = shot.stated_sigma_m {
        attributes += &format!(" drone-dji:RtkFlag=\"{RTK_FIXED}\"");
        for name in ["Lon", "Lat", "Hgt"] {
            attributes += &format!(" drone-dji:RtkStd{name}=\"{sigma_m:.5}\"");
        }
    }
    (!attributes.is_empty()).then(|| {
        format!(
            "<x:xmpmeta xmlns:x=\"adobe:ns:meta/\"><rdf:RDF xmlns:rdf=\"http://www.w3.org/1999/02/22-rdf-syntax-ns#\">\
             <rdf:Description rdf:about=\"\" xmlns:drone-dji=\"http://www.dji.com/drone-dji/1.0/\"{attributes}/>\
             </rdf:RDF></x:xmpmeta>"
        )
    })
}

/// Puts XMP behind the other application segments of a JPEG.
fn insert_xmp(bytes: &mut Vec<u8>, packet: &str) -> io::Result<()> {
    const NAME: &[u8] = b"http://ns.adobe.com/xap/1.0/\0";
    let mut at = 2;
    while let Some([0xff, 0xe0..=0xef, high, low]) = bytes.get(at..at + 4) {
        at += 2 + usize::from(u16::from_be_bytes([*high, *low]));
    }
    let length = u16::try_from(2 + NAME.len() + packet.len()).map_err(io::Error::other)?;
    let mut segment = vec![0xff, 0xe1];
    segment.extend(length.to_be_bytes());
    segment.extend(NAME);
    segment.extend(packet.as_bytes());
    bytes.splice(at..at, segment);
    Ok(())
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
