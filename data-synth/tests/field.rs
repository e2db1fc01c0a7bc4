//! The truth lies where the configuration says.

use crate::{moments, proportion_agrees};
use data_synth::field::{DOUBLE_DISTANCE_M, Field, FieldConfig, GrowthStage, Phyllotaxy, Plant};
use proptest::prelude::*;

/// A field large enough for statistics: about 5,000 sites.
fn large() -> FieldConfig {
    FieldConfig {
        rows: 50,
        row_length_m: 20.0,
        heading_deg: 25.0,
        stage: GrowthStage::Early,
        gsd_m: 0.05,
        ..FieldConfig::default()
    }
}

fn axes(field: &Field, plant: &Plant) -> [f64; 2] {
    field.config.along_across(plant.x_m, plant.y_m)
}

#[test]
fn without_randomness_plants_stand_at_their_sites() {
    let config = FieldConfig {
        jitter_along: 0.0,
        jitter_across_m: 0.0,
        missing_fraction: 0.0,
        doubles_fraction: 0.0,
        curve_m: 0.2,
        grid: true,
        ..large()
    };
    let field = Field::plant(&config).unwrap();
    assert_eq!(field.plants.len(), 50 * 100);
    let phase_m = axes(&field, &field.plants[0])[0];
    for plant in &field.plants {
        let [along_m, across_m] = axes(&field, plant);
        let expected_m = phase_m + plant.site as f64 * config.spacing_m;
        approx::assert_abs_diff_eq!(along_m, expected_m, epsilon = 1e-9);
        let bow_m = 0.2 * (1.0 - (along_m / 10.0).powi(2));
        let row_m = (plant.row as f64 - 24.5) * config.inter_row_m + bow_m;
        approx::assert_abs_diff_eq!(across_m, row_m, epsilon = 1e-9);
        assert!((-10.0..=10.0).contains(&along_m));
    }
}

#[test]
fn jitter_has_the_deviations_that_were_asked_for() {
    let config = FieldConfig {
        jitter_along: 0.2,
        jitter_across_m: 0.03,
        missing_fraction: 0.0,
        doubles_fraction: 0.0,
        grid: true,
        ..large()
    };
    let field = Field::plant(&config).unwrap();
    let still = Field::plant(&FieldConfig { jitter_along: 0.0, jitter_across_m: 0.0, ..config });
    let still = still.unwrap();
    let moved: Vec<[f64; 2]> = field
        .plants
        .iter()
        .zip(&still.plants)
        .map(|(a, b)| {
            let ([s, t], [s0, t0]) = (axes(&field, a), axes(&still, b));
            [s - s0, t - t0]
        })
        .collect();
    for (axis, expected_m) in [(0, 0.2 * 0.2), (1, 0.03)] {
        let (mean_m, deviation_m) = moments(&moved.iter().map(|m| m[axis]).collect::<Vec<_>>());
        let count = moved.len() as f64;
        assert!(mean_m.abs() < 4.0 * expected_m / count.sqrt(), "{mean_m}");
        assert!((deviation_m / expected_m - 1.0).abs() < 4.0 / (2.0 * count).sqrt());
    }
}

#[test]
fn missing_and_doubles_come_as_often_as_they_should() {
    let config = FieldConfig { missing_fraction: 0.2, doubles_fraction: 0.1, ..large() };
    let field = Field::plant(&config).unwrap();
    let firsts = field.plants.iter().filter(|plant| !plant.second).count();
    let seconds = field.plants.len() - firsts;
    assert!(proportion_agrees(firsts, 5000, 0.8, 4.0), "{firsts}");
    assert!(proportion_agrees(seconds, firsts, 0.1, 4.0), "{seconds}");
    for pair in field.plants.windows(2).filter(|pair| pair[1].second) {
        assert_eq!((pair[0].row, pair[0].site), (pair[1].row, pair[1].site));
        let apart_m = f64::hypot(pair[0].x_m - pair[1].x_m, pair[0].y_m - pair[1].y_m);
        assert!((DOUBLE_DISTANCE_M.0..=DOUBLE_DISTANCE_M.1).contains(&apart_m), "{apart_m}");
    }
}

#[test]
fn one_parameter_moves_only_what_depends_on_it() {
    let full = Field::plant(&FieldConfig { missing_fraction: 0.0, ..large() }).unwrap();
    let gaps = Field::plant(&FieldConfig { missing_fraction: 0.4, ..large() }).unwrap();
    let mut rest = full.plants.iter();
    for plant in &gaps.plants {
        let same = rest.any(|other| {
            (other.row, other.site, other.second) == (plant.row, plant.site, plant.second)
                && (other.x_m, other.y_m) == (plant.x_m, plant.y_m)
                && other.leaves == plant.leaves
        });
        assert!(same, "a plant that was not there before");
    }
    let wide = Field::plant(&FieldConfig { gsd_m: 0.01, margin_m: 2.0, ..large() }).unwrap();
    let base = Field::plant(&large()).unwrap();
    let places = |field: &Field| field.plants.iter().map(|p| (p.x_m, p.y_m)).collect::<Vec<_>>();
    assert_eq!(places(&wide), places(&base));
}

#[test]
fn rows_start_together_only_in_a_grid() {
    for grid in [false, true] {
        let config = FieldConfig { grid, jitter_along: 0.0, ..large() };
        let field = Field::plant(&config).unwrap();
        let phases: Vec<f64> = field
            .plants
            .iter()
            .filter(|plant| !plant.second)
            .map(|plant| axes(&field, plant)[0] - plant.site as f64 * config.spacing_m)
            .collect();
        let (_, deviation_m) = moments(&phases);
        if grid {
            assert!(deviation_m < 1e-9);
        } else {
            // Uniform over one spacing.
            assert!((deviation_m - 0.2 / 12f64.sqrt()).abs() < 0.01, "{deviation_m}");
        }
    }
}

#[test]
fn stalks_lean_as_far_as_asked_and_carry_their_leaves() {
    let field = Field::plant(&FieldConfig { tilt_m: 0.05, ..large() }).unwrap();
    let squares: Vec<f64> = field
        .plants
        .iter()
        .map(|plant| plant.tilt_m[0].powi(2) + plant.tilt_m[1].powi(2))
        .collect();
    let rms_m = moments(&squares).0.sqrt();
    assert!((rms_m / 0.05 - 1.0).abs() < 0.04, "{rms_m}");
    for plant in &field.plants {
        let top = plant.leaves.last().unwrap().axis_m[0];
        approx::assert_abs_diff_eq!(top[0], plant.x_m + plant.tilt_m[0], epsilon = 1e-12);
        approx::assert_abs_diff_eq!(top[1], plant.y_m + plant.tilt_m[1], epsilon = 1e-12);
    }
}

#[test]
fn a_field_of_missing_plants_is_bare() {
    let field = Field::plant(&FieldConfig { missing_fraction: 1.0, ..large() }).unwrap();
    assert!(field.plants.is_empty());
    assert!(data_synth::render::mask(&field, &[]).iter().all(|&pixel| pixel == 0));
}

#[test]
fn every_bad_parameter_is_named() {
    type Change = fn(&mut FieldConfig);
    let bad: [(&str, Change); 20] = [
        ("seed", |c| c.seed = u64::MAX),
        ("rows", |c| c.rows = 0),
        ("rows", |c| (c.rows, c.row_length_m) = (100_000, 10_000.0)),
        ("row_length_m", |c| c.row_length_m = f64::NAN),
        ("row_length_m", |c| c.row_length_m = -5.0),
        ("inter_row_m", |c| c.inter_row_m = 0.0),
        ("spacing_m", |c| c.spacing_m = 0.0),
        ("spacing_m", |c| c.spacing_m = f64::INFINITY),
        ("jitter_along", |c| c.jitter_along = -0.1),
        ("jitter_across_m", |c| c.jitter_across_m = f64::NAN),
        ("missing_fraction", |c| c.missing_fraction = 1.1),
        ("doubles_fraction", |c| c.doubles_fraction = -0.1),
        ("curve_m", |c| c.curve_m = f64::NEG_INFINITY),
        ("heading_deg", |c| c.heading_deg = 1e9),
        ("tilt_m", |c| c.tilt_m = -0.01),
        ("gsd_m", |c| c.gsd_m = 0.0),
        ("gsd_m", |c| c.gsd_m = -0.015),
        ("gsd_m", |c| (c.gsd_m, c.row_length_m) = (0.0005, 1000.0)),
        ("margin_m", |c| c.margin_m = -1.0),
        ("margin_m", |c| c.margin_m = f64::NAN),
    ];
    for (name, change) in bad {
        let mut config = FieldConfig::default();
        change(&mut config);
        let error = Field::plant(&config).unwrap_err();
        assert_eq!(error.parameter, name, "{error}");
        assert!(error.to_string().contains("expected"), "{error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever the configuration: every stalk lies in the picture, on the mask to within a pixel where
    /// stalks stand upright, and the two positions of each plant agree.
    #[test]
    fn stalks_are_where_their_pixels_are(
        seed in 0u64..1 << 40,
        rows in 1usize..5,
        row_length_m in 0.1..3.0,
        spacing_m in 0.05..0.5,
        jitter_along in 0.0..1.0,
        heading_deg in -360.0..360.0,
        curve_m in -0.3..0.3,
        gsd_m in 0.005..0.05,
        margin_m in 0.0..0.5,
        stage in prop::sample::select(vec![GrowthStage::Early, GrowthStage::Mid, GrowthStage::Late]),
        phyllotaxy in prop::sample::select(vec![Phyllotaxy::Distichous, Phyllotaxy::Random]),
    ) {
        let config = FieldConfig {
            seed, rows, row_length_m, spacing_m, jitter_along, heading_deg, curve_m, gsd_m,
            margin_m, stage, phyllotaxy, ..FieldConfig::default()
        };
        let field = Field::plant(&config).unwrap();
        let mask = data_synth::render::mask(&field, &[]);
        prop_assert_eq!(mask.dimensions(), (field.frame.width_px, field.frame.height_px));
        for plant in &field.plants {
            let [x_m, y_m] = field.frame.ground(plant.u_px, plant.v_px);
            prop_assert!((x_m - plant.x_m).abs() < 1e-9 && (y_m - plant.y_m).abs() < 1e-9);
            prop_assert!(plant.u_px >= -1e-6 && plant.v_px >= -1e-6);
            let (u, v) = (plant.u_px.round() as u32, plant.v_px.round() as u32);
            prop_assert!(u < mask.width() && v < mask.height());
            // A leaf that begins in the corner of a large pixel may show in the next pixel only.
            let near = |centre: u32, size: u32| centre.saturating_sub(1)..(centre + 2).min(size);
            let mut around = near(u, mask.width())
                .flat_map(|u| near(v, mask.height()).map(move |v| (u, v)));
            prop_assert!(around.any(|(u, v)| mask.get_pixel(u, v).0 == [255]));
        }
    }
}
