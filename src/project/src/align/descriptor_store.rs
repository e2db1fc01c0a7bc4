//! Descriptors in the content store, read again when they are needed.
//!
//! They are the largest part of what a photo leaves behind: 0.8 MB for 6,000 features. Those that were not used for longest
//! leave first; what is computed with them does not depend on the room.

use crate::record::{Bytes, Key, Store};
use rowgram_base::error::Error;
use rowgram_files::memory;
use rowgram_survey::features::{DescriptorSource, Descriptors};
use std::{
    collections::HashMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

/// Bytes of descriptors that are kept in memory: those of 330 photos with 6,000 features. A flight's photo has its
/// neighbours in a few strips before and after it.
pub(crate) const DESCRIPTORS_IN_MEMORY_BYTES: usize = 256 << 20;

/// The descriptors of all photos.
pub(super) struct DescriptorStore {
    store: Store,
    /// Name and key of each photo.
    files: Vec<(String, Key)>,
    room_bytes: usize,
    kept: Mutex<Kept>,
}

#[derive(Default)]
struct Kept {
    /// Photo, its descriptors, when they were last used.
    photos: HashMap<usize, (Arc<Descriptors>, u64)>,
    bytes: usize,
    clock: u64,
    /// A file that could not be read again.
    lost: Option<String>,
}

impl DescriptorStore {
    /// An empty one over a store.
    pub(super) fn new(store: Store) -> DescriptorStore {
        DescriptorStore {
            store,
            files: Vec::new(),
            room_bytes: DESCRIPTORS_IN_MEMORY_BYTES,
            kept: Mutex::default(),
        }
    }

    /// Names the files of all photos.
    pub(super) fn hold(&mut self, files: Vec<(String, Key)>) {
        self.files = files;
    }

    /// Whether all that was asked for was there.
    ///
    /// # Errors
    /// Where a file has vanished or was damaged since it was written.
    pub(super) fn check(&self) -> Result<(), Error> {
        match &self.kept().lost {
            None => Ok(()),
            Some(file) => Err(Error::Incomplete(format!(
                "{file} in the store of align has vanished or is damaged; run it again"
            ))),
        }
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl DescriptorSource for DescriptorStore {
    fn descriptors(&self, photo: usize) -> Arc<Descriptors> {
        {
            let mut kept = self.kept();
            kept.clock += 1;
            let clock = kept.clock;
            if let Some((descriptors, used)) = kept.photos.get_mut(&photo) {
                *used = clock;
                return Arc::clone(descriptors);
            }
        }
        let file = self.files.get(photo);
        let read = file.and_then(|(name, key)| self.store.load::<Bytes>(name, *key));
        let read = read.and_then(|bytes| Descriptors::from_bytes(bytes.0));
        let mut kept = self.kept();
        if read.is_none() {
            kept.lost = Some(file.map_or_else(String::new, |(name, _)| name.clone()));
        }
        let descriptors = Arc::new(read.unwrap_or_default());
        let clock = kept.clock;
        let before = kept.photos.insert(photo, (Arc::clone(&descriptors), clock));
        kept.bytes += descriptors.as_bytes().len();
        kept.bytes -= before.map_or(0, |(before, _)| before.as_bytes().len());
        while kept.bytes > self.room_bytes && kept.photos.len() > 1 {
            let others = kept.photos.iter().filter(|(other, _)| **other != photo);
            let Some((&oldest, _)) = others.min_by_key(|(_, (_, used))| *used) else { break };
            let gone = kept.photos.remove(&oldest);
            kept.bytes -= gone.map_or(0, |(gone, _)| gone.as_bytes().len());
        }
        descriptors
    }

    fn release(&self) {
        {
            let mut kept = self.kept();
            kept.photos = HashMap::new();
            kept.bytes = 0;
        }
        memory::return_freed();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptors_leave_and_come_back_and_a_lost_file_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = DescriptorStore::new(Store::new(folder.path()));
        let files: Vec<(String, Key)> =
            (0..5).map(|k| (k.to_string(), Key::begin().count(k).finish())).collect();
        for (k, (name, key)) in files.iter().enumerate() {
            store.store.save(name, *key, &Bytes(vec![k as u8; 1280])).unwrap();
        }
        store.hold(files);
        store.room_bytes = 3000;
        for photo in [0, 1, 2, 0, 4, 3, 0, 1] {
            let found = store.descriptors(photo);
            assert_eq!(found.as_bytes(), vec![photo as u8; 1280]);
            let kept = store.kept();
            assert!(kept.photos.len() <= 2 && kept.bytes == 1280 * kept.photos.len());
            assert!(kept.photos.contains_key(&photo));
        }
        store.release();
        assert!(store.kept().photos.is_empty());
        assert_eq!(store.descriptors(4).as_bytes(), vec![4; 1280]);
        store.check().unwrap();
        std::fs::remove_file(folder.path().join("2.cbor")).unwrap();
        assert!(store.descriptors(2).is_empty());
        assert!(store.check().unwrap_err().to_string().contains("2 in the store"));
    }
}
