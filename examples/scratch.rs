use rowgram::{engine::Engine, nlls::*, problems::bundle::*};
use std::time::Instant;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let net = rowgram::io::bal::read(args[1].as_ref()).unwrap();
    let loss: Loss = args[2].parse().unwrap();
    let mut o = Options::default();
    for a in &args[3..] {
        match a.as_str() {
            "dogleg" => o.method = Method::Dogleg,
            "full" => o.curvature = Curvature::Full,
            "irls" => o.curvature = Curvature::Reweighted,
            "dense" => o.linear = Linear::Dense,
            "sparse" => o.linear = Linear::Sparse,
            _ => {}
        }
    }
    let sharing = if args.iter().any(|a| a == "shared") {
        InteriorSharing::Shared
    } else {
        InteriorSharing::PerImage
    };
    let b = Bundle::new(&net, sharing, loss).unwrap();
    let mut x = b.problem.start();
    let t = Instant::now();
    let mut e = LeastSquares::new(o);
    let c = e.start(&b.problem, &mut x).unwrap();
    println!("start {c} {:?}", t.elapsed());
    for k in 0..100 {
        let s = e.step(&b.problem, &mut x).unwrap();
        println!(
            "{k} {:.6} {} {:?} {:?} {:.3?}",
            s.cost,
            s.accepted,
            s.stop,
            s.notes.iter().map(|n| format!("{:.2e}", n.1)).collect::<Vec<_>>(),
            t.elapsed()
        );
        if s.stop.is_some() {
            break;
        }
    }
}
