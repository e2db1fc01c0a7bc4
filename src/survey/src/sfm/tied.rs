//! Which images the points of a block really tie together.
//!
//! Two images that show twenty points of each other and none of a third have a place by themselves only: where they are in
//! the block, and how large, nothing says, and the normal equations of such a block have no inverse. So a group grows from the two
//! images that share most: an image is tied to it where it sees enough points of the group, and enough of them twice in
//! it, which gives it its scale.

use super::block::Block;

/// The fewest points that an image shares with images of its group, and how many of them at least two others see.
const SHARED: [usize; 2] = [8, 3];

/// The images that have a pose, by the groups that points tie together, the largest first.
pub fn tied_groups(block: &Block<'_>) -> Vec<Vec<usize>> {
    let images = block.poses.len();
    let mut free: Vec<bool> = block.poses.iter().map(Option::is_some).collect();
    // Who sees each point.
    let seen: Vec<Vec<usize>> = (0..block.tracks.count())
        .map(|track| {
            if block.points[track].is_none() {
                return Vec::new();
            }
            let places = block.tracks.places(track).filter(|&place| block.used[place]);
            let of = places.map(|place| block.tracks.member(place).image as usize);
            of.filter(|&image| free[image]).collect()
        })
        .collect();
    let mut groups = Vec::new();
    while let Some([first, second]) = start(&seen, &free, images) {
        let mut within = vec![false; images];
        let mut rays = vec![0usize; seen.len()];
        let mut group = Vec::new();
        let mut next = vec![first, second];
        while !next.is_empty() {
            for image in next.drain(..) {
                (within[image], free[image]) = (true, false);
                group.push(image);
                for &(track, place) in block.tracks.in_image(image) {
                    let counts = block.used[place as usize] && !seen[track as usize].is_empty();
                    rays[track as usize] += usize::from(counts);
                }
            }
            next = (0..images)
                .filter(|&image| free[image] && !within[image])
                .filter(|&image| {
                    let own = block.tracks.in_image(image).iter();
                    let own = own.filter(|(_, place)| block.used[*place as usize]);
                    let counts: Vec<usize> = own.map(|(track, _)| rays[*track as usize]).collect();
                    let least = |rays: usize| counts.iter().filter(|&&count| count >= rays).count();
                    least(1) >= SHARED[0] && least(2) >= SHARED[1]
                })
                .collect();
        }
        group.sort_unstable();
        groups.push(group);
    }
    groups.extend((0..images).filter(|&image| free[image]).map(|image| vec![image]));
    groups.sort_by_key(|group| (std::cmp::Reverse(group.len()), group.first().copied()));
    groups
}

/// The two free images that share most points, if they share enough.
fn start(seen: &[Vec<usize>], free: &[bool], images: usize) -> Option<[usize; 2]> {
    let mut shared = std::collections::HashMap::new();
    for of in seen {
        for (k, &a) in of.iter().enumerate().filter(|(_, image)| free[**image]) {
            for &b in of[k + 1..].iter().filter(|image| free[**image]) {
                *shared.entry(a.min(b) * images + a.max(b)).or_insert(0usize) += 1;
            }
        }
    }
    let most = shared.into_iter().filter(|(_, count)| *count >= SHARED[0]);
    let (two, _) = most.max_by_key(|&(two, count)| (count, std::cmp::Reverse(two)))?;
    Some([two / images, two % images])
}
