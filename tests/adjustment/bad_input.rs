//! What is wrong with a survey is named; what cannot take part is set aside, nothing is lost.

use super::toy::{NOISE, Plan, measured, truth};
use rowgram::problems::adjustment::{Settings, adjust, validate};
use rowgram::scene::{Reconstruction, Role};

fn block() -> Reconstruction {
    measured(&truth(&Plan { tie_points: 60, ..Plan::default() }), 2, NOISE)
}

#[test]
fn what_is_wrong_is_named() {
    type Damage = fn(&mut Reconstruction);
    let cases: [(Damage, &str); 15] = [
        (|s| s.observations[7].image_px[0] = f64::NAN, "tie point 10"),
        (
            |s| s.images[2].pose.translation[1] = f64::NAN,
            "image IMG_0003.JPG: its pose or its motion is not finite",
        ),
        (|s| s.images[0].expected_motion[4] = f64::NAN, "IMG_0001.JPG: its pose or its motion"),
        (
            |s| s.cameras[0].expected = Some(vec![1.0]),
            "expected has 1 entries, expected one for each",
        ),
        (|s| s.cameras[0].free.truncate(2), "free has 2 entries, expected one for each"),
        (|s| s.images[2].pose.rotation = [2.0, 0.0, 0.0, 0.0], "unit quaternion"),
        (|s| s.ground[1].position_m[0] = f64::INFINITY, "ground point G01"),
        (|s| s.ground[1].sigma_m[2] = 0.0, "expected positive numbers"),
        (|s| s.marks.push(s.marks[3]), "marked twice in image"),
        (|s| s.marks[3].sigma_px = -1.0, "expected a positive number"),
        (|s| s.ground[1].name = "G00".into(), "two ground points are called G00"),
        (|s| s.images[1].name = "IMG_0001.JPG".into(), "two images are called IMG_0001.JPG"),
        (|s| s.tie_sigma_px = 0.0, "standard deviation of tie points is 0 px"),
        (|s| s.images.clear(), "there are no images"),
        (|s| s.points[4].position_m[2] = f64::NAN, "tie point 104"),
    ];
    for (damage, part) in cases {
        let mut survey = block();
        damage(&mut survey);
        let message = validate(&survey).unwrap_err().to_string();
        assert!(message.contains(part), "{part}: {message}");
    }
}

#[test]
fn what_cannot_take_part_is_set_aside_by_name() {
    let mut survey = block();
    // An image with one observation.
    let mut left = 1;
    survey.observations.retain(|o| o.image != 0 || std::mem::replace(&mut left, 0) > 0);
    survey.marks.retain(|mark| mark.image != 0);
    // A point above the cameras, one seen once, a mark that is nowhere near, a point measured twice.
    survey.points[5].position_m[2] += 500.0;
    let mut first = true;
    survey.observations.retain(|o| o.point != 6 || std::mem::take(&mut first));
    let twice = *survey.observations.iter().find(|o| o.point == 7 && o.image != 0).unwrap();
    survey.observations.push(twice);
    let lonely = survey.ground.iter().position(|point| point.role == Role::Check).unwrap();
    let mut first = true;
    survey.marks.retain(|m| m.ground as usize != lonely || std::mem::take(&mut first));
    let before = survey.clone();
    let adjusted = adjust(&mut survey, &Settings::default()).unwrap();
    let told: Vec<String> = adjusted.validated.excluded.iter().map(ToString::to_string).collect();
    let all = told.join("\n");
    for part in [
        "image IMG_0001.JPG: it has",
        "tie point 105",
        "the point is behind the camera",
        "tie point 106: 1 image(s) see it, two are needed",
        "the point is measured twice in this image",
        &format!(
            "ground point {}: it is marked in 1 image(s), 2 needed",
            before.ground[lonely].name
        ),
    ] {
        assert!(all.contains(part), "{part}:\n{all}");
    }
    // It is all still there.
    assert_eq!(survey.images.len(), before.images.len());
    assert_eq!(survey.points.len(), before.points.len());
    assert_eq!(survey.images[0], before.images[0]);
    assert_ne!(survey.images[1], before.images[1]);
}

#[test]
fn a_block_of_nothing_says_why() {
    let mut survey = block();
    // The convention of another program: everything is behind its camera.
    for image in &mut survey.images {
        let turn = rowgram::geometry::rotation::exp([std::f64::consts::PI, 0.0, 0.0]);
        image.pose = rowgram::scene::Pose::from_centre(
            rowgram::geometry::rotation::multiply(turn, image.pose.rotation),
            image.pose.centre_m(),
        );
    }
    let message = validate(&survey).unwrap_err().to_string();
    assert!(
        message.contains("no image is left") && message.contains("behind the camera"),
        "{message}"
    );
}

#[test]
fn a_turn_while_a_photo_is_read_is_refused() {
    let plan = Plan { tie_points: 60, velocity_m_s: Some(8.0), ..Plan::default() };
    let mut survey = measured(&truth(&plan), 2, NOISE);
    assert!(validate(&survey).is_ok());
    survey.images[1].motion[2] = 0.01;
    let message = validate(&survey).unwrap_err().to_string();
    assert!(
        message.contains("image IMG_0002.JPG: its motion has a rotation during readout"),
        "{message}"
    );
}
