//! The marks of an aligned project, for somebody who looks at every surveyed point in all photos that show it.

use super::{
    Project, align, import,
    marks::{marks_file, read},
};
use crate::record::Key;
use rowgram_base::{error::Error, monitor::Silent};
use rowgram_files::control::MarkSource;
use rowgram_optim::output::FileError;
use rowgram_survey::{
    ground_targets::{ExpectedMark, expected_marks, on_the_ground},
    mapping::{View, view::views},
    scene::{GroundObservation, GroundPoint, Reconstruction, Role},
};
use serde::{Deserialize, Serialize};
use std::{
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

/// A photo of the block.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MarkPhoto {
    /// Its name.
    pub name: String,
    /// Columns and rows.
    pub size_px: [u32; 2],
}

/// A mark.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Mark {
    /// Column and row, pixels.
    pub image_px: [f64; 2],
    /// Standard deviation of each, pixels, where it is given.
    pub sigma_px: Option<f64>,
    /// Whether a program found it; else it was made by hand.
    pub is_found: bool,
    /// How far it is from where all marks of its point put it, pixels.
    pub residual_px: Option<f64>,
}

/// A surveyed point in a photo.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PointSight {
    /// Number of the photo.
    pub photo: usize,
    /// Where the block has it; `None` where it should be outside of the photo.
    pub expected_px: Option<[f64; 2]>,
    /// How many pixels a metre has there.
    pub px_per_m: Option<f64>,
    /// Its mark.
    pub mark: Option<Mark>,
}

/// A surveyed point.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MarkedPoint {
    /// Its name.
    pub label: String,
    /// What it is for.
    pub role: Role,
    /// The photos that should show it, and those that have a mark of it.
    pub sights: Vec<PointSight>,
}

/// All marks of a project.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MarkSheet {
    /// State of the file that it was read from.
    pub revision: String,
    /// The photos of the block.
    pub photos: Vec<MarkPhoto>,
    /// The surveyed points.
    pub points: Vec<MarkedPoint>,
}

/// A mark that is set, moved or removed.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkChange {
    /// Number of the photo.
    pub photo: usize,
    /// Number of the point.
    pub point: usize,
    /// Where the mark is, pixels; `None` removes it.
    pub image_px: Option<[f64; 2]>,
}

/// Changes of a sheet.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkChanges {
    /// Of the sheet that they are changes of.
    pub revision: String,
    /// The changes.
    pub changes: Vec<MarkChange>,
}

/// What became of changes.
#[derive(Debug, Clone, PartialEq)]
pub enum Saved {
    /// The file has them; this is what it says now.
    Written(MarkSheet),
    /// The file is another one by now; nothing was written.
    Outdated,
}

/// Reads and changes the marks of a project.
pub struct MarkEditor {
    path: PathBuf,
    /// Without its tie points.
    reconstruction: Reconstruction,
    views: Vec<View>,
    points: Vec<GroundPoint>,
    grounds: Vec<[f64; 3]>,
    photos: Vec<PathBuf>,
    writing: Mutex<()>,
}

impl MarkEditor {
    /// Opens an aligned project with surveyed points.
    ///
    /// # Errors
    /// A project without reconstruction or surveyed points, photos that are not there.
    pub fn open(project: &Project) -> Result<MarkEditor, Error> {
        let mut reconstruction = project.reconstruction()?;
        let points = align::surveyed_points(project, &reconstruction, &mut Silent)?;
        let photos = import::photo_files(&reconstruction, &project.photo_folder())?;
        let grounds = on_the_ground(&reconstruction, &points);
        reconstruction.points = Vec::new();
        reconstruction.observations = Vec::new();
        Ok(MarkEditor {
            path: marks_file(project),
            views: views(&reconstruction),
            reconstruction,
            points,
            grounds,
            photos,
            writing: Mutex::default(),
        })
    }

    /// The file of a photo.
    pub fn photo(&self, number: usize) -> Option<&Path> {
        self.photos.get(number).map(PathBuf::as_path)
    }

    /// What the file of marks says, and where marks should be.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn sheet(&self) -> Result<MarkSheet, Error> {
        let revision = self.revision()?;
        let table = read(&self.path, &self.reconstruction.images, &self.points)?;
        let marks = table.rows.iter().filter(|row| row.source != MarkSource::Removed);
        let known = marks.filter_map(|row| {
            let (image, ground) = (row.image?, row.ground?);
            let sigma_px = row.sigma_px.unwrap_or(1.0);
            Some((GroundObservation { image, ground, image_px: row.image_px, sigma_px }, row))
        });
        let (observations, rows): (Vec<_>, Vec<_>) = known.unzip();
        let expected =
            expected_marks(&self.reconstruction, &self.views, &self.grounds, &observations);
        let mut marks: Vec<(usize, usize, Mark)> = observations
            .iter()
            .zip(rows)
            .zip(expected.residuals_px)
            .map(|((observed, row), residual_px)| {
                let (image_px, sigma_px) = (row.image_px, row.sigma_px);
                let is_found = row.source == MarkSource::Found;
                let mark = Mark { image_px, sigma_px, is_found, residual_px };
                (observed.ground as usize, observed.image as usize, mark)
            })
            .collect();
        let mut take = |ground: usize, image: usize| {
            let place = marks.iter().position(|(g, i, _)| (*g, *i) == (ground, image))?;
            Some(marks.swap_remove(place).2)
        };
        let mut sights: Vec<Vec<PointSight>> = expected
            .of_points
            .into_iter()
            .enumerate()
            .map(|(ground, expected)| {
                let sight = |ExpectedMark { image, image_px, px_per_m }| PointSight {
                    photo: image,
                    expected_px: Some(image_px),
                    px_per_m: Some(px_per_m),
                    mark: take(ground, image),
                };
                expected.into_iter().map(sight).collect()
            })
            .collect();
        for (ground, photo, mark) in marks {
            let sight = PointSight { photo, expected_px: None, px_per_m: None, mark: Some(mark) };
            sights[ground].push(sight);
        }
        let photo =
            |view: &View| MarkPhoto { name: view.name.clone(), size_px: view.interior.size_px() };
        let point = |(point, sights): (&GroundPoint, Vec<PointSight>)| MarkedPoint {
            label: point.name.clone(),
            role: point.role,
            sights,
        };
        Ok(MarkSheet {
            revision,
            photos: self.views.iter().map(photo).collect(),
            points: self.points.iter().zip(sights).map(point).collect(),
        })
    }

    /// Writes changes into the file, unless it is another one than they were made from.
    ///
    /// # Errors
    /// A photo or point that is not there, a mark outside of its photo, a file that cannot be read or written.
    pub fn save(&self, changes: &MarkChanges) -> Result<Saved, Error> {
        let _one_at_a_time = self.writing.lock().unwrap_or_else(PoisonError::into_inner);
        if self.revision()? != changes.revision {
            return Ok(Saved::Outdated);
        }
        let images = &self.reconstruction.images;
        let mut table = read(&self.path, images, &self.points)?;
        for MarkChange { photo, point, image_px } in &changes.changes {
            let (Some(view), Some(named)) = (self.views.get(*photo), self.points.get(*point))
            else {
                return Err(Error::Argument(format!(
                    "expected a photo below {} and a point below {}, found {photo} and {point}",
                    self.views.len(),
                    self.points.len()
                )));
            };
            let ends = (*photo as u32, *point as u32);
            let Some(at) = image_px else {
                table.remove(ends);
                continue;
            };
            let size = view.interior.size_px().map(f64::from);
            if !(0..2).all(|k| (-0.5..=size[k] - 0.5).contains(&at[k])) {
                return Err(Error::Argument(format!(
                    "{}: the mark of {} is outside of the photo, at {at:?}",
                    view.name, named.name
                )));
            }
            table.set(ends, [&view.name, &named.name], *at, None, MarkSource::Hand);
        }
        table.write(&self.path, true)?;
        self.sheet().map(Saved::Written)
    }

    fn revision(&self) -> Result<String, Error> {
        match std::fs::read(&self.path) {
            Ok(bytes) => Ok(Key::of_bytes(&bytes).to_string()),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(String::new()),
            Err(error) => Err(FileError::read(&self.path, error).into()),
        }
    }
}
