//! The flight is the one that was asked for, and each of its errors alone does what it says.

use crate::moments;
use data_synth::{
    camera::{Camera, CameraConfig},
    field::{Field, FieldConfig},
    flight::{FlightConfig, GnssConfig, Shot, fly},
    twin::{FlightPreset, TwinConfig},
};

/// A flight without any error.
fn still() -> FlightConfig {
    FlightConfig {
        gimbal_deg: 0.0,
        heading_deg: 0.0,
        position_m: 0.0,
        height_drift_m: 0.0,
        wind_m_s: 0.0,
        gnss: GnssConfig {
            horizontal_m: 0.0,
            vertical_m: 0.0,
            lever_arm_m: [0.0; 3],
            ..GnssConfig::default()
        },
        ..FlightConfig::default()
    }
}

fn field() -> Field {
    let config =
        FieldConfig { rows: 30, row_length_m: 30.0, heading_deg: 20.0, ..FieldConfig::default() };
    Field::plant(&config).unwrap()
}

fn camera() -> Camera {
    Camera::new(&CameraConfig::wide(1200, 900, 500.0)).unwrap()
}

fn shots(config: &FlightConfig) -> Vec<Shot> {
    fly(config, &field(), &camera()).unwrap()
}

/// Five hundred photos.
fn many(config: FlightConfig) -> Vec<Shot> {
    shots(&FlightConfig { strips: 20, photos_per_strip: 25, ..config })
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| a[i] - b[i])
}

#[test]
fn strips_go_to_and_fro_with_the_overlaps_asked_for() {
    let config =
        FlightConfig { forward_overlap: 0.7, side_overlap: 0.5, direction_deg: 15.0, ..still() };
    let shots = shots(&config);
    let [half_across, half_along] = camera().half_footprint();
    let heading_rad = 35.0f64.to_radians();
    let (along, across) =
        ([heading_rad.cos(), heading_rad.sin()], [-heading_rad.sin(), heading_rad.cos()]);
    let strips = shots.last().unwrap().strip + 1;
    assert!(strips >= 3);
    for pair in shots.windows(2) {
        let step = minus(pair[1].centre_m, pair[0].centre_m);
        let (s, t) =
            (step[0] * along[0] + step[1] * along[1], step[0] * across[0] + step[1] * across[1]);
        if pair[0].strip == pair[1].strip {
            let sign = if pair[0].strip % 2 == 0 { 1.0 } else { -1.0 };
            approx::assert_abs_diff_eq!(s * sign, 2.0 * half_along * 15.0 * 0.3, epsilon = 1e-9);
            approx::assert_abs_diff_eq!(t, 0.0, epsilon = 1e-9);
            approx::assert_abs_diff_eq!(
                pair[1].time_s - pair[0].time_s,
                s.abs() / config.speed_m_s,
                epsilon = 1e-9
            );
        } else {
            approx::assert_abs_diff_eq!(t, 2.0 * half_across * 15.0 * 0.5, epsilon = 1e-9);
        }
    }
    // Every corner of the field is seen.
    let (field, camera) = (field(), camera());
    for row in [0, 29] {
        for end_m in [-15.0, 15.0] {
            let [x, y] = field.config.ground(end_m, field.config.row_across(row, end_m));
            let seen = shots.iter().any(|shot| {
                shot.project(&camera, [x, y, 0.0]).is_some_and(|pixel| camera.inside(pixel, 0.0))
            });
            assert!(seen, "row {row} at {end_m} m");
        }
    }
}

#[test]
fn the_papers_flight_has_its_ground_sampling_distance() {
    let twin = TwinConfig::preset(FlightPreset::Paper);
    let gsd_m = twin.flight.height_m / twin.camera.c_px;
    approx::assert_abs_diff_eq!(gsd_m, 0.015, epsilon = 1e-12);
    let field =
        Field::plant(&FieldConfig { stage: data_synth::field::GrowthStage::Early, ..twin.field })
            .unwrap();
    let photos = fly(&twin.flight, &field, &Camera::new(&twin.camera).unwrap()).unwrap().len();
    assert!((40..=600).contains(&photos), "{photos}");
    assert_eq!((twin.targets.control, twin.targets.check), (18, 10));
}

#[test]
fn looking_out_of_a_pixel_and_projecting_what_is_there_gives_the_pixel() {
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.flight.readout_seconds = 0.04;
    config.flight.turn_rate_deg_s = 8.0;
    config.camera = CameraConfig::wide(1000, 750, 520.0);
    let twin = config.build().unwrap();
    let mut most = 0.0f64;
    for shot in &twin.shots {
        for step in 0..100 {
            let (u, v) = (f64::from(step % 10) * 111.0, f64::from(step / 10) * 83.2);
            let (origin, ray) = shot.ray(&twin.camera, u, v);
            let reach = twin.field().terrain.meet(origin, ray, origin[2]).unwrap();
            let place = [0, 1, 2].map(|i| origin[i] + reach * ray[i]);
            let [back_u, back_v] = shot.project(&twin.camera, place).unwrap();
            most = most.max(f64::hypot(back_u - u, back_v - v));
        }
    }
    assert!(most < 1e-6, "{most} px");
    for mark in &twin.marks {
        let target = &twin.targets[mark.target];
        let pixel = twin.shots[mark.shot].project(&twin.camera, target.place_m);
        assert_eq!(pixel, Some(mark.true_px));
    }
    assert!(twin.marks.len() > 20, "{}", twin.marks.len());
}

#[test]
fn the_gimbal_alone_tilts_and_the_heading_alone_turns() {
    let level = many(still());
    let tilted = many(FlightConfig { gimbal_deg: 2.0, ..still() });
    let turned = many(FlightConfig { heading_deg: 3.0, ..still() });
    let part = |shots: &[Shot], axis: usize| -> Vec<f64> {
        shots
            .iter()
            .zip(&level)
            .map(|(a, b)| {
                // The rotation from the still camera to this one, in the camera frame.
                let mut turn = [[0.0; 3]; 3];
                for (i, row) in turn.iter_mut().enumerate() {
                    for (j, value) in row.iter_mut().enumerate() {
                        *value = (0..3).map(|k| b.rotation[k][i] * a.rotation[k][j]).sum();
                    }
                }
                let (i, j) = [(2, 1), (0, 2), (1, 0)][axis];
                0.5 * (turn[i][j] - turn[j][i])
            })
            .collect()
    };
    for (shots, expected_deg) in [(&tilted, [2.0, 2.0, 0.0]), (&turned, [0.0, 0.0, 3.0])] {
        assert!(shots.iter().zip(&level).all(|(a, b)| a.centre_m == b.centre_m));
        for (axis, expected_deg) in expected_deg.into_iter().enumerate() {
            let deviation_deg = moments(&part(shots, axis)).1.to_degrees();
            assert!(
                (deviation_deg - expected_deg).abs() <= 0.1 * expected_deg + 0.05,
                "{axis}: {deviation_deg}"
            );
        }
    }
}

#[test]
fn places_and_heights_alone_scatter_as_asked() {
    let level = many(still());
    let moved = many(FlightConfig { position_m: 0.5, ..still() });
    let drifting = many(FlightConfig { height_drift_m: 0.4, ..still() });
    let away = |shots: &[Shot], axis: usize| -> Vec<f64> {
        shots.iter().zip(&level).map(|(a, b)| a.centre_m[axis] - b.centre_m[axis]).collect()
    };
    for axis in [0, 1] {
        let (mean_m, deviation_m) = moments(&away(&moved, axis));
        assert!(
            mean_m.abs() < 0.1 && (deviation_m / 0.5 - 1.0).abs() < 0.12,
            "{mean_m} {deviation_m}"
        );
        assert!(away(&drifting, axis).iter().all(|&m| m == 0.0));
    }
    assert!(away(&moved, 2).iter().all(|&m| m == 0.0));
    let heights = away(&drifting, 2);
    let (_, deviation_m) = moments(&heights);
    // Neighbours are correlated by 0.9, so 500 photos count as about 26.
    assert!((0.2..0.65).contains(&deviation_m), "{deviation_m}");
    let steps: Vec<f64> = heights.windows(2).map(|pair| pair[1] - pair[0]).collect();
    assert!(moments(&steps).1 < 0.6 * deviation_m, "drifts slowly");
}

#[test]
fn wind_alone_makes_the_aircraft_crab_into_it() {
    let config = FlightConfig { wind_m_s: 3.0, wind_direction_deg: 80.0, ..still() };
    for (shot, calm) in shots(&config).iter().zip(&shots(&still())) {
        assert_eq!(shot.centre_m, calm.centre_m);
        assert_eq!(shot.velocity_m_s, calm.velocity_m_s);
        // The image's y axis points along the heading: airspeed = ground speed - wind lies on it.
        let wind = [3.0 * 80f64.to_radians().cos(), 3.0 * 80f64.to_radians().sin()];
        let air = [shot.velocity_m_s[0] - wind[0], shot.velocity_m_s[1] - wind[1]];
        let heading = [shot.rotation[0][1], shot.rotation[1][1]];
        let aside = air[0] * heading[1] - air[1] * heading[0];
        approx::assert_abs_diff_eq!(aside, 0.0, epsilon = 1e-9);
        assert!(air[0] * heading[0] + air[1] * heading[1] > 0.0);
    }
}

#[test]
fn the_receiver_errs_as_asked_and_sits_on_its_lever_arm() {
    let exact = many(still());
    assert!(exact.iter().all(|shot| shot.gnss_m == shot.centre_m));
    let gnss = GnssConfig { lever_arm_m: [0.3, -0.2, 0.5], ..still().gnss };
    for shot in many(FlightConfig { gimbal_deg: 3.0, gnss, ..still() }) {
        let away = minus(shot.gnss_m, shot.centre_m);
        for (axis, expected) in [0.3, -0.2, 0.5].into_iter().enumerate() {
            let in_camera: f64 = (0..3).map(|k| shot.rotation[k][axis] * away[k]).sum();
            approx::assert_abs_diff_eq!(in_camera, expected, epsilon = 1e-9);
        }
    }
    let errors = |drift_share: f64| -> Vec<[f64; 3]> {
        let gnss = GnssConfig { horizontal_m: 1.5, vertical_m: 3.0, drift_share, ..still().gnss };
        let shots = many(FlightConfig { gnss, ..still() });
        shots.iter().map(|shot| minus(shot.gnss_m, shot.centre_m)).collect()
    };
    for (axis, expected_m) in [1.5, 1.5, 3.0].into_iter().enumerate() {
        let (mean_m, deviation_m) =
            moments(&errors(0.0).iter().map(|e| e[axis]).collect::<Vec<_>>());
        assert!(mean_m.abs() < 0.2 * expected_m, "{mean_m}");
        assert!((deviation_m / expected_m - 1.0).abs() < 0.12, "{deviation_m}");
    }
    let steps = |errors: &[[f64; 3]]| -> f64 {
        moments(&errors.windows(2).map(|pair| pair[1][0] - pair[0][0]).collect::<Vec<_>>()).1
    };
    assert!(steps(&errors(1.0)) < 0.3 * steps(&errors(0.0)), "a drift common to neighbours");
}

#[test]
fn a_rolling_shutter_alone_moves_rows_by_what_the_camera_flies_meanwhile() {
    let (global, rolling) =
        (shots(&still()), shots(&FlightConfig { readout_seconds: 0.05, ..still() }));
    let camera = camera();
    for (a, b) in global.iter().zip(&rolling) {
        assert_eq!((a.centre_m, a.rotation, a.gnss_m), (b.centre_m, b.rotation, b.gnss_m));
        for v in [0.0, 200.0, 449.5, 700.0, 899.0] {
            let (origin, ray) = b.ray(&camera, 300.0, v);
            let after_s = 0.05 * (v / 899.0 - 0.5);
            for i in 0..3 {
                approx::assert_abs_diff_eq!(
                    origin[i],
                    a.centre_m[i] + after_s * a.velocity_m_s[i],
                    epsilon = 1e-9
                );
            }
            assert_eq!(ray, a.ray(&camera, 300.0, v).1);
        }
    }
}

#[test]
fn every_bad_parameter_is_named() {
    type Change = fn(&mut TwinConfig);
    let bad: [(&str, Change); 22] = [
        ("flight.height_m", |c| c.flight.height_m = 0.0),
        ("flight.forward_overlap", |c| c.flight.forward_overlap = 1.0),
        ("flight.side_overlap", |c| c.flight.side_overlap = f64::NAN),
        ("flight.wind_m_s", |c| c.flight.wind_m_s = 8.0),
        ("flight.readout_seconds", |c| c.flight.readout_seconds = -0.1),
        ("flight.gnss.horizontal_m", |c| c.flight.gnss.horizontal_m = -1.0),
        ("camera.width_px", |c| c.camera.width_px = 1),
        ("camera.c_px", |c| c.camera.c_px = f64::INFINITY),
        ("camera.K1", |c| c.camera.k1 = -4.0 / (625.0 * 625.0)),
        ("image.sun_elevation_deg", |c| c.image.sun_elevation_deg = 0.0),
        ("image.jpeg_quality", |c| c.image.jpeg_quality = 0),
        ("image.defocus_px", |c| c.image.defocus_px = f64::NAN),
        ("targets.control", |c| c.targets.control = 20_000),
        ("targets.size_m", |c| c.targets.size_m = 0.0),
        ("site.epsg", |c| c.site.epsg = 4326),
        ("site.start", |c| c.site.start = "yesterday".to_owned()),
        ("clutter.stones_per_m2", |c| c.clutter.stones_per_m2 = -1.0),
        ("habit.tiller_fraction", |c| c.field.habit.tiller_fraction = 2.0),
        ("plots.length_m", |c| c.field.plots.length_m = 0.01),
        ("terrain.slope_percent", |c| c.field.terrain.slope_percent = 90.0),
        ("tie_points.mean_track", |c| c.tie_points.mean_track = 1.0),
        ("flight.height_m", |c| {
            (c.flight.height_m, c.flight.position_m, c.flight.height_drift_m, c.targets.above_m) =
                (1.0, 0.0, 0.0, 0.0)
        }),
    ];
    for (name, change) in bad {
        let mut config = TwinConfig::preset(FlightPreset::Small);
        change(&mut config);
        let error = config.build().map(|_| ()).unwrap_err();
        assert_eq!(error.parameter, name, "{error}");
        assert!(error.to_string().contains("expected"), "{error}");
    }
}
