//! The first surface against what is known of the field.

use data_synth::{
    photo::{Cover, SurfaceGrid},
    twin::{FlightPreset, TwinConfig},
};

#[test]
fn leaves_stand_above_the_ground_and_bare_cells_are_the_ground() {
    let twin = TwinConfig::preset(FlightPreset::Small).build().unwrap();
    let grid = SurfaceGrid { left_m: -1.0, top_m: 1.0, cell_m: 0.01, width: 200, height: 150 };
    let surface = twin.studio().first_surface(grid);
    let terrain = &twin.field().terrain;
    let (mut plants, mut highest) = (0, 0.0f32);
    for at in 0..200 * 150 {
        let (x, y) = (-1.0 + 0.01 * (at % 200) as f64, 1.0 - 0.01 * (at / 200) as f64);
        let ground = terrain.height_m(x, y) as f32;
        assert!((surface.ground_m[at] - ground).abs() < 1e-6);
        match surface.cover[at] {
            Cover::Ground => assert_eq!(surface.top_m[at], surface.ground_m[at]),
            Cover::Plant => {
                plants += 1;
                highest = highest.max(surface.top_m[at] - ground);
            }
            Cover::Other => {}
        }
    }
    let share = f64::from(plants) / 3e4;
    assert!((0.03..0.5).contains(&share), "{share}");
    assert!((0.2..1.0).contains(&highest), "{highest}");
}
