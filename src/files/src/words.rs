//! Words between white space, as text files of blocks have them, and the numbers that files may hold.

/// Size of the largest number: squares and quotients of larger ones cannot be computed with.
pub(super) const LARGEST: f64 = 1e15;

/// What is wrong, and in which line.
pub(super) type Fault = (Option<usize>, String);

/// A number that can be computed with.
///
/// # Errors
/// What is wrong with it.
pub(super) fn usable(what: &str, value: f64) -> Result<f64, String> {
    if !value.is_finite() {
        return Err(format!("{what} is {value}, expected a finite number"));
    }
    if value.abs() > LARGEST {
        return Err(format!("{what} is {value:e}, expected at most {LARGEST:e} in size"));
    }
    Ok(value)
}

/// Whether a field says that there is nothing.
pub(super) fn is_none(field: &str) -> bool {
    let nothing = ["", "nan", "na", "n/a", "none", "null", "-", "*"];
    nothing.iter().any(|of| field.trim().eq_ignore_ascii_case(of))
}

/// The text of a file.
///
/// # Errors
/// Bytes that are not UTF-8; names the line.
pub(super) fn text(bytes: &[u8]) -> Result<&str, Fault> {
    std::str::from_utf8(bytes).map_err(|e| {
        let line = bytes[..e.valid_up_to()].iter().filter(|&&b| b == b'\n').count() + 1;
        (Some(line), "not text".to_owned())
    })
}

/// White-space separated words with the line that each is on; what follows a `#` in a line is a comment.
pub(super) struct Words<'a> {
    text: &'a str,
    line: usize,
    whole: &'static str,
}

impl<'a> Words<'a> {
    /// Of a file.
    pub(super) fn of_file(text: &'a str) -> Words<'a> {
        Words { text, line: 1, whole: "file" }
    }

    /// Of the line with this number.
    pub(super) fn of_line((line, text): (usize, &'a str)) -> Words<'a> {
        Words { text, line, whole: "line" }
    }

    pub(super) fn fault(&self, message: String) -> Fault {
        (Some(self.line), message)
    }

    /// The next word, where there is one.
    pub(super) fn next(&mut self) -> Option<&'a str> {
        let bytes = self.text.as_bytes();
        let mut start = 0;
        while start < bytes.len() && (bytes[start].is_ascii_whitespace() || bytes[start] == b'#') {
            if bytes[start] == b'#' {
                start += bytes[start..].iter().take_while(|b| **b != b'\n').count();
            } else {
                self.line += usize::from(bytes[start] == b'\n');
                start += 1;
            }
        }
        let length = bytes[start..].iter().take_while(|b| !b.is_ascii_whitespace()).count();
        let word = &self.text[start..start + length];
        self.text = &self.text[start + length..];
        (!word.is_empty()).then_some(word)
    }

    pub(super) fn word(&mut self, what: &str) -> Result<&'a str, Fault> {
        let next = self.next();
        next.ok_or_else(|| self.fault(format!("the {} ends where {what} was expected", self.whole)))
    }

    pub(super) fn number<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, Fault> {
        let word = self.word(what)?;
        word.parse().map_err(|_| self.fault(format!("expected {what}, found {word:?}")))
    }

    pub(super) fn finite(&mut self, what: &str) -> Result<f64, Fault> {
        let value = self.number(what)?;
        usable(what, value).map_err(|message| self.fault(message))
    }

    pub(super) fn many<const N: usize>(&mut self, what: &str) -> Result<[f64; N], Fault> {
        let mut out = [0.0; N];
        for value in &mut out {
            *value = self.finite(what)?;
        }
        Ok(out)
    }

    /// Nothing but comments may follow.
    pub(super) fn end(&mut self) -> Result<(), Fault> {
        match self.next() {
            Some(extra) => {
                Err(self.fault(format!("expected the end of the {}, found {extra:?}", self.whole)))
            }
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_know_their_line_and_numbers_their_size() {
        let mut words = Words::of_file("# c\n1 2e3\n\n1e300 # c 5\nNaN");
        assert_eq!(words.many::<2>("a number").unwrap(), [1.0, 2e3]);
        let fault = |words: &mut Words| words.finite("x").unwrap_err();
        assert_eq!(
            fault(&mut words),
            (Some(4), "x is 1e300, expected at most 1e15 in size".into())
        );
        assert_eq!(fault(&mut words), (Some(5), "x is NaN, expected a finite number".into()));
        words.end().unwrap();
        assert_eq!(fault(&mut words).1, "the file ends where x was expected");
        assert!(Words::of_line((3, "a b")).many::<2>("x").unwrap_err().1.contains("found \"a\""));
    }
}
