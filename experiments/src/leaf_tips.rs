//! Leaves found in side views of maize and sorghum against the leaf tips that people marked there.
//!
//! Counts in leaves: found minus marked, and its size. Tips: the share of marked tips within [`REACH_PX`] of an end of a
//! found leaf. There is no true mask: the plant is what [`COLOURS`] leaves, in the largest group of parts no further than
//! [`GAP_PX`] apart. Stalks are as green as leaves, so a method that sees a stalk counts it.

use crate::{
    Folders,
    leaves::{Method, mean, methods, segment},
};
use rowgram::{
    Error,
    io::{FileError, images, output},
    raster::{Mask, components, hsv},
};
use serde::Deserialize;
use std::{fmt::Write as _, path::Path};

/// How far an end of a leaf may be from a tip, pixels (the pictures are 1227 x 1028).
const REACH_PX: f64 = 20.0;
/// Parts of a plant are no further than this apart, pixels.
const GAP_PX: usize = 8;
/// Smaller parts are not plant, pixels.
const SPECK_PX: usize = 20;
/// Least and largest hue, least saturation, least and largest value: a plant is darker than the screen behind it.
const COLOURS: [u8; 5] = [20, 85, 60, 20, 200];

/// One plant.
#[derive(Deserialize)]
struct Tips {
    x: Vec<f64>,
    y: Vec<f64>,
}

struct Run {
    picture: String,
    method: &'static str,
    found: usize,
    marked: usize,
    tips: Option<f64>,
}

/// Runs every method on every picture with marks and writes `leaf_tips.csv` and `leaf_tips.md`.
pub(crate) fn run(folders: &Folders) -> Result<(), Error> {
    let folder = folders.data.join("leaf_maize_sorghum_side/CountingByDetection_FasterRCNNs");
    let mut runs = Vec::new();
    for list in ["example_training.csv", "example_validation.csv"] {
        for (picture, tips) in marks(&folder.join(list))? {
            let mask = plant(&folder.join("example_images").join(&picture))?;
            for (method, how) in methods() {
                runs.push(judge(&picture, method, &how, &mask, &tips));
            }
        }
    }
    write(&folders.out, &runs)
}

fn marks(path: &Path) -> Result<Vec<(String, Tips)>, Error> {
    let wrong = |what: String| FileError::malformed(path, None, what);
    let mut reader = csv::ReaderBuilder::new()
        .delimiter(b'\t')
        .from_path(path)
        .map_err(|error| wrong(error.to_string()))?;
    reader
        .records()
        .map(|record| {
            let record = record.map_err(|error| wrong(error.to_string()))?;
            let (Some(name), Some(tips)) = (record.get(1), record.get(2)) else {
                return Err(wrong("expected three columns".to_owned()).into());
            };
            let tips = serde_json::from_str(tips).map_err(|error| wrong(error.to_string()))?;
            Ok((name.to_owned(), tips))
        })
        .collect()
}

fn plant(path: &Path) -> Result<Mask, Error> {
    let photo = match images::read(path)? {
        images::Picture::Photo(photo) => photo,
        images::Picture::Mask(mask) => mask.to_rgb(),
    };
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let [from, to, pale, dark, bright] = COLOURS;
    let mut mask = Mask::from_fn(width, height, |u, v| {
        let [h, s, value] = hsv::from_rgb(photo.get_pixel(u as u32, v as u32).0);
        (from..=to).contains(&h) && s >= pale && (dark..=bright).contains(&value)
    });
    components::remove_small(&mut mask, SPECK_PX);
    let mut wide = Mask::empty(width, height);
    for (u, v) in mask.plant_pixels() {
        let reach = GAP_PX / 2;
        for row in v.saturating_sub(reach)..=(v + reach).min(height - 1) {
            let (a, b) = (u.saturating_sub(reach), (u + reach).min(width - 1));
            wide.data[row * width + a..=row * width + b].fill(1);
        }
    }
    let mut largest = Mask::empty(width, height);
    let mut most = 0;
    for part in components::parts(&wide) {
        let mut own = Mask::empty(width, height);
        for run in &part.runs {
            let pixels = run.v * width + run.start..run.v * width + run.end;
            own.data[pixels.clone()].copy_from_slice(&mask.data[pixels]);
        }
        if own.count() > most {
            (most, largest) = (own.count(), own);
        }
    }
    Ok(largest)
}

fn judge(picture: &str, method: &'static str, how: &Method, mask: &Mask, tips: &Tips) -> Run {
    let (labels, leaves) = segment(mask, how);
    let marked = tips.x.len();
    let found = match &leaves {
        Some(leaves) => leaves.leaves.len(),
        None => labels.iter().max().map_or(0, |&most| most as usize),
    };
    let near = leaves.map(|leaves| {
        let ends: Vec<[f64; 2]> = leaves
            .leaves
            .iter()
            .flat_map(|leaf| [leaf.axis_px.first(), leaf.axis_px.last()])
            .flatten()
            .copied()
            .collect();
        let hit = |(x, y): (&f64, &f64)| {
            ends.iter().any(|end| (end[0] - x).hypot(end[1] - y) <= REACH_PX)
        };
        let hits = tips.x.iter().zip(&tips.y).filter(|&tip| hit(tip)).count();
        hits as f64 / marked.max(1) as f64
    });
    Run { picture: picture.to_owned(), method, found, marked, tips: near }
}

fn write(folder: &Path, runs: &[Run]) -> Result<(), Error> {
    let mut csv = "picture,method,found,marked,tips_near_an_end\n".to_owned();
    for Run { picture, method, found, marked, tips } in runs {
        let tips = tips.map(|tips| format!("{tips:.4}")).unwrap_or_default();
        let _ = writeln!(csv, "\"{picture}\",\"{method}\",{found},{marked},{tips}");
    }
    let mut text = "# Leaf tips in side views\n\n| method | DiC | abs DiC | tips at an end |\n|---|---|---|---|\n"
        .to_owned();
    for (method, _) in methods() {
        let mine = || runs.iter().filter(|run| run.method == method);
        let dic = |run: &Run| run.found as f64 - run.marked as f64;
        let tips = mean(mine().filter_map(|run| run.tips));
        let _ = writeln!(
            text,
            "| {method} | {:+.1} | {:.1} | {} |",
            mean(mine().map(dic)).unwrap_or_default(),
            mean(mine().map(|run| dic(run).abs())).unwrap_or_default(),
            tips.map(|tips| format!("{:.0} %", 100.0 * tips)).unwrap_or_default(),
        );
    }
    output::write(&folder.join("leaf_tips.csv"), true, |out| out.write_all(csv.as_bytes()))?;
    output::write(&folder.join("leaf_tips.md"), true, |out| out.write_all(text.as_bytes()))?;
    Ok(())
}
