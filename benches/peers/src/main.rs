//! Bundle adjustment with arael, for comparison: BAL text in, one line of JSON out.
//!
//! Cost = 1/2 sum rho(|r|^2) over observations, r = f (1 + k1 |p|^2 + k2 |p|^4) p - measured, in pixels,
//! with p = -(P.x, P.y) / P.z and P = R X + t; rho(s) = s, or Huber's `2 a sqrt(s) - a^2` where
//! s > a^2. arael minimises the sum without the half, so its costs are halved here.
//!
//! The settings are those of arael's own example of bundle adjustment (`bal_demo`): the sparse solver in
//! f64, which eliminates the points by itself where that is cheaper; Euler angles about a re-centred
//! rotation; damping by gain ratio ("nielsen") or by fixed factors ("ladder").
//!
//! Reference: <https://docs.rs/arael>.

use arael::{
    matrix::matrix3d,
    model::{CrossBlock, EulerAngleParam, Param, SelfBlock},
    refs::{self, Ref},
    simple_lm::{LmConfig, LmIter, LmProblem},
    vect::{vect2d, vect3d},
};
use std::{cell::RefCell, error::Error, ops::ControlFlow, rc::Rc, time::Instant};

#[arael::model]
struct Camera {
    t: Param<vect3d>,
    ea: EulerAngleParam<f64>,
    interior: Param<vect3d>, // f, k1, k2
    hb: SelfBlock<Camera>,
}

#[arael::model]
struct Point {
    pos: Param<vect3d>,
    hb: SelfBlock<Point>,
}

/// An observation without a loss.
#[arael::model]
#[arael(constraint(hb, {
    let pc = cam.ea.rotation_matrix() * pt.pos + cam.t;
    let px = -pc.x / pc.z;
    let py = -pc.y / pc.z;
    let r2 = px * px + py * py;
    let d = 1.0 + r2 * (cam.interior.y + cam.interior.z * r2);
    [cam.interior.x * d * px - plain.xy.x,
     cam.interior.x * d * py - plain.xy.y]
}))]
struct Plain {
    #[arael(ref = root.cameras)]
    cam: Ref<Camera>,
    #[arael(ref = root.points)]
    pt: Ref<Point>,
    xy: vect2d,
    hb: CrossBlock<Camera, Point>,
}

/// An observation with Huber's loss; `k2` is the square of its scale.
#[arael::model]
#[arael(constraint(hb, loss = |s| loss_huber(s, robust.k2), {
    let pc = cam.ea.rotation_matrix() * pt.pos + cam.t;
    let px = -pc.x / pc.z;
    let py = -pc.y / pc.z;
    let r2 = px * px + py * py;
    let d = 1.0 + r2 * (cam.interior.y + cam.interior.z * r2);
    [cam.interior.x * d * px - robust.xy.x,
     cam.interior.x * d * py - robust.xy.y]
}))]
struct Robust {
    #[arael(ref = root.cameras)]
    cam: Ref<Camera>,
    #[arael(ref = root.points)]
    pt: Ref<Point>,
    xy: vect2d,
    k2: f64,
    hb: CrossBlock<Camera, Point>,
}

/// One of the two lists of observations is empty.
#[arael::model]
#[arael(root)]
struct Scene {
    cameras: refs::Vec<Camera>,
    points: refs::Vec<Point>,
    plain: std::vec::Vec<Plain>,
    robust: std::vec::Vec<Robust>,
}

/// The numbers of a BAL file in its order.
struct Bal {
    observations: Vec<(usize, usize, vect2d)>,
    cameras: Vec<[f64; 9]>,
    points: Vec<vect3d>,
}

impl Bal {
    fn read(path: &str) -> Result<Bal, Box<dyn Error>> {
        let text = std::fs::read_to_string(path).map_err(|e| format!("{path}: {e}"))?;
        let mut words = text.split_ascii_whitespace();
        let mut next = || -> Result<f64, Box<dyn Error>> {
            let word = words.next().ok_or_else(|| format!("{path}: ends too early"))?;
            word.parse().map_err(|_| format!("{path}: {word:?} is not a number").into())
        };
        let (cameras, points, observations) =
            (next()? as usize, next()? as usize, next()? as usize);
        let mut bal = Bal { observations: vec![], cameras: vec![], points: vec![] };
        for _ in 0..observations {
            let (camera, point) = (next()? as usize, next()? as usize);
            bal.observations.push((camera, point, vect2d::new(next()?, next()?)));
        }
        for _ in 0..cameras {
            let mut camera = [0.0; 9];
            for value in &mut camera {
                *value = next()?;
            }
            bal.cameras.push(camera);
        }
        for _ in 0..points {
            bal.points.push(vect3d::new(next()?, next()?, next()?));
        }
        Ok(bal)
    }

    fn scene(&self, huber_px: Option<f64>) -> Scene {
        let mut scene = Scene {
            cameras: refs::Vec::new(),
            points: refs::Vec::new(),
            plain: vec![],
            robust: vec![],
        };
        for c in &self.cameras {
            let rotation = rotation_matrix(vect3d::new(c[0], c[1], c[2]));
            scene.cameras.push(Camera {
                t: Param::new(vect3d::new(c[3], c[4], c[5])),
                ea: EulerAngleParam::new(rotation.get_euler_angles()),
                interior: Param::new(vect3d::new(c[6], c[7], c[8])),
                hb: SelfBlock::new(),
            });
        }
        for &pos in &self.points {
            scene.points.push(Point { pos: Param::new(pos), hb: SelfBlock::new() });
        }
        for &(camera, point, xy) in &self.observations {
            let (cam, pt) = (scene.cameras.ref_at(camera), scene.points.ref_at(point));
            match huber_px {
                None => scene.plain.push(Plain { cam, pt, xy, hb: CrossBlock::new() }),
                Some(a) => {
                    scene.robust.push(Robust { cam, pt, xy, k2: a * a, hb: CrossBlock::new() });
                }
            }
        }
        scene
    }
}

fn rotation_matrix(rotation_vector: vect3d) -> matrix3d {
    let w = rotation_vector;
    let square = w.square();
    if square > 1e-24 {
        let angle = square.sqrt();
        matrix3d::rotation_from_axis_angle(w * (1.0 / angle), angle)
    } else {
        matrix3d::from_elements(1.0, -w.z, w.y, w.z, 1.0, -w.x, -w.y, w.x, 1.0)
    }
}

/// The highest resident memory of this process, in MB.
fn peak_memory_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let kilobytes = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .and_then(|rest| rest.split_whitespace().next()?.parse::<f64>().ok());
    kilobytes.map_or(f64::NAN, |kb| kb / 1024.0)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [file, variant, loss, threads, tolerance, max_iterations] = &arguments[..] else {
        return Err("usage: arael-bal FILE nielsen|ladder trivial|huber:A THREADS TOLERANCE \
                    MAX_ITERATIONS"
            .into());
    };
    let huber_px = match loss.split_once(':') {
        None if loss == "trivial" => None,
        Some(("huber", scale)) => Some(scale.parse()?),
        _ => return Err(format!("{loss}: expected trivial or huber:A").into()),
    };
    let bal = Bal::read(file)?;
    let begin = Instant::now();
    let mut scene = bal.scene(huber_px);
    let build_seconds = begin.elapsed().as_secs_f64();

    let log = Rc::new(RefCell::new(Vec::<(usize, f64, f64)>::new()));
    let entries = Rc::clone(&log);
    let begin = Instant::now();
    let base = match variant.as_str() {
        "nielsen" => LmConfig::ill_conditioned(),
        "ladder" => LmConfig::conservative(),
        _ => return Err(format!("{variant}: expected nielsen or ladder").into()),
    };
    let config = base
        .with_initial_lambda(1e-4)
        .with_abs_precision(0.0)
        .with_rel_precision(tolerance.parse()?)
        .with_patience(1)
        .with_min_iters(1)
        .with_max_iters(max_iterations.parse()?)
        .with_num_threads(threads.parse()?)
        .with_observer(move |it: &LmIter<'_, f64>| {
            let cost = if it.accepted { it.new_cost } else { it.cost };
            entries.borrow_mut().push((it.iter, 0.5 * cost, begin.elapsed().as_secs_f64()));
            ControlFlow::Continue(())
        });
    let result = scene.solve_sparse(&config).map_err(|e| format!("{e:?}"))?;
    let solve_seconds = begin.elapsed().as_secs_f64();

    let log: Vec<String> = log
        .borrow()
        .iter()
        .map(|(iteration, cost, seconds)| format!("[{iteration},{cost},{seconds}]"))
        .collect();
    println!(
        r#"{{"initial_cost":{},"final_cost":{},"iterations":{},"build_seconds":{build_seconds},"solve_seconds":{solve_seconds},"peak_memory_mb":{},"stop":"{:?}","log":[{}]}}"#,
        0.5 * result.start_cost,
        0.5 * result.end_cost,
        result.iterations,
        peak_memory_mb(),
        result.status,
        log.join(",")
    );
    Ok(())
}
