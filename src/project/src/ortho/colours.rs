//! One colour for the photos of an orthomosaic: when and how each was exposed, by its file, and the adjustment over all that they show.

use super::{
    photos::read_photo,
    write::{MAX_PIXELS, Work, nothing},
};
use rayon::prelude::*;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::photo::{self, Metadata};
use rowgram_optim::output::name_of;
use rowgram_survey::mapping::{
    Surface, View,
    colour_balance::{self, BalancedPhotos, Exposure},
    grid::{coverage, covering, median_gsd_m},
    photo_cache::PhotoCache,
    select::PhotoSelector,
};
use std::path::PathBuf;

/// When photos were taken and how they were exposed, as their files say. Exposures are compared only where all files say the same
/// things of them.
fn exposures(photos: &[PathBuf], cameras: &[usize]) -> Result<Vec<Exposure>, Error> {
    let all: Vec<Metadata> =
        photos.par_iter().map(|path| photo::read(path)).collect::<Result<_, _>>()?;
    let known = |of: &Metadata| [of.exposure_s, of.iso, of.f_number].map(|value| value.is_some());
    let alike = all.iter().all(|of| of.exposure_s.is_some() && known(of) == known(&all[0]));
    let log = |value: Option<f64>| value.map_or(0.0, f64::ln);
    let of = |(of, &camera): (Metadata, &usize)| Exposure {
        log_exposure: alike.then(|| log(of.exposure_s) + log(of.iso) - 2.0 * log(of.f_number)),
        moment: of.moment,
        camera,
    };
    Ok(all.into_iter().zip(cameras).map(of).collect())
}

impl Work<'_> {
    /// Brings the colours of photos together, over all that they show.
    pub(super) fn balance(
        &self,
        views: &[View],
        (photos, cameras): (&[PathBuf], &[usize]),
        surface: &Surface,
        monitor: &mut dyn Monitor,
    ) -> Result<Option<BalancedPhotos>, Error> {
        let bounds = coverage(views, surface).bounds_m.ok_or_else(|| nothing(views, surface))?;
        let gsd_m = median_gsd_m(views, surface).ok_or_else(|| nothing(views, surface))?;
        let (grid, size) = covering(bounds, gsd_m, surface.georeference.crs, MAX_PIXELS)?;
        let selector = PhotoSelector::new(views, surface, grid, self.options.selection());
        let read = |k: usize| read_photo(&photos[k], views[k].interior.size_px());
        let mut cache = PhotoCache::new(views, &read, self.options.memory_mb << 20);
        let exposures = exposures(photos, cameras)?;
        let found = colour_balance::balance(&selector, size, &exposures, &mut cache)?;
        let subject = name_of(self.files.mosaic);
        monitor.diagnostic(&match found.as_ref().map(|found| &found.balance) {
            Some(found) => Diagnostic::info(
                "colours-balanced",
                subject,
                format!(
                    "photos of one place differ by {:.1} grey values, {:.1} before (median of {} windows); gains from {:.2} to {:.2}, light in the corners {}",
                    found.difference.after,
                    found.difference.before,
                    found.observations,
                    found.gain_range[0],
                    found.gain_range[1],
                    found.cameras.iter().map(|of| format!("{:.2}", of.corner_light)).collect::<Vec<_>>().join(", "),
                ),
            ),
            None => Diagnostic::warning(
                "no-overlap",
                subject,
                "no two photos show the same ground, so colours are not balanced",
            ),
        });
        Ok(found)
    }
}
