//! Orientation of blocks, on flights made from geometry.

mod blocks;
mod pairs;
mod toy;
