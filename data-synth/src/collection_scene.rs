//! Walls and the cameras that look at them: the scene of a [`collection`](crate::collection).
//!
//! A wall is an upright rectangle with centre `c`, direction `a` along it and normal `n` towards the cameras; a
//! point of it is `c + s a + z up + o n`, with `o` the relief. Metres, Z up.

use crate::{
    block::{ForwardCamera, camera},
    block_camera::Matrix,
    collection::{CollectionConfig, Layout},
    streams::{Draw, Stage, stream},
};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// An upright rectangle.
#[derive(Debug, Clone)]
pub(crate) struct Wall {
    /// The middle of its foot.
    pub(crate) foot_m: [f64; 2],
    /// Unit vector along it.
    pub(crate) along: [f64; 2],
    pub(crate) half_width_m: f64,
    pub(crate) height_m: f64,
    /// The wall that it was joined to.
    pub(crate) parent: Option<usize>,
}

impl Wall {
    /// Towards the cameras.
    pub(crate) fn normal(&self) -> [f64; 2] {
        [self.along[1], -self.along[0]]
    }

    fn end_m(&self, side: f64) -> [f64; 2] {
        [0, 1].map(|k| self.foot_m[k] + side * self.half_width_m * self.along[k])
    }

    /// The point `(along, up, out)` of the wall.
    pub(crate) fn at(&self, s_m: f64, z_m: f64, out_m: f64) -> [f64; 3] {
        let n = self.normal();
        let [x, y] = [0, 1].map(|k| self.foot_m[k] + s_m * self.along[k] + out_m * n[k]);
        [x, y, z_m]
    }
}

/// A camera and the walls that it may see, the first its own.
#[derive(Debug, Clone)]
pub(crate) struct View {
    pub(crate) camera: [f64; 9],
    pub(crate) forward: ForwardCamera,
    /// Half the image, pixels.
    pub(crate) half_px: [f64; 2],
    pub(crate) walls: Vec<usize>,
}

/// The walls and all views of them.
#[derive(Debug)]
pub(crate) struct Scene {
    pub(crate) walls: Vec<Wall>,
    pub(crate) views: Vec<View>,
    /// Per wall the views that may see it.
    pub(crate) viewers: Vec<Vec<u32>>,
}

impl Scene {
    pub(crate) fn new(config: &CollectionConfig) -> Scene {
        let (walls, views) = match config.layout {
            Layout::Places => places(config),
            Layout::Street => street(config),
        };
        let mut viewers = vec![Vec::new(); walls.len()];
        for (v, view) in views.iter().enumerate() {
            view.walls.iter().for_each(|&wall| viewers[wall].push(v as u32));
        }
        Scene { walls, views, viewers }
    }
}

/// Half the image of a tourist's photo, held level.
const PHOTO_HALF_PX: [f64; 2] = [1000.0, 750.0];
/// Half the image of the vehicle's cameras, which are wide.
const VEHICLE_HALF_PX: [f64; 2] = [800.0, 600.0];
/// Eye level, metres.
const EYE_M: f64 = 1.7;
/// Views that show a wall from end to end, so that each of its points is seen by that many.
const WHOLE_VIEWS: usize = 3;

/// Walls joined end to end as a tree, with popularity by rank; views from in front of them.
fn places(config: &CollectionConfig) -> (Vec<Wall>, Vec<View>) {
    let mut walls: Vec<Wall> = Vec::with_capacity(config.places);
    // Ends that no wall has been joined to.
    let mut ends: Vec<(usize, f64)> = Vec::new();
    for k in 0..config.places {
        let mut rng = stream(config.seed, Stage::CollectionWall, k as u64);
        let half_width_m = 15.0 * (0.3 * rng.normal()).exp();
        let height_m = 15.0 * (0.3 * rng.normal()).exp();
        let (pick, turn) = (rng.unit(), rng.between(-0.8, 0.8));
        let wall = if ends.is_empty() {
            Wall { foot_m: [0.0; 2], along: [1.0, 0.0], half_width_m, height_m, parent: None }
        } else {
            let (parent, side) = ends.remove((pick * ends.len() as f64) as usize);
            let before = &walls[parent];
            let direction = before.along[1].atan2(before.along[0]) + turn;
            let along = [direction.cos(), direction.sin()];
            let foot_m = [0, 1].map(|k| before.end_m(side)[k] + side * half_width_m * along[k]);
            ends.push((k, side));
            Wall { foot_m, along, half_width_m, height_m, parent: Some(parent) }
        };
        if wall.parent.is_none() {
            ends.extend([(k, -1.0), (k, 1.0)]);
        } else if k % 3 == 0 {
            // A square: another wall begins here as well, seen from the same side.
            ends.push((k, if pick < 0.5 { -1.0 } else { 1.0 }));
        }
        walls.push(wall);
    }
    let shares = popularity(config.images, config.places);
    let mut views = Vec::with_capacity(config.images);
    for (k, &count) in shares.iter().enumerate() {
        for nth in 0..count {
            let mut rng = stream(config.seed, Stage::CollectionView, views.len() as u64);
            views.push(photo(config, &walls, k, nth < WHOLE_VIEWS, &mut rng));
        }
    }
    (walls, views)
}

/// How many of `images` each of `places` gets: by `1 / rank^0.8`, each at least six.
fn popularity(images: usize, places: usize) -> Vec<usize> {
    const LEAST: usize = 6;
    let weights: Vec<f64> = (0..places).map(|k| (k as f64 + 1.0).powf(-0.8)).collect();
    let total: f64 = weights.iter().sum();
    let spare = images - LEAST * places;
    let (mut given, mut sum) = (0, 0.0);
    weights
        .iter()
        .map(|weight| {
            sum += weight;
            let until = (spare as f64 * sum / total).round() as usize;
            let share = LEAST + until - given;
            given = until;
            share
        })
        .collect()
}

/// A photo of wall `k`; `whole` shows all of it.
fn photo(
    config: &CollectionConfig,
    walls: &[Wall],
    k: usize,
    whole: bool,
    rng: &mut ChaCha8Rng,
) -> View {
    let wall = &walls[k];
    let focal_px = config.focal_px * (config.focal_spread * rng.normal()).exp();
    let k1 = (0.05 * rng.normal() - 0.05).clamp(-0.15, 0.15);
    let k2 = (0.02 * rng.normal()).clamp(-0.05, 0.05);
    let joins = rng.unit() < config.joining_fraction;
    let (mut distance_m, mut aside) = (25.0 * (0.5 * rng.normal()).exp(), 0.44 * rng.normal());
    let (mut s_m, mut z_m) = (
        wall.half_width_m * (0.5 * rng.normal()).clamp(-0.9, 0.9),
        wall.height_m * rng.between(0.25, 0.6),
    );
    let mut seen = vec![k];
    let neighbour = wall.parent;
    if let (Some(parent), true) = (neighbour, joins || whole) {
        // From before the seam: both walls are in the picture.
        seen.push(parent);
        if joins && !whole {
            let towards: f64 =
                (0..2).map(|i| (walls[parent].foot_m[i] - wall.foot_m[i]) * wall.along[i]).sum();
            s_m = wall.half_width_m * towards.signum();
            distance_m = distance_m.max(20.0);
        }
    }
    if whole {
        (s_m, z_m, aside) = (0.0, 0.4 * wall.height_m, 0.3 * aside);
        let fill = (1.2 * wall.half_width_m / PHOTO_HALF_PX[0])
            .max(0.7 * wall.height_m / PHOTO_HALF_PX[1]);
        distance_m = fill * focal_px;
    }
    let distance_m = if whole { distance_m } else { distance_m.clamp(8.0, 120.0) };
    let aside = aside.clamp(-1.05, 1.05);
    let target = wall.at(s_m, z_m, 0.0);
    let (sin, cos) = aside.sin_cos();
    let n = wall.normal();
    let centre_m = [
        target[0] + distance_m * (cos * n[0] + sin * wall.along[0]),
        target[1] + distance_m * (cos * n[1] + sin * wall.along[1]),
        EYE_M + 0.1 * rng.normal(),
    ];
    let upright = !whole && rng.unit() < 0.3;
    let roll = 0.03 * rng.normal() + if upright { FRAC_PI_2 } else { 0.0 };
    let rotation = looking(centre_m, target, roll);
    let camera = camera(&rotation, centre_m, [focal_px, k1, k2]);
    View { forward: ForwardCamera::new(&camera), camera, half_px: PHOTO_HALF_PX, walls: seen }
}

/// The rotation of a camera at `from` that looks at `to`, turned by `roll` about its axis.
fn looking(from: [f64; 3], to: [f64; 3], roll: f64) -> Matrix {
    let forward = unit([0, 1, 2].map(|k| to[k] - from[k]));
    let right = unit([forward[1], -forward[0], 0.0]);
    let up = cross(right, forward);
    let (sin, cos) = roll.sin_cos();
    let x = [0, 1, 2].map(|k| cos * right[k] + sin * up[k]);
    let y = [0, 1, 2].map(|k| cos * up[k] - sin * right[k]);
    [x, y, forward.map(|v| -v)]
}

fn unit(v: [f64; 3]) -> [f64; 3] {
    let length = v.iter().map(|v| v * v).sum::<f64>().sqrt();
    v.map(|v| v / length)
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Metres of road between two images of the vehicle.
const STEP_M: f64 = 0.5;
/// Length of a wall along the road, metres.
const FRONT_M: f64 = 20.0;
/// Share of the road that is driven a second time.
const AGAIN: f64 = 0.3;
/// How far the vehicle's cameras see, metres.
const SIGHT_M: f64 = 45.0;

/// A vehicle on a closed road between two rows of walls, its cameras pointing four ways in turn; it drives on after
/// the first round.
fn street(config: &CollectionConfig) -> (Vec<Wall>, Vec<View>) {
    let length_m = config.images as f64 * STEP_M / (1.0 + AGAIN);
    let fronts = ((length_m / FRONT_M) as usize).max(3);
    let radius_m = length_m / TAU;
    // A ring with three bays; place and direction of the road at an angle of the ring.
    let road = |angle: f64| {
        let r = radius_m * (1.0 + 0.12 * (3.0 * angle).sin());
        let slope = radius_m * 0.36 * (3.0 * angle).cos();
        let (sin, cos) = angle.sin_cos();
        let (dx, dy) = (slope * cos - r * sin, slope * sin + r * cos);
        ([r * cos, r * sin], dy.atan2(dx))
    };
    let mut walls = Vec::with_capacity(2 * fronts);
    for k in 0..2 * fronts {
        let mut rng = stream(config.seed, Stage::CollectionWall, k as u64);
        let side = if k % 2 == 0 { 1.0 } else { -1.0 };
        let (at, direction) = road(TAU * ((k / 2) as f64 + 0.5) / fronts as f64);
        let out_m = rng.between(6.0, 14.0);
        let (sin, cos) = direction.sin_cos();
        walls.push(Wall {
            foot_m: [at[0] - side * out_m * sin, at[1] + side * out_m * cos],
            along: [side * cos, side * sin],
            half_width_m: 0.5 * FRONT_M * rng.between(0.7, 1.1),
            height_m: rng.between(5.0, 15.0),
            parent: k.checked_sub(2).or(if k == 1 { Some(0) } else { None }),
        });
    }
    let views = (0..config.images)
        .map(|image| {
            let mut rng = stream(config.seed, Stage::CollectionView, image as u64);
            let (at, direction) = road(TAU * image as f64 * STEP_M / length_m);
            let aside_m =
                0.3 * rng.normal() + if image as f64 * STEP_M > length_m { 1.5 } else { 0.0 };
            let (sin, cos) = direction.sin_cos();
            let centre_m =
                [at[0] - aside_m * sin, at[1] + aside_m * cos, 2.2 + 0.02 * rng.normal()];
            let turn = [0.7, -0.7, 2.0, -2.0][image % 4] + 0.03 * rng.normal();
            let towards = direction + turn;
            let target = [
                centre_m[0] + 10.0 * towards.cos(),
                centre_m[1] + 10.0 * towards.sin(),
                centre_m[2] + 0.3 * rng.normal(),
            ];
            let focal_px = config.focal_px * (config.focal_spread * rng.normal()).exp();
            let k1 = -0.05 + 0.005 * rng.normal();
            let rotation = looking(centre_m, target, 0.02 * rng.normal());
            let camera = camera(&rotation, centre_m, [focal_px, k1, 0.005]);
            let seen = in_sight(&walls, centre_m, towards);
            View {
                forward: ForwardCamera::new(&camera),
                camera,
                half_px: VEHICLE_HALF_PX,
                walls: seen,
            }
        })
        .collect();
    (walls, views)
}

/// The walls that a camera looking `towards` may see, the nearest first.
fn in_sight(walls: &[Wall], from: [f64; 3], towards: f64) -> Vec<usize> {
    let mut seen: Vec<(f64, usize)> = walls
        .iter()
        .enumerate()
        .filter_map(|(k, wall)| {
            let (dx, dy) = (wall.foot_m[0] - from[0], wall.foot_m[1] - from[1]);
            let n = wall.normal();
            let turn = (dy.atan2(dx) - towards + PI).rem_euclid(TAU) - PI;
            let distance_m = dx.hypot(dy);
            (distance_m < SIGHT_M && turn.abs() < 1.2 && dx * n[0] + dy * n[1] < 0.0)
                .then_some((distance_m, k))
        })
        .collect();
    seen.sort_by(|a, b| a.0.total_cmp(&b.0));
    seen.into_iter().map(|(_, k)| k).collect()
}
