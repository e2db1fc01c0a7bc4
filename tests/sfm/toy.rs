//! A flight over rolling ground, straight from geometry: what every photo shows, with noise, and
//! matches of which a share is wrong.

use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use rowgram::{
    camera::{Camera, Interior, Lens, Model},
    geometry::rotation,
    scene::{Axes, CameraPosition, GroundObservation, GroundPoint, Pose, Role},
    sfm::{Features, verify::PairMatches},
};

/// What is flown.
#[derive(Debug, Clone)]
pub struct Flight {
    pub strips: usize,
    pub per_strip: usize,
    pub points: usize,
    pub tilt_deg: f64,
    pub noise_px: f64,
    pub wrong_share: f64,
    /// How far the camera flies while a photo is read, metres.
    pub readout_displacement_m: f64,
    pub seed: u64,
}

impl Default for Flight {
    fn default() -> Flight {
        Flight {
            strips: 3,
            per_strip: 5,
            points: 2500,
            tilt_deg: 3.0,
            noise_px: 0.3,
            wrong_share: 0.3,
            readout_displacement_m: 0.0,
            seed: 1,
        }
    }
}

/// A flight with its truth.
pub struct Flown {
    pub cameras: Vec<Camera>,
    pub poses: Vec<Pose>,
    pub features: Vec<Features>,
    pub matched: Vec<PairMatches>,
    pub ground: Vec<GroundPoint>,
    pub marks: Vec<GroundObservation>,
    pub positions: Vec<CameraPosition>,
}

pub const SIZE_PX: [u32; 2] = [1200, 900];
const C_PX: f64 = 1000.0;
const HEIGHT_M: f64 = 50.0;

/// Height of the ground, metres.
pub fn ground_m(x: f64, y: f64) -> f64 {
    2.0 * (0.06 * x).sin() + 1.5 * (0.09 * y + 0.4).cos() + 0.01 * x
}

pub fn lens(principal_distance_px: f64, k1: f64) -> Camera {
    let mut values = [0.0; 12];
    (values[0], values[1]) = (principal_distance_px, 1.0);
    (values[2], values[3]) = (599.5, 449.5);
    values[4] = k1;
    Camera::new("toy", Interior::new(Model::Brown, SIZE_PX, &values).unwrap())
}

fn seen(
    camera: &Camera,
    pose: &Pose,
    readout_displacement_m: [f64; 3],
    point: [f64; 3],
) -> Option<[f64; 2]> {
    let shift = rotation::rotate(pose.rotation, readout_displacement_m.map(|v| -v));
    let middle = pose.to_camera(point);
    let mut at = camera.interior.project(middle)?;
    // The row decides when, and when decides the row.
    for _ in 0..4 {
        let share = (at[1] - 449.5) / 900.0;
        at = camera.interior.project(std::array::from_fn(|k| middle[k] + share * shift[k]))?;
    }
    let inside = |v: f64, size: u32| (0.0..f64::from(size) - 1.0).contains(&v);
    (inside(at[0], SIZE_PX[0]) && inside(at[1], SIZE_PX[1])).then_some(at)
}

impl Flight {
    pub fn fly(&self) -> Flown {
        self.fly_with_mount([0.0; 2])
    }

    /// The same with a camera that hangs in its mount turned about its own axes, radians.
    pub fn fly_with_mount(&self, [about_x, about_y]: [f64; 2]) -> Flown {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let normal = Normal::new(0.0, 1.0).unwrap();
        let truth = lens(C_PX, -0.05);
        // 75 % forward, 60 % sideways.
        let (along, across) = (0.25 * 0.9 * HEIGHT_M, 0.4 * 1.2 * HEIGHT_M);
        let (mut poses, mut ways) = (Vec::new(), Vec::new());
        for strip in 0..self.strips {
            for k in 0..self.per_strip {
                let back = strip % 2 == 1;
                let along_at = if back { self.per_strip - 1 - k } else { k } as f64 * along;
                let kappa = if back { std::f64::consts::PI } else { 0.0 };
                let mut number = || normal.sample(&mut rng);
                let tilt = self.tilt_deg.to_radians();
                let turn = rotation::multiply(
                    rotation::exp([tilt * number(), tilt * number(), 0.03 * number()]),
                    rotation::exp([0.0, 0.0, -kappa]),
                );
                let turn = rotation::multiply(rotation::exp([about_x, about_y, 0.0]), turn);
                let centre = [
                    strip as f64 * across + 0.8 * number(),
                    along_at + 0.8 * number(),
                    HEIGHT_M + 0.8 * number(),
                ];
                poses.push(Pose::from_centre(turn, centre));
                ways.push([
                    0.0,
                    if back { -self.readout_displacement_m } else { self.readout_displacement_m },
                    0.0,
                ]);
            }
        }
        let extent = [self.strips as f64 * across + 40.0, self.per_strip as f64 * along + 40.0];
        self.photograph(&truth, poses, &ways, extent, &mut rng)
    }

    /// A flight around a place instead, the camera looking at it from the side, without receiver; only photos beside each
    /// other are matched.
    pub fn orbit(&self) -> Flown {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let count = self.strips * self.per_strip;
        let pose = |k: usize| {
            let angle = std::f64::consts::TAU * k as f64 / count as f64;
            // Turned about the vertical, then tilted backwards.
            let turn = rotation::multiply(
                rotation::exp([-55.0_f64.to_radians(), 0.0, 0.0]),
                rotation::exp([0.0, 0.0, -angle]),
            );
            let centre = [30.0 + 40.0 * angle.sin(), 30.0 - 40.0 * angle.cos(), 28.0];
            Pose::from_centre(turn, centre)
        };
        let poses: Vec<Pose> = (0..count).map(pose).collect();
        let ways = vec![[0.0; 3]; count];
        let mut flown = self.photograph(&lens(C_PX, -0.05), poses, &ways, [100.0; 2], &mut rng);
        flown.positions.clear();
        flown.matched.retain(|pair| {
            let apart = pair.images[1].abs_diff(pair.images[0]) as usize;
            apart.min(count - apart) <= 3
        });
        flown
    }

    fn photograph(
        &self,
        truth: &Camera,
        poses: Vec<Pose>,
        ways: &[[f64; 3]],
        [wide, long]: [f64; 2],
        rng: &mut ChaCha8Rng,
    ) -> Flown {
        let normal = Normal::new(0.0, 1.0).unwrap();
        let points: Vec<[f64; 3]> = (0..self.points)
            .map(|_| {
                let x = rng.random_range(-40.0..wide);
                let y = rng.random_range(-40.0..long);
                [x, y, ground_m(x, y)]
            })
            .collect();
        let mut features = Vec::new();
        let mut shows: Vec<Vec<Option<u32>>> = Vec::new();
        for (k, pose) in poses.iter().enumerate() {
            let mut list: Vec<(usize, [f64; 2])> = points
                .iter()
                .enumerate()
                .filter_map(|(p, &point)| Some((p, seen(truth, pose, ways[k], point)?)))
                .collect();
            list.shuffle(rng);
            let mut place = vec![None; points.len()];
            let mut found = Features { name: format!("{k:03}.jpg"), ..Features::default() };
            for (p, at) in list {
                place[p] = Some(found.positions_px.len() as u32);
                let noisy = at.map(|v| v + self.noise_px * normal.sample(rng));
                found.positions_px.push(noisy);
                found.colours.push([p as u8; 3]);
            }
            shows.push(place);
            features.push(found);
        }
        let mut matched = Vec::new();
        for a in 0..poses.len() {
            for b in a + 1..poses.len() {
                // Photos that far apart show nothing in common.
                let (p, q): ([f64; 3], [f64; 3]) = (poses[a].centre_m(), poses[b].centre_m());
                if (p[0] - q[0]).hypot(p[1] - q[1]) > 3.0 * HEIGHT_M {
                    continue;
                }
                let common = (0..points.len()).filter_map(|p| Some([shows[a][p]?, shows[b][p]?]));
                let mut matches: Vec<[u32; 2]> = common.collect();
                if matches.len() < 20 {
                    continue;
                }
                let many = features[b].positions_px.len() as u32;
                for pair in &mut matches {
                    if rng.random_range(0.0..1.0) < self.wrong_share {
                        pair[1] = rng.random_range(0..many);
                    }
                }
                matched.push(PairMatches { images: [a as u32, b as u32], matches });
            }
        }
        let mut flown = Flown {
            cameras: vec![truth.clone()],
            positions: Vec::new(),
            features,
            matched,
            ground: Vec::new(),
            marks: Vec::new(),
            poses,
        };
        flown.survey(truth, ways, [wide, long], rng);
        flown
    }
}

impl Flown {
    /// Targets on a grid, every third one a check point; receiver positions good to half a metre.
    fn survey(
        &mut self,
        truth: &Camera,
        ways_m: &[[f64; 3]],
        [wide, long]: [f64; 2],
        rng: &mut ChaCha8Rng,
    ) {
        let normal = Normal::new(0.0, 1.0).unwrap();
        for k in 0..12 {
            let (i, j) = (k % 3, k / 3);
            let x = -20.0 + (wide - 20.0) * f64::from(i) / 2.0;
            let y = -15.0 + (long - 25.0) * f64::from(j) / 3.0;
            let position_m = [x, y, ground_m(x, y)];
            let ground = self.ground.len() as u32;
            for (image, pose) in self.poses.iter().enumerate() {
                if let Some(at) = seen(truth, pose, ways_m[image], position_m) {
                    let image_px = at.map(|v| v + 0.2 * normal.sample(rng));
                    self.marks.push(GroundObservation {
                        image: image as u32,
                        ground,
                        image_px,
                        sigma_px: 0.3,
                    });
                }
            }
            self.ground.push(GroundPoint {
                name: format!("T{k}"),
                position_m,
                sigma_m: [0.01; 3],
                role: if k % 3 == 1 { Role::Check } else { Role::Control },
                axes: Axes::Xyz,
            });
        }
        for (image, pose) in self.poses.iter().enumerate() {
            let position_m = pose.centre_m().map(|v| v + 0.5 * normal.sample(rng));
            self.positions.push(CameraPosition {
                image: image as u32,
                position_m,
                sigma_m: [5.0; 3],
            });
        }
    }
}
