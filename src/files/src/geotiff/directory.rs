//! The directories of a cloud optimised GeoTIFF: which tags, in which bytes, where the tiles are.
//!
//! Little-endian; BigTIFF where the offsets need more than 32 bits. All directories stand before the data, the
//! full size first; then the tiles, the smallest overview first.
//!
//! Reference: TIFF 6.0; BigTIFF; OGC GeoTIFF 19-008r4 and Cloud Optimized GeoTIFF 21-026.

use super::{
    FOOT, METRE, SURVEY_FOOT, Sample, TILE,
    write::{Colour, Layout, predictor},
};
use rowgram_raster::{
    georeference::{Crs, CrsKind, Georeference},
    spectral::Band,
};
use std::io::{Result, Write};
use tiff_core::Predictor;

/// The raster or one of its overviews.
#[derive(Debug, Clone)]
pub(super) struct Level {
    /// Columns and rows.
    pub(super) size: [usize; 2],
    /// Offset and length of every tile, row by row.
    pub(super) blocks: Vec<Option<(u64, u64)>>,
}

impl Level {
    /// All levels of a layout, the full size first, until one fits in a tile.
    pub(super) fn all(layout: &Layout) -> Vec<Level> {
        let mut size = [layout.width, layout.height];
        let mut levels = Vec::new();
        loop {
            let [across, down] = size.map(|n| n.div_ceil(TILE));
            levels.push(Level { size, blocks: vec![None; across * down] });
            if size[0].max(size[1]) <= TILE {
                return levels;
            }
            size = size.map(|n| n.div_ceil(2));
        }
    }

    /// Tiles side by side.
    pub(super) fn across(&self) -> usize {
        self.size[0].div_ceil(TILE)
    }

    /// Tiles one below the other.
    pub(super) fn down(&self) -> usize {
        self.size[1].div_ceil(TILE)
    }

    fn bytes(&self) -> u64 {
        self.blocks.iter().flatten().map(|(_, length)| length).sum()
    }
}

/// A value of a tag.
#[derive(Debug, Clone)]
enum Value {
    Short(Vec<u16>),
    Long(Vec<u32>),
    Long8(Vec<u64>),
    Double(Vec<f64>),
    Ascii(String),
}

impl Value {
    /// Code of the type, count, bytes.
    fn encode(&self) -> (u16, u64, Vec<u8>) {
        match self {
            Value::Short(v) => {
                (3, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect())
            }
            Value::Long(v) => (4, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect()),
            Value::Long8(v) => {
                (16, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect())
            }
            Value::Double(v) => {
                (12, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect())
            }
            Value::Ascii(text) => {
                let bytes: Vec<u8> = text.bytes().chain([0]).collect();
                (2, bytes.len() as u64, bytes)
            }
        }
    }
}

/// The tags that all levels share, and those of the full size.
pub(super) struct Directory {
    shared: Vec<(u16, Value)>,
    full: Vec<(u16, Value)>,
}

impl Directory {
    /// The tags of a layout whose samples are `T`, and whose bands have these names, if any.
    pub(super) fn new<T: Sample>(layout: &Layout, names: &[Band]) -> Directory {
        let bands = layout.bands();
        let colours = matches!(layout.colour, Colour::Rgb | Colour::Rgba);
        let extra = bands - if colours { 3 } else { 1 };
        let predictor = match predictor::<T>(layout) {
            Predictor::FloatingPoint => 3,
            Predictor::Horizontal => 2,
            _ => 1,
        };
        let mut shared = vec![
            (258, Value::Short(vec![8 * std::mem::size_of::<T>() as u16; bands])),
            (259, Value::Short(vec![8])),
            (262, Value::Short(vec![if colours { 2 } else { 1 }])),
            (277, Value::Short(vec![bands as u16])),
            (284, Value::Short(vec![1])),
            (317, Value::Short(vec![predictor])),
            (322, Value::Long(vec![TILE as u32])),
            (323, Value::Long(vec![TILE as u32])),
            (339, Value::Short(vec![if T::IS_FLOAT { 3 } else { 1 }; bands])),
        ];
        if extra > 0 {
            // Alpha that the colours are not multiplied with, or no alpha at all.
            let kind = if layout.colour == Colour::Rgba { 2 } else { 0 };
            shared.push((338, Value::Short(vec![kind; extra])));
        }
        if let Some(nodata) = layout.nodata {
            shared.push((42113, Value::Ascii(nodata.to_string())));
        }
        let mut full = layout.georeference.as_ref().map_or_else(Vec::new, place);
        if !names.is_empty() {
            let item = |(k, name): (usize, &Band)| {
                format!(
                    "<Item name=\"DESCRIPTION\" sample=\"{k}\" role=\"description\">{name}</Item>"
                )
            };
            let items: String = names.iter().enumerate().map(item).collect();
            full.push((42112, Value::Ascii(format!("<GDALMetadata>{items}</GDALMetadata>"))));
        }
        Directory { shared, full }
    }

    fn of(&self, levels: &[Level], which: usize, offsets: &[u64], big: bool) -> Vec<(u16, Value)> {
        let level = &levels[which];
        let mut tags = self.shared.clone();
        tags.push((254, Value::Long(vec![u32::from(which > 0)])));
        tags.push((256, Value::Long(vec![level.size[0] as u32])));
        tags.push((257, Value::Long(vec![level.size[1] as u32])));
        tags.push((
            324,
            match big {
                true => Value::Long8(offsets.to_vec()),
                false => Value::Long(offsets.iter().map(|&x| x as u32).collect()),
            },
        ));
        let lengths = level.blocks.iter().map(|block| block.map_or(0, |(_, n)| n as u32));
        tags.push((325, Value::Long(lengths.collect())));
        if which == 0 {
            tags.extend(self.full.iter().cloned());
        }
        tags.sort_by_key(|(tag, _)| *tag);
        tags
    }
}

/// `GTCitationGeoKey`, and the tag with the texts of keys.
const CITATION: u16 = 1026;
const ASCII_PARAMETERS: u16 = 34_737;

/// The directory of keys that names a coordinate reference system (GeoTIFF 1.1, 7.1.1), with one key more.
pub(crate) fn geo_keys(crs: &Crs, more: Option<(u16, u16)>) -> Vec<u16> {
    const USER_DEFINED: u16 = 32767;
    let code = crs.epsg.and_then(|epsg| u16::try_from(epsg).ok());
    // Key and value.
    let mut keys: Vec<(u16, u16)> = more.into_iter().collect();
    match (crs.kind, code) {
        (CrsKind::Projected | CrsKind::Unknown, Some(code)) => {
            keys.extend([(1024, 1), (3072, code)]);
        }
        (CrsKind::Feet | CrsKind::SurveyFeet, code) => {
            let is_survey = crs.kind == CrsKind::SurveyFeet;
            let unit = if is_survey { SURVEY_FOOT } else { FOOT };
            keys.extend([(1024, 1), (3072, code.unwrap_or(USER_DEFINED)), (3076, unit)]);
        }
        (CrsKind::Geographic, Some(code)) => keys.extend([(1024, 2), (2048, code)]),
        (CrsKind::Projected, None) => {
            keys.extend([(1024, 1), (3072, USER_DEFINED), (3076, METRE)]);
        }
        (CrsKind::Geographic, None) => keys.push((1024, 2)),
        (CrsKind::Unknown, None) => {}
    }
    if let Some(code) = crs.vertical_epsg.and_then(|epsg| u16::try_from(epsg).ok()) {
        keys.extend([(4096, code), (4099, METRE)]);
    }
    keys.sort_unstable();
    // Revision 1.1 where heights have a datum: GDAL takes those of 1.0 for a habit without meaning.
    let minor = u16::from(crs.vertical_epsg.is_some());
    let mut directory = vec![1, 1, minor, keys.len() as u16];
    directory.extend(keys.into_iter().flat_map(|(key, value)| [key, 0, 1, value]));
    directory
}

/// Where the raster lies: GeoTIFF counts from the corner of the first pixel.
fn place(place: &Georeference) -> Vec<(u16, Value)> {
    let corner = place.map([-0.5, -0.5]);
    let ([a, c], [b, d]) = (place.per_column, place.per_row);
    let mut tags = if b == 0.0 && c == 0.0 && a > 0.0 && d < 0.0 {
        vec![
            (33550, Value::Double(vec![a, -d, 0.0])),
            (33922, Value::Double(vec![0.0, 0.0, 0.0, corner[0], corner[1], 0.0])),
        ]
    } else {
        let rows = [[a, b, 0.0, corner[0]], [c, d, 0.0, corner[1]], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
        vec![(34264, Value::Double(rows.concat()))]
    };
    // The key of the raster's kind says that a pixel is an area.
    let mut keys = geo_keys(&place.crs, Some((1025, 1)));
    // A system without a code: its PROJ string is the citation, from which it is read again.
    if let Some(definition) = place.crs.definition {
        let text = format!("{definition}|");
        let at = 4 + keys[4..].chunks(4).take_while(|key| key[0] < CITATION).count() * 4;
        keys.splice(at..at, [CITATION, ASCII_PARAMETERS, text.len() as u16, 0]);
        keys[3] += 1;
        tags.push((ASCII_PARAMETERS, Value::Ascii(text)));
    }
    tags.push((34735, Value::Short(keys)));
    tags
}

/// Room that a directory takes, with the values that do not fit in its entries.
fn room(tags: &[(u16, Value)], big: bool) -> u64 {
    let (head, entry, inline) = if big { (16, 20, 8) } else { (6, 12, 4) };
    let long = tags.iter().map(|(_, value)| value.encode().2.len() as u64).filter(|&n| n > inline);
    head + entry * tags.len() as u64 + long.map(|n| n.next_multiple_of(8)).sum::<u64>() + 8
}

/// Writes the whole file; `copy(offset, length, out)` brings a tile.
pub(super) fn emit<W: Write>(
    out: &mut W,
    directory: &Directory,
    levels: &[Level],
    copy: &mut dyn FnMut(u64, u64, &mut W) -> Result<()>,
) -> Result<()> {
    let data: u64 = levels.iter().map(Level::bytes).sum();
    let start = |big: bool| -> (u64, Vec<u64>) {
        let mut at = 16;
        let mut starts = Vec::new();
        for which in 0..levels.len() {
            starts.push(at);
            let none = vec![0; levels[which].blocks.len()];
            at += room(&directory.of(levels, which, &none, big), big).next_multiple_of(8);
        }
        (at, starts)
    };
    let big = start(false).0 + data >= u64::from(u32::MAX);
    let (first_tile, starts) = start(big);
    let mut offsets: Vec<Vec<u64>> = vec![Vec::new(); levels.len()];
    let mut at = first_tile;
    for which in (0..levels.len()).rev() {
        for (_, length) in levels[which].blocks.iter().flatten() {
            offsets[which].push(at);
            at += length;
        }
    }
    let mut head = Vec::with_capacity(first_tile as usize);
    head.extend(b"II");
    if big {
        head.extend([43u16, 8, 0].iter().flat_map(|x| x.to_le_bytes()));
        head.extend(16u64.to_le_bytes());
    } else {
        head.extend(42u16.to_le_bytes());
        head.extend(16u32.to_le_bytes());
        head.resize(16, 0);
    }
    for which in 0..levels.len() {
        let tags = directory.of(levels, which, &offsets[which], big);
        let next = starts.get(which + 1).copied().unwrap_or(0);
        put_directory(&mut head, &tags, next, big);
        head.resize(starts.get(which + 1).copied().unwrap_or(first_tile) as usize, 0);
    }
    out.write_all(&head)?;
    for level in levels.iter().rev() {
        for &(offset, length) in level.blocks.iter().flatten() {
            copy(offset, length, out)?;
        }
    }
    Ok(())
}

fn put_directory(head: &mut Vec<u8>, tags: &[(u16, Value)], next: u64, big: bool) {
    let (entry, inline, count) = if big { (20, 8, 8) } else { (12, 4, 2) };
    // Long values stand behind the entries and the offset of the next directory.
    let mut behind = head.len() + count + entry * tags.len() + if big { 8 } else { 4 };
    behind = behind.next_multiple_of(8);
    let mut long: Vec<u8> = Vec::new();
    let from = behind;
    if big {
        head.extend((tags.len() as u64).to_le_bytes());
    } else {
        head.extend((tags.len() as u16).to_le_bytes());
    }
    for (tag, value) in tags {
        let (kind, n, mut bytes) = value.encode();
        head.extend(tag.to_le_bytes());
        head.extend(kind.to_le_bytes());
        if bytes.len() > inline {
            let at = (behind + long.len()) as u64;
            long.extend(bytes);
            long.resize(long.len().next_multiple_of(8), 0);
            bytes = at.to_le_bytes()[..inline].to_vec();
        }
        bytes.resize(inline, 0);
        if big {
            head.extend(n.to_le_bytes());
        } else {
            head.extend((n as u32).to_le_bytes());
        }
        head.extend(bytes);
    }
    head.extend(&next.to_le_bytes()[..if big { 8 } else { 4 }]);
    head.resize(from, 0);
    head.extend(long);
}
