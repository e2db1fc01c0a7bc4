//! Photos through the true camera.
//!
//! For every pixel the ray of its row's moment is followed to the ground; leaves, stalks, straw, stones and
//! targets are triangles whose corners are projected exactly (lens and rolling shutter included) and drawn
//! with four samples a pixel. Light is linear: sun with cast shadows, and sky. What the sensor makes of it
//! is in [`ImageConfig`], each effect on its own.
//!
//! Photos come one after the other, the tiles of one in parallel; nothing depends on the number of threads.

mod first_surface;
mod ground;
mod raster;
mod sensor;
mod shade;
mod shadow;

use crate::{
    camera::Camera,
    check::{ConfigError, within},
    clutter::ClutterConfig,
    corrupt::Weed,
    field::Field,
    flight::Shot,
    mesh::World,
    targets::Target,
};
use image::{GrayImage, RgbImage};
use raster::{Bins, NONE, Place, Samples, TILE};
use rayon::prelude::*;
use sensor::Frame;
use serde::{Deserialize, Serialize};
use shade::Shader;
use shadow::Shadows;

pub use first_surface::{Cover, FirstSurface, SurfaceGrid};

/// Light and sensor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImageConfig {
    /// Where the sun stands, degrees counter-clockwise from east.
    pub sun_azimuth_deg: f64,
    /// How high the sun stands, degrees above the horizon.
    pub sun_elevation_deg: f64,
    /// How uneven the soil's brightness is, relative to a tilled field.
    pub soil_contrast: f64,
    /// Standard deviation of the logarithm of the exposure from photo to photo.
    pub exposure_spread: f64,
    /// Standard deviation of the logarithm of the red and blue gains from photo to photo.
    pub white_balance_spread: f64,
    /// Standard deviation of the logarithm of the light over a flight: it changes slowly, as thin clouds make it.
    pub light_drift: f64,
    /// Whether the camera follows the light in thirds of a stop, by its sensitivity, which it reports.
    pub auto_exposure: bool,
    /// Light lost in the corners, fraction.
    pub vignetting: f64,
    /// Standard deviation of the Gaussian blur of lens and sensor, pixels.
    pub defocus_px: f64,
    /// Whether what moves during the exposure is smeared.
    pub motion_blur: bool,
    /// Standard deviation of the noise in the dark, fraction of saturation.
    pub read_noise: f64,
    /// Standard deviation of the noise at saturation that comes from the light itself, fraction of saturation.
    pub shot_noise: f64,
    /// JPEG quality, 1 to 100.
    pub jpeg_quality: u8,
    /// What the light of the day, sun and sky, is multiplied by: red, green, blue.
    #[serde(skip_serializing_if = "is_usual")]
    pub light: [f64; 3],
}

impl Default for ImageConfig {
    fn default() -> ImageConfig {
        ImageConfig {
            sun_azimuth_deg: -60.0,
            sun_elevation_deg: 58.0,
            soil_contrast: 1.0,
            exposure_spread: 0.06,
            white_balance_spread: 0.02,
            light_drift: 0.0,
            auto_exposure: false,
            vignetting: 0.15,
            defocus_px: 0.8,
            motion_blur: true,
            read_noise: 0.002,
            shot_noise: 0.012,
            jpeg_quality: 92,
            light: [1.0; 3],
        }
    }
}

/// Whether light is that of the usual day.
fn is_usual(light: &[f64; 3]) -> bool {
    *light == [1.0; 3]
}

impl ImageConfig {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that cannot be used: its name, its value and what was expected.
    pub fn check(&self) -> Result<(), ConfigError> {
        within("image.sun_azimuth_deg", self.sun_azimuth_deg, -360.0..=360.0)?;
        within("image.sun_elevation_deg", self.sun_elevation_deg, 10.0..=90.0)?;
        within("image.soil_contrast", self.soil_contrast, 0.0..=3.0)?;
        within("image.exposure_spread", self.exposure_spread, 0.0..=1.0)?;
        within("image.white_balance_spread", self.white_balance_spread, 0.0..=0.5)?;
        within("image.light_drift", self.light_drift, 0.0..=1.0)?;
        within("image.vignetting", self.vignetting, 0.0..=0.9)?;
        within("image.defocus_px", self.defocus_px, 0.0..=20.0)?;
        within("image.read_noise", self.read_noise, 0.0..=0.2)?;
        within("image.shot_noise", self.shot_noise, 0.0..=0.2)?;
        for light in self.light {
            within("image.light", light, 0.05..=20.0)?;
        }
        within("image.jpeg_quality", self.jpeg_quality, 1..=100)
    }

    /// Unit vector towards the sun.
    pub fn sun(&self) -> [f64; 3] {
        let (sin, cos) = self.sun_azimuth_deg.to_radians().sin_cos();
        let (up, flat) = self.sun_elevation_deg.to_radians().sin_cos();
        [flat * cos, flat * sin, up]
    }

    /// Light that comes back from a level white surface under the open sky, red, green, blue; 1 saturates a photo of usual exposure.
    pub fn level_light(&self) -> [f64; 3] {
        let [_, _, up] = self.sun();
        [0, 1, 2].map(|c| {
            self.light[c] * (f64::from(shade::SUN_LIGHT[c]) * up + f64::from(shade::SKY_LIGHT[c]))
        })
    }
}

/// A photo, and what its pixels truly show.
pub struct Photo {
    /// The photo.
    pub image: RgbImage,
    /// 255 where at least half of a pixel shows green leaf or stalk, 0 elsewhere.
    pub mask: GrayImage,
    /// The plant that covers most of a pixel, where plants cover half of it: its number from 1 as
    /// red + 256 green + 65536 blue; 0 elsewhere.
    pub plants: RgbImage,
    /// The leaf that covers most of a pixel, where leaves cover half of it, row by row: numbers as in
    /// [`crate::labels`], withered leaves too; 0 elsewhere.
    pub leaves: Vec<u32>,
}

/// Everything that photos of one field need.
pub struct Studio<'a> {
    world: World<'a>,
    camera: &'a Camera,
    image: &'a ImageConfig,
    ground: ground::Ground,
}

/// Places of the four samples in a pixel: each in a row and a column of its own.
const SAMPLES: [[f32; 2]; 4] = [[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]];

impl<'a> Studio<'a> {
    /// A studio for a field with its weeds, clutter and targets.
    pub fn new(
        field: &'a Field,
        weeds: &'a [Weed],
        clutter: &'a ClutterConfig,
        targets: &'a [Target],
        camera: &'a Camera,
        image: &'a ImageConfig,
    ) -> Studio<'a> {
        let ground = ground::Ground::new(&field.config, image.soil_contrast, image.sun());
        Studio { world: World::new(field, weeds, clutter, targets), camera, image, ground }
    }

    /// Takes photo number `photo`, from 0; the number decides its exposure and noise.
    pub fn photo(&self, shot: &Shot, photo: usize) -> Photo {
        let (width, height) =
            (self.camera.config().width_px as usize, self.camera.config().height_px as usize);
        let view = View::new(self, shot);
        let mut frame = Frame { width, height, light: vec![0.0; 3 * width * height] };
        let mut mask = GrayImage::new(width as u32, height as u32);
        let mut plants = RgbImage::new(width as u32, height as u32);
        let mut leaves = vec![0; width * height];
        frame
            .light
            .par_chunks_mut(3 * width * TILE)
            .zip(mask.par_chunks_mut(width * TILE))
            .zip(plants.par_chunks_mut(3 * width * TILE))
            .zip(leaves.par_chunks_mut(width * TILE))
            .enumerate()
            .for_each_init(
                Samples::<4>::new,
                |samples, (row, (((light, mask), plants), leaves))| {
                    for column in 0..width.div_ceil(TILE) {
                        let out = Out { light, mask, plants, leaves, width };
                        view.tile(samples, column, row, out);
                    }
                },
            );
        if self.image.motion_blur {
            frame.smear(&self.motion(shot));
        }
        frame.blur(self.image.defocus_px);
        let gains = self.gains(shot, photo);
        let seed = self.world.field.config.flight_seed();
        let image = frame.develop(self.image, (seed, photo), gains);
        Photo { image, mask, plants, leaves }
    }

    /// What the light of each channel is multiplied by in photo number `photo`, vignetting aside.
    pub fn gains(&self, shot: &Shot, photo: usize) -> [f64; 3] {
        let gains = sensor::gains(self.image, self.world.field.config.seed, photo);
        let exposure = shot.light * shot.sensitivity.unwrap_or(1.0);
        [0, 1, 2].map(|c| gains[c] * exposure * self.image.light[c])
    }

    /// How far the ground in the middle of every block moves during the exposure, pixels.
    fn motion(&self, shot: &Shot) -> Vec<[f32; 2]> {
        let config = self.camera.config();
        let exposure = 0.5 * shot.exposure_s;
        let (columns, rows) =
            ((config.width_px as usize).div_ceil(TILE), (config.height_px as usize).div_ceil(TILE));
        (0..rows * columns)
            .map(|block| {
                let middle = |index: usize| (index * TILE + TILE / 2) as f64;
                let (u, v) = (middle(block % columns), middle(block / columns));
                let still = [0.0; 2];
                let (origin, direction) = shot.ray(self.camera, u, v);
                let Some(reach) = self.world.field.terrain.meet(origin, direction, origin[2])
                else {
                    return still;
                };
                let place = [0, 1, 2].map(|i| origin[i] + reach * direction[i]);
                let ends = [-exposure, exposure].map(|s| shot.project_at(self.camera, place, s));
                match ends {
                    [Some(a), Some(b)] => [(b[0] - a[0]) as f32, (b[1] - a[1]) as f32],
                    _ => still,
                }
            })
            .collect()
    }
}

/// Where one tile's pixels go.
struct Out<'o> {
    light: &'o mut [f32],
    mask: &'o mut [u8],
    plants: &'o mut [u8],
    leaves: &'o mut [u32],
    width: usize,
}

/// What one photo sees.
struct View<'a> {
    studio: &'a Studio<'a>,
    shot: &'a Shot,
    places: Vec<Place>,
    bins: Bins,
    shader: Shader,
}

impl<'a> View<'a> {
    fn new(studio: &'a Studio<'a>, shot: &'a Shot) -> View<'a> {
        let (camera, terrain) = (studio.camera, &studio.world.field.terrain);
        let (width, height) =
            (camera.config().width_px as usize, camera.config().height_px as usize);
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        const STEPS: usize = 24;
        for step in 0..=STEPS {
            for other in 0..=STEPS {
                let at = |step: usize, size: usize| step as f64 / STEPS as f64 * size as f64 - 0.5;
                let (origin, direction) = shot.ray(camera, at(step, width), at(other, height));
                if let Some(reach) = terrain.meet(origin, direction, origin[2]) {
                    for axis in 0..3 {
                        let value = origin[axis] + reach * direction[axis];
                        low[axis] = low[axis].min(value);
                        high[axis] = high[axis].max(value);
                    }
                }
            }
        }
        // A square metre matters where a place on it, or as near to it as leaves and shadows reach, is seen.
        let seen = |x: f64, y: f64| {
            let pixel = shot.project_within(camera, [x, y, terrain.height_m(x, y)], 0.0, 1.0);
            pixel.is_some_and(|pixel| camera.inside(pixel, 0.0))
        };
        const REACH_M: [f64; 5] = [-2.0, -1.0, 0.0, 1.0, 2.0];
        let wanted = |[x, y]: [f64; 2]| {
            REACH_M.iter().any(|dy| REACH_M.iter().any(|dx| seen(x + dx, y + dy)))
        };
        let mesh = studio.world.gather([low[0], low[1]], [high[0], high[1]], wanted);
        let places: Vec<Place> = mesh
            .vertices
            .par_iter()
            .map(|vertex| {
                let place = vertex.place_m.map(f64::from);
                // Both iterations contract so fast that what is left is far below a thousandth of a pixel.
                let pixel = shot.project_within(camera, place, 0.0, 0.02);
                let Some([u, v]) = pixel else { return [f32::NAN; 3] };
                let (centre, rotation) = shot.pose(shot.row_time_s(v));
                let away: f64 = (0..3).map(|i| rotation[i][2] * (centre[i] - place[i])).sum();
                [u as f32, v as f32, (1.0 / away) as f32]
            })
            .collect();
        let bins = Bins::new(&places, &mesh.triangles, width, height);
        let tallest = mesh.vertices.iter().map(|v| f64::from(v.place_m[2])).fold(high[2], f64::max);
        let gsd_m = shot.centre_m[2].abs().max(1.0) / camera.config().c_px;
        let shadows = Shadows::new(
            &mesh,
            studio.image.sun(),
            [low[0] - 0.2, low[1] - 0.2],
            [high[0] + 0.2, high[1] + 0.2],
            [low[2] - 0.5, tallest],
            (0.6 * gsd_m).clamp(0.002, 0.05),
        );
        let shader = Shader::new(mesh, shadows, studio.image.sun());
        View { studio, shot, places, bins, shader }
    }

    /// Ground sampling distance in the middle of a tile, metres.
    fn gsd_m(&self, u: f64, v: f64) -> f32 {
        let camera = self.studio.camera;
        let place = |u: f64, v: f64| {
            let (origin, direction) = self.shot.ray(camera, u, v);
            let reach = origin[2] / -direction[2];
            [origin[0] + reach * direction[0], origin[1] + reach * direction[1]]
        };
        let ([a, b], [c, d], [e, f]) = (place(u, v), place(u + 1.0, v), place(u, v + 1.0));
        (0.5 * (f64::hypot(c - a, d - b) + f64::hypot(e - a, f - b))) as f32
    }

    fn tile(&self, samples: &mut Samples<4>, column: usize, row: usize, out: Out<'_>) {
        let corner = [column * TILE, row * TILE];
        let list = self.bins.tile(column, row);
        samples.clear();
        samples.draw(list, &self.places, &self.shader.mesh.triangles, corner, &SAMPLES);
        let gsd_m = self.gsd_m((corner[0] + TILE / 2) as f64, (corner[1] + TILE / 2) as f64);
        let rows = out.mask.len() / out.width;
        let columns = TILE.min(out.width - corner[0]);
        let mut last = Tangent { place_m: [0.0; 3], slope: [0.0; 2] };
        for line in 0..rows {
            let v = corner[1] + line;
            let (origin, rotation) = self.shot.pose(self.shot.row_time_s(v as f64));
            for step in 0..columns {
                let u = corner[0] + step;
                let direction = self.studio.camera.direction(u as f64, v as f64);
                let ray = crate::flight::times(&rotation, direction);
                let nearest = &samples.nearest[(line * TILE + step) * 4..][..4];
                let mut light = [0.0f32; 3];
                let (mut bare, mut green) = (0u8, 0u8);
                let (mut owners, mut blades) = ([0u32; 4], [0u32; 4]);
                for sample in 0..4 {
                    let triangle = nearest[sample];
                    if triangle == NONE {
                        bare += 1;
                        continue;
                    }
                    let place = [u as f32 + SAMPLES[sample][0], v as f32 + SAMPLES[sample][1]];
                    let (colour, thing) = self.shader.shade(&self.places, triangle, place, ray);
                    for (sum, part) in light.iter_mut().zip(colour) {
                        *sum += 0.25 * part;
                    }
                    green += u8::from(thing.green);
                    owners[sample] = thing.plant;
                    blades[sample] = thing.leaf;
                }
                if bare > 0 {
                    let colour = self.ground(origin, ray, gsd_m, &mut last);
                    for (sum, part) in light.iter_mut().zip(colour) {
                        *sum += 0.25 * f32::from(bare) * part;
                    }
                }
                let pixel = line * out.width + u;
                out.light[3 * pixel..3 * pixel + 3].copy_from_slice(&light);
                out.mask[pixel] = if green >= 2 { 255 } else { 0 };
                let [r, g, b, _] = owner(owners).to_le_bytes();
                out.plants[3 * pixel..3 * pixel + 3].copy_from_slice(&[r, g, b]);
                out.leaves[pixel] = owner(blades);
            }
        }
    }

    /// The light that comes from the ground along a ray. `last` is where the ray before met it.
    fn ground(&self, origin: [f64; 3], ray: [f64; 3], gsd_m: f32, last: &mut Tangent) -> [f32; 3] {
        let start = last.meet(origin, ray);
        let terrain = &self.studio.world.field.terrain;
        let met = terrain.meet_within(origin, ray, start, 1e-3);
        let Some((reach, slope)) = met else { return [0.0; 3] };
        let place_m = [0, 1, 2].map(|i| origin[i] + reach * ray[i]);
        *last = Tangent { place_m, slope };
        let (colour, relief) = self.studio.ground.look(place_m[0], place_m[1], gsd_m);
        self.shader.ground(place_m.map(|value| value as f32), slope, colour, relief)
    }
}

/// The tangent plane of the ground at a place: where the next ray begins its search.
struct Tangent {
    place_m: [f64; 3],
    slope: [f64; 2],
}

impl Tangent {
    fn meet(&self, origin: [f64; 3], ray: [f64; 3]) -> f64 {
        let [a, b] = self.slope;
        let away = [0, 1, 2].map(|i| origin[i] - self.place_m[i]);
        (away[2] - a * away[0] - b * away[1]) / (a * ray[0] + b * ray[1] - ray[2])
    }
}

/// The plant or leaf that holds most of the four samples, the smallest number where several do; 0 where
/// they hold less than half.
fn owner(owners: [u32; 4]) -> u32 {
    let count = |plant: u32| owners.iter().filter(|&&other| other == plant).count();
    let plants = owners.iter().copied().filter(|&plant| plant != 0);
    if plants.clone().count() < 2 {
        return 0;
    }
    plants.max_by_key(|&plant| (count(plant), std::cmp::Reverse(plant))).unwrap_or(0)
}
