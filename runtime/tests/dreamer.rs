//! A world model of one branch: as RCWM's, in both forms.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use rcwm_models::bundle::{Bundle, BundleKind, PartName};
use rcwm_models::wire::{ActionSource, ActionValues};
use rcwm_runtime::compile::{Optimizations, compile};
use rcwm_runtime::controller::{Cause, State};
use rcwm_runtime::engine::{EngineKind, Form, available};
use rcwm_runtime::policy::{Sampling, Surprise, SurpriseLimits};
use rcwm_runtime::verify::verify;
use rcwm_runtime::{EngineSettings, Policy};
use rcwm_testkit::{ask, dreamer_bundle, image, observation, own_link, start_controller_with};

fn single() -> EngineSettings {
    EngineSettings::single_threaded(EngineKind::Tract)
}

fn policy(settings: EngineSettings) -> Policy {
    Policy::new(&Bundle::open(&dreamer_bundle()).unwrap(), settings, Sampling::Sample { seed: 3 }).unwrap()
}

fn executed(step: u32) -> Option<ActionValues> {
    (step > 0).then(|| [0.2, -0.5, (step as f32).sin(), 1.0].into())
}

#[test]
fn the_golden_values_are_reproduced_on_every_engine() {
    let bundle = Bundle::open(&dreamer_bundle()).unwrap();
    assert_eq!(bundle.manifest.kind, BundleKind::Dreamer);
    let mut engines = vec![single(), single().with_threads(2)];
    engines.extend(available(EngineKind::Ort).is_ok().then(|| EngineSettings::ort(1)));
    for engine in engines {
        let report = verify(&bundle, engine, 1e-5, &mut || {}).unwrap();
        assert!(report.failures.is_empty(), "{:?}", report.failures);
        assert_eq!(report.recurrent.ticks_compared, 4);
    }
}

#[test]
fn what_needs_no_picture_is_worked_ahead_and_nothing_hot_is_left_after_it() {
    let segments = compile(&Bundle::open(&dreamer_bundle()).unwrap(), Optimizations::EXACT).unwrap();
    let parts = |late: bool| -> Vec<PartName> {
        segments.iter().filter(|segment| segment.late == late).map(|segment| segment.part).collect()
    };
    assert_eq!(parts(true), [PartName::Encoder, PartName::Dynamics, PartName::Actor]);
    assert_eq!(parts(false), [PartName::Dynamics, PartName::Actor]);
    for segment in segments.iter().filter(|segment| segment.late) {
        for hot in ["Conv", "MatMul", "Gather", "LayerNormalization", "Softmax", "ArgMax", "Transpose"] {
            assert!(!segment.operators.iter().any(|found| found == hot), "{hot} in {}", segment.part);
        }
    }
}

#[test]
fn the_compiled_tick_gives_what_the_exported_parts_give_and_two_threads_the_same_bits() {
    let mut exported = policy(single().with_form(Form::Exported));
    let (mut one, mut two) = (policy(single()), policy(single().with_threads(2)));
    for step in 0..40 {
        let executed = executed(step % 20);
        let executed = executed.as_ref();
        let expected = exported.observe(&image(step), executed).unwrap();
        one.work_ahead(executed).unwrap();
        let found = one.observe(&image(step), executed).unwrap();
        for (found, expected) in found.mean.iter().zip(expected.mean.iter()) {
            assert!((found - expected).abs() < 1e-4, "step {step}: {found} {expected}");
        }
        assert_eq!(one.state().branches[0].z, exported.state().branches[0].z, "step {step}");
        // Ahead for what is not executed: done again.
        two.work_ahead(Some(&[0.9; 4].into())).unwrap();
        let again = two.observe(&image(step), executed).unwrap();
        assert_eq!(again.action.to_bits(), found.action.to_bits(), "step {step}");
        assert_eq!((again.surprise, again.recomputed), (found.surprise, true));
        one.set_state(exported.state()).unwrap();
        two.set_state(exported.state()).unwrap();
    }
}

#[test]
fn a_missing_frame_is_imagined_and_the_surprise_is_one_number() {
    for settings in [single(), single().with_form(Form::Exported)] {
        let mut policy = policy(settings);
        policy.observe(&image(0), None).unwrap();
        let seen = policy.observe(&image(1), executed(1).as_ref()).unwrap();
        assert!(matches!(seen.surprise, Some(Surprise::Dreamer(nats)) if nats > 0.0), "{:?}", seen.surprise);
        let before = policy.state().clone();
        let imagined = policy.imagine(&executed(2).unwrap()).unwrap();
        assert_eq!((imagined.surprise, policy.imagines()), (None, true));
        assert_eq!(policy.state().branches[0].z, policy.buffers().branches[0].prior_z);
        assert_ne!(*policy.state(), before);
    }
}

#[test]
fn its_surprise_has_a_limit_and_a_report_of_its_own() {
    let link = own_link();
    let peer = link.peer();
    let controller = start_controller_with(&dreamer_bundle(), &link, |settings| {
        settings.surprise = SurpriseLimits { dynamics_max: Some(0.0), ..SurpriseLimits::default() };
    });
    assert_eq!(ask(&peer, &observation(0, 0)).source, ActionSource::Policy as u32);
    for sequence in 1..4 {
        let answer = ask(&peer, &observation(sequence, sequence as u32));
        assert_eq!(answer.source, ActionSource::Fallback as u32);
    }
    peer.close().unwrap();
    let report = controller.join().unwrap().1;
    let counters = report.counters;
    assert_eq!((counters.dynamics_surprises, counters.robot_surprises), (3, 0));
    assert_eq!(report.last_state, State::Fallback { ticks: 3, cause: Cause::DynamicsSurprise });
    let json = serde_json::to_value(report.surprise.unwrap()).unwrap();
    let keys: Vec<_> = json.as_object().unwrap().keys().collect();
    assert_eq!(keys, ["count", "dynamics"]);
    let summary = report.summary();
    let line = summary.lines().find(|line| line.starts_with("surprise")).unwrap();
    assert!(line.contains("(3 over)") && !line.contains("robot"), "{line}");
}
