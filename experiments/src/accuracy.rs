//! Real data sets with default settings and nothing told: plants, leaf masks and leaves, beside rivals of a few lines.
//!
//! Photos go the way of the command `locate`: the estimated leaf mask with its posterior, and plants with the default options.
//! Constants of a rival (its smallest component) and of the uncertainty (how much wider intervals have to be, the share of plants in
//! the right place) are fitted on all other sets and judged on the one left out.
//!
//! Writes `accuracy_plants.csv`, one line per photo, and `accuracy.md`, the tables of `docs/accuracy.md`. Numbers only.

use crate::{
    Folders,
    fail::{make, write_csv},
    leaves,
    mask_sets::{self, MaskPlot},
    plots::{self, Plot, clips, nearest_px},
    rivals::{by_area, excess_green, green_of_lab},
};
use image::{DynamicImage, ImageDecoder as _, ImageReader, RgbImage, metadata::Orientation};
use rayon::prelude::*;
use rowgram::{
    Error,
    io::{FileError, images, output, points},
    phenotype::{
        leaves::LeafOptions,
        locator::{self, LocateOptions, Work},
    },
    raster::{Mask, vegetation},
    score::Score,
};
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// Smallest components that the rival may choose from, in pixels.
const MIN_PIXELS: [usize; 6] = [10, 25, 50, 100, 200, 400];
/// Sets of photos with a point per plant, besides plots and clips.
const POINTS: [&str; 4] = ["maize_residue", "maize_emergence", "potato_uav", "olive_trees"];
/// Tilted photos from a hovering drone, with points marked by eye.
const LOW_DRONE: &str = "corn_soy_low_drone";
/// Leaf masks that come without their photos.
const BEANS: &str = "bean_plots_masks";
/// How much wider intervals may become where they are fitted.
const WIDEST: f64 = 10.0;
/// Sets whose numbers no width of an interval holds: they take no part in fits for others.
const OUT_OF_REACH: [&str; 2] = ["olive_trees", LOW_DRONE];
/// Sets whose photos have nearly the same number of plants: nothing is left to explain beside their mean.
const WITHOUT_R2: [&str; 1] = ["maize_emergence"];

/// One photo.
struct Counted {
    set: &'static str,
    photo: String,
    truth: f64,
    found: f64,
    right: f64,
    /// Sum of the confidences.
    confidence: f64,
    interval: [f64; 2],
    /// Count and right places of the rival, by its smallest component.
    rival: Vec<[f64; 2]>,
}

/// Runs everything on every `every`-th photo.
pub(crate) fn run(folders: &Folders, every: usize) -> Result<(), Error> {
    make(&folders.out)?;
    let mut all = Vec::new();
    let mut photos = sets(&folders.data)?;
    photos.push((LOW_DRONE, tilted(&folders.data)?));
    for (set, plots) in photos {
        let some: Vec<&Plot> = plots.iter().step_by(every).collect();
        let counted: Vec<Counted> =
            some.par_iter().map(|plot| count(set, plot)).collect::<Result<_, Error>>()?;
        all.extend(counted);
    }
    let beans = mask_sets::beans(&folders.data)?;
    let some: Vec<&MaskPlot> = beans.iter().step_by(every).collect();
    let judged = |plot: &&MaskPlot| {
        let leaf = (plot.mask.clone(), None);
        judge(BEANS, &plot.name, &plot.truth, plot.radius_px, leaf, &plot.mask)
    };
    all.extend(some.par_iter().map(judged).collect::<Result<Vec<_>, Error>>()?);
    write_csv(&folders.out.join("accuracy_plants.csv"), &photos_table(&all))?;
    let mut text = plants_table(&all);
    text += &(mask_sets::sorghum_table(&folders.data)? + "\n");
    text += &masks_table(&folders.data, every)?;
    text += &leaves_table(&folders.data, every)?;
    let path = folders.out.join("accuracy.md");
    output::write(&path, true, |writer| writer.write_all(text.as_bytes()))?;
    show(&text);
    Ok(())
}

/// Every set of photos with a point per plant.
pub(crate) fn sets(data: &Path) -> Result<Vec<(&'static str, Vec<Plot>)>, Error> {
    let root = data.join("maize_plots");
    let mut maize = plots::read(&root, "train.txt")?;
    maize.extend(plots::read(&root, "val.txt")?);
    let clips = clips(&data.join("stand_count_clips"))?;
    let mut sets = vec![("maize_plots", maize), ("stand_count_clips", clips)];
    for name in POINTS {
        let root = data.join("plants").join(name);
        let mut found = Vec::new();
        for path in files(&root.join("images"))? {
            let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned());
            let stem = stem.unwrap_or_default();
            let path_of_truth = root.join(format!("truth/{stem}.csv"));
            if path_of_truth.exists() {
                let truth = points::read(&path_of_truth)?;
                let radius_px = nearest_px(&truth) / 4.0;
                match images::read_photo(&path) {
                    Ok(photo) => found.push(Plot { name: stem, photo, truth, radius_px }),
                    // The program refuses it as well; the table has one photo less.
                    Err(error) => left_out(&error),
                }
            }
        }
        sets.push((name, found));
    }
    Ok(sets)
}

/// Photos from a hovering drone; none where they are not there.
fn tilted(data: &Path) -> Result<Vec<Plot>, Error> {
    let root = data.join("fields").join(LOW_DRONE);
    let paths = if root.exists() { files(&root)? } else { Vec::new() };
    let mut tilted = Vec::new();
    for path in paths.iter().filter(|path| path.extension().is_some_and(|e| e == "jpg")) {
        let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let truth = points::read(&root.join(format!("{stem}.plants.csv")))?;
        let radius_px = nearest_px(&truth) / 4.0;
        tilted.push(Plot { name: stem, photo: images::read_photo(path)?, truth, radius_px });
    }
    Ok(tilted)
}

/// The files of a folder, in order of their names.
pub(crate) fn files(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    let entries = std::fs::read_dir(folder).map_err(|error| FileError::read(folder, error))?;
    let mut paths: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
    paths.sort();
    Ok(paths)
}

/// The leaf mask and its posterior. A photo in which nothing can be told has an empty mask, and is judged by it.
pub(crate) fn leaf_of(photo: &RgbImage) -> (Mask, Option<Vec<u8>>) {
    let empty = || Mask::empty(photo.width() as usize, photo.height() as usize);
    let found = vegetation::segment(photo, None, &vegetation::Options::default());
    found.map_or_else(|_| (empty(), None), |found| (found.mask, Some(found.posterior)))
}

fn vegetation_of(photo: &RgbImage) -> Mask {
    leaf_of(photo).0
}

fn right(found: &[[f64; 2]], truth: &[[f64; 2]], radius_px: f64) -> Result<f64, Error> {
    let score = Score::new(found, truth, &[radius_px])?;
    Ok(score.radii[0].precision.unwrap_or(0.0) * found.len() as f64)
}

fn count(set: &'static str, plot: &Plot) -> Result<Counted, Error> {
    let (leaf, green) = (leaf_of(&plot.photo), excess_green(&plot.photo));
    judge(set, &plot.name, &plot.truth, plot.radius_px, leaf, &green)
}

/// The plants of a leaf mask, with its posterior, and what the rival makes of its own mask.
fn judge(
    set: &'static str,
    name: &str,
    truth: &[[f64; 2]],
    radius_px: f64,
    (mask, posterior): (Mask, Option<Vec<u8>>),
    green: &Mask,
) -> Result<Counted, Error> {
    let found = locator::prepare(&mask, posterior, None, &LocateOptions::default());
    // Where no plant can be located none was found: the photo counts, with all its plants missed.
    let stand = match found.map(|found| found.work) {
        Ok(Work::Stand(stand)) => Some(stand),
        _ => None,
    };
    let plants = stand.as_ref().map_or(&[][..], |stand| &stand.plants);
    let at: Vec<[f64; 2]> = plants.iter().map(|plant| plant.position_px).collect();
    let rival = MIN_PIXELS
        .iter()
        .map(|&least| {
            let places = by_area(green, least);
            Ok([places.len() as f64, right(&places, truth, radius_px)?])
        })
        .collect::<Result<_, Error>>()?;
    Ok(Counted {
        set,
        photo: name.to_owned(),
        truth: truth.len() as f64,
        found: at.len() as f64,
        right: right(&at, truth, radius_px)?,
        confidence: plants.iter().map(|plant| plant.confidence).sum(),
        interval: stand.as_ref().map_or([0.0; 2], |stand| stand.count_interval),
        rival,
    })
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, n), value| (sum + value, n + 1.0));
    sum / f64::max(count, 1.0)
}

/// MAPE, MAE, RMSE, R2 of counts.
fn errors(counts: &[(f64, f64)]) -> [f64; 4] {
    let off = |&(truth, found): &(f64, f64)| found - truth;
    let middle = mean(counts.iter().map(|count| count.0));
    let square = mean(counts.iter().map(|count| off(count).powi(2)));
    let spread = mean(counts.iter().map(|count| (count.0 - middle).powi(2)));
    [
        100.0 * mean(counts.iter().map(|count| (off(count) / count.0.max(1.0)).abs())),
        mean(counts.iter().map(|count| off(count).abs())),
        square.sqrt(),
        1.0 - square / spread.max(1e-12),
    ]
}

fn f1(truth: f64, found: f64, right: f64) -> f64 {
    2.0 * right / (truth + found).max(1.0)
}

/// Share of the photos whose number lies in intervals that are so many times as wide, and their mean width over the number.
fn coverage(photos: &[&Counted], wider: f64) -> [f64; 2] {
    let half = |c: &Counted| wider * 0.5 * (c.interval[1] - c.interval[0]);
    let inside = |c: &&&Counted| {
        let middle = 0.5 * (c.interval[0] + c.interval[1]);
        (c.truth - middle).abs() <= half(c)
    };
    let held = photos.iter().filter(inside).count() as f64 / photos.len().max(1) as f64;
    [held, mean(photos.iter().map(|c| 2.0 * half(c) / c.truth.max(1.0)))]
}

fn plants_table(all: &[Counted]) -> String {
    let mut names: Vec<&str> = all.iter().map(|c| c.set).collect();
    names.dedup();
    let mut text = "## Plants, defaults, number not given\n\nRight: within a quarter of the spacing. The rival: excess green above \
         Otsu's threshold, components of at least n pixels, `round(area / median area)` plants each; n is the one with the smallest \
         mean error on the other sets. MAPE in %.\n\n| set | photos | MAPE | MAE | RMSE | R2 | F1 | rival's n | MAPE | MAE | RMSE | R2 | F1 |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    let mut sure = String::from(
        "\n## Uncertainty\n\nHeld: share of photos whose number lies in the interval of 95 %, and its mean width over the \
         number. Left out: intervals as many times as wide as holds 95 % on all other sets, each of which counts the same (trees, which no width holds, take no part), \
         and confidence times the share of right places of all other sets.\n\n\
         | set | held | width | confidence | precision | wider, left out | held | width | confidence, left out |\n\
         |---|---|---|---|---|---|---|---|---|\n",
    );
    for name in &names {
        let (mine, others): (Vec<&Counted>, Vec<&Counted>) =
            all.iter().partition(|c| c.set == *name);
        let rival = |set: &[&Counted], k: usize| -> Vec<(f64, f64)> {
            set.iter().map(|c| (c.truth, c.rival[k][0])).collect()
        };
        let cost = |k: usize| errors(&rival(&others, k))[0];
        let k =
            (1..MIN_PIXELS.len()).fold(0, |best, k| if cost(k) < cost(best) { k } else { best });
        let [mape, mae, rmse, r2] =
            errors(&mine.iter().map(|c| (c.truth, c.found)).collect::<Vec<_>>());
        let [mape_r, mae_r, rmse_r, r2_r] = errors(&rival(&mine, k));
        let told = |r2: f64| match r2 {
            r2 if WITHOUT_R2.contains(name) || r2 < -9.99 => "-".to_owned(),
            r2 => format!("{r2:.2}"),
        };
        let own = mean(mine.iter().map(|c| f1(c.truth, c.found, c.right)));
        let theirs = mean(mine.iter().map(|c| f1(c.truth, c.rival[k][0], c.rival[k][1])));
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "| {name} | {} | {mape:.1} | {mae:.1} | {rmse:.1} | {} | {own:.3} | {} | {mape_r:.1} | {mae_r:.1} | {rmse_r:.1} | {} | {theirs:.3} |",
            mine.len(),
            told(r2),
            MIN_PIXELS[k],
            told(r2_r),
        );
        let inside = |c: &&Counted| (c.interval[0]..=c.interval[1]).contains(&c.truth);
        let held = mean(mine.iter().map(|c| f64::from(u8::from(inside(c)))));
        let width = mean(mine.iter().map(|c| (c.interval[1] - c.interval[0]) / c.truth.max(1.0)));
        let share = |set: &[&Counted], of: fn(&Counted) -> f64| {
            set.iter().map(|c| of(c)).sum::<f64>()
                / set.iter().map(|c| c.found).sum::<f64>().max(1.0)
        };
        let confidence = share(&mine, |c| c.confidence);
        let other_sets: Vec<Vec<&Counted>> = names
            .iter()
            .filter(|other| *other != name && !OUT_OF_REACH.contains(*other))
            .map(|other| all.iter().filter(|c| c.set == *other).collect())
            .collect();
        let holds = |wider: f64| mean(other_sets.iter().map(|set| coverage(set, wider)[0]));
        let mut factors = (5..).map(|k| 0.1 * f64::from(k)).take_while(|factor| *factor < WIDEST);
        let fitted = factors.find(|&factor| holds(factor) >= 0.95).unwrap_or(WIDEST);
        let [held_out, width_out] = coverage(&mine, fitted);
        let fit: Vec<&Counted> = other_sets.into_iter().flatten().collect();
        let placed = share(&fit, |c| c.right) / share(&fit, |c| c.confidence);
        let _ = writeln!(
            sure,
            "| {name} | {held:.2} | {width:.2} | {confidence:.3} | {:.3} | {fitted:.1} | {held_out:.2} | {width_out:.2} | {:.3} |",
            share(&mine, |c| c.right),
            (confidence * placed).min(1.0),
        );
    }
    text + &sure + "\n"
}

/// A line for each photo under a line of names.
fn photos_table(all: &[Counted]) -> Vec<Vec<String>> {
    let names = ["set", "photo", "truth", "found", "right", "confidence", "low", "high"];
    let lines = all.iter().map(|c| {
        let numbers = [c.truth, c.found, c.right, c.confidence, c.interval[0], c.interval[1]];
        let numbers = numbers.map(|x| format!("{x:.2}"));
        [c.set.to_owned(), c.photo.clone()].into_iter().chain(numbers).collect()
    });
    std::iter::once(names.map(str::to_owned).to_vec()).chain(lines).collect()
}

/// Share of the pixels that are leaf in either mask which are in both.
fn overlap(found: &Mask, truth: &[bool]) -> f64 {
    let pairs = || found.data.iter().zip(truth);
    let both = pairs().filter(|(f, t)| **f != 0 && **t).count();
    let any = pairs().filter(|(f, t)| **f != 0 || **t).count();
    both as f64 / any.max(1) as f64
}

/// A photo as its metadata say that it is to be seen, which is how masks were drawn; the program takes pixels as stored.
fn upright(path: &Path, photo: RgbImage) -> RgbImage {
    let reader = ImageReader::open(path).ok().and_then(|file| file.with_guessed_format().ok());
    let decoder = reader.and_then(|reader| reader.into_decoder().ok());
    let orientation = decoder.and_then(|mut decoder| decoder.orientation().ok());
    let mut picture = DynamicImage::from(photo);
    picture.apply_orientation(orientation.unwrap_or(Orientation::NoTransforms));
    picture.into_rgb8()
}

/// The true mask of a photo.
fn mask_of(folder: &Path, photo: &Path, suffix: &str) -> PathBuf {
    let stem = photo.file_stem().map(|s| s.to_string_lossy().into_owned());
    folder.join(format!("{}{suffix}.png", stem.unwrap_or_default()))
}

fn masks_table(data: &Path, every: usize) -> Result<String, Error> {
    let mut text =
        "## Leaf masks, defaults\n\nMean over photos of the intersection over union.\n\n\
         | set | photos | default | excess green + Otsu | a* + Otsu |\n|---|---|---|---|---|\n"
            .to_owned();
    for (name, root, [pictures, masks], suffix) in [
        ("wheat_ews", data.join("plants/wheat_ews"), ["images", "truth"], ".mask"),
        ("rice_paddy", data.join("plants/rice_paddy"), ["images", "truth"], ".mask"),
        ("seg_rgbweed", data.join("seg_rgbweed"), ["Images", "Vegetation_Masks"], ""),
    ] {
        let photos: Vec<PathBuf> = files(&root.join(pictures))?
            .into_iter()
            .filter(|path| mask_of(&root.join(masks), path, suffix).exists())
            .step_by(every)
            .collect();
        let scores: Vec<[f64; 3]> = photos
            .par_iter()
            .map(|path| {
                let mask = mask_of(&root.join(masks), path, suffix);
                let photo = upright(path, images::read_photo(path)?);
                let grey = images::read_grey(&mask)?;
                if grey.dimensions() != photo.dimensions() {
                    let (found, expected) = (grey.dimensions(), photo.dimensions());
                    let message = format!("a mask of {found:?} pixels, expected {expected:?}");
                    return Err(FileError::malformed(&mask, None, message).into());
                }
                let truth: Vec<bool> = grey.pixels().map(|pixel| pixel.0[0] > 127).collect();
                let found = [vegetation_of(&photo), excess_green(&photo), green_of_lab(&photo)];
                Ok(found.map(|mask| overlap(&mask, &truth)))
            })
            .collect::<Result<_, Error>>()?;
        let of = |k: usize| mean(scores.iter().map(|score| score[k]));
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "| {name} | {} | {:.3} | {:.3} | {:.3} |",
            scores.len(),
            of(0),
            of(1),
            of(2)
        );
    }
    Ok(text)
}

fn leaves_table(data: &Path, every: usize) -> Result<String, Error> {
    let mut text = "\n## Leaves of rosettes\n\nSymmetric best Dice, and mean absolute error of the number of leaves.\n\n\
         | mask | method | SBD | number |\n|---|---|---|---|\n"
        .to_owned();
    let all = files(&data.join("leaf_cvppp_a1"))?;
    let labels: Vec<&PathBuf> = all
        .iter()
        .filter(|path| path.to_string_lossy().ends_with("_label.png"))
        .step_by(every)
        .collect();
    let rivals = [
        ("default", leaves::Method::Slices(LeafOptions::default())),
        ("watershed, markers 3 widths apart", leaves::Method::Watershed(3.0)),
    ];
    for own in [false, true] {
        for (name, how) in &rivals {
            let runs: Vec<leaves::Run> = labels
                .par_iter()
                .map(|path| {
                    let (truth, mut mask) = leaves::classes(path)?;
                    if own {
                        let photo = path.to_string_lossy().replace("_label", "_rgb");
                        mask = vegetation_of(&images::read_colour(Path::new(&photo))?);
                    }
                    Ok(leaves::judge(&leaves::segment(&mask, how), &truth))
                })
                .collect::<Result<_, Error>>()?;
            // Writing to a string does not fail.
            let _ = writeln!(
                text,
                "| {} | {name} | {:.3} | {:.1} |",
                if own { "own" } else { "true" },
                mean(runs.iter().map(|run| run.sbd)),
                mean(runs.iter().map(|run| (run.found - run.truth).abs()))
            );
        }
    }
    Ok(text)
}

#[expect(clippy::print_stderr, reason = "what the tables lack is said")]
fn left_out(error: &FileError) {
    eprintln!("left out: {error}");
}

#[expect(clippy::print_stdout, reason = "the tables are the output")]
pub(crate) fn show(text: &str) {
    println!("{text}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_counts() {
        let [mape, mae, rmse, r2] = errors(&[(10.0, 11.0), (20.0, 17.0)]);
        assert!((mape - 12.5).abs() < 1e-9 && (mae - 2.0).abs() < 1e-9, "{mape} {mae}");
        assert!((rmse - 5f64.sqrt()).abs() < 1e-9 && (r2 - 0.8).abs() < 1e-9, "{rmse} {r2}");
    }
}
