//! Files beside another one that are read with it: the place, the bands and the mask of a raster, the table of a shapefile, what a
//! GeoPackage has not merged yet.

use crate::{geotiff, polygons};
use std::path::{Path, PathBuf};

/// A file with those beside it that are read with it, itself first.
pub fn with_side_files(path: &Path) -> Vec<PathBuf> {
    let is = |ending: &str| path.extension().is_some_and(|own| own.eq_ignore_ascii_case(ending));
    let beside = match () {
        () if is("shp") => polygons::shapefile_parts(path),
        () if is("gpkg") => vec![added(path, "-wal")],
        () => geotiff::side_files(path),
    };
    let beside = beside.into_iter().filter(|other| other != path && other.is_file());
    std::iter::once(path.to_owned()).chain(beside).collect()
}

/// A path with something behind its name.
pub(crate) fn added(path: &Path, more: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(more);
    PathBuf::from(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_read_with_a_file_and_is_there_belongs_to_it() {
        let folder = tempfile::tempdir().unwrap();
        let of = |name: &str| {
            let files = with_side_files(&folder.path().join(name));
            let names = files.iter().map(|path| path.file_name().unwrap().to_str().unwrap());
            names.map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(of("a.tif"), ["a.tif"]);
        for name in ["tfw", "tif.aux.xml", "tif.msk", "prj", "jgw", "jpg.aux.xml", "gpkg-wal"] {
            std::fs::write(folder.path().join(format!("a.{name}")), "").unwrap();
        }
        assert_eq!(of("a.tif"), ["a.tif", "a.tfw", "a.prj", "a.tif.aux.xml", "a.tif.msk"]);
        // Viewers write statistics beside photos.
        assert_eq!(of("a.jpg"), ["a.jpg", "a.jgw", "a.prj"]);
        assert_eq!(of("a.gpkg"), ["a.gpkg", "a.gpkg-wal"]);
        assert_eq!(of("a.shp"), ["a.shp", "a.prj"]);
    }
}
