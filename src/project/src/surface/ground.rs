//! The ground under a surface: fitted to what is bare, or from elsewhere.

use super::heights::Heights;
use rowgram_base::error::Error;
use rowgram_files::geoid::Geoid;
use rowgram_optim::output::FileError;
use rowgram_raster::{
    georeference::{Crs, Georeference, Transfer},
    window::Window,
};
use rowgram_survey::mapping::dense::Terrain;
use std::path::{Path, PathBuf};

/// Where the height of the ground comes from.
pub(super) enum Ground {
    /// Nowhere.
    Unknown,
    /// From bare places.
    Fitted(Fitted),
    /// From another program, sensor or date.
    Given { heights: Heights, datum: Option<Datum> },
}

/// A lattice through bare places.
pub(super) struct Fitted {
    pub(super) terrain: Terrain,
    /// Its coordinates, x and y in metres: those of a "pixel" of this.
    pub(super) frame: Georeference,
}

impl Fitted {
    /// In the coordinates of a map in metres.
    pub(super) fn on_map(terrain: Terrain, crs: Crs) -> Fitted {
        let frame =
            Georeference { origin: [0.0; 2], per_column: [1.0, 0.0], per_row: [0.0, 1.0], crs };
        Fitted { terrain, frame }
    }

    /// In metres along the rows and against the columns of a raster whose cells are so large on the ground, from its first cell on.
    pub(super) fn frame_of(place: &Georeference, [width_m, height_m]: [f64; 2]) -> Georeference {
        Georeference {
            per_column: place.per_column.map(|c| c / width_m),
            per_row: place.per_row.map(|c| -c / height_m),
            ..*place
        }
    }
}

/// What takes heights of a ground to those of its surface.
pub(super) struct Datum {
    path: PathBuf,
    geoid: Geoid,
    /// 1 where the surface is over the ellipsoid, -1 where the ground is.
    sign: f64,
}

impl Datum {
    pub(super) fn read(path: &Path, surface_is_ellipsoidal: bool) -> Result<Datum, FileError> {
        let sign = if surface_is_ellipsoidal { 1.0 } else { -1.0 };
        Ok(Datum { path: path.to_owned(), geoid: Geoid::read(path)?, sign })
    }

    /// What is added to heights of the ground at the corners of a window, metres.
    fn corners(&self, place: &Georeference, window: Window) -> Result<[[f64; 2]; 2], Error> {
        let Some(system) = place.crs.system() else {
            return Err(Error::Argument(
                "[surface] geoid: the map does not say its reference system, so its latitude is not known".into(),
            ));
        };
        let at = |u: usize, v: usize| -> Result<f64, Error> {
            let [x, y] = place.map([u as f64, v as f64]);
            let degrees = system.to_wgs84(x, y).map_err(|why| Error::Argument(why.to_string()))?;
            self.geoid.at_m(degrees).map(|height_m| self.sign * height_m).ok_or_else(|| {
                let message = format!(
                    "it does not reach {:.4} degrees north, {:.4} east",
                    degrees[0], degrees[1]
                );
                FileError::malformed(&self.path, None, message).into()
            })
        };
        let Window { u, v, width, height } = window;
        Ok([[at(u, v)?, at(u + width, v)?], [at(u, v + height)?, at(u + width, v + height)?]])
    }
}

impl Ground {
    pub(super) fn is_known(&self) -> bool {
        !matches!(self, Ground::Unknown)
    }

    pub(super) fn has_sigma(&self) -> bool {
        matches!(self, Ground::Fitted(_))
    }

    /// Heights of the ground, and their standard deviations where there are any, at the cells of a window, metres.
    ///
    /// # Errors
    /// Files that are damaged, a geoid that does not reach so far.
    pub(super) fn on(&self, place: &Georeference, window: Window) -> Result<[Vec<f32>; 2], Error> {
        match self {
            Ground::Unknown => Ok([const { Vec::new() }; 2]),
            Ground::Given { heights, datum } => {
                let mut ground = heights.on(place, window)?;
                if let Some(datum) = datum {
                    let [above, below] = datum.corners(place, window)?;
                    for (at, height) in ground.iter_mut().enumerate() {
                        let s = (at % window.width) as f64 / window.width as f64;
                        let t = (at / window.width) as f64 / window.height as f64;
                        let line = |[a, b]: [f64; 2]| a * (1.0 - s) + b * s;
                        *height += (line(above) * (1.0 - t) + line(below) * t) as f32;
                    }
                }
                Ok([ground, Vec::new()])
            }
            Ground::Fitted(Fitted { terrain, frame }) => {
                let transfer = Transfer::between(&place.crs, &frame.crs);
                let cells = window.width * window.height;
                let [mut ground, mut sigma] = [const { Vec::new() }; 2].map(|mut of: Vec<f32>| {
                    of.reserve_exact(cells);
                    of
                });
                for at in 0..cells {
                    let cell = [window.u + at % window.width, window.v + at / window.width];
                    let on_map = transfer.at(place.map(cell.map(|c| c as f64)));
                    let own = on_map.and_then(|at| frame.pixel(at));
                    let known = own.and_then(|at| terrain.with_sigma_at_m(at));
                    let [height_m, sigma_m] = known.unwrap_or([f64::NAN; 2]).map(|m| m as f32);
                    ground.push(height_m);
                    sigma.push(if sigma_m.is_finite() { sigma_m } else { f32::NAN });
                }
                Ok([ground, sigma])
            }
        }
    }
}
