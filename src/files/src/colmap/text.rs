//! COLMAP's text form.

use super::{CameraRow, Feature, HALF_PX, ImageRow, PointRow, ReadKind, Rows};
use crate::words::{Fault, Words, text, usable};
use rowgram_survey::scene::Reconstruction;
use std::io::Write;

/// Lines that say something, with their one-based numbers.
fn lines(bytes: &[u8]) -> Result<Vec<(usize, &str)>, Fault> {
    Ok(text(bytes)?.lines().enumerate().map(|(k, line)| (k + 1, line.trim_end())).collect())
}

pub(super) fn cameras(bytes: &[u8]) -> Result<Vec<CameraRow>, Fault> {
    let mut rows = Vec::new();
    for line in lines(bytes)? {
        if line.1.is_empty() || line.1.starts_with('#') {
            continue;
        }
        let mut words = Words::of_line(line);
        let id = words.number("a camera number")?;
        let name = words.word("the name of a lens model")?;
        let kind = ReadKind::named(name)
            .ok_or_else(|| words.fault(format!("the lens model {name:?} is not supported")))?;
        let size = [words.number("the width")?, words.number("the height")?];
        let mut parameters = Vec::new();
        for _ in 0..kind.count() {
            parameters.push(words.finite("a lens parameter")?);
        }
        if words.next().is_some() {
            return Err(
                words.fault(format!("{name} has {} parameters, there are more", kind.count()))
            );
        }
        rows.push(CameraRow { id, kind, size, parameters });
    }
    Ok(rows)
}

pub(super) fn images(bytes: &[u8]) -> Result<Vec<ImageRow>, Fault> {
    let mut rows = Vec::new();
    let lines = lines(bytes)?;
    let mut rest = lines.into_iter().filter(|(_, text)| !text.starts_with('#'));
    // The second line of an image may be empty, the first may not.
    while let Some(line) = rest.next() {
        if line.1.is_empty() {
            continue;
        }
        let mut words = Words::of_line(line);
        let id = words.number("an image number")?;
        let rotation = words.many("a component of the quaternion")?;
        let translation = words.many("a component of the translation")?;
        let camera = words.number("a camera number")?;
        // The name is what is left: it may hold spaces.
        let mut name = line.1.trim_start();
        for _ in 0..9 {
            name = name.split_once(char::is_whitespace).map_or("", |(_, rest)| rest.trim_start());
        }
        let name = name.trim_end().to_owned();
        if name.is_empty() {
            return Err(words.fault("the image has no name".into()));
        }
        let mut features = Vec::new();
        if let Some(line) = rest.next() {
            let mut words = Words::of_line(line);
            while let Some(first) = words.next() {
                let u = first
                    .parse()
                    .map_err(|_| words.fault(format!("expected u, found {first:?}")))?;
                let u = usable("u", u).map_err(|message| words.fault(message))?;
                let v = words.finite("v")?;
                let point: i64 = words.number("the number of a point")?;
                features.push(Feature {
                    image_px: [u - HALF_PX, v - HALF_PX],
                    point: u64::try_from(point).ok(),
                });
            }
        }
        rows.push(ImageRow { id, rotation, translation, camera, name, features });
    }
    Ok(rows)
}

pub(super) fn points(bytes: &[u8]) -> Result<Vec<PointRow>, Fault> {
    let mut rows = Vec::new();
    for line in lines(bytes)? {
        if line.1.is_empty() || line.1.starts_with('#') {
            continue;
        }
        let mut words = Words::of_line(line);
        let id = words.number("the number of a point")?;
        let position = words.many("a coordinate")?;
        let colour = [words.number("red")?, words.number("green")?, words.number("blue")?];
        rows.push(PointRow { id, position, colour });
    }
    Ok(rows)
}

pub(super) fn write(
    (cameras, images): &Rows,
    survey: &Reconstruction,
    tracks: &[Vec<(u32, u32)>],
) -> (Vec<u8>, Vec<u8>, Vec<u8>) {
    let mut out = (Vec::new(), Vec::new(), Vec::new());
    // Writing to memory cannot fail.
    let _ = fill(cameras, images, survey, tracks, &mut out);
    out
}

fn fill(
    cameras: &[CameraRow],
    images: &[ImageRow],
    survey: &Reconstruction,
    tracks: &[Vec<(u32, u32)>],
    (to_cameras, to_images, to_points): &mut (Vec<u8>, Vec<u8>, Vec<u8>),
) -> std::io::Result<()> {
    writeln!(to_cameras, "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]")?;
    for row in cameras {
        write!(to_cameras, "{} {} {} {}", row.id, row.kind.name(), row.size[0], row.size[1])?;
        for value in &row.parameters {
            write!(to_cameras, " {value}")?;
        }
        writeln!(to_cameras)?;
    }
    writeln!(to_images, "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")?;
    writeln!(to_images, "# POINTS2D[] as (X, Y, POINT3D_ID)")?;
    for row in images {
        write!(to_images, "{}", row.id)?;
        for value in row.rotation.iter().chain(&row.translation) {
            write!(to_images, " {value}")?;
        }
        writeln!(to_images, " {} {}", row.camera, row.name)?;
        for (k, feature) in row.features.iter().enumerate() {
            let [u, v] = feature.image_px.map(|c| c + HALF_PX);
            let space = if k == 0 { "" } else { " " };
            match feature.point {
                Some(id) => write!(to_images, "{space}{u} {v} {id}")?,
                None => write!(to_images, "{space}{u} {v} -1")?,
            }
        }
        writeln!(to_images)?;
    }
    writeln!(to_points, "# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)")?;
    for (point, track) in survey.points.iter().zip(tracks) {
        let ([x, y, z], [r, g, b]) = (point.position_m, point.colour);
        write!(to_points, "{} {x} {y} {z} {r} {g} {b} -1", point.id)?;
        for (image, place) in track {
            write!(to_points, " {image} {place}")?;
        }
        writeln!(to_points)?;
    }
    Ok(())
}
