//! Where ground points are in photos, read for a block and changed in place.

use super::{Defaults, IMAGE, Names, no_such_image, nothing_matches};
use crate::{
    FileError,
    csv_table::CsvWriter,
    table::{Column, Table},
};
use rowgram_optim::output;
use rowgram_survey::scene::{Excluded, ExcludedKind, GroundObservation, GroundPoint};
use std::{collections::HashMap, path::Path};

/// The point of a mark: no image is called so.
const POINT_OF_MARK: &[&str] =
    &["label", "point", "gcp", "gcp_label", "gcp_name", "marker", "point_name", "name", "id"];
const COLUMN_PX: &[&str] =
    &["u_px", "u", "x_px", "px", "pixel_x", "x_pixel", "image_x", "im_x", "col", "column", "x"];
const ROW_PX: &[&str] =
    &["v_px", "v", "y_px", "py", "pixel_y", "y_pixel", "image_y", "im_y", "row", "line", "y"];

/// Columns of marks without a header: those that name images and points, and the two numbers after them.
fn unnamed_marks(
    table: &Table,
    names: &Names<'_>,
    points: &HashMap<&str, u32>,
) -> Result<[Column; 4], FileError> {
    let first = |is: &dyn Fn(&str) -> bool| {
        let mut columns = table.columns().map(|(_, column)| column);
        columns.find(|column| table.rows().iter().any(|row| is(table.text(row, *column))))
    };
    let image = first(&|text| names.find(text).is_some());
    let label = first(&|text| points.contains_key(text));
    let mut numbers = table.columns().map(|(_, column)| column).filter(|column| {
        let others = Some(*column) != image && Some(*column) != label;
        others && table.rows().iter().all(|row| table.parse(row, *column).is_some())
    });
    match (image, label, numbers.next(), numbers.next()) {
        (Some(image), Some(label), Some(u), Some(v)) => Ok([image, label, u, v]),
        _ => Err(table.whole_fault(
            "it has no header, and its columns are not the image, the name of the point, its column and its row in pixels: expected a header image, label, u_px, v_px".into(),
        )),
    }
}

/// Where a row of a file of marks comes from: its column `source`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MarkSource {
    /// Made by hand: every word but those below, and none.
    Hand,
    /// `found`: by a program, which may measure it anew.
    Found,
    /// `removed`: found by a program and taken back by a person. It is no mark and is not to be found again.
    Removed,
}

impl MarkSource {
    fn of(text: &str) -> MarkSource {
        let known = [MarkSource::Found, MarkSource::Removed];
        known.into_iter().find(|source| source.text() == text).unwrap_or(MarkSource::Hand)
    }

    fn text(self) -> &'static str {
        match self {
            MarkSource::Hand => "",
            MarkSource::Found => "found",
            MarkSource::Removed => "removed",
        }
    }
}

/// A row of a file of marks.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkRow {
    /// Index of the image; `None` where the block has none of that name.
    pub image: Option<u32>,
    /// Index of the ground point; `None` where there is none of that name.
    pub ground: Option<u32>,
    /// Pixels.
    pub image_px: [f64; 2],
    /// Standard deviation of each coordinate, pixels, where it is given.
    pub sigma_px: Option<f64>,
    /// Who made it.
    pub source: MarkSource,
    line: usize,
    cells: Vec<String>,
}

/// A file of marks that can be changed: what is not changed stays as it is, columns without a meaning here included.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkTable {
    comments: Vec<String>,
    header: Vec<String>,
    /// Where in a row the image, the point, column, row, standard deviation and source stand.
    places: [usize; 6],
    /// The marks in the order of the file.
    pub rows: Vec<MarkRow>,
}

impl Default for MarkTable {
    fn default() -> MarkTable {
        MarkTable {
            comments: Vec::new(),
            header: ["image", "label", "u_px", "v_px", "sigma_px", "source"]
                .map(str::to_owned)
                .into(),
            places: [0, 1, 2, 3, 4, 5],
            rows: Vec::new(),
        }
    }
}

impl MarkTable {
    /// Reads a file.
    ///
    /// # Errors
    /// Missing columns, fields that are no numbers, a point that is marked twice in one image.
    pub fn read(
        path: &Path,
        names: &Names<'_>,
        ground: &[GroundPoint],
    ) -> Result<MarkTable, FileError> {
        let table = Table::read(path)?;
        let points: HashMap<&str, u32> =
            ground.iter().enumerate().map(|(k, point)| (point.name.as_str(), k as u32)).collect();
        let own = if table.is_named() {
            [
                table.required("image", IMAGE)?,
                table.required("name of the point", POINT_OF_MARK)?,
                table.required("column in the image", COLUMN_PX)?,
                table.required("row in the image", ROW_PX)?,
            ]
        } else {
            unnamed_marks(&table, names, &points)?
        };
        let [image, label, u, v] = own;
        let sigma = table.column(&["sigma_px"]);
        let source = table.column(&["source"]);
        let mut header = table.header().to_vec();
        let place = |column: Column| table.columns().position(|(_, other)| other == column);
        let mut places = [0; 6];
        let usual = MarkTable::default().header;
        for (k, column) in own.map(Some).into_iter().chain([sigma, source]).enumerate() {
            places[k] = column.and_then(place).unwrap_or_else(|| {
                header.push(usual[k].clone());
                header.len() - 1
            });
            if !table.is_named() {
                header[places[k]].clone_from(&usual[k]);
            }
        }
        let mut rows: Vec<MarkRow> = Vec::new();
        let mut lines: HashMap<(u32, u32), usize> = HashMap::new();
        for row in table.rows() {
            let at = [table.number(row, u)?, table.number(row, v)?];
            let sigma_px = table.positive_or(row, sigma, f64::NAN)?;
            let mut cells: Vec<String> =
                table.columns().map(|(_, column)| table.text(row, column).to_owned()).collect();
            cells.resize(header.len(), String::new());
            // A decimal comma would not be told from a separator.
            (cells[places[2]], cells[places[3]]) = (at[0].to_string(), at[1].to_string());
            if sigma_px.is_finite() {
                cells[places[4]] = sigma_px.to_string();
            }
            let (image, label) = (table.text(row, image), table.text(row, label));
            let found = MarkRow {
                image: names.find(image),
                ground: points.get(label).copied(),
                image_px: at,
                sigma_px: Some(sigma_px).filter(|sigma| sigma.is_finite()),
                source: source
                    .map_or(MarkSource::Hand, |column| MarkSource::of(table.text(row, column))),
                line: row.line,
                cells,
            };
            if let (Some(at), Some(ground)) = (found.image, found.ground)
                && let Some(line) = lines.insert((at, ground), row.line)
            {
                let message = format!("{label} is marked twice in {image}, first in line {line}");
                return Err(table.fault(row, message));
            }
            rows.push(found);
        }
        Ok(MarkTable { comments: table.comments().to_vec(), header, places, rows })
    }

    /// Puts a mark in place of the one that its point has in its image, or behind all others.
    pub fn set(
        &mut self,
        (image, ground): (u32, u32),
        [image_name, label]: [&str; 2],
        image_px: [f64; 2],
        sigma_px: Option<f64>,
        source: MarkSource,
    ) {
        let place = self.place((image, ground));
        let mut cells = match place {
            Some(place) => self.rows[place].cells.clone(),
            None => {
                let mut cells = vec![String::new(); self.header.len()];
                image_name.clone_into(&mut cells[self.places[0]]);
                label.clone_into(&mut cells[self.places[1]]);
                cells
            }
        };
        cells[self.places[2]] = format!("{:.3}", image_px[0]);
        cells[self.places[3]] = format!("{:.3}", image_px[1]);
        cells[self.places[4]] = sigma_px.map_or(String::new(), |sigma| format!("{sigma:.3}"));
        cells[self.places[5]] = source.text().to_owned();
        let line = place.map_or(0, |place| self.rows[place].line);
        let (image, ground) = (Some(image), Some(ground));
        let row = MarkRow { image, ground, image_px, sigma_px, source, line, cells };
        match place {
            Some(place) => self.rows[place] = row,
            None => self.rows.push(row),
        }
    }

    /// Takes back the mark of a point in an image. Of one that was found a row stays, so that it is not found again.
    pub fn remove(&mut self, ends: (u32, u32)) {
        let Some(place) = self.place(ends) else { return };
        match self.rows[place].source {
            MarkSource::Hand => drop(self.rows.remove(place)),
            MarkSource::Found | MarkSource::Removed => {
                let row = &mut self.rows[place];
                row.source = MarkSource::Removed;
                row.cells[self.places[5]] = row.source.text().to_owned();
            }
        }
    }

    fn place(&self, (image, ground): (u32, u32)) -> Option<usize> {
        self.rows.iter().position(|row| (row.image, row.ground) == (Some(image), Some(ground)))
    }

    /// Writes the file.
    ///
    /// # Errors
    /// A file that exists unless `force`; where it cannot be written.
    pub fn write(&self, path: &Path, force: bool) -> Result<(), FileError> {
        output::write(path, force, |out| {
            for comment in &self.comments {
                writeln!(out, "{comment}")?;
            }
            let mut csv = CsvWriter::new(out);
            csv.write_record(&self.header)?;
            for row in &self.rows {
                csv.write_record(&row.cells)?;
            }
            csv.flush()
        })
    }
}

/// Reads marks; those in images that are not in the block are set aside by name.
///
/// # Errors
/// As [`MarkTable::read`]; a ground point that is not there, rows none of which names an image of the block.
pub fn marks(
    path: &Path,
    names: &Names<'_>,
    ground: &[GroundPoint],
    defaults: &Defaults,
) -> Result<(Vec<GroundObservation>, Vec<Excluded>), FileError> {
    let table = MarkTable::read(path, names, ground)?;
    let mut found = Vec::new();
    let mut aside = Vec::new();
    for row in table.rows.iter().filter(|row| row.source != MarkSource::Removed) {
        let [name, label] = [0, 1].map(|k| row.cells[table.places[k]].as_str());
        let Some(ground) = row.ground else {
            let message = format!("there is no ground point {label:?}");
            return Err(FileError::malformed(path, row.line, message));
        };
        let sigma_px = row.sigma_px.unwrap_or(defaults.mark_px);
        match row.image {
            None => aside.push(no_such_image(ExcludedKind::Mark, name, Some(label))),
            Some(image) => {
                found.push(GroundObservation { image, ground, image_px: row.image_px, sigma_px });
            }
        }
    }
    if found.is_empty() && !table.rows.is_empty() {
        return Err(FileError::malformed(path, None, nothing_matches(&aside, names)));
    }
    Ok((found, aside))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowgram_survey::scene::{Axes, Role};

    fn block() -> (Names<'static>, Vec<GroundPoint>) {
        let point = |name: &str| GroundPoint {
            name: name.to_owned(),
            position_m: [0.0; 3],
            sigma_m: [0.02; 3],
            role: Role::Control,
            axes: Axes::Xyz,
        };
        (Names::new(["a.jpg", "b.jpg"]), ["T1", "-T2"].map(point).into())
    }

    #[test]
    fn what_is_not_changed_stays_as_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("marks.csv");
        let (names, ground) = block();
        let text =
            "# by Ana\nwho;file;point;x;y\nana;A.JPG;T1;10,25;20\nben;c.jpg;T1;1;2\nana;b;T9;3;4\n";
        std::fs::write(&path, text).unwrap();
        let mut table = MarkTable::read(&path, &names, &ground).unwrap();
        let ends: Vec<_> = table.rows.iter().map(|row| (row.image, row.ground)).collect();
        assert_eq!(ends, [(Some(0), Some(0)), (None, Some(0)), (Some(1), None)]);
        table.set((1, 1), ["b.jpg", "-T2"], [5.0, 6.25], Some(0.1), MarkSource::Found);
        table.set((0, 0), ["a.jpg", "T1"], [11.0, 21.0], None, MarkSource::Hand);
        table.write(&path, true).unwrap();
        let written = std::fs::read_to_string(&path).unwrap();
        assert_eq!(
            written,
            "# by Ana\nwho,file,point,x,y,sigma_px,source\nana,A.JPG,T1,11.000,21.000,,\nben,c.jpg,T1,1,2,,\n\
             ana,b,T9,3,4,,\n,b.jpg,'-T2,5.000,6.250,0.100,found\n"
        );
        let again = MarkTable::read(&path, &names, &ground).unwrap();
        let row = &again.rows[3];
        assert!(
            row.source == MarkSource::Found && row.ground == Some(1) && row.sigma_px == Some(0.1),
            "{row:?}"
        );
        // The reader of a block names the point that is not there with its line.
        let error = marks(&path, &names, &ground, &Defaults::default()).unwrap_err().to_string();
        assert!(error.contains("line 5") && error.contains("T9"), "{error}");
    }

    #[test]
    fn a_removed_mark_is_none_and_is_remembered_where_it_was_found() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("marks.csv");
        let (names, ground) = block();
        let mut table = MarkTable::default();
        table.set((0, 0), ["a.jpg", "T1"], [1.0, 2.0], None, MarkSource::Hand);
        table.set((1, 0), ["b.jpg", "T1"], [3.0, 4.0], Some(0.1), MarkSource::Found);
        table.set((1, 1), ["b.jpg", "-T2"], [5.0, 6.0], Some(0.1), MarkSource::Found);
        for ends in [(0, 0), (1, 0), (0, 1)] {
            table.remove(ends);
        }
        table.write(&path, false).unwrap();
        let again = MarkTable::read(&path, &names, &ground).unwrap();
        let rows: Vec<_> =
            again.rows.iter().map(|row| (row.image, row.ground, row.source)).collect();
        assert_eq!(
            rows,
            [(Some(1), Some(0), MarkSource::Removed), (Some(1), Some(1), MarkSource::Found)]
        );
        let (found, _) = marks(&path, &names, &ground, &Defaults::default()).unwrap();
        assert_eq!(found.len(), 1);
        // A person who marks it after all has the last word.
        table.set((1, 0), ["b.jpg", "T1"], [3.5, 4.0], None, MarkSource::Hand);
        table.write(&path, true).unwrap();
        let (found, _) = marks(&path, &names, &ground, &Defaults::default()).unwrap();
        assert_eq!(found.len(), 2);
    }

    #[test]
    fn a_file_without_a_header_gets_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("marks.csv");
        let (names, ground) = block();
        std::fs::write(&path, "T1 10.5 20 a.jpg\n").unwrap();
        let table = MarkTable::read(&path, &names, &ground).unwrap();
        table.write(&path, true).unwrap();
        let written = std::fs::read_to_string(&path).unwrap();
        assert_eq!(written, "label,u_px,v_px,image,sigma_px,source\nT1,10.5,20,a.jpg,,\n");
        assert_eq!(MarkTable::read(&path, &names, &ground).unwrap().rows[0].image, Some(0));
        let (found, _) = marks(&path, &names, &ground, &Defaults::default()).unwrap();
        assert_eq!(found[0].sigma_px, Defaults::default().mark_px);
    }
}
