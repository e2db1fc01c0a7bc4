//! Every variant of the locator on synthetic masks, with the true number of plants.
//!
//! `field_masks/SCENARIO/N.png` with truth in `N.csv`; 1.5 cm per pixel, so 5 cm are 3.33 px.

use crate::{
    Folders,
    methods::{self, METHODS, Run},
    table,
};
use rayon::prelude::*;
use rowgram::{
    Error,
    io::{FileError, images, points},
    phenotype::rows,
    problems::plants::index::PixelIndex,
};
use std::path::{Path, PathBuf};

/// Ground sampling distance of the masks.
pub(crate) const GSD_M: f64 = 0.015;

/// A scenario and one of its masks.
pub(crate) type Job = (String, PathBuf);

/// All masks, by scenario.
pub(crate) fn jobs(folders: &Folders, masks: usize) -> Result<Vec<Job>, FileError> {
    let root = folders.data.join("field_masks");
    let mut jobs: Vec<Job> = Vec::new();
    for scenario in list(&root)?.into_iter().filter(|path| path.is_dir()) {
        let name = scenario.file_name().map(|n| n.to_string_lossy().into_owned());
        let name = name.unwrap_or_default();
        if name != "whole_field" {
            let is_mask = |path: &PathBuf| path.extension().is_some_and(|e| e == "png");
            let found = list(&scenario)?.into_iter().filter(is_mask).take(masks);
            jobs.extend(found.map(|path| (name.clone(), path)));
        }
    }
    Ok(jobs)
}

/// Runs the experiment.
pub(crate) fn run(folders: &Folders, masks: usize) -> Result<(), Error> {
    make(&folders.out)?;
    let jobs = jobs(folders, masks)?;
    let radii_px = [0.05 / GSD_M, 0.10 / GSD_M];
    let runs: Vec<Vec<Run>> = jobs
        .par_iter()
        .map(|(scenario, path)| {
            let mask = images::read_mask(path)?;
            let truth = points::read(&path.with_extension("csv"))?;
            let index = PixelIndex::from_mask(mask.width, &mask.data);
            let detection = rows::detect(&index);
            let image = path.file_stem().map(|n| n.to_string_lossy().into_owned());
            let at = (scenario.as_str(), image.as_deref().unwrap_or_default());
            METHODS
                .iter()
                .map(|m| methods::run(m, at, &index, &detection, &truth, &radii_px, 0.01 / GSD_M))
                .collect()
        })
        .collect::<Result<_, Error>>()?;
    let runs: Vec<Run> = runs.into_iter().flatten().collect();
    let title = "Plant location on synthetic masks, true number of plants";
    table::write(&folders.out, "locate_masks", title, &["5cm", "10cm"], &runs)
}

/// Makes the output folder.
pub(crate) fn make(folder: &Path) -> Result<(), FileError> {
    std::fs::create_dir_all(folder).map_err(|error| FileError::write(folder, error))
}

/// The entries of a folder, sorted.
fn list(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    let entries = std::fs::read_dir(folder).map_err(|error| FileError::read(folder, error))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(Result::ok).map(|e| e.path()).collect();
    paths.sort();
    Ok(paths)
}
