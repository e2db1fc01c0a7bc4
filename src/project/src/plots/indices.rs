//! Spectral indices of plots and of plants: means over pixels, in one pass over the orthomosaic by bands of rows.

use super::PlotsOptions;
use rayon::prelude::*;
use rowgram_base::{error::Error, options::Auto};
use rowgram_files::rasters::{BAND_ROWS, Source};
use rowgram_plants::phenotype::{
    plant_pixels::PlantPixels,
    plot_scatter::{PlotParts, ValueParts},
    traits::check_index_name,
};
use rowgram_raster::{
    Mask,
    polygon::Polygon,
    spectral::{Band, Formula, Index},
    srgb::LightScale,
    window,
};
use std::ops::Range;

impl PlotsOptions {
    /// The indices that the settings name; `None` where they leave it to the orthomosaic.
    ///
    /// # Errors
    /// A word that is no index, a name that is taken.
    pub(super) fn named_indices(&self) -> Result<Option<Vec<Index>>, String> {
        let Auto::Given(words) = &self.indices else { return Ok(None) };
        let indices = Index::list(words).map_err(|why| format!("indices: {why}"))?;
        for index in &indices {
            check_index_name(index).map_err(|why| format!("indices: {why}"))?;
        }
        Ok(Some(indices))
    }

    /// The indices of an orthomosaic with these bands, each with its formula over them.
    ///
    /// # Errors
    /// As [`PlotsOptions::named_indices`], and an index that needs a band which is not there.
    pub(crate) fn indices_of(
        &self,
        bands: &[Option<Band>],
    ) -> Result<Vec<(Index, Formula)>, Error> {
        let refused = |why: String| Error::Argument(format!("[plots] {why}"));
        let indices = self.named_indices().map_err(refused)?.unwrap_or_else(|| Index::usual(bands));
        let bound = |index: Index| {
            let formula = index.bind(bands).map_err(|why| refused(format!("indices: {why}")))?;
            Ok((index, formula))
        };
        indices.into_iter().map(bound).collect()
    }
}

/// What is measured.
pub(super) struct Measuring<'a> {
    pub(super) source: &'a Source,
    pub(super) mask: &'a Mask,
    /// Pixels that show something; `None` where all do.
    pub(super) valid: Option<&'a Mask>,
    pub(super) indices: &'a [(Index, Formula)],
    /// The scale of the light of a picture that has red, green and blue alone.
    pub(super) light: LightScale,
}

/// Sums of an index over some pixels and over the leaf pixels among them.
#[derive(Debug, Clone, Default)]
pub(super) struct Sums {
    pub(super) ground: ValueParts,
    pub(super) leaf: ValueParts,
}

/// Sums of all indices.
#[derive(Debug, Clone, Default)]
pub(super) struct Means {
    /// Of each plot, by index.
    pub(super) plots: Vec<Vec<Sums>>,
    /// Over the leaf pixels of each plant, by index.
    pub(super) plants: Vec<Vec<ValueParts>>,
}

impl Measuring<'_> {
    /// Sums over plots and plants, the places of which are pixels. None where there is no index, or where the picture has another size
    /// than the mask.
    ///
    /// # Errors
    /// A damaged picture.
    pub(super) fn means(&self, plots: &[&Polygon], plants_px: &[[f64; 2]]) -> Result<Means, Error> {
        let (width, height) = (self.mask.width, self.mask.height);
        if self.indices.is_empty() || self.source.size() != (width, height) {
            return Ok(Means::default());
        }
        let indices = self.indices.len();
        let roles = self.source.roles()?;
        let is_spectral = |band: &Option<Band>| matches!(band, Some(Band::RedEdge | Band::Nir));
        let is_scaled = self.light != LightScale::IDENTITY && !roles.iter().any(is_spectral);
        let scaled = is_scaled.then(|| (roles, self.light.grey_values()));
        let mut of_plots: Vec<PlotRuns> = (plots.iter())
            .map(|plot| PlotRuns {
                runs: plot.runs(width, height),
                parts: PlotParts::of(plot),
                sums: vec![Sums::default(); indices],
            })
            .collect();
        let pixels = PlantPixels::new(plants_px);
        let around = |at: &[f64; 2]| PlotParts::around(*at, pixels.reach_px());
        let parts: Vec<PlotParts> = plants_px.iter().map(around).collect();
        let mut of_plants = vec![vec![ValueParts::default(); indices]; plants_px.len()];
        for band in window::bands(height, BAND_ROWS, 0) {
            let rows = band.rows;
            let (mut samples, gaps) = self.source.spectra(rows.clone())?;
            if let Some((bands, grey)) = &scaled {
                samples.par_chunks_mut(bands.len()).for_each(|pixel| scale(pixel, bands, grey));
            }
            let is_seen = |k: usize| {
                let valid = self.valid.is_none_or(|of| of.data[rows.start * width + k] != 0);
                valid && gaps.as_ref().is_none_or(|gaps| !gaps[k])
            };
            let values: Vec<Vec<f32>> = (self.indices.iter())
                .map(|(_, formula)| {
                    let mut values = formula.evaluate(&samples);
                    let hide = |(k, value): (usize, &mut f32)| {
                        if !is_seen(k) {
                            *value = f32::NAN;
                        }
                    };
                    values.par_iter_mut().enumerate().for_each(hide);
                    values
                })
                .collect();
            drop(samples);
            // Each plot is the work of one thread, pixels in their order: sums do not depend on the threads.
            of_plots.par_iter_mut().for_each(|plot| plot.add(&values, self.mask, &rows));
            if plants_px.is_empty() {
                continue;
            }
            let leaf = |k: &usize| self.mask.data[rows.start * width + k] != 0;
            let plant_of = |k: usize| {
                let at = [(k % width) as f64, (rows.start + k / width) as f64];
                Some((k, at, pixels.of(at)?))
            };
            let all: Vec<usize> = (0..rows.len() * width).filter(leaf).collect();
            let found: Vec<_> = all.into_par_iter().filter_map(plant_of).collect();
            for (k, at, plant) in found {
                let part = parts[plant].at(at);
                for (sums, values) in of_plants[plant].iter_mut().zip(&values) {
                    sums.add(part, values[k]);
                }
            }
        }
        let plots = of_plots.into_iter().map(|plot| plot.sums).collect();
        Ok(Means { plots, plants: of_plants })
    }
}

/// Brings the bytes of a pixel, over 255, into a scale of light.
fn scale(pixel: &mut [f32], bands: &[Option<Band>], grey: &[[f64; 256]; 3]) {
    for (value, band) in pixel.iter_mut().zip(bands) {
        let channel = match band {
            Some(Band::Red) => 0,
            Some(Band::Green) => 1,
            Some(Band::Blue) => 2,
            _ => continue,
        };
        // Between two bytes in proportion, for samples of more bits.
        let at = (255.0 * value.clamp(0.0, 1.0)).min(254.999);
        let (below, part) = (at as usize, f64::from(at.fract()));
        let [low, high] = [below, below + 1].map(|byte| grey[channel][byte]);
        *value = ((low + part * (high - low)) / 255.0) as f32;
    }
}

/// The pixels of a plot, and what was summed of them.
struct PlotRuns {
    /// Sorted by row.
    runs: Vec<(usize, Range<usize>)>,
    parts: PlotParts,
    sums: Vec<Sums>,
}

impl PlotRuns {
    /// Adds some rows; `values` are those of each index.
    fn add(&mut self, values: &[Vec<f32>], mask: &Mask, rows: &Range<usize>) {
        let begin = self.runs.partition_point(|(v, _)| *v < rows.start);
        for (v, run) in self.runs[begin..].iter().take_while(|(v, _)| *v < rows.end) {
            let leaf = mask.row(*v);
            for u in run.clone() {
                let part = self.parts.at([u as f64, *v as f64]);
                for (sums, values) in self.sums.iter_mut().zip(values) {
                    let value = values[(v - rows.start) * mask.width + u];
                    sums.ground.add(part, value);
                    if leaf[u] != 0 {
                        sums.leaf.add(part, value);
                    }
                }
            }
        }
    }
}
