//! COLMAP's binary form, little-endian.

use super::{CameraRow, Feature, HALF_PX, ImageRow, PointRow, ReadKind, Rows};
use crate::words::{Fault, usable};
use rowgram_survey::scene::Reconstruction;

/// Bytes yet to be read.
struct Bytes<'a> {
    rest: &'a [u8],
}

impl<'a> Bytes<'a> {
    fn take<const N: usize>(&mut self, what: &str) -> Result<[u8; N], Fault> {
        let (first, rest) = self
            .rest
            .split_first_chunk::<N>()
            .ok_or_else(|| (None, format!("the file ends where {what} was expected")))?;
        self.rest = rest;
        Ok(*first)
    }

    fn u32(&mut self, what: &str) -> Result<u32, Fault> {
        self.take(what).map(u32::from_le_bytes)
    }

    fn u64(&mut self, what: &str) -> Result<u64, Fault> {
        self.take(what).map(u64::from_le_bytes)
    }

    fn finite(&mut self, what: &str) -> Result<f64, Fault> {
        let value = f64::from_le_bytes(self.take(what)?);
        usable(what, value).map_err(|message| (None, message))
    }

    /// A count of things of at least `size` bytes each; nothing is allocated for a number that the
    /// file cannot hold.
    fn count(&mut self, what: &str, size: usize) -> Result<usize, Fault> {
        let count = self.u64(what)?;
        match usize::try_from(count).ok().filter(|n| n.saturating_mul(size) <= self.rest.len()) {
            Some(count) => Ok(count),
            None => Err((None, format!("{count} as {what}: the file is too short for that"))),
        }
    }

    fn done(&self) -> Result<(), Fault> {
        if self.rest.is_empty() {
            Ok(())
        } else {
            Err((None, format!("{} bytes are left after the end", self.rest.len())))
        }
    }
}

pub(super) fn cameras(bytes: &[u8]) -> Result<Vec<CameraRow>, Fault> {
    let mut bytes = Bytes { rest: bytes };
    let count = bytes.count("the number of cameras", 24)?;
    let mut rows = Vec::with_capacity(count);
    for _ in 0..count {
        let id = bytes.u32("a camera number")?;
        let number = bytes.u32("a lens model")? as i32;
        let kind = ReadKind::numbered(number).ok_or_else(|| {
            (None, format!("camera {id}: COLMAP's lens model {number} is not supported; write the model as text"))
        })?;
        let size = [bytes.u64("the width")?, bytes.u64("the height")?];
        let parameters = (0..kind.count()).map(|_| bytes.finite("a lens parameter"));
        let parameters = parameters.collect::<Result<Vec<f64>, Fault>>()?;
        rows.push(CameraRow { id, kind, size, parameters });
    }
    bytes.done()?;
    Ok(rows)
}

pub(super) fn images(bytes: &[u8]) -> Result<Vec<ImageRow>, Fault> {
    let mut bytes = Bytes { rest: bytes };
    let count = bytes.count("the number of images", 73)?;
    let mut rows = Vec::with_capacity(count);
    for _ in 0..count {
        let id = bytes.u32("an image number")?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = bytes.finite("a number of a pose")?;
        }
        let camera = bytes.u32("a camera number")?;
        let end = bytes.rest.iter().position(|&b| b == 0);
        let end = end.ok_or_else(|| (None, format!("image {id}: its name has no end")))?;
        let name = String::from_utf8(bytes.rest[..end].to_vec())
            .map_err(|_| (None, format!("image {id}: its name is not text")))?;
        bytes.rest = &bytes.rest[end + 1..];
        let features = bytes.count("the number of features", 24)?;
        let mut row = ImageRow {
            id,
            rotation: [pose[0], pose[1], pose[2], pose[3]],
            translation: [pose[4], pose[5], pose[6]],
            camera,
            name,
            features: Vec::with_capacity(features),
        };
        for _ in 0..features {
            let (u, v) = (bytes.finite("u")?, bytes.finite("v")?);
            let point = bytes.u64("the number of a point")?;
            row.features.push(Feature {
                image_px: [u - HALF_PX, v - HALF_PX],
                point: (point != u64::MAX).then_some(point),
            });
        }
        rows.push(row);
    }
    bytes.done()?;
    Ok(rows)
}

pub(super) fn points(bytes: &[u8]) -> Result<Vec<PointRow>, Fault> {
    let mut bytes = Bytes { rest: bytes };
    let count = bytes.count("the number of points", 51)?;
    let mut rows = Vec::with_capacity(count);
    for _ in 0..count {
        let id = bytes.u64("the number of a point")?;
        let mut position = [0.0; 3];
        for value in &mut position {
            *value = bytes.finite("a coordinate")?;
        }
        let colour = bytes.take("a colour")?;
        let _error: [u8; 8] = bytes.take("the error of a point")?;
        let track = bytes.count("the length of a track", 8)?;
        bytes.rest = &bytes.rest[8 * track..];
        rows.push(PointRow { id, position, colour });
    }
    bytes.done()?;
    Ok(rows)
}

pub(super) fn write(
    (cameras, images): &Rows,
    survey: &Reconstruction,
    tracks: &[Vec<(u32, u32)>],
) -> (Vec<u8>, Vec<u8>, Vec<u8>) {
    let mut to_cameras = (cameras.len() as u64).to_le_bytes().to_vec();
    for row in cameras {
        to_cameras.extend(row.id.to_le_bytes());
        to_cameras.extend(row.kind.id().to_le_bytes());
        row.size.iter().for_each(|n| to_cameras.extend(n.to_le_bytes()));
        row.parameters.iter().for_each(|v| to_cameras.extend(v.to_le_bytes()));
    }
    let mut to_images = (images.len() as u64).to_le_bytes().to_vec();
    for row in images {
        to_images.extend(row.id.to_le_bytes());
        let pose = row.rotation.iter().chain(&row.translation);
        pose.for_each(|v| to_images.extend(v.to_le_bytes()));
        to_images.extend(row.camera.to_le_bytes());
        to_images.extend(row.name.as_bytes());
        to_images.push(0);
        to_images.extend((row.features.len() as u64).to_le_bytes());
        for feature in &row.features {
            feature.image_px.iter().for_each(|v| to_images.extend((v + HALF_PX).to_le_bytes()));
            to_images.extend(feature.point.unwrap_or(u64::MAX).to_le_bytes());
        }
    }
    let mut to_points = (survey.points.len() as u64).to_le_bytes().to_vec();
    for (point, track) in survey.points.iter().zip(tracks) {
        to_points.extend(point.id.to_le_bytes());
        point.position_m.iter().for_each(|v| to_points.extend(v.to_le_bytes()));
        to_points.extend(point.colour);
        to_points.extend((-1.0f64).to_le_bytes());
        to_points.extend((track.len() as u64).to_le_bytes());
        for (image, place) in track {
            to_points.extend(image.to_le_bytes());
            to_points.extend(place.to_le_bytes());
        }
    }
    (to_cameras, to_images, to_points)
}
