//! The surveyed ground points of a project in the frame of its reconstruction, whether they have image measurements or not.

use super::{
    ground,
    inputs::{Frame, Sources},
};
use crate::Project;
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor},
};
use rowgram_files::control;
use rowgram_raster::crs::{Crs, LocalPlane};
use rowgram_survey::scene::{GroundPoint, HorizontalFrame, Reconstruction};

/// Reads the ground points.
///
/// # Errors
/// A project without a table of them, one that cannot be read, points that are nowhere near the photos.
pub(crate) fn surveyed_points(
    project: &Project,
    reconstruction: &Reconstruction,
    monitor: &mut dyn Monitor,
) -> Result<Vec<GroundPoint>, Error> {
    let options = &project.config().align;
    let sources = Sources::of(project, options);
    let Some(path) = &sources.control else {
        return Err(Error::NothingToDo(format!(
            "there are no ground points in {}; expected gcps.csv with the columns label, easting_m, northing_m, height_m",
            project.root().display()
        )));
    };
    if !ground::is_table(path) {
        return Err(Error::NothingToDo(format!(
            "{} has image measurements of its own; expected gcps.csv, a table of points alone",
            path.display()
        )));
    }
    let frame = match &reconstruction.reference.horizontal {
        HorizontalFrame::Projected { definition, .. } => {
            let crs = Crs::from_words(definition)
                .map_err(|e| Error::Argument(format!("the reconstruction: {e}")))?;
            Frame::Map(Box::new(crs))
        }
        HorizontalFrame::LocalPlane { latitude_deg, longitude_deg, height_m } => {
            Frame::Local(LocalPlane::at([*latitude_deg, *longitude_deg, *height_m]))
        }
        HorizontalFrame::Unnamed => Frame::Unnamed,
        HorizontalFrame::Free => Frame::Free,
    };
    let mut read = control::read(path, &sources.defaults, None, sources.crs.is_some())?;
    ground::without_heights(&mut read, &path.display().to_string(), monitor);
    let mut points = read.ground;
    if read.geographic {
        for point in &mut points {
            let [latitude_deg, longitude_deg, height_m] = point.position_m;
            point.position_m = ground::place(&frame, latitude_deg, longitude_deg, height_m)
                .map_err(|e| Error::Argument(format!("{}: {e}", path.display())))?;
        }
    }
    let photos: Vec<[f64; 3]> =
        reconstruction.images.iter().map(|image| image.pose.centre_m()).collect();
    let is_near = |point: &GroundPoint| {
        let [x, y, _] = point.position_m;
        photos.iter().any(|at| (at[0] - x).hypot(at[1] - y) < ground::REACH_M)
    };
    if !points.iter().any(is_near) {
        return Err(Error::Argument(format!(
            "{}: no point is within {:.0} km of the photos, whose system is {}; name the system of the points with [project] crs and align again",
            path.display(),
            ground::REACH_M / 1000.0,
            reconstruction.reference.name()
        )));
    }
    if let Some(choice) = &read.choice {
        let subject = path.display().to_string();
        monitor.diagnostic(&Diagnostic::info("columns-assumed", subject, choice.as_str()));
    }
    Ok(points)
}
