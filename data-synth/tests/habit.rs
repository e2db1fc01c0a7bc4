//! What a habit adds to a field comes as often as asked, and plots and terrain are where they should be.

use crate::proportion_agrees;
use data_synth::{
    corrupt::Corruption,
    field::{Field, FieldConfig},
    habit::{Habit, PlotConfig},
    terrain::TerrainConfig,
};

fn field(change: impl Fn(&mut FieldConfig)) -> Field {
    let mut config =
        FieldConfig { rows: 40, row_length_m: 16.0, gsd_m: 0.05, ..FieldConfig::default() };
    change(&mut config);
    Field::plant(&config).unwrap()
}

/// Everything of a plant that a habit must not touch.
fn stands(field: &Field) -> Vec<(f64, f64, usize)> {
    field.plants.iter().map(|plant| (plant.x_m, plant.y_m, plant.plot)).collect()
}

#[test]
fn tillers_panicles_and_dying_leaves_come_as_often_as_asked() {
    let plain = field(|_| ());
    assert!(plain.plants.iter().all(|plant| plant.stalks.len() == 1));
    let grown = field(|c| {
        c.habit = Habit {
            tiller_fraction: 0.3,
            panicle_fraction: 0.4,
            senescent_fraction: 0.25,
            ..c.habit.clone()
        }
    });
    assert_eq!(stands(&plain), stands(&grown));
    let tillered = grown.plants.iter().filter(|plant| plant.stalks.len() > 1).count();
    assert!(proportion_agrees(tillered, grown.plants.len(), 0.3, 4.0), "{tillered}");
    assert!(grown.plants.iter().all(|plant| plant.stalks.len() <= 3));
    let stalks: Vec<_> = grown.plants.iter().flat_map(|plant| &plant.stalks).collect();
    let panicles = stalks.iter().filter(|stalk| stalk.panicle_m > 0.0).count();
    assert!(proportion_agrees(panicles, stalks.len(), 0.4, 4.0), "{panicles}");
    let (mut low, mut dying) = (0, 0);
    for plant in &grown.plants {
        for stalk in 0..plant.stalks.len() as u32 {
            let leaves: Vec<_> = plant.leaves.iter().filter(|leaf| leaf.stalk == stalk).collect();
            let third = leaves.len().div_ceil(3);
            low += third;
            dying += leaves.iter().take(third).filter(|leaf| leaf.senescent).count();
            assert!(leaves.iter().skip(third).all(|leaf| !leaf.senescent));
        }
        // The main stalk's leaves are the same as without a habit.
        let before =
            &plain.plants.iter().find(|p| (p.x_m, p.y_m) == (plant.x_m, plant.y_m)).unwrap().leaves;
        assert!(before.iter().zip(&plant.leaves).all(|(a, b)| a.axis_m == b.axis_m));
    }
    assert!(proportion_agrees(dying, low, 0.25, 4.0), "{dying} of {low}");
}

#[test]
fn dying_leaves_leave_the_mask_and_the_picture_says_so_too() {
    let mut scenario = data_synth::scenario::Scenario::default();
    let green = scenario.build().unwrap().mask();
    scenario.field.habit.senescent_fraction = 1.0;
    let (mask, picture) = scenario.build().unwrap().mask_and_picture();
    assert!(mask.iter().zip(green.iter()).all(|(after, before)| after <= before));
    let count = |mask: &image::GrayImage| mask.iter().filter(|&&pixel| pixel == 255).count() as f64;
    // The lowest third of the leaves, two of five to seven, partly below others.
    let part = count(&mask) / count(&green);
    assert!((0.6..0.9).contains(&part), "{part}");
    for (pixel, colour) in mask.pixels().zip(picture.pixels()) {
        let [r, g, b] = colour.0;
        assert_eq!(pixel.0 == [255], g > r && g > b, "{colour:?}");
    }
}

#[test]
fn leaf_planes_follow_the_preferred_direction() {
    let follows = |preference: f64| {
        let field = field(|c| {
            c.heading_deg = 30.0;
            c.habit.azimuth_preference = preference;
        });
        // Doubled angles against the direction across the rows, 120 degrees.
        let cosines =
            field.leaves().map(|leaf| (2.0 * (leaf.azimuth_rad - 120f64.to_radians())).cos());
        cosines.sum::<f64>() / field.leaves().count() as f64
    };
    // Scatter of 20 degrees between plants and 25 within leaves exp(-2 (0.35^2 + 0.44^2)) = 0.53.
    assert!(follows(0.0).abs() < 0.03, "{}", follows(0.0));
    assert!((follows(1.0) - 0.53).abs() < 0.03, "{}", follows(1.0));
    assert!((follows(0.5) - 0.27).abs() < 0.04, "{}", follows(0.5));
}

#[test]
fn hues_spread_as_asked() {
    let spread = |hue_spread: f64| {
        let field = field(|c| c.habit.hue_spread = hue_spread);
        crate::moments(&field.leaves().map(|leaf| leaf.hue_deg).collect::<Vec<_>>()).1
    };
    // 4 degrees between plants and 3 within, beside what comes with a leaf's height.
    assert!(spread(0.0) < 2.0);
    assert!((4.5..6.0).contains(&spread(1.0)), "{}", spread(1.0));
}

#[test]
fn plots_divide_the_field_and_alleys_are_bare() {
    let plots = PlotConfig { rows: 8, length_m: 4.0, alley_m: 2.0 };
    let field = field(|c| {
        c.plots = plots.clone();
        c.jitter_along = 0.0;
    });
    assert_eq!(plots.count(40, 16.0), [5, 3]);
    let mut counts = [0; 15];
    for plant in &field.plants {
        let [along_m, _] = field.config.along_across(plant.x_m, plant.y_m);
        let from_start_m = along_m + 8.0;
        let within_m = from_start_m.rem_euclid(6.0);
        // The second plant of a pair may lie up to 6 cm beyond.
        assert!(within_m <= 4.06 || within_m >= 5.94, "{from_start_m}");
        counts[plant.plot] += 1;
        assert_eq!(plant.plot / 3, plant.row / 8);
    }
    // 8 rows of 20 sites, 5 % missing, 3 % doubled.
    assert!(counts.iter().all(|&count| (130..=180).contains(&count)), "{counts:?}");
}

#[test]
fn plants_stand_on_the_ground_and_leaves_above_it() {
    let field = field(|c| {
        c.rows = 8;
        c.curve_m = 0.1;
        c.terrain = TerrainConfig {
            slope_percent: 5.0,
            slope_direction_deg: 30.0,
            relief_m: 0.3,
            relief_wavelength_m: 8.0,
            furrow_m: 0.1,
        };
    });
    let flat =
        Field::plant(&FieldConfig { terrain: TerrainConfig::default(), ..field.config.clone() })
            .unwrap();
    assert_eq!(stands(&field), stands(&flat), "terrain moves no plant");
    for plant in &field.plants {
        assert_eq!(plant.z_m, field.terrain.height_m(plant.x_m, plant.y_m));
        for leaf in &plant.leaves {
            for [x, y, z] in field.leaf_axis_m(plant.z_m, leaf) {
                assert!(z > field.terrain.height_m(x, y));
            }
        }
    }
}

#[test]
fn weeds_are_grasses_as_often_as_asked() {
    let field = field(|_| ());
    let weeds = |grass_share: f64| {
        Corruption { weeds_per_m2: 3.0, grass_share, ..Corruption::default() }.weeds(&field)
    };
    let mixed = weeds(0.4);
    let grasses = mixed.iter().filter(|weed| weed.grass).count();
    assert!(proportion_agrees(grasses, mixed.len(), 0.4, 4.0), "{grasses} of {}", mixed.len());
    assert!(weeds(0.0).iter().all(|weed| !weed.grass));
    for (a, b) in weeds(0.0).iter().zip(&mixed) {
        assert_eq!((a.x_m, a.y_m), (b.x_m, b.y_m));
        if b.grass {
            assert!(
                b.leaves.iter().all(|leaf| leaf.length_m > 4.0 * leaf.width_m),
                "leaf-like axes"
            );
        }
    }
}
