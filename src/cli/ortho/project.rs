//! Where photos, poses, lenses and points come from: the results of `rowgram align`, a model of another program,
//! or a table of poses with a camera.

use crate::{
    camera::{Camera, Interior},
    error::Error,
    io::{FileError, bundler, camera, cloud_points, colmap, opensfm, orthority, poses},
    mapping::{View, dem::Point},
    raster::georeference::Crs,
};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// What the mapping verbs share: where the block is.
#[derive(Debug, clap::Args)]
pub(in crate::cli) struct Input {
    /// Folder with the photos and, in rowgram/, the results of rowgram align.
    #[arg(required_unless_present_any = ["model", "poses", "points"])]
    project: Option<PathBuf>,
    /// Results of rowgram align that are elsewhere [default: PROJECT/rowgram].
    #[arg(long, value_name = "DIR")]
    aligned: Option<PathBuf>,
    /// Another program's model, in the mapping frame: COLMAP folder, reconstruction.json, bundle.out.
    #[arg(long, value_name = "PATH", conflicts_with = "poses")]
    model: Option<PathBuf>,
    /// Table of poses (filename, x, y, z, omega, phi, kappa) or Orthority's GeoJSON; needs --camera.
    #[arg(long, value_name = "FILE", requires = "camera")]
    poses: Option<PathBuf>,
    /// Camera of the photos: camera.toml, reconstruction.json, Orthority's YAML. Several: chosen by name.
    #[arg(long, value_name = "FILE")]
    camera: Vec<PathBuf>,
    /// Folder of the photos [default: PROJECT/images or PROJECT].
    #[arg(long, value_name = "DIR")]
    photos: Option<PathBuf>,
    /// Added to all coordinates of a model whose origin is elsewhere: east, north, up, metres.
    #[arg(
        long,
        value_name = "E,N,U",
        value_delimiter = ',',
        num_args = 3,
        allow_negative_numbers = true
    )]
    offset: Vec<f64>,
    /// EPSG code of the mapping frame, where the input does not say it.
    #[arg(long, value_name = "CODE")]
    epsg: Option<u32>,
    /// EPSG code of what heights are measured from (5773: EGM96, 5703: NAVD88), where it is known.
    #[arg(long, value_name = "CODE")]
    vertical_epsg: Option<u32>,
    /// Points for the surface: CSV with x_m, y_m, z_m and perhaps sigma_z_m.
    #[arg(long, value_name = "FILE")]
    points: Option<PathBuf>,
}

/// A block in the mapping frame.
pub(in crate::cli) struct Block {
    /// Photos with lenses and poses.
    pub(in crate::cli) views: Vec<View>,
    /// The cloud.
    pub(in crate::cli) points: Vec<Point>,
    /// The coordinate reference system.
    pub(in crate::cli) crs: Option<Crs>,
}

impl Input {
    /// Where results are kept.
    pub(in crate::cli) fn results(&self) -> Option<PathBuf> {
        self.aligned
            .clone()
            .or_else(|| self.project.as_ref().map(|project| project.join("rowgram")))
    }

    /// An output that was not named.
    ///
    /// # Errors
    /// Where there is no project.
    pub(in crate::cli) fn output(
        &self,
        named: Option<&Path>,
        name: &str,
    ) -> Result<PathBuf, Error> {
        if let Some(path) = named {
            return Ok(path.to_owned());
        }
        let folder = self.results().filter(|folder| folder.is_dir()).ok_or_else(|| {
            Error::Argument(
                "give --output: there are no results of rowgram align to write beside".into(),
            )
        })?;
        Ok(folder.join(name))
    }

    /// Reads it.
    ///
    /// # Errors
    /// What is missing, and where it was looked for.
    pub(in crate::cli) fn block(&self) -> Result<Block, Error> {
        let mut block = if let Some(path) = &self.model {
            self.model(path)?
        } else if let Some(path) = &self.poses {
            Block { views: self.posed(&poses::read(path)?, path)?, points: Vec::new(), crs: None }
        } else if let Some(folder) = self.results() {
            self.aligned(&folder)?
        } else {
            Block { views: Vec::new(), points: Vec::new(), crs: None }
        };
        if let Some(path) = &self.points {
            block.points = cloud_points::read(path)?;
        }
        if let [e, n, u] = self.offset[..] {
            let by = [e, n, u];
            for view in &mut block.views {
                let centre = view.centre_m();
                let moved = std::array::from_fn(|k| centre[k] + by[k]);
                let pose = crate::scene::Pose::from_centre(view.pose.rotation, moved);
                *view = View::new(&view.name, view.interior, pose, view.motion);
            }
            for point in &mut block.points {
                (0..3).for_each(|k| point.position_m[k] += by[k]);
            }
        }
        if let Some(code) = self.epsg {
            if let Some(known) = block.crs.and_then(|crs| crs.epsg).filter(|&known| known != code) {
                return Err(Error::Argument(format!(
                    "--epsg {code}: the block is in EPSG:{known}"
                )));
            }
            let vertical_epsg = block.crs.and_then(|crs| crs.vertical_epsg);
            block.crs = Some(Crs { vertical_epsg, ..Crs::projected(code) });
        }
        if let Some(code) = self.vertical_epsg {
            block.crs = Some(Crs { vertical_epsg: Some(code), ..block.crs.unwrap_or(Crs::LOCAL) });
        }
        Ok(block)
    }

    fn model(&self, path: &Path) -> Result<Block, Error> {
        let model = if path.is_dir() {
            colmap::read(path)?
        } else if path.extension().is_some_and(|e| e == "json") {
            opensfm::read_poses(path)?
        } else {
            let size = self.cameras()?.into_iter().next().map(|c| c.interior.size_px());
            let size = size.ok_or_else(|| {
                Error::Argument(format!(
                    "{}: Bundler's files have no image sizes; give --camera",
                    path.display()
                ))
            })?;
            let list = path.with_file_name("list.txt");
            bundler::read(path, list.is_file().then_some(list.as_path()), size)?
        };
        let survey = &model.survey;
        let views = survey.images.iter().map(|image| {
            let interior = survey.cameras[image.camera].interior;
            View::new(&image.name, interior, image.pose, Some(image.motion))
        });
        let points =
            survey.points.iter().map(|p| Point { position_m: p.position_m, sigma_z_m: f64::NAN });
        Ok(Block { views: views.collect(), points: points.collect(), crs: None })
    }

    fn aligned(&self, folder: &Path) -> Result<Block, Error> {
        let table = folder.join("exterior_orientation.csv");
        if !table.is_file() {
            return Err(FileError::malformed(
                folder,
                None,
                "no exterior_orientation.csv here: run rowgram align first, or give --model, or --poses with --camera",
            )
            .into());
        }
        let model = folder.join("colmap");
        let views = if self.camera.is_empty() && colmap::find(&model).is_some() {
            // That format knows nothing of how a camera moved.
            let mut views = self.model(&model)?.views;
            let exterior = poses::read(&table)?;
            let motions: BTreeMap<&str, Option<[f64; 6]>> =
                exterior.iter().map(|e| (e.name.as_str(), e.motion)).collect();
            for view in &mut views {
                if let Some(&motion) = motions.get(view.name.as_str()) {
                    *view = View::new(&view.name, view.interior, view.pose, motion);
                }
            }
            views
        } else {
            let exterior = poses::read(&table)?;
            if !self.camera.is_empty() {
                self.posed(&exterior, &table)?
            } else {
                let second = folder.join("camera-2.toml");
                if second.exists() {
                    return Err(FileError::malformed(
                        &table,
                        None,
                        "there are several cameras and the table does not say which photo has which; give --model",
                    )
                    .into());
                }
                let lens = camera::read(&folder.join("camera-1.toml"))?.interior;
                exterior.iter().map(|e| View::new(&e.name, lens, e.pose, e.motion)).collect()
            }
        };
        let table = folder.join("report").join("points.csv");
        let points = if table.is_file() { cloud_points::read(&table)? } else { Vec::new() };
        let crs = std::fs::read_to_string(folder.join("crs.txt")).ok().and_then(|text| {
            let first = text.lines().next()?.trim().to_owned();
            // EPSG:32616, or EPSG:32616+5773 with what heights are measured from.
            let codes = first.strip_prefix("EPSG:")?.split_whitespace().next()?;
            let (code, vertical) =
                codes.split_once('+').map_or((codes, None), |(a, b)| (a, Some(b)));
            let vertical_epsg = vertical.and_then(|text| text.parse().ok());
            Some(Crs { vertical_epsg, ..Crs::projected(code.parse().ok()?) })
        });
        Ok(Block { views, points, crs })
    }

    fn cameras(&self) -> Result<Vec<Camera>, Error> {
        let mut cameras = Vec::new();
        for path in &self.camera {
            match path.extension().and_then(|e| e.to_str()) {
                Some("yaml" | "yml") => cameras.extend(orthority::read(path)?),
                Some("json") => cameras.extend(opensfm::read_poses(path)?.survey.cameras),
                _ => cameras.push(camera::read(path)?),
            }
        }
        Ok(cameras)
    }

    fn posed(&self, exterior: &[poses::Exterior], path: &Path) -> Result<Vec<View>, Error> {
        let cameras = self.cameras()?;
        let by_name: BTreeMap<&str, &Interior> =
            cameras.iter().map(|c| (c.name.as_str(), &c.interior)).collect();
        let one = |e: &poses::Exterior| {
            let named = e.camera.as_deref().and_then(|name| by_name.get(name).copied());
            let lens = match (named, &cameras[..]) {
                (Some(lens), _) => lens,
                (None, [only]) => &only.interior,
                _ => {
                    let names: Vec<&str> = by_name.keys().copied().collect();
                    return Err(FileError::malformed(
                        path,
                        None,
                        format!(
                            "photo {:?} has camera {:?}, which is not one of {names:?}",
                            e.name,
                            e.camera.as_deref().unwrap_or_default()
                        ),
                    )
                    .into());
                }
            };
            Ok(View::new(&e.name, *lens, e.pose, e.motion))
        };
        exterior.iter().map(one).collect()
    }

    /// The photo of each view.
    ///
    /// # Errors
    /// Names the first view without one.
    pub(in crate::cli) fn photos(&self, views: &[View]) -> Result<Vec<PathBuf>, Error> {
        let folder = match (&self.photos, &self.project) {
            (Some(folder), _) => folder.clone(),
            (None, Some(project)) => {
                let images = project.join("images");
                if images.is_dir() { images } else { project.clone() }
            }
            (None, None) => {
                return Err(Error::Argument("give --photos, the folder of the photos".into()));
            }
        };
        let listing = std::fs::read_dir(&folder).map_err(|e| FileError::read(&folder, e))?;
        let mut by_stem: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
        for entry in listing.flatten() {
            let path = entry.path();
            let picture = path.extension().and_then(|e| e.to_str()).is_some_and(|e| {
                matches!(e.to_lowercase().as_str(), "jpg" | "jpeg" | "png" | "tif" | "tiff")
            });
            if let (true, Some(stem)) = (picture, path.file_stem().and_then(|s| s.to_str())) {
                by_stem.entry(stem.to_owned()).or_default().push(path);
            }
        }
        let unposed = by_stem.len().saturating_sub(views.len());
        if unposed > 0 {
            tracing::info!(
                "{unposed} photos of {} have no pose and are not used",
                folder.display()
            );
        }
        let find = |view: &View| {
            let exact = folder.join(&view.name);
            if exact.is_file() {
                return Ok(exact);
            }
            let named = Path::new(&view.name);
            let stems = [named.file_stem().and_then(|s| s.to_str()), Some(view.name.as_str())];
            let found = stems.into_iter().flatten().find_map(|stem| by_stem.get(stem));
            match found.map(Vec::as_slice) {
                Some([one]) => Ok(one.clone()),
                Some(several) => Err(Error::Argument(format!(
                    "{}: {} photos could be {:?}; expected one",
                    folder.display(),
                    several.len(),
                    view.name
                ))),
                None => Err(Error::Argument(format!(
                    "{}: there is no photo {:?}, which has a pose; give --photos, the folder it is in",
                    folder.display(),
                    view.name
                ))),
            }
        };
        views.iter().map(find).collect()
    }
}
