//! Where ground points are in photos.

use super::{Defaults, IMAGE, Names, no_such_image, nothing_matches};
use crate::{
    FileError,
    table::{Column, Table},
};
use rowgram_survey::scene::{Excluded, ExcludedKind, GroundObservation, GroundPoint, Image};
use std::{collections::HashMap, path::Path};

/// The point of a mark: no image is called so.
const POINT_OF_MARK: &[&str] =
    &["label", "point", "gcp", "gcp_label", "gcp_name", "marker", "point_name", "name", "id"];
const COLUMN_PX: &[&str] =
    &["u_px", "u", "x_px", "px", "pixel_x", "x_pixel", "image_x", "im_x", "col", "column", "x"];
const ROW_PX: &[&str] =
    &["v_px", "v", "y_px", "py", "pixel_y", "y_pixel", "image_y", "im_y", "row", "line", "y"];

/// Columns of marks without a header: those that name images and points, and the two numbers after them.
fn unnamed_marks(
    table: &Table,
    names: &Names<'_>,
    points: &HashMap<&str, u32>,
) -> Result<[Column; 4], FileError> {
    let first = |is: &dyn Fn(&str) -> bool| {
        let mut columns = table.columns().map(|(_, column)| column);
        columns.find(|column| table.rows().iter().any(|row| is(table.text(row, *column))))
    };
    let image = first(&|text| names.find(text).is_some());
    let label = first(&|text| points.contains_key(text));
    let mut numbers = table.columns().map(|(_, column)| column).filter(|column| {
        let others = Some(*column) != image && Some(*column) != label;
        others && table.rows().iter().all(|row| table.parse(row, *column).is_some())
    });
    match (image, label, numbers.next(), numbers.next()) {
        (Some(image), Some(label), Some(u), Some(v)) => Ok([image, label, u, v]),
        _ => Err(table.whole_fault(
            "it has no header, and its columns are not the image, the name of the point, its column and its row in pixels: expected a header image, label, u_px, v_px".into(),
        )),
    }
}

/// Reads marks; those in images that are not in the block are set aside by name.
///
/// # Errors
/// Missing columns, fields that are no numbers, a ground point that is not there or is marked twice
/// in one image, no image that matches.
pub fn marks(
    path: &Path,
    images: &[Image],
    ground: &[GroundPoint],
    defaults: &Defaults,
) -> Result<(Vec<GroundObservation>, Vec<Excluded>), FileError> {
    let table = Table::read(path)?;
    let names = Names::new(images);
    let points: HashMap<&str, u32> =
        ground.iter().enumerate().map(|(k, point)| (point.name.as_str(), k as u32)).collect();
    let [image, label, u, v] = if table.is_named() {
        [
            table.required("image", IMAGE)?,
            table.required("name of the point", POINT_OF_MARK)?,
            table.required("column in the image", COLUMN_PX)?,
            table.required("row in the image", ROW_PX)?,
        ]
    } else {
        unnamed_marks(&table, &names, &points)?
    };
    let sigma = table.column(&["sigma_px"]);
    let mut found = Vec::new();
    let mut aside = Vec::new();
    let mut lines: HashMap<(u32, u32), usize> = HashMap::new();
    for row in table.rows() {
        let label = table.text(row, label);
        let Some(&ground) = points.get(label) else {
            let message = format!("there is no ground point {label:?}");
            return Err(table.fault(row, message));
        };
        let name = table.text(row, image);
        let mark = GroundObservation {
            image: 0,
            ground,
            image_px: [table.number(row, u)?, table.number(row, v)?],
            sigma_px: table.positive_or(row, sigma, defaults.mark_px)?,
        };
        let Some(image) = names.find(name) else {
            aside.push(no_such_image(ExcludedKind::Mark, name, Some(label)));
            continue;
        };
        if let Some(line) = lines.insert((image, ground), row.line) {
            let message = format!("{label} is marked twice in {name}, first in line {line}");
            return Err(table.fault(row, message));
        }
        found.push(GroundObservation { image, ..mark });
    }
    if found.is_empty() {
        return Err(table.whole_fault(nothing_matches(&aside, images)));
    }
    Ok((found, aside))
}
