//! `rowgram crops`: plots in the photos themselves.

use crate::program::rowgram;
use rowgram::io::csv_table::CsvTable;
use serde_json::Value;
use std::{fs, path::Path};

/// Cuts the plots of a project that was run, and compares what the photos say with what the orthomosaic says.
pub fn assert_photos_agree_with_the_map(project: &Path) {
    let parent = project.parent().unwrap();
    let name = project.file_name().unwrap().to_str().unwrap();
    let run = rowgram(parent, &format!("crops {name} -q --json --as-taken --photos-per-plot 4"));
    assert_eq!(run.code, 0, "{}", run.stderr);
    let outcome: Value = serde_json::from_str(&run.stdout).unwrap();
    let crops = outcome["crops"].as_array().unwrap();
    // Photos of 15 m x 11 m show few plots of 8 m x 4 m whole; every other one is named.
    assert!(!crops.is_empty(), "{outcome}");
    let plots: std::collections::BTreeSet<&str> =
        crops.iter().map(|crop| crop["plot"].as_str().unwrap()).collect();
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
    let again = rowgram(parent, &format!("crops {name} -q"));
    assert_eq!(again.code, 2, "what is there is not replaced: {}", again.stderr);
    assert!(again.stderr.contains("--force"), "{}", again.stderr);
}
