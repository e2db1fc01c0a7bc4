//! What is painted on targets.
//!
//! A pattern is a square of cells in the frame of the target, its size 1, the first row on top; a disc has none. Code words of coded
//! ones are written row by row, the first cell the most significant bit, 1 white.

use crate::field::words;
use serde::{Deserialize, Serialize};
use std::{fmt, str::FromStr};

/// A pattern.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TargetPattern {
    /// Two black and two white quadrants; the size is the side of the plate.
    #[default]
    Chequered,
    /// A white cross on a black plate; the size is the length of its arms, a fifth of it their width.
    Cross,
    /// A white disc on a black plate half as wide again; the size is its diameter.
    Disc,
    /// AprilTag 36h11 with a white margin; the size is the side of the black square.
    Apriltag,
    /// ArUco `DICT_4X4_50` likewise.
    Aruco,
}

words!(TargetPattern {
    "chequered" = Chequered,
    "cross" = Cross,
    "disc" = Disc,
    "apriltag" = Apriltag,
    "aruco" = Aruco
});

/// The cells of a pattern.
pub(crate) struct Cells {
    /// Where they begin and end, both across and down, from the middle.
    pub(crate) lines: Vec<f64>,
    /// Which are white, row by row.
    pub(crate) white: Vec<bool>,
}

impl TargetPattern {
    /// Number of codes, where it has any.
    pub(crate) fn codes(self) -> Option<usize> {
        match self {
            TargetPattern::Apriltag => Some(APRILTAG.len()),
            TargetPattern::Aruco => Some(ARUCO.len()),
            TargetPattern::Chequered | TargetPattern::Cross | TargetPattern::Disc => None,
        }
    }

    /// Its cells, of coded ones with the code of this number; `None` for a disc.
    pub(crate) fn cells(self, code: usize) -> Option<Cells> {
        match self {
            TargetPattern::Chequered => {
                Some(Cells { lines: vec![-0.5, 0.0, 0.5], white: vec![false, true, true, false] })
            }
            TargetPattern::Cross => Some(Cells {
                lines: vec![-0.5, -0.1, 0.1, 0.5],
                white: (0..9).map(|k| k == 4 || k % 2 == 1).collect(),
            }),
            TargetPattern::Disc => None,
            TargetPattern::Apriltag => Some(coded(6, APRILTAG[code])),
            TargetPattern::Aruco => Some(coded(4, ARUCO[code])),
        }
    }
}

/// A white margin, a black border and the cells of a code word.
fn coded(side: usize, word: u64) -> Cells {
    let whole = side + 4;
    let cell = 1.0 / (side + 2) as f64;
    let white = |k: usize| {
        let (row, column) = (k / whole, k % whole);
        let border = |at: usize| at.min(whole - 1 - at);
        match border(row).min(border(column)) {
            0 => true,
            1 => false,
            _ => word >> (side * side - 1 - ((row - 2) * side + column - 2)) & 1 == 1,
        }
    };
    Cells {
        lines: (0..=whole).map(|k| (k as f64 - 0.5 * whole as f64) * cell).collect(),
        white: (0..whole * whole).map(white).collect(),
    }
}

/// The first codes of AprilTag 36h11.
#[rustfmt::skip]
const APRILTAG: [u64; 40] = [
    0xd5d628584, 0xd97f18b49, 0xdd280910e, 0xe479e9c98, 0xebcbca822, 0xf31dab3ac, 0x056a5d085, 0x10652e1d4,
    0x22b1dfead, 0x265ad0472, 0x34fe91b86, 0x3ff962cd5, 0x43a25329a, 0x474b4385f, 0x4e9d243e9, 0x5246149ae,
    0x5997f5538, 0x683bb6c4c, 0x6be4a7211, 0x7e3158eea, 0x81da494af, 0x858339a74, 0x8cd51a5fe, 0x9f21cc2d7,
    0xa2cabc89c, 0xadc58d9eb, 0xb16e7dfb0, 0xb8c05eb3a, 0xd25ef139d, 0xd607e1962, 0xe4aba3076, 0x2dde6a3da,
    0x43d40c678, 0x5620be351, 0x64c47fa65, 0x686d7002a, 0x6c16605ef, 0x6fbf50bb4, 0x8d06d39dc, 0x9f53856b5,
];

/// ArUco 4x4_50.
const ARUCO: [u64; 50] = [
    0xb532, 0x0f9a, 0x332d, 0x9946, 0x549e, 0x79cd, 0x9e2e, 0xc4f2, 0xfeda, 0xcf56, 0xf991, 0x11a7,
    0x0eb7, 0x2a0f, 0x24b1, 0x263e, 0x4665, 0x6600, 0x6c5e, 0x76af, 0x868b, 0xb02b, 0xccd5, 0xdd82,
    0xfe47, 0x9471, 0xace4, 0xa554, 0x2123, 0x346f, 0x4415, 0x57b2, 0x9ecf, 0xf0cb, 0x08ae, 0x0929,
    0x1875, 0x04ff, 0x0df6, 0x1c5a, 0x1718, 0x2a28, 0x328c, 0x38b2, 0x24e8, 0x2eeb, 0x2d3f, 0x4b64,
    0x502e, 0x5013,
];
