//! Each corruption alone does what it says, and none touches the truth.

use crate::proportion_agrees;
use data_synth::{
    corrupt::Corruption,
    field::{FieldConfig, GrowthStage},
    render,
    scenario::{Preset, Scenario, Scene},
};

fn scene(corruption: Corruption) -> Scene {
    let field = FieldConfig { stage: GrowthStage::Early, ..FieldConfig::default() };
    Scenario { field, corruption }.build().unwrap()
}

fn area_m2(scene: &Scene) -> f64 {
    let frame = &scene.field.frame;
    f64::from(frame.width_px) * f64::from(frame.height_px) * frame.gsd_m.powi(2)
}

#[test]
fn truth_does_not_change() {
    let clean = scene(Corruption::default());
    let dirty = scene(Corruption {
        weeds_per_m2: 20.0,
        grass_share: 0.5,
        false_fraction: 0.1,
        missed_fraction: 0.2,
    });
    assert_eq!(clean.field, dirty.field);
    assert_eq!(clean.mask(), render::mask(&clean.field, &[]), "nothing by default");
    assert_ne!(clean.mask(), dirty.mask());
}

#[test]
fn weeds_come_in_their_number_and_only_add_leaf() {
    let clean = scene(Corruption::default());
    let weedy = scene(Corruption { weeds_per_m2: 10.0, ..Corruption::default() });
    assert_eq!(weedy.weeds.len() as f64, (10.0 * area_m2(&weedy)).round());
    let (before, after) = (clean.mask(), weedy.mask());
    assert!(before.iter().zip(after.iter()).all(|(b, a)| b <= a));
    let added = before.iter().zip(after.iter()).filter(|(b, a)| b < a).count();
    let per_weed_cm2 = added as f64 * 2.25 / weedy.weeds.len() as f64;
    assert!((20.0..80.0).contains(&per_weed_cm2), "{per_weed_cm2} cm2");
    // Spread over the whole picture: as many left as right, above as below.
    let left = weedy.weeds.iter().filter(|weed| weed.x_m < 0.0).count();
    let above = weedy.weeds.iter().filter(|weed| weed.y_m > 0.0).count();
    for half in [left, above] {
        assert!(proportion_agrees(half, weedy.weeds.len(), 0.5, 5.0), "{half}");
    }
}

#[test]
fn false_pixels_come_on_bare_ground_only() {
    let clean = scene(Corruption::default()).mask();
    let spoilt = scene(Corruption { false_fraction: 0.02, ..Corruption::default() }).mask();
    let bare = clean.iter().filter(|&&pixel| pixel == 0).count();
    let gained = clean.iter().zip(spoilt.iter()).filter(|(b, a)| b < a).count();
    let lost = clean.iter().zip(spoilt.iter()).filter(|(b, a)| b > a).count();
    assert_eq!(lost, 0);
    assert!(proportion_agrees(gained, bare, 0.02, 4.0), "{gained} of {bare}");
}

#[test]
fn missed_pixels_come_on_leaves_only() {
    let clean = scene(Corruption::default()).mask();
    let spoilt = scene(Corruption { missed_fraction: 0.3, ..Corruption::default() }).mask();
    let leaf = clean.iter().filter(|&&pixel| pixel == 255).count();
    let gained = clean.iter().zip(spoilt.iter()).filter(|(b, a)| b < a).count();
    let lost = clean.iter().zip(spoilt.iter()).filter(|(b, a)| b > a).count();
    assert_eq!(gained, 0);
    assert!(proportion_agrees(lost, leaf, 0.3, 4.0), "{lost} of {leaf}");
}

#[test]
fn corruptions_do_not_disturb_each_other() {
    let dirty = Scenario::preset(Preset::Mid20Dirty);
    let mut only_weeds = dirty.clone();
    only_weeds.corruption.false_fraction = 0.0;
    only_weeds.corruption.missed_fraction = 0.0;
    let (dirty, only_weeds) = (dirty.build().unwrap(), only_weeds.build().unwrap());
    assert_eq!(dirty.weeds, only_weeds.weeds);
}

#[test]
fn the_picture_changes_only_where_the_mask_does() {
    let clean = scene(Corruption::default());
    let spoilt =
        scene(Corruption { false_fraction: 0.02, missed_fraction: 0.1, ..Corruption::default() });
    let ((mask, picture), (spoilt_mask, spoilt_picture)) =
        (clean.mask_and_picture(), spoilt.mask_and_picture());
    let pixels = mask.pixels().zip(spoilt_mask.pixels());
    for ((before, after), (b, a)) in pixels.zip(picture.pixels().zip(spoilt_picture.pixels())) {
        assert_eq!(before == after, b == a);
    }
}

#[test]
fn every_bad_parameter_is_named() {
    for value in [-0.1, 1e9, f64::NAN] {
        for (name, corruption) in [
            ("weeds_per_m2", Corruption { weeds_per_m2: value, ..Corruption::default() }),
            ("grass_share", Corruption { grass_share: value, ..Corruption::default() }),
            ("false_fraction", Corruption { false_fraction: value, ..Corruption::default() }),
            ("missed_fraction", Corruption { missed_fraction: value, ..Corruption::default() }),
        ] {
            let scenario = Scenario { corruption, ..Scenario::default() };
            assert_eq!(scenario.build().unwrap_err().parameter, name);
        }
    }
}
