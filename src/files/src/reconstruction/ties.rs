//! The tables of tie points and of their measurements.

use super::super::{FileError, csv_table::quoted, output, table::Table};
use rowgram_survey::scene::{Observation, Reconstruction, TiePoint};
use std::{
    collections::{HashMap, HashSet},
    path::Path,
};

/// What the tables cannot hold.
pub(super) fn check(scene: &Reconstruction) -> Result<(), String> {
    let mut ids = HashSet::new();
    for point in &scene.points {
        if !ids.insert(point.id) {
            return Err(format!("two tie points have the number {}", point.id));
        }
        if point.position_m.iter().any(|v| !v.is_finite()) {
            return Err(format!("tie point {}: its position is not finite", point.id));
        }
    }
    let known = scene.accuracy.iter().flat_map(|accuracy| accuracy.points_m.as_flattened());
    if known.into_iter().any(|v| !v.is_finite()) {
        return Err("a standard deviation of a tie point is not finite".to_owned());
    }
    let mut names = HashSet::new();
    if let Some(image) = scene.images.iter().find(|image| !names.insert(&image.name)) {
        return Err(format!("two images are called {:?}", image.name));
    }
    for o in &scene.observations {
        let (image, point) =
            (scene.images.get(o.image as usize), scene.points.get(o.point as usize));
        let (Some(image), Some(point)) = (image, point) else {
            return Err(format!("an observation names image {} and point {}", o.image, o.point));
        };
        if o.image_px.iter().any(|v| !v.is_finite()) {
            return Err(format!("tie point {} in {}: not finite", point.id, image.name));
        }
    }
    Ok(())
}

pub(super) fn write_points(
    path: &Path,
    scene: &Reconstruction,
    force: bool,
) -> Result<(), FileError> {
    let sigmas = scene.accuracy.as_ref().map(|accuracy| accuracy.points_m.as_slice());
    output::write(path, force, |out| {
        write!(out, "point,x_m,y_m,z_m,red,green,blue")?;
        writeln!(out, "{}", if sigmas.is_some() { ",sigma_x_m,sigma_y_m,sigma_z_m" } else { "" })?;
        for (k, TiePoint { id, position_m: [x, y, z], colour }) in scene.points.iter().enumerate() {
            let [red, green, blue] = colour;
            write!(out, "{id},{x},{y},{z},{red},{green},{blue}")?;
            if let Some([x, y, z]) = sigmas.map(|sigmas| sigmas[k]) {
                write!(out, ",{x},{y},{z}")?;
            }
            writeln!(out)?;
        }
        Ok(())
    })
}

pub(super) fn write_observations(
    path: &Path,
    scene: &Reconstruction,
    force: bool,
) -> Result<(), FileError> {
    let names: Vec<_> = scene.images.iter().map(|image| quoted(&image.name)).collect();
    output::write(path, force, |out| {
        writeln!(out, "image,point,u_px,v_px")?;
        scene.observations.iter().try_for_each(|o| {
            let (name, id) = (&names[o.image as usize], scene.points[o.point as usize].id);
            let [u, v] = o.image_px;
            writeln!(out, "{name},{id},{u},{v}")
        })
    })
}

fn complete(path: &Path, what: &str, there: usize, expected: usize) -> Result<(), FileError> {
    if there == expected {
        return Ok(());
    }
    let message = format!(
        "{there} {what}, {} says {expected}: the files are not from one reconstruction",
        super::NAME
    );
    Err(FileError::malformed(path, None, message))
}

pub(super) fn read_points(
    path: &Path,
    expected: usize,
    scene: &mut Reconstruction,
) -> Result<(), FileError> {
    let table = Table::with_header(path)?;
    let id = table.required("number of the point", &["point"])?;
    let axes = [
        table.required("easting", &["x_m"])?,
        table.required("northing", &["y_m"])?,
        table.required("height", &["z_m"])?,
    ];
    let colours = [
        table.required("red", &["red"])?,
        table.required("green", &["green"])?,
        table.required("blue", &["blue"])?,
    ];
    let sigmas = match scene.accuracy {
        None => None,
        Some(_) => Some([
            table.required("standard deviation along X", &["sigma_x_m"])?,
            table.required("standard deviation along Y", &["sigma_y_m"])?,
            table.required("standard deviation along Z", &["sigma_z_m"])?,
        ]),
    };
    for row in table.rows() {
        if let (Some(columns), Some(accuracy)) = (sigmas, &mut scene.accuracy) {
            let mut sigma_m = [0.0; 3];
            for (value, column) in sigma_m.iter_mut().zip(columns) {
                *value = table.number(row, column)?;
            }
            accuracy.points_m.push(sigma_m);
        }
        let mut position_m = [0.0; 3];
        for (value, column) in position_m.iter_mut().zip(axes) {
            *value = table.number(row, column)?;
        }
        let mut colour = [0; 3];
        for (value, column) in colour.iter_mut().zip(colours) {
            *value = table.whole(row, column)?;
        }
        scene.points.push(TiePoint { id: table.whole(row, id)?, position_m, colour });
    }
    complete(path, "tie points", scene.points.len(), expected)
}

pub(super) fn read_observations(
    path: &Path,
    expected: usize,
    scene: &mut Reconstruction,
) -> Result<(), FileError> {
    let table = Table::with_header(path)?;
    let image = table.required("image", &["image"])?;
    let point = table.required("number of the point", &["point"])?;
    let axes = [table.required("column", &["u_px"])?, table.required("row", &["v_px"])?];
    let images: HashMap<&str, u32> =
        scene.images.iter().zip(0..).map(|(image, k)| (image.name.trim(), k)).collect();
    let points: HashMap<u64, u32> =
        scene.points.iter().zip(0..).map(|(point, k)| (point.id, k)).collect();
    if points.len() != scene.points.len() {
        return Err(FileError::malformed(path, None, "two tie points have the same number"));
    }
    for row in table.rows() {
        let name = table.text(row, image);
        let id: u64 = table.whole(row, point)?;
        let place = images.get(name);
        let image = place.ok_or_else(|| table.fault(row, format!("there is no image {name:?}")))?;
        let place = points.get(&id);
        let point = place.ok_or_else(|| table.fault(row, format!("there is no tie point {id}")))?;
        let image_px = [table.number(row, axes[0])?, table.number(row, axes[1])?];
        scene.observations.push(Observation { image: *image, point: *point, image_px });
    }
    complete(path, "observations", scene.observations.len(), expected)
}
