//! Matched tiles in the content store, so that an attempt that was interrupted goes on where it stopped.

use crate::{
    Project, Stage,
    record::{Bytes, Key, Store},
};
use rowgram_base::error::Error;
use rowgram_survey::mapping::dense::{DenseTile, Margin, Pass, Tile, TileStore};
use serde::{Deserialize, Serialize};

/// Tiles under one key of all that decides them.
pub(super) struct TilesOnDisk {
    store: Store,
    key: Key,
}

impl TilesOnDisk {
    /// Those of a project. Tiles of other keys are not seen.
    pub(super) fn new(project: &Project, key: Key) -> TilesOnDisk {
        TilesOnDisk { store: project.store(Stage::Surface), key }
    }

    /// Removes them all.
    pub(super) fn forget(&self) -> Result<(), Error> {
        self.store.retain(&[])
    }
}

fn name(pass: Pass, number: usize) -> String {
    let pass = match pass {
        Pass::Coarse => "coarse",
        Pass::Fine => "fine",
    };
    format!("{pass}-{number}")
}

impl TileStore<Error> for TilesOnDisk {
    fn load(&mut self, pass: Pass, number: usize) -> Result<Option<DenseTile>, Error> {
        let stored: Option<StoredTile> = self.store.load(&name(pass, number), self.key);
        Ok(stored.and_then(StoredTile::tile))
    }

    fn save(&mut self, pass: Pass, number: usize, tile: &DenseTile) -> Result<(), Error> {
        self.store.save(&name(pass, number), self.key, &StoredTile::of(tile))
    }
}

/// A tile as it is written: little-endian bytes.
#[derive(Serialize, Deserialize)]
struct StoredTile {
    corner_m: [f64; 2],
    cell_m: f64,
    size: [usize; 2],
    surface_m: Bytes,
    sigma_m: Bytes,
    confidence: Bytes,
    photos: Bytes,
    colour: Bytes,
    margin_m: Bytes,
}

impl StoredTile {
    fn of(tile: &DenseTile) -> StoredTile {
        let Tile { corner_m, cell_m, size } = tile.tile;
        StoredTile {
            corner_m,
            cell_m,
            size,
            surface_m: of_floats(&tile.surface_m),
            sigma_m: of_floats(&tile.sigma_m),
            confidence: Bytes(tile.confidence.clone()),
            photos: Bytes(tile.photos.clone()),
            colour: Bytes(tile.colour.as_flattened().to_vec()),
            margin_m: of_floats(tile.margin.heights_m()),
        }
    }

    /// `None` where lengths do not fit.
    fn tile(self) -> Option<DenseTile> {
        let StoredTile {
            corner_m,
            cell_m,
            size,
            surface_m,
            sigma_m,
            confidence,
            photos,
            colour,
            margin_m,
        } = self;
        let cells = size[0] * size[1];
        let tile = DenseTile {
            tile: Tile { corner_m, cell_m, size },
            surface_m: floats(&surface_m),
            sigma_m: floats(&sigma_m),
            confidence: confidence.0,
            photos: photos.0,
            colour: colour.0.as_chunks::<3>().0.to_vec(),
            margin: Margin::from_heights(size, floats(&margin_m))?,
        };
        let fits = tile.surface_m.len() == cells
            && tile.sigma_m.len() == cells
            && tile.confidence.len() == cells
            && tile.photos.len() == cells
            && tile.colour.len() == cells;
        fits.then_some(tile)
    }
}

fn of_floats(values: &[f32]) -> Bytes {
    Bytes(values.iter().flat_map(|value| value.to_le_bytes()).collect())
}

fn floats(bytes: &Bytes) -> Vec<f32> {
    bytes.0.as_chunks::<4>().0.iter().map(|&value| f32::from_le_bytes(value)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_comes_back_bit_by_bit_and_only_under_its_key() {
        let folder = tempfile::tempdir().unwrap();
        let key = |text| Key::begin().text(text).finish();
        let tile = DenseTile {
            tile: Tile { corner_m: [0.1, 2.0], cell_m: 0.015, size: [3, 2] },
            surface_m: vec![1.5, f32::NAN, -0.25, 0.0, 7.0, f32::NAN],
            sigma_m: vec![0.01, f32::NAN, 0.5, 0.25, 1.0, 0.0],
            confidence: vec![0, 1, 2, 3, 4, 255],
            photos: vec![0, 5, 2, 3, 4, 1],
            colour: vec![[1, 2, 3], [4, 5, 6], [0; 3], [255; 3], [7; 3], [9, 8, 7]],
            margin: Margin::from_heights([3, 2], (0..336).map(|k| k as f32).collect()).unwrap(),
        };
        let mut store = TilesOnDisk { store: Store::new(folder.path()), key: key("one") };
        store.save(Pass::Fine, 3, &tile).unwrap();
        let found = store.load(Pass::Fine, 3).unwrap().unwrap();
        let bits = |tile: &DenseTile| -> Vec<u32> {
            tile.surface_m.iter().chain(&tile.sigma_m).map(|z| z.to_bits()).collect()
        };
        assert_eq!(bits(&found), bits(&tile));
        assert_eq!((found.tile, &found.colour), (tile.tile, &tile.colour));
        assert_eq!(found.margin, tile.margin);
        assert_eq!((&found.confidence, &found.photos), (&tile.confidence, &tile.photos));
        assert!(store.load(Pass::Coarse, 3).unwrap().is_none());
        let mut other = TilesOnDisk { store: Store::new(folder.path()), key: key("two") };
        assert!(other.load(Pass::Fine, 3).unwrap().is_none());
    }
}
