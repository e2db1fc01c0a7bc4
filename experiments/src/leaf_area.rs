//! Leaf count against leaf area: how linear it is, and what the kind of picture does to it.
//!
//! The same stand, planted at three densities, seen by a wide-angle camera as taken, without its distortion, and from straight
//! above (what a perfect orthomosaic shows); true masks, so that nothing but geometry differs. The ground is cut into squares;
//! a square's pixels are those whose rays meet the ground in it, its leaves those of the plants that stand in it.
//!
//! - `r2`: squared correlation of leaves and pixels over the squares, with a 95 % bootstrap interval;
//! - bias: leaves counted from area (`rho` from the squares of the inner third, by distance from the nadir) in the outer
//!   third, of the true ones, with the interval that the program gives for the count.

use crate::{leaf_area_figure, locate::make};
use data_synth::{
    camera::CameraConfig,
    field::{Field, GrowthStage},
    files, labels,
    twin::{FlightPreset, Twin, TwinConfig},
};
use image::{Rgb, RgbImage};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rowgram::{
    Error,
    camera::{Camera, Lens},
    io::output,
    mapping::undistort::{self, Crop, Interpolation},
    phenotype::leaf_count::{Calibration, Region},
};
use std::{fmt::Write as _, path::Path};

/// Side of a square, metres: two rows.
const SIDE_M: f64 = 1.52;
/// Squares on each side of the middle.
const SQUARES: i64 = 6;
/// In-row spacings of the stands, metres.
const SPACINGS_M: [f64; 3] = [0.12, 0.2, 0.4];
/// Draws of the bootstrap.
const DRAWS: usize = 2000;

/// Growth stages, each a panel of the figure.
pub(crate) const STAGES: [GrowthStage; 3] =
    [GrowthStage::Early, GrowthStage::Mid, GrowthStage::Late];
/// Kinds of pictures, each a colour.
pub(crate) const KINDS: [&str; 3] = ["as taken", "without distortion", "straight above"];

/// A square of the ground in one kind of picture.
pub(crate) struct Square {
    pub(crate) stage: usize,
    pub(crate) kind: usize,
    spacing_m: f64,
    /// Distance of its middle from the nadir, metres.
    away_m: f64,
    pub(crate) pixels: f64,
    pub(crate) leaves: f64,
}

/// Runs everything and writes `leaf_area.csv`, `leaf_area.md` and `leaf_area.svg`.
pub(crate) fn run(out: &Path) -> Result<(), Error> {
    make(out)?;
    let mut squares = Vec::new();
    for stage in 0..STAGES.len() {
        for spacing_m in SPACINGS_M {
            squares.extend(stand(stage, spacing_m)?);
        }
    }
    let mut csv = "stage,kind,spacing_m,from_nadir_m,pixels,leaves\n".to_owned();
    for s in &squares {
        let (stage, kind) = (STAGES[s.stage], KINDS[s.kind]);
        let _ = writeln!(
            csv,
            "{stage},{kind},{},{:.3},{},{}",
            s.spacing_m, s.away_m, s.pixels, s.leaves
        );
    }
    let text = table(&squares)?;
    let svg = leaf_area_figure::draw(&squares).map_err(unusable)?;
    for (name, content) in
        [("leaf_area.csv", &csv), ("leaf_area.md", &text), ("leaf_area.svg", &svg)]
    {
        output::write(&out.join(name), true, |writer| writer.write_all(content.as_bytes()))?;
    }
    Ok(())
}

/// One photo above the middle of one stand, in its three kinds.
fn stand(stage: usize, spacing_m: f64) -> Result<Vec<Square>, Error> {
    let mut config = TwinConfig::preset(FlightPreset::Paper);
    config.field.stage = STAGES[stage];
    config.field.spacing_m = spacing_m;
    config.field.rows = 36;
    config.field.row_length_m = 28.0;
    config.field.plots = Default::default();
    config.corruption.weeds_per_m2 = 0.0;
    config.camera = CameraConfig::wide(2288, 1716, 1000.0);
    config.flight.readout_seconds = 0.0;
    config.flight.position_m = 0.0;
    (config.flight.strips, config.flight.photos_per_strip) = (1, 1);
    let twin = config.build().map_err(unusable)?;
    let shot = &twin.shots[0];
    let photo = twin.studio().photo(shot, 0);
    let taken = RgbImage::from_fn(photo.mask.width(), photo.mask.height(), |u, v| {
        Rgb([photo.mask.get_pixel(u, v).0[0]; 3])
    });
    let lens = lens(&twin)?;
    let ideal = undistort::ideal_camera(&lens.interior, Crop::All, 1.0).map_err(unusable)?;
    let (flat, _) = undistort::undistort(&taken, &lens.interior, &ideal, Interpolation::Bilinear)
        .map_err(unusable)?;
    let field = twin.field();
    let above = labels::labels(field, &[]);
    let mut grids = [(); 3].map(|()| Grid::new(field, [shot.centre_m[0], shot.centre_m[1]]));
    let ray = |direction: [f64; 3]| -> [f64; 3] {
        [0, 1, 2].map(|i| (0..3).map(|j| shot.rotation[i][j] * direction[j]).sum())
    };
    let ground = |direction: [f64; 3]| {
        let [x, y, z] = ray(direction);
        let reach = field.terrain.meet(shot.centre_m, [x, y, z], shot.centre_m[2])?;
        Some([shot.centre_m[0] + reach * x, shot.centre_m[1] + reach * y])
    };
    for (u, v, pixel) in taken.enumerate_pixels().filter(|(_, _, pixel)| pixel.0[0] > 127) {
        debug_assert!(pixel.0[0] == 255);
        if let Some(place) = ground(twin.camera.direction(f64::from(u), f64::from(v))) {
            grids[0].add(field, place);
        }
    }
    for (u, v, _) in flat.enumerate_pixels().filter(|(_, _, pixel)| pixel.0[0] > 127) {
        let direction = ideal.unproject([f64::from(u), f64::from(v)]);
        if let Some(place) = direction.and_then(ground) {
            grids[1].add(field, place);
        }
    }
    for (index, _) in above.data.iter().enumerate().filter(|&(_, &label)| label > 0) {
        let (u, v) = ((index % above.width) as f64, (index / above.width) as f64);
        grids[2].add(field, field.frame.ground(u, v));
    }
    let mut leaves = Grid::new(field, [shot.centre_m[0], shot.centre_m[1]]);
    for plant in &field.plants {
        for _ in &plant.leaves {
            leaves.add(field, [plant.x_m, plant.y_m]);
        }
    }
    let mut squares = Vec::new();
    for (at, &count) in leaves.counts.iter().enumerate() {
        let [i, j] = leaves.middle_m(at);
        // All corners in the photo, leaves as high as they grow included, and in the stand.
        let seen = [(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)].iter().all(|(a, b)| {
            let (along, across) = (i + a * SIDE_M, j + b * SIDE_M);
            let [x, y] = field.config.ground(along, across);
            let ground_m = field.terrain.height_m(x, y);
            let stands = along.abs() < 0.5 * field.config.row_length_m;
            stands
                && [0.0, 1.5].iter().all(|up| {
                    let pixel = shot.project(&twin.camera, [x, y, ground_m + up]);
                    pixel.is_some_and(|pixel| twin.camera.inside(pixel, 0.0))
                })
        });
        let away_m = (i - leaves.middle[0]).hypot(j - leaves.middle[1]);
        if seen {
            squares.extend(grids.iter().enumerate().map(|(kind, grid)| {
                let (pixels, leaves) = (grid.counts[at], count);
                Square { stage, kind, spacing_m, away_m, pixels, leaves }
            }));
        }
    }
    Ok(squares)
}

fn lens(twin: &Twin) -> Result<Camera, Error> {
    let mut toml = Vec::new();
    files::camera(twin, &mut toml).map_err(unusable)?;
    Camera::from_toml(&String::from_utf8_lossy(&toml)).map_err(unusable)
}

fn unusable(error: impl std::fmt::Display) -> Error {
    Error::Argument(error.to_string())
}

/// Counts in the squares around a place, along and across the rows.
struct Grid {
    middle: [f64; 2],
    counts: Vec<f64>,
}

impl Grid {
    const ACROSS: i64 = 2 * SQUARES + 1;

    fn new(field: &Field, middle_m: [f64; 2]) -> Grid {
        let middle = field.config.along_across(middle_m[0], middle_m[1]);
        Grid { middle, counts: vec![0.0; (Self::ACROSS * Self::ACROSS) as usize] }
    }

    fn add(&mut self, field: &Field, [x_m, y_m]: [f64; 2]) {
        let place = field.config.along_across(x_m, y_m);
        let [i, j] =
            [0, 1].map(|k| ((place[k] - self.middle[k]) / SIDE_M).round() as i64 + SQUARES);
        if (0..Self::ACROSS).contains(&i) && (0..Self::ACROSS).contains(&j) {
            self.counts[(j * Self::ACROSS + i) as usize] += 1.0;
        }
    }

    /// The middle of a square, along and across.
    fn middle_m(&self, at: usize) -> [f64; 2] {
        let (i, j) = (at as i64 % Self::ACROSS - SQUARES, at as i64 / Self::ACROSS - SQUARES);
        [self.middle[0] + i as f64 * SIDE_M, self.middle[1] + j as f64 * SIDE_M]
    }
}

fn table(squares: &[Square]) -> Result<String, Error> {
    let mut text = "# Leaf count against leaf area\n\n| stage | picture | squares | r2 | 95 % | pixels per \
         leaf, inner third | outer third: counted/true | 95 % |\n|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for (stage, name) in STAGES.iter().enumerate() {
        for (kind, picture) in KINDS.iter().enumerate() {
            let mut mine: Vec<&Square> =
                squares.iter().filter(|s| (s.stage, s.kind) == (stage, kind)).collect();
            mine.sort_by(|a, b| a.away_m.total_cmp(&b.away_m));
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let mut draws: Vec<f64> = (0..DRAWS)
                .map(|_| {
                    let drawn: Vec<&Square> =
                        mine.iter().map(|_| mine[rng.random_range(0..mine.len())]).collect();
                    r2(&drawn)
                })
                .collect();
            draws.sort_by(f64::total_cmp);
            let third = mine.len() / 3;
            let regions: Vec<Region> = mine[..third]
                .iter()
                .map(|s| Region { pixels: s.pixels, leaves: s.leaves })
                .collect();
            let calibration = Calibration::from_regions(&regions).map_err(Error::Argument)?;
            let outer = &mine[mine.len() - third..];
            let pixels: Vec<u64> = outer.iter().map(|s| s.pixels as u64).collect();
            let truth: f64 = outer.iter().map(|s| s.leaves).sum();
            let count = calibration.count(&pixels, 1);
            let [low, high] = count.interval.map_or([f64::NAN; 2], |i| [i.low, i.high]);
            let _ = writeln!(
                text,
                "| {name} | {picture} | {} | {:.3} | {:.3} to {:.3} | {:.1} | {:.3} | {:.3} to {:.3} |",
                mine.len(),
                r2(&mine),
                draws[DRAWS / 40],
                draws[DRAWS - 1 - DRAWS / 40],
                calibration.rho,
                count.leaves / truth,
                low / truth,
                high / truth,
            );
        }
    }
    Ok(text)
}

/// Squared correlation of leaves and pixels.
fn r2(squares: &[&Square]) -> f64 {
    let count = squares.len() as f64;
    let mean = |f: fn(&Square) -> f64| squares.iter().map(|s| f(s)).sum::<f64>() / count;
    let (x, y) = (mean(|s| s.pixels), mean(|s| s.leaves));
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for s in squares {
        let (a, b) = (s.pixels - x, s.leaves - y);
        xx += a * a;
        xy += a * b;
        yy += b * b;
    }
    xy * xy / (xx * yy)
}
