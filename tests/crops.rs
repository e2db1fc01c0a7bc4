//! `rowgram plots crops`: plots in the photos themselves.

use crate::program::rowgram;
use rowgram::io::csv_table::CsvTable;
use serde_json::Value;
use std::{collections::BTreeSet, fs, path::Path};

/// Cuts the plots of a project that was run, and compares what the photos say with what the orthomosaic says.
pub fn assert_photos_agree_with_the_map(project: &Path) {
    let parent = project.parent().unwrap();
    let name = project.file_name().unwrap().to_str().unwrap();
    let run =
        rowgram(parent, &format!("plots crops {name} -q --json --as-taken --photos-per-plot 4"));
    assert_eq!(run.code, 0, "{}", run.stderr);
    let outcome: Value = serde_json::from_str(&run.stdout).unwrap();
    let crops = outcome["crops"].as_array().unwrap();
    // Photos of 15 m x 11 m show few plots of 8 m x 4 m whole; every other one is named.
    assert!(!crops.is_empty(), "{outcome}");
    let plots: BTreeSet<&str> = crops.iter().map(|crop| crop["plot"].as_str().unwrap()).collect();
    assert_eq!(plots.len() + outcome["without_photo"].as_array().unwrap().len(), 8, "{outcome}");
    let folder = project.join("rowgram/crops");
    for crop in crops {
        let file = folder.join(crop["file"].as_str().unwrap());
        let picture = image::open(&file).unwrap().into_rgb8();
        let size = [picture.width(), picture.height()];
        assert_eq!(serde_json::json!(size), crop["size_px"], "{crop}");
        assert!(picture.pixels().all(|pixel| pixel.0 != [0; 3]), "the whole plot is shown: {crop}");
        // The plot is inside the part as it was taken, too.
        let part = image::open(folder.join(crop["as_taken"].as_str().unwrap())).unwrap();
        let from = crop["as_taken_from_px"].as_array().unwrap();
        for corner in crop["photo_polygon_px"][0].as_array().unwrap() {
            for (axis, length) in [(0, part.width()), (1, part.height())] {
                let at = corner[axis].as_f64().unwrap() - from[axis].as_f64().unwrap();
                assert!((-0.5..=f64::from(length)).contains(&at), "{crop}");
            }
        }
        let world = fs::read_to_string(file.with_extension("pgw")).unwrap();
        let numbers: Vec<f64> = world.lines().map(|line| line.parse().unwrap()).collect();
        let gsd_m = outcome["gsd_m"].as_f64().unwrap();
        assert_eq!(numbers.len(), 6);
        approx::assert_abs_diff_eq!(numbers[0].hypot(numbers[1]), gsd_m, epsilon = 1e-9);
    }
    // Cover by photos against cover by the map, of plots that are in both.
    let of_map = CsvTable::read(&project.join("rowgram/plots/traits.csv")).unwrap();
    let of_photos = CsvTable::read(&folder.join("traits.csv")).unwrap();
    let named = |table: &CsvTable, column: &str| -> std::collections::BTreeMap<String, f64> {
        let names = table.texts("plot").unwrap().into_iter().map(str::to_owned);
        names.zip(table.numbers(column).unwrap()).collect()
    };
    let (map, photos) = (named(&of_map, "canopy_cover"), named(&of_photos, "canopy_cover"));
    let scatter = named(&of_photos, "canopy_cover_sd");
    assert!(!photos.is_empty());
    for (plot, cover) in &photos {
        assert!(
            (cover - map[plot]).abs() < 0.05,
            "{plot}: {cover} in photos, {} on the map",
            map[plot]
        );
        // A single photo has no scatter.
        assert!(scatter[plot].is_nan() || scatter[plot] < 0.05, "{plot}: {}", scatter[plot]);
    }
    assert_comparison_agrees(project, &plots);
    let again = rowgram(parent, &format!("plots crops {name} -q"));
    assert_eq!(again.code, 2, "what is there is not replaced: {}", again.stderr);
    assert!(again.stderr.contains("--force"), "{}", again.stderr);
}

/// Most that a trait of a plot may differ between photos and orthomosaic, in the unit of the trait. Both see the same leaves through the
/// same leaf rule; what is left are the colours that drawing the map balances and the direction from which a leaf is seen.
/// The one plot that a photo shows whole differs by 0.010 in cover, at most 0.005 in indices and 0.22 in a*: the bounds are four to nine times that.
const MAX_DIFFERENCE: [(&str, f64); 7] = [
    ("canopy_cover", 0.05),
    ("exg", 0.02),
    ("gli", 0.02),
    ("ngrdi", 0.02),
    ("vari", 0.03),
    ("tgi", 0.02),
    ("a_star", 1.5),
];

/// `comparison.csv` has every trait of every plot that photos show, and the two sources agree.
fn assert_comparison_agrees(project: &Path, plots: &BTreeSet<&str>) {
    let table = CsvTable::read(&project.join("rowgram/crops/comparison.csv")).unwrap();
    let [names, traits] = ["plot", "trait"].map(|column| table.texts(column).unwrap());
    let [map, photos, mean, difference] =
        ["orthomosaic", "photos", "photos_mean", "difference"].map(|of| table.numbers(of).unwrap());
    let rows: BTreeSet<(&str, &str)> =
        names.iter().zip(&traits).map(|(plot, of)| (*plot, *of)).collect();
    let expected: BTreeSet<(&str, &str)> = plots
        .iter()
        .flat_map(|plot| MAX_DIFFERENCE.iter().map(move |(of, _)| (*plot, *of)))
        .collect();
    assert_eq!(rows, expected, "every trait of every plot once");
    assert_eq!(table.len(), rows.len());
    for k in 0..table.len() {
        let of =
            format!("{} of {}: {} on the map, {} in photos", traits[k], names[k], map[k], mean[k]);
        assert!([map[k], mean[k], difference[k]].iter().all(|x| x.is_finite()), "{of}");
        assert!((1.0..=4.0).contains(&photos[k]), "{of}: {} photos", photos[k]);
        // Six decimals of each.
        approx::assert_abs_diff_eq!(difference[k], mean[k] - map[k], epsilon = 2e-6);
        let (_, most) = MAX_DIFFERENCE.iter().find(|(name, _)| *name == traits[k]).unwrap();
        assert!(difference[k].abs() < *most, "{of}");
    }
}
