//! try
fn main() {
    use data_synth::twin::*;
    let a: Vec<String> = std::env::args().collect();
    let mut c = TwinConfig::preset(a[1].parse().unwrap());
    if let Some(w) = a.get(4) {
        if w == "12mp" {
            c.camera = data_synth::camera::CameraConfig::wide(4000, 3000, 1750.0);
        }
    }
    let t0 = std::time::Instant::now();
    let t = c.build().unwrap();
    println!(
        "built {:?} plants {} shots {} marks {}",
        t0.elapsed(),
        t.field().plants.len(),
        t.shots.len(),
        t.marks.len()
    );
    let s = t.studio();
    println!("studio {:?}", t0.elapsed());
    let ids: Vec<usize> = a[2].split(',').map(|x| x.parse().unwrap()).collect();
    for i in ids {
        let p = s.photo(&t.shots[i], i);
        println!("photo {:?}", t0.elapsed());
        let b = data_synth::exif::jpeg(&p.image, 92, &t.shots[i], &c.camera, &t.site).unwrap();
        println!("jpeg {:?}", t0.elapsed());
        std::fs::create_dir_all(&a[3]).unwrap();
        std::fs::write(format!("{}/{}", a[3], t.shots[i].name), b).unwrap();
        p.mask.save(format!("{}/{}.mask.png", a[3], t.shots[i].name)).unwrap();
    }
}
