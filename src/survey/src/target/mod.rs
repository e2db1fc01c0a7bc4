//! Chessboards in photos: every inner corner to a fraction of a pixel.
//!
//! 1. *Candidates* (`shape`): where the blurred picture is a saddle (`Ixy^2 > Ixx Iyy`, a local
//!    maximum) and a ring around it is dark, bright, dark, bright with two straight borders.
//! 2. *Grid* (`grid`): corners that lie along each other's edges, with the sides of the edge
//!    swapping, are neighbours; neighbours make rows and columns, and whatever is missing is looked for
//!    where the rows and columns around it predict it. No lens model is assumed, so a fisheye will do.
//! 3. *Order* (`order`): the same corner is the first in every photo, as far as the board's
//!    symmetry allows, and the order is OpenCV's.
//! 4. *Refinement* (`refine`) in the full-size picture.
//!
//! The first two run on levels of a pyramid, beginning where the picture has about a megapixel;
//! coarser levels help with blurred photos, finer ones with small boards.
//!
//! Positions are in pixels, the centre of the top-left pixel being (0, 0).

mod grey;
mod grid;
mod order;
mod refine;
mod shape;

use grey::Grey;
use grid::Grid;
use image::GrayImage;
use serde::{Deserialize, Serialize};
use shape::Ring;

/// A chessboard by its inner corners, where four squares meet.
///
/// Written as `COLUMNSxROWS`, such as `8x6`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Board {
    /// Inner corners of a row.
    pub columns: usize,
    /// Inner corners of a column.
    pub rows: usize,
}

impl rowgram_base::options::Value for Board {
    fn kind() -> rowgram_base::options::Kind {
        rowgram_base::options::Kind::Text
    }
}

impl std::fmt::Display for Board {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.columns, self.rows)
    }
}

impl From<Board> for String {
    fn from(board: Board) -> String {
        board.to_string()
    }
}

impl TryFrom<String> for Board {
    type Error = String;

    fn try_from(text: String) -> Result<Board, String> {
        text.parse()
    }
}

impl std::str::FromStr for Board {
    type Err = String;

    /// From `COLUMNSxROWS`.
    fn from_str(text: &str) -> Result<Board, String> {
        let sides = text.split_once(['x', 'X']).and_then(|(columns, rows)| {
            Some(Board { columns: columns.trim().parse().ok()?, rows: rows.trim().parse().ok()? })
        });
        match sides {
            Some(board) if board.columns.min(board.rows) < 3 => {
                Err(format!("{board}: a board needs at least 3 inner corners on each side"))
            }
            Some(board) if board.columns.max(board.rows) > 500 => {
                Err(format!("{board}: more than 500 inner corners on a side"))
            }
            Some(board) => Ok(board),
            None => Err(format!(
                "{text:?}: expected the inner corners of a row and of a column, such as 8x6"
            )),
        }
    }
}

/// How corners are looked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectionOptions {
    /// Half the side of the window of the refinement, as a share of the distance to the nearest
    /// neighbour.
    pub window_share: f64,
    /// The largest half side of that window, in pixels.
    pub max_window_px: usize,
}

impl Default for DetectionOptions {
    fn default() -> DetectionOptions {
        DetectionOptions { window_share: 0.3, max_window_px: 11 }
    }
}

/// A corner of the board in a photo.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BoardCorner {
    /// Its place in a row of the board, from 0.
    pub column: usize,
    /// Its row, from 0.
    pub row: usize,
    /// Where it is in the photo, `u` and `v` in pixels.
    pub image_px: [f64; 2],
}

/// A board in a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// The corners that were found, row by row. Where the board is not whole, columns and rows
    /// count from the first one seen, and their order is that of the picture.
    pub corners: Vec<BoardCorner>,
    /// Whether all corners of the board were found.
    pub complete: bool,
    /// How wide an edge of the board is, from a tenth to nine tenths of its step, in pixels: the
    /// median over the board.
    pub edge_width_px: f64,
    /// How many other whole boards of this size are in the photo.
    pub others: usize,
}

/// Why a photo has no board.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NotFound {
    /// There is nothing like a board.
    #[error("no chessboard")]
    Nothing,
    /// There is a board, but of another size.
    #[error("a chessboard of {found} inner corners, expected {expected}")]
    OtherSize {
        /// The board in the photo.
        found: Board,
        /// The board that was looked for.
        expected: Board,
    },
    /// Too little of the board can be seen.
    #[error("{corners} corners of a chessboard only, in {columns} columns and {rows} rows")]
    TooLittle {
        /// Corners seen.
        corners: usize,
        /// Columns seen.
        columns: usize,
        /// Rows seen.
        rows: usize,
    },
}

/// A part of a board is of use if it has so many columns and rows and a dozen corners.
const MIN_PART: i32 = 3;
/// Fewer corners than this determine no pose together with a lens.
const MIN_CORNERS: usize = 12;
/// The first level has at most so many pixels.
const FIRST_LEVEL_PIXELS: usize = 2_000_000;
/// Coarser levels than this have nothing to show.
const LAST_LEVEL_PIXELS: usize = 60_000;

/// Finds `board` in a photo.
///
/// Where several are there, the one that covers most of the picture.
///
/// # Errors
/// Where there is none, or too little of it.
pub fn detect(
    image: &GrayImage,
    board: Board,
    options: &DetectionOptions,
) -> Result<Detection, NotFound> {
    let mut levels = vec![Grey::new(image)];
    while levels.last().is_some_and(|level| level.data.len() >= 4 * LAST_LEVEL_PIXELS) {
        let next = levels[levels.len() - 1].half();
        levels.push(next);
    }
    let first = levels
        .iter()
        .position(|level| level.data.len() <= FIRST_LEVEL_PIXELS)
        .unwrap_or(levels.len() - 1);
    let ring = Ring::new();
    let mut best: Option<(usize, Grid)> = None;
    // The first level, then finer ones, then coarser ones.
    for level in (0..=first).rev().chain(first + 1..levels.len()) {
        let (mut boards, largest) = on_level(&levels[level], &ring, board);
        if !boards.is_empty() {
            boards.sort_by(|a, b| area(b).total_cmp(&area(a)));
            let others = boards.len() - 1;
            let whole = boards.swap_remove(0);
            if let Some(found) = finish(&levels, level, &whole, Some(board), others, options) {
                return Ok(found);
            }
        }
        if let Some(grid) = largest
            && best.as_ref().is_none_or(|(_, other)| grid.len() > other.len())
        {
            best = Some((level, grid));
        }
    }
    let Some((level, grid)) = best else { return Err(NotFound::Nothing) };
    partial(&levels, level, &grid, board, options)
}

/// The whole boards of a level, and the largest grid whatever its size.
fn on_level(level: &Grey, ring: &Ring, board: Board) -> (Vec<Grid>, Option<Grid>) {
    let blurred = level.blurred();
    let corners = shape::corners(&blurred, ring);
    let mut grids = grid::grids(&blurred, &corners);
    grids.truncate(8);
    for grid in &mut grids {
        if grid.len() < 4 {
            continue;
        }
        grid::grow(level, &blurred, ring, grid);
        grid::trim(grid);
    }
    grids.sort_by_key(|grid| std::cmp::Reverse(grid.len()));
    let largest = grids.first().filter(|grid| grid.len() >= 4).cloned();
    let mut whole: Vec<Grid> = Vec::new();
    for grid in grids {
        // Two seeds may have grown into the same board.
        let twin = |other: &Grid| {
            let centre = |grid: &Grid| mean(grid.values().map(|corner| corner.at));
            let (a, b) = (centre(other), centre(&grid));
            (a[0] - b[0]).hypot(a[1] - b[1]) < 2.0
        };
        if is_whole(&grid, board) && !whole.iter().any(twin) {
            whole.push(grid);
        }
    }
    (whole, largest)
}

fn mean(points: impl Iterator<Item = [f64; 2]>) -> [f64; 2] {
    let (sum, count) = points
        .fold(([0.0; 2], 0.0), |(sum, count), p| ([sum[0] + p[0], sum[1] + p[1]], count + 1.0));
    [sum[0] / count, sum[1] / count]
}

fn size(grid: &Grid) -> (usize, usize) {
    grid::bounds(grid).map_or((0, 0), |(low, high)| {
        ((high.0 - low.0 + 1) as usize, (high.1 - low.1 + 1) as usize)
    })
}

fn is_whole(grid: &Grid, board: Board) -> bool {
    let (columns, rows) = size(grid);
    let fits = (columns, rows) == (board.columns, board.rows)
        || (rows, columns) == (board.columns, board.rows);
    fits && grid.len() == columns * rows
}

/// The area of the box around a grid, in pixels of its level.
fn area(grid: &Grid) -> f64 {
    let span = |axis: usize| {
        let (low, high) = grid.values().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), c| {
            (l.min(c.at[axis]), h.max(c.at[axis]))
        });
        high - low
    };
    span(0) * span(1)
}

/// What can be said of a grid that is not the whole board.
fn partial(
    levels: &[Grey],
    level: usize,
    grid: &Grid,
    board: Board,
    options: &DetectionOptions,
) -> Result<Detection, NotFound> {
    let (columns, rows) = size(grid);
    let (long, short) = (columns.max(rows), columns.min(rows));
    let (board_long, board_short) = (board.columns.max(board.rows), board.columns.min(board.rows));
    let full = grid.len() == columns * rows;
    let found = Board { columns: long, rows: short };
    if long > board_long || short > board_short {
        return Err(NotFound::OtherSize { found, expected: board });
    }
    let too_little = NotFound::TooLittle { corners: grid.len(), columns: long, rows: short };
    if columns.min(rows) < MIN_PART as usize || grid.len() < MIN_CORNERS {
        return Err(if grid.len() < 9 { NotFound::Nothing } else { too_little });
    }
    // A grid without a hole, away from the border of the picture, is a board of its own.
    if full && !touches_border(&levels[level], grid) {
        return Err(NotFound::OtherSize { found, expected: board });
    }
    finish(levels, level, grid, None, 0, options).ok_or(too_little)
}

/// Whether the next corner in some direction would lie outside the picture.
fn touches_border(level: &Grey, grid: &Grid) -> bool {
    grid.iter().any(|(&(i, j), corner)| {
        [(1, 0), (0, 1), (-1, 0), (0, -1)].iter().any(|&(di, dj)| {
            let Some(behind) = grid.get(&(i - di, j - dj)) else { return false };
            if grid.contains_key(&(i + di, j + dj)) {
                return false;
            }
            let next: [f64; 2] = std::array::from_fn(|k| 2.0 * corner.at[k] - behind.at[k]);
            !(4.0..level.width as f64 - 5.0).contains(&next[0])
                || !(4.0..level.height as f64 - 5.0).contains(&next[1])
        })
    })
}

/// Orders a grid, takes it to the full-size picture and refines it there; `None` where a corner
/// gets lost on the way.
fn finish(
    levels: &[Grey],
    level: usize,
    grid: &Grid,
    board: Option<Board>,
    others: usize,
    options: &DetectionOptions,
) -> Option<Detection> {
    let scale = f64::from(1u32 << level);
    let offset = 0.5 * (scale - 1.0);
    let full_size = &levels[0];
    let mut ordered = order::order(&levels[level], grid, board);
    for corner in &mut ordered {
        corner.image_px = corner.image_px.map(|x| scale * x + offset);
    }
    let spacings = order::spacings(&ordered);
    let mut corners = Vec::with_capacity(ordered.len());
    for (corner, spacing) in ordered.iter().zip(&spacings) {
        // Through the levels in between, so that no window has to bridge more than a pixel or two.
        let mut at = corner.image_px;
        for finer in (0..level).rev().chain([0]) {
            let scale = f64::from(1u32 << finer);
            let offset = 0.5 * (scale - 1.0);
            let share = (options.window_share * spacing / scale) as usize;
            let start = at.map(|x| (x - offset) / scale);
            // Beside the border of the picture the window shrinks.
            let half = share.clamp(2, options.max_window_px);
            let refined =
                (2..=half).rev().find_map(|half| refine::refine(&levels[finer], start, half));
            match refined {
                Some(refined) => at = refined.map(|x| scale * x + offset),
                None if board.is_some() => return None,
                None => break,
            }
        }
        let off = (at[0] - corner.image_px[0]).hypot(at[1] - corner.image_px[1]);
        if off < 0.25 * spacing {
            corners.push(BoardCorner { image_px: at, ..*corner });
        } else if board.is_some() {
            return None;
        }
    }
    let edge_width_px = order::edge_width(full_size, &corners);
    let complete = board.is_some();
    (complete || corners.len() >= MIN_CORNERS).then_some(Detection {
        corners,
        complete,
        edge_width_px,
        others,
    })
}
