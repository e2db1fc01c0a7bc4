//! What is written is read back, to the last bit; what is wrong is named.

use super::*;
use rowgram_survey::{
    camera::{Camera, Correlation, Interior, Lens, Model},
    scene::*,
};

/// Numbers that need all of their digits.
fn awkward(k: usize) -> f64 {
    1.0 / 3.0 + 4_649_000.1 * (k as f64 + 0.7).sin()
}

fn scene() -> Reconstruction {
    let camera = |model: Model, c: f64| {
        let count = model.parameters().len();
        let mut values: Vec<f64> =
            (0..count).map(|k| model.default_value(k, [400, 300]).unwrap_or(c)).collect();
        values[0] = c;
        values[count - 1] = 1e-22 / 3.0;
        let mut camera =
            Camera::new(model.word(), Interior::new(model, [400, 300], &values).unwrap());
        camera.free[0] = true;
        camera.standard_deviations[0] = Some(awkward(1).abs());
        camera
    };
    let mut cameras = vec![camera(Model::Smac, 350.1), camera(Model::Brown, 1.0 / 3.0 + 200.0)];
    cameras[0].expected = Some(cameras[0].interior.values().to_vec());
    let names = vec!["f_px".to_owned()];
    cameras[1].correlation = Some(Correlation { names, matrix: vec![vec![1.0]] });
    let image = |k: usize| Image {
        name: ["a, \"b\".jpg", "IMG_2.JPG"][k].into(),
        id: 7 + k as u32,
        camera: k,
        pose: Pose {
            rotation: rowgram_optim::geometry::rotation::exp([0.1, -0.2, 1.0 / 3.0 + k as f64]),
            translation: [awkward(k), -awkward(k + 1), 0.1 + 0.2],
        },
        motion: [0.0, 1e-5 / 3.0, 0.0, 0.1, 0.2, 0.3],
        expected_motion: if k == 0 { [0.0; 6] } else { [1.0 / 7.0; 6] },
    };
    let point = |k: usize| TiePoint {
        id: 3 * k as u64 + 1,
        position_m: [awkward(k), awkward(k + 5), -awkward(k + 9)],
        colour: [k as u8, 200, 255],
    };
    Reconstruction {
        reference: ReferenceFrame {
            horizontal: HorizontalFrame::LocalPlane {
                latitude_deg: 42.0 + 1.0 / 3.0,
                longitude_deg: -93.7,
                height_m: 0.0,
            },
            vertical: VerticalFrame::CameraPositions,
            unit: LengthUnit::Metre,
        },
        cameras,
        images: vec![image(0), image(1)],
        points: (0..20).map(point).collect(),
        observations: (0..40)
            .map(|k| Observation {
                image: k % 2,
                point: k / 2,
                image_px: [awkward(k as usize), awkward(k as usize + 3)],
            })
            .collect(),
        tie_sigma_px: 0.1 + 0.2,
        ground: vec![GroundPoint {
            name: "GCP \"1\"".into(),
            position_m: [awkward(2), awkward(3), awkward(4)],
            sigma_m: [0.01, 0.02, 1.0 / 30.0],
            role: Role::Check,
            axes: Axes::Xy,
        }],
        marks: vec![GroundObservation {
            image: 1,
            ground: 0,
            image_px: [awkward(7), awkward(8)],
            sigma_px: 0.5,
        }],
        positions: vec![CameraPosition {
            image: 0,
            position_m: [awkward(1); 3],
            sigma_m: [2.0; 3],
        }],
        orientations: vec![CameraOrientation {
            image: 1,
            rotation: [awkward(2), 0.1, 1.0 / 3.0, -0.0],
            sigma_rad: [0.1 / 3.0, 0.02, 0.1],
        }],
        lever_arm_m: [0.1, 1.0 / 3.0, -0.0],
        scale_bars: Vec::new(),
        rolling_shutter: Some(RollingShutter { readout_s: 0.03, sigma_velocity_m_s: 1.0 / 3.0 }),
        accuracy: Some(Accuracy {
            sigma0: 1.2 / 0.7,
            images: vec![PoseSigma { centre_m: [0.1 / 3.0; 3], angles_rad: [1e-5 / 3.0; 3] }; 2],
            cameras: vec![
                CameraSigma {
                    names: vec!["c_px".into()],
                    sigmas: vec![0.1 / 3.0],
                    correlation: vec![vec![1.0]],
                },
                CameraSigma::default(),
            ],
            points_m: (0..20).map(|k| [awkward(k).abs(), 0.1 / 3.0, 1e-9]).collect(),
        }),
        excluded: vec![Excluded {
            kind: ExcludedKind::TiePoint,
            image: None,
            point: Some("17".into()),
            reason: "1 image(s) see it, two are needed".into(),
        }],
    }
}

#[test]
fn what_is_written_is_read_back_to_the_last_bit() {
    let folder = tempfile::tempdir().unwrap();
    for scene in [scene(), Reconstruction { accuracy: None, ..scene() }] {
        write(folder.path(), &scene, true).unwrap();
        assert!(is_one(folder.path()));
        let back = read(&folder.path().join(NAME)).unwrap();
        assert_eq!(back, scene);
        // -0 and 0 are equal, but not the same.
        assert!(back.lever_arm_m[2].is_sign_negative());
        assert_eq!(
            back.images[1].pose.translation.map(f64::to_bits),
            scene.images[1].pose.translation.map(f64::to_bits)
        );
    }
    // Files may have a standard deviation of the rotation during readout, which must be 0.
    let json = folder.path().join(NAME);
    let text = std::fs::read_to_string(&json).unwrap();
    let with_rate = text.replacen("\"readout_s\"", "\"sigma_rate_rad_s\": 0.0, \"readout_s\"", 1);
    assert_ne!(with_rate, text);
    std::fs::write(&json, &with_rate).unwrap();
    assert_eq!(read(&json).unwrap().rolling_shutter, scene().rolling_shutter);
    for (key, expected) in [
        ("\"sigma_rate_rad_s\": 0.1,", "sigma_rate_rad_s is 0.1, expected 0"),
        ("\"sigma_rate\": 0.0,", "unknown field `sigma_rate`"),
    ] {
        std::fs::write(&json, with_rate.replace("\"sigma_rate_rad_s\": 0.0,", key)).unwrap();
        let error = read(&json).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let error = write(folder.path(), &scene(), false).unwrap_err().to_string();
    assert!(error.contains("reconstruction.json exists already"), "{error}");
}

#[test]
fn what_is_wrong_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join(NAME);
    write(&json, &scene(), false).unwrap();
    let good = std::fs::read_to_string(&json).unwrap();
    for (damage, expected) in [
        (("\"version\": 1", "\"version\": 9"), "version is 9"),
        (("\"version\": 1", "\"version\": \"x\""), "line 3: at \"version\": invalid type"),
        (("\"tie_sigma_px\"", "\"tie_sigma\""), "unknown field `tie_sigma`"),
        (("\"camera\":1", "\"camera\":5"), "image \"IMG_2.JPG\": there is no camera with index 5"),
        (("\"model\":\"smac\"", "\"model\":\"fishy\""), "at \"model\": unknown variant `fishy`"),
        (("\"image\":\"IMG_2.JPG\"", "\"image\":\"IMG_3.JPG\""), "there is no image \"IMG_3.JPG\""),
        (("\"K1\":", "\"k1\":"), "parameter"),
        (
            ("\"tie_point_count\": 20", "\"tie_point_count\": 21"),
            "20 tie points, reconstruction.json says 21",
        ),
    ] {
        assert!(good.contains(damage.0), "{damage:?}\n{good}");
        std::fs::write(&json, good.replacen(damage.0, damage.1, 1)).unwrap();
        let error = read(&json).unwrap_err().to_string();
        assert!(error.contains(expected), "{damage:?}: {error}");
    }
    std::fs::write(&json, &good).unwrap();
    let table = folder.path().join(OBSERVATIONS);
    let good = std::fs::read_to_string(&table).unwrap();
    std::fs::write(&table, good.replacen("IMG_2.JPG,1,", "IMG_9.JPG,1,", 1)).unwrap();
    let error = read(&json).unwrap_err().to_string();
    assert!(error.contains("tie_observations.csv, line 3: there is no image"), "{error}");
    for wrong in [
        Reconstruction { tie_sigma_px: f64::NAN, ..scene() },
        Reconstruction { images: vec![scene().images[0].clone(); 2], ..scene() },
    ] {
        assert!(write(&json, &wrong, true).is_err());
    }
}
