//! The page on which marks of surveyed points are looked at and changed. `marks.js` draws it; what it changes comes back as JSON.

use super::{Answer, Viewer};
use crate::{
    report::page,
    targets::{MarkChanges, MarkEditor, MarkSheet, Saved},
};
use maud::{DOCTYPE, html};
use rowgram_base::error::Error;

pub(super) const SCRIPT: &str = include_str!("marks.js");
pub(super) const STYLE: &str = include_str!("marks.css");

/// The target that changes are put to, and of the marks themselves.
pub(super) const TARGET: &str = "marks.json";

/// The page of a project; `has_map` where there is one of its map, too.
pub(super) fn page(name: &str, has_map: bool) -> String {
    let styles = html! {
        link rel="stylesheet" href="style.css";
        link rel="stylesheet" href="marks.css";
    };
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            (page::head(&format!("Marks of {name}"), &styles))
            body .viewer .marking {
                header {
                    h1 { (name) }
                    @if has_map { a href="./" { "Map" } }
                    p role="status" id="state" { "reading marks" }
                    button type="button" id="discard" disabled { "Discard changes" }
                    button type="button" id="save" .main disabled { "Save" }
                }
                main id="marks" {
                    nav aria-label="Surveyed points" { ol id="points" {} }
                    section aria-label="Photos that show the point" {
                        div .tools {
                            h2 id="point-name" {}
                            label { "shown "
                                input id="shown" type="range" min="0" max="4" step="0.25" value="2" aria-label="Metres that a picture shows";
                                output id="shown-m" {}
                            }
                        }
                        div id="crops" {}
                    }
                    section .loupe aria-label="Loupe" {
                        canvas id="loupe" tabindex="0" aria-label="Enlarged part of the photo" {}
                        p id="place" {}
                        p .note {
                            "A click sets the mark. " kbd { "↑" } kbd { "↓" } kbd { "←" } kbd { "→" } " move it by 0.1 px, with " kbd { "Shift" }
                            " by 1 px. " kbd { "Delete" } " removes it. " kbd { "N" } " and " kbd { "P" } " go to the next and previous photo, "
                            kbd { "Ctrl" } kbd { "S" } " saves. The wheel zooms, dragging moves the picture."
                        }
                        p .key {
                            span .found { "found" } span .hand { "by hand" } span .changed { "not saved" } span .expected { "expected" }
                        }
                    }
                }
                script src="marks.js" {}
            }
        }
    };
    page.into_string()
}

impl Viewer {
    /// The marks as JSON.
    pub(super) fn marks(editor: &MarkEditor) -> Answer {
        match editor.sheet() {
            Ok(sheet) => json(&sheet),
            // It is the file that has to be put right, and this page is where that is seen.
            Err(error) => Answer::failed(500, &error.to_string()),
        }
    }

    /// Writes the changes that were put to a target; `None` where nothing can be put.
    pub(super) fn put(&self, target: &str, body: &[u8]) -> Option<Answer> {
        let editor = self.editor.as_ref().filter(|_| target == TARGET)?;
        let changes: MarkChanges = match serde_json::from_slice(body) {
            Ok(changes) => changes,
            Err(error) => return Some(Answer::failed(400, &format!("not understood: {error}"))),
        };
        Some(match editor.save(&changes) {
            Ok(Saved::Written(sheet)) => json(&sheet),
            Ok(Saved::Outdated) => Answer::failed(
                409,
                "the file of marks has been changed by somebody else: nothing was saved; load the page again and repeat the changes",
            ),
            Err(Error::Argument(message)) => Answer::failed(400, &message),
            Err(error) => Answer::failed(500, &error.to_string()),
        })
    }
}

fn json(sheet: &MarkSheet) -> Answer {
    match serde_json::to_vec(sheet) {
        Ok(body) => Answer::found("application/json", body),
        Err(error) => Answer::unreadable(&error),
    }
}
