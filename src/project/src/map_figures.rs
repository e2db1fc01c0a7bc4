//! Pictures of maps: the mosaic small, which photo each place came from, how many photos show it; surfaces shaded and in
//! colours.

use super::figures;
use image::{Rgb, RgbImage};
use rayon::prelude::*;
use rowgram_base::error::Error;
use rowgram_files::{csv_table::CsvWriter, images};
use rowgram_optim::output;
use rowgram_raster::{density::colour, georeference::Georeference};
use rowgram_survey::mapping::{
    Surface, elevation::ElevationModel, mosaic::Rendered, select::PhotoSelector,
};
use std::path::Path;

/// What has no data.
const EMPTY: [u8; 3] = [255, 255, 255];

fn picture([width, height]: [usize; 2], colour: impl Fn(usize, usize) -> [u8; 3]) -> RgbImage {
    RgbImage::from_fn(width as u32, height as u32, |u, v| Rgb(colour(u as usize, v as usize)))
}

/// A colour of its own for each number; those of neighbours differ.
fn own_colour(number: u32) -> [u8; 3] {
    let hue = (f64::from(number) * 0.618_033_988_749_895).fract() * 6.0;
    let value = [235.0, 190.0, 150.0][number as usize % 3];
    let saturation = 0.55;
    let of = |shift: f64| {
        let k = (hue + shift) % 6.0;
        let part = k.min(4.0 - k).clamp(0.0, 1.0);
        (value * (1.0 - saturation * part)) as u8
    };
    [of(5.0), of(3.0), of(1.0)]
}

/// Preview, sources with seams, coverage, and a table of the photos.
///
/// # Errors
/// Where one cannot be written.
pub(super) fn draw_mosaic(
    folder: &Path,
    selector: &PhotoSelector<'_>,
    rendered: &Rendered,
    grid: Georeference,
    force: bool,
) -> Result<(), Error> {
    let small = &rendered.preview;
    let size = small.size;
    let preview = picture(size, |u, v| match small.rgba[v * size[0] + u] {
        [_, _, _, 0] => EMPTY,
        [r, g, b, _] => [r, g, b],
    });
    images::write_photo(&folder.join("mosaic.png"), force, &preview)?;
    let source = |u: usize, v: usize| small.source[v * size[0] + u];
    let sources = picture(size, |u, v| {
        let own = source(u, v);
        let seam = (u + 1 < size[0] && source(u + 1, v) != own)
            || (v + 1 < size[1] && source(u, v + 1) != own);
        match (own, seam) {
            (0, false) => EMPTY,
            (_, true) => [20, 20, 20],
            (own, false) => own_colour(own),
        }
    });
    images::write_photo(&folder.join("sources.png"), force, &sources)?;
    let step = small.step;
    let among: Vec<u32> = (0..selector.views().len() as u32).collect();
    let counts: Vec<usize> = (0..size[0] * size[1])
        .into_par_iter()
        .map_init(Vec::new, |candidates, k| {
            let point = selector.point_m(k % size[0] * step, k / size[0] * step);
            point.map_or(0, |point| {
                selector.candidates(point, &among, candidates);
                candidates.len()
            })
        })
        .collect();
    let most = counts.iter().copied().max().unwrap_or(0);
    let coverage = picture(size, |u, v| match counts[v * size[0] + u] {
        0 => EMPTY,
        n => colour(n as f64 / most.max(2) as f64),
    });
    images::write_photo(&folder.join("coverage.png"), force, &coverage)?;
    output::write(&folder.join("coverage.csv"), force, |out| {
        writeln!(out, "photos_that_show_it,share_of_cells,area_m2")?;
        let cell_m2 = (grid.per_column[0] * grid.per_row[1]).abs() * (step * step) as f64;
        for n in 0..=most {
            let cells = counts.iter().filter(|&&count| count == n).count();
            let share = cells as f64 / counts.len() as f64;
            writeln!(out, "{n},{share:.6},{:.3}", cells as f64 * cell_m2)?;
        }
        Ok(())
    })?;
    output::write(&folder.join("sources.csv"), force, |out| {
        let mut csv = CsvWriter::new(out);
        csv.write_record(["number", "image", "pixels", "x_m", "y_m", "z_m"])?;
        for (k, view) in selector.views().iter().enumerate() {
            let fixed = [k.to_string(), view.name.clone(), rendered.cells_of[k].to_string()];
            let at = view.centre_m().map(|metres| format!("{metres:.4}"));
            csv.write_record(fixed.into_iter().chain(at))?;
        }
        csv.flush()
    })?;
    Ok(())
}

/// Surface and standard deviations, and a table of how heights are distributed.
///
/// # Errors
/// Where one cannot be written.
pub(super) fn draw_elevation(
    folder: &Path,
    model: &ElevationModel,
    force: bool,
) -> Result<(), Error> {
    let surface = &model.surface;
    images::write_photo(&folder.join("hillshade.png"), force, &hillshade(surface))?;
    let sigmas = model.sorted_sigmas_m();
    let share = |share: f64| ((sigmas.len().saturating_sub(1)) as f64 * share) as usize;
    if let Some(&most) = sigmas.get(share(0.95)) {
        let size = [surface.width, surface.height];
        let picture = values(size, &model.sigmas_m, [0.0, f64::from(most)]);
        images::write_photo(&folder.join("sigma.png"), force, &picture)?;
    }
    let mut heights: Vec<f32> =
        surface.heights_m.iter().copied().filter(|z| z.is_finite()).collect();
    heights.sort_by(f32::total_cmp);
    output::write(&folder.join("heights.csv"), force, |out| {
        writeln!(out, "share_of_cells,height_m,sigma_m")?;
        for percent in (0..=100).step_by(5) {
            let of = |values: &[f32]| {
                let at = (values.len().saturating_sub(1)) * percent / 100;
                values.get(at).map_or(String::new(), |value| format!("{value:.4}"))
            };
            writeln!(out, "{:.2},{},{}", percent as f64 / 100.0, of(&heights), of(&sigmas))?;
        }
        Ok(())
    })?;
    Ok(())
}

/// A dense surface, shaded, every so many cells that the picture has at most 4096 a side.
///
/// # Errors
/// Where it cannot be written.
pub(super) fn draw_surface(folder: &Path, surface: &Surface) -> Result<(), Error> {
    let step = figures::step(surface.width, surface.height);
    let shaded = hillshade(surface);
    let size = [surface.width.div_ceil(step), surface.height.div_ceil(step)];
    let picture = picture(size, |u, v| shaded.get_pixel((u * step) as u32, (v * step) as u32).0);
    Ok(images::write_photo(&folder.join("surface.png"), false, &picture)?)
}

/// Heights of the canopy from 0 (dark blue) to `top_m` (yellow).
///
/// # Errors
/// Where it cannot be written.
pub(super) fn draw_canopy(
    folder: &Path,
    [width, height]: [usize; 2],
    canopy_m: &[f32],
    top_m: f64,
) -> Result<(), Error> {
    let step = figures::step(width, height);
    let size = [width.div_ceil(step), height.div_ceil(step)];
    let picture = picture(size, |u, v| match f64::from(canopy_m[v * step * width + u * step]) {
        value if value.is_finite() => colour(value / top_m.max(1e-9)),
        _ => EMPTY,
    });
    Ok(images::write_photo(&folder.join("canopy.png"), false, &picture)?)
}

/// A surface lit from the north-west, its colours by height.
fn hillshade(surface: &Surface) -> RgbImage {
    let [low, high] = surface.range_m();
    let cell = surface.cell_m();
    let size = [surface.width, surface.height];
    let z = |u: usize, v: usize| f64::from(surface.heights_m[v * size[0] + u]);
    // Relief of a field is small: its slopes are stretched so that the picture has contrast.
    let mut slopes: Vec<f64> = (0..size[1].saturating_sub(1))
        .flat_map(|v| (0..size[0].saturating_sub(1)).map(move |u| (u, v)))
        .map(|(u, v)| ((z(u + 1, v) - z(u, v)).hypot(z(u, v + 1) - z(u, v))) / cell)
        .filter(|slope| slope.is_finite())
        .collect();
    slopes.sort_by(f64::total_cmp);
    let usual = slopes.get(slopes.len() * 9 / 10).copied().unwrap_or(1.0).max(1e-6);
    let stretch = 0.7 / usual;
    picture(size, |u, v| {
        let own = z(u, v);
        if !own.is_finite() {
            return EMPTY;
        }
        let next = |a: f64| if a.is_finite() { a } else { own };
        let east = next(z((u + 1).min(size[0] - 1), v)) - next(z(u.saturating_sub(1), v));
        let south = next(z(u, (v + 1).min(size[1] - 1))) - next(z(u, v.saturating_sub(1)));
        let (gx, gy) = (stretch * east / (2.0 * cell), -stretch * south / (2.0 * cell));
        // Light from the north-west, 45 degrees high.
        let light = (0.5 * gx - 0.5 * gy + 0.707) / (1.0 + gx * gx + gy * gy).sqrt();
        let base = colour((own - low) / (high - low).max(1e-9));
        base.map(|c| (f64::from(c) * 0.35 + 165.0 * light.clamp(0.0, 1.0)) as u8)
    })
}

/// Values in colours between two limits.
fn values(size: [usize; 2], of: &[f32], [low, high]: [f64; 2]) -> RgbImage {
    picture(size, |u, v| match f64::from(of[v * size[0] + u]) {
        value if value.is_finite() => colour((value - low) / (high - low).max(1e-12)),
        _ => EMPTY,
    })
}
