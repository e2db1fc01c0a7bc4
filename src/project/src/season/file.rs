//! `season.toml`: the flights over one field, their dates, and how they are brought together.
//!
//! ```text
//! name = "Trial 7"
//! sown = "2015-05-20"
//! plots = "plots.geojson"
//!
//! [[flights]]
//! project = "2015-05-28"
//! date = "2015-05-28"
//!
//! [season]
//! search_m = 3.0
//! ```
//!
//! Paths are relative to the file.

use super::SeasonOptions;
use crate::stac;
use rowgram_base::{
    error::Error,
    options::{Options, nearest},
};
use rowgram_files::read_text;
use rowgram_optim::output::{self, FileError};
use rowgram_plants::phenotype::traits::known_traits;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The usual name of the file.
pub const SEASON_FILE: &str = "season.toml";

/// Whose frame a flight is in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Frame {
    /// That of its own ground control, which is that of the season.
    Own,
    /// Its own is not trusted: it is tied to other flights.
    Tied,
}

/// A flight.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightEntry {
    /// The folder of its project.
    pub project: PathBuf,
    /// The day of the flight, `YYYY-MM-DD`, quoted or not.
    #[serde(deserialize_with = "date_text")]
    pub date: String,
    /// Whose frame it is in; where not set, its own where ground control took part in its adjustment.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<Frame>,
    /// Panels of known reflectance, drawn on the map of this flight.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub panels: Option<PathBuf>,
}

/// What the file says.
#[derive(Debug, Clone, PartialEq)]
pub struct SeasonFile {
    /// Where it is.
    pub path: PathBuf,
    /// Name in the report.
    pub name: String,
    /// When the field was sown, days from 1970-01-01.
    pub sown: Option<i64>,
    /// Polygons of the plots.
    pub plots: Option<PathBuf>,
    /// Panels of known reflectance, in the frame of the season.
    pub panels: Option<PathBuf>,
    /// Traits whose growth is fitted.
    pub traits: Vec<String>,
    /// The flights by date.
    pub flights: Vec<FlightEntry>,
    /// How they are brought together.
    pub options: SeasonOptions,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Content {
    name: Option<String>,
    #[serde(default, deserialize_with = "optional_date_text")]
    sown: Option<String>,
    plots: Option<PathBuf>,
    panels: Option<PathBuf>,
    traits: Option<Vec<String>>,
    #[serde(default)]
    flights: Vec<toml::Spanned<FlightEntry>>,
    season: Option<toml::Table>,
}

/// A date as a text or as TOML's own.
#[derive(Deserialize)]
#[serde(untagged, expecting = "expected a date like 2015-05-28")]
enum DateText {
    Text(String),
    Date(toml::value::Datetime),
}

fn date_text<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    Ok(match DateText::deserialize(deserializer)? {
        DateText::Text(text) => text,
        DateText::Date(date) => date.to_string(),
    })
}

fn optional_date_text<'de, D: serde::Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<String>, D::Error> {
    date_text(deserializer).map(Some)
}

/// Traits whose growth is fitted where the file names none.
const USUAL_TRAITS: [&str; 3] = ["canopy_cover", "plants", "canopy_height_m"];

impl SeasonFile {
    /// Reads the file.
    ///
    /// # Errors
    /// A file that cannot be read; in which line a key, a date or a folder is not as it has to be, and what was expected.
    pub fn read(path: &Path) -> Result<SeasonFile, Error> {
        let text = read_text(path)?;
        let line_of = |at: usize| text.get(..at).map(|before| before.matches('\n').count() + 1);
        let content: Content = toml::from_str(&text).map_err(|error| {
            let line = error.span().and_then(|span| line_of(span.start));
            FileError::malformed(path, line, error.message())
        })?;
        let malformed = |line: Option<usize>, message: String| -> Error {
            FileError::malformed(path, line, message).into()
        };
        let root = output::folder_of(path);
        let options = match &content.season {
            Some(table) => SeasonOptions::default()
                .with(table)
                .and_then(|options| options.validate().map(|()| options))
                .map_err(|why| malformed(None, format!("[season] {why}")))?,
            None => SeasonOptions::default(),
        };
        let day = |text: &str| {
            days_from_epoch(text)
                .ok_or_else(|| format!("{text:?}: expected a date like 2015-05-28"))
        };
        let sown = content.sown.as_deref().map(day).transpose();
        let sown = sown.map_err(|why| malformed(None, format!("sown = {why}")))?;
        let traits: Vec<String> =
            content.traits.unwrap_or_else(|| USUAL_TRAITS.map(str::to_owned).to_vec());
        for name in &traits {
            let all = known_traits();
            if !all.iter().any(|of| of.name == *name) {
                let names: Vec<&str> = all.iter().map(|of| &*of.name).collect();
                let near = nearest(name, &names).map(|near| format!("; did you mean {near:?}?"));
                let message =
                    format!("traits: {name:?} is no trait of plots{}", near.unwrap_or_default());
                return Err(malformed(None, message));
            }
        }
        let mut flights: Vec<(i64, usize, FlightEntry)> = Vec::new();
        for flight in content.flights {
            let line = line_of(flight.span().start);
            let flight = flight.into_inner();
            let date = day(&flight.date).map_err(|why| malformed(line, format!("date = {why}")))?;
            if !root.join(&flight.project).is_dir() {
                let message = format!("project = {:?}: there is no such folder", flight.project);
                return Err(malformed(line, message));
            }
            if let Some(panels) = flight.panels.as_ref().filter(|of| !root.join(of).is_file()) {
                let message = format!("panels = {panels:?}: there is no such file");
                return Err(malformed(line, message));
            }
            if sown.is_some_and(|sown| date < sown) {
                return Err(malformed(
                    line,
                    format!("date = {:?}: it is before sowing", flight.date),
                ));
            }
            if flights.iter().any(|(other, _, _)| *other == date) {
                let message = format!("date = {:?}: another flight has this date", flight.date);
                return Err(malformed(line, message));
            }
            let folder = |flight: &FlightEntry| root.join(&flight.project).canonicalize().ok();
            let own = folder(&flight);
            if flights.iter().any(|(_, _, other)| folder(other) == own) {
                let message = format!("project = {:?}: it is listed twice", flight.project);
                return Err(malformed(line, message));
            }
            flights.push((date, flights.len(), flight));
        }
        if flights.is_empty() {
            return Err(malformed(None, "no [[flights]]: expected one or more".to_owned()));
        }
        flights.sort_by_key(|(date, order, _)| (*date, *order));
        let plots = content.plots.map(|plots| root.join(plots));
        let panels = content.panels.map(|panels| root.join(panels));
        for (key, path) in [("plots", &plots), ("panels", &panels)] {
            if let Some(path) = path.as_ref().filter(|path| !path.is_file()) {
                return Err(malformed(None, format!("{key}: there is no file {}", path.display())));
            }
        }
        let folder = root.canonicalize().ok();
        let folder_name = folder.and_then(|root| Some(root.file_name()?.to_str()?.to_owned()));
        Ok(SeasonFile {
            path: path.to_owned(),
            name: content.name.or(folder_name).unwrap_or_else(|| "season".to_owned()),
            sown,
            plots,
            panels,
            traits,
            flights: flights.into_iter().map(|(_, _, flight)| flight).collect(),
            options,
        })
    }

    /// The folder that paths are relative to.
    pub fn root(&self) -> PathBuf {
        output::folder_of(&self.path).to_owned()
    }

    /// The folder of the results: `season` beside `season.toml`, `NAME-season` beside another `NAME.toml`, so that seasons in one folder
    /// keep theirs apart.
    pub fn results(&self) -> PathBuf {
        let name = self.path.file_stem().and_then(|stem| stem.to_str()).unwrap_or("season");
        self.root().join(if name == "season" { name.to_owned() } else { format!("{name}-season") })
    }

    /// Days from sowing, or from the first flight where nobody says when the field was sown.
    pub fn day(&self, flight: &FlightEntry) -> f64 {
        let of = |date: &str| days_from_epoch(date).unwrap_or_default();
        let first = self.flights.first().map_or(0, |first| of(&first.date));
        (of(&flight.date) - self.sown.unwrap_or(first)) as f64
    }
}

/// Days from 1970-01-01 to a date, `YYYY-MM-DD`, of the Gregorian calendar; `None` where it is none.
fn days_from_epoch(text: &str) -> Option<i64> {
    let date: toml::value::Datetime = text.parse().ok()?;
    let (toml::value::Date { year, month, day }, None, None) = (date.date?, date.time, date.offset)
    else {
        return None;
    };
    Some(stac::days(year.into(), month.into(), day.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<SeasonFile, String> {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a", "b"] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
        }
        let path = folder.path().join(SEASON_FILE);
        std::fs::write(&path, text).unwrap();
        SeasonFile::read(&path).map_err(|error| error.to_string())
    }

    const TWO: &str = "sown = \"2016-02-20\"\n[[flights]]\nproject = \"b\"\ndate = \"2016-03-01\"\n\
                       [[flights]]\nproject = \"a\"\ndate = \"2016-02-28\"\nframe = \"own\"\n";

    #[test]
    fn flights_come_in_the_order_of_their_dates() {
        let file = read(TWO).unwrap();
        let days: Vec<f64> = file.flights.iter().map(|flight| file.day(flight)).collect();
        assert_eq!(days, [8.0, 10.0], "2016 is a leap year");
        assert_eq!(file.flights[0].frame, Some(Frame::Own));
        assert_eq!(file.traits.len(), 3);
        let without = read(&TWO.replace("sown = \"2016-02-20\"\n", "")).unwrap();
        assert_eq!(without.day(&without.flights[1]), 2.0);
        let unquoted = TWO.replace("\"2016-02-20\"", "2016-02-20");
        let unquoted = read(&unquoted.replace("\"2016-02-28\"", "2016-02-28")).unwrap();
        assert_eq!(unquoted.flights, file.flights);
        assert_eq!(unquoted.sown, file.sown);
    }

    #[test]
    fn faults_are_named_with_their_line() {
        for (text, words) in [
            ("name = 3\n", "season.toml, line 1"),
            ("", "no [[flights]]"),
            ("[[flights]]\nproject = \"c\"\ndate = \"2016-03-01\"\n", "no such folder"),
            ("[[flights]]\nproject = \"a\"\ndate = \"2016-02-30\"\n", "expected a date"),
            ("[[flights]]\nproject = \"a\"\ndata = \"2016-02-28\"\n", "unknown field"),
            ("sown = \"March\"\n[[flights]]\nproject = \"a\"\ndate = \"2016-02-28\"\n", "sown ="),
            (
                "panels = \"p.csv\"\n[[flights]]\nproject = \"a\"\ndate = \"2016-02-28\"\n",
                "panels: there is no file",
            ),
            (
                "[[flights]]\nproject = \"a\"\ndate = \"2016-02-28\"\npanels = \"p.csv\"\n",
                "panels = \"p.csv\": there is no such file",
            ),
            (
                "plots = \"p.geojson\"\n[[flights]]\nproject = \"a\"\ndate = \"2016-02-28\"\n",
                "no file",
            ),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
        for (from, to, words) in [
            ("2016-02-28", "2016-03-01", "another flight has this date"),
            ("2016-02-28", "2016-02-19", "before sowing"),
            ("\"a\"", "\"b\"", "listed twice"),
            ("\"a\"", "\"./b\"", "listed twice"),
            ("\"2016-02-28\"", "3", "expected a date"),
            ("sown", "traits = [\"canopy_cove\"]\nsown", "did you mean \"canopy_cover\"?"),
        ] {
            let error = read(&TWO.replacen(from, to, 1)).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
        let error = read(&format!("{TWO}[season]\nsearch_m = -1.0\n")).unwrap_err();
        assert!(error.contains("[season] search_m = -1.0: expected"), "{error}");
    }
}
