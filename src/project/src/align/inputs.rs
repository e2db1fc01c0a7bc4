//! Which photos a project has, what their files say, what is known on the ground and in the air.

use super::{
    AlignOptions,
    geotags::{self, PositionFiles},
    ground, known_photos,
};
use crate::{
    Project, Stage,
    photo_folder::UNUSABLE_NAME,
    record::{Key, Store},
};
use rowgram_base::{
    error::Error,
    monitor::{Diagnostic, Monitor, Severity},
};
use rowgram_files::{
    control::Defaults,
    image_names::Names,
    images,
    photo::{Geotag, Metadata},
};
use rowgram_optim::output::FileError;
use rowgram_raster::crs::{Crs, LocalPlane};
use rowgram_survey::{
    camera::{Camera, Model},
    scene::{Axes, HorizontalFrame, LengthUnit, ReferenceFrame, Role, VerticalFrame},
    sfm::{adjust_block::AdjustedBlock, georeference::Known, intrinsics::without_distortion},
};
use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

/// One photo.
pub(super) struct Photo {
    pub(super) path: PathBuf,
    pub(super) name: String,
    pub(super) metadata: Metadata,
    pub(super) size_px: [u32; 2],
    /// Key of the file's bytes.
    pub(super) content: Key,
    /// Index of its camera.
    pub(super) camera: usize,
}

/// Where the coordinates of a project live.
pub(super) enum Frame {
    /// A reference system that somebody named, or that the control can only be in.
    Map(Box<Crs>),
    /// That of the control, which nobody named.
    Unnamed,
    /// A plane at a place on the ellipsoid.
    Local(LocalPlane),
    /// None: nothing is known on the ground or in the air.
    Free,
}

impl Frame {
    /// As the reconstruction's file has it.
    pub(super) fn reference(&self, georeferenced: bool, has_control: bool) -> ReferenceFrame {
        if !georeferenced {
            return ReferenceFrame::default();
        }
        ReferenceFrame {
            horizontal: match self {
                Frame::Map(crs) => HorizontalFrame::from(&**crs),
                Frame::Unnamed => HorizontalFrame::Unnamed,
                Frame::Local(plane) => HorizontalFrame::from(plane),
                Frame::Free => HorizontalFrame::Free,
            },
            vertical: if has_control {
                VerticalFrame::ControlPoints
            } else {
                VerticalFrame::CameraPositions
            },
            unit: LengthUnit::Metre,
        }
    }
}

/// Everything that is known before a photo is looked at.
pub(super) struct Inputs {
    pub(super) photos: Vec<Photo>,
    /// The cameras at their start, and where their principal distance comes from; `None` where it is
    /// only a guess.
    pub(super) cameras: Vec<(Camera, Option<String>)>,
    /// Whether the cameras were calibrated beforehand.
    pub(super) calibrated: bool,
    pub(super) frame: Frame,
    pub(super) known: Known,
    /// For each photo whether the accuracy of its position was given.
    pub(super) has_position_sigma: Vec<bool>,
    /// Horizontal positions for the choice of neighbours, metres; NaN where there is none.
    pub(super) plan_m: Vec<[f64; 2]>,
    /// Where each photo was taken, as far as that is used.
    pub(super) tags: Vec<Option<Geotag>>,
    /// Photos that are left out, and why.
    pub(super) left_out: Vec<(String, String)>,
    /// Files that are the same as a photo, and as which.
    pub(super) copies: Vec<(String, String)>,
}

impl Inputs {
    /// The photos in the order in which they were taken, as far as they tell: by moment, then by name.
    pub(super) fn flight(&self) -> Vec<usize> {
        flight(&self.photos)
    }

    /// The names of the photos.
    pub(super) fn names(&self) -> Vec<&str> {
        self.photos.iter().map(|photo| photo.name.as_str()).collect()
    }

    /// The cameras.
    pub(super) fn cameras(&self) -> Vec<Camera> {
        self.cameras.iter().map(|(camera, _)| camera.clone()).collect()
    }

    /// The frame as the reconstruction has it, whose heights are those of the control that takes part.
    pub(super) fn reference(&self, found: &AdjustedBlock) -> ReferenceFrame {
        let mut ground = found.adjusted.reconstruction.ground.iter();
        let has_control = ground.any(|point| point.role == Role::Control && point.axes != Axes::Xy);
        self.frame.reference(found.georeferenced, has_control)
    }

    /// Sizes that image measurements may have been made in, relative to the photos.
    pub(super) fn mark_scales(&self) -> Vec<f64> {
        let mut scales = vec![0.25, 0.5, 2.0, 4.0];
        for photo in &self.photos {
            if let Some([width, _]) = photo.metadata.written_size_px {
                let scale = f64::from(photo.size_px[0]) / f64::from(width);
                if (scale - 1.0).abs() > 0.01 && !scales.iter().any(|s| (s - scale).abs() < 0.01) {
                    scales.push(scale);
                }
            }
        }
        scales
    }

    /// A photo in grey.
    pub(super) fn read_grey(&self, image: usize) -> Result<image::GrayImage, Error> {
        Ok(rowgram_survey::features::grey(&images::read_photo(&self.photos[image].path)?))
    }
}

/// Where things are, and what the settings say about them.
pub(super) struct Sources<'a> {
    pub(super) crs: Option<&'a str>,
    pub(super) control: Option<PathBuf>,
    pub(super) marks: Option<PathBuf>,
    /// Files of camera positions.
    pub(super) positions: PositionFiles,
    pub(super) camera: Option<PathBuf>,
    pub(super) check: &'a [String],
    pub(super) keep: &'a [String],
    pub(super) use_positions: bool,
    /// Standard deviation of a gimbal's roll and pitch, degrees; 0: not used.
    pub(super) gimbal_sigma_deg: f64,
    pub(super) model: Model,
    pub(super) defaults: Defaults,
}

/// The usual names of files of ground control.
pub(crate) const CONTROL: [&str; 6] = [
    "gcps.csv",
    "gcp_list.txt",
    "ground_control_points.json",
    "gcps.txt",
    "images/gcp_list.txt",
    "gcp.csv",
];

impl<'a> Sources<'a> {
    pub(super) fn of(project: &'a Project, options: &'a AlignOptions) -> Sources<'a> {
        let settings = &project.config().project;
        let calibrated = || project.finished(Stage::Calibrate, "camera.toml");
        Sources {
            crs: settings.crs.as_deref(),
            control: project.given(settings.control.as_ref(), &CONTROL),
            marks: project.given(settings.marks.as_ref(), &["marks.csv"]),
            positions: geotags::files(project, settings.positions.as_ref()),
            camera: project.given(settings.camera.as_ref(), &["camera.toml"]).or_else(calibrated),
            check: &options.check,
            keep: &options.keep,
            use_positions: options.use_positions,
            gimbal_sigma_deg: options.gimbal_sigma_deg,
            model: options.lens.model(),
            defaults: Defaults {
                mark_px: options.mark_sigma_px,
                control_m: options.control_sigma_m,
                ..Defaults::default()
            },
        }
    }
}

/// The files beside the photos that are read.
pub(super) fn beside(project: &Project) -> Vec<PathBuf> {
    let options = AlignOptions::default();
    let Sources { control, marks, positions, camera, .. } = Sources::of(project, &options);
    // Only a table of control has its image measurements beside it.
    let marks = marks.filter(|_| control.as_deref().is_some_and(ground::is_table));
    let positions: Vec<PathBuf> = positions.used().cloned().collect();
    [control, marks, camera].into_iter().flatten().chain(positions).collect()
}

/// Reads everything that is known beforehand; photos that the store knows are not read again.
///
/// # Errors
/// Control that cannot be read, a coordinate reference system that is none.
pub(super) fn inspect(
    project: &Project,
    options: &AlignOptions,
    store: Option<&Store>,
    monitor: &mut dyn Monitor,
) -> Result<Inputs, Error> {
    let sources = &Sources::of(project, options);
    let named = |path: PathBuf| (path.clone(), project.photo_name(&path));
    let files: Vec<(PathBuf, String)> = project.photos().into_iter().map(named).collect();
    let read = known_photos::read(project, &files, store)?;
    set_aside(project, monitor);
    let mut photos: Vec<Photo> = Vec::new();
    let (mut left_out, mut copies) = (Vec::new(), Vec::new());
    // Names of copies are longer: "IMG_1 (1).JPG".
    let mut originals: HashMap<Key, String> = HashMap::new();
    for photo in read.iter().flatten() {
        let name = originals.entry(photo.content).or_insert_with(|| photo.name.clone());
        if photo.name.len() < name.len() {
            name.clone_from(&photo.name);
        }
    }
    for photo in read {
        match photo {
            Err(fault) => left_out.push(fault),
            Ok(photo) => match &originals[&photo.content] {
                original if *original == photo.name => photos.push(photo),
                original => {
                    copies.push((photo.name.clone(), format!("it is the same file as {original}")));
                }
            },
        }
    }
    left_out
        .extend(project.unusable_photos().into_iter().map(|name| (name, UNUSABLE_NAME.to_owned())));
    for (name, reason) in left_out.iter().chain(&copies) {
        monitor.diagnostic(&Diagnostic::warning(
            "photo-left-out",
            name.as_str(),
            format!("left out: {reason}"),
        ));
    }
    let cameras = cameras(&mut photos, sources, monitor)?;
    unread(&photos, monitor);
    let order = flight(&photos);
    let tags = geotags::geotags(&photos, &order, sources, monitor)?;
    let (frame, known, has_position_sigma) = ground::read(&photos, &tags, sources, monitor)?;
    let plan_m = ground::plan_m(&tags);
    tracing::debug!(
        "{} photos, {} with a position, {} ground points, {} marks; frame: {}",
        photos.len(),
        plan_m.iter().filter(|p| p[0].is_finite()).count(),
        known.ground.len(),
        known.marks.len(),
        frame.reference(true, known.has_control()).name()
    );
    let calibrated = sources.camera.is_some();
    Ok(Inputs {
        photos,
        cameras,
        calibrated,
        frame,
        known,
        has_position_sigma,
        plan_m,
        tags,
        left_out,
        copies,
    })
}

fn flight(photos: &[Photo]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..photos.len()).collect();
    order.sort_by(|&a, &b| {
        let (a, b) = (&photos[a], &photos[b]);
        a.metadata.moment.cmp(&b.metadata.moment).then(a.name.cmp(&b.name))
    });
    order
}

/// Names files that lie among the photos and are not used.
fn set_aside(project: &Project, monitor: &mut dyn Monitor) {
    let bands = project.bands();
    let Some(first) = bands.first() else { return };
    let message = format!(
        "{} files are bands of a multispectral camera, the first {}: set aside; the colour photos are used",
        bands.len(),
        project.photo_name(first)
    );
    monitor.diagnostic(&Diagnostic::info("bands-set-aside", "photos", message));
}

/// Says what of the photos' EXIF could not be read.
fn unread(photos: &[Photo], monitor: &mut dyn Monitor) {
    let damaged: Vec<&Photo> = photos.iter().filter(|p| !p.metadata.unread.is_empty()).collect();
    let Some(first) = damaged.first() else { return };
    let message = format!(
        "{} photos have EXIF that is damaged in part ({}, the first {}); what can be read is used",
        damaged.len(),
        first.metadata.unread,
        first.name
    );
    let lacks = |p: &&Photo| p.metadata.geotag.is_none() || p.metadata.focal_mm.is_none();
    let severity = if damaged.iter().any(lacks) { Severity::Warning } else { Severity::Info };
    monitor.diagnostic(&Diagnostic::new(severity, "exif-damaged", "photos", message));
}

/// Focal lengths of one camera, apart by less than this share of them: what EXIF says of a fixed lens differs by rounding
/// and by focus, by some tenths of a percent; the steps of a zoom are several percent.
const SAME_FOCAL: f64 = 0.01;

/// Whether photos with these heads and sizes are of one camera: by make, model, size and focal length.
pub(crate) fn is_same_camera(
    (a, a_px): (&Metadata, [u32; 2]),
    (b, b_px): (&Metadata, [u32; 2]),
) -> bool {
    let focal = |of: &Metadata| of.focal_mm.or(of.focal_35mm);
    let is_same_focal = match (focal(a), focal(b)) {
        (Some(a), Some(b)) => (a - b).abs() <= SAME_FOCAL * a.max(b),
        (a, b) => a == b,
    };
    (&a.make, &a.model, a_px) == (&b.make, &b.model, b_px) && is_same_focal
}

/// Photos of one camera share its lens.
fn cameras(
    photos: &mut [Photo],
    sources: &Sources<'_>,
    monitor: &mut dyn Monitor,
) -> Result<Vec<(Camera, Option<String>)>, Error> {
    let given = match &sources.camera {
        Some(path) => Some((path.as_path(), rowgram_files::camera::read(path)?)),
        None => None,
    };
    // The first photo of each.
    let mut groups: Vec<usize> = Vec::new();
    let mut cameras = Vec::new();
    // A photo without metadata has the camera of the others of its size, if there is one.
    let described: Vec<(usize, [u32; 2])> = photos
        .iter()
        .enumerate()
        .filter(|(_, p)| p.metadata.focal_mm.is_some() || p.metadata.focal_35mm.is_some())
        .map(|(k, p)| (k, p.size_px))
        .collect();
    let mut adopted = Vec::new();
    for k in 0..photos.len() {
        let size_px = photos[k].size_px;
        let own = photos[k].metadata.focal_mm.is_some() || photos[k].metadata.focal_35mm.is_some();
        let adopts = described.iter().find(|(_, size)| *size == size_px);
        let like = match (own, adopts) {
            (false, Some((other, _))) => {
                adopted.push(photos[k].name.clone());
                *other
            }
            _ => k,
        };
        let metadata = &photos[like].metadata;
        let label = match metadata.focal_mm.or(metadata.focal_35mm) {
            Some(focal) => format!("{} {} {focal:.3} mm", metadata.make, metadata.model),
            None => format!("{} {} unknown camera", metadata.make, metadata.model),
        };
        let label = label.trim();
        let is_of = |first: &usize| {
            let first = &photos[*first];
            is_same_camera((metadata, size_px), (&first.metadata, first.size_px))
        };
        let place = match groups.iter().position(is_of) {
            Some(place) => place,
            None => {
                groups.push(like);
                let name = photos[k].name.as_str();
                let names = (label, name);
                cameras.push(start(names, size_px, metadata, sources.model, given.as_ref())?);
                groups.len() - 1
            }
        };
        photos[k].camera = place;
    }
    if !adopted.is_empty() && adopted.len() < photos.len() {
        let message =
            "no camera data in the file; taken as photos of the camera of the others of that size";
        monitor.diagnostic(&Diagnostic::warning("camera-assumed", adopted.join(", "), message));
    }
    for (camera, source) in &cameras {
        if source.is_none() {
            let message =
                "the files do not tell the focal length; it is estimated from the matches";
            monitor.diagnostic(&Diagnostic::warning(
                "focal-length-unknown",
                camera.name.as_str(),
                message,
            ));
        }
    }
    Ok(cameras)
}

fn start(
    (label, photo): (&str, &str),
    size_px: [u32; 2],
    metadata: &Metadata,
    model: Model,
    given: Option<&(&Path, Camera)>,
) -> Result<(Camera, Option<String>), Error> {
    if let Some((path, camera)) = given {
        if camera.interior.size_px() != size_px {
            let [[width, height], [own_width, own_height]] = [camera.interior.size_px(), size_px];
            let message = format!(
                "it is for images of {width} x {height} pixels, {photo} has {own_width} x {own_height}: take photos of another size out of the folder, or give the camera of these photos"
            );
            return Err(FileError::malformed(path, None, message).into());
        }
        return Ok((camera.clone(), Some(path.display().to_string())));
    }
    let found = metadata.principal_distance_px(size_px);
    let [width, height] = size_px.map(f64::from);
    let c = found.map_or(1.2 * width.max(height), |(c, _)| c);
    let mut camera = without_distortion(label, model, size_px, c)
        .map_err(|e| Error::Argument(format!("camera {label}: {e}")))?;
    // What the maker says of a focal length is good to a few per cent.
    camera.standard_deviations[0] = Some(if found.is_some() { 0.05 * c } else { 0.3 * c });
    Ok((camera, found.map(|(_, source)| source.to_owned())))
}

/// The names of the photos, to match other names against.
pub(super) fn names(photos: &[Photo]) -> Names<'_> {
    Names::new(photos.iter().map(|photo| photo.name.as_str()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn focal_lengths_of_one_lens_may_differ_a_little() {
        let head = |focal_mm: f64| Metadata { focal_mm: Some(focal_mm), ..Metadata::default() };
        let is_same = |a: f64, b: f64, b_px: [u32; 2]| {
            is_same_camera((&head(a), [4000, 3000]), (&head(b), b_px))
        };
        assert!(is_same(4.301, 4.312, [4000, 3000]));
        assert!(!is_same(4.3, 4.6, [4000, 3000]));
        assert!(!is_same(4.3, 4.3, [160, 120]));
        let unknown = Metadata::default();
        assert!(!is_same_camera((&head(4.3), [40, 30]), (&unknown, [40, 30])));
    }

    #[test]
    fn a_photo_that_is_not_of_the_given_camera_is_named() {
        let camera = without_distortion("given", Model::Brown, [4000, 3000], 3500.0).unwrap();
        let given = (Path::new("camera.toml"), camera);
        let names = ("", "thumb.jpg");
        let error = start(names, [160, 120], &Metadata::default(), Model::Brown, Some(&given));
        let error = error.unwrap_err().to_string();
        assert!(error.contains("thumb.jpg has 160 x 120"), "{error}");
    }
}
