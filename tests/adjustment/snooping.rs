//! Blunders, wrong control points, one left out at a time, variance components.

use super::toy::{NOISE, Noise, Plan, measured, truth, with_positions};
use rowgram::problems::adjustment::{
    DataSnoopingOptions, Group, OutlierTest, Settings, adjust, leave_one_out, retained_suspects,
    snoop, variance_components,
};
use rowgram::scene::Role;

#[test]
fn a_planted_blunder_is_found_and_nothing_else() {
    let truth = with_positions(truth(&Plan::default()));
    for (kind, test) in
        [("tie", OutlierTest::Pope), ("mark", OutlierTest::Baarda), ("position", OutlierTest::Pope)]
    {
        let mut survey = measured(&truth, 31, NOISE);
        let expected = match kind {
            "tie" => {
                // A point in many images, so that its blunder can be told from theirs.
                let rays = |p: u32| survey.observations.iter().filter(|o| o.point == p).count();
                let point = (0..150u32).max_by_key(|&p| rays(p)).unwrap();
                let k = survey.observations.iter().position(|o| o.point == point).unwrap();
                survey.observations[k].image_px[1] += 12.0 * 0.4;
                let image = &survey.images[survey.observations[k].image as usize].name;
                format!("tie point {} in {image}", 100 + point)
            }
            "mark" => {
                survey.marks[6].image_px[0] -= 15.0 * 0.3;
                let mark = survey.marks[6];
                format!(
                    "mark of {} in {}",
                    survey.ground[mark.ground as usize].name,
                    survey.images[mark.image as usize].name
                )
            }
            _ => {
                survey.positions[4].position_m[2] += 1.5;
                format!("camera position of {}", survey.images[4].name)
            }
        };
        let found = adjust(&mut survey.clone(), &Settings::default()).unwrap();
        let (worst, _) = found.statistics.rejected(test, |_| 0.001)[0];
        assert_eq!(found.name(found.statistics.tested[worst].subject), expected);
        let snooping = DataSnoopingOptions { test, ..DataSnoopingOptions::default() };
        let snooped = snoop(&mut survey, &Settings::default(), &snooping).unwrap();
        let names: Vec<&str> =
            snooped.removed.iter().map(|removed| removed.name.as_str()).collect();
        assert_eq!(names, [expected.as_str()]);
        assert!(snooped.complete && snooped.removed[0].excess > 1.0);
    }
}

#[test]
fn a_wrong_control_point_is_named_not_averaged_in() {
    let truth = truth(&Plan::default());
    let mut good = measured(&truth, 41, NOISE);
    let mut bad = good.clone();
    let wrong = bad.ground.iter().position(|point| point.role == Role::Control).unwrap() + 3;
    assert_eq!(bad.ground[wrong].role, Role::Control);
    bad.ground[wrong].position_m[0] += 0.6;
    bad.ground[wrong].position_m[2] -= 0.8;
    let name = format!("control point {}", bad.ground[wrong].name);
    let averaged = adjust(&mut bad.clone(), &Settings::default()).unwrap();
    let mut worse = bad.clone();
    let snooped = snoop(&mut bad, &Settings::default(), &DataSnoopingOptions::default()).unwrap();
    assert_eq!(snooped.removed.len(), 1, "{:?}", snooped.removed);
    assert_eq!(snooped.removed[0].name, name);
    let residual = snooped.removed[0].residual;
    assert!(residual[0] < -0.05 && residual[2] > 0.05, "{residual:?}");
    // How far off it is was told before it went.
    let error = snooped.removed[0].error;
    assert!((error[0] - 0.6).abs() < 0.1 && (error[2] + 0.8).abs() < 0.15, "{error:?}");
    // What is off by no more than a metre and more may be kept, and is named.
    let lenient = DataSnoopingOptions { least_error_m: 2.0, ..DataSnoopingOptions::default() };
    let settings = Settings::default();
    let kept = snoop(&mut worse.clone(), &settings, &lenient).unwrap();
    assert!(kept.complete && kept.removed.is_empty(), "{:?}", kept.removed);
    assert_eq!(retained_suspects(&kept.adjusted, &settings, &lenient)[0].name, name);
    let stricter = DataSnoopingOptions { least_error_m: 0.5, ..DataSnoopingOptions::default() };
    assert_eq!(snoop(&mut worse, &settings, &stricter).unwrap().removed[0].name, name);
    // It is a check point now, and its error is what was planted.
    let check = snooped.adjusted.check_points.iter().find(|check| check.ground == wrong).unwrap();
    assert!(
        (check.error_m[0] + 0.6).abs() < 0.1 && (check.error_m[2] - 0.8).abs() < 0.15,
        "{check:?}"
    );
    // The rest is as without it.
    good.ground[wrong].role = Role::Check;
    let clean = adjust(&mut good, &Settings::default()).unwrap();
    assert!((clean.statistics.sigma0 - snooped.adjusted.statistics.sigma0).abs() < 1e-6);
    assert!(averaged.statistics.sigma0 > 1.2 * clean.statistics.sigma0);
}

#[test]
fn control_is_kept_where_its_standard_deviations_are_too_small() {
    let plan = Plan { control: 12, checks: 2, ..Plan::default() };
    let rough = Noise { control: 5.0, ..NOISE };
    let mut survey = measured(&truth(&plan), 43, rough);
    let of_control = |removed: &[rowgram::problems::adjustment::Removed]| -> Vec<String> {
        let control = removed.iter().filter(|removed| removed.group == Group::Control);
        control.map(|removed| removed.name.clone()).collect()
    };
    // Taken at their word, good points would go one by one.
    let baarda =
        DataSnoopingOptions { test: OutlierTest::Baarda, ..DataSnoopingOptions::default() };
    let taken = snoop(&mut survey.clone(), &Settings::default(), &baarda).unwrap();
    assert!(of_control(&taken.removed).len() > 2, "{:?}", taken.removed);
    let pope = DataSnoopingOptions::default();
    let kept = snoop(&mut survey.clone(), &Settings::default(), &pope).unwrap();
    assert_eq!(of_control(&kept.removed), [""; 0]);
    // And still the one that is wrong is named.
    let wrong = survey.ground.iter().position(|point| point.role == Role::Control).unwrap() + 3;
    assert_eq!(survey.ground[wrong].role, Role::Control);
    survey.ground[wrong].position_m[1] += 3.0;
    let name = format!("control point {}", survey.ground[wrong].name);
    let found = snoop(&mut survey, &Settings::default(), &pope).unwrap();
    assert_eq!(of_control(&found.removed), [name]);
}

#[test]
fn each_control_point_is_predicted_by_the_others() {
    let truth = truth(&Plan { tie_points: 80, ..Plan::default() });
    let mut survey = measured(&truth, 51, NOISE);
    adjust(&mut survey, &Settings::default()).unwrap();
    let wrong = 4;
    assert_eq!(survey.ground[wrong].role, Role::Control);
    survey.ground[wrong].position_m[2] += 1.0;
    let found = leave_one_out(&survey, &Settings::default()).unwrap();
    assert_eq!(found.len(), 8);
    let worst = found.iter().max_by(|a, b| {
        let z = |l: &rowgram::problems::adjustment::LeaveOneOut| l.error_m.unwrap()[2].abs();
        z(a).total_cmp(&z(b))
    });
    let worst = worst.unwrap();
    assert_eq!(worst.name, survey.ground[wrong].name);
    assert!((worst.error_m.unwrap()[2] + 1.0).abs() < 0.3, "{worst:?}");
    // Its own adjustment is clean, so it is far out there.
    assert!(worst.error_m.unwrap()[2].abs() > 5.0 * worst.sigma_m.unwrap()[2], "{worst:?}");
}

#[test]
fn variance_components_recover_the_noise() {
    let plan =
        Plan { tie_points: 250, control: 14, checks: 2, columns: 5, rows: 4, ..Plan::default() };
    let truth = with_positions(truth(&plan));
    let noise = Noise { tie: 2.0, mark: 0.6, control: 1.0, position: 3.0 };
    let mut survey = measured(&truth, 61, noise);
    let found = variance_components(&mut survey, &Settings::default(), 15).unwrap();
    assert!(found.converged, "{:?}", found.settings.sigma_factors);
    let factor = |group: Group| found.settings.sigma_factors[group as usize];
    // One standard deviation of such a factor is 1/sqrt(2 r); control has little redundancy.
    for (group, expected, tolerance) in [
        (Group::TiePoints, 2.0, 0.1),
        (Group::Marks, 0.6, 0.1),
        (Group::Positions, 3.0, 0.9),
        (Group::Control, 1.0, 0.5),
    ] {
        let found = factor(group);
        assert!((found - expected).abs() < tolerance, "{}: {found}", group.name());
    }
    assert!((found.adjusted.statistics.sigma0 - 1.0).abs() < 0.02);
}
