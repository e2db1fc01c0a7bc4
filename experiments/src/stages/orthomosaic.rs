//! Segmentation and local density in three kinds of pictures of one flight: the photo as taken, without its
//! distortion, and the orthomosaic.
//!
//! The flight's block is adjusted from tie points and control, the surface comes from the adjusted points, the
//! mosaic from the adjusted photos over it. The true masks of the photos go the same way as the photos, so that
//! what is compared is the segmentation and not what stands up from the ground; how far the mosaic is from a
//! view from straight above is a number of its own.

use super::adjust::{self, Estimate};
use crate::stage::{Measured, Metric, Stage, Trace, metric};
use data_synth::{
    camera::CameraConfig,
    field::Frame,
    twin::{FlightPreset, TwinConfig},
};
use image::{GrayImage, Rgb, RgbImage};
use rowgram::mapping::undistort::{self, Crop, Interpolation};
use rowgram::{
    mapping::{
        Surface,
        dem::{CloudOptions, SurfacePoint, TriangulatedCloud},
        paint::paint,
        photo::DecodedPhoto,
        select::{PhotoSelector, SelectionOptions},
        view::View,
    },
    raster::{
        Mask, density,
        georeference::{Crs, Georeference},
        mask::Thresholds,
        window::Window,
    },
    scene::Reconstruction,
};
use serde::{Deserialize, Serialize};
use std::sync::{Arc, Mutex};

/// The kind of picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Picture {
    /// As the camera took it.
    Perspective,
    /// As a camera without distortion would have taken it from the same place.
    DistortionFree,
    /// All photos over the surface, each cell from the closest camera.
    Orthomosaic,
}

/// What can be varied.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Parameters {
    /// The field, the flight and the light.
    twin: TwinConfig,
    /// How the block is adjusted.
    estimate: Estimate,
    picture: Picture,
    /// Thresholds of the leaf mask: hue from and to, least saturation, least value.
    tau1: i64,
    tau2: i64,
    tau3: i64,
    tau4: i64,
    /// Side of the window of the local density, pixels, odd.
    window_px: usize,
    /// Side of the cells of the surface, metres.
    surface_m: f64,
    /// Whether the picture is kept.
    trace: bool,
    /// Every so many columns and rows one is kept.
    trace_step: usize,
}

impl Default for Parameters {
    fn default() -> Parameters {
        let mut twin = TwinConfig::preset(FlightPreset::Small);
        twin.camera = CameraConfig::wide(600, 450, 300.0);
        (twin.field.rows, twin.field.row_length_m, twin.field.gsd_m) = (12, 9.0, 0.02);
        twin.field.plots = Default::default();
        (twin.flight.height_m, twin.flight.margin_m) = (6.0, 0.0);
        (twin.flight.position_m, twin.flight.height_drift_m) = (0.2, 0.1);
        (twin.targets.control, twin.targets.check, twin.targets.size_m) = (5, 0, 0.2);
        twin.tie_points.outlier_fraction = 0.0;
        Parameters {
            twin,
            estimate: Estimate::default(),
            picture: Picture::Orthomosaic,
            tau1: 30,
            tau2: 79,
            tau3: 30,
            tau4: 163,
            window_px: 41,
            surface_m: 0.25,
            trace: false,
            trace_step: 2,
        }
    }
}

/// The stage.
pub(crate) struct Orthomosaic;

impl Stage for Orthomosaic {
    type Parameters = Parameters;
    const NAME: &'static str = "orthomosaic";
    const ABOUT: &'static str =
        "leaf masks and density of a flight's photos, undistorted photos and orthomosaic";
    const METRICS: &'static [Metric] = &[
        metric("f1", "F1 of leaf pixels"),
        metric("area_ratio", "found over true leaf area"),
        metric("density_error", "root mean square error of the local density, share of a window"),
        metric(
            "scale_spread",
            "standard deviation of the ground area of a pixel, share of its mean",
        ),
        metric("f1_above", "F1 of a mosaic's leaf pixels against the view from straight above"),
        metric("covered", "share of the picture that shows something"),
        metric("photos", "photos of the flight"),
    ];
    const SEEDED: &'static [&'static str] = &["twin.field.seed"];

    fn check(p: &Parameters) -> Result<(), String> {
        adjust::check(&p.twin, &p.estimate)?;
        Thresholds::new(p.tau1, p.tau2, p.tau3, p.tau4).map_err(|e| e.to_string())?;
        density::half_window(p.window_px).map_err(|e| e.to_string())?;
        if !(p.surface_m > 0.0 && p.surface_m.is_finite()) || p.trace_step == 0 {
            return Err("surface_m and trace_step have to be positive".to_owned());
        }
        Ok(())
    }

    fn run(p: &Parameters, seed: u64) -> Result<Measured, String> {
        let mut config = p.twin.clone();
        config.field.seed = seed;
        let flown = fly(&config, &p.estimate, seed)?;
        let seen = match p.picture {
            Picture::Perspective => perspective(&flown)?,
            Picture::DistortionFree => distortion_free(&flown)?,
            Picture::Orthomosaic => orthomosaic(&flown, p.surface_m)?,
        };
        let thresholds =
            Thresholds::new(p.tau1, p.tau2, p.tau3, p.tau4).map_err(|e| e.to_string())?;
        let found = thresholds.mask(&seen.picture);
        let (width, height) = (found.width, found.height);
        let found = Mask::from_fn(width, height, |u, v| {
            let at = v * width + u;
            found.data[at] != 0 && seen.known[at]
        });
        let mut measured = Measured::default();
        let counts = counts(&found, &seen.truth, &seen.known);
        measured.put("f1", f1(counts));
        measured.put("area_ratio", (counts[2] + counts[3]) / (counts[1] + counts[3]));
        let half = density::half_window(p.window_px).map_err(|e| e.to_string())?;
        let [ours, truth] =
            [&found, &seen.truth].map(|mask| density::rows(mask, half, 0..mask.height));
        let window = (p.window_px * p.window_px) as f64;
        let known = seen.known.iter().filter(|&&known| known).count() as f64;
        let squares: f64 = (0..ours.len())
            .filter(|&at| seen.known[at])
            .map(|at| ((f64::from(ours[at]) - f64::from(truth[at])) / window).powi(2))
            .sum();
        measured.put("density_error", (squares / known).sqrt());
        measured.put("scale_spread", seen.scale_spread);
        if let Some(above) = &seen.above {
            measured.put("f1_above", f1(self::counts(&found, above, &seen.known)));
        }
        measured.put("covered", known / ours.len() as f64);
        measured.put("photos", flown.photos.len() as f64);
        if p.trace {
            let columns = ["u_px", "v_px", "red", "green", "blue", "leaf", "density"];
            let mut trace = Trace::new("picture", &columns);
            for v in (0..height).step_by(p.trace_step) {
                for u in (0..width).step_by(p.trace_step) {
                    let at = v * width + u;
                    if seen.known[at] {
                        let [red, green, blue] =
                            seen.picture.get_pixel(u as u32, v as u32).0.map(f64::from);
                        let leaf = 255.0 * f64::from(found.data[at]);
                        let share = f64::from(ours[at]) / window;
                        trace.rows.push(vec![u as f64, v as f64, red, green, blue, leaf, share]);
                    }
                }
            }
            measured.traces.push(trace);
        }
        Ok(measured)
    }
}

/// True and found leaf in one geometry.
struct Seen {
    picture: RgbImage,
    truth: Mask,
    /// From straight above, where the geometry is that of the map.
    above: Option<Mask>,
    /// Where the picture shows something.
    known: Vec<bool>,
    scale_spread: f64,
}

/// Neither, only true, only found, both.
fn counts(found: &Mask, truth: &Mask, known: &[bool]) -> [f64; 4] {
    let mut counts = [0.0; 4];
    for ((&found, &leaf), _) in
        found.data.iter().zip(&truth.data).zip(known).filter(|(_, known)| **known)
    {
        counts[2 * usize::from(found != 0) + usize::from(leaf != 0)] += 1.0;
    }
    counts
}

fn f1([_, missed, wrong, right]: [f64; 4]) -> f64 {
    2.0 * right / (2.0 * right + missed + wrong)
}

/// A flight with its photos and its adjusted block.
struct Flown {
    /// The raster of the field from straight above, and its leaf mask.
    frame: Frame,
    above: Mask,
    /// Photos and their true masks.
    photos: Vec<(RgbImage, RgbImage)>,
    survey: Reconstruction,
}

/// The last flight: a sweep over pictures and thresholds needs the same one again and again.
static FLOWN: Mutex<Vec<(String, Arc<Flown>)>> = Mutex::new(Vec::new());
const KEPT: usize = 2;

fn fly(config: &TwinConfig, estimate: &Estimate, seed: u64) -> Result<Arc<Flown>, String> {
    let key = toml::to_string(config).map_err(|e| e.to_string())?
        + &toml::to_string(estimate).map_err(|e| e.to_string())?;
    let poisoned = |_| "another thread failed while it took photos".to_owned();
    // Held while the photos are taken: who wants the same ones waits for them.
    let mut kept = FLOWN.lock().map_err(poisoned)?;
    if let Some((_, flown)) = kept.iter().find(|(of, _)| *of == key) {
        return Ok(flown.clone());
    }
    let twin = config.build().map_err(|e| e.to_string())?;
    let survey = adjust::adjusted(&twin, estimate, seed)?;
    let studio = twin.studio();
    let photos = twin
        .shots
        .iter()
        .enumerate()
        .map(|(number, shot)| {
            let photo = studio.photo(shot, number);
            let mask = grey(&photo.mask);
            (photo.image, mask)
        })
        .collect();
    let (frame, above) = (twin.field().frame, leaf(&grey(&twin.scene.mask())));
    let flown = Arc::new(Flown { frame, above, photos, survey });
    if kept.len() >= KEPT {
        kept.remove(0);
    }
    kept.push((key, flown.clone()));
    Ok(flown)
}

/// Three equal channels, for what works on colours.
fn grey(mask: &GrayImage) -> RgbImage {
    RgbImage::from_fn(mask.width(), mask.height(), |u, v| Rgb([mask.get_pixel(u, v).0[0]; 3]))
}

fn leaf(picture: &RgbImage) -> Mask {
    Mask::from_fn(picture.width() as usize, picture.height() as usize, |u, v| {
        picture.get_pixel(u as u32, v as u32).0[0] > 127
    })
}

impl Flown {
    /// The photo in the middle of the flight.
    fn middle(&self) -> Result<usize, String> {
        let photos = self.photos.len();
        if photos == 0 { Err("the flight has no photo".to_owned()) } else { Ok(photos / 2) }
    }

    fn view(&self, image: usize) -> View {
        let image = &self.survey.images[image];
        let interior = self.survey.cameras[image.camera].interior;
        View::new(&image.name, interior, image.pose, None)
    }
}

/// The surface through the adjusted tie points, with cells of this side.
pub(super) fn surface(survey: &Reconstruction, cell_m: f64) -> Result<Surface, String> {
    let points: Vec<SurfacePoint> = survey
        .points
        .iter()
        .map(|point| SurfacePoint { position_m: point.position_m, sigma_z_m: f64::NAN })
        .collect();
    let cloud =
        TriangulatedCloud::new(&points, &CloudOptions::default()).map_err(|e| e.to_string())?;
    let bounds = cloud.bounds_m();
    let size = bounds.map(|[low, high]| ((high - low) / cell_m) as usize + 1);
    let place = Georeference::north_up([bounds[0][0], bounds[1][1]], cell_m, Crs::LOCAL);
    cloud.surface(place, size).map(|(surface, _)| surface).map_err(|e| e.to_string())
}

fn perspective(flown: &Flown) -> Result<Seen, String> {
    let number = flown.middle()?;
    let (picture, mask) = &flown.photos[number];
    Ok(Seen {
        picture: picture.clone(),
        truth: leaf(mask),
        above: None,
        known: vec![true; (mask.width() * mask.height()) as usize],
        scale_spread: spread(&flown.view(number), flown)?,
    })
}

fn distortion_free(flown: &Flown) -> Result<Seen, String> {
    let number = flown.middle()?;
    let (picture, mask) = &flown.photos[number];
    let view = flown.view(number);
    let ideal =
        undistort::ideal_camera(&view.interior, Crop::Inside, 1.0).map_err(|e| e.to_string())?;
    let flat = |picture: &RgbImage, interpolation| {
        undistort::undistort(picture, &view.interior, &ideal, interpolation)
            .map(|(flat, _)| flat)
            .map_err(|e| e.to_string())
    };
    let truth = leaf(&flat(mask, Interpolation::Bilinear)?);
    let pose = flown.survey.images[number].pose;
    Ok(Seen {
        picture: flat(picture, Interpolation::Bicubic)?,
        known: vec![true; truth.data.len()],
        truth,
        above: None,
        scale_spread: spread(&View::new(&view.name, ideal, pose, None), flown)?,
    })
}

fn orthomosaic(flown: &Flown, surface_m: f64) -> Result<Seen, String> {
    let surface = surface(&flown.survey, surface_m)?;
    let views: Vec<View> = (0..flown.photos.len()).map(|image| flown.view(image)).collect();
    let frame = flown.frame;
    let origin = frame.ground(0.0, 0.0);
    let grid = Georeference::north_up(origin, frame.gsd_m, Crs::LOCAL);
    let (width, height) = (frame.width_px as usize, frame.height_px as usize);
    let selector = PhotoSelector::new(&views, &surface, grid, SelectionOptions::default());
    let sources = selector.sources(Window::whole(width, height));
    let mosaic = |which: fn(&(RgbImage, RgbImage)) -> &RgbImage, interpolation| {
        let photos: Vec<DecodedPhoto> =
            flown.photos.iter().map(|both| DecodedPhoto::new(which(both), None)).collect();
        let present: Vec<Option<&DecodedPhoto>> = photos.iter().map(Some).collect();
        let mut rgba = vec![[0; 4]; width * height];
        paint(&sources, &present, None, interpolation, &mut rgba);
        RgbImage::from_fn(width as u32, height as u32, |u, v| {
            let [red, green, blue, _] = rgba[v as usize * width + u as usize];
            Rgb([red, green, blue])
        })
    };
    Ok(Seen {
        picture: mosaic(|both| &both.0, Interpolation::Bicubic),
        truth: leaf(&mosaic(|both| &both.1, Interpolation::Bilinear)),
        above: Some(flown.above.clone()),
        known: sources.source.iter().map(|&source| source != 0).collect(),
        scale_spread: 0.0,
    })
}

/// How unequal the ground areas of a view's pixels are, over a grid of them.
fn spread(view: &View, flown: &Flown) -> Result<f64, String> {
    const PLACES: u32 = 24;
    let surface = surface(&flown.survey, 1.0)?;
    let [width, height] = view.interior.size_px().map(f64::from);
    let mut areas = Vec::new();
    for i in 0..PLACES {
        for j in 0..PLACES {
            let share = |k: u32, size: f64| (f64::from(k) + 0.5) / f64::from(PLACES) * (size - 2.0);
            let at = [share(i, width), share(j, height)];
            let corner = |du: f64, dv: f64| view.ground([at[0] + du, at[1] + dv], &surface);
            if let (Some(a), Some(b), Some(c)) =
                (corner(0.0, 0.0), corner(1.0, 0.0), corner(0.0, 1.0))
            {
                let (right, down) = ([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]]);
                areas.push((right[0] * down[1] - right[1] * down[0]).abs());
            }
        }
    }
    let count = areas.len() as f64;
    let mean = areas.iter().sum::<f64>() / count;
    Ok((areas.iter().map(|area| (area - mean).powi(2)).sum::<f64>() / count).sqrt() / mean)
}
