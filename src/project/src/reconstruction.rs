//! The reconstruction of a project, and what maps take from it.

use super::{Project, Stage};
use rowgram_base::error::Error;
use rowgram_files::reconstruction;
use rowgram_survey::scene::Reconstruction;
use std::path::PathBuf;

impl Project {
    /// The files of the reconstruction, for the record of a stage.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where there is none, and why.
    pub(super) fn reconstruction_files(&self) -> Result<Vec<PathBuf>, Error> {
        if self.given_orthomosaic().is_some() {
            return Err(Error::NothingToDo("the orthomosaic is given".to_owned()));
        }
        let path = self.file(Stage::Align, reconstruction::NAME);
        let record = self.records().read(Stage::Align);
        if !path.is_file() || record.is_some_and(|record| record.is_superseded) {
            return Err(self.missing(Stage::Align, reconstruction::NAME, "reconstruction"));
        }
        Ok(vec![path.with_file_name(reconstruction::POINTS), path])
    }

    /// The reconstruction.
    ///
    /// # Errors
    /// [`Error::NothingToDo`] where there is none, or none with a scale: products are in metres.
    pub fn reconstruction(&self) -> Result<Reconstruction, Error> {
        self.reconstruction_files()?;
        let found = reconstruction::read(&self.file(Stage::Align, reconstruction::NAME))?;
        if !found.reference.has_scale() {
            return Err(Error::NothingToDo(
                "the reconstruction has no scale, so its lengths are no metres; provide camera positions, ground control points or a scale bar"
                    .to_owned(),
            ));
        }
        Ok(found)
    }
}
