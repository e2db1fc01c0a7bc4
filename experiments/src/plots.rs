//! Real plots and clips with one annotated point per plant.

use rayon::prelude::*;
use rowgram::robust::median;
use rowgram::{
    Error,
    io::{FileError, images, points},
};
use std::path::Path;

/// Side of a clip, in pixels.
const CLIP_PX: f64 = 640.0;

pub(crate) struct Plot {
    pub(crate) name: String,
    pub(crate) photo: image::RgbImage,
    pub(crate) truth: Vec<[f64; 2]>,
    /// A quarter of the distance of plants in a row, pixels.
    pub(crate) radius_px: f64,
}

pub(crate) fn read(root: &Path, list: &str) -> Result<Vec<Plot>, Error> {
    let path = root.join(list);
    let names = std::fs::read_to_string(&path).map_err(|error| FileError::read(&path, error))?;
    names
        .split_whitespace()
        .collect::<Vec<_>>()
        .par_iter()
        .map(|name| {
            let photo = images::read_photo(&root.join(format!("image/{name}.jpg")))?;
            let truth = points::read(&root.join(format!("label/{name}.txt")))?;
            let radius_px = spacing_px(&truth) / 4.0;
            Ok(Plot { name: (*name).to_owned(), photo, truth, radius_px })
        })
        .collect()
}

/// Median distance between neighbours in a row: the plots have two rows along x, and the largest
/// gap in y is between them.
fn spacing_px(truth: &[[f64; 2]]) -> f64 {
    let mut by_y = truth.to_vec();
    by_y.sort_by(|a, b| a[1].total_cmp(&b[1]));
    let split = (1..by_y.len())
        .max_by(|&a, &b| (by_y[a][1] - by_y[a - 1][1]).total_cmp(&(by_y[b][1] - by_y[b - 1][1])))
        .unwrap_or(0);
    let (first, second) = by_y.split_at_mut(split);
    let mut gaps = Vec::new();
    for row in [first, second] {
        row.sort_by(|a, b| a[0].total_cmp(&b[0]));
        gaps.extend(row.windows(2).map(|pair| pair[1][0] - pair[0][0]));
    }
    median(gaps).unwrap_or(40.0).max(4.0)
}

/// Clips with their boxes, by name.
pub(crate) fn clips(root: &Path) -> Result<Vec<Plot>, Error> {
    let folder = root.join("images");
    let entries = std::fs::read_dir(&folder).map_err(|error| FileError::read(&folder, error))?;
    let mut paths: Vec<_> = entries.filter_map(Result::ok).map(|entry| entry.path()).collect();
    paths.sort();
    paths
        .par_iter()
        .map(|path| {
            let name = path.file_stem().map(|n| n.to_string_lossy().into_owned());
            let name = name.unwrap_or_default();
            let boxes = root.join(format!("labels/{name}.txt"));
            let text =
                std::fs::read_to_string(&boxes).map_err(|error| FileError::read(&boxes, error))?;
            let truth: Vec<[f64; 2]> = text
                .lines()
                .filter_map(|line| {
                    let numbers: Vec<f64> =
                        line.split_whitespace().filter_map(|word| word.parse().ok()).collect();
                    let &[_, x, y, _, _] = numbers.as_slice() else { return None };
                    Some([x * CLIP_PX - 0.5, y * CLIP_PX - 0.5])
                })
                .collect();
            let radius_px = nearest_px(&truth) / 4.0;
            Ok(Plot { name, photo: images::read_photo(path)?, truth, radius_px })
        })
        .collect()
}

/// Median distance to the nearest neighbour on the farther side: with rows farther apart than plants,
/// the spacing in the rows, whatever their heading.
pub(crate) fn nearest_px(truth: &[[f64; 2]]) -> f64 {
    let mut distances: Vec<f64> = truth
        .iter()
        .filter_map(|at| {
            let mut near: Vec<[f64; 2]> = truth
                .iter()
                .map(|other| [other[0] - at[0], other[1] - at[1]])
                .filter(|d| d[0] != 0.0 || d[1] != 0.0)
                .collect();
            near.sort_by(|a, b| a[0].hypot(a[1]).total_cmp(&b[0].hypot(b[1])));
            let first = *near.first()?;
            let other =
                near.iter().find(|d| d[0] * first[0] + d[1] * first[1] < 0.0).unwrap_or(&first);
            Some(0.5 * (first[0].hypot(first[1]) + other[0].hypot(other[1])))
        })
        .collect();
    distances.sort_by(f64::total_cmp);
    distances.get(distances.len() / 2).copied().unwrap_or(4.0).max(4.0)
}
