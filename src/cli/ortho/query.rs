//! `rowgram query`: from a place on a mosaic to the pixel of the photo behind it, and back.

use super::{provenance_path, read_surface, record, render::NO_SOURCE, render::PROVENANCE_BANDS};
use crate::{
    error::Error,
    io::geotiff::Reader,
    mapping::{View, surface::Heights},
    raster::window::Window,
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Ask a mosaic which photo pixel is behind a place, or where a photo pixel is
#[derive(Debug, clap::Args)]
#[command(arg_required_else_help = true)]
pub(in crate::cli) struct Query {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    /// The photo and its pixel behind a place on the map
    #[command(after_help = "Example:
  rowgram query ortho 500670.2 4480143.1 --map field/rowgram/ortho/ortho.tif --json")]
    Ortho {
        /// East coordinate, metres.
        #[arg(allow_negative_numbers = true)]
        x: f64,
        /// North coordinate, metres.
        #[arg(allow_negative_numbers = true)]
        y: f64,
        #[command(flatten)]
        of: Of,
    },
    /// The place on the map, and the mosaic's pixel, of a photo's pixel
    #[command(after_help = "Example:
  rowgram query photo IMG_0031.JPG 2011.5 1490 --map field/rowgram/ortho/ortho.tif")]
    Photo {
        /// The photo's name.
        image: String,
        /// Column, the centre of the first one being 0.
        #[arg(allow_negative_numbers = true)]
        u: f64,
        /// Row, the centre of the first one being 0.
        #[arg(allow_negative_numbers = true)]
        v: f64,
        #[command(flatten)]
        of: Of,
    },
}

#[derive(Debug, clap::Args)]
struct Of {
    /// The mosaic.
    #[arg(long, value_name = "FILE", default_value = "ortho.tif")]
    map: PathBuf,
    /// The surface, if it is not where it was.
    #[arg(long, value_name = "FILE")]
    dem: Option<PathBuf>,
    /// Print one line of JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Behind {
    image: String,
    path: String,
    /// The photo's pixel of the place itself.
    u_px: f64,
    v_px: f64,
    x_m: f64,
    y_m: f64,
    z_m: f64,
    /// The mosaic's pixel that it lies in, and what is stored there.
    column: usize,
    row: usize,
    pixel_u_px: f32,
    pixel_v_px: f32,
    view_angle_deg: f32,
    to_seam_m: Option<f32>,
}

#[derive(Serialize)]
struct Place {
    image: String,
    x_m: f64,
    y_m: f64,
    z_m: f64,
    /// Where it is on the mosaic, the centre of the first pixel being (0, 0).
    column: f64,
    row: f64,
    /// Whether the mosaic's pixel is taken from this photo.
    is_source: Option<bool>,
}

impl Query {
    /// Runs the verb.
    ///
    /// # Errors
    /// A mosaic without its record, a place that it does not show, a photo that it does not know.
    pub(in crate::cli) fn run(&self) -> Result<(), Error> {
        match &self.what {
            What::Ortho { x, y, of } => {
                let found = of.behind([*x, *y])?;
                of.print(&found, || {
                    format!(
                        "{} u {:.3} v {:.3} px; height {:.3} m, view angle {:.1} degrees{}",
                        found.path,
                        found.u_px,
                        found.v_px,
                        found.z_m,
                        found.view_angle_deg,
                        found
                            .to_seam_m
                            .map_or(String::new(), |m| format!(", {m:.2} m to the seam"))
                    )
                })
            }
            What::Photo { image, u, v, of } => {
                let found = of.place(image, [*u, *v])?;
                of.print(&found, || {
                    format!(
                        "x {:.4} y {:.4} z {:.4} m; column {:.2} row {:.2} of the mosaic{}",
                        found.x_m,
                        found.y_m,
                        found.z_m,
                        found.column,
                        found.row,
                        match found.is_source {
                            Some(false) => ", which is taken from another photo",
                            Some(true) => ", which is taken from this photo",
                            None => "",
                        }
                    )
                })
            }
        }
    }
}

impl Of {
    fn print(&self, value: &impl Serialize, text: impl FnOnce() -> String) -> Result<(), Error> {
        if self.json { crate::cli::print_json(value) } else { crate::cli::print(&text()) }
    }

    /// Photos with their files, and the surface.
    fn known(&self) -> Result<(Vec<View>, Vec<PathBuf>, crate::mapping::Surface), Error> {
        let (views, paths, dem, above_m) = record::read(&self.map)?;
        let dem = self.dem.clone().or(dem).ok_or_else(|| {
            Error::Argument(format!("{}: give --dem, its surface", self.map.display()))
        })?;
        Ok((views, paths, read_surface(&dem, Heights::Bilinear)?.raised(above_m)))
    }

    /// The record of the pixel at a place; `None` where it has no source.
    fn stored(&self, map: &Path, at: [f64; 2]) -> Result<Option<(usize, usize, Vec<f32>)>, Error> {
        let reader = Reader::open(&provenance_path(map))?;
        let outside =
            || Error::Argument(format!("{} does not show ({}, {})", map.display(), at[0], at[1]));
        let place = reader.georeference().and_then(|place| place.pixel(at)).ok_or_else(outside)?;
        let (u, v) = (place[0].round(), place[1].round());
        let inside =
            u >= 0.0 && v >= 0.0 && u < reader.width() as f64 && v < reader.height() as f64;
        if !inside {
            return Err(outside());
        }
        let (u, v) = (u as usize, v as usize);
        let record = reader.read::<f32>(Window { u, v, width: 1, height: 1 })?;
        if record.len() != PROVENANCE_BANDS {
            return Err(Error::Argument(format!(
                "{}: it has {} bands, expected the {PROVENANCE_BANDS} of a provenance raster",
                reader.path().display(),
                record.len()
            )));
        }
        Ok((record[0] != NO_SOURCE).then_some((u, v, record)))
    }

    fn behind(&self, at: [f64; 2]) -> Result<Behind, Error> {
        let (views, paths, surface) = self.known()?;
        let (column, row, record) = self.stored(&self.map, at)?.ok_or_else(|| {
            Error::Argument(format!(
                "{} has no photo at ({}, {})",
                self.map.display(),
                at[0],
                at[1]
            ))
        })?;
        let k = record[0] as usize;
        let view = views.get(k).ok_or_else(|| {
            Error::Argument(format!("{}: there is no photo number {k}", self.map.display()))
        })?;
        let z = surface.at(at).ok_or_else(|| {
            Error::Argument(format!("the surface has no height at ({}, {})", at[0], at[1]))
        })?;
        // At the border of a photo the pixel's centre may be in it and the place just outside.
        let pixel = view.pixel([at[0], at[1], z]);
        let pixel = pixel.unwrap_or([f64::from(record[1]), f64::from(record[2])]);
        Ok(Behind {
            image: view.name.clone(),
            path: paths[k].display().to_string(),
            u_px: pixel[0],
            v_px: pixel[1],
            x_m: at[0],
            y_m: at[1],
            z_m: z,
            column,
            row,
            pixel_u_px: record[1],
            pixel_v_px: record[2],
            view_angle_deg: record[3],
            to_seam_m: (record[4] != NO_SOURCE).then_some(record[4]),
        })
    }

    fn place(&self, image: &str, image_px: [f64; 2]) -> Result<Place, Error> {
        let (views, _, surface) = self.known()?;
        let stem = Path::new(image).file_stem().and_then(|s| s.to_str());
        let k = views
            .iter()
            .position(|view| view.name == image || Some(view.name.as_str()) == stem)
            .ok_or_else(|| {
                Error::Argument(format!("{}: there is no photo {image:?}", self.map.display()))
            })?;
        let point = views[k].ground(image_px, &surface).ok_or_else(|| {
            Error::Argument(format!(
                "pixel ({}, {}) of {image} does not show the surface",
                image_px[0], image_px[1]
            ))
        })?;
        let map = Reader::open(&self.map)?;
        let pixel = map.georeference().and_then(|place| place.pixel([point[0], point[1]]));
        let [column, row] = pixel.ok_or_else(|| {
            Error::Argument(format!("{} does not lie on the map", self.map.display()))
        })?;
        let is_source = match provenance_path(&self.map).is_file() {
            true => self
                .stored(&self.map, [point[0], point[1]])
                .ok()
                .map(|stored| stored.is_some_and(|(_, _, record)| record[0] as usize == k)),
            false => None,
        };
        Ok(Place {
            image: views[k].name.clone(),
            x_m: point[0],
            y_m: point[1],
            z_m: point[2],
            column,
            row,
            is_source,
        })
    }
}
