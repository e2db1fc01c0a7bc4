//! Reconstructions of other programs: a model with its tie points, or a table of poses with cameras.

use crate::photo_folder::{flight_photos, photo_name};
use rowgram_base::error::Error;
use rowgram_files::{bundler, camera, colmap, image_names::composed, opensfm, orthority, poses};
use rowgram_optim::output::FileError;
use rowgram_raster::crs;
use rowgram_survey::{
    camera::Camera,
    scene::{
        HorizontalFrame, Image, LengthUnit, Pose, Reconstruction, ReferenceFrame, VerticalFrame,
    },
};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// Where a reconstruction of another program is, and what its files do not say.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ModelImport {
    /// A model in the mapping frame: a COLMAP folder, OpenSfM's `reconstruction.json`, Bundler's `bundle.out`.
    pub model: Option<PathBuf>,
    /// A table of poses (filename, x, y, z, omega, phi, kappa) or Orthority's GeoJSON, in place of a model.
    pub poses: Option<PathBuf>,
    /// Cameras of the poses: `camera.toml`, `reconstruction.json`, Orthority's YAML. Several are told apart by name.
    pub cameras: Vec<PathBuf>,
    /// Added to all coordinates: east, north, up, metres.
    pub offset_m: Option<[f64; 3]>,
    /// The coordinate reference system: `EPSG:<code>` or a PROJ string.
    pub crs: Option<String>,
    /// EPSG code of what heights are measured from, where it is known.
    pub vertical_crs: Option<u32>,
}

impl ModelImport {
    /// The reconstruction. Its lengths are taken to be metres.
    ///
    /// # Errors
    /// Files that cannot be read; poses without a camera, a coordinate reference system that nobody knows.
    pub fn read(&self) -> Result<Reconstruction, Error> {
        let mut reconstruction = match (&self.model, &self.poses) {
            (Some(path), _) => self.model(path)?,
            (None, Some(path)) => self.posed(path)?,
            (None, None) => Reconstruction::default(),
        };
        reconstruction.reference = self.reference()?;
        if let Some(offset_m) = self.offset_m {
            for image in &mut reconstruction.images {
                let centre_m = image.pose.centre_m();
                let moved = std::array::from_fn(|k| centre_m[k] + offset_m[k]);
                image.pose = Pose::from_centre(image.pose.rotation, moved);
            }
            for point in &mut reconstruction.points {
                (0..3).for_each(|k| point.position_m[k] += offset_m[k]);
            }
        }
        Ok(reconstruction)
    }

    /// The frame that was named.
    ///
    /// # Errors
    /// A coordinate reference system that nobody knows.
    pub fn reference(&self) -> Result<ReferenceFrame, Error> {
        let horizontal = match &self.crs {
            None => HorizontalFrame::Unnamed,
            Some(words) => {
                let known = crs::Crs::from_words(words)
                    .map_err(|error| Error::Argument(format!("--crs {words}: {error}")))?;
                HorizontalFrame::from(&known)
            }
        };
        let known = |epsg| VerticalFrame::Known { epsg };
        let vertical = self.vertical_crs.map_or(VerticalFrame::Unknown, known);
        Ok(ReferenceFrame { horizontal, vertical, unit: LengthUnit::Metre })
    }

    fn model(&self, path: &Path) -> Result<Reconstruction, Error> {
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
        Ok(model.survey)
    }

    fn cameras(&self) -> Result<Vec<Camera>, Error> {
        let mut cameras = Vec::new();
        for path in &self.cameras {
            match path.extension().and_then(|e| e.to_str()) {
                Some("yaml" | "yml") => cameras.extend(orthority::read(path)?),
                Some("json") => cameras.extend(opensfm::read_poses(path)?.survey.cameras),
                _ => cameras.push(camera::read(path)?),
            }
        }
        Ok(cameras)
    }

    fn posed(&self, path: &Path) -> Result<Reconstruction, Error> {
        let cameras = self.cameras()?;
        let by_name: BTreeMap<&str, usize> =
            cameras.iter().enumerate().map(|(k, camera)| (camera.name.as_str(), k)).collect();
        let exterior = poses::read(path)?;
        let image = |(k, exterior): (usize, &poses::Exterior)| {
            let named = exterior.camera.as_deref().and_then(|name| by_name.get(name).copied());
            let camera = match (named, cameras.len()) {
                (Some(camera), _) => camera,
                (None, 1) => 0,
                _ => {
                    let names: Vec<&str> = by_name.keys().copied().collect();
                    let message = format!(
                        "photo {:?} has camera {:?}, which is not one of {names:?}",
                        exterior.name,
                        exterior.camera.as_deref().unwrap_or_default()
                    );
                    return Err(Error::from(FileError::malformed(path, None, message)));
                }
            };
            Ok(Image {
                name: exterior.name.clone(),
                id: k as u32 + 1,
                camera,
                pose: exterior.pose,
                motion: exterior.motion.unwrap_or_default(),
                expected_motion: [0.0; 6],
            })
        };
        let images = exterior.iter().enumerate().map(image).collect::<Result<_, Error>>()?;
        Ok(Reconstruction { cameras, images, ..Reconstruction::default() })
    }
}

/// The file of each photo of a reconstruction, among the photos of a folder: the name itself, or the name without its
/// ending.
///
/// # Errors
/// A folder that cannot be read; the first photo without a file, or with several that it could be.
pub fn photo_files(reconstruction: &Reconstruction, folder: &Path) -> Result<Vec<PathBuf>, Error> {
    std::fs::read_dir(folder).map_err(|e| FileError::read(folder, e))?;
    let mut by_stem: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
    let photos = flight_photos(folder).photos;
    let by_name: BTreeMap<String, &PathBuf> =
        photos.iter().map(|path| (photo_name(path, folder), path)).collect();
    for path in &photos {
        if let Some(stem) = path.file_stem().and_then(|stem| stem.to_str()) {
            by_stem.entry(stem.to_owned()).or_default().push(path.clone());
        }
    }
    let find = |image: &Image| {
        let exact = folder.join(&image.name);
        if exact.is_file() {
            return Ok(exact);
        }
        if let Some(path) = by_name.get(&composed(&image.name)) {
            return Ok((*path).clone());
        }
        let named = Path::new(&image.name);
        let stems = [named.file_stem().and_then(|stem| stem.to_str()), Some(image.name.as_str())];
        let found = stems.into_iter().flatten().find_map(|stem| by_stem.get(stem));
        match found.map(Vec::as_slice) {
            Some([one]) => Ok(one.clone()),
            Some(several) => Err(Error::Argument(format!(
                "{}: {} photos could be {:?}; expected one",
                folder.display(),
                several.len(),
                image.name
            ))),
            None => Err(Error::Argument(format!(
                "{}: there is no photo {:?}, which has a pose; expected the folder of the photos",
                folder.display(),
                image.name
            ))),
        }
    };
    reconstruction.images.iter().map(find).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const POSES: &str = "filename,x,y,z,omega,phi,kappa,camera\na.jpg,1,2,30,0,0,0,left\n\
                         b.jpg,4,5,31,0,0,90,right\n";
    const CAMERAS: &str = "left:\n  type: pinhole\n  im_size: [120, 90]\n  focal_len: 0.8\n\
                           right:\n  type: pinhole\n  im_size: [240, 180]\n  focal_len: 0.8\n";

    fn given(folder: &Path) -> ModelImport {
        fs::write(folder.join("poses.csv"), POSES).unwrap();
        fs::write(folder.join("cameras.yaml"), CAMERAS).unwrap();
        ModelImport {
            poses: Some(folder.join("poses.csv")),
            cameras: vec![folder.join("cameras.yaml")],
            ..ModelImport::default()
        }
    }

    #[test]
    fn every_photo_has_the_camera_that_its_pose_names() {
        let folder = tempfile::tempdir().unwrap();
        let import = ModelImport {
            offset_m: Some([100.0, 0.0, -1.0]),
            crs: Some("EPSG:32616".to_owned()),
            vertical_crs: Some(5703),
            ..given(folder.path())
        };
        let found = import.read().unwrap();
        let widths: Vec<u32> = found
            .images
            .iter()
            .map(|image| found.cameras[image.camera].interior.size_px()[0])
            .collect();
        assert_eq!(widths, [120, 240]);
        let centre = found.images[1].pose.centre_m();
        for (found, expected) in centre.into_iter().zip([104.0, 5.0, 30.0]) {
            approx::assert_abs_diff_eq!(found, expected, epsilon = 1e-9);
        }
        assert_eq!(found.reference.vertical, VerticalFrame::Known { epsg: 5703 });
        assert!(found.reference.has_scale());
        let HorizontalFrame::Projected { epsg, .. } = found.reference.horizontal else {
            panic!("{:?}", found.reference)
        };
        assert_eq!(epsg, Some(32616));
        let error = ModelImport { crs: Some("EPSG:4326".into()), ..import }.read().unwrap_err();
        assert!(error.to_string().contains("--crs EPSG:4326"), "{error}");
    }

    #[test]
    fn a_photo_of_an_unknown_camera_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let import = given(folder.path());
        fs::write(folder.path().join("poses.csv"), POSES.replace("right", "rear")).unwrap();
        let error = import.read().unwrap_err().to_string();
        assert!(
            error.contains("\"b.jpg\" has camera \"rear\"") && error.contains("left"),
            "{error}"
        );
    }

    #[test]
    fn photos_are_found_by_name_or_without_their_ending() {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        let reconstruction = given(at).read().unwrap();
        for name in ["a.jpg", "b.tif"] {
            fs::write(at.join(name), "").unwrap();
        }
        let found = photo_files(&reconstruction, at).unwrap();
        assert_eq!(found, [at.join("a.jpg"), at.join("b.tif")]);
        fs::write(at.join("b.png"), "").unwrap();
        let error = photo_files(&reconstruction, at).unwrap_err().to_string();
        assert!(error.contains("2 photos could be \"b.jpg\""), "{error}");
        fs::remove_file(at.join("b.png")).unwrap();
        fs::remove_file(at.join("b.tif")).unwrap();
        let error = photo_files(&reconstruction, at).unwrap_err().to_string();
        assert!(error.contains("there is no photo \"b.jpg\""), "{error}");
    }
}
