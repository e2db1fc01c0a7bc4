//! Reconstructions in files: what is written is read back, and other readers' equations find the
//! measurements where they are. The readers here know the formats' conventions and nothing of ours.

use super::toy::{self, Plan, truth};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rowgram::{
    camera::{Interior, Lens, Model as LensModel},
    io::{bundler, colmap, model::Model, opensfm},
    scene::Reconstruction,
};
use serde_json::Value;
use std::{collections::HashMap, path::Path};

fn lens(model: LensModel, values: &[f64]) -> Interior {
    Interior::new(model, toy::SIZE_PX, values).unwrap()
}

/// Brown's model with everything that COLMAP's OPENCV has.
fn brown() -> Interior {
    let values = [900.0, 1.002, 503.0, 371.0, -0.06, 0.02, 5e-4, -3e-4, 0.0, 0.0, 0.0, 0.0];
    lens(LensModel::Brown, &values)
}

/// A block without noise: every measurement is the projection of its point.
fn exact(interior: Interior) -> Model {
    let survey = truth(&Plan { tie_points: 40, interior, ..Plan::default() });
    Model { survey, ..Model::default() }
}

/// Both blocks are the same but for names of cameras and numbers of images and points.
fn assert_same(a: &Reconstruction, b: &Reconstruction) {
    let place: HashMap<&str, usize> =
        b.images.iter().enumerate().map(|(k, image)| (image.name.as_str(), k)).collect();
    assert_eq!(a.images.len(), b.images.len());
    for image in &a.images {
        let other = &b.images[place[image.name.as_str()]];
        let apart = Vector3::from(image.pose.centre_m()) - Vector3::from(other.pose.centre_m());
        assert!(apart.norm() < 1e-8, "{}: {apart}", image.name);
        let [q, r] = [image, other].map(|i| nalgebra::Vector4::from(i.pose.rotation));
        assert!((q - r).norm().min((q + r).norm()) < 1e-12);
        let lenses = (a.cameras[image.camera].interior, b.cameras[other.camera].interior);
        for point in [[0.1, -0.2, -1.0], [0.0, 0.0, -3.0], [-0.3, 0.25, -1.0]] {
            let [p, q] = [lenses.0.project(point).unwrap(), lenses.1.project(point).unwrap()];
            assert!((p[0] - q[0]).hypot(p[1] - q[1]) < 1e-9, "{p:?} {q:?}");
        }
    }
    let key = |s: &Reconstruction| {
        let mut all: Vec<(String, [i64; 3], [f64; 2])> = s
            .observations
            .iter()
            .map(|o| {
                let at = s.points[o.point as usize].position_m.map(|v| (v * 1e6).round() as i64);
                (s.images[o.image as usize].name.clone(), at, o.image_px)
            })
            .collect();
        all.sort_by(|a, b| (&a.0, a.1).cmp(&(&b.0, b.1)));
        all
    };
    let (a, b) = (key(a), key(b));
    assert_eq!(a.len(), b.len());
    for (one, other) in a.iter().zip(&b) {
        assert_eq!((&one.0, one.1), (&other.0, other.1));
        let apart = (one.2[0] - other.2[0]).hypot(one.2[1] - other.2[1]);
        assert!(apart < 1e-9, "{one:?} {other:?}");
    }
}

#[test]
fn colmap_models_come_back_and_are_what_colmap_reads() {
    let lenses = [
        (brown(), "OPENCV", 8),
        (lens(LensModel::Bal, &[900.0, 0.0, 0.0]), "SIMPLE_PINHOLE", 3),
        (lens(LensModel::Bal, &[900.0, -0.05, 0.01]), "RADIAL", 5),
        (
            lens(LensModel::Fisheye, &[900.0, 0.999, 503.0, 371.0, 0.02, -0.01, 1e-3, 0.0]),
            "OPENCV_FISHEYE",
            8,
        ),
        (
            lens(
                LensModel::Brown,
                &[900.0, 1.0, 503.0, 371.0, -0.06, 0.02, 0.0, 0.0, 1e-3, 0.01, 0.0, 0.0],
            ),
            "FULL_OPENCV",
            12,
        ),
    ];
    for (interior, kind, count) in lenses {
        let model = exact(interior);
        for form in [colmap::Form::Text, colmap::Form::Binary] {
            let folder = tempfile::tempdir().unwrap();
            colmap::write(folder.path(), &model, form, false).unwrap();
            assert_eq!(colmap::find(folder.path()), Some(form));
            let back = colmap::read(folder.path()).unwrap();
            assert_same(&model.survey, &back.survey);
            // What was read is written as the same bytes.
            let again = tempfile::tempdir().unwrap();
            colmap::write(again.path(), &back, form, false).unwrap();
            let twice = colmap::read(again.path()).unwrap();
            assert_eq!(twice.camera_ids, back.camera_ids);
            assert_eq!(twice.survey.points, back.survey.points);
            assert_eq!(twice.survey.observations, back.survey.observations);
            if form == colmap::Form::Text {
                let cameras = std::fs::read_to_string(folder.path().join("cameras.txt")).unwrap();
                let row = cameras.lines().find(|line| !line.starts_with('#')).unwrap();
                let words: Vec<&str> = row.split_whitespace().collect();
                assert_eq!((words[1], words.len() - 4), (kind, count));
                if kind == "OPENCV" {
                    colmap_reader(folder.path());
                }
            }
        }
    }
}

/// COLMAP's own equations on its text files, OPENCV lens.
fn colmap_reader(folder: &Path) {
    let text = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
    let numbers =
        |words: &[&str]| -> Vec<f64> { words.iter().map(|w| w.parse().unwrap()).collect() };
    let cameras = text("cameras.txt");
    let row = cameras.lines().find(|line| !line.starts_with('#')).unwrap();
    let p = numbers(&row.split_whitespace().skip(4).collect::<Vec<_>>());
    let mut points: HashMap<u64, Vector3<f64>> = HashMap::new();
    for line in text("points3D.txt").lines().filter(|line| !line.starts_with('#')) {
        let words: Vec<&str> = line.split_whitespace().collect();
        points.insert(words[0].parse().unwrap(), Vector3::from_vec(numbers(&words[1..4])));
    }
    let images = text("images.txt");
    let mut lines = images.lines().filter(|line| !line.starts_with('#'));
    let mut count = 0;
    while let (Some(head), Some(tail)) = (lines.next(), lines.next()) {
        let n = numbers(&head.split_whitespace().skip(1).take(7).collect::<Vec<_>>());
        let q = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(n[0], n[1], n[2], n[3]));
        let t = Vector3::new(n[4], n[5], n[6]);
        let words: Vec<&str> = tail.split_whitespace().collect();
        for feature in words.chunks(3).filter(|feature| feature[2] != "-1") {
            let c = q * points[&feature[2].parse().unwrap()] + t;
            assert!(c.z > 0.0);
            let (x, y) = (c.x / c.z, c.y / c.z);
            let r2 = x * x + y * y;
            let radial = 1.0 + p[4] * r2 + p[5] * r2 * r2;
            let xd = x * radial + 2.0 * p[6] * x * y + p[7] * (r2 + 2.0 * x * x);
            let yd = y * radial + 2.0 * p[7] * x * y + p[6] * (r2 + 2.0 * y * y);
            let measured = numbers(&feature[..2]);
            let apart = (p[0] * xd + p[2] - measured[0]).hypot(p[1] * yd + p[3] - measured[1]);
            // Coordinates of half a million metres leave 1e-10 m, thus 1e-9 px.
            assert!(apart < 1e-8, "{apart}");
            count += 1;
        }
    }
    assert!(count > 100);
}

#[test]
fn bundler_files_come_back_and_are_what_bundler_reads() {
    let model = exact(lens(LensModel::Bal, &[900.0, -0.05, 0.01]));
    let folder = tempfile::tempdir().unwrap();
    let (path, list) = (folder.path().join("bundle.out"), folder.path().join("list.txt"));
    bundler::write(&path, Some(&list), &model, false).unwrap();
    let back = bundler::read(&path, Some(&list), toy::SIZE_PX).unwrap();
    assert_same(&model.survey, &back.survey);

    let text = std::fs::read_to_string(&path).unwrap();
    let numbers: Vec<f64> = text
        .lines()
        .skip(1)
        .flat_map(|line| line.split_whitespace().map(|w| w.parse().unwrap()))
        .collect();
    let mut numbers = numbers.into_iter();
    let mut next = || numbers.next().unwrap();
    let (cameras, points) = (next() as usize, next() as usize);
    let cameras: Vec<[f64; 15]> = (0..cameras).map(|_| std::array::from_fn(|_| next())).collect();
    let mut count = 0;
    for _ in 0..points {
        let x = Vector3::new(next(), next(), next());
        (0..3).for_each(|_| assert!((0.0..256.0).contains(&next())));
        for _ in 0..next() as usize {
            let c = &cameras[next() as usize];
            next();
            let p = Matrix3::from_row_slice(&c[3..12]) * x + Vector3::new(c[12], c[13], c[14]);
            let (u, v) = (-p.x / p.z, -p.y / p.z);
            let r2 = u * u + v * v;
            let radial = c[0] * (1.0 + c[1] * r2 + c[2] * r2 * r2);
            let apart = (radial * u - next()).hypot(radial * v - next());
            assert!(apart < 1e-8, "{apart}");
            count += 1;
        }
    }
    assert_eq!(count, model.survey.observations.len());
    // A name that the list would cut short is refused.
    let mut blank = model.clone();
    blank.survey.images[0].name = "IMG 1.jpg".into();
    let other = folder.path().join("other.out");
    let error = bundler::write(&other, Some(&list), &blank, true).unwrap_err().to_string();
    assert!(error.contains("IMG 1.jpg") && !other.exists(), "{error}");
    // So is a lens that the format cannot hold.
    let error = bundler::write(&path, None, &exact(brown()), true).unwrap_err().to_string();
    assert!(error.contains("Bundler knows f, k1 and k2"), "{error}");
}

#[test]
fn opensfm_files_come_back_and_are_what_opensfm_reads() {
    let fisheye = lens(LensModel::Fisheye, &[900.0, 1.0, 503.0, 371.0, 0.02, -0.01, 1e-3, 0.0]);
    for (interior, kind) in [
        (brown(), "brown"),
        (lens(LensModel::Bal, &[900.0, -0.05, 0.01]), "perspective"),
        (fisheye, "fisheye_opencv"),
    ] {
        let model = exact(interior);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("reconstruction.json");
        let tracks = folder.path().join("tracks.csv");
        opensfm::write(&path, &tracks, &model, false).unwrap();
        assert_same(&model.survey, &opensfm::read(&path, &tracks).unwrap().survey);
        let file: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        let camera = file[0]["cameras"].as_object().unwrap().values().next().unwrap();
        assert_eq!(camera["projection_type"], kind);
        if kind == "brown" {
            opensfm_reader(&file[0], camera, &std::fs::read_to_string(&tracks).unwrap());
        }
    }
}

/// OpenSfM's own equations: normalised coordinates, `(pixel + 0.5 - size / 2) / larger side`.
fn opensfm_reader(reconstruction: &Value, camera: &Value, tracks: &str) {
    let vector = |value: &Value| Vector3::from_fn(|k, _| value[k].as_f64().unwrap());
    let number = |key: &str| camera[key].as_f64().unwrap();
    let mut count = 0;
    for line in tracks.lines().skip(1) {
        let fields: Vec<&str> = line.split('\t').collect();
        let shot = &reconstruction["shots"][fields[0]];
        let point = vector(&reconstruction["points"][fields[1]]["coordinates"]);
        let c = Rotation3::new(vector(&shot["rotation"])) * point + vector(&shot["translation"]);
        let (x, y) = (c.x / c.z, c.y / c.z);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (number("k1") + r2 * (number("k2") + r2 * number("k3")));
        let (p1, p2) = (number("p1"), number("p2"));
        let xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let yd = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y);
        let u = number("focal_x") * xd + number("c_x") - fields[3].parse::<f64>().unwrap();
        let v = number("focal_y") * yd + number("c_y") - fields[4].parse::<f64>().unwrap();
        let apart_px = 1000.0 * u.hypot(v);
        assert!(apart_px < 1e-8, "{apart_px}");
        count += 1;
    }
    assert!(count > 100);
}

#[test]
fn pixel_centres_are_at_the_borders_conventions() {
    // A feature in the centre of the top-left pixel, and the middle of the image.
    let mut model = exact(lens(LensModel::Bal, &[900.0, 0.0, 0.0]));
    model.survey.observations[0].image_px = [0.0, 0.0];
    let folder = tempfile::tempdir().unwrap();
    colmap::write(folder.path(), &model, colmap::Form::Text, false).unwrap();
    let images = std::fs::read_to_string(folder.path().join("images.txt")).unwrap();
    let all: Vec<f64> = images
        .lines()
        .filter(|line| !line.starts_with('#'))
        .skip(1)
        .step_by(2)
        .flat_map(|line| line.split_whitespace().map(|w| w.parse().unwrap()).collect::<Vec<f64>>())
        .collect();
    assert!(all.chunks(3).any(|feature| feature[..2] == [0.5, 0.5]));
    let cameras = std::fs::read_to_string(folder.path().join("cameras.txt")).unwrap();
    let row = cameras.lines().find(|line| !line.starts_with('#')).unwrap();
    let words: Vec<&str> = row.split_whitespace().collect();
    // COLMAP's image centre is half the size.
    let centre: Vec<f64> = words[5..7].iter().map(|w| w.parse().unwrap()).collect();
    assert_eq!(centre, [500.0, 375.0]);
}

#[test]
fn damaged_files_are_named_with_the_line() {
    let folder = tempfile::tempdir().unwrap();
    let model = exact(brown());
    let at = folder.path();
    colmap::write(at, &model, colmap::Form::Text, false).unwrap();
    let damage = |name: &str, from: &str, to: &str, part: &str| {
        let path = at.join(name);
        let whole = std::fs::read_to_string(&path).unwrap();
        assert!(whole.contains(from), "{from}");
        std::fs::write(&path, whole.replacen(from, to, 1)).unwrap();
        let error = colmap::read(at).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains(part), "{part}: {error}");
        std::fs::write(&path, whole).unwrap();
    };
    damage("cameras.txt", "OPENCV", "OPENCAVE", "OPENCAVE");
    damage("cameras.txt", " 1000 750 ", " 1000 nan ", "cameras.txt");
    damage("points3D.txt", "\n100 ", "\n1oo ", "line 2: expected the number of a point");
    colmap::write(at, &model, colmap::Form::Binary, false).unwrap();
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let whole = std::fs::read(at.join(name)).unwrap();
        std::fs::write(at.join(name), &whole[..whole.len() / 2]).unwrap();
        let error = colmap::read(at).unwrap_err().to_string();
        assert!(error.contains(name), "{error}");
        // A count that the file cannot hold asks for no memory.
        let mut huge = whole.clone();
        huge[..8].fill(0xff);
        std::fs::write(at.join(name), &huge).unwrap();
        assert!(colmap::read(at).unwrap_err().to_string().contains(name));
        std::fs::write(at.join(name), &whole).unwrap();
    }
}
