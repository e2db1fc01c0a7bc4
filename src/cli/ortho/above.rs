//! How far above the surface a map is drawn.

use super::{Setting, options::Above, render::Photos};
use crate::{
    error::Error,
    mapping::{
        leaf_height::{self, Agreement, LeafHeight},
        photo::Photo,
        select::Selector,
    },
    raster::georeference::Georeference,
};

/// Cells by which photos are compared are not smaller, metres: finer than leaves are.
const CELL_M: f64 = 0.01;

impl Setting<'_> {
    /// How far above the surface the map is to be drawn, metres.
    ///
    /// # Errors
    /// Photos that cannot be read.
    pub(super) fn above_m(&self) -> Result<f64, Error> {
        match self.args.above {
            Above::Metres(metres) => Ok(metres),
            Above::Leaves => Ok(match self.leaf_height()? {
                Some(found) => {
                    tracing::info!(
                        "leaves are {:.3} m above the surface: there photos agree best about what is green (correlation {:.2}, {:.2} at the surface itself); the map is drawn there",
                        found.height_m,
                        found.correlation,
                        found.at_surface
                    );
                    found.height_m
                }
                None => {
                    tracing::warn!(
                        "at no height above the surface do photos agree clearly better about what is green; the map is drawn at the surface itself"
                    );
                    0.0
                }
            }),
        }
    }

    fn leaf_height(&self) -> Result<Option<LeafHeight>, Error> {
        let [x, y] = self.surface.bounds_m();
        let cell_m = self.median_gsd_m()?.max(CELL_M);
        let grid = Georeference::north_up([x[0], y[1]], cell_m, self.surface.georeference.crs);
        let size = [x, y].map(|[low, high]| ((high - low) / cell_m) as usize + 1);
        let selector = Selector::new(self.views, self.surface, grid, self.args.rules());
        let largest = self.views.iter().map(|view| {
            let [width, height] = view.interior.size_px().map(|n| n as usize);
            4 * width * height
        });
        // Both of a pair are needed at a time.
        let room = (self.args.memory << 20).max(2 * largest.max().unwrap_or(0));
        let mut photos = Photos::new(self.paths, room);
        let mut agreement = Agreement::default();
        for pair in leaf_height::pairs(&selector, size) {
            photos.each_group(&pair.photos, &selector, |photos: &[Option<&Photo>]| {
                if let [Some(first), Some(second)] = pair.photos.map(|k| photos[k]) {
                    agreement.add(&selector, &pair, [first, second]);
                }
            })?;
        }
        Ok(agreement.best())
    }
}
