//! What was found joins the marks made by hand, which stay as they are: a mark that was found where there is one by hand is not
//! written, nor where a person took one back. Marks that were found before are found anew.

use super::Project;
use rowgram_base::error::Error;
use rowgram_files::{
    control::{MarkRow, MarkSource, MarkTable},
    image_names::Names,
};
use rowgram_survey::{
    ground_targets::FoundTargets,
    scene::{GroundPoint, Image},
};
use std::path::{Path, PathBuf};

/// How far marks made by hand may be from where all photos have their points: so many sizes of a target, and pixels.
const NEAR_SIZES: f64 = 1.5;
const NEAR_PX: f64 = 10.0;

/// Where a project has its marks.
pub(super) fn marks_file(project: &Project) -> PathBuf {
    let named = project.config().project.marks.as_ref();
    project.given(named, &["marks.csv"]).unwrap_or_else(|| project.root().join("marks.csv"))
}

/// The marks of a file; none where there is no file.
pub(super) fn read(
    path: &Path,
    images: &[Image],
    points: &[GroundPoint],
) -> Result<MarkTable, Error> {
    match path.is_file() {
        true => Ok(MarkTable::read(path, &Names::of(images), points)?),
        false => Ok(MarkTable::default()),
    }
}

/// Puts what was found beside the marks of a file that were made by hand, and says how many of these there are.
///
/// # Errors
/// Marks made by hand most of which contradict the photos.
pub(super) fn join(
    path: &Path,
    mut table: MarkTable,
    found: &FoundTargets,
    (images, points): (&[Image], &[GroundPoint]),
) -> Result<(MarkTable, usize), Error> {
    table.rows.retain(|row| row.source != MarkSource::Found);
    let by_hand = || table.rows.iter().filter(|row| row.source == MarkSource::Hand);
    let ends = |row: &MarkRow| Some((row.image? as usize, row.ground? as usize));
    let contradicts = by_hand().filter_map(|row| {
        let ends = ends(row)?;
        let at = found.sightings.iter().find(|at| (at.image, at.ground) == ends)?;
        let [u, v] = at.outcome.as_ref().map_or(at.predicted_px, |found| found.image_px);
        let off_px = (row.image_px[0] - u).hypot(row.image_px[1] - v);
        Some(off_px > NEAR_SIZES * at.size_px + NEAR_PX)
    });
    let contradicts: Vec<bool> = contradicts.collect();
    let wrong = contradicts.iter().filter(|wrong| **wrong).count();
    if 2 * wrong > contradicts.len() {
        return Err(Error::Argument(format!(
            "{}: {wrong} of {} marks made by hand are farther than a target from where the photos have their points; see that columns and rows \
             are pixels of these photos and labels those of the points, or replace all marks with --force",
            path.display(),
            contradicts.len()
        )));
    }
    let by_hand = by_hand().count();
    let taken: Vec<(usize, usize)> = table.rows.iter().filter_map(ends).collect();
    for (sighting, measured) in found.measurements() {
        if taken.contains(&(sighting.image, sighting.ground)) {
            continue;
        }
        let names = [images[sighting.image].name.as_str(), points[sighting.ground].name.as_str()];
        let ends = (sighting.image as u32, sighting.ground as u32);
        table.set(ends, names, measured.image_px, Some(measured.sigma_px), MarkSource::Found);
    }
    Ok((table, by_hand))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_survey::{
        ground_targets::{NotFound, TargetKind, TargetMeasurement, TargetSighting},
        scene::{Axes, Pose, Role},
    };

    fn block() -> (Vec<Image>, Vec<GroundPoint>) {
        let pose = Pose { rotation: [1.0, 0.0, 0.0, 0.0], translation: [0.0; 3] };
        let image = |name: &str| Image {
            name: name.to_owned(),
            id: 0,
            camera: 0,
            pose,
            motion: [0.0; 6],
            expected_motion: [0.0; 6],
        };
        let point = |name: &str| GroundPoint {
            name: name.to_owned(),
            position_m: [0.0; 3],
            sigma_m: [0.02; 3],
            role: Role::Control,
            axes: Axes::Xyz,
        };
        (["a.jpg", "b.jpg", "c.jpg"].map(image).into(), ["T1", "T2"].map(point).into())
    }

    fn found(at: &[(usize, usize, f64)]) -> FoundTargets {
        let sighting = |&(image, ground, u): &(usize, usize, f64)| TargetSighting {
            ground,
            image,
            predicted_px: [u + 1.0, 50.0],
            size_px: 20.0,
            outcome: match image {
                2 => Err(NotFound::Unconfirmed),
                _ => Ok(TargetMeasurement {
                    image_px: [u, 50.0],
                    sigma_px: 0.1,
                    score: 0.9,
                    code: None,
                    residual_px: None,
                }),
            },
        };
        FoundTargets {
            kind: TargetKind::Disc,
            size_m: 0.2,
            shift_m: [0.0; 3],
            shift_sigma_m: 0.0,
            sightings: at.iter().map(sighting).collect(),
        }
    }

    /// The lines of the file after what was found has joined `text`.
    fn joined(text: &str, found: &FoundTargets) -> Result<(Vec<String>, usize), String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("marks.csv");
        let (images, points) = block();
        std::fs::write(&path, text).unwrap();
        let table = read(&path, &images, &points).unwrap();
        let (table, by_hand) =
            join(&path, table, found, (&images, &points)).map_err(|error| error.to_string())?;
        table.write(&path, true).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        Ok((text.lines().skip(1).map(str::to_owned).collect(), by_hand))
    }

    #[test]
    fn marks_made_by_hand_win_and_nothing_is_lost() {
        let found = found(&[(0, 0, 30.0), (1, 0, 60.0), (2, 0, 90.0), (1, 1, 10.0), (0, 1, 40.0)]);
        let text = "image,label,u_px,v_px,sigma_px,source,note\n\
                    a.jpg,T1,31.5,50,,,wind\n\
                    c.jpg,T1,91,50,,,\n\
                    d.jpg,T1,7,8,,,another flight\n\
                    b.jpg,T2,200,200,0.1,found,\n\
                    a.jpg,T2,300,300,0.1,removed,\n\
                    c.jpg,T2,5,5,0.1,found,\n";
        let (lines, by_hand) = joined(text, &found).unwrap();
        assert_eq!(by_hand, 3);
        assert_eq!(
            lines,
            [
                "a.jpg,T1,31.5,50,,,wind",
                "c.jpg,T1,91,50,,,",
                "d.jpg,T1,7,8,,,another flight",
                "a.jpg,T2,300,300,0.1,removed,",
                "b.jpg,T1,60.000,50.000,0.100,found,",
                "b.jpg,T2,10.000,50.000,0.100,found,",
            ]
        );
        // Once more changes nothing.
        let text = format!("image,label,u_px,v_px,sigma_px,source,note\n{}\n", lines.join("\n"));
        assert_eq!(joined(&text, &found).unwrap(), (lines, 3));
    }

    #[test]
    fn marks_of_other_photos_are_not_joined() {
        let found = found(&[(0, 0, 3000.0), (1, 0, 2000.0), (1, 1, 1000.0)]);
        let resized =
            "image,label,u_px,v_px\na.jpg,T1,1500,25\nb.jpg,T1,1000,25\nb.jpg,T2,1000,50\n";
        let error = joined(resized, &found).unwrap_err();
        assert!(error.contains("2 of 3 marks made by hand"), "{error}");
        assert!(error.contains("marks.csv") && error.contains("--force"), "{error}");
    }
}
