//! Features of a photo in a file, so that they need not be found again.
//!
//! One line of JSON says what follows, then come the key points (five little-endian `f32` each: `u_px`,
//! `v_px`, `sigma_px`, `angle_rad`, `response`) and the descriptors (128 bytes each):
//!
//! ```text
//! {"format":"rowgram-features","version":1,"key":"...","width_px":4000,"height_px":3000,
//!  "count":8192,"checksum":"..."}          (one line, ended by \n)
//! ```
//!
//! The key tells of which photo and by which options they are ([`key`]); the checksum tells a whole file
//! from a damaged one.

use super::{FileError, output};
use rowgram_optim::drive::Fingerprint;
use rowgram_survey::features::{
    DESCRIPTOR_LENGTH, Descriptors, FeatureOptions, Features, KeyPoint,
};
use serde::{Deserialize, Serialize};
use std::path::Path;

const FORMAT: &str = "rowgram-features";
const VERSION: u32 = 1;
/// Numbers of a key point.
const NUMBERS: usize = 5;
/// Bytes of a key point and its descriptor.
const RECORD: usize = 4 * NUMBERS + DESCRIPTOR_LENGTH;

/// Format and version first: they say whether the other fields can be understood.
#[derive(Deserialize)]
struct Kind {
    format: String,
    version: u32,
}

#[derive(Serialize, Deserialize)]
struct Line {
    format: String,
    version: u32,
    key: String,
    width_px: u32,
    height_px: u32,
    count: u64,
    checksum: String,
}

/// A mark of a photo's file (all its bytes), of the options and of the method's version: features under
/// another key are to be found anew.
pub fn key(photo_file: &[u8], options: &FeatureOptions) -> u64 {
    let FeatureOptions { max_features, upscale, norm, contrast_threshold, edge_threshold } =
        *options;
    Fingerprint::new()
        .count(photo_file.len() as u64)
        .bytes(photo_file)
        .count(u64::from(VERSION))
        .count(max_features as u64)
        .text(&format!("{upscale:?} {norm:?}"))
        .numbers(&[contrast_threshold.into(), edge_threshold.into()])
        .finish()
}

/// Writes features under a key, atomically.
///
/// # Errors
/// As [`output::write`].
pub fn write(path: &Path, force: bool, key: u64, features: &Features) -> Result<(), FileError> {
    let mut body = Vec::with_capacity(features.key_points.len() * RECORD);
    for point in &features.key_points {
        let KeyPoint { u_px, v_px, sigma_px, angle_rad, response } = *point;
        for number in [u_px, v_px, sigma_px, angle_rad, response] {
            body.extend(number.to_le_bytes());
        }
    }
    body.extend(features.descriptors.as_bytes());
    let line = Line {
        format: FORMAT.to_owned(),
        version: VERSION,
        key: hexadecimal(key),
        width_px: features.width_px,
        height_px: features.height_px,
        count: features.key_points.len() as u64,
        checksum: hexadecimal(Fingerprint::new().bytes(&body).finish()),
    };
    output::write(path, force, |file| {
        serde_json::to_writer(&mut *file, &line)?;
        file.write_all(b"\n")?;
        file.write_all(&body)
    })
}

/// Reads features and their key.
///
/// # Errors
/// [`FileError::Read`] where the file cannot be read; [`FileError::Malformed`] where it is no such file,
/// of another version, truncated or damaged.
pub fn read(path: &Path) -> Result<(u64, Features), FileError> {
    let bytes = crate::memory::read_file(path)?;
    parse(&bytes).map_err(|message| FileError::malformed(path, None, message))
}

fn parse(bytes: &[u8]) -> Result<(u64, Features), String> {
    let foreign = || "this is not a file of rowgram align features".to_owned();
    let end = bytes.iter().position(|&byte| byte == b'\n').ok_or_else(foreign)?;
    let (header, body) = (&bytes[..end], &bytes[end + 1..]);
    let kind: Kind = serde_json::from_slice(header).map_err(|_| foreign())?;
    if kind.format != FORMAT {
        return Err(foreign());
    }
    if kind.version != VERSION {
        let version = kind.version;
        return Err(format!("features of format {version} cannot be read, only format {VERSION}"));
    }
    let line: Line =
        serde_json::from_slice(header).map_err(|error| format!("damaged header: {error}"))?;
    let key = u64::from_str_radix(&line.key, 16)
        .map_err(|_| format!("damaged header: the key {:?} is not hexadecimal", line.key))?;
    let count = usize::try_from(line.count).unwrap_or(usize::MAX);
    let expected = count.saturating_mul(RECORD);
    if body.len() != expected {
        return Err(format!(
            "damaged: {} bytes follow the header, {count} features have {expected}",
            body.len()
        ));
    }
    if hexadecimal(Fingerprint::new().bytes(body).finish()) != line.checksum {
        return Err("damaged: the checksum does not fit the content".to_owned());
    }
    let (points, descriptors) = body.split_at(count * 4 * NUMBERS);
    let key_points = points.as_chunks::<{ 4 * NUMBERS }>().0.iter().map(|record| {
        let (numbers, _) = record.as_chunks::<4>();
        let number = |index: usize| f32::from_le_bytes(numbers[index]);
        KeyPoint {
            u_px: number(0),
            v_px: number(1),
            sigma_px: number(2),
            angle_rad: number(3),
            response: number(4),
        }
    });
    let features = Features {
        width_px: line.width_px,
        height_px: line.height_px,
        key_points: key_points.collect(),
        descriptors: Descriptors::from_bytes(descriptors.to_vec()).ok_or_else(foreign)?,
    };
    Ok((key, features))
}

/// Written as text, because JSON's numbers do not hold 64 bits everywhere.
fn hexadecimal(number: u64) -> String {
    format!("{number:016x}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn features() -> Features {
        let point = |k: u8| KeyPoint {
            u_px: f32::from(k) + 0.25,
            v_px: -0.5,
            sigma_px: 1.75,
            angle_rad: 6.0,
            response: 0.031,
        };
        Features {
            width_px: 40,
            height_px: 30,
            key_points: (0..3).map(point).collect(),
            descriptors: Descriptors::from_bytes((0..3 * 128).map(|k| k as u8).collect()).unwrap(),
        }
    }

    #[test]
    fn what_was_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("photo.features");
        let options = FeatureOptions::default();
        let key = key(b"a photo", &options);
        for features in [features(), Features::default()] {
            write(&path, true, key, &features).unwrap();
            assert_eq!(read(&path).unwrap(), (key, features));
        }
        assert!(matches!(write(&path, false, key, &features()), Err(FileError::Exists { .. })));
    }

    #[test]
    fn another_photo_or_option_has_another_key() {
        let options = FeatureOptions::default();
        let more = FeatureOptions { max_features: options.max_features + 1, ..options };
        let marks = [key(b"a photo", &options), key(b"a phot0", &options), key(b"a photo", &more)];
        assert!(marks[0] != marks[1] && marks[0] != marks[2] && marks[1] != marks[2]);
    }

    #[test]
    fn damage_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("photo.features");
        write(&path, false, 7, &features()).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let fault = |bytes: &[u8]| parse(bytes).unwrap_err();
        assert!(fault(&whole[..whole.len() - 1]).contains("3 features have 444"));
        let mut flipped = whole.clone();
        *flipped.last_mut().unwrap() ^= 1;
        assert!(fault(&flipped).contains("checksum"));
        assert!(fault(b"").contains("not a file of rowgram align features"));
        assert!(fault(b"{\"format\":\"other\",\"version\":1}\n").contains("not a file"));
        let newer = b"{\"format\":\"rowgram-features\",\"version\":2}\n";
        assert!(fault(newer).contains("format 2 cannot be read"));
        for end in 0..whole.len() {
            assert!(parse(&whole[..end]).is_err());
        }
    }
}
