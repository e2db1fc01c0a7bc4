//! Tracks: which image positions show the same point.
//!
//! Matches of pairs join to tracks, those of the strongest pairs first; a match that would put two
//! positions of one image into a track is refused, because one point has one image in a photo. Features at the same
//! place (one for each direction of a key point) are one position: counted twice, it would pass for two measurements.

use rowgram_base::disjoint_sets::DisjointSets;
use std::collections::HashMap;

/// A place in an image: which image, which of its features.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Member {
    /// Index of the image.
    pub image: u32,
    /// Index of the feature in it.
    pub feature: u32,
}

/// For each of some positions the first one at the same place.
fn places(positions_px: &[[f64; 2]]) -> Vec<u32> {
    let mut first: HashMap<[u64; 2], u32> = HashMap::with_capacity(positions_px.len());
    let of = positions_px.iter().enumerate();
    of.map(|(k, at)| *first.entry(at.map(f64::to_bits)).or_insert(k as u32)).collect()
}

/// All tracks of a block.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Tracks {
    /// Where each track begins in `members`; one more than there are tracks.
    starts: Vec<u32>,
    members: Vec<Member>,
    /// Per image: `(track, place in members)`, ascending.
    of_images: Vec<Vec<(u32, u32)>>,
}

/// The nodes of a tree, from one of them on.
fn ring(next: &[u32], first: usize) -> impl Iterator<Item = usize> + '_ {
    let after = move |&node: &usize| Some(next[node] as usize).filter(|&node| node != first);
    std::iter::successors(Some(first), after)
}

/// Trees of positions, no two of which are in one image. Flat arrays: of thousands of photos there are millions of trees.
struct Forest {
    sets: DisjointSets,
    /// Image of each node.
    image_of: Vec<u32>,
    /// The next node of the same tree, around in a ring.
    next: Vec<u32>,
    /// Nodes of each tree, by its root.
    nodes: Vec<u32>,
    /// Of each image: the last comparison of two trees whose smaller one has it.
    compared: Vec<u64>,
    comparisons: u64,
}

impl Forest {
    /// A tree for each position; images have so many.
    fn new(counts: &[usize]) -> Forest {
        let images = counts.iter().enumerate();
        let image_of: Vec<u32> =
            images.flat_map(|(k, count)| std::iter::repeat_n(k as u32, *count)).collect();
        let total = image_of.len();
        Forest {
            sets: DisjointSets::new(total),
            image_of,
            next: (0..total as u32).collect(),
            nodes: vec![1; total],
            compared: vec![0; counts.len()],
            comparisons: 0,
        }
    }

    /// Joins two trees unless they share an image.
    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.sets.root(a as usize), self.sets.root(b as usize));
        if a == b {
            return;
        }
        let (root, other) = if self.nodes[a] >= self.nodes[b] { (a, b) } else { (b, a) };
        self.comparisons += 1;
        for node in ring(&self.next, other) {
            self.compared[self.image_of[node] as usize] = self.comparisons;
        }
        let is_shared =
            |node: usize| self.compared[self.image_of[node] as usize] == self.comparisons;
        if ring(&self.next, root).any(is_shared) {
            return;
        }
        self.next.swap(root, other);
        self.nodes[root] += self.nodes[other];
        self.sets.link(root, other);
    }
}

impl Tracks {
    /// Joins what pairs of images match, the strongest pairs first; features of an image at the same place are one.
    pub fn of_pairs<'a>(
        features: &[super::Features],
        pairs: impl Iterator<Item = ([u32; 2], &'a [[u32; 2]])>,
    ) -> Tracks {
        let mut order: Vec<([u32; 2], &[[u32; 2]])> = pairs.collect();
        order.sort_by(|(a, of_a), (b, of_b)| of_b.len().cmp(&of_a.len()).then(a.cmp(b)));
        let counts: Vec<usize> = features.iter().map(|f| f.positions_px.len()).collect();
        let places: Vec<Vec<u32>> = features.iter().map(|f| places(&f.positions_px)).collect();
        let of_places = order.into_iter().map(|(images, matches)| {
            let [first, second] = images.map(|image| &places[image as usize]);
            (images, matches.iter().map(|&[a, b]| [first[a as usize], second[b as usize]]))
        });
        Tracks::join_each(&counts, of_places)
    }

    /// Joins the matches of pairs, `([first image, second image], [[feature, feature], ..])`, given in
    /// the order in which they are to be trusted; `features` is how many each image has.
    pub fn join<'a>(
        features: &[usize],
        pairs: impl Iterator<Item = ([u32; 2], &'a [[u32; 2]])>,
    ) -> Tracks {
        Tracks::join_each(features, pairs.map(|(images, of)| (images, of.iter().copied())))
    }

    fn join_each<M: Iterator<Item = [u32; 2]>>(
        features: &[usize],
        pairs: impl Iterator<Item = ([u32; 2], M)>,
    ) -> Tracks {
        let mut offsets = vec![0u32];
        for count in features {
            offsets.push(offsets[offsets.len() - 1] + *count as u32);
        }
        let total = offsets[features.len()];
        let mut forest = Forest::new(features);
        for (images, matches) in pairs {
            let [first, second] = images.map(|image| offsets[image as usize]);
            for [a, b] in matches {
                forest.join(first + a, second + b);
            }
        }
        let mut tracks = Tracks {
            starts: vec![0],
            members: Vec::new(),
            of_images: vec![Vec::new(); features.len()],
        };
        // Tracks come in the order of their first member.
        let mut numbers = vec![u32::MAX; total as usize];
        let mut lengths: Vec<u32> = Vec::new();
        let Forest { mut sets, image_of, nodes, .. } = forest;
        let mut track_of = |node: u32, lengths: &mut Vec<u32>| {
            let root = sets.root(node as usize);
            (nodes[root] > 1).then(|| {
                if numbers[root] == u32::MAX {
                    numbers[root] = lengths.len() as u32;
                    lengths.push(0);
                }
                numbers[root] as usize
            })
        };
        for node in 0..total {
            if let Some(track) = track_of(node, &mut lengths) {
                lengths[track] += 1;
            }
        }
        let mut next = 0;
        for length in &mut lengths {
            let begin = next;
            next += *length;
            tracks.starts.push(next);
            *length = begin;
        }
        tracks.members = vec![Member { image: 0, feature: 0 }; next as usize];
        for node in 0..total {
            let Some(track) = track_of(node, &mut lengths) else { continue };
            let (image, place) = (image_of[node as usize], lengths[track]);
            lengths[track] += 1;
            tracks.members[place as usize] =
                Member { image, feature: node - offsets[image as usize] };
        }
        for track in 0..tracks.count() {
            for place in tracks.places(track) {
                let image = tracks.members[place].image as usize;
                tracks.of_images[image].push((track as u32, place as u32));
            }
        }
        tracks
    }

    /// The tracks that are marked, in their order.
    pub(super) fn only(&self, kept: &[bool]) -> Tracks {
        let mut tracks = Tracks {
            starts: vec![0],
            members: Vec::new(),
            of_images: vec![Vec::new(); self.of_images.len()],
        };
        for track in (0..self.count()).filter(|&track| kept[track]) {
            let number = tracks.count() as u32;
            for &member in self.of(track) {
                let place = tracks.members.len() as u32;
                tracks.of_images[member.image as usize].push((number, place));
                tracks.members.push(member);
            }
            tracks.starts.push(tracks.members.len() as u32);
        }
        tracks
    }

    /// How many tracks there are.
    pub fn count(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// How many members all tracks have.
    pub fn member_count(&self) -> usize {
        self.members.len()
    }

    /// Places of a track's members.
    pub fn places(&self, track: usize) -> std::ops::Range<usize> {
        self.starts[track] as usize..self.starts[track + 1] as usize
    }

    /// The member at a place.
    pub fn member(&self, place: usize) -> Member {
        self.members[place]
    }

    /// The members of a track, ascending by image.
    pub fn of(&self, track: usize) -> &[Member] {
        &self.members[self.places(track)]
    }

    /// `(track, place of the member)` of everything in an image.
    pub fn in_image(&self, image: usize) -> &[(u32, u32)] {
        &self.of_images[image]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn tracks_are_those_of_joining_sets_one_by_one(
            matches in prop::collection::vec(((0u32..6, 0u32..4), (0u32..6, 0u32..4)), 0..60),
        ) {
            let matches: Vec<_> = matches.into_iter().filter(|(a, b)| a.0 != b.0).collect();
            let pairs: Vec<([u32; 2], [[u32; 2]; 1])> =
                matches.iter().map(|(a, b)| ([a.0, b.0], [[a.1, b.1]])).collect();
            let tracks = Tracks::join(&[4; 6], pairs.iter().map(|(i, m)| (*i, m.as_slice())));
            let mut sets: Vec<Vec<(u32, u32)>> =
                (0..6).flat_map(|i| (0..4).map(move |f| vec![(i, f)])).collect();
            for (a, b) in &matches {
                let holds = |sets: &[Vec<(u32, u32)>], of| sets.iter().position(|s| s.contains(of));
                let (one, two) = (holds(&sets, a).unwrap(), holds(&sets, b).unwrap());
                let share = |s: &(u32, u32)| sets[two].iter().any(|other| other.0 == s.0);
                if one == two || sets[one].iter().any(share) {
                    continue;
                }
                let moved = std::mem::take(&mut sets[two]);
                sets[one].extend(moved);
            }
            let mut expected: Vec<Vec<(u32, u32)>> =
                sets.into_iter().filter(|set| set.len() > 1).collect();
            expected.iter_mut().for_each(|set| set.sort_unstable());
            expected.sort();
            let of = |track| tracks.of(track).iter().map(|m| (m.image, m.feature)).collect();
            let mut found: Vec<Vec<(u32, u32)>> = (0..tracks.count()).map(of).collect();
            found.sort();
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn features_at_the_same_place_are_one() {
        let at = |positions: &[[f64; 2]]| crate::sfm::Features {
            positions_px: positions.to_vec(),
            ..crate::sfm::Features::default()
        };
        // Two directions of one key point in each image.
        let features = [at(&[[5.0, 6.0], [5.0, 6.0], [9.0, 9.0]]), at(&[[1.0, 2.0], [1.0, 2.0]])];
        let matches = [[0, 0], [1, 1], [2, 0]];
        let tracks = Tracks::of_pairs(&features, [([0, 1], matches.as_slice())].into_iter());
        assert_eq!((tracks.count(), tracks.member_count()), (1, 2));
    }

    #[test]
    fn matches_join_and_contradictions_are_refused() {
        let features = [3, 3, 3];
        let pairs: Vec<([u32; 2], Vec<[u32; 2]>)> = vec![
            ([0, 1], vec![[0, 0], [1, 1]]),
            ([1, 2], vec![[0, 2], [1, 0]]),
            // 0-0, 1-0, 2-2 are one track already: 2-1 would be a second position in image 2.
            ([0, 2], vec![[0, 1], [1, 0]]),
        ];
        let tracks = Tracks::join(&features, pairs.iter().map(|(i, m)| (*i, m.as_slice())));
        assert_eq!(tracks.count(), 2);
        let of = |k: usize| -> Vec<(u32, u32)> {
            tracks.of(k).iter().map(|m| (m.image, m.feature)).collect()
        };
        assert_eq!(of(0), [(0, 0), (1, 0), (2, 2)]);
        assert_eq!(of(1), [(0, 1), (1, 1), (2, 0)]);
        assert_eq!(tracks.in_image(2), [(0, 2), (1, 5)]);
    }
}
