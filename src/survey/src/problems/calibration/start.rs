//! Where a calibration begins: nothing is known of the lens.
//!
//! Several principal distances are tried with two shapes of lens, rectilinear (`r = c tan theta`) and
//! equidistant (`r = c theta`), each put into the requested model by a fit of its radial terms. Rays
//! through a trial lens make the view of a plane a homography, whatever the lens; from it follow the
//! poses (Zhang, 2000, section 3.1, with a known matrix). A few robust steps of adjustment from each
//! trial tell which is right: the one of the least cost goes on.

use super::{Request, State, View, adjust};
use crate::camera::{Interior, Lens, Model, lens::to_computer_vision};
use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, UnitQuaternion, Vector3};
use rowgram_optim::{engine::SolveError, geometry::homography::homography, nlls::Loss};

/// Principal distances that are tried, as shares of the longer side of the photos.
const DISTANCES: [f64; 8] = [0.25, 0.36, 0.5, 0.7, 1.0, 1.5, 2.4, 4.0];
/// Steps of adjustment for each trial, and for the best of them.
const TRIAL_ITERATIONS: u64 = 12;
const MAIN_ITERATIONS: u64 = 40;
/// Scale of the loss, pixels: far more than a corner is ever off, far less than a wrong lens makes.
const LOSS: Loss = Loss::Huber(4.0);
/// The widest ray that an equidistant trial puts into a model with a flat image plane.
const WIDEST_RAD: f64 = 1.3;

/// The shape of a trial lens.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shape {
    Rectilinear,
    Equidistant,
}

/// The best start, adjusted a little: interior orientation and poses of all views.
///
/// # Errors
/// [`SolveError::InfeasibleStart`] where no trial sees all views as planes in front of the camera.
pub fn search(views: &[View], request: &Request) -> Result<State, SolveError> {
    trials(views, request)
        .into_iter()
        .find_map(|trial| adjust(views, request, &trial, LOSS, MAIN_ITERATIONS).ok())
        .map(|solution| solution.state)
        .ok_or_else(|| {
            SolveError::InfeasibleStart(
                "no lens was found under which the photos show a plane in front of the camera; \
                 are the corners of each photo in the order of the board?"
                    .into(),
            )
        })
}

/// The states of all successful trials after a few steps, that of the least cost first.
fn trials(views: &[View], request: &Request) -> Vec<State> {
    use rayon::prelude::*;
    let trials: Vec<(Shape, f64)> = [Shape::Rectilinear, Shape::Equidistant]
        .into_iter()
        .flat_map(|shape| DISTANCES.map(|share| (shape, share)))
        .collect();
    // Principal distance and radial terms alone.
    let few = Request { free: radial_only(request), ..request.clone() };
    let mut found: Vec<(f64, State)> = trials
        .par_iter()
        .filter_map(|&(shape, share)| {
            let state = trial(views, request, shape, share)?;
            let first = adjust(views, &few, &state, LOSS, TRIAL_ITERATIONS).ok()?;
            let cost = first.calibration.problem.costs(&first.x).ok()?.iter().sum();
            Some((cost, first.state))
        })
        .collect();
    // Equal costs keep the order of the trials, which is the same for any number of threads.
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.into_iter().map(|(_, state)| state).collect()
}

/// The parameters of the request that shape the radial curve, with the principal distance.
fn radial_only(request: &Request) -> Vec<bool> {
    let parameters = request.model.parameters();
    let mut free = request.free.clone();
    for (free, parameter) in free.iter_mut().zip(parameters) {
        *free &= matches!(parameter.name, "c_px" | "f_px" | "K1" | "K2" | "k1" | "k2");
    }
    if !free.contains(&true) {
        free.clone_from(&request.free);
    }
    free
}

/// Lens and poses of one trial; `None` where the model cannot have that shape, or a view is no
/// plane with it.
fn trial(views: &[View], request: &Request, shape: Shape, share: f64) -> Option<State> {
    let long = f64::from(request.size_px[0].max(request.size_px[1]));
    let interior = lens(views, request, shape, share * long)?;
    let poses = views.iter().map(|view| pose(view, &interior)).collect::<Option<Vec<_>>>()?;
    let corners = views.iter().flat_map(|v| &v.marks).map(|m| m.corner + 1).max().unwrap_or(0);
    Some(State { interior, poses, heights_m: vec![0.0; corners] })
}

/// A lens of the requested model that has nearly this shape over the corners' radii.
fn lens(views: &[View], request: &Request, shape: Shape, distance_px: f64) -> Option<Interior> {
    let model = request.model;
    let mut values = request.values.clone();
    let principal = model.place("c_px").or_else(|| model.place("f_px"))?;
    // A principal distance that is held is no matter of trial.
    if request.free[principal] {
        values[principal] = distance_px;
    }
    let distance = values[principal];
    let centre = [0, 1].map(|k| 0.5 * (f64::from(request.size_px[k]) - 1.0));
    let farthest = views
        .iter()
        .flat_map(|view| &view.marks)
        .map(|m| (m.image_px[0] - centre[0]).hypot(m.image_px[1] - centre[1]))
        .fold(0.0, f64::max);
    let free = |name: &str| model.place(name).filter(|&k| request.free[k]);
    match (model, shape) {
        (Model::Fisheye, Shape::Equidistant) | (_, Shape::Rectilinear) => {
            if model == Model::Fisheye && shape == Shape::Rectilinear {
                // c tan(theta) by powers of theta.
                fit(&mut values, [free("k1"), free("k2")], |share| {
                    let theta = share * (farthest / distance).atan();
                    (theta, theta.tan())
                })?;
            }
        }
        (Model::Brown | Model::Bal, Shape::Equidistant) => {
            let widest = (farthest / distance).min(WIDEST_RAD);
            fit(&mut values, [free("k1"), free("k2")], |share| {
                let theta = share * widest;
                (theta.tan(), theta)
            })?;
        }
        (Model::Smac, Shape::Equidistant) => {
            let widest = farthest.min(WIDEST_RAD * distance);
            fit(&mut values, [free("K1"), free("K2")], |share| {
                let r = share * widest;
                (r, distance * (r / distance).tan())
            })?;
        }
    }
    Interior::new(model, request.size_px, &values).ok()
}

/// Writes the coefficients of `y = x (1 + k1 x^2 + k2 x^4)` that fit a curve from 0 to its end
/// best to their places; those that are not free stay. `None` where the curve is no number.
fn fit(
    values: &mut [f64],
    places: [Option<usize>; 2],
    curve: impl Fn(f64) -> (f64, f64),
) -> Option<()> {
    const POINTS: usize = 40;
    let powers: Vec<(usize, i32)> = places
        .into_iter()
        .zip([2, 4])
        .filter_map(|(place, power)| place.map(|place| (place, power)))
        .collect();
    // Nothing to bend with: only the rectilinear trial is of use.
    if powers.is_empty() {
        return None;
    }
    let end = curve(1.0).0;
    let points: Vec<(f64, f64)> = (1..=POINTS).map(|k| curve(k as f64 / POINTS as f64)).collect();
    let matrix = DMatrix::from_fn(POINTS, powers.len(), |row, column| {
        let x = points[row].0;
        x * (x / end).powi(powers[column].1)
    });
    let right = DVector::from_fn(POINTS, |row, _| points[row].1 - points[row].0);
    let solution = matrix.svd(true, true).solve(&right, 1e-12).ok()?;
    for (k, &(place, power)) in powers.iter().enumerate() {
        let value = solution[k] / end.powi(power);
        if !value.is_finite() {
            return None;
        }
        values[place] = value;
    }
    Some(())
}

/// The pose of the board in a view, from the rays of a lens; `None` where too few of them meet a
/// plane in front of the camera.
pub fn pose(view: &View, interior: &Interior) -> Option<[f64; 7]> {
    let mut pairs = Vec::with_capacity(view.marks.len());
    for mark in &view.marks {
        let Some(ray) = interior.unproject(mark.image_px) else { continue };
        let ray = to_computer_vision(ray);
        // Rays nearly across the axis have no place in a flat image plane.
        if ray[2] > 0.15 {
            pairs.push((mark.board_m, [ray[0] / ray[2], ray[1] / ray[2]]));
        }
    }
    if pairs.len() < 4 || 2 * pairs.len() < view.marks.len() {
        return None;
    }
    let h = homography(&pairs)?;
    let (a, b, t) = (h.column(0).into_owned(), h.column(1).into_owned(), h.column(2).into_owned());
    let scale = 2.0 / (a.norm() + b.norm());
    let scale = if t[2] < 0.0 { -scale } else { scale };
    let (a, b, t) = (a * scale, b * scale, t * scale);
    let rotation = nearest_rotation(a, b)?;
    let q = UnitQuaternion::from_rotation_matrix(&rotation);
    // From the frame of computer vision to the photogrammetric one: half a turn about x.
    let flip = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let q = flip * q;
    let t = to_computer_vision([t[0], t[1], t[2]]);
    let pose = [q.w, q.i, q.j, q.k, t[0], t[1], t[2]];
    let visible = view.marks.iter().all(|mark| {
        let p = rotation_times(&q, mark.board_m, t);
        interior.project(p).is_some()
    });
    visible.then_some(pose)
}

fn rotation_times(q: &UnitQuaternion<f64>, board_m: [f64; 2], t: [f64; 3]) -> [f64; 3] {
    let p = q * Vector3::new(board_m[0], board_m[1], 0.0);
    [p[0] + t[0], p[1] + t[1], p[2] + t[2]]
}

/// The rotation nearest to one whose first two columns are given.
fn nearest_rotation(a: Vector3<f64>, b: Vector3<f64>) -> Option<Rotation3<f64>> {
    let svd = Matrix3::from_columns(&[a, b, a.cross(&b)]).svd(true, true);
    let r = svd.u? * svd.v_t?;
    (r.determinant() > 0.0 && r.iter().all(|v| v.is_finite()))
        .then(|| Rotation3::from_matrix_unchecked(r))
}

/// Corners of a board in any order but the board's lie further from every projective map of it
/// than any lens bends them: this share of the spread of the corners.
const MAX_BEND: f64 = 0.15;

/// Whether a photo can be one of the board: its corners are nearly a projective map of it.
pub fn resembles_plane(view: &View) -> bool {
    let pairs: Vec<_> = view.marks.iter().map(|mark| (mark.board_m, mark.image_px)).collect();
    let Some(h) = homography(&pairs) else { return false };
    let count = pairs.len() as f64;
    let mean: [f64; 2] =
        std::array::from_fn(|k| pairs.iter().map(|pair| pair.1[k]).sum::<f64>() / count);
    let square = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2);
    let spread: f64 = pairs.iter().map(|pair| square(pair.1, mean)).sum();
    let bend: f64 = pairs
        .iter()
        .map(|pair| square(pair.1, rowgram_optim::geometry::homography::apply(&h, pair.0)))
        .sum();
    bend.is_finite() && bend < MAX_BEND * MAX_BEND * spread
}
