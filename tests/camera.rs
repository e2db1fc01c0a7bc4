//! Lens models: against OpenCV, against differences, against their own inverse.

use proptest::prelude::*;
use rowgram::camera::{Interior, Lens, Model, brown::Brown, lens::to_computer_vision, smac::Smac};

const SIZE_PX: [u32; 2] = [1280, 960];

/// A lens of each model with strong but sound distortion.
fn lenses() -> Vec<Interior> {
    let make = |model, values: &[f64]| Interior::new(model, SIZE_PX, values).unwrap();
    vec![
        make(Model::Smac, &[800.0, 3.0, -5.0, 0.0, 4e-7, 2e-13, -1e-20, 2e-6, -1e-6, 0.0]),
        make(Model::Smac, &[800.0, 3.0, -5.0, 2e-2, -2e-7, 1e-13, 0.0, 0.0, 0.0, 350.0]),
        make(
            Model::Brown,
            &[800.0, 1.002, 640.0, 470.0, -0.2, 0.05, 1e-3, -7e-4, -0.004, 0.0, 0.0, 0.0],
        ),
        make(
            Model::Brown,
            &[560.0, 0.998, 640.0, 470.0, 1.9, 0.31, 2e-4, -6e-4, 0.004, 2.17, 0.78, 0.041],
        ),
        make(Model::Fisheye, &[400.0, 1.001, 655.0, 470.0, 0.03, -0.012, 0.004, -6e-4]),
        make(Model::Bal, &[800.0, -0.12, 0.02]),
    ]
}

proptest! {
    #[test]
    fn projecting_a_pixels_ray_gives_the_pixel(
        u in 0.0..1280.0f64,
        v in 0.0..960.0f64,
        distance in 0.1..1e4f64,
    ) {
        for lens in lenses() {
            let ray = lens.unproject([u, v]).unwrap();
            let norm: f64 = ray.iter().map(|c| c * c).sum();
            prop_assert!((norm - 1.0).abs() < 1e-14);
            let back = lens.project(ray.map(|c| c * distance)).unwrap();
            for (a, b) in back.iter().zip([u, v]) {
                prop_assert!((a - b).abs() < 1e-10, "{:?}: {back:?}", lens.model());
            }
        }
    }

    #[test]
    fn a_place_to_begin_at_changes_no_image(
        u in 0.0..1280.0f64,
        v in 0.0..960.0f64,
        // As near as a measured position is, far off, and outside the picture.
        off in prop_oneof![-2.0..2.0f64, -200.0..200.0f64, -3000.0..3000.0f64],
        distance in 0.1..1e4f64,
    ) {
        for lens in lenses() {
            let point = lens.unproject([u, v]).unwrap().map(|c| c * distance);
            let (plain, near_px) = (lens.project(point).unwrap(), [u + off, v - off]);
            let near = lens.project_near(point, near_px).unwrap();
            let with = lens.project_with_derivatives_near(point, near_px).unwrap();
            let full = lens.project_with_derivatives(point).unwrap();
            for k in 0..2 {
                prop_assert!((near[k] - plain[k]).abs() < 1e-9, "{:?} {near:?}", lens.model());
                prop_assert!((with.image_px[k] - plain[k]).abs() < 1e-9);
                for (a, b) in with.by_point[k].iter().zip(&full.by_point[k]) {
                    prop_assert!((a - b).abs() <= 1e-9 * (1.0 + b.abs()), "{:?}", lens.model());
                }
            }
        }
    }

    #[test]
    fn derivatives_match_differences(
        u in 20.0..1260.0f64,
        v in 20.0..940.0f64,
        distance in 1.0..30.0f64,
    ) {
        for lens in lenses() {
            let point = lens.unproject([u, v]).unwrap().map(|c| c * distance);
            let found = lens.project_with_derivatives(point).unwrap();
            let plain = lens.project(point).unwrap();
            prop_assert!((0..2).all(|k| (found.image_px[k] - plain[k]).abs() < 1e-11));
            let compare = |analytic: [f64; 2], along: &dyn Fn(f64) -> [f64; 2], h: f64, what: &str| {
                let central = |h: f64| -> [f64; 2] {
                    let (high, low) = (along(h), along(-h));
                    [0, 1].map(|k| (high[k] - low[k]) / (2.0 * h))
                };
                let (wide, narrow) = (central(h), central(0.5 * h));
                for k in 0..2 {
                    let difference = (4.0 * narrow[k] - wide[k]) / 3.0;
                    // In pixels: what the differences' own rounding leaves.
                    let error = (analytic[k] - difference).abs() * h;
                    assert!(error < 1e-8, "{:?} {what}: {analytic:?} {difference}", lens.model());
                }
            };
            for axis in 0..3 {
                let along = |h: f64| {
                    let mut moved = point;
                    moved[axis] += h;
                    lens.project(moved).unwrap()
                };
                let analytic = [found.by_point[0][axis], found.by_point[1][axis]];
                compare(analytic, &along, 3e-4 * distance, &format!("point {axis}"));
            }
            for (place, parameter) in lens.parameters().iter().enumerate() {
                if !parameter.estimable {
                    continue;
                }
                let analytic = [found.by_parameters[0][place], found.by_parameters[1][place]];
                // A step that moves the image by a fraction of a pixel at its corner, where the
                // coefficients have most to say.
                let corner = lens.unproject([1200.0, 900.0]).unwrap();
                let there = lens.project_with_derivatives(corner).unwrap().by_parameters;
                let size = there[0][place].hypot(there[1][place]).max(1.0);
                let along = |h: f64| {
                    let mut values = lens.values().to_vec();
                    values[place] += h;
                    lens.with_values(&values).unwrap().project(point).unwrap()
                };
                compare(analytic, &along, 0.3 / size, parameter.name);
            }
            let rest = lens.parameters().len()..;
            prop_assert!(found.by_parameters.iter().all(|row| row[rest.clone()].iter().all(|&v| v == 0.0)));
        }
    }

    #[test]
    fn the_corrected_residual_vanishes_where_the_measured_one_does(
        u in 100.0..1180.0f64,
        v in 100.0..860.0f64,
    ) {
        let lens = &lenses()[0];
        let point = lens.unproject([u, v]).unwrap().map(|c| 7.0 * c);
        let zero = lens.corrected_residual(point, [u, v]).unwrap().image_px;
        prop_assert!(zero.iter().all(|r| r.abs() < 1e-10));
        // Half a pixel measured is about half a pixel corrected, in the same direction.
        let shifted = lens.corrected_residual(point, [u - 0.5, v]).unwrap();
        prop_assert!((shifted.image_px[0] - 0.5).abs() < 0.3 && shifted.image_px[1].abs() < 0.2);
        let h = 1e-3;
        for axis in 0..3 {
            let along = |h: f64| {
                let mut moved = point;
                moved[axis] += h;
                lens.corrected_residual(moved, [u - 0.5, v]).unwrap().image_px
            };
            let (high, low) = (along(h), along(-h));
            for k in 0..2 {
                let difference = (high[k] - low[k]) / (2.0 * h);
                prop_assert!((shifted.by_point[k][axis] - difference).abs() < 1e-4 * difference.abs().max(1.0));
            }
        }
        for place in 0..9 {
            let corner = lens.corrected_residual(point, [1200.0, 900.0]).unwrap().by_parameters;
            let h = 0.3 / corner[0][place].hypot(corner[1][place]).max(1.0);
            let along = |h: f64| {
                let mut values = lens.values().to_vec();
                values[place] += h;
                let moved = lens.with_values(&values).unwrap();
                moved.corrected_residual(point, [u - 0.5, v]).unwrap().image_px
            };
            let (high, low) = (along(h), along(-h));
            for k in 0..2 {
                let error = shifted.by_parameters[k][place] * h - 0.5 * (high[k] - low[k]);
                prop_assert!(error.abs() < 1e-6, "parameter {place}: {error}");
            }
        }
    }
}

#[test]
fn opencv_sees_the_same() {
    let text = include_str!("golden/lenses.txt");
    let mut count = 0;
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let (word, rest) = line.split_once(' ').unwrap();
        let numbers: Vec<f64> = rest.split(' ').map(|v| v.parse().unwrap()).collect();
        let model = Model::ALL.into_iter().find(|model| model.word() == word).unwrap();
        let (values, rest) = numbers.split_at(model.parameters().len());
        let lens = Interior::new(model, SIZE_PX, values).unwrap();
        let point = to_computer_vision([rest[0], rest[1], rest[2]]);
        let found = lens.project(point).unwrap();
        // Both compute in double precision; coordinates are below 1e4 pixels.
        assert!((0..2).all(|k| (found[k] - rest[3 + k]).abs() < 1e-9), "{line}: {found:?}");
        count += 1;
    }
    assert_eq!(count, 72);
}

#[test]
fn smac_does_what_its_equations_say() {
    // The equations of the image-to-ideal correction, written out once more.
    let [c, xp, yp, k0, k1, k2, k3, p1, p2, r0] =
        [800.0, 3.0, -5.0, 1e-3, 4e-7, 2e-13, -1e-20, 2e-6, -1e-6, 300.0];
    let lens = Smac::new([c, xp, yp, k0, k1, k2, k3, p1, p2, r0], [639.5, 479.5]);
    for (u, v) in [(10.0, 20.0), (640.0, 480.0), (1200.0, 100.0)] {
        let (x, y): (f64, f64) = (u - 639.5 - xp, 479.5 - v - yp);
        let r: f64 = x.hypot(y);
        let q = k0
            + k1 * (r.powi(2) - r0.powi(2))
            + k2 * (r.powi(4) - r0.powi(4))
            + k3 * (r.powi(6) - r0.powi(6));
        let ideal = [
            x + x * q + p1 * (r * r + 2.0 * x * x) + 2.0 * p2 * x * y,
            y + y * q + 2.0 * p1 * x * y + p2 * (r * r + 2.0 * y * y),
        ];
        let w = -25.0;
        let found = lens.project([-ideal[0] * w / c, -ideal[1] * w / c, w]).unwrap();
        assert!((found[0] - u).abs() < 1e-10 && (found[1] - v).abs() < 1e-10, "{found:?}");
    }
}

#[test]
fn there_is_no_image_outside_the_valid_radius_or_behind_the_camera() {
    for lens in lenses() {
        assert_eq!(lens.project([0.0, 0.0, 0.0]), None);
        assert_eq!(lens.project([0.0, 0.0, 1.0]), None, "{:?}", lens.model());
        assert_eq!(lens.project([f64::NAN, 0.0, -1.0]), None, "{:?}", lens.model());
        assert!(lens.project([0.0, 0.0, -1.0]).is_some());
    }
    // r (1 + K1 r^2) turns where 3 K1 r^2 = -1.
    let smac = Smac::new([800.0, 0.0, 0.0, 0.0, -1e-6, 0.0, 0.0, 0.0, 0.0, 0.0], [639.5, 479.5]);
    let turn = (1.0f64 / 3e-6).sqrt();
    assert!((smac.valid_radius_px() / turn - 1.0).abs() < 1e-12);
    let farthest = turn * (1.0 - 1e-6 * turn * turn);
    assert!(smac.project([0.999 * farthest, 0.0, -800.0]).is_some());
    assert_eq!(smac.project([1.001 * farthest, 0.0, -800.0]), None);
    assert_eq!(smac.unproject([639.5 + 1.001 * turn, 479.5]), None);
    // r (1 + k1 r^2) with k1 = -1/3 turns at 1.
    let mut values = [0.0; 12];
    (values[0], values[1], values[4]) = (500.0, 1.0, -1.0 / 3.0);
    let brown = Brown::new(values);
    assert!((brown.valid_radius() - 1.0).abs() < 1e-12);
    assert!(brown.project([0.999, 0.0, -1.0]).is_some());
    assert_eq!(brown.project([1.001, 0.0, -1.0]), None);
    // A fisheye sees sideways and a little behind.
    let fisheye = lenses()[4];
    assert!(fisheye.project([1.0, 0.0, 0.1]).is_some());
}

#[test]
fn values_that_mean_nothing_are_refused() {
    let smac =
        |values: &[f64]| Interior::new(Model::Smac, SIZE_PX, values).unwrap_err().to_string();
    assert!(smac(&[800.0]).contains("10 parameters, 1 values"));
    let mut values = [0.0; 10];
    assert!(smac(&values).contains("c_px is 0"));
    values[0] = 800.0;
    values[4] = f64::NAN;
    assert!(smac(&values).contains("K1 is NaN"));
}
