//! The dense surface of small synthetic flights with true lenses and poses, compared with the true one.

use super::*;
use crate::{
    camera::{Interior, Model},
    mapping::{MapError, View, photo::DecodedPhoto},
    scene::Pose,
};
use data_synth::{
    camera::CameraConfig,
    field::GrowthStage,
    photo::{Cover, FirstSurface, SurfaceGrid},
    twin::{FlightPreset, Twin, TwinConfig},
};
use rowgram_optim::geometry::rotation;
use std::collections::BTreeMap;

const CELL_M: f64 = 0.015;
const SIZE: usize = 240;

/// Eight rows of 8 m, photos of 640 x 480 pixels from 8 m, 80 % of overlap along and 70 % across.
fn twin(readout_seconds: f64) -> Twin {
    config(readout_seconds).build().unwrap()
}

fn config(readout_seconds: f64) -> TwinConfig {
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.field.rows = 8;
    config.field.row_length_m = 8.0;
    config.field.plots = Default::default();
    config.camera = CameraConfig::compact(640, 480, 530.0);
    config.flight.height_m = 8.0;
    config.flight.margin_m = -1.0;
    config.flight.forward_overlap = 0.8;
    config.flight.side_overlap = 0.7;
    config.flight.position_m = 0.1;
    config.flight.readout_seconds = readout_seconds;
    config.targets.control = 0;
    config.targets.check = 0;
    config
}

fn views(twin: &Twin) -> Vec<View> {
    let c = &twin.config.camera;
    let values = [c.c_px, c.xp_px, c.yp_px, c.k0, c.k1, c.k2, c.k3, c.p1, c.p2, c.r0_px];
    let interior = Interior::new(Model::Smac, [c.width_px, c.height_px], &values).unwrap();
    let shots = twin.shots.iter();
    shots
        .map(|shot| {
            let [omega, phi, kappa] = shot.angles_rad();
            let about = [[omega, 0.0, 0.0], [0.0, phi, 0.0], [0.0, 0.0, kappa]];
            let [x, y, z] = about.map(rotation::exp);
            let turned = rotation::inverse(rotation::multiply(rotation::multiply(x, y), z));
            // While the frame is read out the centre moves, so the scene moves back in the camera frame.
            let shift = rotation::rotate(turned, shot.velocity_m_s.map(|v| -v * shot.readout_s));
            let motion = [0.0, 0.0, 0.0, shift[0], shift[1], shift[2]];
            let motion = (shot.readout_s > 0.0).then_some(motion);
            View::new(&shot.name, interior, Pose::from_centre(turned, shot.centre_m), motion)
        })
        .collect()
}

fn area_options() -> AreaOptions {
    AreaOptions {
        range_m: 0.6,
        relief_m: 0.6,
        others: 4,
        tile_cells: 64,
        penalties: Penalties::default(),
        prior: Prior::default(),
    }
}

struct Quality {
    known: f64,
    bare_nmad_m: f64,
    leaves_within: f64,
    soil_near_within: f64,
    terrain_rmse_m: f64,
}

fn compare((found, ground): &(DenseTile, Terrain), truth: &FirstSurface) -> Quality {
    let near_plant = |at: usize| {
        let (i, j) = ((at % SIZE) as i32, (at / SIZE) as i32);
        (-5..=5).any(|dj| {
            (-5..=5).any(|di| {
                let (x, y) = (i + di, j + dj);
                let inside = x >= 0 && y >= 0 && x < SIZE as i32 && y < SIZE as i32;
                inside && truth.cover[y as usize * SIZE + x as usize] == Cover::Plant
            })
        })
    };
    let (mut bare, mut leaves, mut near, mut terrain) = (vec![], vec![], vec![], vec![]);
    for at in 0..SIZE * SIZE {
        let off = f64::from(found.surface_m[at] - truth.top_m[at]);
        match truth.cover[at] {
            Cover::Plant => leaves.push(off),
            Cover::Ground if near_plant(at) => near.push(off),
            Cover::Ground if off.is_finite() => bare.push(off),
            _ => {}
        }
        let place = found.tile.place_m(at % SIZE, at / SIZE);
        let below = ground.at_m(place).unwrap();
        terrain.push((below - f64::from(truth.ground_m[at])).powi(2));
    }
    let within =
        |off: &[f64]| off.iter().filter(|off| off.abs() < 0.05).count() as f64 / off.len() as f64;
    bare.sort_by(f64::total_cmp);
    let middle = bare[bare.len() / 2];
    let mut away: Vec<f64> = bare.iter().map(|off| (off - middle).abs()).collect();
    away.sort_by(f64::total_cmp);
    let known = found.surface_m.iter().filter(|z| z.is_finite()).count();
    Quality {
        known: known as f64 / (SIZE * SIZE) as f64,
        bare_nmad_m: 1.4826 * away[away.len() / 2],
        leaves_within: within(&leaves),
        soil_near_within: within(&near),
        terrain_rmse_m: (terrain.iter().sum::<f64>() / terrain.len() as f64).sqrt(),
    }
}

fn surface_of(twin: &Twin) -> ((DenseTile, Terrain), FirstSurface) {
    let tile = Tile { corner_m: [-1.5, 1.9], cell_m: CELL_M, size: [SIZE; 2] };
    let [left_m, top_m] = tile.corner_m;
    let grid = SurfaceGrid { left_m, top_m, cell_m: CELL_M, width: SIZE, height: SIZE };
    let studio = twin.studio();
    let views = views(twin);
    let photos: Vec<DecodedPhoto> = (0..twin.shots.len())
        .map(|k| DecodedPhoto::new(&studio.photo(&twin.shots[k], k).image, None))
        .collect();
    let read = |k: usize| -> Result<DecodedPhoto, MapError> { Ok(photos[k].clone()) };
    // A surface of tie points: a level somewhere in the canopy.
    let level = twin.field().terrain.height_m(0.3, 0.1) + 0.1;
    let base = |_: [f64; 2]| Some(level);
    let options = AreaOptions { tile_cells: SIZE, ..area_options() };
    let area = Area { views: &views, read: &read, base: &base, cells: tile, options };
    let mut store = TilesInMemory::default();
    let tiles: &mut dyn TileStore<MapError> = &mut store;
    let ground = area.match_all(tiles, &mut || ()).unwrap().terrain.unwrap();
    let found = tiles.load(Pass::Fine, 0).unwrap().unwrap();
    ((found, ground), studio.first_surface(grid))
}

#[test]
fn leaves_and_soil_are_where_they_are() {
    let (found, truth) = surface_of(&twin(0.0));
    let q = compare(&found, &truth);
    let all = [q.known, q.bare_nmad_m, q.leaves_within, q.soil_near_within, q.terrain_rmse_m];
    println!("known, bare soil (m), leaves, soil beside leaves, ground (m): {all:?}");
    assert!(q.known > 0.99, "{all:?}");
    assert!(q.bare_nmad_m < 0.5 * CELL_M, "{all:?}");
    assert!(q.leaves_within > 0.55, "{all:?}");
    assert!(q.soil_near_within > 0.86, "{all:?}");
    // Furrows of 5 cm between rows are less deep on nodes of 30 cm.
    assert!(q.terrain_rmse_m < 0.02, "{all:?}");
}

#[test]
fn rows_that_repeat_every_ten_centimetres_are_not_matched_one_off() {
    // Neighbouring photos see them from 0.18 and 0.36 of the height of flight: one row off is 55 or 28 cm of height, and layers reach as far.
    let mut config = config(0.0);
    config.field.stage = GrowthStage::Early;
    (config.field.rows, config.field.inter_row_m, config.field.spacing_m) = (60, 0.1, 0.05);
    config.field.terrain.furrow_m = 0.01;
    let (found, truth) = surface_of(&config.build().unwrap());
    let found = found.0;
    let off = found.surface_m.iter().zip(&truth.top_m).map(|(z, top)| (z - top).abs());
    let wrong = off.filter(|off| *off > 0.2).count();
    assert!(wrong < SIZE * SIZE / 1000, "{wrong} cells");
    assert!(found.surface_m.iter().filter(|z| z.is_finite()).count() > SIZE * SIZE * 99 / 100);
}

#[test]
fn rows_of_a_rolling_shutter_have_poses_of_their_own() {
    let (found, truth) = surface_of(&twin(0.03));
    let q = compare(&found, &truth);
    assert!(q.bare_nmad_m < 0.6 * CELL_M, "{}", q.bare_nmad_m);
    assert!(q.leaves_within > 0.5, "{}", q.leaves_within);
}

#[test]
fn any_number_of_threads_gives_the_same_and_bad_input_is_refused() {
    let twin = twin(0.0);
    let views = views(&twin);
    let studio = twin.studio();
    let of = |k: usize| DecodedPhoto::new(&studio.photo(&twin.shots[k], k).image, None);
    let photos: Vec<MatchedPhoto> = (0..4).map(|k| MatchedPhoto::new(of(k))).collect();
    let posed: Vec<PosedPhoto<'_>> =
        views.iter().zip(&photos).map(|(view, photo)| PosedPhoto { view, photo }).collect();
    let [x, y, _] = twin.shots[1].centre_m;
    let tile = Tile { corner_m: [x - 1.0, y + 0.5], cell_m: 0.03, size: [300, 40] };
    let base = |_: [f64; 2]| Some(0.0);
    let options = DenseOptions { prior: Prior::None, ..DenseOptions::default() };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let found = pool.install(|| match_tile(&posed, &base, &tile, &options, None)).unwrap();
        let bits: Vec<u32> = found.surface_m.iter().map(|z| z.to_bits()).collect();
        assert!(found.surface_m.iter().any(|z| z.is_finite()));
        (bits, found.confidence, found.photos)
    };
    assert_eq!(with(1), with(3));
    let refused =
        |result: Result<DenseTile, crate::mapping::MapError>| result.unwrap_err().to_string();
    assert!(refused(match_tile(&posed[..1], &base, &tile, &options, None)).contains("at least 2"));
    let nowhere = |_: [f64; 2]| None;
    assert!(refused(match_tile(&posed, &nowhere, &tile, &options, None)).contains("no height"));
    let wrong = DenseOptions { layer_m: 0.0, ..options };
    assert!(refused(match_tile(&posed, &base, &tile, &wrong, None)).contains("positive length"));
    // Photos that do not overlap there: no height, and no guess.
    let beyond = Tile { corner_m: [x + 500.0, y], ..tile };
    let found = match_tile(&posed, &base, &beyond, &options, None).unwrap();
    assert!(found.surface_m.iter().all(|z| z.is_nan()));
}

/// All tiles in memory.
#[derive(Default)]
struct TilesInMemory(BTreeMap<(Pass, usize), DenseTile>);

impl<E> TileStore<E> for TilesInMemory {
    fn load(&mut self, pass: Pass, number: usize) -> Result<Option<DenseTile>, E> {
        Ok(self.0.get(&(pass, number)).cloned())
    }

    fn save(&mut self, pass: Pass, number: usize, tile: &DenseTile) -> Result<(), E> {
        self.0.insert((pass, number), tile.clone());
        Ok(())
    }
}

/// Tiles in memory that refuse to be kept after a number of them, as a full disk would.
struct Stopping {
    kept: TilesInMemory,
    left: usize,
    asked: usize,
}

impl TileStore<MapError> for Stopping {
    fn load(&mut self, pass: Pass, number: usize) -> Result<Option<DenseTile>, MapError> {
        self.kept.load(pass, number)
    }

    fn save(&mut self, pass: Pass, number: usize, tile: &DenseTile) -> Result<(), MapError> {
        self.asked += 1;
        self.left = self.left.checked_sub(1).ok_or_else(|| MapError("stopped".into()))?;
        self.kept.save(pass, number, tile)
    }
}

#[test]
fn an_attempt_that_stops_between_tiles_goes_on_to_the_same_bits() {
    let twin = twin(0.0);
    let views = views(&twin);
    let studio = twin.studio();
    let photos: Vec<DecodedPhoto> = (0..twin.shots.len())
        .map(|k| DecodedPhoto::new(&studio.photo(&twin.shots[k], k).image, None))
        .collect();
    let read = |k: usize| -> Result<DecodedPhoto, MapError> { Ok(photos[k].clone()) };
    let [x, y, _] = twin.shots[1].centre_m;
    let cells = Tile { corner_m: [x - 1.0, y + 0.9], cell_m: 0.03, size: [200, 120] };
    let base = |_: [f64; 2]| Some(0.1);
    let options = area_options();
    let area = Area { views: &views, read: &read, base: &base, cells, options };
    let attempt = |store: &mut dyn TileStore<MapError>| {
        let mut done = 0;
        let found = area.match_all(store, &mut || done += 1);
        found.map(|ground| (ground, done))
    };
    let mut whole = TilesInMemory::default();
    let (ground, done) = attempt(&mut whole).unwrap();
    let [coarse, fine] = [Pass::Coarse, Pass::Fine].map(|pass| area.tiles(pass));
    let tiles = coarse + fine;
    assert_eq!((done, coarse, fine), (tiles, 2, 8));
    assert!(ground.terrain.is_some());
    // Stopped in the coarse pass, and again in the fine one.
    let mut store = Stopping { kept: TilesInMemory::default(), left: 1, asked: 0 };
    assert_eq!(attempt(&mut store).unwrap_err().to_string(), "stopped");
    store.left = 5;
    assert_eq!(attempt(&mut store).unwrap_err().to_string(), "stopped");
    (store.left, store.asked) = (tiles, 0);
    let (resumed, done) = attempt(&mut store).unwrap();
    assert_eq!(done, tiles);
    assert_eq!(store.asked, tiles - 6, "what was kept is not matched again");
    assert_eq!(resumed, ground);
    let bits = |store: &mut TilesInMemory, pass, number| {
        let found: Result<Option<DenseTile>, MapError> = store.load(pass, number);
        let tile = found.unwrap().unwrap();
        let heights: Vec<u32> =
            tile.surface_m.iter().chain(&tile.sigma_m).map(|z| z.to_bits()).collect();
        (heights, tile.confidence, tile.photos, tile.colour)
    };
    // In parts, the last ones first.
    let mut parts = TilesInMemory::default();
    for (pass, from) in [(Pass::Coarse, 1..2), (Pass::Coarse, 0..1), (Pass::Fine, 3..8)] {
        area.match_tiles(pass, from, &mut parts, &mut || ()).unwrap();
    }
    assert_eq!(attempt(&mut parts).unwrap().0, ground);
    for (pass, count) in [(Pass::Coarse, coarse), (Pass::Fine, fine)] {
        for number in 0..count {
            let expected = bits(&mut whole, pass, number);
            assert!(expected == bits(&mut store.kept, pass, number), "{pass:?} {number}");
            assert!(expected == bits(&mut parts, pass, number), "{pass:?} {number}");
        }
    }
    assert!(bits(&mut whole, Pass::Fine, 0).0.iter().any(|&z| f32::from_bits(z).is_finite()));
}

#[test]
fn two_photos_no_overlap_and_water_say_what_is_not_known() {
    let twin = twin(0.0);
    let views = views(&twin);
    let studio = twin.studio();
    let photos: Vec<DecodedPhoto> =
        (0..2).map(|k| DecodedPhoto::new(&studio.photo(&twin.shots[k], k).image, None)).collect();
    let [x, y, _] = twin.shots[1].centre_m;
    let area = Tile { corner_m: [x - 1.0, y + 0.9], cell_m: 0.03, size: [100, 60] };
    let options = area_options();
    type Read<'a> = &'a (dyn Fn(usize) -> Result<DecodedPhoto, MapError> + Sync);
    let attempt = |read: Read<'_>, cells: &Tile| {
        let mut store = TilesInMemory::default();
        let base = |_: [f64; 2]| Some(0.1);
        let area = Area { views: &views[..2], read, base: &base, cells: *cells, options };
        let found = area.match_all(&mut store, &mut || ())?;
        let tile: Result<_, MapError> = store.load(Pass::Fine, 0);
        Ok::<_, MapError>((found, tile?.unwrap()))
    };
    // Two photos see the same ground, and heights are those of the pair.
    let (found, tile) = attempt(&|k| Ok(photos[k].clone()), &area).unwrap();
    assert!(found.terrain.is_some());
    assert!(tile.photos.iter().all(|&n| n <= 2) && tile.photos.contains(&2));
    assert!(tile.surface_m.iter().any(|z| z.is_finite()));
    // Ground that neither shows.
    let away = Tile { corner_m: [x + 400.0, y], ..area };
    let refused = attempt(&|k| Ok(photos[k].clone()), &away).unwrap_err().to_string();
    assert!(refused.contains("nowhere do two photos"), "{refused}");
    // Water without a ripple looks alike at all heights: no height is better than another, and nothing is taken for ground.
    let water = image::RgbImage::from_pixel(640, 480, image::Rgb([60, 70, 80]));
    let (found, tile) = attempt(&|_| Ok(DecodedPhoto::new(&water, None)), &area).unwrap();
    assert_eq!(found.terrain, None);
    assert!(tile.confidence.iter().all(|&c| c == 0), "{:?}", tile.confidence.iter().max());
    let sigmas = || tile.sigma_m.iter().filter(|sigma| sigma.is_finite());
    let least = sigmas().fold(f32::INFINITY, |least, &sigma| least.min(sigma));
    assert!(sigmas().count() > 0 && f64::from(least) > 0.47 * options.range_m, "{least}");
}

#[test]
fn blocks_and_tiles_meet_without_steps() {
    let twin = twin(0.0);
    let mut views = views(&twin);
    // Orientations in error: blocks of other photos are at other heights.
    for (k, view) in views.iter_mut().enumerate() {
        let [x, y, z] = view.centre_m();
        let pose = Pose::from_centre(view.pose.rotation, [x, y, z + [0.02, -0.03, 0.01][k % 3]]);
        *view = View::new(&view.name, view.interior, pose, view.motion);
    }
    let studio = twin.studio();
    let photos: Vec<DecodedPhoto> = (0..twin.shots.len())
        .map(|k| DecodedPhoto::new(&studio.photo(&twin.shots[k], k).image, None))
        .collect();
    let read = |k: usize| -> Result<DecodedPhoto, MapError> { Ok(photos[k].clone()) };
    let cells = Tile { corner_m: [-1.5, 1.9], cell_m: 0.03, size: [128, 128] };
    let base = |_: [f64; 2]| Some(0.1);
    let options = AreaOptions { tile_cells: 64, ..area_options() };
    let area = Area { views: &views, read: &read, base: &base, cells, options };
    let mut store = TilesInMemory::default();
    let tiles: &mut dyn TileStore<MapError> = &mut store;
    let layer_m = area.match_all(tiles, &mut || ()).unwrap().layer_m;
    let margins = TileMargins::read(cells.size, 64, layer_m, tiles).unwrap();
    let mut heights = [vec![f32::NAN; 128 * 128], vec![f32::NAN; 128 * 128]];
    for (number, [u, v]) in area::starts(cells.size, 64).into_iter().enumerate() {
        let apart = tiles.load(Pass::Fine, number).unwrap().unwrap();
        let mut joined = apart.clone();
        margins.join([u, v], &mut joined);
        for (all, part) in heights.iter_mut().zip([&apart, &joined]) {
            for (row, from) in part.surface_m.chunks(64).enumerate() {
                all[(v + row) * 128 + u..][..64].copy_from_slice(from);
            }
        }
    }
    // Median of the steps from one column to the next, all along the columns.
    let step = |all: &[f32], column: usize| {
        let mut steps: Vec<f32> = (0..128)
            .map(|row| (all[row * 128 + column] - all[row * 128 + column - 1]).abs())
            .filter(|step| step.is_finite())
            .collect();
        steps.sort_by(f32::total_cmp);
        steps[steps.len() / 2]
    };
    let usual: Vec<f32> =
        (8..120).filter(|k| k % 32 > 8 && k % 32 < 24).map(|k| step(&heights[1], k)).collect();
    let usual = usual.iter().sum::<f32>() / usual.len() as f32;
    let [apart, joined] = [0, 1].map(|k| step(&heights[k], 64));
    println!("steps at the line of tiles {apart} m, joined {joined} m, elsewhere {usual} m");
    assert!(apart > 1.5 * usual, "{apart} {usual}");
    assert!(joined < 1.2 * usual, "{joined} {usual}");
}
