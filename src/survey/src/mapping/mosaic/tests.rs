//! Mosaics of three photos of one colour each, side by side over level ground.

use super::*;
use crate::{
    camera::{Interior, Model},
    mapping::{Surface, View, photo::DecodedPhoto, select::SelectionOptions},
    scene::Pose,
};
use image::{Rgb, RgbImage};
use rowgram_raster::{georeference::Crs, polygon::Polygon};

const SIZE: [u32; 2] = [80, 60];
const COLOURS: [[u8; 3]; 3] = [[200, 10, 10], [10, 200, 10], [10, 10, 200]];

/// 8 m x 6 m on the ground each, 4 m apart.
fn views() -> Vec<View> {
    let values = [100.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let interior = Interior::new(Model::Smac, SIZE, &values).unwrap();
    let at = |k: usize| Pose::from_centre([1.0, 0.0, 0.0, 0.0], [4.0 * k as f64, 0.0, 10.0]);
    (0..3).map(|k| View::new(&format!("p{k}"), interior, at(k), None)).collect()
}

fn surface() -> Surface {
    let place = Georeference::north_up([-10.0, 10.0], 1.0, Crs::LOCAL);
    Surface::new(place, [31, 21], vec![0.0; 31 * 21]).unwrap()
}

/// Photo `k`; the left half of the second one has no data.
fn photo(k: usize) -> DecodedPhoto {
    let image = RgbImage::from_pixel(SIZE[0], SIZE[1], Rgb(COLOURS[k]));
    let gaps: Vec<bool> = (0..SIZE[0] * SIZE[1]).map(|n| k == 1 && n % SIZE[0] < 40).collect();
    DecodedPhoto::new(&image, Some(&gaps))
}

/// All cells of a mosaic of 16 m x 6 m: colour, all of the provenance and whether a photo was passed over, what came of it.
fn rendered(
    corrections: Option<&[ColourCorrection]>,
    room: usize,
) -> (Vec<[u8; 4]>, Vec<[f32; 6]>, Rendered) {
    rendered_with(corrections, room, &[]).0
}

type Found = (Vec<[u8; 4]>, Vec<[f32; 6]>, Rendered);

/// The same with plots that are to come from one photo, and which they come from.
fn rendered_with(
    corrections: Option<&[ColourCorrection]>,
    room: usize,
    plots: &[&Polygon],
) -> (Found, Vec<Option<usize>>) {
    let (views, surface) = (views(), surface());
    let grid = Georeference::north_up([-3.995, 2.995], 0.01, Crs::LOCAL);
    let size = [1600, 600];
    let selector = PhotoSelector::new(&views, &surface, grid, SelectionOptions::default());
    let read = |k: usize| -> Result<DecodedPhoto, String> { Ok(photo(k)) };
    let mut cache = PhotoCache::new(&views, &read, room);
    let (assignment, photos) = selector.whole_plots(size, plots);
    let mosaic = Mosaic {
        selector: &selector,
        grid,
        size,
        interpolation: Interpolation::Bilinear,
        corrections,
        assignment: Some(&assignment),
        with_provenance: true,
    };
    let mut colours = vec![[1u8; 4]; size[0] * size[1]];
    let mut records = vec![[f32::NAN; 6]; size[0] * size[1]];
    let found = render(&mosaic, &mut cache, |tile| {
        let Window { u, v, width, height } = tile.window;
        let full = provenance::full(&selector, tile.window, &tile.provenance);
        for n in 0..width * height {
            let at = (v + n / width) * size[0] + u + n % width;
            assert!(records[at][0].is_nan(), "cell {at} came twice");
            colours[at].copy_from_slice(&tile.rgba[4 * n..4 * n + 4]);
            records[at][..5].copy_from_slice(&full[5 * n..5 * n + 5]);
            records[at][5] = f32::from(tile.provenance[2 * n + 1]);
        }
        Ok(())
    });
    let photos = photos.iter().map(|photo| photo.map(|photo| photo.view)).collect();
    ((colours, records, found.unwrap()), photos)
}

#[test]
fn tiles_cover_every_cell_once() {
    for size in [[1, 1], [512, 512], [1600, 600], [3000, 2100]] {
        let tiles = tiles(size);
        assert_eq!(tiles.iter().map(Window::pixels).sum::<usize>(), size[0] * size[1]);
        let mut corners: Vec<[usize; 2]> = tiles.iter().map(|tile| [tile.u, tile.v]).collect();
        corners.sort_unstable();
        corners.dedup();
        assert_eq!(corners.len(), tiles.len());
        assert!(tiles.iter().all(|tile| tile.u % TILE == 0 && tile.v % TILE == 0));
        assert!(tiles.iter().all(|tile| tile.width <= TILE && tile.height <= TILE));
    }
}

#[test]
fn a_cell_without_data_comes_from_the_next_best_photo() {
    let (colours, records, found) = rendered(None, usize::MAX);
    // Along the middle row: the nearest camera, but left of 4 m the second photo has no data.
    for (x, photo) in [(-3.0_f64, 0), (1.9, 0), (3.0, 0), (4.2, 1), (5.9, 1), (6.1, 2), (11.0, 2)] {
        let at = 300 * 1600 + ((x + 4.0) * 100.0).round() as usize;
        let [r, g, b] = COLOURS[photo];
        assert_eq!(colours[at], [r, g, b, 255], "{x}");
        assert_eq!(records[at][0], photo as f32, "{x}");
        assert_eq!(records[at][5], if x == 3.0 { 1.0 } else { 0.0 }, "{x}: passed over");
        // The pixel in the photo, from similar triangles: 10 px per metre from the middle.
        let u = 39.5 + 10.0 * (x + 0.005 - 4.0 * photo as f64);
        assert!((f64::from(records[at][1]) - u).abs() < 0.06, "{x}: {u} {:?}", records[at]);
        let angle = ((x + 0.005 - 4.0 * photo as f64).abs() / 10.0).atan().to_degrees();
        assert!((f64::from(records[at][3]) - angle).abs() < 0.06, "{x}: {angle}");
    }
    assert_eq!(found.coloured, colours.iter().filter(|colour| colour[3] > 0).count());
    assert_eq!(found.cells_of.iter().sum::<usize>(), found.coloured);
    let preview = &found.preview;
    assert_eq!((preview.step, preview.size), (1, [1600, 600]));
    assert!(preview.rgba == colours && preview.source[300 * 1600] == 1);
}

/// A rectangle in metres on the ground as a polygon in cells.
fn rectangle([left, right]: [f64; 2], [bottom, top]: [f64; 2]) -> Polygon {
    let corners = [[left, top], [right, top], [right, bottom], [left, bottom]];
    Polygon { rings: vec![corners.map(|[x, y]| [(x + 4.0) * 100.0, (3.0 - y) * 100.0]).to_vec()] }
}

#[test]
fn a_plot_comes_from_the_photo_that_shows_all_of_it() {
    let across = rectangle([4.5, 7.0], [0.5, 1.5]);
    let without_data = rectangle([1.5, 3.5], [0.5, 1.5]);
    let too_wide = rectangle([-1.0, 7.5], [-1.5, -0.5]);
    let beside = rectangle([6.5, 7.7], [1.0, 2.0]);
    let plots = [&across, &without_data, &too_wide, &beside];
    let ((colours, records, found), photos) = rendered_with(None, usize::MAX, &plots);
    // The last one overlaps the first, which begins farther left and keeps its cells.
    assert_eq!(photos, [Some(1), Some(1), None, Some(2)]);
    let (by_rule, rule_records, _) = rendered(None, usize::MAX);
    let at = |[x, y]: [f64; 2]| {
        ((3.0 - y) * 100.0).round() as usize * 1600 + ((x + 4.0) * 100.0).round() as usize
    };
    for (place, photo, passed_over) in [
        ([5.0, 1.0], 1, false),
        ([6.9, 1.0], 1, false),
        ([6.9, 1.2], 1, false),
        ([7.2, 1.2], 2, false),
        ([7.2, 0.7], 2, false),
        // Its photo has no data there: the best of the others.
        ([3.0, 1.0], 0, true),
        ([1.6, 1.0], 0, true),
        ([5.9, -1.0], 1, false),
        ([6.1, -1.0], 2, false),
    ] {
        let [r, g, b] = COLOURS[photo];
        assert_eq!(colours[at(place)], [r, g, b, 255], "{place:?}");
        assert_eq!(records[at(place)][0], photo as f32, "{place:?}");
        assert_eq!(records[at(place)][5] > 0.0, passed_over, "{place:?}");
    }
    // Elsewhere nothing changes, and a cell of an assigned photo shows its place on the ground as ever.
    let mut assigned = vec![false; colours.len()];
    for plot in [&across, &without_data, &beside] {
        for (row, run) in plot.runs(1600, 600) {
            assigned[row * 1600..][run].fill(true);
        }
    }
    for n in (0..colours.len()).filter(|&n| !assigned[n]) {
        assert!(colours[n] == by_rule[n], "{n}");
        assert!(records[n][5] == rule_records[n][5], "{n}");
    }
    let record = records[at([6.9, 1.0])];
    assert!((f64::from(record[1]) - (39.5 + 10.0 * (6.905 - 4.0))).abs() < 0.06, "{record:?}");
    assert_eq!(found.coloured, colours.iter().filter(|colour| colour[3] > 0).count());
    let (again, _) = rendered_with(None, 0, &plots);
    assert!(again.0 == colours && again.2 == found);
}

#[test]
fn the_room_for_photos_changes_nothing() {
    let (roomy, without) = (rendered(None, usize::MAX), rendered(None, 0));
    assert!(roomy.0 == without.0 && roomy.1 == without.1 && roomy.2 == without.2);
}

#[test]
fn corrections_change_the_colours_of_photos() {
    let by = |gain: [f32; 3]| ColourCorrection {
        gain,
        middle_px: [39.5, 29.5],
        radius_px: 50.0,
        log_shape: [0.0; 7],
    };
    let corrections = [by([0.5; 3]), by([1.0; 3]), by([2.0, 1.0, 1.0])];
    let (colours, _, _) = rendered(Some(&corrections), usize::MAX);
    // By the equations of IEC 61966-2-1 half the light of 200 is 146.3.
    assert_eq!(colours[300 * 1600 + 100][0], 146);
    // At 5 m: the left half of the second photo has no data.
    assert_eq!(colours[300 * 1600 + 900], [10, 200, 10, 255]);
    assert_eq!(colours[300 * 1600 + 1500][1..], [10, 200, 255]);
}

#[test]
fn errors_of_reading_and_of_taking_end_the_work() {
    let (views, surface) = (views(), surface());
    let grid = Georeference::north_up([-3.995, 2.995], 0.01, Crs::LOCAL);
    let selector = PhotoSelector::new(&views, &surface, grid, SelectionOptions::default());
    let mosaic = Mosaic {
        selector: &selector,
        grid,
        size: [1600, 600],
        interpolation: Interpolation::Bilinear,
        corrections: None,
        assignment: None,
        with_provenance: false,
    };
    let damaged = |_: usize| -> Result<DecodedPhoto, String> { Err("damaged".to_owned()) };
    let mut cache = PhotoCache::new(&views, &damaged, 0);
    assert_eq!(render(&mosaic, &mut cache, |_| Ok(())).unwrap_err(), "damaged");
    let read = |k: usize| -> Result<DecodedPhoto, String> { Ok(photo(k)) };
    let mut cache = PhotoCache::new(&views, &read, 0);
    let full = |_: Tile| Err("the disk is full".to_owned());
    assert_eq!(render(&mosaic, &mut cache, full).unwrap_err(), "the disk is full");
}
