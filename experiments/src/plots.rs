//! Every variant of the locator on real plots with one annotated point per plant, true number of
//! plants.
//!
//! The thresholds of the leaf mask and the smallest component are chosen on every third plot of
//! `train.txt` by coordinate search: from the published values, each setting in turn takes the
//! candidate with the largest score, until a whole round changes nothing (four rounds at most). The
//! score is the mean F1 at a quarter of the median in-row spacing, over k-means and the inter-row
//! prior started from rows. `val.txt` takes no part in it.

use crate::{
    Folders,
    locate::make,
    methods::{self, METHODS, Method, Run},
    table,
};
use rayon::prelude::*;
use rowgram::robust::median;
use rowgram::{
    Error,
    io::{FileError, images, output, points},
    phenotype::rows,
    problems::plants::index::PixelIndex,
    raster::{components, mask::Thresholds},
};
use std::path::Path;

/// Radius in pixels besides the relative one; about 5 cm.
const FIXED_RADIUS_PX: f64 = 15.0;
/// Floor of the scatter about a row: about 1 cm.
const FLOOR_PX: f64 = 3.0;
/// Methods whose scores decide the thresholds.
const JUDGES: [&str; 2] = ["k-means", "rows, inter-row joint"];

/// The candidates of every setting: four thresholds, least pixels of a component.
pub(crate) const CANDIDATES: [&[i64]; 5] = [
    &[20, 25, 30, 35, 40, 45, 50],
    &[60, 65, 70, 79, 90],
    &[0, 15, 30, 50, 70],
    &[100, 130, 163, 200, 255],
    &[0, 10, 25, 50, 200],
];

pub(crate) struct Plot {
    pub(crate) name: String,
    pub(crate) photo: image::RgbImage,
    pub(crate) truth: Vec<[f64; 2]>,
    pub(crate) radii_px: [f64; 2],
}

/// Runs the experiment.
pub(crate) fn run(folders: &Folders) -> Result<(), Error> {
    make(&folders.out)?;
    let root = folders.data.join("maize_plots");
    let train = read(&root, "train.txt")?;
    let search: Vec<&Plot> = train.iter().step_by(3).collect();
    let judges: Vec<Method> =
        METHODS.iter().copied().filter(|method| JUDGES.contains(&method.name)).collect();
    let mut settings = [30, 79, 30, 163, 0];
    let mut best = mean_f1(&compare("search", &search, &judges, settings)?);
    let mut log = format!("settings,score\n\"{settings:?}\",{best:.4}\n");
    for _ in 0..4 {
        let before = settings;
        for (setting, candidates) in CANDIDATES.iter().enumerate() {
            for &candidate in *candidates {
                let mut tried = settings;
                tried[setting] = candidate;
                if tried == settings || candidate == before[setting] {
                    continue;
                }
                let score = mean_f1(&compare("search", &search, &judges, tried)?);
                log += &format!("\"{tried:?}\",{score:.4}\n");
                if score > best {
                    (best, settings) = (score, tried);
                }
            }
        }
        if settings == before {
            break;
        }
    }
    let path = folders.out.join("locate_plots_search.csv");
    output::write(&path, true, |writer| writer.write_all(log.as_bytes()))?;
    let val = read(&root, "val.txt")?;
    let mut runs = compare("train", &train.iter().collect::<Vec<_>>(), METHODS, settings)?;
    runs.extend(compare("val", &val.iter().collect::<Vec<_>>(), METHODS, settings)?);
    let title = format!(
        "Plant location on real plots, true number of plants; thresholds {:?}, components of at \
         least {} pixels",
        &settings[..4],
        settings[4]
    );
    table::write(&folders.out, "locate_plots", &title, &["quarter_spacing", "15px"], &runs)
}

fn compare(
    list: &str,
    plots: &[&Plot],
    methods: &[Method],
    [t1, t2, t3, t4, least]: [i64; 5],
) -> Result<Vec<Run>, Error> {
    let thresholds = Thresholds::new(t1, t2, t3, t4)?;
    let runs: Vec<Vec<Run>> = plots
        .par_iter()
        .map(|plot| {
            let mut mask = thresholds.mask(&plot.photo);
            components::remove_small(&mut mask, least.unsigned_abs() as usize);
            let index = PixelIndex::from_mask(mask.width, &mask.data);
            let detection = rows::detect(&index);
            let at = (list, plot.name.as_str());
            let run = |method: &Method| {
                let (truth, radii) = (&plot.truth, &plot.radii_px);
                methods::run(method, at, &index, &detection, truth, radii, FLOOR_PX)
            };
            methods.iter().map(run).collect()
        })
        .collect::<Result<_, Error>>()?;
    Ok(runs.into_iter().flatten().collect())
}

fn mean_f1(runs: &[Run]) -> f64 {
    runs.iter().map(|run| run.f1[0]).sum::<f64>() / runs.len().max(1) as f64
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
            let radii_px = [spacing_px(&truth) / 4.0, FIXED_RADIUS_PX];
            Ok(Plot { name: (*name).to_owned(), photo, truth, radii_px })
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
