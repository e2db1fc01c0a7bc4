//! Two wide lenses with rolling shutters, against what the twin says of every photo.

use data_synth::{
    camera::{Camera as TwinCamera, CameraConfig},
    flight::Shot,
    twin::{FlightPreset, TwinConfig},
};
use rowgram::{
    camera::Camera,
    io::{
        geotiff::{Colour, Layout, Reader, write},
        poses::from_angles_rad,
    },
    mapping::Surface,
    monitor::Collector,
    options::Auto,
    pipeline::{
        Project,
        ortho::{OrthoOptions, ortho},
        query::query,
    },
    raster::{
        georeference::{Crs, Georeference},
        window::Window,
    },
    scene::{HorizontalFrame, Image, LengthUnit, Pose, Reconstruction, ReferenceFrame},
};
use std::{fs, path::Path};

/// Photos of two flights with two wide lenses and rolling shutters, as one reconstruction in the files of a project, and
/// what the twin says of each photo.
fn two_wide_cameras(root: &Path) -> Vec<(Shot, TwinCamera)> {
    let config = |degree: f64| {
        let mut config = TwinConfig::preset(FlightPreset::Small);
        config.field.rows = 6;
        config.field.row_length_m = 6.0;
        config.field.plots = Default::default();
        config.camera = CameraConfig::wide(600, 450, 330.0);
        config.camera.k1 *= degree;
        config.camera.xp_px *= -degree;
        config.flight.height_m = 8.0;
        config.flight.margin_m = -1.0;
        (config.flight.strips, config.flight.photos_per_strip) = (2, 2);
        (config.flight.speed_m_s, config.flight.readout_seconds) = (2.0, 0.02);
        config.flight.turn_rate_deg_s = 2.0;
        config.tie_points.per_photo = 20;
        config
    };
    let mut scene = Reconstruction {
        reference: ReferenceFrame {
            horizontal: HorizontalFrame::Unnamed,
            unit: LengthUnit::Metre,
            ..ReferenceFrame::default()
        },
        tie_sigma_px: 0.5,
        ..Reconstruction::default()
    };
    let mut truth = Vec::new();
    fs::create_dir(root.join("images")).unwrap();
    for (number, degree) in [1.0, 0.8].into_iter().enumerate() {
        let twin = config(degree).build().unwrap();
        let mut toml = Vec::new();
        data_synth::files::camera(&twin, &mut toml).unwrap();
        let mut camera = Camera::from_toml(&String::from_utf8(toml).unwrap()).unwrap();
        camera.name = format!("wide {number}");
        scene.cameras.push(camera);
        for (k, shot) in twin.shots.iter().enumerate() {
            let name = format!("c{number}_{k}.png");
            let back = |v: [f64; 3]| -> [f64; 3] {
                std::array::from_fn(|i| (0..3).map(|j| shot.rotation[j][i] * v[j]).sum())
            };
            let [turn, shift] = [shot.turn_rad_s, shot.velocity_m_s]
                .map(|rate| back(rate).map(|part| -part * shot.readout_s));
            let [omega, phi, kappa] = shot.angles_rad();
            scene.images.push(Image {
                name: name.clone(),
                id: scene.images.len() as u32 + 1,
                camera: number,
                pose: Pose::from_centre(from_angles_rad([omega, phi, kappa]), shot.centre_m),
                motion: [turn[0], turn[1], turn[2], shift[0], shift[1], shift[2]],
                expected_motion: [0.0; 6],
            });
            image::RgbImage::from_pixel(600, 450, image::Rgb([90, 120, 60]))
                .save(root.join("images").join(name))
                .unwrap();
            truth.push((shot.clone(), twin.camera.clone()));
        }
    }
    let folder = root.join("rowgram/align");
    fs::create_dir_all(&folder).unwrap();
    rowgram::io::reconstruction::write(&folder, &scene, false).unwrap();
    truth
}

#[test]
#[ignore = "slow; cargo test -- --include-ignored"]
fn wide_lenses_of_two_cameras_are_right_to_a_fiftieth_of_a_pixel() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let truth = two_wide_cameras(root);
    let centre = truth[0].0.centre_m.map(f64::floor);
    let (side, size) = (0.25, [120, 120]);
    let place = Georeference::north_up([centre[0] - 15.0, centre[1] + 15.0], side, Crs::LOCAL);
    let wave = |k: usize| {
        ((k % size[0]) as f32 * 0.2).sin() * 0.3 + ((k / size[0]) as f32 * 0.1).cos() * 0.2
    };
    let ground = centre[2] as f32 - 8.0;
    let z: Vec<f32> = (0..size[0] * size[1]).map(|k| ground + wave(k)).collect();
    let layout = Layout {
        width: size[0],
        height: size[1],
        colour: Colour::Values,
        georeference: Some(place),
        nodata: None,
    };
    write::<f32, rowgram::Error>(&root.join("relief.tif"), false, &layout, |writer| {
        Ok(writer.put(Window::whole(size[0], size[1]), &z)?)
    })
    .unwrap();
    let surface = Surface::new(place, size, z).unwrap();
    let project = Project::open(root).unwrap();
    let options = OrthoOptions {
        canopy_height_m: Auto::Given(0.0),
        gsd_m: Some(0.03),
        dem: Some("relief.tif".into()),
        ..OrthoOptions::default()
    };
    let mut found = Collector::default();
    let outcome = ortho(&project, &options, &mut found).unwrap();
    assert!(root.join("rowgram/ortho").join(&outcome.mosaic.file).is_file());
    let full = root.join("full.tif");
    query(&project, None).unwrap().write_full(&full, false, &mut found).unwrap();
    let reader = Reader::open(&full).unwrap();
    let grid = reader.georeference().unwrap();
    let records = reader.read::<f32>(Window::whole(reader.width(), reader.height())).unwrap();
    let (mut squared, mut largest, mut of_camera, mut far) = (0.0, 0.0f64, [0, 0], 0);
    for (k, record) in records.chunks_exact(5).enumerate().filter(|(_, record)| record[0] >= 0.0) {
        let [x, y] = grid.map([(k % reader.width()) as f64, (k / reader.width()) as f64]);
        let photo = record[0] as usize;
        let (shot, camera) = &truth[photo];
        let point = [x, y, surface.at([x, y]).unwrap()];
        let Some([u, v]) = shot.project(camera, point) else { panic!("{photo} {x} {y}") };
        let off = (f64::from(record[1]) - u).hypot(f64::from(record[2]) - v);
        squared += off * off;
        largest = largest.max(off);
        of_camera[usize::from(photo >= truth.len() / 2)] += 1;
        far += usize::from((u - 300.0).hypot(v - 225.0) > 300.0);
    }
    let count = of_camera[0] + of_camera[1];
    assert!(of_camera.iter().all(|&cells| cells > 20_000), "{of_camera:?}");
    assert!(far > 1000, "only {far} cells come from the corners of photos");
    let rms = (squared / f64::from(count)).sqrt();
    println!("{count} cells: {rms:.5} px rms, at most {largest:.5} px");
    assert!(rms < 0.005 && largest < 0.02, "{rms} px rms, at most {largest} px");
    // The same again without doing it, and a project without scale is refused.
    let mut again = Collector::default();
    assert_eq!(ortho(&project, &options, &mut again).unwrap(), outcome);
    assert!(again.diagnostics.iter().any(|found| found.code == "stage-kept"));
    let origins = query(&project, None).unwrap();
    let [x, y] = grid.map([0.5 * reader.width() as f64, 0.5 * reader.height() as f64]);
    let pixel = origins.photo_pixel([x, y]).unwrap();
    let back = origins.map_position(&pixel.image, [pixel.u_px, pixel.v_px]).unwrap();
    assert!((back.x_m - x).hypot(back.y_m - y) < 1e-6, "{back:?}");
    let path = root.join("rowgram/align/reconstruction.json");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("\"metre\"", "\"arbitrary\"")).unwrap();
    let error = ortho(&project, &options, &mut again).unwrap_err().to_string();
    assert!(error.contains("no scale"), "{error}");
}
