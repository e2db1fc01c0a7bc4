//! Bytes to text: UTF-8 and UTF-16 by their byte order mark, UTF-8 without one, else Latin-1 as Windows writes it.

/// Windows' code page 1252 from 0x80 to 0x9f, where it differs from Latin-1.
const WINDOWS: [char; 32] = [
    '€', '\u{81}', '‚', 'ƒ', '„', '…', '†', '‡', 'ˆ', '‰', 'Š', '‹', 'Œ', '\u{8d}', 'Ž', '\u{8f}',
    '\u{90}', '‘', '’', '“', '”', '•', '–', '—', '˜', '™', 'š', '›', 'œ', '\u{9d}', 'ž', 'Ÿ',
];

/// The text of a file.
pub(crate) fn decode(bytes: Vec<u8>) -> String {
    let units = |big: bool| -> Vec<u16> {
        let unit = |pair: &[u8]| {
            let pair = [pair[0], pair[1]];
            if big { u16::from_be_bytes(pair) } else { u16::from_le_bytes(pair) }
        };
        bytes[2..].chunks_exact(2).map(unit).collect()
    };
    if bytes.starts_with(&[0xff, 0xfe]) {
        return String::from_utf16_lossy(&units(false));
    }
    if bytes.starts_with(&[0xfe, 0xff]) {
        return String::from_utf16_lossy(&units(true));
    }
    let text = String::from_utf8(bytes).unwrap_or_else(|error| {
        let letter = |&byte: &u8| match byte {
            0x80..=0x9f => WINDOWS[usize::from(byte) - 0x80],
            byte => char::from(byte),
        };
        error.as_bytes().iter().map(letter).collect()
    });
    match text.strip_prefix('\u{feff}') {
        Some(rest) => rest.to_owned(),
        None => text,
    }
}
