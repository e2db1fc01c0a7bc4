//! Identifiers that an ontology or a database of breeders has for traits.
//!
//! The Crop Ontology has variables of its own for every crop, and databases have others again, so which identifier a trait has
//! is said by whoever sends the values: a table with the columns `trait` (a name of the trait dictionary) and `id`, such as
//! `CO_322:0000994`.

use rowgram_base::options::nearest;
use rowgram_files::csv_table::CsvTable;
use rowgram_optim::output::FileError;
use rowgram_plants::phenotype::traits::Trait;
use std::{collections::BTreeMap, path::Path};

/// Identifiers by trait.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct VariableIds(BTreeMap<String, String>);

impl VariableIds {
    /// Reads a table of these traits.
    ///
    /// # Errors
    /// A table without these columns, a trait that there is not or that stands twice, an identifier that is empty or
    /// stands at two traits.
    pub(super) fn read(path: &Path, all: &[Trait]) -> Result<VariableIds, FileError> {
        let table = CsvTable::read(path)?;
        let wrong = |line: usize, message: String| FileError::malformed(path, Some(line), message);
        let (Some(traits), Some(ids)) = (table.texts("trait"), table.texts("id")) else {
            return Err(wrong(1, "expected the columns trait and id".to_owned()));
        };
        let names: Vec<&str> = all.iter().map(|of| &*of.name).collect();
        let mut found = BTreeMap::new();
        for (row, (name, id)) in traits.into_iter().zip(ids).enumerate() {
            let (line, name, id) = (row + 2, name.trim(), id.trim());
            let Some(of) = all.iter().find(|of| of.name == name) else {
                let hint = nearest(name, &names)
                    .map_or(String::new(), |near| format!("; did you mean {near}?"));
                return Err(wrong(line, format!("there is no trait {name:?}{hint}")));
            };
            if id.is_empty() || found.values().any(|other| other == id) {
                let message = format!("{name}: expected an identifier of its own, found {id:?}");
                return Err(wrong(line, message));
            }
            if found.insert(of.name.to_string(), id.to_owned()).is_some() {
                return Err(wrong(line, format!("{name} stands twice")));
            }
        }
        Ok(VariableIds(found))
    }

    /// The identifier of a trait; its name where nothing else is said.
    pub(super) fn of<'a>(&'a self, of: &'a Trait) -> &'a str {
        self.0.get(&*of.name).map_or(&*of.name, String::as_str)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_plants::phenotype::traits::TRAITS;

    #[test]
    fn identifiers_are_read_and_mistakes_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("variables.csv");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            VariableIds::read(&path, TRAITS)
        };
        let ids = read("trait,id\nplants,CO_322:0000994\ncanopy_cover, X:1 \n").unwrap();
        let id = |name: &str| ids.of(TRAITS.iter().find(|of| of.name == name).unwrap()).to_owned();
        assert_eq!([id("plants"), id("canopy_cover"), id("exg")], ["CO_322:0000994", "X:1", "exg"]);
        for (text, parts) in [
            ("trait,code\nplants,1\n", "columns trait and id"),
            ("trait,id\nplant,1\n", "did you mean plants?"),
            ("trait,id\nplants,\n", "an identifier of its own"),
            ("trait,id\nplants,1\nexg,1\n", "an identifier of its own"),
            ("trait,id\nplants,1\nplants,2\n", "plants stands twice"),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(parts), "{text}: {error}");
        }
    }
}
