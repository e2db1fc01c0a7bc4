//! `rowgram ortho`, `query` and `dem` on small worlds whose photos are drawn by a formula of their own.

mod colour;
mod dem;
mod wide_lenses;

use crate::program::rowgram;
use rowgram::{
    io::geotiff::{Colour, Layout, Reader, write},
    monitor::Collector,
    pipeline::query::OrthophotoOrigins,
    raster::{
        georeference::{Crs, Georeference},
        window::Window,
    },
};
use std::{fs, path::Path};

const F_PX: f64 = 100.0;
const SIZE: [u32; 2] = [120, 90];
const HEIGHT_M: f64 = 20.0;
const EAST_M: f64 = 500_000.0;
const NORTH_M: f64 = 4_475_000.0;

fn colour(x: f64, y: f64) -> [f64; 3] {
    [
        128.0 + 100.0 * (0.5 * x).sin(),
        128.0 + 100.0 * (0.4 * y).cos(),
        128.0 + 60.0 * (0.3 * (x + y)).sin(),
    ]
}

/// A grey value of sRGB whose linear light is multiplied.
fn exposed(value: f64, factor: f64) -> f64 {
    let coded = value / 255.0;
    let light = if coded <= 0.04045 { coded / 12.92 } else { ((coded + 0.055) / 1.055).powf(2.4) };
    let light = light * factor;
    255.0 * if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

/// Ground `z = slope x`; three cameras straight down, 10 m apart, their x axis to the east, with exposures that light is multiplied by.
struct World {
    slope: f64,
    exposure: [f64; 3],
}

const LEVEL: World = World { slope: 0.0, exposure: [1.0; 3] };

impl World {
    fn camera_x(k: usize) -> f64 {
        10.0 * k as f64
    }

    /// The pixel of a place, from similar triangles.
    fn pixel(&self, k: usize, x: f64, y: f64) -> [f64; 2] {
        let depth = HEIGHT_M - self.slope * x;
        [59.5 + F_PX * (x - Self::camera_x(k)) / depth, 44.5 - F_PX * y / depth]
    }

    fn build(&self, folder: &Path) {
        fs::create_dir(folder.join("images")).unwrap();
        let mut poses = "filename,x,y,z,omega,phi,kappa\n".to_owned();
        for k in 0..3 {
            let photo = image::RgbImage::from_fn(SIZE[0], SIZE[1], |u, v| {
                // The ray meets z = slope x where (u - 59.5)/f (h - slope x) = x - camera_x.
                let a = (f64::from(u) - 59.5) / F_PX;
                let x = (Self::camera_x(k) + a * HEIGHT_M) / (1.0 + a * self.slope);
                let y = (44.5 - f64::from(v)) / F_PX * (HEIGHT_M - self.slope * x);
                let bytes =
                    colour(x, y).map(|c| exposed(c, self.exposure[k]).round().clamp(0.0, 255.0));
                image::Rgb(bytes.map(|c| c as u8))
            });
            photo.save(folder.join(format!("images/p{k}.png"))).unwrap();
            let x = EAST_M + Self::camera_x(k);
            poses += &format!("p{k}.png,{x},{NORTH_M},{HEIGHT_M},0,0,0\n");
        }
        fs::write(folder.join("poses.csv"), poses).unwrap();
        let camera = format!(
            "lens:\n  type: pinhole\n  im_size: [{}, {}]\n  focal_len: {}\n",
            SIZE[0],
            SIZE[1],
            F_PX / 120.0
        );
        fs::write(folder.join("camera.yaml"), camera).unwrap();
        self.dem(&folder.join("dem.tif"), [-20.0, 15.0], [61, 31], Crs::projected(32616));
    }

    fn dem(&self, path: &Path, corner: [f64; 2], [width, height]: [usize; 2], crs: Crs) {
        let place = Georeference::north_up([EAST_M + corner[0], NORTH_M + corner[1]], 1.0, crs);
        let layout = Layout {
            width,
            height,
            colour: Colour::Values,
            georeference: Some(place),
            nodata: Some(-9999.0),
        };
        let z: Vec<f32> = (0..width * height)
            .map(|k| (self.slope * (corner[0] + (k % width) as f64)) as f32)
            .collect();
        write::<f32, rowgram::Error>(path, true, &layout, |writer| {
            Ok(writer.put(Window::whole(width, height), &z)?)
        })
        .unwrap();
    }
}

const GIVEN: &str = "ortho --poses poses.csv --camera camera.yaml --photos images --dem dem.tif --gsd-m 0.2 --canopy-height-m 0 -q";

struct Mosaic {
    place: Georeference,
    size: [usize; 2],
    rgba: Vec<u8>,
    records: Vec<f32>,
    /// 1 where a better photo has no data or does not see the place.
    passed_over: Vec<u16>,
}

impl Mosaic {
    fn read(path: &Path) -> Mosaic {
        let reader = Reader::open(path).unwrap();
        let size = [reader.width(), reader.height()];
        let all = Window::whole(size[0], size[1]);
        let stem = path.file_stem().unwrap().to_str().unwrap();
        let full = path.with_file_name(format!("{stem}_full.tif"));
        let origins = OrthophotoOrigins::open(path, None).unwrap();
        origins.write_full(&full, true, &mut Collector::default()).unwrap();
        let records = Reader::open(&full).unwrap();
        let stored = Reader::open(&path.with_file_name(format!("{stem}_provenance.tif"))).unwrap();
        let passed_over =
            stored.read::<u16>(all).unwrap().chunks_exact(2).map(|cell| cell[1]).collect();
        Mosaic {
            place: reader.georeference().unwrap(),
            size,
            rgba: reader.read::<u8>(all).unwrap(),
            records: records.read::<f32>(all).unwrap(),
            passed_over,
        }
    }

    /// Place relative to the first camera, colour with alpha, record.
    fn cells(&self) -> impl Iterator<Item = ([f64; 2], &[u8], &[f32])> {
        let records = self.records.chunks_exact(5);
        self.rgba.chunks_exact(4).zip(records).enumerate().map(|(k, (rgba, record))| {
            let at = [(k % self.size[0]) as f64, (k / self.size[0]) as f64];
            let [x, y] = self.place.map(at);
            ([x - EAST_M, y - NORTH_M], rgba, record)
        })
    }
}

fn run(folder: &Path, arguments: &str) -> String {
    let run = rowgram(folder, arguments);
    assert_eq!(run.code, 0, "{arguments}: {}", run.stderr);
    run.stdout
}

#[test]
fn every_cell_comes_from_the_closest_camera_that_shows_it() {
    let folder = tempfile::tempdir().unwrap();
    for (name, world) in [("level", LEVEL), ("slope", World { slope: 0.1, ..LEVEL })] {
        let folder = folder.path().join(name);
        fs::create_dir(&folder).unwrap();
        world.build(&folder);
        // Colours as the photos have them.
        run(&folder, &format!("{GIVEN} -o ortho.tif --figures pictures --balance=false"));
        let mosaic = Mosaic::read(&folder.join("ortho.tif"));
        let mut seen = 0;
        for ([x, y], rgba, record) in mosaic.cells() {
            let z = world.slope * x;
            let shown = |k: usize| {
                let [u, v] = world.pixel(k, x, y);
                u >= -0.5 && v >= -0.5 && u < 119.5 && v < 89.5
            };
            let squared =
                |k: usize| (x - World::camera_x(k)).powi(2) + y * y + (HEIGHT_M - z).powi(2);
            let best =
                (0..3).filter(|&k| shown(k)).min_by(|&a, &b| squared(a).total_cmp(&squared(b)));
            // Rounding decides on the very border of a photo or of two.
            let near_border = (0..3).any(|k| {
                let [u, v] = world.pixel(k, x, y);
                [u + 0.5, v + 0.5, u - 119.5, v - 89.5].iter().any(|d| d.abs() < 1e-6)
            }) || (0..2).any(|k| (squared(k) - squared(k + 1)).abs() < 1e-6);
            if near_border {
                continue;
            }
            assert_eq!(rgba[3], if best.is_some() { 255 } else { 0 }, "{x} {y}");
            let Some(k) = best else {
                assert_eq!(record[0], -1.0);
                continue;
            };
            seen += 1;
            assert_eq!(record[0], k as f32, "{x} {y}");
            let [u, v] = world.pixel(k, x, y);
            // 32-bit positions up to 120 px.
            assert!((f64::from(record[1]) - u).abs() < 1e-4, "{x} {y}: {u} {record:?}");
            assert!((f64::from(record[2]) - v).abs() < 1e-4, "{x} {y}: {v} {record:?}");
            let plan = (x - World::camera_x(k)).hypot(y);
            let angle = (plan / (HEIGHT_M - z)).atan().to_degrees();
            assert!((f64::from(record[3]) - angle).abs() < 1e-3, "{x} {y}");
            let seam = (0..3)
                .filter(|&j| j != k && shown(j))
                .map(|j| (x - 0.5 * (World::camera_x(k) + World::camera_x(j))).abs())
                .fold(f64::INFINITY, f64::min);
            let seam = if seam.is_finite() { seam } else { -1.0 };
            assert!((f64::from(record[4]) - seam).abs() < 1e-3, "{x} {y}: {seam} {record:?}");
            // Bytes are rounded twice, and between pixels the colours bend by less than a grey value.
            // Half a pixel outside the centres the border is repeated.
            let inner = u >= 0.0 && v >= 0.0 && u <= 119.0 && v <= 89.0;
            for (c, expected) in colour(x, y).into_iter().enumerate() {
                let off = (f64::from(rgba[c]) - expected).abs();
                assert!(off <= if inner { 1.6 } else { 8.0 }, "{x} {y} {c}: {off}");
            }
        }
        // 44 m x 18 m in cells of 0.2 m, less on the slope.
        assert!(seen > 15_000, "{seen}");
        for picture in ["mosaic.png", "sources.png", "coverage.png", "coverage.csv", "sources.csv"]
        {
            assert!(folder.join("pictures").join(picture).is_file(), "{picture}");
        }
    }
}

#[test]
fn results_do_not_depend_on_threads_or_room() {
    let folder = tempfile::tempdir().unwrap();
    World { slope: 0.05, exposure: [1.0, 0.9, 1.05] }.build(folder.path());
    for options in ["", "--balance=false", "--visibility-m 0.05 --interpolation bicubic"] {
        run(folder.path(), &format!("{GIVEN} {options} -o a.tif --force"));
        run(
            folder.path(),
            &format!("{GIVEN} {options} -o b.tif --force --threads 1 --memory-mb 0"),
        );
        for name in [".tif", "_provenance.tif"] {
            let read =
                |which: &str| fs::read(folder.path().join(format!("{which}{name}"))).unwrap();
            assert!(read("a") == read("b"), "{options} {name}");
        }
    }
}

#[test]
fn a_mosaic_knows_the_photo_pixel_behind_each_place_and_back() {
    let folder = tempfile::tempdir().unwrap();
    let world = World { slope: 0.1, ..LEVEL };
    world.build(folder.path());
    run(folder.path(), &format!("{GIVEN} -o ortho.tif"));
    let (x, y) = (7.31, -3.27);
    let text = run(
        folder.path(),
        &format!("ortho query ortho.tif --at {},{} --json", EAST_M + x, NORTH_M + y),
    );
    let found: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(found["image"], "p1.png");
    let pixel = [found["u_px"].as_f64().unwrap(), found["v_px"].as_f64().unwrap()];
    let expected = world.pixel(1, x, y);
    for k in 0..2 {
        approx::assert_abs_diff_eq!(pixel[k], expected[k], epsilon = 1e-5);
    }
    let arguments =
        format!("ortho query ortho.tif --photo p1.png --pixel {},{} --json", pixel[0], pixel[1]);
    let back: serde_json::Value = serde_json::from_str(&run(folder.path(), &arguments)).unwrap();
    approx::assert_abs_diff_eq!(back["x_m"].as_f64().unwrap(), EAST_M + x, epsilon = 1e-5);
    approx::assert_abs_diff_eq!(back["y_m"].as_f64().unwrap(), NORTH_M + y, epsilon = 1e-5);
    assert_eq!(back["is_source"], true);
    let outside = rowgram(folder.path(), "ortho query ortho.tif --at 0,0");
    assert_eq!(outside.code, 2, "{}", outside.stderr);
    assert!(outside.stderr.contains("does not show"), "{}", outside.stderr);
}

#[test]
fn balance_takes_the_step_out_of_a_seam() {
    let folder = tempfile::tempdir().unwrap();
    World { slope: 0.0, exposure: [1.0, 0.6, 1.0] }.build(folder.path());
    // Ratios of the mosaic to the true colour left and right of the seam at x = 5 m.
    let step = |name: &str| {
        let mosaic = Mosaic::read(&folder.path().join(name));
        let side = |range: std::ops::Range<f64>| {
            let ratios: Vec<f64> = mosaic
                .cells()
                .filter(|([x, y], rgba, _)| range.contains(x) && y.abs() < 5.0 && rgba[3] == 255)
                .map(|([x, y], rgba, _)| f64::from(rgba[1]) / colour(x, y)[1])
                .collect();
            ratios.iter().sum::<f64>() / ratios.len() as f64
        };
        (side(4.4..5.0) - side(5.0..5.6)).abs()
    };
    run(folder.path(), &format!("{GIVEN} -o plain.tif --balance=false"));
    run(folder.path(), &format!("{GIVEN} -o balanced.tif"));
    let (plain, balanced) = (step("plain.tif"), step("balanced.tif"));
    // 0.6^(1/2.4) = 0.81.
    assert!((plain - 0.2).abs() < 0.03, "{plain}");
    assert!(balanced < 0.01, "{balanced}");
}

#[test]
fn a_plot_can_come_from_one_photo() {
    let folder = tempfile::tempdir().unwrap();
    LEVEL.build(folder.path());
    // Across the seam at x = 5 m, and wider than a photo.
    let plot = |name: &str, [left, right]: [f64; 2], [bottom, top]: [f64; 2]| {
        let [west, east] = [left, right].map(|x| EAST_M + x);
        let [south, north] = [bottom, top].map(|y| NORTH_M + y);
        serde_json::json!({
            "type": "Feature",
            "properties": {"name": name},
            "geometry": {"type": "Polygon", "coordinates":
                [[[west, south], [east, south], [east, north], [west, north], [west, south]]]}
        })
    };
    let plots = vec![plot("A1", [4.0, 9.0], [-3.0, 3.0]), plot("A2", [-5.0, 20.0], [4.0, 6.0])];
    let plots = crate::maps::collection(Some(32616), plots);
    fs::write(folder.path().join("plots.geojson"), plots).unwrap();
    let arguments = format!("{GIVEN} --whole-plots plots.geojson -o ortho.tif").replace(" -q", "");
    let run = rowgram(folder.path(), &arguments);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stderr.contains("no photo shows the whole of 1 of 2 plots (A2)"), "{}", run.stderr);
    let table = fs::read_to_string(folder.path().join("ortho_plots.csv")).unwrap();
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!(lines.len(), 3, "{table}");
    assert_eq!(lines[0], "plot,photo,view_angle_deg");
    assert!(lines[1].starts_with("A1,p1.png,") && lines[2] == "A2,,", "{table}");
    // 3.5 m beside the camera, 20 m below it; outlines are followed from cell to cell, half a cell off at the most.
    let angle: f64 = lines[1].split(',').next_back().unwrap().parse().unwrap();
    approx::assert_abs_diff_eq!(angle, (3.5_f64 / 20.0).atan().to_degrees(), epsilon = 0.4);
    let mosaic = Mosaic::read(&folder.path().join("ortho.tif"));
    let mut seen = [0; 2];
    for ([x, y], _, provenance) in mosaic.cells() {
        let is_in_plot = (4.1..8.9).contains(&x) && y.abs() < 2.9;
        if is_in_plot {
            assert_eq!(provenance[0], 1.0, "({x}, {y})");
            seen[0] += 1;
        } else if (4.0..4.9).contains(&x) && y.abs() > 3.1 && y.abs() < 6.0 {
            assert_eq!(provenance[0], 0.0, "({x}, {y})");
            seen[1] += 1;
        }
    }
    assert!(seen.iter().all(|&n| n > 50), "{seen:?}");
}

#[test]
fn frames_have_a_map_each() {
    let folder = tempfile::tempdir().unwrap();
    LEVEL.build(folder.path());
    let text = run(folder.path(), &format!("{GIVEN} --frames -o ortho.tif --json"));
    let report: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(report["frames"].as_array().unwrap().len(), 3);
    assert_eq!(report["frames"][2]["file"], "frames/p2_ortho.tif");
    assert_eq!(report["file"], "ortho.tif");
    let one = Mosaic::read(&folder.path().join("frames/p2_ortho.tif"));
    let coloured = one.cells().filter(|(_, rgba, _)| rgba[3] == 255).count();
    // 120 x 90 pixels of 0.2 m each.
    assert!((10_600..=11_000).contains(&coloured), "{coloured}");
}

#[test]
fn photos_of_one_name_in_two_folders_are_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    LEVEL.build(at);
    let mut poses = fs::read_to_string(at.join("poses.csv")).unwrap();
    for (k, name) in [(0, "100MEDIA/p.png"), (1, "101MEDIA/p.png")] {
        fs::create_dir(at.join("images").join(&name[..8])).unwrap();
        fs::rename(at.join(format!("images/p{k}.png")), at.join("images").join(name)).unwrap();
        poses = poses.replace(&format!("p{k}.png"), name);
    }
    fs::write(at.join("poses.csv"), poses).unwrap();
    let text = run(at, &format!("{GIVEN} --frames -o ortho.tif --json"));
    let report: serde_json::Value = serde_json::from_str(&text).unwrap();
    let frames = report["frames"].as_array().unwrap();
    let names: Vec<&str> = frames.iter().map(|frame| frame["file"].as_str().unwrap()).collect();
    let expected = ["100MEDIA_p.png_ortho.tif", "101MEDIA_p.png_ortho.tif", "p2_ortho.tif"];
    assert_eq!(names, expected.map(|name| format!("frames/{name}")));
    let query = "ortho query ortho.tif --pixel 59,44 --photo";
    let ambiguous = rowgram(at, &format!("{query} p"));
    assert_eq!(ambiguous.code, 2);
    assert!(ambiguous.stderr.contains("100MEDIA/p.png, 101MEDIA/p.png"), "{}", ambiguous.stderr);
    assert_eq!(rowgram(at, &format!("{query} 101MEDIA/p.png")).code, 0);
    // One of them alone, by its name without the ending.
    let text = run(at, &format!("{GIVEN} --only p2 -o one.tif --json"));
    let report: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(report["photos"], 1);
}

#[test]
fn what_is_wrong_with_the_input_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    LEVEL.build(at);
    let degrees = Crs::geographic(4326);
    LEVEL.dem(&at.join("degrees.tif"), [0.0, 0.0], [5, 5], degrees);
    LEVEL.dem(&at.join("far.tif"), [9000.0, 0.0], [5, 5], Crs::projected(32616));
    LEVEL.dem(&at.join("zone.tif"), [-20.0, 15.0], [61, 31], Crs::projected(32617));
    LEVEL.dem(&at.join("half.tif"), [-20.0, 15.0], [25, 31], Crs::projected(32616));
    let given = GIVEN.replace("--dem dem.tif", "");
    let refused = |arguments: &str, words: &str| {
        let run = rowgram(at, &format!("{arguments} -o refused.tif"));
        assert_eq!(run.code, 2, "{arguments}: {}", run.stderr);
        assert!(run.stderr.contains(words), "{arguments}: {}", run.stderr);
        assert!(!at.join("refused.tif").exists());
    };
    refused(&format!("{given} --dem degrees.tif"), "degrees");
    refused(&format!("{given} --dem far.tif"), "no photo shows any of the surface");
    refused(&format!("{given} --dem zone.tif --crs EPSG:32616"), "EPSG:32617");
    refused(&format!("{given} --dem images/p0.png"), "p0.png");
    refused(&given, "--dem names the surface");
    refused(&format!("{GIVEN} --only p7.png"), "there is no photo \"p7.png\"");
    refused(&format!("{GIVEN} --max-angle-deg 95"), "from 0.1 to 89.9");
    refused(&GIVEN.replace("--photos images", "--photos ."), "there is no photo \"p0.png\"");
    refused("ortho --poses poses.csv --camera camera.yaml --dem dem.tif", "--photos");
    refused(&format!("{GIVEN} --whole-plots p.geojson"), "p.geojson");
    refused("ortho nothing", "expected a folder with photos or an orthomosaic");
    fs::write(at.join("short.csv"), "filename,x,y,z,omega,phi\np0.png,1,2,3,4,5\n").unwrap();
    refused(&GIVEN.replace("poses.csv", "short.csv"), "kappa");
    // A surface that ends within the photos: what it does not cover has no colour.
    let cut = rowgram(at, &format!("{given} --dem half.tif -o half_ortho.tif").replace(" -q", ""));
    assert_eq!(cut.code, 0, "{}", cut.stderr);
    assert!(
        cut.stderr
            .contains("edges of 2 of 3 photos extend beyond the surface and stay transparent"),
        "{}",
        cut.stderr
    );
    let half = Mosaic::read(&at.join("half_ortho.tif"));
    assert!(half.cells().all(|([x, _], rgba, _)| rgba[3] == 0 || x <= 4.0 + 1e-9));
    let again = rowgram(at, &format!("{given} --dem half.tif -o half_ortho.tif"));
    assert!(again.code == 2 && again.stderr.contains("--force"), "{}", again.stderr);
    image::RgbImage::new(60, 90).save(at.join("images/p1.png")).unwrap();
    refused(GIVEN, "60 x 90 pixels, its camera 120 x 90");
}

#[test]
fn pixels_without_data_come_from_the_next_photo_or_from_none() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    LEVEL.build(at);
    let path = at.join("images/p1.png");
    let mut photo = image::open(&path).unwrap().into_rgba8();
    // The left half of the middle photo is transparent, whatever its colours say.
    for (u, _, pixel) in photo.enumerate_pixels_mut() {
        if u < 60 {
            *pixel = image::Rgba([255, 0, 0, 0]);
        }
    }
    photo.save(&path).unwrap();
    for options in ["", "--interpolation bicubic"] {
        run(at, &format!("{GIVEN} {options} -o ortho.tif --force"));
        let mosaic = Mosaic::read(&at.join("ortho.tif"));
        let (mut of_next, mut of_none) = (0, 0);
        for ([x, y], rgba, record) in mosaic.cells() {
            if rgba[3] == 0 {
                assert_eq!(record[0], -1.0, "{x} {y}: a source without a colour");
                of_none += usize::from(y.abs() < 8.0 && (6.0..9.0).contains(&x));
                continue;
            }
            if record[0] == 1.0 {
                assert!(record[1] >= 60.0, "{x} {y}: {record:?}");
            }
            // Closest is the second photo, but there it has no data.
            of_next += usize::from((5.2..9.0).contains(&x) && record[0] == 0.0);
            for (c, expected) in colour(x, y).into_iter().enumerate() {
                assert!((f64::from(rgba[c]) - expected).abs() < 9.0, "{x} {y}: {rgba:?}");
            }
        }
        assert!(of_next > 500 && of_none == 0, "{of_next} {of_none}");
        let marked = mosaic.cells().zip(&mosaic.passed_over).filter(|((_, rgba, record), mark)| {
            assert!(**mark == 0 || (rgba[3] == 255 && record[0] != 1.0));
            **mark == 1
        });
        assert!(marked.count() >= of_next);
    }
}

#[test]
fn heights_keep_the_code_of_their_datum() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    LEVEL.build(at);
    let of = |name: &str| Reader::open(&at.join(name)).unwrap().georeference().unwrap().crs;
    run(at, &format!("{GIVEN} --vertical-crs 5773 -o given.tif"));
    assert_eq!((of("given.tif").epsg, of("given.tif").vertical_epsg), (Some(32616), Some(5773)));
    let known = Crs { vertical_epsg: Some(5703), ..Crs::projected(32616) };
    LEVEL.dem(&at.join("dem.tif"), [-20.0, 15.0], [61, 31], known);
    run(at, &format!("{GIVEN} -o from_dem.tif"));
    assert_eq!(of("from_dem.tif"), known);
    let other = rowgram(at, &format!("{GIVEN} --vertical-crs 5773 -o other.tif"));
    assert!(other.code == 2 && other.stderr.contains("EPSG:5703"), "{}", other.stderr);
}

#[cfg(unix)]
#[test]
fn a_full_disk_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    LEVEL.build(at);
    let before = fs::read_dir(at).unwrap().count();
    // Files end at 16 KiB and writing beyond is an error, as on a disk without room.
    let script = format!(
        "trap '' XFSZ; ulimit -f 32; exec {} {GIVEN} -o ortho.tif",
        env!("CARGO_BIN_EXE_rowgram")
    );
    let done =
        std::process::Command::new("sh").args(["-c", &script]).current_dir(at).output().unwrap();
    let stderr = String::from_utf8_lossy(&done.stderr);
    assert_eq!(done.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("cannot write") && stderr.contains("ortho"), "{stderr}");
    assert_eq!(fs::read_dir(at).unwrap().count(), before, "something half-written is left");
}
