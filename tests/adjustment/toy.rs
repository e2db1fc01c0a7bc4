//! A small aerial block with control, as it is and as it is measured.

use crate::nlls::toys::normal;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::{
    camera::{Camera, Interior, Lens, Model},
    geometry::rotation,
    scene::{
        Axes, CameraPosition, GroundObservation, GroundPoint, Image, Observation, Pose,
        Reconstruction, Role, RollingShutter, TiePoint,
    },
};

/// Standard deviations of everything measured.
pub const TIE_PX: f64 = 0.4;
pub const MARK_PX: f64 = 0.3;
pub const CONTROL_M: [f64; 3] = [0.02, 0.02, 0.03];
pub const POSITION_M: [f64; 3] = [0.05, 0.05, 0.08];
/// Far from the origin, as mapping frames are.
pub const CORNER_M: [f64; 3] = [351_000.0, 512_600.0, 265.0];
pub const SIZE_PX: [u32; 2] = [1000, 750];

pub fn smac() -> Interior {
    let values = [900.0, 4.0, -3.0, 0.0, 6e-8, -5e-14, 0.0, 1e-6, -5e-7, 0.0];
    Interior::new(Model::Smac, SIZE_PX, &values).unwrap()
}

/// What a block looks like.
pub struct Plan {
    pub seed: u64,
    pub columns: usize,
    pub rows: usize,
    pub tie_points: usize,
    pub control: usize,
    pub checks: usize,
    pub interior: Interior,
    /// With a rolling shutter: the velocity along the strips, metres per second.
    pub velocity_m_s: Option<f64>,
}

impl Default for Plan {
    fn default() -> Plan {
        Plan {
            seed: 7,
            columns: 4,
            rows: 3,
            tie_points: 150,
            control: 8,
            checks: 4,
            interior: smac(),
            velocity_m_s: None,
        }
    }
}

pub const READOUT_S: f64 = 0.03;

/// The block as it is: every measurement exact.
pub fn truth(plan: &Plan) -> Reconstruction {
    let mut rng = ChaCha8Rng::seed_from_u64(plan.seed);
    let mut survey = Reconstruction {
        cameras: vec![Camera::new("toy", plan.interior)],
        tie_sigma_px: TIE_PX,
        ..Reconstruction::default()
    };
    if plan.velocity_m_s.is_some() {
        survey.rolling_shutter =
            Some(RollingShutter { readout_s: READOUT_S, sigma_velocity_m_s: 500.0 });
    }
    let (along, across, height) = (16.0, 18.0, 50.0);
    for row in 0..plan.rows {
        for column in 0..plan.columns {
            // Strips are flown to and fro.
            let turn = if row % 2 == 0 { 0.0 } else { std::f64::consts::PI };
            let small = [0, 1, 2].map(|_| 0.04 * normal(&mut rng));
            let rotation = rotation::normalize(rotation::multiply(
                rotation::exp(small),
                rotation::exp([0.0, 0.0, turn]),
            ));
            let centre = [
                CORNER_M[0] + along * column as f64 + normal(&mut rng),
                CORNER_M[1] + across * row as f64 + normal(&mut rng),
                CORNER_M[2] + height + 2.0 * normal(&mut rng),
            ];
            let mut motion = [0.0; 6];
            if let Some(velocity) = plan.velocity_m_s {
                let forward = if row % 2 == 0 { velocity } else { -velocity };
                let shift = rotation::rotate(rotation, [forward * READOUT_S, 0.0, 0.0]);
                motion[3..].copy_from_slice(&shift.map(|v| -v));
            }
            let id = survey.images.len() as u32 + 1;
            survey.images.push(Image {
                name: format!("IMG_{id:04}.JPG"),
                id,
                camera: 0,
                pose: Pose::from_centre(rotation, centre),
                motion,
                expected_motion: [0.0; 6],
            });
        }
    }
    let extent = [along * (plan.columns - 1) as f64, across * (plan.rows - 1) as f64];
    while survey.points.len() < plan.tie_points {
        let at = [
            CORNER_M[0] + (extent[0] + 20.0) * rng.random::<f64>() - 10.0,
            CORNER_M[1] + (extent[1] + 16.0) * rng.random::<f64>() - 8.0,
            CORNER_M[2] + 3.0 * normal(&mut rng),
        ];
        let seen = images_of(&survey, at);
        if seen.len() >= 2 {
            let point = survey.points.len() as u32;
            survey.points.push(TiePoint {
                id: 100 + u64::from(point),
                position_m: at,
                colour: [90, 120, 60],
            });
            survey.observations.extend(seen.into_iter().map(|(image, image_px)| Observation {
                image,
                point,
                image_px,
            }));
        }
    }
    let total = plan.control + plan.checks;
    while survey.ground.len() < total {
        let k = survey.ground.len();
        // Around the block and in it, in turn.
        let share = k as f64 / total as f64 * std::f64::consts::TAU;
        let radius = if k.is_multiple_of(2) { 0.48 } else { 0.25 };
        let at = [
            CORNER_M[0] + extent[0] * (0.5 + radius * share.cos()),
            CORNER_M[1] + extent[1] * (0.5 + radius * share.sin()),
            CORNER_M[2] + 3.0 * normal(&mut rng),
        ];
        let ground = k as u32;
        for (image, image_px) in images_of(&survey, at) {
            survey.marks.push(GroundObservation { image, ground, image_px, sigma_px: MARK_PX });
        }
        survey.ground.push(GroundPoint {
            name: format!("G{k:02}"),
            position_m: at,
            sigma_m: CONTROL_M,
            role: if k % 3 == 2 && (k / 3) < plan.checks { Role::Check } else { Role::Control },
            axes: Axes::Xyz,
        });
    }
    survey
}

/// Where the images see a point, by fixed-point iteration where the shutter rolls.
fn images_of(survey: &Reconstruction, at: [f64; 3]) -> Vec<(u32, [f64; 2])> {
    let mut found = Vec::new();
    for (k, image) in survey.images.iter().enumerate() {
        let lens = &survey.cameras[image.camera].interior;
        let still = image.pose.to_camera(at);
        let mut pixel = lens.project(still);
        if survey.rolling_shutter.is_some() {
            for _ in 0..20 {
                let Some(at_px) = pixel else { break };
                let tau = survey.readout_share(k, at_px[1]);
                let turned = rotation::rotate(
                    rotation::exp([0, 1, 2].map(|c| tau * image.motion[c])),
                    still,
                );
                let moved = [0, 1, 2].map(|c| turned[c] + tau * image.motion[3 + c]);
                pixel = lens.project(moved);
            }
        }
        if let Some([u, v]) = pixel
            && (5.0..f64::from(SIZE_PX[0]) - 6.0).contains(&u)
            && (5.0..f64::from(SIZE_PX[1]) - 6.0).contains(&v)
        {
            found.push((k as u32, [u, v]));
        }
    }
    found
}

/// Adds camera positions, exact.
pub fn with_positions(mut survey: Reconstruction) -> Reconstruction {
    survey.positions = (0..survey.images.len())
        .map(|k| CameraPosition {
            image: k as u32,
            position_m: survey.images[k].pose.centre_m(),
            sigma_m: POSITION_M,
        })
        .collect();
    survey
}

/// How much of its standard deviation each kind of measurement errs by.
#[derive(Clone, Copy)]
pub struct Noise {
    pub tie: f64,
    pub mark: f64,
    pub control: f64,
    pub position: f64,
}

pub const NOISE: Noise = Noise { tie: 1.0, mark: 1.0, control: 1.0, position: 1.0 };

/// The block as it is measured, started away from the truth.
pub fn measured(truth: &Reconstruction, seed: u64, noise: Noise) -> Reconstruction {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut survey = truth.clone();
    for o in &mut survey.observations {
        o.image_px.iter_mut().for_each(|v| *v += noise.tie * TIE_PX * normal(&mut rng));
    }
    for mark in &mut survey.marks {
        mark.image_px.iter_mut().for_each(|v| *v += noise.mark * MARK_PX * normal(&mut rng));
    }
    for point in &mut survey.ground {
        for k in 0..3 {
            point.position_m[k] += noise.control * point.sigma_m[k] * normal(&mut rng);
        }
    }
    for position in &mut survey.positions {
        for k in 0..3 {
            position.position_m[k] += noise.position * position.sigma_m[k] * normal(&mut rng);
        }
    }
    for image in &mut survey.images {
        let centre = image.pose.centre_m().map(|v| v + 0.3 * normal(&mut rng));
        let turn = rotation::exp([0, 1, 2].map(|_| 0.005 * normal(&mut rng)));
        let rotation = rotation::normalize(rotation::multiply(turn, image.pose.rotation));
        image.pose = Pose::from_centre(rotation, centre);
        image.motion = [0.0; 6];
    }
    for point in &mut survey.points {
        point.position_m.iter_mut().for_each(|v| *v += 0.3 * normal(&mut rng));
    }
    survey
}

/// Frees parameters of the only camera.
pub fn free(survey: &mut Reconstruction, names: &[&str]) {
    survey.cameras[0].set_free(names).unwrap();
}
