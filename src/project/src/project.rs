//! A project on disk: a folder with photos, or with an orthomosaic, and the folder of its results.
//!
//! ```text
//! field/                  the root
//!   rowgram.toml          settings; every key has a default
//!   images/               photos; or photos directly in the root
//!   gcps.csv ...          what is known on the ground and in the air
//!   rowgram/              the results
//!     align/ dem/ ...     a folder per stage
//!     stages/align.json   what a stage read, did and wrote
//!     report.html         the report
//!     rowgram-manifest.json   what was written, and what was in it
//!     .rowgram-store/     what stages found on their way, for the next time
//! ```

use super::{
    Config, SETTINGS, Stage,
    config::ProjectOptions,
    orthomosaic,
    photo_folder::{FlightPhotos, IMAGES, flight_photos, photo_name, photos_in, unread_photos},
    record::{self, Content, Lock, Records, STORE, Store},
};
use rowgram_base::{error::Error, options::Choice};
use rowgram_files::{geotiff::Reading, polygons, rasters::Source, side_files::with_side_files};
use rowgram_optim::output::{FileError, name_of};
use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

/// Endings of photos that are read, in lower case.
pub const PHOTO_ENDINGS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];

/// A folder with photos or an orthomosaic, its settings, and where results go.
#[derive(Debug, Clone)]
pub struct Project {
    root: PathBuf,
    results: PathBuf,
    config: Config,
    /// Held where a run of several stages works on the project.
    lock: Option<Arc<Lock>>,
    /// Stages that are done again whatever is there.
    again: Vec<Stage>,
    /// Whether files in the way of results, which are not as they were written, are kept beside in place of a refusal.
    force: bool,
    /// The day of the flight where somebody but its photos says it.
    date: Option<String>,
}

impl Project {
    /// The project in a folder, with the settings of its `rowgram.toml`; results are in `rowgram` below it.
    ///
    /// # Errors
    /// A folder that is none, settings that cannot be understood.
    pub fn open(root: impl Into<PathBuf>) -> Result<Project, Error> {
        let root = root.into();
        let config = Config::of_folder(&root)?;
        Project::new(root, config)
    }

    /// The project in a folder, with these settings; results are in `rowgram` below it.
    ///
    /// # Errors
    /// A folder that is none.
    pub fn new(root: impl Into<PathBuf>, config: Config) -> Result<Project, Error> {
        let root = root.into();
        if !root.is_dir() {
            let message = "expected a folder with photos or an orthomosaic";
            return Err(FileError::malformed(&root, None, message).into());
        }
        let results = root.join("rowgram");
        Ok(Project {
            root,
            results,
            config,
            lock: None,
            again: Vec::new(),
            force: false,
            date: None,
        })
    }

    /// The same with results in another folder.
    #[must_use]
    pub fn with_results(mut self, results: impl Into<PathBuf>) -> Project {
        self.results = results.into();
        self
    }

    /// The same, whose stages of this list are done again although nothing has changed.
    #[must_use]
    pub fn again(mut self, stages: impl IntoIterator<Item = Stage>) -> Project {
        self.again.extend(stages);
        self
    }

    /// The same, where `force` says that a file in the way of results, which was edited or is somebody else's, is kept beside with the
    /// ending `.edited`; else it is refused.
    #[must_use]
    pub fn forced(mut self, force: bool) -> Project {
        self.force = force;
        self
    }

    /// The same, flown on a day, `YYYY-MM-DD`, where its photos do not say when.
    #[must_use]
    pub fn on(mut self, date: &str) -> Project {
        self.date = Some(date.to_owned());
        self
    }

    /// That day.
    pub(super) fn date(&self) -> Option<&str> {
        self.date.as_deref()
    }

    /// Whether a stage is done although nothing has changed.
    pub(super) fn is_again(&self, stage: Stage) -> bool {
        self.again.contains(&stage)
    }

    /// Whether files in the way are kept beside.
    pub(super) fn is_forced(&self) -> bool {
        self.force
    }

    /// The same, reserved for this process until it is dropped.
    ///
    /// # Errors
    /// Where another process is working on it.
    pub fn reserved(mut self) -> Result<Project, Error> {
        self.lock = Some(self.lock()?);
        Ok(self)
    }

    /// Reserves the project for this process, until the lock and the project are dropped.
    pub(super) fn lock(&self) -> Result<Arc<Lock>, Error> {
        match &self.lock {
            Some(lock) => Ok(Arc::clone(lock)),
            None => Ok(Arc::new(Lock::take(&self.root, &self.results)?)),
        }
    }

    /// Reserves the project for processes that only add to what its stages keep.
    pub(super) fn share(&self) -> Result<Lock, Error> {
        Lock::share(&self.results)
    }

    /// The folder of the project.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The folder of its results.
    pub fn results(&self) -> &Path {
        &self.results
    }

    /// Its settings.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Its name for people: that of the settings, else that of the folder.
    pub fn name(&self) -> String {
        let folder = || self.root.canonicalize().ok()?.file_name()?.to_str().map(str::to_owned);
        self.config.project.name.clone().or_else(folder).unwrap_or_else(|| "project".to_owned())
    }

    /// The folder of a stage.
    pub fn folder(&self, stage: Stage) -> PathBuf {
        self.results.join(stage.word())
    }

    /// Where a file of a stage is, or will be.
    pub fn file(&self, stage: Stage, name: &str) -> PathBuf {
        self.folder(stage).join(name)
    }

    /// A file that a stage wrote when it was done last; `None` also where the stage had nothing to do since.
    pub fn finished(&self, stage: Stage, name: &str) -> Option<PathBuf> {
        let path = Some(self.file(stage, name)).filter(|path| path.is_file())?;
        self.records().read(stage).filter(|record| !record.is_superseded).map(|_| path)
    }

    /// Why a file of a stage cannot be used that is not [`Project::finished`].
    pub(super) fn missing(&self, stage: Stage, name: &str, what: &str) -> Error {
        let (path, word) = (self.file(stage, name), stage.word());
        let folder = self.folder(stage);
        Error::NothingToDo(match path.is_file() {
            true => format!(
                "the {what} in {} is that of an earlier run: something changed since, and {word} failed or had nothing to do; run rowgram {word} again",
                folder.display()
            ),
            false => {
                format!("there is no {what} in {}; make one with rowgram {word}", folder.display())
            }
        })
    }

    /// The content store.
    pub(super) fn store_of_all(&self) -> Store {
        Store::new(self.results.join(STORE))
    }

    /// What the steps of a stage found before.
    pub(super) fn store(&self, stage: Stage) -> Store {
        self.store_of_all().within(&stage.word())
    }

    /// The contents of files, each by itself.
    pub(super) fn content_of_each(
        &self,
        files: &[PathBuf],
    ) -> Result<Vec<Result<Content, FileError>>, Error> {
        record::remembered(&self.root, files, &self.store_of_all())
    }

    /// The contents of files and of those beside them that are read with them.
    pub(super) fn contents(&self, files: &[PathBuf]) -> Result<Vec<Content>, Error> {
        let files: Vec<PathBuf> = files.iter().flat_map(|path| with_side_files(path)).collect();
        let all: Result<Vec<Content>, FileError> =
            self.content_of_each(&files)?.into_iter().collect();
        Ok(all?)
    }

    /// The settings that a person wrote, where there are any.
    pub(super) fn settings_file(&self) -> Option<PathBuf> {
        Some(self.root.join(SETTINGS)).filter(|path| path.is_file())
    }

    /// The polygons of its plots.
    pub fn plots(&self) -> Option<PathBuf> {
        self.polygons(self.config.project.plots.as_ref(), "plots")
    }

    /// The regions in which leaves were counted by hand.
    pub fn regions(&self) -> Option<PathBuf> {
        self.polygons(self.config.project.regions.as_ref(), "regions")
    }

    /// What its stages did.
    pub fn records(&self) -> Records {
        Records::of(&self.root, &self.results)
    }

    /// A file of the project: the one that a setting names, else the first of the usual names that is there.
    pub fn given(&self, named: Option<&PathBuf>, usual: &[&str]) -> Option<PathBuf> {
        let there = |name: &&str| Some(self.root.join(name)).filter(|path| path.is_file());
        match named {
            Some(path) => Some(self.root.join(path)),
            None => usual.iter().find_map(there),
        }
    }

    /// A file of polygons: the one that a setting names, else `stem` with one of the endings of polygons.
    pub fn polygons(&self, named: Option<&PathBuf>, stem: &str) -> Option<PathBuf> {
        match named {
            Some(path) => Some(self.root.join(path)),
            None => polygons::find(&self.root, stem, &polygons::ENDINGS).into_iter().next(),
        }
    }

    /// The folder of the photos: `images`, else the root.
    pub fn photo_folder(&self) -> PathBuf {
        let images = self.root.join(IMAGES);
        if images.is_dir() { images } else { self.root.clone() }
    }

    /// Where photos are looked for, for people.
    pub(super) fn photo_place(&self) -> String {
        let unread = unread_photos(&self.photo_folder());
        if !unread.is_empty() {
            let (count, first) = (unread.len(), name_of(&unread[0]));
            return format!(
                "in images/ or directly that are read, but {count} files such as {first}: convert them to JPEG or TIFF, and keep their EXIF"
            );
        }
        if !self.root.join(IMAGES).is_dir() {
            return "in images/ or directly".to_owned();
        }
        match photos_in(&self.root).len() {
            0 => "in images/".to_owned(),
            n => format!(
                "in images/, but {n} directly in the folder, which are not used beside it: move them there, or remove images/"
            ),
        }
    }

    /// What a photo is called: its path from the folder of the photos on.
    pub fn photo_name(&self, path: &Path) -> String {
        photo_name(path, &self.photo_folder())
    }

    /// The photos, sorted by name: those in `images`, else those in the root, with the subfolders of a card.
    pub fn photos(&self) -> Vec<PathBuf> {
        self.flight_photos().photos
    }

    /// Bands of a multispectral camera beside the photos, which are not used.
    pub fn bands(&self) -> Vec<PathBuf> {
        self.flight_photos().bands
    }

    fn flight_photos(&self) -> FlightPhotos {
        let mut found = flight_photos(&self.photo_folder());
        if self.root.join(IMAGES).is_dir() {
            return found;
        }
        match &self.config.project.ortho {
            Some(ortho) => found.photos.retain(|path| *path != self.root.join(ortho)),
            None if orthomosaic::among(&found.photos).is_some() => found.photos.clear(),
            None => {}
        }
        found
    }

    /// Photos whose names are not UTF-8, with a sign for what cannot be shown; they take no part.
    pub fn unusable_photos(&self) -> Vec<String> {
        let found = self.flight_photos().unusable;
        found.iter().map(|path| self.photo_name(path)).collect()
    }

    /// An orthomosaic that is there from the beginning: the one that the settings name, or that of a folder without photos
    /// (`orthomosaic`).
    pub fn given_orthomosaic(&self) -> Option<PathBuf> {
        match &self.config.project.ortho {
            Some(ortho) => Some(self.root.join(ortho)),
            None if self.root.join(IMAGES).is_dir() => None,
            None => self.rasters().map(|rasters| rasters.ortho),
        }
    }

    /// The rasters of a folder without photos, the orthomosaic among them.
    pub(super) fn rasters(&self) -> Option<orthomosaic::Rasters> {
        let pictures = photos_in(&self.root);
        match pictures.is_empty() {
            true => orthomosaic::below(&self.root),
            false => orthomosaic::among(&pictures),
        }
    }

    /// Heights of another program beside an orthomosaic that is there from the beginning.
    pub(super) fn heights_beside(&self) -> orthomosaic::HeightsBeside {
        let Some(ortho) = self.given_orthomosaic() else { return Default::default() };
        let mut others = match &self.config.project.ortho {
            None => self.rasters().map(|rasters| rasters.others).unwrap_or_default(),
            Some(_) => ortho.parent().map(photos_in).unwrap_or_default(),
        };
        others.retain(|path| *path != ortho);
        orthomosaic::heights(&self.root, &others)
    }

    /// The orthomosaic, given or made.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where there is none.
    pub fn orthomosaic(&self) -> Result<PathBuf, Error> {
        self.given_orthomosaic()
            .or_else(|| self.finished(Stage::Ortho, "ortho.tif"))
            .ok_or_else(|| self.missing(Stage::Ortho, "ortho.tif", "orthomosaic"))
    }

    /// How a picture is read: the orthomosaic that was given with bands and reflectance as the settings say.
    pub(super) fn reading(&self, path: &Path) -> Reading {
        let ProjectOptions { bands, reflectance_scale, .. } = &self.config.project;
        let is_said = !bands.is_empty() || reflectance_scale.is_some();
        if !is_said || self.given_orthomosaic().is_none_or(|ortho| ortho != path) {
            return Reading::default();
        }
        Reading { bands: bands.clone(), full_reflectance: *reflectance_scale }
    }

    /// Opens a picture or raster of the project.
    ///
    /// # Errors
    /// As [`Source::open_with`].
    pub(super) fn open_picture(&self, path: &Path) -> Result<Source, FileError> {
        Source::open_with(path, &self.reading(path))
    }

    /// The leaf mask.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where there is none.
    pub fn mask(&self) -> Result<PathBuf, Error> {
        self.finished(Stage::Segment, "mask.tif")
            .ok_or_else(|| self.missing(Stage::Segment, "mask.tif", "leaf mask"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn what_is_missing_is_told_from_what_is_out_of_date() {
        let folder = tempfile::tempdir().unwrap();
        let project = Project::new(folder.path(), Config::default()).unwrap();
        let told = || project.missing(Stage::Ortho, "ortho.tif", "orthomosaic").to_string();
        assert!(told().contains("there is no orthomosaic"), "{}", told());
        fs::create_dir_all(project.folder(Stage::Ortho)).unwrap();
        fs::write(project.file(Stage::Ortho, "ortho.tif"), "").unwrap();
        assert!(told().contains("earlier run"), "{}", told());
    }

    #[test]
    fn photos_beside_an_empty_folder_of_photos_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let project = Project::new(folder.path(), Config::default()).unwrap();
        fs::write(folder.path().join("a.jpg"), "").unwrap();
        assert_eq!(project.photo_place(), "in images/ or directly");
        fs::create_dir(folder.path().join("images")).unwrap();
        assert!(project.photo_place().contains("1 directly in the folder"));
    }
}
