//! Tracks that are made longer, on points whose images are known.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rowgram::{
    camera::{Camera, Interior, Lens, Model},
    geometry::rotation,
    scene::Pose,
    sfm::{
        Block, Features,
        longer_tracks::{MAX_RAYS, lengthen},
        tracks::Tracks,
    },
};

const IMAGES: usize = 4;

/// Which images have a point, as tracks, by its kind.
fn tracks_of_kind(kind: usize) -> &'static [&'static [usize]] {
    match kind {
        // The third and the fourth photo show it, but nobody found it there.
        0 => &[&[0, 1]],
        // One point, two tracks.
        1 => &[&[0, 1], &[2, 3]],
        // Nothing is missing.
        2 => &[&[0, 1, 2, 3]],
        // Two neighbours a pixel apart in the photo that has both.
        _ => &[&[0, 1], &[1, 2, 3]],
    }
}

fn seen(block: &Block<'_>, image: usize, point: [f64; 3]) -> [f64; 2] {
    block.lens(image).project(block.poses[image].unwrap().to_camera(point)).unwrap()
}

fn apart(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[test]
fn tracks_of_one_place_are_joined_and_go_on_where_photos_show_it() {
    let values = [500.0, 1.0, 199.5, 149.5, -0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let cameras = [Camera::new("drone", Interior::new(Model::Brown, [400, 300], &values).unwrap())];
    let nothing = vec![Features::default(); IMAGES];
    let empty = Tracks::default();
    let mut bare = Block::new(&nothing, &empty, &cameras);
    for image in 0..IMAGES {
        let turn = rotation::exp([0.03, -0.02 * image as f64, 0.1 * image as f64]);
        bare.poses[image] = Some(Pose::from_centre(turn, [1.2 * image as f64, 0.2, 15.0]));
    }
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut features = nothing.clone();
    let mut matches = Vec::new();
    let mut points = Vec::new();
    for k in 0..96 {
        // Twenty pixels apart.
        let mut jitter = || rng.random_range(-0.1..0.1);
        let (x, y) = (-2.0 + 0.6 * f64::from(k % 12), -2.5 + 0.7 * f64::from(k / 12));
        let point = [x + jitter(), y + jitter(), 0.0];
        let kind = (k as usize / 3) % 4;
        let seen: Vec<[f64; 2]> = (0..IMAGES).map(|image| seen(&bare, image, point)).collect();
        let off = |at: &[f64; 2]| at[0] < 12.0 || at[1] < 12.0 || at[0] > 387.0 || at[1] > 287.0;
        if seen.iter().any(off) {
            continue;
        }
        for (second, members) in tracks_of_kind(kind).iter().enumerate() {
            let mut track = Vec::new();
            for &image in *members {
                let mut noise = || rng.random_range(-0.1..0.1);
                let beside = if kind == 3 { second as f64 } else { 0.0 };
                let at = [seen[image][0] + noise() + beside, seen[image][1] + noise()];
                track.push([image as u32, features[image].positions_px.len() as u32]);
                features[image].positions_px.push(at);
            }
            matches.extend(
                track.windows(2).map(|two| ([two[0][0], two[1][0]], [[two[0][1], two[1][1]]])),
            );
            points.push((kind, track, point));
        }
    }
    let counts: Vec<usize> = features.iter().map(|of| of.positions_px.len()).collect();
    let tracks = Tracks::join(&counts, matches.iter().map(|(i, m)| (*i, m.as_slice())));
    let mut block = bare.over(&features, &tracks);
    for track in 0..tracks.count() {
        let first = tracks.of(track)[0];
        let head = [first.image, first.feature];
        block.points[track] =
            points.iter().find(|(_, of, _)| of[0] == head).map(|(.., point)| *point);
        block.used[tracks.places(track)].fill(true);
    }
    let count = |kind: usize| points.iter().filter(|(k, ..)| *k == kind).count();
    assert!((0..4).all(|kind| count(kind) >= 10));
    let longer = lengthen(&block, MAX_RAYS);
    assert_eq!(longer.joined, count(1) / 2);
    assert_eq!(longer.predicted, 2 * count(0));
    assert_eq!(longer.measured, counts);
    let mut lengths = [0; IMAGES + 1];
    for track in 0..longer.tracks.count() {
        let members = longer.tracks.of(track);
        lengths[members.len()] += 1;
        assert!(members.windows(2).all(|two| two[0].image < two[1].image));
        let (first, last) = (members[0], members[members.len() - 1]);
        if last.feature as usize >= counts[last.image as usize] {
            let head = [first.image, first.feature];
            let (kind, _, point) = points.iter().find(|(_, of, _)| of[0] == head).unwrap();
            let image = last.image as usize;
            let at = longer.features[image].positions_px[last.feature as usize];
            assert_eq!(*kind, 0);
            assert!(apart(at, seen(&block, image, *point)) < 1e-9);
        }
    }
    // Of the neighbours neither is taken for the other.
    assert_eq!(lengths[2], count(3) / 2);
    assert_eq!(lengthen(&block, 3).predicted, count(0));
}
