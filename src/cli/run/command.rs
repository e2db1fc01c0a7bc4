//! A command of this program, as the stages run it and as a person would type it.

use super::record;
use std::{
    ffi::OsString,
    path::{Path, PathBuf},
};

/// A word of a command.
enum Word {
    Text(String),
    Path(PathBuf),
}

/// A command, and the files that decide what it does beside its words.
pub(super) struct Command {
    words: Vec<Word>,
    pub(super) inputs: Vec<PathBuf>,
    /// Whether the folder keeps what an earlier, unfinished attempt found.
    pub(super) resumes: bool,
}

impl Command {
    pub(super) fn new(verb: &[&str]) -> Command {
        let words = verb.iter().map(|word| Word::Text((*word).to_owned())).collect();
        Command { words, inputs: Vec::new(), resumes: false }
    }

    pub(super) fn word(mut self, word: impl ToString) -> Command {
        self.words.push(Word::Text(word.to_string()));
        self
    }

    pub(super) fn option(self, name: &str, value: impl ToString) -> Command {
        self.word(name).word(value)
    }

    pub(super) fn maybe(self, name: &str, value: Option<impl ToString>) -> Command {
        match value {
            Some(value) => self.option(name, value),
            None => self,
        }
    }

    pub(super) fn flag(self, name: &str, wanted: bool) -> Command {
        if wanted { self.word(name) } else { self }
    }

    pub(super) fn path(mut self, path: &Path) -> Command {
        self.words.push(Word::Path(path.to_owned()));
        self
    }

    /// An option that names a file to be written.
    pub(super) fn to(self, name: &str, path: &Path) -> Command {
        self.word(name).path(path)
    }

    /// An option that names a file to be read.
    pub(super) fn from(mut self, name: &str, path: &Path) -> Command {
        self.inputs.push(path.to_owned());
        self.word(name).path(path)
    }

    pub(super) fn reads(mut self, files: impl IntoIterator<Item = PathBuf>) -> Command {
        self.inputs.extend(files);
        self
    }

    /// The command as the program takes it.
    pub(super) fn arguments(&self) -> Vec<OsString> {
        let words = self.words.iter().map(|word| match word {
            Word::Text(text) => text.into(),
            Word::Path(path) => path.into(),
        });
        std::iter::once("rowgram".into()).chain(words).collect()
    }

    /// The command as a person types it in the project's folder.
    pub(super) fn shown(&self, root: &Path) -> String {
        let words = self.words.iter().map(|word| {
            let text = match word {
                Word::Text(text) => text.clone(),
                Word::Path(path) => {
                    let inside = record::relative(root, path);
                    if inside.as_os_str().is_empty() {
                        ".".to_owned()
                    } else {
                        inside.display().to_string()
                    }
                }
            };
            let plain = |c: char| c.is_alphanumeric() || "._-/,:=+".contains(c);
            if !text.is_empty() && text.chars().all(plain) {
                text
            } else {
                format!("'{}'", text.replace('\'', "'\\''"))
            }
        });
        std::iter::once("rowgram".to_owned()).chain(words).collect::<Vec<_>>().join(" ")
    }
}
