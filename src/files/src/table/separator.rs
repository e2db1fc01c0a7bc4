//! What separates the fields of a table, and its numbers from their decimals.

/// So many rows tell it.
const SAMPLE: usize = 40;

/// How fields and numbers are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Separator {
    by: u8,
    quote: u8,
    pub(super) decimal_comma: bool,
}

/// The first fields of a table.
struct Sample {
    rows: usize,
    /// Numbers in rows of the usual width.
    numbers: usize,
    /// Fields of those rows.
    fields: usize,
}

impl Separator {
    /// The one that a header has most of; blanks where it has no other.
    pub(super) fn of_header(text: &str) -> Separator {
        let first = text.lines().find(|line| !line.trim().is_empty()).unwrap_or_default();
        let count = |by: &u8| first.bytes().filter(|b| b == by).count();
        let most = *[b'\t', b';', b','].iter().max_by_key(|by| count(by)).unwrap_or(&b',');
        let by = if count(&most) == 0 && first.trim().contains(' ') { b' ' } else { most };
        let quote = if first.trim_start().starts_with('\'') { b'\'' } else { b'"' };
        let mut found = Separator { by, quote, decimal_comma: false };
        let head: String = text.split_inclusive('\n').take(SAMPLE).collect();
        found.decimal_comma = by != b',' && found.has_decimal_commas(&head);
        found
    }

    /// The one by which most fields are numbers, or by which there are most fields.
    pub(super) fn of(text: &str) -> Separator {
        let first = text.lines().find(|line| !line.trim().is_empty()).unwrap_or_default();
        let quote = if first.trim_start().starts_with('\'') { b'\'' } else { b'"' };
        let head: String = text.split_inclusive('\n').take(4 * SAMPLE).collect();
        let mut best = (Separator { by: b',', quote, decimal_comma: false }, (0, 0, 0));
        for by in [b'\t', b';', b',', b' '] {
            let mut separator = Separator { by, quote, decimal_comma: false };
            separator.decimal_comma = separator.has_decimal_commas(&head);
            let sample = separator.sample(&head);
            let score = (sample.numbers, sample.rows, sample.fields);
            if sample.fields > sample.rows && score > best.1 {
                best = (separator, score);
            }
        }
        best.0
    }

    pub(super) fn is_blank(&self) -> bool {
        self.by == b' '
    }

    fn rows_of(&self, head: &str) -> Vec<Vec<String>> {
        let mut rows: Vec<Vec<String>> = Vec::new();
        // What cannot be split says nothing here.
        let _ = self.split(head, |_, fields| {
            rows.push(fields.iter().map(|field| (*field).to_owned()).collect());
            rows.len() < SAMPLE
        });
        rows
    }

    /// Whether fields have a comma where a number has its point, and none has a point there.
    fn has_decimal_commas(&self, head: &str) -> bool {
        let rows = self.rows_of(head);
        let fields = || rows.iter().flatten();
        let with_comma = |field: &&String| {
            field.matches(',').count() == 1 && !field.contains('.') && number(field, true).is_some()
        };
        let with_point = |field: &String| field.contains('.') && field.parse::<f64>().is_ok();
        fields().any(|field| with_comma(&field)) && !fields().any(with_point)
    }

    fn sample(&self, head: &str) -> Sample {
        let rows = self.rows_of(head);
        let mut widths: Vec<usize> = rows.iter().map(Vec::len).collect();
        widths.sort_unstable();
        let usual = widths.get(widths.len() / 2).copied().unwrap_or(0);
        let of_usual: Vec<&Vec<String>> = rows.iter().filter(|row| row.len() == usual).collect();
        let numbers = of_usual.iter().flat_map(|row| row.iter());
        let numbers = numbers.filter(|field| self.number(field).is_some()).count();
        Sample { rows: of_usual.len(), numbers, fields: usual * of_usual.len() }
    }

    pub(super) fn number(&self, field: &str) -> Option<f64> {
        number(field, self.decimal_comma)
    }

    /// The fields of a line.
    pub(super) fn fields_of<'a>(&self, line: &'a str) -> Vec<&'a str> {
        match self.by {
            b' ' => blank_separated(line, char::from(self.quote)),
            by => line.split(char::from(by)).map(str::trim).collect(),
        }
    }

    /// The fields of a line of so many titles, which may be separated otherwise than the rows.
    pub(super) fn titles_of<'a>(&self, line: &'a str, count: usize) -> Vec<&'a str> {
        let others = [b'\t', b';', b','].map(|by| Separator { by, ..*self });
        let mut ways = others.iter().map(|other| other.fields_of(line));
        let own = self.fields_of(line);
        if own.len() == count { own } else { ways.find(|way| way.len() == count).unwrap_or(own) }
    }

    /// Gives the fields of each record with the byte at which it begins, until the listener has enough.
    ///
    /// # Errors
    /// A record that cannot be split.
    pub(super) fn split(
        &self,
        text: &str,
        mut listener: impl FnMut(usize, &[&str]) -> bool,
    ) -> Result<(), String> {
        if self.is_blank() {
            let mut at = 0;
            for line in text.split_inclusive('\n') {
                let fields = blank_separated(line, char::from(self.quote));
                if !fields.is_empty() && !listener(at, &fields) {
                    break;
                }
                at += line.len();
            }
            return Ok(());
        }
        let mut reader = csv::ReaderBuilder::new()
            .has_headers(false)
            .flexible(true)
            .delimiter(self.by)
            .quote(self.quote)
            .trim(csv::Trim::All)
            .from_reader(text.as_bytes());
        let mut record = csv::StringRecord::new();
        while reader.read_record(&mut record).map_err(|e| e.to_string())? {
            let at = record.position().map_or(0, |position| position.byte() as usize);
            let fields: Vec<&str> = record.iter().collect();
            if !listener(at, &fields) {
                break;
            }
        }
        Ok(())
    }
}

/// Words between blanks; a word in quotes may have blanks.
fn blank_separated(line: &str, quote: char) -> Vec<&str> {
    let mut fields = Vec::new();
    let mut rest = line.trim();
    while !rest.is_empty() {
        let quoted = rest.strip_prefix(quote).and_then(|inside| inside.split_once(quote));
        let (field, after) = match quoted {
            Some((field, after)) => (field, after),
            None => rest.split_once(char::is_whitespace).unwrap_or((rest, "")),
        };
        fields.push(field);
        rest = after.trim_start();
    }
    fields
}

/// A number with a decimal point or comma.
pub(super) fn number(field: &str, decimal_comma: bool) -> Option<f64> {
    match field.parse::<f64>() {
        Ok(value) => Some(value),
        Err(_) if decimal_comma && field.matches(',').count() == 1 => {
            field.replace(',', ".").parse().ok()
        }
        Err(_) => None,
    }
}
