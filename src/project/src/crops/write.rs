//! Files of the crops: pictures with world files, tables, and a folder that appears when all of it is there.

use super::{
    CropsOutcome, PlotCrop,
    traits::{COLUMNS, mean_and_deviation},
};
use image::{RgbImage, imageops};
use rowgram_base::error::Error;
use rowgram_files::csv_table::CsvWriter;
use rowgram_optim::output::{self, FileError};
use rowgram_raster::georeference::Georeference;
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// A name that every file system takes: letters, digits, hyphen, underscore, point; no point in front.
pub(super) fn as_file_name(name: &str) -> String {
    let usable = |c: char| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let name: String = name.trim().chars().take(100).map(usable).collect();
    match name.trim_start_matches('.') {
        "" => "_".to_owned(),
        rest => rest.to_owned(),
    }
}

/// The world file beside a PNG: six lines, the last two the map position of the centre of the top-left pixel.
pub(super) fn world_file(picture: &Path, of: &Georeference) -> Result<(), FileError> {
    let [a, d] = of.per_column;
    let [b, e] = of.per_row;
    let [c, f] = of.origin;
    output::write(&picture.with_extension("pgw"), false, |out| {
        [a, d, b, e, c, f].iter().try_for_each(|value| writeln!(out, "{value:?}"))
    })
}

/// The part of a photo that holds a polygon, and its first column and row; `None` where they do not meet.
pub(super) fn part_around(
    photo: &RgbImage,
    rings: &[Vec<[f64; 2]>],
) -> Option<([u32; 2], RgbImage)> {
    let size = [photo.width(), photo.height()];
    let bounds = |axis: usize| {
        let values = || rings.iter().flatten().map(|at| at[axis]);
        let low = values().fold(f64::INFINITY, f64::min).floor();
        let high = values().fold(f64::NEG_INFINITY, f64::max).ceil() + 1.0;
        let end = f64::from(size[axis]);
        (low <= high).then(|| (low.clamp(0.0, end) as u32, high.clamp(0.0, end) as u32))
    };
    let ((left, right), (top, bottom)) = (bounds(0)?, bounds(1)?);
    (left < right && top < bottom).then(|| {
        let part = imageops::crop_imm(photo, left, top, right - left, bottom - top);
        ([left, top], part.to_image())
    })
}

/// Files that stand beside the folders of the plots.
pub(super) const TABLES: [&str; 4] = ["crops.csv", "traits.csv", "crops.json", "comparison.csv"];

/// `crops.csv` (one line a crop), `traits.csv` (one line a plot) and `crops.json` (everything).
pub(super) fn tables(outcome: &CropsOutcome, folder: &Path) -> Result<(), Error> {
    let number = |value: Option<f64>| {
        let mut text = String::new();
        if let Some(value) = value {
            let _ = write!(text, "{value:.6}");
        }
        text
    };
    output::write(&folder.join("crops.csv"), false, |out| {
        let mut csv = CsvWriter::new(out);
        let fixed = ["plot", "image", "rank", "file", "as_taken", "view_angle_deg", "sharpness"];
        csv.write_record(fixed.into_iter().chain(COLUMNS.map(|(name, _)| name)))?;
        for crop in &outcome.crops {
            let path = |path: &PathBuf| path.to_string_lossy().into_owned();
            let fixed = [
                crop.plot.clone(),
                crop.image.clone(),
                crop.rank.to_string(),
                path(&crop.file),
                crop.as_taken.as_ref().map(path).unwrap_or_default(),
                format!("{:.2}", crop.view_angle_deg),
                number(crop.traits.sharpness),
            ];
            let values = COLUMNS.map(|(_, value)| number(value(&crop.traits)));
            csv.write_record(fixed.into_iter().chain(values))?;
        }
        csv.flush()
    })?;
    output::write(&folder.join("traits.csv"), false, |out| {
        let mut csv = CsvWriter::new(out);
        let names = COLUMNS.iter().flat_map(|(name, _)| [(*name).to_owned(), format!("{name}_sd")]);
        csv.write_record(["plot".to_owned(), "photos".to_owned()].into_iter().chain(names))?;
        for crops in outcome.crops.chunk_by(|a, b| a.plot == b.plot) {
            let values = COLUMNS.iter().flat_map(|(_, value)| {
                let of = crops.iter().map(|crop: &PlotCrop| value(&crop.traits));
                let (mean, deviation) = mean_and_deviation(of);
                [number(mean), number(deviation)]
            });
            let fixed = [crops[0].plot.clone(), crops.len().to_string()];
            csv.write_record(fixed.into_iter().chain(values))?;
        }
        csv.flush()
    })?;
    Ok(output::write_json(&folder.join("crops.json"), false, outcome)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_names_of_files() {
        for (name, expected) in [
            ("12-B", "12-B"),
            ("Plot 3/4", "Plot_3_4"),
            ("../../etc", "_.._etc"),
            ("..", "_"),
            ("", "_"),
            ("Süd 1", "Süd_1"),
        ] {
            assert_eq!(as_file_name(name), expected, "{name}");
        }
    }

    #[test]
    fn a_part_is_cut_at_the_edge_of_the_photo() {
        let photo = RgbImage::new(20, 10);
        let ring = |points: &[[f64; 2]]| vec![points.to_vec()];
        let (from, part) =
            part_around(&photo, &ring(&[[15.2, 3.0], [25.0, 3.0], [18.0, 12.0]])).unwrap();
        assert_eq!((from, part.dimensions()), ([15, 3], (5, 7)));
        assert!(part_around(&photo, &ring(&[[30.0, 3.0], [35.0, 3.0], [31.0, 5.0]])).is_none());
        assert!(part_around(&photo, &[]).is_none());
    }
}
