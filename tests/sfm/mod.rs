//! Orientation of blocks, on flights made from geometry.

mod any_flight;
mod blocks;
mod gimbal;
mod longer_tracks;
mod pairs;
mod toy;
mod weak_datum;
