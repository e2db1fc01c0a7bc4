//! Decoded photos, as many as there is room for.
//!
//! Photos are read when they are needed; those that were not needed for longest leave first. What is computed with them
//! does not depend on the room.

use super::{View, photo::DecodedPhoto};
use rayon::prelude::*;
use std::{collections::BTreeMap, sync::Arc};

/// Reads a photo by its index.
pub type ReadPhoto<'a, E> = dyn Fn(usize) -> Result<DecodedPhoto, E> + Sync + 'a;

/// Decoded photos, the least recently used of which leave first.
pub struct PhotoCache<'a, E> {
    views: &'a [View],
    read: &'a ReadPhoto<'a, E>,
    capacity_bytes: usize,
    kept: BTreeMap<usize, (Arc<DecodedPhoto>, u64)>,
    clock: u64,
}

impl<'a, E: Send> PhotoCache<'a, E> {
    /// An empty one for the photos of `views`; at least one photo is kept whatever the capacity.
    pub fn new(
        views: &'a [View],
        read: &'a ReadPhoto<'a, E>,
        capacity_bytes: usize,
    ) -> PhotoCache<'a, E> {
        PhotoCache { views, read, capacity_bytes, kept: BTreeMap::new(), clock: 0 }
    }

    /// The same with room for at least two photos at a time.
    #[must_use]
    pub fn with_room_for_two(mut self) -> PhotoCache<'a, E> {
        let largest = (0..self.views.len()).map(|k| self.bytes(k)).max().unwrap_or(0);
        self.capacity_bytes = self.capacity_bytes.max(2 * largest);
        self
    }

    /// Number of photos.
    pub fn count(&self) -> usize {
        self.views.len()
    }

    fn bytes(&self, k: usize) -> usize {
        let [width, height] = self.views[k].interior.size_px().map(|n| n as usize);
        4 * width * height
    }

    /// Parts of some photos that fit in the room together, in the order of their numbers; at least one each.
    fn groups(&self, needed: &[usize]) -> Vec<Vec<usize>> {
        let mut groups: Vec<Vec<usize>> = Vec::new();
        let mut bytes = usize::MAX;
        for &k in needed {
            let own = self.bytes(k);
            match groups.last_mut() {
                Some(group) if bytes.saturating_add(own) <= self.capacity_bytes => {
                    group.push(k);
                    bytes += own;
                }
                _ => {
                    groups.push(vec![k]);
                    bytes = own;
                }
            }
        }
        groups
    }

    /// Brings photos into memory.
    fn load(&mut self, group: &[usize]) -> Result<(), E> {
        self.clock += 1;
        let clock = self.clock;
        let mut missing = Vec::new();
        let mut bytes = 0;
        for &k in group {
            bytes += self.bytes(k);
            match self.kept.get_mut(&k) {
                Some((_, used)) => *used = clock,
                None => missing.push(k),
            }
        }
        let others = |kept: &BTreeMap<usize, (Arc<DecodedPhoto>, u64)>| {
            let of = kept.values().filter(|(_, used)| *used != clock);
            of.map(|(photo, _)| photo.bytes()).sum::<usize>()
        };
        while bytes + others(&self.kept) > self.capacity_bytes {
            let oldest = self.kept.iter().filter(|(_, (_, used))| *used != clock);
            let Some(k) = oldest.min_by_key(|(k, (_, used))| (*used, **k)).map(|(k, _)| *k) else {
                break;
            };
            self.kept.remove(&k);
        }
        let read = self.read;
        let decoded: Vec<Result<(usize, DecodedPhoto), E>> =
            missing.par_iter().map(|&k| Ok((k, read(k)?))).collect();
        for photo in decoded {
            let (k, photo) = photo?;
            self.kept.insert(k, (Arc::new(photo), clock));
        }
        Ok(())
    }

    /// Loads photos part by part and hands each part to `with`, by index; `None` for those that are not in the part.
    ///
    /// # Errors
    /// As the reader of photos says.
    pub fn each_group(
        &mut self,
        needed: &[usize],
        mut with: impl FnMut(&[Option<&DecodedPhoto>]),
    ) -> Result<(), E> {
        for group in self.groups(needed) {
            self.load(&group)?;
            let mut photos: Vec<Option<&DecodedPhoto>> = vec![None; self.views.len()];
            for &k in &group {
                photos[k] = self.kept.get(&k).map(|(photo, _)| photo.as_ref());
            }
            with(&photos);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Interior, Model},
        scene::Pose,
    };
    use std::sync::Mutex;

    /// Five photos of 40 x 30 pixels, 4800 bytes each.
    fn views() -> Vec<View> {
        let values = [50.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let interior = Interior::new(Model::Smac, [40, 30], &values).unwrap();
        let pose = Pose::from_centre([1.0, 0.0, 0.0, 0.0], [0.0; 3]);
        vec![View::new("p", interior, pose, None); 5]
    }

    /// The groups that a cache of so many bytes hands out for some needs, and what it had to read for each.
    fn trace(bytes: usize, needs: &[&[usize]]) -> (Vec<Vec<usize>>, Vec<Vec<usize>>) {
        let views = views();
        let reads = Mutex::new(Vec::new());
        let read = |k: usize| -> Result<DecodedPhoto, String> {
            reads.lock().unwrap().push(k);
            if k == 4 {
                return Err("photo 4 is damaged".to_owned());
            }
            Ok(DecodedPhoto::new(&image::RgbImage::new(40, 30), None))
        };
        let mut cache = PhotoCache::new(&views, &read, bytes);
        let (mut groups, mut read_for) = (Vec::new(), Vec::new());
        for needed in needs {
            cache
                .each_group(needed, |photos| {
                    groups.push((0..photos.len()).filter(|&k| photos[k].is_some()).collect());
                })
                .unwrap();
            let mut read = std::mem::take(&mut *reads.lock().unwrap());
            read.sort_unstable();
            read_for.push(read);
        }
        (groups, read_for)
    }

    #[test]
    fn photos_are_handed_out_in_groups_that_fit() {
        let (groups, read) = trace(2 * 4800, &[&[0, 1, 2]]);
        assert_eq!((groups, read), (vec![vec![0, 1], vec![2]], vec![vec![0, 1, 2]]));
        // Without room each comes alone.
        let (groups, _) = trace(0, &[&[0, 3]]);
        assert_eq!(groups, [vec![0], vec![3]]);
    }

    #[test]
    fn the_photo_not_needed_for_longest_leaves_first() {
        let (_, read) = trace(2 * 4800, &[&[0], &[1], &[0], &[2], &[0], &[1]]);
        assert_eq!(read, [vec![0], vec![1], vec![], vec![2], vec![], vec![1]]);
    }

    #[test]
    fn a_photo_that_cannot_be_read_is_an_error() {
        let views = views();
        let read = |_: usize| -> Result<DecodedPhoto, String> { Err("damaged".to_owned()) };
        let mut cache = PhotoCache::new(&views, &read, 0);
        assert_eq!(cache.each_group(&[1], |_| unreachable!()).unwrap_err(), "damaged");
        let roomy = PhotoCache::new(&views, &read, 0).with_room_for_two();
        assert_eq!(roomy.groups(&[0, 1, 2]), [vec![0, 1], vec![2]]);
    }
}
