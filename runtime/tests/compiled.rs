//! The compiled tick against the exported parts.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::wire::ActionValues;
use rcwm_runtime::compile::{Optimizations, compile};
use rcwm_runtime::engine::{EngineKind, Form};
use rcwm_runtime::policy::Sampling;
use rcwm_runtime::{EngineSettings, Policy};
use rcwm_testkit::{image, smallest_bundle};
use rustix::process::Pid;
use rustix::thread::{CpuSet, sched_getaffinity, sched_getcpu, sched_setaffinity};

fn policy(bundle: &Bundle, settings: EngineSettings) -> Policy {
    Policy::new(bundle, settings, Sampling::Sample { seed: 3 }).unwrap()
}

fn with(optimizations: Optimizations) -> EngineSettings {
    EngineSettings::single_threaded(EngineKind::Tract).with_form(Form::Compiled(optimizations))
}

#[test]
fn nothing_that_is_hot_is_left_between_image_and_action() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let segments = compile(&bundle, Optimizations::EXACT).unwrap();
    let late: Vec<PartName> = segments.iter().filter(|s| s.late).map(|s| s.part).collect();
    assert_eq!(late, [PartName::Encoder, PartName::Robot, PartName::Environment, PartName::Actor]);
    let early: Vec<PartName> = segments.iter().filter(|s| !s.late).map(|s| s.part).collect();
    assert_eq!(early, [PartName::Robot, PartName::Interaction, PartName::Environment, PartName::Actor]);
    let hot = [
        "Conv",
        "MatMul",
        "Gather",
        "ReduceSum",
        "LayerNormalization",
        "Softmax",
        "Log",
        "ArgMax",
        "Transpose",
    ];
    for segment in segments.iter().filter(|segment| segment.late) {
        for operator in &segment.operators {
            assert!(!hot.contains(&operator.as_str()), "{operator} in {}", segment.part);
        }
    }
}

#[test]
fn every_optimization_gives_what_the_exported_parts_give() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let none = Optimizations::NONE;
    let norms = Optimizations { norms: true, ..none };
    let convolutions = Optimizations { convolutions: true, ..norms };
    let layers = Optimizations { layers: true, ..none };
    let mut exported = policy(&bundle, with(none).with_form(Form::Exported));
    let mut others =
        [none, norms, convolutions, layers, Optimizations::EXACT].map(|o| policy(&bundle, with(o)));
    for step in 0..40 {
        let executed = ActionValues::from([0.2, -0.5, (step as f32).sin(), 1.0]);
        let executed = (step % 20 > 0).then_some(&executed);
        let expected = exported.observe(&image(step), executed).unwrap();
        for (index, other) in others.iter_mut().enumerate() {
            let found = other.observe(&image(step), executed).unwrap();
            for (found, expected) in
                found.mean.iter().chain(&found.std).zip(expected.mean.iter().chain(&expected.std))
            {
                assert!((found - expected).abs() < 1e-4, "{index}, step {step}: {found} {expected}");
            }
            assert_eq!(other.state().branches[0].z, exported.state().branches[0].z, "{index}, step {step}");
            assert_eq!(other.state().branches[1].z, exported.state().branches[1].z, "{index}, step {step}");
            other.set_state(exported.state()).unwrap();
        }
        let state = exported.state().clone();
        exported.set_state(&state).unwrap();
    }
}

#[test]
fn two_graphs_in_the_other_engine_give_what_its_exported_parts_give() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let [mut exported, mut split] =
        [Form::Exported, Form::Split].map(|form| policy(&bundle, EngineSettings::ort(1).with_form(form)));
    let mut executed = None;
    for step in 0..20 {
        // What is worked ahead must be what is used: every other tick does it at once.
        if step % 2 == 0 {
            split.work_ahead(executed.as_ref()).unwrap();
        }
        let expected = exported.observe(&image(step), executed.as_ref()).unwrap();
        let found = split.observe(&image(step), executed.as_ref()).unwrap();
        for (found, expected) in found.mean.iter().zip(expected.mean.iter()) {
            assert!((found - expected).abs() < 1e-5, "step {step}: {found} {expected}");
        }
        let classes =
            |policy: &Policy| policy.state().branches.iter().map(|b| b.z.clone()).collect::<Vec<_>>();
        assert_eq!(classes(&split), classes(&exported), "step {step}");
        executed = Some(expected.action);
        if step % 5 == 4 {
            let missing = expected.action;
            let (found, expected) = (split.imagine(&missing).unwrap(), exported.imagine(&missing).unwrap());
            assert!((found.mean[0] - expected.mean[0]).abs() < 1e-5, "step {step}, imagined");
            executed = Some(expected.action);
        }
    }
}

#[test]
fn one_thread_and_two_give_the_same_bits() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let settings = with(Optimizations::EXACT);
    let (mut one, mut two) = (policy(&bundle, settings), policy(&bundle, settings.with_threads(2)));
    for step in 0..200 {
        let executed = (step > 0).then(|| ActionValues::from([0.1; 4]));
        let executed = executed.as_ref();
        let (one, two) = (one.observe(&image(step), executed), two.observe(&image(step), executed));
        let (one, two) = (one.unwrap(), two.unwrap());
        assert_eq!(one.action.to_bits(), two.action.to_bits(), "step {step}");
        assert_eq!(one.surprise, two.surprise);
    }
}

/// Getting ready computes on the last image; neither what is observed nor what is imagined after it may show a trace of that.
#[test]
fn warming_the_caches_changes_no_bit_of_what_follows() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    for threads in [1, 2] {
        let settings = with(Optimizations::EXACT).with_threads(threads);
        let (mut plain, mut warmed) = (policy(&bundle, settings), policy(&bundle, settings));
        for step in 0..60 {
            let executed = ActionValues::from([0.1, (step as f32).cos(), -0.4, 0.0]);
            let tick = |policy: &mut Policy, warms_caches: bool| {
                // Ahead for what is executed, or for something else; before or after getting ready.
                let ahead = if step % 3 == 0 { [0.7; 4].into() } else { executed };
                if step > 0 && step % 2 == 0 {
                    policy.work_ahead(Some(&ahead)).unwrap();
                }
                if warms_caches {
                    policy.warm_caches();
                }
                match step % 5 {
                    4 => policy.imagine(&executed).unwrap(),
                    _ => policy.observe(&image(step), (step > 0).then_some(&executed)).unwrap(),
                }
            };
            let (expected, found) = (tick(&mut plain, false), tick(&mut warmed, true));
            assert_eq!(found.action.to_bits(), expected.action.to_bits(), "step {step}");
            assert_eq!((found.surprise, found.recomputed), (expected.surprise, expected.recomputed));
            assert_eq!(warmed.state(), plain.state(), "step {step}");
        }
    }
}

/// The helper is kept from running, then let go, again and again: what it brings too late is never taken for what was asked last.
#[test]
fn a_second_thread_that_is_late_is_done_without_and_changes_no_bit() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    std::thread::spawn(move || {
        let settings = with(Optimizations::EXACT);
        let (mut alone, mut beside) = (policy(&bundle, settings), policy(&bundle, settings.with_threads(2)));
        let all = sched_getaffinity(None).unwrap();
        let mut late = 0;
        for step in 0..400 {
            let starved = step / 10 % 2 == 0;
            if step % 10 == 0 {
                let policy = if step % 40 == 0 { libc::SCHED_IDLE } else { libc::SCHED_OTHER };
                starve_helpers(starved, policy, &all);
            }
            let executed = ActionValues::from([0.1, (step as f32).cos(), -0.4, 0.0]);
            let executed = (step > 0).then_some(&executed);
            let expected = alone.observe(&image(step), executed).unwrap();
            let found = beside.observe(&image(step), executed).unwrap();
            late += u32::from(starved && found.helper_late);
            assert!(!expected.helper_late);
            assert_eq!(found.action.to_bits(), expected.action.to_bits(), "step {step}");
            assert_eq!(beside.state(), alone.state(), "step {step}");
        }
        // Of the hundred ticks with SCHED_IDLE; how often it is late otherwise depends on what else the machine does.
        assert!(late > 20, "late for {late} ticks");
    })
    .join()
    .unwrap();
}

/// Gives the ticks' second threads the core of the calling thread, and of that a tenth, so that they are stopped half-way, or with
/// SCHED_IDLE hardly anything; or all the cores that there are for this process.
fn starve_helpers(starve: bool, policy: i32, all: &CpuSet) {
    let mut cpus = *all;
    if starve {
        cpus.clear();
        cpus.set(sched_getcpu());
    }
    sched_setaffinity(None, &cpus).unwrap();
    for task in std::fs::read_dir("/proc/self/task").unwrap().flatten() {
        if std::fs::read_to_string(task.path().join("comm")).is_ok_and(|name| name.trim_end() == "rcwm-tick")
        {
            let id: i32 = task.file_name().to_str().unwrap().parse().unwrap();
            let parameters = libc::sched_param { sched_priority: 0 };
            // One that has ended meanwhile belongs to another test; the way back may need a privilege, and is not needed.
            let _ = sched_setaffinity(Pid::from_raw(id), &cpus);
            // SAFETY: the parameters live through the calls.
            unsafe {
                libc::sched_setscheduler(id, policy, &raw const parameters);
                libc::setpriority(libc::PRIO_PROCESS, id as libc::id_t, if starve { 10 } else { 0 });
            }
        }
    }
}

/// What was imagined goes on from the prior, whichever way the tick is computed.
#[test]
fn imagined_frames_agree_with_the_exported_parts() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let settings = with(Optimizations::EXACT);
    let mut exported = policy(&bundle, settings.with_form(Form::Exported));
    let mut compiled = policy(&bundle, settings);
    for step in 0..30 {
        let executed = ActionValues::from([0.3; 4]);
        let tick = |policy: &mut Policy| match step % 3 {
            0 => policy.observe(&image(step), (step > 0).then_some(&executed)).unwrap(),
            _ => policy.imagine(&executed).unwrap(),
        };
        let (expected, found) = (tick(&mut exported), tick(&mut compiled));
        assert_eq!(expected.surprise.is_some(), step % 3 == 0);
        for (found, expected) in found.mean.iter().zip(expected.mean) {
            assert!((found - expected).abs() < 1e-4, "step {step}: {found} {expected}");
        }
        assert_eq!(compiled.state().branches[0].z, exported.state().branches[0].z, "step {step}");
    }
}
