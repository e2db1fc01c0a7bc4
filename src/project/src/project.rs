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
//! ```

use super::{
    Config, Stage, orthomosaic,
    record::{Lock, Records},
};
use rowgram_base::{error::Error, options::Choice};
use rowgram_files::polygons;
use rowgram_optim::output::FileError;
use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

/// Endings of photos that are read, in lower case.
pub const PHOTO_ENDINGS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];

/// A folder with photos or an orthomosaic, its settings, and where results go.
#[derive(Debug)]
pub struct Project {
    root: PathBuf,
    results: PathBuf,
    config: Config,
    /// Held where a run of several stages works on the project.
    lock: Option<Arc<Lock>>,
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
        Ok(Project { root, results, config, lock: None })
    }

    /// The same with results in another folder.
    #[must_use]
    pub fn with_results(mut self, results: impl Into<PathBuf>) -> Project {
        self.results = results.into();
        self
    }

    /// The same, reserved for this process until it is dropped.
    ///
    /// # Errors
    /// Where another process is working on it.
    pub fn reserved(mut self) -> Result<Project, Error> {
        self.lock = Some(Arc::new(Lock::take(&self.results)?));
        Ok(self)
    }

    /// A copy that is reserved for this process until it is dropped.
    ///
    /// # Errors
    /// Where another process is working on it.
    pub(super) fn reserve(&self) -> Result<Project, Error> {
        let lock = match &self.lock {
            Some(lock) => Arc::clone(lock),
            None => Arc::new(Lock::take(&self.results)?),
        };
        let (root, results) = (self.root.clone(), self.results.clone());
        Ok(Project { root, results, config: self.config.clone(), lock: Some(lock) })
    }

    /// Reserves the project for a stage, unless it is reserved already.
    pub(super) fn lock(&self) -> Result<Option<Lock>, Error> {
        match self.lock {
            Some(_) => Ok(None),
            None => Lock::take(&self.results).map(Some),
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

    /// A file of a stage, if it is there.
    pub fn existing(&self, stage: Stage, name: &str) -> Option<PathBuf> {
        Some(self.file(stage, name)).filter(|path| path.is_file())
    }

    /// A file that a stage left when it was done last.
    pub fn finished(&self, stage: Stage, name: &str) -> Option<PathBuf> {
        let path = self.existing(stage, name)?;
        self.records().read(stage).map(|_| path)
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
            None => polygons::find(&self.root, stem),
        }
    }

    /// The photos, sorted by name: those in `images`, else those in the root.
    pub fn photos(&self) -> Vec<PathBuf> {
        let images = self.root.join("images");
        if images.is_dir() {
            return photos_in(&images);
        }
        let photos = photos_in(&self.root);
        if self.config.project.ortho.is_none() && orthomosaic::among(&photos).is_some() {
            return Vec::new();
        }
        match &self.config.project.ortho {
            Some(ortho) => {
                photos.into_iter().filter(|path| *path != self.root.join(ortho)).collect()
            }
            None => photos,
        }
    }

    /// An orthomosaic that is there from the beginning: the one that the settings name, or that of a folder without photos
    /// ([`orthomosaic`]).
    pub fn given_orthomosaic(&self) -> Option<PathBuf> {
        if self.config.project.ortho.is_some() {
            return self.given_among(&[]);
        }
        if self.root.join("images").is_dir() {
            return None;
        }
        self.given_among(&photos_in(&self.root))
    }

    /// The rasters of a folder without photos, the orthomosaic among them.
    pub(super) fn rasters(&self) -> Option<orthomosaic::Rasters> {
        let pictures = photos_in(&self.root);
        match pictures.is_empty() {
            true => orthomosaic::below(&self.root),
            false => orthomosaic::among(&pictures),
        }
    }

    fn given_among(&self, photos: &[PathBuf]) -> Option<PathBuf> {
        if let Some(path) = &self.config.project.ortho {
            return Some(self.root.join(path));
        }
        let rasters = match photos.is_empty() {
            true => orthomosaic::below(&self.root),
            false => orthomosaic::among(photos),
        };
        rasters.map(|rasters| rasters.ortho)
    }

    /// The orthomosaic, given or made.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where there is none.
    pub fn orthomosaic(&self) -> Result<PathBuf, Error> {
        self.given_orthomosaic()
            .or_else(|| self.existing(Stage::Ortho, "ortho.tif"))
            .ok_or_else(|| Error::NothingToDo("there is no orthomosaic".to_owned()))
    }

    /// The leaf mask.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where there is none.
    pub fn mask(&self) -> Result<PathBuf, Error> {
        self.existing(Stage::Segment, "mask.tif")
            .ok_or_else(|| Error::NothingToDo("there is no leaf mask".to_owned()))
    }
}

/// The photos of a folder by their endings, sorted by name; hidden files are none.
pub fn photos_in(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut found: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| {
            let hidden =
                path.file_name().and_then(|n| n.to_str()).is_none_or(|name| name.starts_with('.'));
            let ending = path.extension().and_then(|e| e.to_str()).map(str::to_lowercase);
            path.is_file()
                && !hidden
                && ending.is_some_and(|ending| PHOTO_ENDINGS.contains(&ending.as_str()))
        })
        .collect();
    found.sort();
    found
}
