//! Tie points straight from geometry: their noise, gross errors and tracks are those asked for.

use crate::{moments, proportion_agrees};
use data_synth::{
    tie_points::{TiePoint, TiePointConfig},
    twin::{FlightPreset, Twin, TwinConfig},
};

fn twin(change: impl Fn(&mut TiePointConfig)) -> (Twin, Vec<TiePoint>) {
    let mut config = TwinConfig::preset(FlightPreset::Small);
    config.tie_points = TiePointConfig {
        per_photo: 150,
        sigma_px: 0.0,
        outlier_fraction: 0.0,
        ..config.tie_points
    };
    change(&mut config.tie_points);
    let twin = config.build().unwrap();
    let points = twin.tie_points();
    (twin, points)
}

#[test]
fn without_errors_measurements_are_projections() {
    let (twin, points) = twin(|_| ());
    assert!(points.len() > 140 * twin.shots.len(), "{}", points.len());
    for point in &points {
        assert!(point.seen.len() >= 2);
        assert!(point.seen.windows(2).all(|pair| pair[0].shot < pair[1].shot));
        let above_m =
            point.place_m[2] - twin.field().terrain.height_m(point.place_m[0], point.place_m[1]);
        assert!((-1e-5..0.2).contains(&above_m), "{above_m}");
        for sighting in &point.seen {
            let pixel = twin.shots[sighting.shot].project(&twin.camera, point.place_m).unwrap();
            assert_eq!(pixel, sighting.true_px);
            assert_eq!(pixel, sighting.measured_px);
            assert!(twin.camera.inside(pixel, 0.0));
        }
    }
}

#[test]
fn noise_outliers_and_tracks_are_those_asked_for_and_leave_the_truth_alone() {
    let (_, clean) = twin(|_| ());
    let (_, noisy) = twin(|config| config.sigma_px = 0.7);
    let (_, gross) = twin(|config| config.outlier_fraction = 0.1);
    let mut errors = Vec::new();
    for (a, b) in clean.iter().zip(&noisy) {
        assert_eq!(a.place_m, b.place_m);
        errors.extend(
            b.seen
                .iter()
                .flat_map(|s| [s.measured_px[0] - s.true_px[0], s.measured_px[1] - s.true_px[1]]),
        );
    }
    let (mean_px, deviation_px) = moments(&errors);
    let count = errors.len() as f64;
    assert!(mean_px.abs() < 4.0 * 0.7 / count.sqrt(), "{mean_px}");
    assert!((deviation_px / 0.7 - 1.0).abs() < 4.0 / (2.0 * count).sqrt(), "{deviation_px}");
    let sightings: Vec<_> = gross.iter().flat_map(|point| &point.seen).collect();
    let outliers = sightings.iter().filter(|s| s.outlier).count();
    assert!(proportion_agrees(outliers, sightings.len(), 0.1, 4.0), "{outliers}");
    for s in sightings {
        let away_px = f64::hypot(s.measured_px[0] - s.true_px[0], s.measured_px[1] - s.true_px[1]);
        let range = if s.outlier { 8.0 - 1e-9..40.0 + 1e-9 } else { 0.0..1e-9 };
        assert!(range.contains(&away_px), "{away_px}");
    }
}

#[test]
fn longer_tracks_are_longer() {
    let mean = |mean_track: f64| {
        let (_, points) = twin(|config| config.mean_track = mean_track);
        points.iter().map(|point| point.seen.len() as f64).sum::<f64>() / points.len() as f64
    };
    assert_eq!(mean(2.0), 2.0);
    let (usual, long) = (mean(3.0), mean(6.0));
    // Cut off where no further photo sees the point.
    assert!((2.5..=3.05).contains(&usual), "{usual}");
    assert!(long > usual + 0.5, "{long}");
}
