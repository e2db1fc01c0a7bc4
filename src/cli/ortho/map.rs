//! One map: its grid, its gains, its files.

use super::{
    Map, Setting, figures, provenance_path, record,
    render::{Job, Photos, Rendered, render},
};
use crate::{
    error::Error,
    io::{FileError, geotiff},
    mapping::{balance::Overlaps, paint::Gain, photo::Photo, select::Selector},
    raster::{
        georeference::{CrsKind, Georeference},
        undistort::Interpolation,
    },
};
use std::{path::Path, time::Instant};

impl Setting<'_> {
    /// The grid of the map: its pixels' borders lie on multiples of their size.
    fn grid(&self) -> Result<(Georeference, [usize; 2]), Error> {
        let args = self.args;
        if let Some(path) = &args.like {
            let reader = geotiff::Reader::open(path)?;
            let place = reader.georeference().filter(|place| place.crs.kind != CrsKind::Geographic);
            let place = place.ok_or_else(|| {
                FileError::malformed(path, None, "it does not lie on a map in metres")
            })?;
            let grid = Georeference { crs: self.surface.georeference.crs, ..place };
            return Ok((grid, [reader.width(), reader.height()]));
        }
        let gsd = match args.gsd {
            Some(gsd) => gsd,
            None => {
                let median = self.median_gsd_m()?;
                // Three digits are enough to name it.
                format!("{median:.2e}").parse().unwrap_or(median)
            }
        };
        let [x, y] = match args.bounds[..] {
            [left, bottom, right, top] => [[left, right], [bottom, top]],
            _ => {
                let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
                let (mut beyond, mut partly) = (0, 0);
                for view in self.views {
                    match view.footprint_m(self.surface) {
                        Some((footprint, whole)) => {
                            partly += usize::from(!whole);
                            for (all, own) in bounds.iter_mut().zip(footprint) {
                                *all = [all[0].min(own[0]), all[1].max(own[1])];
                            }
                        }
                        None => beyond += 1,
                    }
                }
                if beyond > 0 && beyond < self.views.len() {
                    tracing::warn!("{beyond} photos show nothing of the surface");
                }
                if partly > 0 {
                    tracing::warn!(
                        "{partly} of {} photos reach beyond the surface; what it does not cover has no colour",
                        self.views.len()
                    );
                }
                bounds
            }
        };
        if x[0] > x[1] {
            return Err(self.nothing().into());
        }
        let span = |[low, high]: [f64; 2]| {
            let first = (low / gsd).floor();
            (first, (high / gsd).ceil() - first)
        };
        let ((left, columns), (bottom, rows)) = (span(x), span(y));
        if columns * rows > 1e11 {
            return Err(Error::Argument(format!(
                "the map would have {columns:.0} x {rows:.0} pixels of {gsd} m; give a larger --gsd or --bounds"
            )));
        }
        let origin = [(left + 0.5) * gsd, (bottom + rows - 0.5) * gsd];
        let grid = Georeference::north_up(origin, gsd, self.surface.georeference.crs);
        Ok((grid, [columns.max(1.0) as usize, rows.max(1.0) as usize]))
    }

    /// Median ground sampling distance of the photos, metres per pixel.
    ///
    /// # Errors
    /// Where none shows any of the surface.
    pub(super) fn median_gsd_m(&self) -> Result<f64, Error> {
        let mut all: Vec<f64> =
            self.views.iter().filter_map(|view| view.gsd_m(self.surface)).collect();
        all.sort_by(f64::total_cmp);
        Ok(*all.get(all.len() / 2).ok_or_else(|| self.nothing())?)
    }

    /// Makes the map and everything beside it.
    ///
    /// # Errors
    /// Photos that cannot be read, outputs that cannot be written.
    pub(super) fn map(&self, output: &Path) -> Result<Map, Error> {
        let started = Instant::now();
        let args = self.args;
        let (grid, size) = self.grid()?;
        let selector = Selector::new(self.views, self.surface, grid, args.rules());
        let mut photos = Photos::new(self.paths, args.memory << 20);
        let gains = match args.balance {
            true => Some(self.gains(&selector, size, &mut photos)?),
            false => None,
        };
        let job = Job {
            selector: &selector,
            paths: self.paths,
            grid,
            size,
            interpolation: args.interpolation(),
            feather_m: args.feather,
            gains: gains.as_deref(),
        };
        let provenance = (!args.no_provenance).then(|| provenance_path(output));
        let rendered = render(&job, &mut photos, (output, provenance.as_deref()), args.force)?;
        if rendered.coloured == 0 {
            tracing::warn!("{}: no pixel has a colour", output.display());
        }
        record::write(output, self, &grid, size, gains.as_deref())?;
        if let Some(folder) = &args.figures {
            self.figures(folder, output, &selector, &rendered, grid)?;
        }
        let seconds = started.elapsed().as_secs_f64();
        Ok(Map {
            output: output.display().to_string(),
            provenance: provenance.map(|path| path.display().to_string()),
            width_px: size[0],
            height_px: size[1],
            gsd_m: grid.per_column[0],
            above_m: self.above_m,
            epsg: grid.crs.epsg,
            vertical_epsg: grid.crs.vertical_epsg,
            photos: rendered.cells_of.iter().filter(|&&cells| cells > 0).count(),
            coloured_pixels: rendered.coloured,
            seconds,
            megapixels_per_second: 1e-6 * (size[0] * size[1]) as f64 / seconds,
        })
    }

    fn figures(
        &self,
        folder: &Path,
        output: &Path,
        selector: &Selector<'_>,
        rendered: &Rendered,
        grid: Georeference,
    ) -> Result<(), Error> {
        let folder = match self.args.frames {
            true => folder.join(output.file_stem().unwrap_or_default()),
            false => folder.to_owned(),
        };
        std::fs::create_dir_all(&folder).map_err(|e| FileError::write(&folder, e))?;
        figures::mosaic(&folder, selector, rendered, grid, self.args.force)
    }

    /// Gains from cells on a coarse grid, as many as tell the means apart.
    fn gains(
        &self,
        selector: &Selector<'_>,
        [width, height]: [usize; 2],
        photos: &mut Photos<'_>,
    ) -> Result<Vec<Gain>, Error> {
        let step = ((width * height) as f64 / 40_000.0).sqrt().ceil().max(1.0) as usize;
        let among: Vec<u32> = (0..self.views.len() as u32).collect();
        let mut candidates = Vec::new();
        let mut wanted: Vec<Vec<(usize, [f32; 2])>> = vec![Vec::new(); self.views.len()];
        let mut cells = 0;
        for v in (step / 2..height).step_by(step) {
            for u in (step / 2..width).step_by(step) {
                let Some(point) = selector.point_m(u, v) else { continue };
                selector.candidates(point, &among, &mut candidates);
                if candidates.len() >= 2 {
                    for candidate in &candidates {
                        let at = candidate.image_px.map(|value| value as f32);
                        wanted[candidate.view].push((cells, at));
                    }
                    cells += 1;
                }
            }
        }
        let mut colours: Vec<Vec<(usize, [f32; 3])>> = vec![Vec::new(); cells];
        let all: Vec<usize> = (0..self.views.len()).filter(|&k| !wanted[k].is_empty()).collect();
        photos.each_group(&all, selector, |photos: &[Option<&Photo>]| {
            for (k, photo) in photos.iter().enumerate() {
                let Some(photo) = photo else { continue };
                for &(cell, at) in &wanted[k] {
                    let colour = photo.at(at, Interpolation::Bilinear);
                    if Photo::has_data(colour) {
                        let [r, g, b, _] = colour;
                        colours[cell].push((k, [r, g, b]));
                    }
                }
            }
        })?;
        let mut overlaps = Overlaps::default();
        for seen in &colours {
            for (i, &first) in seen.iter().enumerate() {
                seen[i + 1..].iter().for_each(|&second| overlaps.add(first, second));
            }
        }
        if overlaps.pairs() == 0 {
            tracing::warn!("--balance: no two photos show the same ground");
        }
        Ok(overlaps.gains(self.views.len())?)
    }
}
