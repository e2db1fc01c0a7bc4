//! The leaf mask of an orthomosaic whose cameras have errors, from geometry alone.
//!
//! A point `P` of a leaf appears in a photo at `p = project(true camera, P)`. The map shows it where the
//! ray of `p` by the *adjusted* camera meets the surface of the adjusted block: displaced by the errors of
//! the block, and outwards by about `h tan(angle of view)` where it is `h` above that surface. Each cell
//! of the map takes the photo whose adjusted centre is nearest in plan, so that leaves are cut and
//! doubled at seams as in any mosaic. The share of a cell that leaves cover is blurred, scaled to grey
//! values, spoiled by noise, and cut at a threshold.

use super::{
    adjust::{self, Estimate, normal},
    orthomosaic,
};
use crate::streams::{Stream, drawn};
use data_synth::{
    camera::Camera as TrueCamera,
    corrupt::Weed,
    field::{Field, Frame},
    flight::Shot,
    leaf::Leaf,
    render,
    twin::{Twin, TwinConfig},
};
use image::GrayImage;
use rowgram::{
    camera::{Camera, Interior, Lens},
    mapping::{Surface, view::View},
    problems::adjustment::{CheckPoint, adjust},
    raster::Mask,
    scene::{CameraPosition, Role},
};
use serde::{Deserialize, Serialize};

/// Side of the cells of the surface through the tie points, metres.
const SURFACE_M: f64 = 0.5;

/// Pixels along the side of a cell in which leaves are drawn.
pub(super) const FINE: u32 = 3;
/// Farther than this the map moves no leaf, metres.
const MOVED_M: f64 = 0.3;

/// The errors of what goes in.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Errors {
    /// Misfit of the calibration that is kept fixed, root mean square over the photo, pixels.
    pub(super) lens_px: f64,
    /// Standard deviation of the surveyed control points, each coordinate, metres.
    pub(super) control_m: f64,
    /// Standard deviation of the receiver's positions in plan, metres; twice that in height.
    pub(super) receiver_m: f64,
    /// Mean height of the highest leaf of a plant above the surface that the photos are projected on, metres.
    pub(super) leaf_height_m: f64,
    /// How far the threshold is from the middle between leaf and soil, grey values; above 0 leaf is lost.
    pub(super) threshold_grey: f64,
}

impl Default for Errors {
    fn default() -> Errors {
        Errors {
            lens_px: 0.5,
            control_m: 0.02,
            receiver_m: 0.5,
            leaf_height_m: 0.2,
            threshold_grey: 0.0,
        }
    }
}

/// Which realisation of what is random. Each has streams of its own: another draw of one moves no other.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Draws {
    /// Plants, flight, marks, tie points, weeds and the noise of the pixels.
    pub(super) field: u32,
    pub(super) lens: u32,
    pub(super) control: u32,
    pub(super) receiver: u32,
}

/// How the map sees leaves.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Contrast {
    /// Grey values between soil and leaf.
    pub(super) contrast_grey: f64,
    /// Standard deviation of the noise of a cell, grey values.
    pub(super) noise_grey: f64,
    /// Standard deviation of the blur of photo and resampling, cells.
    pub(super) blur_px: f64,
}

impl Default for Contrast {
    fn default() -> Contrast {
        Contrast { contrast_grey: 80.0, noise_grey: 10.0, blur_px: 0.7 }
    }
}

/// A flight and what came of its adjustment.
pub(super) struct Flown {
    pub(super) twin: Twin,
    pub(super) checks: Vec<CheckPoint>,
    views: Vec<View>,
    surface: Surface,
}

/// Flies over a field and adjusts the block with the errors.
pub(super) fn fly(
    config: &TwinConfig,
    estimate: &Estimate,
    errors: &Errors,
    draws: &Draws,
    seed: u64,
) -> Result<Flown, String> {
    let mut config = config.clone();
    // The errors of survey and receiver come from streams of their own, below.
    (config.targets.survey_horizontal_m, config.targets.survey_vertical_m) = (0.0, 0.0);
    (config.flight.gnss.horizontal_m, config.flight.gnss.vertical_m) = (0.0, 0.0);
    let mut twin = config.build().map_err(|e| e.to_string())?;
    raise(&mut twin.scene.field, errors.leaf_height_m);
    let mut survey = adjust::survey(&twin, estimate, seed)?;
    let lens = misfit(&survey.cameras[0].interior, errors.lens_px, seed, draws.lens)?;
    survey.cameras[0] = Camera::new("calibrated", lens);
    let mut rng = drawn(seed, draws.control.into(), Stream::Control);
    for ground in survey.ground.iter_mut().filter(|ground| ground.role == Role::Control) {
        ground.position_m = ground.position_m.map(|c| c + errors.control_m * normal(&mut rng));
        ground.sigma_m = [errors.control_m.max(1e-4); 3];
    }
    receive(&mut survey.positions, config.flight.gnss.drift_share, errors, draws, seed);
    let adjusted = adjust(&mut survey, &adjust::settings(estimate)?).map_err(|e| e.to_string())?;
    let views = survey
        .images
        .iter()
        .map(|image| {
            View::new(&image.name, survey.cameras[image.camera].interior, image.pose, None)
        })
        .collect();
    let surface = orthomosaic::surface(&survey, SURFACE_M)?;
    Ok(Flown { twin, checks: adjusted.check_points, views, surface })
}

/// Errors of the receiver: a share of the variance is common to the whole flight.
fn receive(
    positions: &mut [CameraPosition],
    common: f64,
    errors: &Errors,
    draws: &Draws,
    seed: u64,
) {
    let sigma = errors.receiver_m;
    let sigmas = [sigma, sigma, 2.0 * sigma];
    let mut rng = drawn(seed, draws.receiver.into(), Stream::Receiver);
    let bias = sigmas.map(|sigma| sigma * common.sqrt() * normal(&mut rng));
    for position in positions {
        for axis in 0..3 {
            position.position_m[axis] +=
                bias[axis] + sigmas[axis] * (1.0 - common).sqrt() * normal(&mut rng);
        }
        position.sigma_m = sigmas.map(|sigma| sigma.max(1e-3));
    }
}

/// A lens that differs from the true one by so much, root mean square over the photo: principal distance,
/// principal point, radial and decentring terms, each with as much at a corner, times a normal number.
fn misfit(lens: &Interior, rms_px: f64, seed: u64, draw: u32) -> Result<Interior, String> {
    let mut rng = drawn(seed, draw.into(), Stream::Input);
    let [width, height] = lens.size_px().map(f64::from);
    let corner = 0.5 * width.hypot(height);
    let c = lens.principal_distance_px();
    // What of each parameter moves a point at the corner by about a pixel.
    let unit = |name: &str| match name {
        "c_px" => c / corner,
        "xp_px" | "yp_px" => 1.0,
        "K1" => corner.powi(-3),
        "K2" => corner.powi(-5),
        "P1" | "P2" => corner.powi(-2),
        _ => 0.0,
    };
    let pattern: Vec<(f64, f64)> = lens
        .parameters()
        .iter()
        .map(|parameter| {
            let value = lens.value(parameter.name).unwrap_or(0.0);
            let unit = unit(parameter.name);
            (value, if unit == 0.0 { 0.0 } else { unit * normal(&mut rng) })
        })
        .collect();
    let moved = |size: f64| {
        let values: Vec<f64> = pattern.iter().map(|(value, step)| value + size * step).collect();
        lens.with_values(&values).map_err(|e| e.to_string())
    };
    let one = rms_between(lens, &moved(1.0)?);
    if one > 0.0 { moved(rms_px / one) } else { Err("a lens without directions".to_owned()) }
}

/// Root mean square distance of where two lenses show the same directions.
fn rms_between(a: &Interior, b: &Interior) -> f64 {
    const STEPS: u32 = 12;
    let [width, height] = a.size_px().map(f64::from);
    let (mut squares, mut count) = (0.0, 0.0);
    for i in 0..=STEPS {
        for j in 0..=STEPS {
            let share = |k: u32| f64::from(k) / f64::from(STEPS);
            let at = [share(i) * (width - 1.0), share(j) * (height - 1.0)];
            if let Some(to) = a.unproject(at).and_then(|ray| b.project(ray)) {
                squares += (to[0] - at[0]).powi(2) + (to[1] - at[1]).powi(2);
                count += 1.0;
            }
        }
    }
    if count > 0.0 { f64::sqrt(squares / count) } else { 0.0 }
}

/// Scales the heights of all leaves so that the highest leaf of a plant is so high in the mean. What is
/// seen from straight above stays as it is.
fn raise(field: &mut Field, height_m: f64) {
    let tops: Vec<f64> = field
        .plants
        .iter()
        .map(|plant| {
            let heights = plant.leaves.iter().flat_map(|leaf| leaf.axis_m.map(|node| node[2]));
            heights.fold(0.0, f64::max)
        })
        .collect();
    let mean = tops.iter().sum::<f64>() / tops.len().max(1) as f64;
    if mean > 0.0 {
        let scale = height_m / mean;
        let leaves = field.plants.iter_mut().flat_map(|plant| &mut plant.leaves);
        leaves.flat_map(|leaf| &mut leaf.axis_m).for_each(|node| node[2] *= scale);
    }
}

impl Flown {
    /// Where the map shows a point of the field by the photo that it takes there; `None` beyond it.
    pub(super) fn shown(&self, point_m: [f64; 3]) -> Option<[f64; 2]> {
        let photo = nearest(&self.centres(), [point_m[0], point_m[1]]);
        self.shown_by(photo, point_m)
    }

    fn centres(&self) -> Vec<[f64; 2]> {
        self.views.iter().map(|view| [view.centre_m()[0], view.centre_m()[1]]).collect()
    }

    fn shown_by(&self, photo: usize, point_m: [f64; 3]) -> Option<[f64; 2]> {
        let (shot, camera): (&Shot, &TrueCamera) = (&self.twin.shots[photo], &self.twin.camera);
        let at = self.views[photo].ground(shot.project(camera, point_m)?, &self.surface)?;
        Some([at[0], at[1]])
    }

    /// The leaf as a photo puts it on the map.
    fn displaced(&self, photo: usize, leaf: &Leaf, base_z_m: f64) -> Option<Leaf> {
        let mut shown = leaf.clone();
        let nodes = self.twin.field().leaf_axis_m(base_z_m, leaf);
        for (node, point_m) in shown.axis_m.iter_mut().zip(nodes) {
            [node[0], node[1]] = self.shown_by(photo, point_m)?;
        }
        Some(shown)
    }

    /// Share of each cell of the map that is leaf, row by row.
    pub(super) fn shares(&self) -> Vec<f32> {
        let field = self.twin.field();
        let [width, height] = cells(&field.frame);
        let centres = self.centres();
        let sources: Vec<usize> = (0..width * height)
            .map(|at| nearest(&centres, cell(&field.frame, at % width, at / width)))
            .collect();
        let mut shares = vec![0.0; width * height];
        for photo in (0..self.views.len()).filter(|photo| sources.contains(photo)) {
            let picture = self.picture(photo, &centres);
            for (at, share) in shares.iter_mut().enumerate().filter(|(at, _)| sources[*at] == photo)
            {
                *share = covered(&picture, at % width, at / width);
            }
        }
        shares
    }

    /// Everything near the cells of a photo, as that photo shows it.
    fn picture(&self, photo: usize, centres: &[[f64; 2]]) -> GrayImage {
        let field = self.twin.field();
        let leaves = field.plants.iter().flat_map(|plant| {
            let far = |node: &[f64; 3]| distance([node[0], node[1]], [plant.x_m, plant.y_m]);
            plant.leaves.iter().flat_map(move |leaf| leaf.axis_m.each_ref().map(far))
        });
        let reach_m = leaves.fold(0.25, f64::max) + MOVED_M;
        let near = |place: [f64; 2]| {
            let least = distance(centres[nearest(centres, place)], place);
            distance(centres[photo], place) < least + 2.0 * reach_m
        };
        let plants = field
            .plants
            .iter()
            .filter(|plant| near([plant.x_m, plant.y_m]))
            .map(|plant| {
                let mut shown = plant.clone();
                let leaves = plant.leaves.iter();
                shown.leaves =
                    leaves.filter_map(|leaf| self.displaced(photo, leaf, plant.z_m)).collect();
                shown
            })
            .collect();
        let weeds: Vec<Weed> = self
            .twin
            .weeds()
            .iter()
            .filter(|weed| near([weed.x_m, weed.y_m]))
            .map(|weed| {
                let base_z_m = field.terrain.height_m(weed.x_m, weed.y_m);
                let mut shown = weed.clone();
                let leaves = weed.leaves.iter();
                shown.leaves =
                    leaves.filter_map(|leaf| self.displaced(photo, leaf, base_z_m)).collect();
                shown
            })
            .collect();
        let field = Field {
            config: field.config.clone(),
            frame: field.frame,
            terrain: field.terrain.clone(),
            plants,
            panels: Vec::new(),
        };
        render::mask(&field, &weeds)
    }

    /// Share of each cell that leaves of the crop cover, seen from straight above.
    pub(super) fn true_shares(&self) -> Vec<f32> {
        let field = self.twin.field();
        let picture = render::mask(field, &[]);
        let [width, height] = cells(&field.frame);
        (0..width * height).map(|at| covered(&picture, at % width, at / width)).collect()
    }
}

/// Columns and rows of the map.
pub(super) fn cells(frame: &Frame) -> [usize; 2] {
    [frame.width_px, frame.height_px].map(|pixels| (pixels / FINE) as usize)
}

/// The middle of a cell of the map, metres.
pub(super) fn cell(frame: &Frame, column: usize, row: usize) -> [f64; 2] {
    place(frame, [column as f64, row as f64])
}

/// The place of a position in the map, metres.
pub(super) fn place(frame: &Frame, [column, row]: [f64; 2]) -> [f64; 2] {
    let fine = |cells: f64| f64::from(FINE) * cells + 0.5 * f64::from(FINE - 1);
    frame.ground(fine(column), fine(row))
}

/// The position in the map of a place.
pub(super) fn position(frame: &Frame, [x_m, y_m]: [f64; 2]) -> [f64; 2] {
    let coarse = |fine: f64| (fine - 0.5 * f64::from(FINE - 1)) / f64::from(FINE);
    frame.pixel(x_m, y_m).map(coarse)
}

fn covered(picture: &GrayImage, column: usize, row: usize) -> f32 {
    let (u, v) = (FINE * column as u32, FINE * row as u32);
    let inside = (0..FINE * FINE)
        .filter(|k| picture.get_pixel(u + k % FINE, v + k / FINE).0[0] != 0)
        .count();
    inside as f32 / (FINE * FINE) as f32
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn nearest(centres: &[[f64; 2]], place: [f64; 2]) -> usize {
    let apart = |k: usize| (centres[k][0] - place[0]).powi(2) + (centres[k][1] - place[1]).powi(2);
    (1..centres.len()).fold(0, |best, k| if apart(k) < apart(best) { k } else { best })
}

/// The mask of cells whose grey value is above the threshold.
pub(super) fn threshold(
    shares: &[f32],
    width: usize,
    contrast: &Contrast,
    offset_grey: f64,
    seed: u64,
    draw: u32,
) -> Mask {
    let height = shares.len() / width;
    let soft = blurred(shares, width, contrast.blur_px);
    let mut rng = drawn(seed, draw.into(), Stream::Pixels);
    let least = 0.5 * contrast.contrast_grey + offset_grey;
    let grey = |share: f32, rng: &mut _| {
        contrast.contrast_grey * f64::from(share) + contrast.noise_grey * normal(rng)
    };
    let data = soft.iter().map(|&share| u8::from(grey(share, &mut rng) > least) * 255).collect();
    Mask { width, height, data }
}

/// A Gaussian blur, first along, then across.
fn blurred(values: &[f32], width: usize, sigma: f64) -> Vec<f32> {
    let reach = (3.0 * sigma).ceil() as usize;
    let mut weights: Vec<f64> = (0..=2 * reach)
        .map(|k| k as f64 - reach as f64)
        .map(|x| (-0.5 * (x / sigma.max(1e-9)).powi(2)).exp())
        .collect();
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|weight| *weight /= sum);
    let height = values.len() / width;
    let mut along = vec![0.0_f32; values.len()];
    for v in 0..height {
        for u in 0..width {
            let at = |k: usize| (u + k).saturating_sub(reach).min(width - 1);
            along[v * width + u] = weights
                .iter()
                .enumerate()
                .map(|(k, &weight)| weight as f32 * values[v * width + at(k)])
                .sum();
        }
    }
    let mut across = vec![0.0_f32; values.len()];
    for v in 0..height {
        for (k, &weight) in weights.iter().enumerate() {
            let from = (v + k).saturating_sub(reach).min(height - 1) * width;
            let (to, from) = (&mut across[v * width..][..width], &along[from..][..width]);
            to.iter_mut().zip(from).for_each(|(to, from)| *to += weight as f32 * from);
        }
    }
    across
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram::camera::Model;

    #[test]
    fn a_misfit_is_as_large_as_it_is_asked_to_be() {
        let values = [3000.0, 5.0, -3.0, 0.0, 4e-9, 0.0, 0.0, 1e-7, 0.0, 0.0];
        let lens = Interior::new(Model::Smac, [4000, 3000], &values).unwrap();
        assert!(rms_between(&lens, &misfit(&lens, 0.0, 1, 0).unwrap()) < 1e-9);
        for draw in 0..5 {
            let found = rms_between(&lens, &misfit(&lens, 2.0, 1, draw).unwrap());
            assert!((found - 2.0).abs() < 0.05, "{draw}: {found}");
        }
        let (one, other) = (misfit(&lens, 2.0, 1, 0).unwrap(), misfit(&lens, 2.0, 1, 1).unwrap());
        assert!(rms_between(&one, &other) > 0.1);
    }

    #[test]
    fn a_blur_keeps_the_sum_and_a_higher_threshold_keeps_less() {
        let mut shares = vec![0.0; 40 * 30];
        for v in 10..20 {
            shares[v * 40 + 8..][..14].fill(1.0);
        }
        let soft = blurred(&shares, 40, 1.2);
        assert!((soft.iter().sum::<f32>() - 140.0).abs() < 1e-3);
        assert!(soft[10 * 40 + 8] < 0.5 && soft[15 * 40 + 15] > 0.999);
        let contrast = Contrast { noise_grey: 0.0, ..Contrast::default() };
        let leaf = |offset: f64| {
            let mask = threshold(&shares, 40, &contrast, offset, 1, 0);
            mask.data.iter().filter(|&&pixel| pixel != 0).count()
        };
        assert!(leaf(-24.0) > leaf(0.0) && leaf(0.0) > leaf(24.0));
        // Half way between leaf and soil edges stay where they are, but for the corners.
        assert!((130..=140).contains(&leaf(0.0)), "{}", leaf(0.0));
    }
}
