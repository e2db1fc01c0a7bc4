//! `rowgram surface dem` from points of a known surface.

use super::{EAST_M, NORTH_M, run};
use crate::program::rowgram;
use rowgram::{
    io::geotiff::Reader,
    raster::{georeference::Crs, window::Window},
};
use std::fs;

#[test]
fn points_become_a_surface_with_its_uncertainty() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let mut csv = "point,x_m,y_m,z_m,sigma_x_m,sigma_y_m,sigma_z_m\n".to_owned();
    // A slope with plants of 0.6 m on a third of the points and one wild point.
    for k in 0..3000 {
        let (x, y) =
            (30.0 * (k as f64 * 0.754_877_666).fract(), 30.0 * (k as f64 * 0.569_840_291).fract());
        let plant = if k % 3 == 0 { 0.6 } else { 0.0 };
        let wild = if k == 1500 { 40.0 } else { 0.0 };
        let z = 100.0 + 0.05 * x + plant + wild;
        csv += &format!("{k},{:.4},{:.4},{z:.4},0.01,0.01,0.03\n", EAST_M + x, NORTH_M + y);
    }
    fs::write(at.join("points.csv"), csv).unwrap();
    let text = run(
        at,
        "surface dem --points points.csv --crs EPSG:32616 --cell-m 0.25 -o dem.tif --figures pictures --json -q",
    );
    let report: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert!(report["outliers"].as_array().unwrap().contains(&1500.into()), "{report}");
    let grid = |name: &str| {
        let reader = Reader::open(&at.join(name)).unwrap();
        assert_eq!(reader.georeference().unwrap().crs, Crs::projected(32616));
        let values = reader.read_f32(Window::whole(reader.width(), reader.height())).unwrap();
        (reader.georeference().unwrap(), reader.width(), values)
    };
    let (place, width, surface) = grid("dem.tif");
    let (_, _, sigma) = grid("dem_sigma.tif");
    let mut off = Vec::new();
    for (k, &z) in surface.iter().enumerate().filter(|(_, z)| z.is_finite()) {
        let [x, _] = place.map([(k % width) as f64, (k / width) as f64]);
        off.push(f64::from(z) - 100.0 - 0.05 * (x - EAST_M));
        assert!((0.005..=0.0301).contains(&sigma[k]), "{}", sigma[k]);
    }
    off.sort_by(f64::total_cmp);
    // From the soil to the tops of the plants; the wild point is left out.
    assert!(off[0] > -0.05 && off[off.len() - 1] < 0.65, "{:?} {:?}", off[0], off.last());
    assert!(off[off.len() / 10] < 0.2 && off[off.len() * 9 / 10] > 0.2, "{}", off[off.len() / 2]);
    assert!(at.join("pictures/hillshade.png").is_file() && at.join("pictures/sigma.png").is_file());
    let none = rowgram(at, "surface dem --points points.csv -o dem.tif");
    assert!(none.code == 2 && none.stderr.contains("--force"), "{}", none.stderr);
    let auto = rowgram(at, "surface dem --points points.csv -o more.tif --extend-m auto");
    assert!(auto.code == 2 && auto.stderr.contains("expected metres"), "{}", auto.stderr);
    let text = run(
        at,
        "surface dem --points points.csv --crs EPSG:32616 --cell-m 0.25 --extend-m 5 -o more.tif --json -q",
    );
    let more: serde_json::Value = serde_json::from_str(&text).unwrap();
    let cells = |of: &serde_json::Value, key: &str| of[key].as_u64().unwrap();
    assert_eq!(cells(&report, "continued_cells"), 0);
    assert_eq!(
        cells(&more, "cells_with_height"),
        cells(&more, "width_px") * cells(&more, "height_px")
    );
    assert!(cells(&more, "continued_cells") > cells(&report, "cells_with_height") / 2, "{more}");
    let (place, width, surface) = grid("more.tif");
    let (_, _, sigma) = grid("more_sigma.tif");
    for (k, &z) in surface.iter().enumerate().filter(|&(k, _)| sigma[k].is_nan()) {
        let [x, _] = place.map([(k % width) as f64, (k / width) as f64]);
        let off = f64::from(z) - 100.0 - 0.05 * (x - EAST_M);
        // Between the soil and the tops of the plants, as the heights nearest are.
        assert!((-0.15..0.75).contains(&off), "{off}");
    }
}

#[test]
fn a_surface_can_go_as_far_as_photos_show_ground() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    run(at, "synth flight --preset small --no-photos -o field -q");
    let made = |extend: &str| -> serde_json::Value {
        let arguments = format!(
            "surface dem --model field/model --cell-m 0.5 --extend-m {extend} -o {extend}.tif --json -q"
        );
        serde_json::from_str(&run(at, &arguments)).unwrap()
    };
    let (points, photos) = (made("0"), made("auto"));
    let side = |of: &serde_json::Value, key: &str| of[key].as_f64().unwrap() * 0.5;
    for key in ["width_px", "height_px"] {
        // Photos of 15 m x 11 m overlap by 60 %: beyond the points there is up to half of one on either side.
        let more = side(&photos, key) - side(&points, key);
        assert!((2.0..15.0).contains(&more), "{key}: {more}");
    }
    let cells = |key: &str| photos[key].as_u64().unwrap();
    assert_eq!(cells("cells_with_height"), cells("width_px") * cells("height_px"));
    assert!(cells("continued_cells") > 0);
}
