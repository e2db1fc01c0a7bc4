//! How much light comes back from things and ground: sun, sky, and light through leaves.

use super::{
    raster::{Place, weights},
    shadow::Shadows,
};
use crate::mesh::{Kind, Mesh, Thing};

/// Light of the sun on a surface that faces it, red, green, blue.
pub(super) const SUN_LIGHT: [f32; 3] = [1.02, 0.97, 0.88];
/// Light of the sky on level open ground.
pub(super) const SKY_LIGHT: [f32; 3] = [0.24, 0.27, 0.32];

/// Shades one photo.
pub(super) struct Shader {
    pub(super) mesh: Mesh,
    shadows: Shadows,
    sun: [f32; 3],
}

impl Shader {
    pub(super) fn new(mesh: Mesh, shadows: Shadows, sun: [f64; 3]) -> Shader {
        Shader { mesh, shadows, sun: sun.map(|part| part as f32) }
    }

    /// The light from bare ground at a place with a slope, a reflectance, and how much more light its
    /// small relief gets than level ground.
    pub(super) fn ground(
        &self,
        place_m: [f32; 3],
        slope: [f64; 2],
        colour: [f32; 3],
        relief: f32,
    ) -> [f32; 3] {
        let normal = unit([-slope[0] as f32, -slope[1] as f32, 1.0]);
        let facing = (dot(normal, self.sun) * relief).max(0.0);
        let sun = facing * self.shadows.sunlit(place_m);
        let sky = 0.6 + 0.4 * relief.min(1.3);
        [0, 1, 2].map(|c| colour[c] * (SUN_LIGHT[c] * sun + SKY_LIGHT[c] * sky))
    }

    /// The light from a triangle at a position in the photo, and what it belongs to. `ray` is the
    /// direction of view.
    pub(super) fn shade(
        &self,
        places: &[Place],
        triangle: u32,
        [u, v]: [f32; 2],
        ray: [f64; 3],
    ) -> ([f32; 3], &Thing) {
        let [a, b, c, thing] = self.mesh.triangles[triangle as usize];
        let thing = &self.mesh.things[thing as usize];
        let corners = [a, b, c].map(|k| &self.mesh.vertices[k as usize]);
        let weights = weights([a, b, c].map(|k| places[k as usize]), u, v);
        let mix = |get: &dyn Fn(usize) -> f32| (0..3).map(|k| weights[k] * get(k)).sum::<f32>();
        let place = [0, 1, 2].map(|i| mix(&|k| corners[k].place_m[i]));
        let p = corners.map(|corner| corner.place_m);
        let mut normal = unit(cross(minus(p[1], p[0]), minus(p[2], p[0])));
        let view = unit(ray.map(|part| -part as f32));
        let blade = matches!(thing.kind, Kind::Leaf | Kind::Weed);
        let mut colour = thing.colour;
        let mut pale = 0.0;
        if blade {
            if normal[2] < 0.0 {
                normal = normal.map(|part| -part);
            }
            let across = mix(&|k| corners[k].across);
            let along = mix(&|k| corners[k].along);
            // The two halves of a blade are folded up along the midrib.
            let side = side(&corners.map(|corner| corner.across), &p);
            let fold = -0.38 * across.signum();
            normal = unit([0, 1, 2].map(|i| normal[i] + fold * side[i]));
            // The midrib is about a tenth of the width, paler, and fades towards the tip.
            pale = (1.0 - across.abs() / 0.14).max(0.0) * (1.0 - along).max(0.0);
        }
        for (channel, extra) in colour.iter_mut().zip([0.16, 0.20, 0.10]) {
            *channel += pale * extra;
        }
        let facing = dot(normal, self.sun);
        let seen = dot(normal, view);
        let sunlit = self.shadows.sunlit(place);
        let same_side = facing * seen >= 0.0;
        // What does not come back on the lit side of a blade shines through to the other, yellower.
        let (sun, tint) = if same_side {
            (facing.abs(), [1.0, 1.0, 1.0])
        } else if blade {
            (0.55 * facing.abs(), [1.05, 1.0, 0.45])
        } else {
            (0.0, [1.0; 3])
        };
        let sky = 0.65 + 0.35 * normal[2].abs();
        let light = [0, 1, 2]
            .map(|c| colour[c] * (SUN_LIGHT[c] * sun * sunlit * tint[c] + SKY_LIGHT[c] * sky));
        // The wax of a blade mirrors a little of sun and sky.
        let shine = if blade && same_side {
            let half = unit([0, 1, 2].map(|i| view[i] + self.sun[i]));
            0.10 * dot(normal, half).abs().powi(24) * sunlit
        } else {
            0.0
        };
        (light.map(|part| part + shine), thing)
    }
}

/// The direction in the triangle's plane in which `across` grows, unit length: level across the blade.
fn side(across: &[f32; 3], p: &[[f32; 3]; 3]) -> [f32; 3] {
    let (e, f) = (minus(p[1], p[0]), minus(p[2], p[0]));
    let (de, df) = (across[1] - across[0], across[2] - across[0]);
    let normal = cross(e, f);
    let (towards_e, towards_f) = (cross(f, normal), cross(normal, e));
    unit([0, 1, 2].map(|i| de * towards_e[i] + df * towards_f[i]))
}

fn minus(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    let length = dot(v, v).sqrt();
    if length > 0.0 { v.map(|part| part / length) } else { [0.0, 0.0, 1.0] }
}
