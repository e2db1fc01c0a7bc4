//! Which corner of a grid is the first, and what the ordered grid says of the picture.
//!
//! Rows and columns are a right-handed pair in the picture (the board is not seen in a mirror), and
//! the square inside the first corner is dark. Where the board's symmetry leaves a choice, the
//! corner is taken from which the columns run down the picture most; this is OpenCV's order.

use super::{Board, BoardCorner, grey::Grey, grid::Grid};

/// The corners of a grid, row by row, in pixels of its level; a part of a board (`None`) keeps as
/// many columns and rows as it has.
pub(super) fn order(level: &Grey, grid: &Grid, board: Option<Board>) -> Vec<BoardCorner> {
    let Some((low, high)) = super::grid::bounds(grid) else { return Vec::new() };
    let (columns, rows) = (high.0 - low.0, high.1 - low.1);
    // The four turns of the grid: where it starts and the steps along a row and a column.
    let turns = [
        ((low.0, low.1), (1, 0), (0, 1)),
        ((high.0, low.1), (0, 1), (-1, 0)),
        ((high.0, high.1), (-1, 0), (0, -1)),
        ((low.0, high.1), (0, -1), (1, 0)),
    ];
    let mut best: Option<((bool, f64), Vec<BoardCorner>)> = None;
    for (k, (start, right, down)) in turns.into_iter().enumerate() {
        let (columns, rows) = if k % 2 == 0 { (columns, rows) } else { (rows, columns) };
        let (columns, rows) = (columns as usize + 1, rows as usize + 1);
        if board.is_some_and(|board| (columns, rows) != (board.columns, board.rows)) {
            continue;
        }
        let mut corners = Vec::with_capacity(grid.len());
        for row in 0..rows {
            for column in 0..columns {
                let (i, j) = (column as i32, row as i32);
                let place =
                    (start.0 + i * right.0 + j * down.0, start.1 + i * right.1 + j * down.1);
                if let Some(corner) = grid.get(&place) {
                    corners.push(BoardCorner { column, row, image_px: corner.at });
                }
            }
        }
        let rank = (first_is_dark(level, &corners), falls(&corners));
        let better = best.as_ref().is_none_or(|(other, _)| (rank.0, rank.1) > (other.0, other.1));
        if better {
            best = Some((rank, corners));
        }
    }
    best.map(|(_, corners)| corners).unwrap_or_default()
}

fn find(corners: &[BoardCorner], column: usize, row: usize) -> Option<[f64; 2]> {
    corners.iter().find(|c| (c.column, c.row) == (column, row)).map(|c| c.image_px)
}

/// Whether squares whose column and row add up to an even number are darker than the others.
fn first_is_dark(level: &Grey, corners: &[BoardCorner]) -> bool {
    let mut difference = 0.0;
    for corner in corners {
        let (column, row) = (corner.column, corner.row);
        let others = [(1, 0), (0, 1), (1, 1)].map(|(i, j)| find(corners, column + i, row + j));
        let [Some(a), Some(b), Some(c)] = others else { continue };
        let centre = std::array::from_fn(|k| 0.25 * (corner.image_px[k] + a[k] + b[k] + c[k]));
        let Some(value) = level.sample(centre) else { continue };
        difference += if (column + row).is_multiple_of(2) { value } else { -value };
    }
    // An unequal number of squares leaves a mean of the whole in the sum.
    let squares = |parity: usize| {
        corners
            .iter()
            .filter(|c| {
                (c.column + c.row) % 2 == parity
                    && find(corners, c.column + 1, c.row + 1).is_some()
                    && find(corners, c.column + 1, c.row).is_some()
                    && find(corners, c.column, c.row + 1).is_some()
            })
            .count() as f64
    };
    let excess = squares(0) - squares(1);
    let mean = corners.iter().filter_map(|c| level.sample(c.image_px)).sum::<f64>()
        / corners.len().max(1) as f64;
    difference - excess * mean < 0.0
}

/// How far the columns run down the picture, in pixels.
fn falls(corners: &[BoardCorner]) -> f64 {
    let last = corners.iter().map(|c| c.row).max().unwrap_or(0);
    let mean = |row: usize| {
        let (sum, count) = corners
            .iter()
            .filter(|c| c.row == row)
            .fold((0.0, 0.0), |(sum, count), c| (sum + c.image_px[1], count + 1.0));
        sum / f64::max(count, 1.0)
    };
    mean(last) - mean(0)
}

/// The distance from each corner to the nearest of its neighbours in the grid, in pixels.
pub(super) fn spacings(corners: &[BoardCorner]) -> Vec<f64> {
    corners
        .iter()
        .map(|corner| {
            corners
                .iter()
                .filter(|other| {
                    corner.column.abs_diff(other.column) + corner.row.abs_diff(other.row) == 1
                })
                .map(|other| {
                    let (a, b) = (corner.image_px, other.image_px);
                    (a[0] - b[0]).hypot(a[1] - b[1])
                })
                .fold(f64::INFINITY, f64::min)
        })
        .collect()
}

/// The width of the edges between neighbours, in pixels: 0.8 of the step over the steepest
/// slope; the median, 0 where no edge could be measured.
pub(super) fn edge_width(picture: &Grey, corners: &[BoardCorner]) -> f64 {
    let mut widths: Vec<f64> = corners
        .iter()
        .flat_map(|corner| {
            [(1, 0), (0, 1)].map(|(i, j)| (corner, corner.column + i, corner.row + j))
        })
        .filter_map(|(corner, column, row)| {
            width_of(picture, corner.image_px, find(corners, column, row)?)
        })
        .collect();
    if widths.is_empty() {
        return 0.0;
    }
    widths.sort_by(f64::total_cmp);
    widths[widths.len() / 2]
}

/// The width of the edge from `a` to `b`, looked at across its middle.
fn width_of(picture: &Grey, a: [f64; 2], b: [f64; 2]) -> Option<f64> {
    let along = [b[0] - a[0], b[1] - a[1]];
    let length = along[0].hypot(along[1]);
    let across = [-along[1] / length, along[0] / length];
    let reach = (0.3 * length).min(20.0);
    let middle = [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])];
    let value = |s: f64| picture.sample([middle[0] + s * across[0], middle[1] + s * across[1]]);
    let step = (value(reach)? - value(-reach)?).abs();
    let mut steepest: f64 = 0.0;
    let count = (4.0 * reach) as i32;
    for k in -count..count {
        let s = f64::from(k) * 0.25;
        steepest = steepest.max((value(s + 0.5)? - value(s - 0.5)?).abs());
    }
    (steepest > 0.0).then_some(0.8 * step / steepest)
}
