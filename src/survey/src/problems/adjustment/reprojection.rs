//! The image of a point through any built-in lens, with or without a rolling shutter.
//!
//! ```text
//! P = R X + t + tau s       tau: share of the readout, -1/2 .. 1/2; s = 0 without motion
//! r = (u(P; interior) - u_measured) / sigma
//! ```
//!
//! Blocks: `Pose` (or `PoseWithParameters(3)` with `s`), lens, point. A lens block holds the parameters of
//! any model with the image centre as origin, then a number for the model; what the model does not
//! have is frozen.

use crate::{
    camera::{Interior, Lens, MAX_PARAMETERS, Model},
    problems::pose_chain::{by_increment, by_world, to_camera},
};
use rowgram_optim::{
    engine::SolveError,
    geometry::rotation,
    lanes::Lane,
    nlls::{
        Dim, Linearized, LinearizedProjection, Loss, Measurement, Problem, ProjectionBatch,
        ProjectionFactor,
    },
};

/// Length of a lens block.
pub(super) const LENS: usize = MAX_PARAMETERS + 1;
/// Numbers prepared per image: rotation by rows, translation, range of the model, lens block.
const GLOBAL_SHUTTER: usize = 13 + LENS;
/// The same and the shift during readout.
const ROLLING_SHUTTER: usize = GLOBAL_SHUTTER + 3;
/// Numbers per observation: position from the image centre, 1/sigma, share of the readout.
pub(super) const DATA: usize = 4;

/// An image at rest.
#[derive(Debug, Clone, Copy)]
struct GlobalShutterFactor;

/// An image in motion.
#[derive(Debug, Clone, Copy)]
struct RollingShutterFactor;

/// The number of SMAC with its residual in the corrected domain: behind those of all models.
const CORRECTED: f64 = Model::ALL.len() as f64;

fn number(model: Model) -> f64 {
    model as usize as f64
}

fn model(number: f64) -> Model {
    Model::ALL.get(number as usize).copied().unwrap_or(Model::Smac)
}

/// The lens block of an interior orientation.
pub(super) fn lens_block(interior: &Interior, corrected: bool) -> [f64; LENS] {
    let mut block = [0.0; LENS];
    let values = interior.values();
    block[..values.len()].copy_from_slice(values);
    if let Some(place) = interior.model().absolute_principal_point() {
        block[place] -= interior.centre_px()[0];
        block[place + 1] -= interior.centre_px()[1];
    }
    block[LENS - 1] = if corrected { CORRECTED } else { number(interior.model()) };
    block
}

/// The parameters in a lens block, in the terms of `interior`.
pub(super) fn lens_values(interior: &Interior, block: &[f64]) -> Vec<f64> {
    let mut values = block[..interior.values().len()].to_vec();
    if let Some(place) = interior.model().absolute_principal_point() {
        values[place] += interior.centre_px()[0];
        values[place + 1] += interior.centre_px()[1];
    }
    values
}

fn prepare<const Q: usize>(kept: &[f64], lens: &[f64]) -> [f64; Q] {
    let mut out = [0.0; Q];
    let r = rotation::matrix([kept[0], kept[1], kept[2], kept[3]]);
    for k in 0..3 {
        out[3 * k..3 * k + 3].copy_from_slice(&r[k]);
        out[9 + k] = kept[4 + k];
    }
    out[12] = Interior::unchecked(model(lens[LENS - 1]), [0, 0], [0.0; 2], lens).valid_radius();
    out[13..GLOBAL_SHUTTER].copy_from_slice(lens);
    if kept.len() > 7 {
        out[GLOBAL_SHUTTER..].copy_from_slice(&kept[7..]);
    }
    out
}

/// What the lens is asked: point, measured position, range, lens block.
const ASKED: usize = 6 + LENS;
/// What it answers: residual, by point, by parameters.
const ANSWERED: usize = 2 + 6 + 2 * MAX_PARAMETERS;

fn lens_of(asked: &[f64; ASKED]) -> Interior {
    Interior::with_valid_radius(model(asked[ASKED - 1]), [0.0; 2], &asked[6..], asked[5])
}

/// Residual in pixels; NaN where there is no image.
fn residual(asked: &[f64; ASKED]) -> [f64; 2] {
    let point = [asked[0], asked[1], asked[2]];
    if asked[ASKED - 1] == CORRECTED {
        let found = lens_of(asked).corrected_residual(point, [asked[3], asked[4]]);
        return found.map_or([f64::NAN; 2], |found| found.image_px);
    }
    let found = lens_of(asked).project_near(point, [asked[3], asked[4]]);
    found.map_or([f64::NAN; 2], |u| [u[0] - asked[3], u[1] - asked[4]])
}

/// Residual and derivatives; NaN where there is no image.
fn answer(asked: &[f64; ASKED]) -> [f64; ANSWERED] {
    let point = [asked[0], asked[1], asked[2]];
    let lens = lens_of(asked);
    let measured = [asked[3], asked[4]];
    let found = if asked[ASKED - 1] == CORRECTED {
        lens.corrected_residual(point, measured)
    } else {
        lens.project_with_derivatives_near(point, measured).map(|mut found| {
            found.image_px[0] -= measured[0];
            found.image_px[1] -= measured[1];
            found
        })
    };
    let Some(found) = found else { return [f64::NAN; ANSWERED] };
    let mut out = [0.0; ANSWERED];
    out[..2].copy_from_slice(&found.image_px);
    for row in 0..2 {
        out[2 + 3 * row..5 + 3 * row].copy_from_slice(&found.by_point[row]);
        let at = 8 + MAX_PARAMETERS * row;
        out[at..at + MAX_PARAMETERS].copy_from_slice(&found.by_parameters[row]);
    }
    out
}

#[inline(always)]
fn asked<L: Lane>(c: &[L], p: &[L; 3], data: &[L; DATA]) -> [L; ASKED] {
    // No closures here and below: they would be compiled without the instruction set.
    let mut asked = [p[0]; ASKED];
    asked[..3].copy_from_slice(p);
    asked[3..5].copy_from_slice(&data[..2]);
    asked[5..].copy_from_slice(&c[12..ASKED + 7]);
    asked
}

/// Everything but the rows by the kept block: residual, by lens, by the point in the frame of the
/// pose's middle, by the point in the world.
#[inline(always)]
fn by_lens<L: Lane>(found: &[L; ANSWERED], row: usize, weight: L) -> [L; LENS] {
    let mut by_lens = [weight.like(0.0); LENS];
    for k in 0..MAX_PARAMETERS {
        by_lens[k] = found[8 + MAX_PARAMETERS * row + k] * weight;
    }
    by_lens
}

impl ProjectionFactor for GlobalShutterFactor {
    type Residual = Dim<2>;
    type Camera = Dim<6>;
    type Shared = Dim<LENS>;
    type Point = Dim<3>;
    type Prepared = Dim<GLOBAL_SHUTTER>;
    type Data = Dim<DATA>;

    fn prepare(kept: &[f64], shared: &[f64]) -> [f64; GLOBAL_SHUTTER] {
        prepare(kept, shared)
    }

    #[inline(always)]
    fn residual<L: Lane>(c: &[L; GLOBAL_SHUTTER], x: &[L; 3], data: &[L; DATA]) -> [L; 2] {
        let p = to_camera(c, x);
        let r = L::each(&asked(c, &p, data), residual);
        [r[0] * data[2], r[1] * data[2]]
    }

    #[inline(always)]
    fn linearize<L: Lane>(
        c: &[L; GLOBAL_SHUTTER],
        x: &[L; 3],
        data: &[L; DATA],
    ) -> Linearized<Self, L> {
        let p = to_camera(c, x);
        let found = L::each(&asked(c, &p, data), answer);
        let weight = data[2];
        let j = [
            [found[2] * weight, found[3] * weight, found[4] * weight],
            [found[5] * weight, found[6] * weight, found[7] * weight],
        ];
        LinearizedProjection {
            residual: [found[0] * weight, found[1] * weight],
            jacobian_camera: [by_increment(&p, &j[0]), by_increment(&p, &j[1])],
            jacobian_shared: [by_lens(&found, 0, weight), by_lens(&found, 1, weight)],
            jacobian_point: [by_world(c, &j[0]), by_world(c, &j[1])],
        }
    }
}

/// `P`: a point in the camera frame of the middle of the readout, shifted by `tau s`.
#[inline(always)]
fn shifted<L: Lane>(c: &[L; ROLLING_SHUTTER], q: &[L; 3], tau: L) -> [L; 3] {
    let mut p = *q;
    for k in 0..3 {
        p[k] = q[k] + tau * c[GLOBAL_SHUTTER + k];
    }
    p
}

impl ProjectionFactor for RollingShutterFactor {
    type Residual = Dim<2>;
    type Camera = Dim<9>;
    type Shared = Dim<LENS>;
    type Point = Dim<3>;
    type Prepared = Dim<ROLLING_SHUTTER>;
    type Data = Dim<DATA>;

    fn prepare(kept: &[f64], shared: &[f64]) -> [f64; ROLLING_SHUTTER] {
        prepare(kept, shared)
    }

    #[inline(always)]
    fn residual<L: Lane>(c: &[L; ROLLING_SHUTTER], x: &[L; 3], data: &[L; DATA]) -> [L; 2] {
        let p = shifted(c, &to_camera(c, x), data[3]);
        let r = L::each(&asked(c, &p, data), residual);
        [r[0] * data[2], r[1] * data[2]]
    }

    #[inline(always)]
    fn linearize<L: Lane>(
        c: &[L; ROLLING_SHUTTER],
        x: &[L; 3],
        data: &[L; DATA],
    ) -> Linearized<Self, L> {
        let q = to_camera(c, x);
        let found = L::each(&asked(c, &shifted(c, &q, data[3]), data), answer);
        let (weight, tau) = (data[2], data[3]);
        let zero = weight.like(0.0);
        let mut jacobian_camera = [[zero; 9]; 2];
        let mut jacobian_point = [[zero; 3]; 2];
        for row in 0..2 {
            let mut j = [zero; 3];
            for k in 0..3 {
                j[k] = found[2 + 3 * row + k] * weight;
                jacobian_camera[row][6 + k] = j[k] * tau;
            }
            jacobian_camera[row][..6].copy_from_slice(&by_increment(&q, &j));
            jacobian_point[row] = by_world(c, &j);
        }
        LinearizedProjection {
            residual: [found[0] * weight, found[1] * weight],
            jacobian_camera,
            jacobian_shared: [by_lens(&found, 0, weight), by_lens(&found, 1, weight)],
            jacobian_point,
        }
    }
}

/// Whether images move while they are read out: the one place that chooses between the two factors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shutter {
    Global,
    Rolling,
}

/// What is prepared of an image and its camera, with unused places behind a global shutter's.
pub(super) type PreparedImage = [f64; ROLLING_SHUTTER];

/// One linearised measurement.
pub(super) struct Ray {
    pub(super) residual: [f64; 2],
    /// By the tangent of the image, row by row.
    pub(super) by_image: Vec<f64>,
    /// By the lens, row by row.
    pub(super) by_lens: Vec<f64>,
    pub(super) by_point: [[f64; 3]; 2],
}

impl Shutter {
    pub(super) fn prepare(self, image: &[f64], lens: &[f64]) -> PreparedImage {
        prepare(image, lens)
    }

    pub(super) fn linearize(
        self,
        prepared: &PreparedImage,
        point: &[f64; 3],
        data: &[f64; DATA],
    ) -> Ray {
        match self {
            Shutter::Global => {
                let mut own = [0.0; GLOBAL_SHUTTER];
                own.copy_from_slice(&prepared[..GLOBAL_SHUTTER]);
                ray(GlobalShutterFactor::linearize(&own, point, data))
            }
            Shutter::Rolling => ray(RollingShutterFactor::linearize(prepared, point, data)),
        }
    }

    /// Adds tie points to a problem.
    pub(super) fn add_measurements(
        self,
        problem: &mut Problem,
        name: &str,
        loss: Loss,
        measurements: Vec<Measurement<DATA>>,
    ) -> Result<(), SolveError> {
        match self {
            Shutter::Global => {
                problem.add(name, loss, ProjectionBatch::new(GlobalShutterFactor, measurements))
            }
            Shutter::Rolling => {
                problem.add(name, loss, ProjectionBatch::new(RollingShutterFactor, measurements))
            }
        }
    }
}

fn ray<const K: usize>(found: LinearizedProjection<f64, Dim<2>, Dim<K>, Dim<LENS>, Dim<3>>) -> Ray {
    Ray {
        residual: found.residual,
        by_image: found.jacobian_camera.concat(),
        by_lens: found.jacobian_shared.concat(),
        by_point: found.jacobian_point,
    }
}
