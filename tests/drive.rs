//! The driver: limits, interruption, observers, the trace, refusals, and that nothing is lost.

use crate::engine::{Accelerated, Bowl, Wanderer, trace_without_seconds};
use rowgram::{
    Kind,
    drive::{Drive, DriveError, Event, Fingerprint, Limits},
    engine::{Engine, SolveError, Step, Termination},
    io::FileError,
};
use std::{
    path::Path,
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
    time::Duration,
};

fn start() -> Vec<f64> {
    vec![1.0, -2.0, 3.0]
}

fn bowl() -> Bowl {
    Bowl::new(3)
}

#[test]
fn driving_changes_nothing_but_who_calls() {
    let mut engine = Accelerated::default();
    let mut x = start();
    engine.start(&bowl(), &mut x).unwrap();
    let mut steps = 0;
    while engine.step(&bowl(), &mut x).unwrap().stop.is_none() {
        steps += 1;
    }
    let outcome = Drive::new(&bowl(), Accelerated::default(), start()).run().unwrap();
    assert_eq!(outcome.x, x);
    assert_eq!((outcome.stop, outcome.iterations), (Termination::StepConverged, steps + 1));
    assert_eq!(outcome.final_cost.to_bits(), bowl().cost(&x).to_bits());
    assert_eq!(outcome.initial_cost, bowl().cost(&start()));
    assert!(outcome.brief().ends_with(Termination::StepConverged.explain()), "{}", outcome.brief());
}

#[test]
fn a_lent_engine_comes_back() {
    let mut engine = Accelerated::default();
    Drive::new(&bowl(), &mut engine, start()).limits(Limits::iterations(5)).run().unwrap();
    let memory = serde_json::to_value(Engine::<Bowl>::state(&engine)).unwrap();
    assert_eq!(memory["count"], 5);
}

#[test]
fn the_limit_of_iterations_is_exact() {
    for limit in [0, 1, 7] {
        let outcome = Drive::new(&bowl(), Wanderer::new(1), start())
            .limits(Limits::iterations(limit))
            .run()
            .unwrap();
        assert_eq!((outcome.iterations, outcome.stop), (limit, Termination::MaxIterations));
    }
}

#[test]
fn the_target_ends_the_run_at_the_iterate_that_reached_it() {
    let target = 0.5;
    let limits = Limits { target_cost: Some(target), ..Limits::default() };
    let outcome = Drive::new(&bowl(), Wanderer::new(1), start()).limits(limits).run().unwrap();
    assert_eq!(outcome.stop, Termination::TargetCost);
    assert!(bowl().cost(&outcome.x) <= target && outcome.log.len() > 2);
    assert!(outcome.log[outcome.log.len() - 2].best_cost > target, "not one step too many");
    let again = Drive::new(&bowl(), Wanderer::new(1), outcome.x).limits(limits).run().unwrap();
    assert_eq!(
        (again.iterations, again.stop),
        (0, Termination::TargetCost),
        "reached before any step"
    );
}

#[test]
fn the_limit_of_time_holds() {
    let limits = Limits { max_time: Some(Duration::from_millis(50)), ..Limits::default() };
    let outcome = Drive::new(&bowl(), Wanderer::new(1), start()).limits(limits).run().unwrap();
    assert_eq!(outcome.stop, Termination::MaxTime);
    assert!(outcome.seconds >= 0.05 && outcome.iterations > 0);
    let limits = Limits { max_time: Some(Duration::ZERO), ..Limits::default() };
    let outcome = Drive::new(&bowl(), Wanderer::new(1), start()).limits(limits).run().unwrap();
    assert_eq!((outcome.stop, outcome.iterations), (Termination::MaxTime, 0));
}

#[test]
fn a_raised_flag_interrupts_before_the_next_step() {
    let flag = AtomicBool::new(false);
    let outcome = Drive::new(&bowl(), Wanderer::new(1), start())
        .interrupt(&flag)
        .on_step(|event| flag.store(event.iteration == 12, Ordering::Relaxed))
        .run()
        .unwrap();
    assert_eq!((outcome.stop, outcome.iterations), (Termination::Interrupted, 12));
}

#[test]
fn observers_see_every_step() {
    let mut pages = Vec::new();
    Drive::new(&bowl(), Wanderer::new(1), start())
        .limits(Limits::iterations(2))
        .on_step(|event| {
            assert_eq!(event.step.cost, event.cost);
            pages.push((event.iteration, event.x.len()));
        })
        .run()
        .unwrap();
    assert_eq!(pages, [(1, 3), (2, 3)]);
}

#[test]
fn the_best_cost_of_a_wandering_run_is_told() {
    let limits = Limits::iterations(300);
    let outcome = Drive::new(&bowl(), Wanderer::new(1), start()).limits(limits).run().unwrap();
    assert!(outcome.best_cost < outcome.final_cost, "the seed was chosen so");
    let costs: Vec<f64> = outcome.log.iter().map(|entry| entry.best_cost).collect();
    assert!(costs.is_sorted_by(|a, b| a >= b));
    assert_eq!(outcome.log.last().unwrap().iteration, 300);
}

#[test]
fn the_log_is_a_list_of_lists_in_json() {
    let outcome =
        Drive::new(&bowl(), Wanderer::new(1), start()).limits(Limits::iterations(0)).run().unwrap();
    let json = serde_json::to_value(&outcome.log).unwrap();
    assert_eq!(json[0][0], 0);
    assert_eq!(json[0][1], outcome.initial_cost);
    assert_eq!(json[0].as_array().unwrap().len(), 3);
}

/// Counts copies, and fails at a step of one's choice.
struct Breaking {
    at: u64,
    steps: u64,
}

static COPIES: AtomicU64 = AtomicU64::new(0);

#[derive(serde::Serialize, serde::Deserialize)]
struct Counted(u64);

impl Clone for Counted {
    fn clone(&self) -> Self {
        COPIES.fetch_add(1, Ordering::Relaxed);
        Counted(self.0)
    }
}

impl Engine<str> for Breaking {
    type Iterate = Counted;
    type State = u64;
    const NAME: &'static str = "breaking";
    fn start(&mut self, _: &str, x: &mut Counted) -> Result<f64, SolveError> {
        Ok(-(x.0 as f64))
    }
    fn step(&mut self, problem: &str, x: &mut Counted) -> Result<Step, SolveError> {
        if self.steps == self.at {
            return Err(SolveError::NotFinite(problem.to_owned()));
        }
        self.steps += 1;
        x.0 += 1;
        let cost = -(x.0 as f64);
        Ok(Step { cost, step_norm: 1.0, accepted: true, stop: None, metrics: Vec::new() })
    }
    fn state(&self) -> u64 {
        self.steps
    }
    fn resume(&mut self, problem: &str, x: &mut Counted, steps: u64) -> Result<f64, SolveError> {
        self.steps = steps;
        self.start(problem, x)
    }
}

#[test]
fn a_failing_step_loses_nothing_and_nothing_is_copied() {
    let folder = tempfile::tempdir().unwrap();
    let (trace, saved) = (folder.path().join("trace.csv"), folder.path().join("run"));
    let drive = |at| Drive::new("a test", Breaking { at, steps: 0 }, Counted(0));
    let mut seen = 0;
    let outcome = drive(5)
        .trace(&trace)
        .checkpoint(&saved, 2)
        .on_step(|event| seen = event.iteration)
        .run()
        .unwrap();
    assert_eq!((outcome.x.0, outcome.iterations, seen), (5, 5, 5));
    assert_eq!(outcome.error, Some(SolveError::NotFinite("a test".to_owned())));
    assert!(outcome.brief().contains("not a finite number in a test"));
    assert_eq!(trace_without_seconds(&trace).len(), 1 + 1 + 5, "header, start, five steps");
    assert!(matches!(outcome.checked(), Err(DriveError::Solve(_))));
    assert_eq!(COPIES.load(Ordering::Relaxed), 0, "the iterate is moved, never copied");

    let resumed = drive(7).resume_from(&saved).run().unwrap();
    assert_eq!((resumed.x.0, resumed.iterations), (7, 7), "from the checkpoint at 4, not at 5");
}

#[test]
fn a_start_that_cannot_be_evaluated_is_an_error() {
    let error = Drive::new(&bowl(), Accelerated::default(), vec![f64::NAN; 3]).run().unwrap_err();
    assert!(matches!(error, DriveError::Solve(SolveError::InfeasibleStart(_))), "{error}");
}

#[test]
fn a_killed_run_resumes_into_a_whole_trace() {
    let bowl = bowl();
    let folder = tempfile::tempdir().unwrap();
    let (whole, resumed) = (folder.path().join("whole.csv"), folder.path().join("resumed.csv"));
    let saved = folder.path().join("run.checkpoint");
    let drive = || Drive::new(&bowl, Wanderer::new(3), start()).limits(Limits::iterations(30));
    drive().trace(&whole).run().unwrap();
    // A kill leaves the last periodic checkpoint, here that of iteration 20, and no trace.
    drive()
        .limits(Limits::iterations(27))
        .trace(folder.path().join("never-seen.csv"))
        .checkpoint(&saved, 10)
        .on_step(|event| {
            if event.iteration == 21 {
                std::fs::copy(&saved, folder.path().join("killed")).unwrap();
            }
        })
        .run()
        .unwrap();
    drive().trace(&resumed).resume_from(folder.path().join("killed")).run().unwrap();
    assert_eq!(trace_without_seconds(&resumed), trace_without_seconds(&whole));
}

#[test]
fn a_run_that_the_engine_ended_stays_ended() {
    let bowl = bowl();
    let folder = tempfile::tempdir().unwrap();
    let saved = folder.path().join("run.checkpoint");
    let drive = || Drive::new(&bowl, Accelerated::default(), start());
    let first = drive().checkpoint(&saved, 10).run().unwrap();
    let bytes = std::fs::read(&saved).unwrap();
    let again = drive().checkpoint(&saved, 10).resume_from(&saved).run().unwrap();
    assert_eq!((again.x, again.iterations, again.stop), (first.x, first.iterations, first.stop));
    assert_eq!(std::fs::read(&saved).unwrap(), bytes);
}

#[test]
fn the_time_before_a_resumption_counts() {
    let bowl = bowl();
    let folder = tempfile::tempdir().unwrap();
    let saved = folder.path().join("run.checkpoint");
    let limits = Limits { max_time: Some(Duration::from_millis(20)), ..Limits::default() };
    let drive = || Drive::new(&bowl, Wanderer::new(3), start()).limits(limits);
    let first = drive().checkpoint(&saved, 0).run().unwrap();
    let again = drive().resume_from(&saved).run().unwrap();
    assert_eq!((again.iterations, again.stop), (first.iterations, Termination::MaxTime));
    assert!(again.seconds >= first.seconds);
}

/// The message of a refused resumption, which is bad input each time.
fn refusal<P: ?Sized, E: Engine<P>>(drive: Drive<'_, P, E>) -> String {
    let error = drive.run().map(|outcome| outcome.iterations).unwrap_err();
    let message = error.to_string();
    assert_eq!(rowgram::Error::from(error).kind(), Kind::BadInput, "{message}");
    message
}

#[test]
fn a_checkpoint_of_something_else_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let saved = folder.path().join("run.checkpoint");
    let mark = Fingerprint::new().numbers(&bowl().weights).finish();
    let bowl = bowl();
    Drive::new(&bowl, Wanderer::new(3), start())
        .limits(Limits::iterations(5))
        .fingerprint(mark)
        .checkpoint(&saved, 0)
        .run()
        .unwrap();
    let resume = |path: &Path| Drive::new(&bowl, Wanderer::new(3), start()).resume_from(path);

    let message = refusal(
        Drive::new(&bowl, Accelerated::default(), start()).fingerprint(mark).resume_from(&saved),
    );
    assert!(message.contains("engine wanderer") && message.contains("accelerated"), "{message}");
    let message = refusal(resume(&saved).fingerprint(mark + 1));
    assert!(message.contains("another problem"), "{message}");
    let steeper = Bowl { weights: vec![2.0; 3] };
    let message = refusal(
        Drive::new(&steeper, Wanderer::new(3), start()).fingerprint(mark).resume_from(&saved),
    );
    assert!(message.contains("its cost is"), "{message}");

    let missing = folder.path().join("nothing");
    assert!(refusal(resume(&missing)).contains("cannot read"));
    let other = folder.path().join("other.txt");
    std::fs::write(&other, "2 3 4\n").unwrap();
    assert!(refusal(resume(&other)).contains("not a rowgram checkpoint"));
    let bytes = std::fs::read(&saved).unwrap();
    std::fs::write(&other, &bytes[..bytes.len() - 3]).unwrap();
    assert!(refusal(resume(&other).fingerprint(mark)).contains("truncated"));
    let mut damaged = bytes.clone();
    *damaged.last_mut().unwrap() ^= 1;
    std::fs::write(&other, &damaged).unwrap();
    assert!(refusal(resume(&other).fingerprint(mark)).contains("damaged"));
}

#[test]
fn outputs_that_exist_are_refused_before_any_work() {
    let folder = tempfile::tempdir().unwrap();
    let taken = folder.path().join("taken");
    std::fs::write(&taken, "mine").unwrap();
    let bowl = bowl();
    let drive = || {
        let never = |_: &Event<'_, Vec<f64>>| panic!("no step may be made");
        Drive::new(&bowl, Wanderer::new(3), start()).limits(Limits::iterations(1)).on_step(never)
    };
    for refused in [drive().trace(&taken), drive().checkpoint(&taken, 1)] {
        let error = refused.run().map(|outcome| outcome.iterations).unwrap_err();
        assert!(matches!(error, DriveError::File(FileError::Exists { .. })), "{error}");
    }
    let both = folder.path().join("both");
    assert!(refusal(drive().trace(&both).checkpoint(&both, 1)).contains("one path"));
    assert_eq!(std::fs::read(&taken).unwrap(), b"mine");
    let drive = Drive::new(&bowl, Wanderer::new(3), start()).limits(Limits::iterations(1));
    drive.trace(&taken).force(true).run().unwrap().checked().unwrap();
    assert!(std::fs::read(&taken).unwrap().starts_with(b"iteration,"));
}

#[test]
fn a_full_disk_ends_no_run() {
    let folder = tempfile::tempdir().unwrap();
    let inner = folder.path().join("inner");
    std::fs::create_dir(&inner).unwrap();
    let outcome = Drive::new(&bowl(), Wanderer::new(3), start())
        .limits(Limits::iterations(9))
        .checkpoint(inner.join("run.checkpoint"), 4)
        .trace(inner.join("trace.csv"))
        .on_step(|event| {
            if event.iteration == 1 {
                std::fs::remove_dir(&inner).unwrap();
            }
        })
        .run()
        .unwrap();
    assert_eq!(outcome.iterations, 9);
    assert!(matches!(outcome.checked(), Err(DriveError::File(FileError::Write { .. }))));
}
