//! Everything that stands or lies on the ground as triangles, gathered for one part of the field.
//!
//! Positions are metres in the local frame of the field. A leaf is the strip between its two edges, each at
//! half the width to the side of the axis, level across: the same ribbon that the mask is cut from.

use crate::{
    clutter::ClutterConfig,
    corrupt::Weed,
    field::{Field, Plant},
    habit::Stalk,
    leaf::{Leaf, NODES},
    targets::Target,
};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// What a triangle belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Leaf,
    Weed,
    Stalk,
    Panicle,
    Residue,
    Stone,
    Target,
}

/// One thing: what it is, its colour, and whose it is.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Thing {
    pub(crate) kind: Kind,
    /// Reflectance, linear.
    pub(crate) colour: [f32; 3],
    /// Plant number from 1; 0 where it belongs to none.
    pub(crate) plant: u32,
    /// Leaf number from 1, as in [`crate::labels`]; 0 where it is no leaf.
    pub(crate) leaf: u32,
    /// Whether it counts as leaf in a mask: green blades of plants and weeds.
    pub(crate) green: bool,
}

/// A corner: place (metres), and where on its blade (along from 0 to 1, across from -1 to 1).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Vertex {
    pub(crate) place_m: [f32; 3],
    pub(crate) along: f32,
    pub(crate) across: f32,
}

/// Triangles of things.
#[derive(Debug, Default)]
pub(crate) struct Mesh {
    pub(crate) vertices: Vec<Vertex>,
    /// Three corners and the thing.
    pub(crate) triangles: Vec<[u32; 4]>,
    pub(crate) things: Vec<Thing>,
}

/// The two edges of a ribbon, (left, right) seen from above along the axis.
pub(crate) fn edges(
    axis_m: &[[f64; 3]; NODES],
    half_width_m: &[f64; NODES],
) -> ([[f64; 3]; NODES], [[f64; 3]; NODES]) {
    let side = |node: usize| {
        let (a, b) = (axis_m[node.saturating_sub(1)], axis_m[(node + 1).min(NODES - 1)]);
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        let length = f64::hypot(dx, dy);
        if length > 0.0 { [-dy / length, dx / length] } else { [0.0, 0.0] }
    };
    let shifted = |sign: f64| {
        std::array::from_fn(|node| {
            let ([sx, sy], half) = (side(node), sign * half_width_m[node]);
            [axis_m[node][0] + half * sx, axis_m[node][1] + half * sy, axis_m[node][2]]
        })
    };
    (shifted(1.0), shifted(-1.0))
}

/// Linear reflectance from hue (degrees), saturation and value (0 to 1, as a picture would show them).
pub(crate) fn reflectance(hue_deg: f64, saturation: f64, value: f64) -> [f32; 3] {
    let sector = hue_deg.rem_euclid(360.0) / 60.0;
    let chroma = value * saturation;
    let middle = chroma * (1.0 - (sector % 2.0 - 1.0).abs());
    let [r, g, b] = match sector as u32 {
        0 => [chroma, middle, 0.0],
        1 => [middle, chroma, 0.0],
        2 => [0.0, chroma, middle],
        3 => [0.0, middle, chroma],
        4 => [middle, 0.0, chroma],
        _ => [chroma, 0.0, middle],
    };
    // The tone curve is about a square.
    [r, g, b].map(|part| (part + value - chroma).max(0.0).powi(2) as f32)
}

impl Mesh {
    fn thing(&mut self, kind: Kind, colour: [f32; 3], plant: u32, green: bool) -> u32 {
        self.things.push(Thing { kind, colour, plant, leaf: 0, green });
        self.things.len() as u32 - 1
    }

    fn vertex(&mut self, place_m: [f64; 3], along: f64, across: f64) -> u32 {
        let place_m = place_m.map(|value| value as f32);
        self.vertices.push(Vertex { place_m, along: along as f32, across: across as f32 });
        self.vertices.len() as u32 - 1
    }

    fn ribbon(&mut self, axis_m: &[[f64; 3]; NODES], half_width_m: &[f64; NODES], thing: u32) {
        let (left, right) = edges(axis_m, half_width_m);
        for node in 0..NODES {
            let along = node as f64 / (NODES - 1) as f64;
            let l = self.vertex(left[node], along, 1.0);
            let r = self.vertex(right[node], along, -1.0);
            if node > 0 {
                self.triangles.push([l - 2, r - 2, r, thing]);
                if node < NODES - 1 {
                    self.triangles.push([l - 2, r, l, thing]);
                }
            }
        }
    }

    /// An upright tube of five sides with a radius at each of its rings.
    fn tube(&mut self, rings: &[([f64; 3], f64)], thing: u32) {
        const SIDES: u32 = 5;
        let first = self.vertices.len() as u32;
        for (middle, radius) in rings {
            for side in 0..SIDES {
                let (sin, cos) = (TAU * f64::from(side) / f64::from(SIDES)).sin_cos();
                self.vertex(
                    [middle[0] + radius * cos, middle[1] + radius * sin, middle[2]],
                    0.0,
                    0.0,
                );
            }
        }
        for ring in 1..rings.len() as u32 {
            for side in 0..SIDES {
                let (a, b) = (first + (ring - 1) * SIDES, first + ring * SIDES);
                let next = (side + 1) % SIDES;
                self.triangles.push([a + side, a + next, b + next, thing]);
                self.triangles.push([a + side, b + next, b + side, thing]);
            }
        }
    }

    fn leaf(&mut self, axis_m: &[[f64; 3]; NODES], leaf: &Leaf, kind: Kind, owner: [u32; 2]) {
        let [plant, number] = owner;
        let (saturation, value) = if leaf.senescent { (0.45, 0.62) } else { (0.60, 0.56) };
        let colour = reflectance(leaf.hue_deg, saturation, value * leaf.brightness);
        let thing = self.thing(kind, colour, plant, !leaf.senescent);
        self.things[thing as usize].leaf = number;
        self.ribbon(axis_m, &leaf.half_width_m, thing);
    }

    fn stalk(&mut self, plant: &Plant, stalk: &Stalk, number: u32) {
        let base = [plant.x_m, plant.y_m, plant.z_m];
        let at = |part: f64| [0, 1, 2].map(|i| base[i] + part * stalk.top_m[i]);
        let colour = reflectance(76.0, 0.45, 0.52);
        let thing = self.thing(Kind::Stalk, colour, number, true);
        let radius = stalk.radius_m;
        self.tube(&[(at(0.0), 1.2 * radius), (at(1.0), 0.8 * radius), (at(1.001), 0.0)], thing);
        if stalk.panicle_m > 0.0 {
            let thing = self.thing(Kind::Panicle, reflectance(24.0, 0.55, 0.45), number, false);
            let top = at(1.0);
            let up = |part: f64| [top[0], top[1], top[2] + 0.04 + part * stalk.panicle_m];
            let wide = 0.16 * stalk.panicle_m;
            let rings = [(0.0, 0.2), (0.2, 0.8), (0.45, 1.0), (0.75, 0.7), (1.0, 0.0)];
            let rings = rings.map(|(part, radius)| (up(part), wide * radius));
            self.tube(&rings, thing);
        }
    }

    fn append(&mut self, mut other: Mesh) {
        let (vertices, things) = (self.vertices.len() as u32, self.things.len() as u32);
        self.triangles.extend(
            other
                .triangles
                .iter()
                .map(|[a, b, c, t]| [a + vertices, b + vertices, c + vertices, t + things]),
        );
        self.vertices.append(&mut other.vertices);
        self.things.append(&mut other.things);
    }
}

/// All that can be seen, sorted into square metres.
pub(crate) struct World<'a> {
    pub(crate) field: &'a Field,
    weeds: &'a [Weed],
    clutter: &'a ClutterConfig,
    targets: &'a [Target],
    low: [i64; 2],
    size: [usize; 2],
    /// Plants and weeds of each square metre; a number from the number of plants on is a weed.
    cells: Vec<Vec<u32>>,
    /// Number of the first leaf of each plant and weed, from 1.
    first_leaf: Vec<u32>,
}

/// How far leaves reach from their stalk's base, metres.
const REACH_M: f64 = 1.0;

impl<'a> World<'a> {
    pub(crate) fn new(
        field: &'a Field,
        weeds: &'a [Weed],
        clutter: &'a ClutterConfig,
        targets: &'a [Target],
    ) -> World<'a> {
        let places: Vec<[f64; 2]> = field
            .plants
            .iter()
            .map(|plant| [plant.x_m, plant.y_m])
            .chain(weeds.iter().map(|weed| [weed.x_m, weed.y_m]))
            .collect();
        let (mut low, mut high) = ([0; 2], [0; 2]);
        for place in &places {
            for axis in 0..2 {
                let cell = place[axis].floor() as i64;
                low[axis] = cell.min(low[axis]);
                high[axis] = cell.max(high[axis]);
            }
        }
        let size = [0, 1].map(|axis| (high[axis] - low[axis] + 1) as usize);
        let mut cells = vec![Vec::new(); size[0] * size[1]];
        for (number, place) in places.iter().enumerate() {
            let [i, j] = [0, 1].map(|axis| (place[axis].floor() as i64 - low[axis]) as usize);
            cells[j * size[0] + i].push(number as u32);
        }
        let counts = field.plants.iter().map(|plant| plant.leaves.len());
        let first_leaf = counts
            .chain(weeds.iter().map(|weed| weed.leaves.len()))
            .scan(1, |next, count| {
                let first = *next;
                *next += count as u32;
                Some(first)
            })
            .collect();
        World { field, weeds, clutter, targets, low, size, cells, first_leaf }
    }

    /// Everything that stands within `low_m..high_m` (X, Y) or reaches into it, on those square metres (given
    /// by their middle) that `wanted` wants.
    pub(crate) fn gather(
        &self,
        low_m: [f64; 2],
        high_m: [f64; 2],
        wanted: impl Fn([f64; 2]) -> bool + Sync,
    ) -> Mesh {
        let first = low_m.map(|value| (value - REACH_M).floor() as i64);
        let last = high_m.map(|value| (value + REACH_M).floor() as i64);
        let rows: Vec<Mesh> = (first[1]..=last[1])
            .into_par_iter()
            .map(|y| {
                let mut mesh = Mesh::default();
                for x in first[0]..=last[0] {
                    if wanted([x as f64 + 0.5, y as f64 + 0.5]) {
                        self.cell(&mut mesh, x, y);
                    }
                }
                mesh
            })
            .collect();
        let mut mesh = Mesh::default();
        for row in rows {
            mesh.append(row);
        }
        for target in self.targets {
            let [x, y, _] = target.place_m;
            if x >= low_m[0] - 5.0
                && x <= high_m[0] + 5.0
                && y >= low_m[1] - 5.0
                && y <= high_m[1] + 5.0
            {
                mesh.target(target);
            }
        }
        for panel in &self.field.panels {
            let colour = panel.reflectance.map(|part| part as f32);
            let thing = mesh.thing(Kind::Target, colour, 0, false);
            let [a, b, c, d] = panel.corners_m.map(|at_m| mesh.vertex(at_m, 0.0, 0.0));
            mesh.triangles.push([a, b, c, thing]);
            mesh.triangles.push([a, c, d, thing]);
        }
        mesh
    }

    fn cell(&self, mesh: &mut Mesh, x: i64, y: i64) {
        let [i, j] = [x - self.low[0], y - self.low[1]];
        let inside = i >= 0 && j >= 0 && (i as usize) < self.size[0] && (j as usize) < self.size[1];
        if inside {
            for &number in &self.cells[j as usize * self.size[0] + i as usize] {
                let first = self.first_leaf[number as usize];
                match self.field.plants.get(number as usize) {
                    Some(plant) => self.plant(mesh, plant, [number + 1, first]),
                    None => {
                        let weed = &self.weeds[number as usize - self.field.plants.len()];
                        let ground_m = self.field.terrain.height_m(weed.x_m, weed.y_m);
                        for (leaf, label) in weed.leaves.iter().zip(first..) {
                            let axis_m = self.field.leaf_axis_m(ground_m, leaf);
                            mesh.leaf(&axis_m, leaf, Kind::Weed, [0, label]);
                        }
                    }
                }
            }
        }
        let seed = self.field.config.seed;
        for piece in self.clutter.residue(seed, x, y) {
            let (sin, cos) = piece.azimuth_rad.sin_cos();
            let [mx, my] = piece.middle_m;
            let (half, wide) = (0.5 * piece.length_m, 0.5 * piece.width_m);
            let ground_m = self.field.terrain.height_m(mx, my) + 0.004;
            let colour = reflectance(42.0, 0.30, 0.72 * piece.brightness);
            let thing = mesh.thing(Kind::Residue, colour, 0, false);
            let corners = [(-half, wide), (-half, -wide), (half, -wide), (half, wide)];
            let [a, b, c, d] = corners.map(|(s, t)| {
                let z_m = ground_m + if s > 0.0 { piece.rise_m } else { 0.0 };
                mesh.vertex([mx + s * cos - t * sin, my + s * sin + t * cos, z_m], 0.0, 0.0)
            });
            mesh.triangles.push([a, b, c, thing]);
            mesh.triangles.push([a, c, d, thing]);
        }
        for stone in self.clutter.stones(seed, x, y) {
            const RIM: u32 = 6;
            let [mx, my] = stone.middle_m;
            let ground_m = self.field.terrain.height_m(mx, my);
            let colour = reflectance(30.0, 0.22, 0.55 * stone.brightness);
            let thing = mesh.thing(Kind::Stone, colour, 0, false);
            let ring = |mesh: &mut Mesh, part: f64, z_m: f64| {
                (0..RIM).fold(u32::MAX, |first, side| {
                    let angle = stone.turn_rad + TAU * f64::from(side) / f64::from(RIM);
                    let radius = part * stone.radius_m * (1.0 + 0.2 * (3.0 * angle).sin());
                    let place = [mx + radius * angle.cos(), my + radius * angle.sin(), z_m];
                    let vertex = mesh.vertex(place, 0.0, 0.0);
                    first.min(vertex)
                })
            };
            let low = ring(mesh, 1.0, ground_m);
            let high = ring(mesh, 0.6, ground_m + 0.8 * stone.height_m);
            let top = mesh.vertex([mx, my, ground_m + stone.height_m], 0.0, 0.0);
            for side in 0..RIM {
                let next = (side + 1) % RIM;
                mesh.triangles.push([low + side, low + next, high + next, thing]);
                mesh.triangles.push([low + side, high + next, high + side, thing]);
                mesh.triangles.push([high + side, high + next, top, thing]);
            }
        }
    }

    fn plant(&self, mesh: &mut Mesh, plant: &Plant, [number, first]: [u32; 2]) {
        for stalk in &plant.stalks {
            mesh.stalk(plant, stalk, number);
        }
        for (leaf, label) in plant.leaves.iter().zip(first..) {
            let axis_m = self.field.leaf_axis_m(plant.z_m, leaf);
            mesh.leaf(&axis_m, leaf, Kind::Leaf, [number, label]);
        }
    }
}

impl Mesh {
    fn target(&mut self, target: &Target) {
        let [x, y, z] = target.place_m;
        let (sin, cos) = target.azimuth_rad.sin_cos();
        let size = target.size_m;
        // `s` and `t` in its size, `t` down as it is read.
        let corner =
            |s: f64, t: f64| [x + size * (s * cos + t * sin), y + size * (s * sin - t * cos), z];
        let Some(cells) = target.pattern.cells(target.code) else {
            const RIM: u32 = 48;
            let thing = self.thing(Kind::Target, WHITE, 0, false);
            let middle = self.vertex(corner(0.0, 0.0), 0.0, 0.0);
            let plate = self.thing(Kind::Target, BLACK, 0, false);
            let rim: Vec<[u32; 2]> = (0..RIM)
                .map(|k| {
                    let (sin, cos) = (TAU * f64::from(k) / f64::from(RIM)).sin_cos();
                    // On the border of the plate in the same direction.
                    let far = 0.75 / sin.abs().max(cos.abs());
                    [0.5, far].map(|r| self.vertex(corner(r * cos, -r * sin), 0.0, 0.0))
                })
                .collect();
            for (k, &[from, outer]) in rim.iter().enumerate() {
                let [to, next] = rim[(k + 1) % rim.len()];
                self.triangles.push([middle, from, to, thing]);
                self.triangles.push([from, outer, next, plate]);
                self.triangles.push([from, next, to, plate]);
            }
            return;
        };
        let side = cells.lines.len() - 1;
        for (k, white) in cells.white.iter().enumerate() {
            let colour = if *white { WHITE } else { BLACK };
            let thing = self.thing(Kind::Target, colour, 0, false);
            let [left, right] = [k % side, k % side + 1].map(|line| cells.lines[line]);
            let [top, bottom] = [k / side, k / side + 1].map(|line| cells.lines[line]);
            let [a, b, c, d] = [(left, bottom), (right, bottom), (right, top), (left, top)]
                .map(|(s, t)| self.vertex(corner(s, t), 0.0, 0.0));
            self.triangles.push([a, b, c, thing]);
            self.triangles.push([a, c, d, thing]);
        }
    }
}

/// Reflectances of paint.
const WHITE: [f32; 3] = [0.80; 3];
const BLACK: [f32; 3] = [0.03; 3];
