//! Every reader on files that are damaged: an error with the file's name, or a result, and never a panic.
//!
//! The corpus is what the program writes itself and the golden rasters; each file is changed by a seeded
//! generator, a few bytes at a time: flipped, cut out, doubled, cut off, numbers made huge.

use crate::program::rowgram;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::io::{
    bal, camera, colmap, control, gcp_list, geotiff, images, photo, points, polygons, poses,
};
use std::{
    fs,
    path::{Path, PathBuf},
};

/// Damages per file; enough to reach every branch that a byte decides in files of this size.
const DAMAGES: usize = 150;

fn damaged(bytes: &[u8], rng: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for _ in 0..rng.random_range(1..4) {
        if bytes.is_empty() {
            break;
        }
        let at = rng.random_range(0..bytes.len());
        match rng.random_range(0..6) {
            0 => bytes[at] ^= 1 << rng.random_range(0..8),
            1 => bytes[at] = rng.random_range(0..=255),
            2 => {
                let end = (at + rng.random_range(1..40)).min(bytes.len());
                bytes.drain(at..end);
            }
            3 => bytes.truncate(at),
            4 => {
                let end = (at + rng.random_range(1..40)).min(bytes.len());
                let copy = bytes[at..end].to_vec();
                bytes.splice(at..at, copy);
            }
            _ => {
                let words: [&[u8]; 6] =
                    [b"99999999999", b"-1", b"NaN", b"1e308", b"\xff\xff\xff\xff", b","];
                let word = words[rng.random_range(0..words.len())];
                let end = (at + word.len()).min(bytes.len());
                bytes.splice(at..end, word.iter().copied());
            }
        }
    }
    bytes
}

/// Reads a damaged file; an error must name it.
fn read(kind: &str, path: &Path) {
    let defaults = control::Defaults::default();
    let message = match kind {
        "bal" => bal::read(path).err().map(|e| e.to_string()),
        "camera" => camera::read(path).err().map(|e| e.to_string()),
        "colmap" => colmap::read(path.parent().unwrap()).err().map(|e| e.to_string()),
        "ground" => control::ground_points(path, &defaults).err().map(|e| e.to_string()),
        "gcp_list" => gcp_list::read(path, &defaults, None).err().map(|e| e.to_string()),
        "geolocation" => {
            rowgram::io::camera_positions::read(path, None).err().map(|e| e.to_string())
        }
        "geotiff" => geotiff::Reader::open(path)
            .and_then(|reader| {
                let height = reader.height().min(64);
                let width = reader.width();
                let window = rowgram::raster::window::Window::rows(width, 0..height);
                // A raster that says it is huge is not read for the sake of a test.
                if width <= 4096 { reader.read_f32(window).map(drop) } else { Ok(()) }
            })
            .err()
            .map(|e| e.to_string()),
        "picture" => images::read(path).err().map(|e| e.to_string()),
        "points" => points::read(path).err().map(|e| e.to_string()),
        "polygons" => polygons::read(path, None).err().map(|e| e.to_string()),
        "poses" => poses::read(path).err().map(|e| e.to_string()),
        "exif" => {
            photo::parse(&fs::read(path).unwrap());
            None
        }
        other => panic!("no reader {other}"),
    };
    if let Some(message) = message {
        let folder = path.parent().unwrap().to_string_lossy();
        assert!(message.contains(&*folder), "{kind}: {message}");
    }
}

fn torture(kind: &str, file: &Path, folder: &Path) {
    let bytes = fs::read(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    let name = file.file_name().unwrap();
    let place = folder.join(kind);
    fs::create_dir_all(&place).unwrap();
    if kind == "colmap" {
        for entry in fs::read_dir(file.parent().unwrap()).unwrap() {
            let path = entry.unwrap().path();
            fs::copy(&path, place.join(path.file_name().unwrap())).unwrap();
        }
    }
    let path = place.join(name);
    fs::write(&path, &bytes).unwrap();
    read(kind, &path);
    let mut rng = ChaCha8Rng::seed_from_u64(bytes.len() as u64);
    for _ in 0..DAMAGES {
        fs::write(&path, damaged(&bytes, &mut rng)).unwrap();
        read(kind, &path);
    }
    fs::write(&path, &bytes).unwrap();
}

#[test]
fn damaged_files_are_no_reason_to_fall() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let grown =
        rowgram(root, "synth flight --preset small --no-photos --tie-points 10 -o field -q");
    assert_eq!(grown.code, 0, "{}", grown.stderr);
    let bundled = rowgram(root, "synth bundle --images 4 --points 40 -o block.txt -q");
    assert_eq!(bundled.code, 0, "{}", bundled.stderr);
    let binary = rowgram(root, "convert field/model --to colmap-binary -o binary -q");
    fs::write(
        root.join("gcp_list.txt"),
        "EPSG:32616\n500670.1 4480143.2 182.1 10.5 20.5 IMG_1.JPG A\n500680.1 4480143.2 182.1 30 40 IMG_2.JPG CHK-B\n",
    )
    .unwrap();
    fs::write(
        root.join("plots.geojson"),
        r#"{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"name":"A","leaves":3},"geometry":{"type":"Polygon","coordinates":[[[0,0],[4,0],[4,4],[0,0]]]}}]}"#,
    )
    .unwrap();
    let in_field = |name: &str| root.join("field").join(name);
    let mut cases: Vec<(&str, PathBuf)> = vec![
        ("bal", root.join("block.txt")),
        ("camera", in_field("truth/camera.toml")),
        ("colmap", in_field("model/cameras.txt")),
        ("colmap", in_field("model/images.txt")),
        ("colmap", in_field("model/points3D.txt")),
        ("ground", in_field("gcps.csv")),
        ("geolocation", in_field("geolocation.csv")),
        ("gcp_list", root.join("gcp_list.txt")),
        ("polygons", root.join("plots.geojson")),
        ("points", in_field("truth/plants.csv")),
        ("poses", in_field("truth/exterior_orientation.csv")),
    ];
    assert_eq!(binary.code, 0, "{}", binary.stderr);
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        cases.push(("colmap", root.join("binary").join(name)));
    }
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/geotiff");
    for entry in fs::read_dir(golden).unwrap() {
        let path = entry.unwrap().path();
        cases.push(("geotiff", path.clone()));
        cases.push(("exif", path));
    }
    let picture =
        image::RgbImage::from_fn(16, 12, |u, v| image::Rgb([u as u8 * 9, v as u8 * 9, 7]));
    for name in ["picture.png", "picture.jpg"] {
        picture.save(root.join(name)).unwrap();
        cases.push(("picture", root.join(name)));
        cases.push(("exif", root.join(name)));
    }
    for (kind, file) in cases {
        torture(kind, &file, &root.join("tortured"));
        fs::remove_dir_all(root.join("tortured")).unwrap();
    }
}
