//! Bundler's `bundle.out` (version 0.3) with its list of images.
//!
//! ```text
//! # Bundle file v0.3
//! cameras points
//! f k1 k2 / R (3 lines) / t            per camera; f = 0: the image is not in the block
//! X Y Z / r g b / n (camera key x y)*  per point
//! ```
//!
//! Positions are from the image centre, `x` right and `y` up; the camera looks along `-z`: the frames are
//! those of [`rowgram_survey::camera::lens`]. The format has no image sizes; they decide only where in the
//! image the centre is. Images with the same `f`, `k1`, `k2` share a camera.
//!
//! Reference: N. Snavely, *Bundler v0.4 User's Manual*, 2010.

use super::{
    FileError,
    memory::read_text,
    model::{Model, names_once},
    output,
    words::{Fault, Words},
};
use rowgram_optim::geometry::rotation;
use rowgram_survey::{
    camera::{Camera, Interior, Lens, Model as LensModel},
    scene::{Image, Observation, Pose, Reconstruction, TiePoint},
};
use std::path::Path;

/// Whether a text begins as these files do.
pub fn is_one(text: &[u8]) -> bool {
    text.starts_with(b"# Bundle file")
}

/// The name in a line of the list: numbers may follow it (0 and the focal length), and it may have blanks.
fn name_of_line(line: &str) -> Option<String> {
    let mut name = line.trim();
    for _ in 0..2 {
        match name.rsplit_once(char::is_whitespace) {
            Some((begin, last)) if last.parse::<f64>().is_ok() => name = begin.trim_end(),
            _ => break,
        }
    }
    (!name.is_empty()).then(|| name.to_owned())
}

/// Reads a block. `list` names the images, one a line (numbers behind the name are left out); without
/// it they are called `00000000.jpg` and so on.
///
/// # Errors
/// Where a file cannot be read or is no such file; names the line.
pub fn read(path: &Path, list: Option<&Path>, size_px: [u32; 2]) -> Result<Model, FileError> {
    let text = read_text(path)?;
    let names: Option<Vec<String>> = match list {
        Some(list) => {
            let lines = read_text(list)?;
            Some(lines.lines().filter_map(name_of_line).collect())
        }
        None => None,
    };
    parse(&text, names.as_deref(), size_px)
        .map_err(|(line, message)| FileError::malformed(path, line, message))
}

fn parse(text: &str, names: Option<&[String]>, size_px: [u32; 2]) -> Result<Model, Fault> {
    if !is_one(text.as_bytes()) {
        return Err((Some(1), "expected \"# Bundle file v0.3\"".into()));
    }
    let mut words = Words::of_file(text);
    let cameras: usize = words.number("the number of cameras")?;
    let points: usize = words.number("the number of points")?;
    for (count, what) in [(cameras, "cameras"), (points, "points")] {
        if count > text.len() / 2 {
            return Err(
                words.fault(format!("{count} {what} cannot be in a file of {} bytes", text.len()))
            );
        }
    }
    if let Some(names) = names
        && names.len() != cameras
    {
        return Err((
            None,
            format!("there are {cameras} cameras, the list names {} images", names.len()),
        ));
    }
    let mut model = Model {
        survey: Reconstruction { tie_sigma_px: 1.0, ..Reconstruction::default() },
        ..Model::default()
    };
    let mut places: Vec<Option<u32>> = Vec::with_capacity(cameras);
    let mut lenses: Vec<[f64; 3]> = Vec::new();
    for k in 0..cameras {
        let lens: [f64; 3] = words.many("f, k1 or k2")?;
        let r: [f64; 9] = words.many("an entry of R")?;
        let t: [f64; 3] = words.many("an entry of t")?;
        if lens[0] == 0.0 {
            places.push(None);
            continue;
        }
        let rotation = quaternion(&r)
            .ok_or_else(|| words.fault(format!("camera {k}: its R is not a rotation")))?;
        let camera = match lenses.iter().position(|known| *known == lens) {
            Some(camera) => camera,
            None => {
                let interior = Interior::new(LensModel::Bal, size_px, &lens)
                    .map_err(|error| words.fault(format!("camera {k}: {error}")))?;
                lenses.push(lens);
                let name = format!("camera {}", lenses.len());
                model.survey.cameras.push(Camera::new(&name, interior));
                lenses.len() - 1
            }
        };
        places.push(Some(model.survey.images.len() as u32));
        model.survey.images.push(Image {
            name: names.map_or_else(|| format!("{k:08}.jpg"), |names| names[k].clone()),
            id: k as u32,
            camera,
            pose: Pose { rotation, translation: t },
            motion: [0.0; 6],
            expected_motion: [0.0; 6],
        });
    }
    for point in 0..points {
        let position_m = words.many("a coordinate")?;
        let colour: [f64; 3] = words.many("a colour")?;
        let id = point as u64;
        let point = point as u32;
        let colour = colour.map(|c| c.clamp(0.0, 255.0) as u8);
        model.survey.points.push(TiePoint { id, position_m, colour });
        let rays: usize = words.number("the number of rays")?;
        for _ in 0..rays {
            let camera: usize = words.number("the index of a camera")?;
            let _key: i64 = words.number("the number of a key")?;
            let [x, y] = words.many("a position")?;
            let place = places.get(camera).copied().ok_or_else(|| {
                words.fault(format!("camera {camera} does not exist, there are {cameras}"))
            })?;
            if let Some(image) = place {
                let [cu, cv] = rowgram_survey::camera::image_centre_px(size_px);
                let image_px = [cu + x, cv - y];
                model.survey.observations.push(Observation { image, point, image_px });
            }
        }
    }
    words.end()?;
    names_once(&model.survey).map_err(|message| (None, message))?;
    Ok(model)
}

fn quaternion(r: &[f64; 9]) -> Option<rotation::Quaternion> {
    let m = nalgebra::Matrix3::from_row_slice(r);
    let off = (m * m.transpose() - nalgebra::Matrix3::identity()).norm();
    if off > 1e-4 || m.determinant() < 0.0 {
        return None;
    }
    let q = nalgebra::UnitQuaternion::from_rotation_matrix(
        &nalgebra::Rotation3::from_matrix_unchecked(m),
    );
    Some(rotation::normalize([q.w, q.i, q.j, q.k]))
}

/// Writes a block, and its list of images where `list` is given.
///
/// # Errors
/// A lens that the format cannot hold, a name with a blank in the list; otherwise as [`output::write`].
pub fn write(
    path: &Path,
    list: Option<&Path>,
    model: &Model,
    force: bool,
) -> Result<(), FileError> {
    let survey = &model.survey;
    let lenses: Vec<[f64; 3]> = survey
        .cameras
        .iter()
        .map(|camera| {
            as_bundler(&camera.interior).ok_or_else(|| {
                FileError::malformed(
                    path,
                    None,
                    format!(
                        "camera {:?}: Bundler knows f, k1 and k2 and the principal point in the image centre; this {} lens has more",
                        camera.name,
                        camera.interior.model().word()
                    ),
                )
            })
        })
        .collect::<Result<_, FileError>>()?;
    if let Some(list) = list {
        output::check(list, force)?;
        let is_word =
            |name: &str| !name.is_empty() && !name.contains(|c: char| c.is_ascii_whitespace());
        if let Some(image) = survey.images.iter().find(|image| !is_word(&image.name)) {
            let message = format!(
                "image {:?}: a name in Bundler's list of images ends at the first blank; rename the image",
                image.name
            );
            return Err(FileError::malformed(list, None, message));
        }
    }
    let mut rays: Vec<Vec<(u32, usize, [f64; 2])>> = vec![Vec::new(); survey.points.len()];
    let mut keys = vec![0; survey.images.len()];
    for o in &survey.observations {
        let image = o.image as usize;
        let [cu, cv] = survey.cameras[survey.images[image].camera].interior.centre_px();
        let at = [o.image_px[0] - cu, cv - o.image_px[1]];
        rays[o.point as usize].push((o.image, keys[image], at));
        keys[image] += 1;
    }
    output::write(path, force, |out| {
        writeln!(out, "# Bundle file v0.3\n{} {}", survey.images.len(), survey.points.len())?;
        for image in &survey.images {
            let [f, k1, k2] = lenses[image.camera];
            writeln!(out, "{f:e} {k1:e} {k2:e}")?;
            for row in rotation::matrix(image.pose.rotation) {
                writeln!(out, "{:e} {:e} {:e}", row[0], row[1], row[2])?;
            }
            let t = image.pose.translation;
            writeln!(out, "{:e} {:e} {:e}", t[0], t[1], t[2])?;
        }
        for (point, rays) in survey.points.iter().zip(&rays) {
            let ([x, y, z], [r, g, b]) = (point.position_m, point.colour);
            writeln!(out, "{x:e} {y:e} {z:e}\n{r} {g} {b}")?;
            write!(out, "{}", rays.len())?;
            for (image, key, [x, y]) in rays {
                write!(out, " {image} {key} {x:e} {y:e}")?;
            }
            writeln!(out)?;
        }
        Ok(())
    })?;
    if let Some(list) = list {
        output::write(list, force, |out| {
            survey.images.iter().try_for_each(|image| writeln!(out, "{}", image.name))
        })?;
    }
    Ok(())
}

/// `f`, `k1`, `k2` of a lens that has no more.
fn as_bundler(interior: &Interior) -> Option<[f64; 3]> {
    let v = interior.values();
    match interior.model() {
        LensModel::Bal => Some([v[0], v[1], v[2]]),
        LensModel::Brown => {
            let [cx, cy] = interior.centre_px();
            let plain = v[1] == 1.0 && v[2] == cx && v[3] == cy && v[6..].iter().all(|&c| c == 0.0);
            plain.then(|| [v[0], v[4], v[5]])
        }
        LensModel::Smac | LensModel::Fisheye => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_the_list_may_have_blanks_and_are_there_once() {
        for (line, name) in [
            ("IMG 0001.jpg", "IMG 0001.jpg"),
            ("a b.jpg 0 3250.5", "a b.jpg"),
            ("  a.jpg 0", "a.jpg"),
        ] {
            assert_eq!(name_of_line(line).as_deref(), Some(name), "{line}");
        }
        let camera = "100 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n";
        let text = format!("# Bundle file v0.3\n2 0\n{camera}{camera}");
        let read = |names: [&str; 2]| parse(&text, Some(&names.map(str::to_owned)), [40, 30]);
        assert!(read(["a.jpg", "b.jpg"]).is_ok());
        let (_, message) = read(["a.jpg", "a.jpg"]).unwrap_err();
        assert!(message.contains("two images are called \"a.jpg\""), "{message}");
    }
}
