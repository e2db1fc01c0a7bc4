//! The dense surface of a run against the truth of its synthetic field.

use rowgram::{
    io::geotiff::Reader, mapping::Surface, pipeline::dem::read_surface, raster::window::Window,
};
use std::path::Path;

/// How a surface compares with the true one.
#[derive(Debug)]
struct Quality {
    /// Share of the cells that two photos show with a height.
    known: f64,
    /// Spread (robust standard deviation) of the errors of bare soil, metres.
    bare_nmad_m: f64,
    /// Median error of bare soil, metres.
    bare_bias_m: f64,
    /// Share of leaf cells within 5 cm of the true top.
    leaves_within: f64,
    /// Error of the 95th percentile of the height over the ground of squares of 2 m: mean, and standard deviation, metres.
    height_m: [f64; 2],
    /// Root mean square error of the ground, metres.
    ground_rmse_m: f64,
}

fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

fn heights(path: &Path) -> Surface {
    read_surface(path).unwrap()
}

fn compare(project: &Path) -> Quality {
    let found = |name: &str| heights(&project.join("rowgram/surface").join(name));
    let (surface, ground, canopy) = (found("dsm.tif"), found("dtm.tif"), found("chm.tif"));
    let truth = heights(&project.join("truth/dsm.tif"));
    let above = heights(&project.join("truth/chm.tif"));
    let seen = Reader::open(&project.join("rowgram/surface/photos.tif")).unwrap();
    let seen = seen.read_f32(Window::whole(surface.width, surface.height)).unwrap();
    let mut squares = std::collections::BTreeMap::<[i64; 2], (Vec<f64>, Vec<f64>)>::new();
    let (mut bare, mut leaves, mut off_ground) = (Vec::new(), Vec::new(), Vec::new());
    let (mut shown, mut known) = (0, 0);
    for at in 0..surface.width * surface.height {
        let place =
            surface.georeference.map([(at % surface.width) as f64, (at / surface.width) as f64]);
        let (Some(top), Some(height)) = (truth.at(place), above.at(place)) else { continue };
        if seen[at] < 2.0 {
            continue;
        }
        shown += 1;
        let off = f64::from(surface.heights_m[at]) - top;
        if !off.is_finite() {
            continue;
        }
        known += 1;
        if height == 0.0 {
            bare.push(off);
        } else if height > 0.02 {
            leaves.push(off);
        }
        off_ground.push((f64::from(ground.heights_m[at]) - (top - height)).powi(2));
        let square = squares.entry(place.map(|c| (c / 2.0).floor() as i64)).or_default();
        square.0.push(f64::from(canopy.heights_m[at]));
        square.1.push(height);
    }
    let p95 = |values: &mut Vec<f64>| {
        let at = (0.95 * (values.len() - 1) as f64).round() as usize;
        *values.select_nth_unstable_by(at, f64::total_cmp).1
    };
    let whole = (1.6 / (surface.cell_m() * surface.cell_m())) as usize;
    let off: Vec<f64> = squares
        .values_mut()
        .filter(|(found, _)| found.len() > whole)
        .map(|(found, truth)| p95(found) - p95(truth))
        .collect();
    let mean = off.iter().sum::<f64>() / off.len() as f64;
    let spread = off.iter().map(|o| (o - mean).powi(2)).sum::<f64>() / (off.len() - 1) as f64;
    let bias = median(&mut bare);
    let mut away: Vec<f64> = bare.iter().map(|off| (off - bias).abs()).collect();
    let within = leaves.iter().filter(|off| off.abs() < 0.05).count();
    Quality {
        known: f64::from(known) / f64::from(shown),
        bare_nmad_m: 1.4826 * median(&mut away),
        bare_bias_m: bias,
        leaves_within: within as f64 / leaves.len() as f64,
        height_m: [mean, spread.sqrt()],
        ground_rmse_m: (off_ground.iter().sum::<f64>() / off_ground.len() as f64).sqrt(),
    }
}

/// The surface of a project that `run` has made, against its truth.
pub(crate) fn assert_close_to_truth(project: &Path) {
    let quality = compare(project);
    println!("{quality:?}");
    // 60 % of overlap, poses as adjusted, pixels of 1.5 cm; targets are surveyed to 2 cm.
    assert!(quality.known > 0.98, "{quality:?}");
    assert!(quality.bare_nmad_m < 0.0125 && quality.bare_bias_m.abs() < 0.03, "{quality:?}");
    // The truth is read between its cells, so borders of leaves count as leaves: measured 0.44.
    assert!(quality.leaves_within > 0.4, "{quality:?}");
    // Leaves taken for higher ones, mostly where two photos only show them: measured +7.3 and 3.7 cm.
    assert!(quality.height_m[0].abs() < 0.09 && quality.height_m[1] < 0.05, "{quality:?}");
    assert!(quality.ground_rmse_m < 0.04, "{quality:?}");
}
