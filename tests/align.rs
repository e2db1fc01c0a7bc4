//! `rowgram align` as a program: what it refuses and how it says so. The geometry is tested on flights made
//! from numbers, in `sfm`.

use crate::program::rowgram;
use std::fs;

#[test]
fn a_folder_that_is_none_or_without_photos_is_bad_input() {
    let folder = tempfile::tempdir().unwrap();
    let run = rowgram(folder.path(), "align missing");
    assert_eq!(run.code, 2);
    let said = run.stderr;
    assert!(said.contains("expected a folder with photos"), "{said}");

    fs::create_dir(folder.path().join("images")).unwrap();
    let run = rowgram(folder.path(), "align .");
    assert_eq!(run.code, 2);
    let said = run.stderr;
    assert!(said.contains("0 photos") && said.contains("at least 3"), "{said}");
}

#[test]
fn options_that_cannot_be_are_refused_before_any_work() {
    for (options, part) in [
        ("--tolerance 0", "--tolerance-px 0: expected a number greater than 0"),
        ("--max-features 10", "--max-features 10: expected"),
        ("--lens wide", "--lens \"wide\": expected one of: auto, brown, smac"),
        ("--from adjust --until match", "--from: it comes after"),
    ] {
        let run = rowgram(std::env::temp_dir().as_path(), &format!("align nowhere {options}"));
        assert_eq!(run.code, 2, "{options}");
        assert!(run.stderr.contains(part), "{options}: {}", run.stderr);
    }
}

#[test]
fn dead_files_and_doubles_are_named_and_a_name_of_no_system_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    fs::create_dir(&images).unwrap();
    let save = |name: &str, shade: u8| {
        image::RgbImage::from_pixel(64, 48, image::Rgb([shade; 3]))
            .save(images.join(name))
            .unwrap();
    };
    save("a.png", 10);
    save("b.png", 200);
    save("e.png", 90);
    fs::copy(images.join("a.png"), images.join("a (1).png")).unwrap();
    fs::create_dir(images.join("@eaDir")).unwrap();
    fs::copy(images.join("e.png"), images.join("@eaDir/thumbnail.png")).unwrap();
    fs::write(images.join("d.jpg"), b"no picture").unwrap();
    let run = rowgram(folder.path(), "align . --until inspect");
    assert_eq!(run.code, 0);
    let said = run.stderr;
    assert!(said.contains("a (1).png: left out: it is the same file as a.png"), "{said}");
    assert!(!said.contains("thumbnail"), "{said}");
    assert!(said.contains("d.jpg: left out: it is no picture"), "{said}");

    let run = rowgram(folder.path(), "align . --crs EPSG:99999");
    assert_eq!(run.code, 2);
    let said = run.stderr;
    assert!(said.contains("EPSG:99999 is not a known"), "{said}");

    // Another process works on the project.
    let results = folder.path().join("rowgram");
    let lock = fs::File::create(results.join(".lock")).unwrap();
    lock.lock().unwrap();
    let run = rowgram(folder.path(), "align .");
    assert_eq!(run.code, 2);
    let said = run.stderr;
    assert!(said.contains("another rowgram process is working here"), "{said}");
    drop(lock);

    // Photos of nothing: nothing can be oriented, and that is said.
    let run = rowgram(folder.path(), "align .");
    assert_eq!(run.code, 3);
    let said = run.stderr;
    assert!(said.contains("shows next to nothing") && said.contains("could be oriented"), "{said}");
}

/// A project of three photos of nothing at some place, in decimal degrees, with control.
fn placed(root: &std::path::Path, photos: [f64; 2], control: [f64; 2], settings: &str) -> String {
    let images = root.join("images");
    fs::create_dir_all(&images).unwrap();
    let mut positions = "image,lat,lon,height_m\n".to_owned();
    for k in 0..3_u8 {
        let name = format!("{k}.png");
        let shade = image::Rgb([40 * k + 20; 3]);
        image::RgbImage::from_pixel(64, 48, shade).save(images.join(&name)).unwrap();
        let [lat, lon] = photos.map(|v| v + 1e-4 * f64::from(k));
        positions += &format!("{name},{lat},{lon},200\n");
    }
    fs::write(root.join("geolocation.csv"), positions).unwrap();
    let [east, north] = control;
    let row = |k: i32| format!("G{k},{},{},100\n", east + 5.0 * f64::from(k), north);
    let rows: String = (0..3).map(row).collect();
    fs::write(root.join("gcps.csv"), format!("label,easting_m,northing_m,height_m\n{rows}"))
        .unwrap();
    let marks: String = (0..3).map(|k| format!("{k}.png,G{k},20,20\n")).collect();
    fs::write(root.join("marks.csv"), format!("image,label,u_px,v_px\n{marks}")).unwrap();
    fs::write(root.join("rowgram.toml"), format!("[project]\n{settings}\n")).unwrap();
    let run = rowgram(root, "align . --until inspect");
    let doctor = rowgram(root, "doctor .");
    let said = run.stderr;
    if run.code == 0 {
        return "fine".to_owned();
    }
    assert_eq!(run.code, 2, "{said}");
    let line = said.lines().find(|line| line.contains("error:")).unwrap_or_default();
    let message = line.split_once("error: ").map_or("", |(_, message)| message);
    let told = format!("{}{}", doctor.stdout, doctor.stderr);
    assert!(told.contains(message), "doctor does not say {message:?}: {told}");
    said
}

#[test]
fn positions_and_control_of_another_place_are_errors_that_name_the_cause() {
    let folder = tempfile::tempdir().unwrap();
    // Indiana, UTM zone 16.
    let (here, control) = ([40.4718, -86.9920], [500_678.0, 4_480_140.0]);
    let zone = "crs = \"EPSG:32616\"";
    type Case = (&'static str, [f64; 2], [f64; 2], &'static str, &'static str);
    let cases: [Case; 7] = [
        ("right", here, control, zone, "fine"),
        ("assumed", here, control, "", "fine"),
        ("wrong zone", here, control, "crs = \"EPSG:32633\"", "EPSG:32616"),
        ("neighbour", here, control, "crs = \"EPSG:32617\"", "EPSG:32616"),
        ("exchanged", [-86.9920, 40.4718], control, zone, "latitude and longitude"),
        ("feet", here, control.map(|v| v / 0.3048), zone, "in feet"),
        ("nowhere", here, [1e12, 4_480_140.0], zone, "no coordinates in metres"),
    ];
    for (name, photos, control, settings, expected) in cases {
        let root = folder.path().join(name.replace(' ', "-"));
        fs::create_dir(&root).unwrap();
        let said = placed(&root, photos, control, settings);
        assert!(said.contains(expected), "{name}: {said}");
    }
}

/// A picture of blobs of many sizes, the same for the same seed.
fn texture(seed: u64) -> image::RgbImage {
    use rand::{RngExt, SeedableRng};
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut sum = vec![0.0_f32; 400 * 300];
    for cell in [2_u32, 5, 11, 23] {
        let side = 400 / cell + 2;
        let values: Vec<f32> = (0..side * side).map(|_| random.random::<f32>()).collect();
        for (k, out) in sum.iter_mut().enumerate() {
            let (u, v) = (k as u32 % 400, k as u32 / 400);
            *out += values[(v / cell * side + u / cell) as usize] / 4.0;
        }
    }
    image::RgbImage::from_fn(400, 300, |u, v| {
        image::Rgb([(40.0 + 170.0 * sum[(v * 400 + u) as usize]) as u8; 3])
    })
}

#[test]
fn blurred_and_wrongly_exposed_photos_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    fs::create_dir(&images).unwrap();
    for k in 0..7 {
        let photo = texture(k);
        let photo = match k {
            2 => image::imageops::blur(&photo, 3.0),
            4 => image::RgbImage::from_fn(400, 300, |u, v| {
                image::Rgb(
                    photo.get_pixel(u, v).0.map(|c| c.saturating_add(if u > 90 { 240 } else { 0 })),
                )
            }),
            _ => photo,
        };
        photo.save(images.join(format!("{k}.png"))).unwrap();
    }
    let run = rowgram(folder.path(), "align . --until features");
    assert_eq!(run.code, 0, "{}", run.stderr);
    let named: Vec<&str> = run.stderr.lines().filter(|line| line.contains(".png: ")).collect();
    assert_eq!(named.len(), 2, "{}", run.stderr);
    assert!(named.iter().any(|line| line.contains("2.png: it seems blurred")), "{named:?}");
    assert!(
        named.iter().any(|line| line.contains("4.png: ") && line.contains("white")),
        "{named:?}"
    );
}
