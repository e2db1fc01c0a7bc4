//! `rowgram leaves`, `leaf-count`, `leaf-density` and `thresholds`, and GeoTIFF in and out, as a user meets them.

use crate::{data, maps, program::rowgram};
use image::{GrayImage, Luma, Rgb, RgbImage};
use rowgram::{
    io::geotiff::{self, Colour, Layout, Reader},
    io::{FileError, images},
    raster::{
        georeference::{Crs, Georeference},
        window::Window,
    },
};
use std::path::Path;

const SOIL: Rgb<u8> = Rgb([150, 120, 90]);
const LEAF: Rgb<u8> = Rgb([70, 160, 60]);

/// Two leaves that cross, and one apart.
fn leaf(u: u32, v: u32) -> bool {
    let (u, v) = (f64::from(u), f64::from(v));
    let crossing =
        (10.0..90.0).contains(&u) && ((v - u).abs() < 4.0 || (v + u - 100.0).abs() < 4.0);
    crossing || ((110.0..150.0).contains(&u) && (v - 30.0).abs() < 2.6)
}

fn mask_png(folder: &Path) {
    let mask = GrayImage::from_fn(170, 110, |u, v| Luma([if leaf(u, v) { 255 } else { 0 }]));
    mask.save(folder.join("mask.png")).unwrap();
}

/// The same as a photo in a GeoTIFF of 1 cm pixels.
fn ortho(path: &Path) {
    let place = Georeference::north_up([500_000.0, 4_475_000.0], 0.01, Crs::projected(32616));
    let picture = RgbImage::from_fn(170, 110, |u, v| if leaf(u, v) { LEAF } else { SOIL });
    maps::write(path, &picture, place);
}

fn rows(path: &Path) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().map(|line| line.split(',').map(str::to_owned).collect()).collect()
}

#[test]
fn leaves_of_a_mask_are_measured_in_pixels_and_said_so() {
    let folder = tempfile::tempdir().unwrap();
    mask_png(folder.path());
    let run = rowgram(
        folder.path(),
        "leaves mask.png -o leaves.csv --labels labels.tif --figures figures",
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stderr.contains("lengths are in pixels"), "{}", run.stderr);
    let table = rows(&folder.path().join("leaves.csv"));
    assert_eq!(table.len(), 4, "{table:?}");
    assert!(!table[0].contains(&"length_m".to_owned()));
    let column = table[0].iter().position(|name| name == "length_px").unwrap();
    let mut lengths: Vec<f64> = table[1..].iter().map(|row| row[column].parse().unwrap()).collect();
    lengths.sort_by(f64::total_cmp);
    // Ends are cut along the columns; a pixel or two more or less.
    assert!((lengths[0] - 40.0).abs() < 4.0 && (lengths[1] - 113.0).abs() < 8.0, "{lengths:?}");
    let labels = Reader::open(&folder.path().join("labels.tif")).unwrap();
    let labels: Vec<u32> = labels.read(Window::whole(170, 110)).unwrap();
    for v in 0..110 {
        for u in 0..170 {
            assert_eq!(labels[(v * 170 + u) as usize] > 0, leaf(u, v));
        }
    }
    assert_eq!(labels.iter().max(), Some(&3));
}

#[test]
fn leaves_of_an_orthomosaic_are_on_the_map_and_belong_to_plants() {
    let folder = tempfile::tempdir().unwrap();
    ortho(&folder.path().join("ortho.tif"));
    std::fs::write(folder.path().join("plants.csv"), "u_px,v_px\n8,8\n8,92\n108,30\n").unwrap();
    let command = "leaves ortho.tif --hsv 30,79,30,163 -o leaves.geojson --plants plants.csv --per-plant counts.csv --json";
    let run = rowgram(folder.path(), command);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let summary: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!((summary["leaves"].as_u64(), summary["gsd_m"].as_f64()), (Some(3), Some(0.01)));
    let text = std::fs::read_to_string(folder.path().join("leaves.geojson")).unwrap();
    let map: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(map["crs"]["properties"]["name"], "urn:ogc:def:crs:EPSG::32616");
    for feature in map["features"].as_array().unwrap() {
        let first = &feature["geometry"]["coordinates"][0];
        assert!((first[0].as_f64().unwrap() - 500_000.85).abs() < 1.0, "{first}");
        assert!((first[1].as_f64().unwrap() - 4_474_999.5).abs() < 0.75, "{first}");
        let of = |name: &str| feature["properties"][name].as_f64().unwrap();
        assert!((of("length_m") - 0.01 * of("length_px")).abs() < 1e-3);
        // LEAF has a hue of 114 degrees.
        assert!((of("hue_deg") - 114.0).abs() < 2.0);
    }
    let counts = rows(&folder.path().join("counts.csv"));
    let leaves: Vec<&str> = counts.iter().map(|row| row[3].as_str()).collect();
    assert_eq!(leaves, ["leaves", "1", "1", "1"]);
}

#[test]
fn areas_larger_than_any_leaf_are_no_leaves() {
    let folder = tempfile::tempdir().unwrap();
    ortho(&folder.path().join("ortho.tif"));
    let command = "leaves ortho.tif --hsv 30,79,30,163 -o leaves.csv --gsd-m 0.05 --json";
    let run = rowgram(folder.path(), command);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stderr.contains("no single leaf is told apart"), "{}", run.stderr);
    let summary: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(summary["leaves"], 0);
    assert!(summary["median_length_m"].is_null() && summary["usual_width_px"].as_f64() > Some(1.0));
    assert_eq!(rows(&folder.path().join("leaves.csv")).len(), 1);
}

#[test]
fn windows_and_whole_pictures_give_the_same() {
    let folder = tempfile::tempdir().unwrap();
    ortho(&folder.path().join("ortho.tif"));
    RgbImage::from_fn(170, 110, |u, v| if leaf(u, v) { LEAF } else { SOIL })
        .save(folder.path().join("photo.png"))
        .unwrap();
    for image in ["ortho.tif", "photo.png"] {
        let run = rowgram(
            folder.path(),
            &format!("segment {image} --hsv 30,79,30,163 -o {image}.mask.png"),
        );
        assert_eq!(run.code, 0, "{}", run.stderr);
        let run = rowgram(
            folder.path(),
            &format!("segment {image} --hsv 30,79,30,163 -o {image}.mask.tif"),
        );
        assert_eq!(run.code, 0, "{}", run.stderr);
    }
    let whole = images::read_mask(&folder.path().join("photo.png.mask.png")).unwrap();
    for name in ["ortho.tif.mask.png", "ortho.tif.mask.tif", "photo.png.mask.tif"] {
        assert!(images::read_mask(&folder.path().join(name)).unwrap() == whole, "{name}");
    }
    let place = Reader::open(&folder.path().join("ortho.tif.mask.tif")).unwrap().georeference();
    assert_eq!(place.unwrap().crs, Crs::projected(32616));
}

#[test]
fn masks_without_and_with_nothing_but_plants_work_and_what_is_no_mask_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let of = |name: &str, value: u8| {
        GrayImage::from_pixel(30, 20, Luma([value])).save(folder.path().join(name)).unwrap();
        rowgram(folder.path(), &format!("leaves {name} --shape blade -o {name}.csv"))
    };
    let empty = of("empty.png", 0);
    assert_eq!(empty.code, 0, "{}", empty.stderr);
    assert_eq!(rows(&folder.path().join("empty.png.csv")).len(), 1);
    // Nothing but plants is taken for a mask whose values are exchanged.
    let full = of("full.png", 255);
    assert!(full.code == 2 && full.stderr.contains("exchanged"), "{}", full.stderr);
    // A grey raster of many values is neither a mask nor a photo in colours.
    let layout =
        Layout { width: 20, height: 10, colour: Colour::Values, georeference: None, nodata: None };
    geotiff::write::<f32, FileError>(
        &folder.path().join("heights.tif"),
        false,
        &layout,
        |writer| {
            let heights: Vec<f32> = (0..200u8).map(f32::from).collect();
            writer.put(Window::whole(20, 10), &heights)
        },
    )
    .unwrap();
    let run = rowgram(folder.path(), "leaves heights.tif -o heights.csv");
    assert_eq!(run.code, 2);
    assert!(
        run.stderr.contains("heights.tif") && run.stderr.contains("expected a mask"),
        "{}",
        run.stderr
    );
    let run = rowgram(folder.path(), "leaves empty.png -o leaves.shp");
    assert!(run.code == 2 && run.stderr.contains(".gpkg or .geojson or .csv"), "{}", run.stderr);
    let run = rowgram(folder.path(), "leaves empty.png -o leaves.csv --edge-angle-rad 4");
    assert!(
        run.code == 2 && run.stderr.contains("expected a number from 0 to 3.14"),
        "{}",
        run.stderr
    );
}

#[test]
fn a_geopackage_holds_leaves_and_plants_on_the_map() {
    let folder = tempfile::tempdir().unwrap();
    ortho(&folder.path().join("ortho.tif"));
    std::fs::write(folder.path().join("plants.csv"), "u_px,v_px\n30,50\n120,50\n").unwrap();
    for output in ["leaves.gpkg", "leaves.csv"] {
        let run = rowgram(
            folder.path(),
            &format!("leaves ortho.tif --hsv 30,79,30,163 -o {output} --plants plants.csv"),
        );
        assert_eq!(run.code, 0, "{}", run.stderr);
    }
    let table = rows(&folder.path().join("leaves.csv"));
    let file = rusqlite::Connection::open(folder.path().join("leaves.gpkg")).unwrap();
    let text = |sql: &str| file.query_row(sql, [], |row| row.get::<_, String>(0)).unwrap();
    let number = |sql: &str| file.query_row(sql, [], |row| row.get::<_, f64>(0)).unwrap();
    assert_eq!(number("SELECT count(*) * 1.0 FROM leaves") as usize, table.len() - 1);
    assert_eq!(number("SELECT sum(leaves) * 1.0 FROM plants") as usize, table.len() - 1);
    assert_eq!(
        text("SELECT geometry_type_name FROM gpkg_geometry_columns WHERE table_name = 'leaves'"),
        "LINESTRING"
    );
    let column = |name: &str| table[0].iter().position(|column| column == name).unwrap();
    for name in ["length_m", "x", "area_px"] {
        let expected: f64 = table[1][column(name)].parse().unwrap();
        let found = number(&format!("SELECT {name} * 1.0 FROM leaves WHERE fid = 1"));
        assert!((found - expected).abs() < 1e-9, "{name}: {found} {expected}");
    }
    let [low, x, high] = ["min_x", "(SELECT x FROM leaves WHERE fid = 1)", "max_x"].map(|what| {
        number(&format!("SELECT {what} FROM gpkg_contents WHERE table_name = 'leaves'"))
    });
    assert!(low <= x && x <= high, "{low} {x} {high}");
}

#[test]
fn the_number_of_threads_changes_no_byte() {
    let folder = tempfile::tempdir().unwrap();
    ortho(&folder.path().join("ortho.tif"));
    let files = [1, 2, 3].map(|n| {
        let command =
            format!("leaves ortho.tif -o {n}.csv --labels {n}.tif --figures {n} --threads {n}");
        assert_eq!(rowgram(folder.path(), &command).code, 0);
        [format!("{n}.csv"), format!("{n}.tif"), format!("{n}/leaves.png")]
            .map(|name| std::fs::read(folder.path().join(name)).unwrap())
    });
    assert!(files[0] == files[1] && files[1] == files[2]);
}

#[test]
fn leaves_are_counted_from_area() {
    let folder = tempfile::tempdir().unwrap();
    mask_png(folder.path());
    let plots = r#"{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"name":"right","leaves":1},
        "geometry":{"type":"Polygon","coordinates":[[[100,0],[169.5,0],[169.5,109],[100,109]]]}}]}"#;
    std::fs::write(folder.path().join("plots.geojson"), plots).unwrap();
    let run = rowgram(
        folder.path(),
        "leaves count mask.png --regions plots.geojson --plots plots.geojson -o counts.csv --json",
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stderr.contains("may not be orthorectified"), "{}", run.stderr);
    let summary: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    // The leaf that stands alone has 5 rows of 40 pixels.
    assert_eq!(summary["rho_px"].as_f64(), Some(200.0));
    let counts = rows(&folder.path().join("counts.csv"));
    assert_eq!((counts[2][0].as_str(), counts[2][2].as_str()), ("right", "1.000"));
    let run = rowgram(folder.path(), "leaves count mask.png --rho-px -3 -o c.csv");
    assert!(
        run.code == 2 && run.stderr.contains("expected a number greater than 0"),
        "{}",
        run.stderr
    );
    let run = rowgram(folder.path(), "leaves count mask.png -o c.csv");
    assert_eq!(run.code, 2);
}

#[test]
fn the_density_is_the_number_of_plants_in_the_window() {
    let folder = tempfile::tempdir().unwrap();
    mask_png(folder.path());
    let run = rowgram(
        folder.path(),
        "leaves density mask.png --window-px 5 -o density.tif --figures figures",
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let found: Vec<u32> = Reader::open(&folder.path().join("density.tif"))
        .unwrap()
        .read(Window::whole(170, 110))
        .unwrap();
    for (u, v) in [(0u32, 0u32), (12, 12), (50, 50), (169, 109), (130, 28)] {
        let count = (v.saturating_sub(2)..=(v + 2).min(109))
            .flat_map(|y| (u.saturating_sub(2)..=(u + 2).min(169)).map(move |x| (x, y)))
            .filter(|&(x, y)| leaf(x, y))
            .count();
        assert_eq!(found[(v * 170 + u) as usize] as usize, count, "{u} {v}");
    }
    let run = rowgram(folder.path(), "leaves density mask.png --window-px 4 -o other.tif");
    assert!(run.code == 2 && run.stderr.contains("expected an odd number"), "{}", run.stderr);
}

#[test]
fn thresholds_are_proposed_tuned_and_drawn() {
    let folder = tempfile::tempdir().unwrap();
    mask_png(folder.path());
    RgbImage::from_fn(170, 110, |u, v| {
        let noise = ((u * 7 + v * 11) % 13) as u8;
        let Rgb([r, g, b]) = if leaf(u, v) { LEAF } else { SOIL };
        Rgb([r + noise, g, b + noise / 2])
    })
    .save(folder.path().join("photo.png"))
    .unwrap();
    let run = rowgram(folder.path(), "segment thresholds photo.png --figures proposed");
    assert!(run.code == 0 && run.stdout.contains("(proposed)"), "{} {}", run.stdout, run.stderr);
    let run = rowgram(
        folder.path(),
        "segment thresholds photo.png --masks mask.png --figures figures --json",
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let summary: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(summary["judged"][0]["iou"].as_f64(), Some(1.0));
    for name in [
        "proposed/histograms.svg",
        "figures/histograms.csv",
        "figures/sweeps.svg",
        "figures/sweeps.csv",
    ] {
        assert!(folder.path().join(name).exists(), "{name}");
    }
    // A mask with softened edges is split at half of its white.
    image::GrayImage::from_fn(170, 110, |u, v| {
        image::Luma([if leaf(u, v) { 255 - (u % 2) as u8 * 60 } else { (v % 3) as u8 * 40 }])
    })
    .save(folder.path().join("soft.png"))
    .unwrap();
    let run = rowgram(folder.path(), "segment thresholds photo.png --masks soft.png --json");
    let summary: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(summary["judged"][0]["iou"].as_f64(), Some(1.0));
    let run = rowgram(folder.path(), "segment thresholds photo.png photo.png --masks mask.png");
    assert!(run.code == 2 && run.stderr.contains("expected one for each"), "{}", run.stderr);
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn real_pictures_are_read() {
    let Some(path) = data::path("leaf_cvppp_a1/plant001_fg.png") else { return };
    let folder = tempfile::tempdir().unwrap();
    let run = rowgram(folder.path(), &format!("leaves {} -o leaves.csv --json", path.display()));
    assert_eq!(run.code, 0, "{}", run.stderr);
    let summary: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert!(summary["leaves"].as_u64().unwrap() >= 2);
}
