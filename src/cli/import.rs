//! Arguments that name a reconstruction of another program.

use rowgram_base::error::Error;
use rowgram_project::import::ModelImport;
use std::path::PathBuf;

/// A model of another program, in place of a project.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "In place of a project")]
pub(super) struct ModelArgs {
    /// Another program's model, in the mapping frame: COLMAP folder, reconstruction.json of OpenSfM, bundle.out.
    #[arg(long, value_name = "PATH")]
    model: Option<PathBuf>,
    /// Table of poses (filename, x, y, z, omega, phi, kappa) or Orthority's GeoJSON; needs --camera.
    #[arg(long, value_name = "FILE", requires = "camera", conflicts_with = "model")]
    poses: Option<PathBuf>,
    /// Camera of the photos: camera.toml, reconstruction.json, Orthority's YAML. Several: chosen by name.
    #[arg(long, value_name = "FILE")]
    camera: Vec<PathBuf>,
    /// Added to all coordinates of a model whose origin is elsewhere: east, north, up, metres.
    #[arg(long, value_name = "E,N,U", value_delimiter = ',', allow_hyphen_values = true)]
    offset: Vec<f64>,
    /// Coordinate reference system of the model: EPSG:<code> or a PROJ string.
    #[arg(long, value_name = "CRS")]
    crs: Option<String>,
    /// EPSG code of what heights are measured from (5773: EGM96, 5703: NAVD88), where it is known.
    #[arg(long, value_name = "CODE")]
    vertical_crs: Option<u32>,
}

impl ModelArgs {
    /// What was named.
    ///
    /// # Errors
    /// An offset that is not of three numbers.
    pub(super) fn import(&self) -> Result<ModelImport, Error> {
        let offset_m = match self.offset[..] {
            [] => None,
            [east, north, up] => Some([east, north, up]),
            _ => return Err(Error::Argument("--offset: expected E,N,U, three numbers".into())),
        };
        Ok(ModelImport {
            model: self.model.clone(),
            poses: self.poses.clone(),
            cameras: self.camera.clone(),
            offset_m,
            crs: self.crs.clone(),
            vertical_crs: self.vertical_crs,
        })
    }
}
