//! What a tick asks of the allocator: nothing in our code, a bounded number of small pieces in tract's plan, and no growth.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use rcwm_models::bundle::Bundle;
use rcwm_models::onnx::data_type;
use rcwm_runtime::compile::{Optimizations, Segment, compile};
use rcwm_runtime::engine::EngineKind;
use rcwm_runtime::policy::Sampling;
use rcwm_runtime::{EngineSettings, Policy, operators};
use rcwm_testkit::counting::{Counting, allocations};
use rcwm_testkit::{image, smallest_bundle};
use tract_onnx::prelude::*;
use tract_onnx::tract_core::plan::eval;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn policy(bundle: &Bundle) -> Policy {
    Policy::new(bundle, EngineSettings::single_threaded(EngineKind::Tract), Sampling::Sample { seed: 1 })
        .unwrap()
}

fn inputs(segment: &Segment) -> TVec<TValue> {
    let zeros = |dtype: i32, shape: &[usize]| match dtype {
        data_type::UINT8 => Tensor::zero::<u8>(shape),
        data_type::INT64 => Tensor::zero::<i64>(shape),
        _ => Tensor::zero::<f32>(shape),
    };
    segment.inputs.iter().map(|(_, fact)| zeros(fact.dtype, &fact.shape).unwrap().into_tvalue()).collect()
}

/// Allocations of one run of a segment in tract once it has settled, and those within our operators.
fn of_segment(segment: &Segment) -> (u64, u64) {
    let model = operators::onnx().model_for_read(&mut &segment.onnx[..]).unwrap();
    let model = model.into_typed().unwrap().into_decluttered().unwrap().into_optimized().unwrap();
    let mut state = TypedSimpleState::new(&model.into_runnable().unwrap()).unwrap();
    let (mut whole, mut ours) = (0, 0);
    let inputs = inputs(segment);
    for _ in 0..5 {
        let fed = inputs.clone();
        whole = allocations(|| state.run(fed).unwrap()).0;
    }
    for _ in 0..5 {
        ours = 0;
        let run = state.run_plan_with_eval(inputs.clone(), |context, state, node, inputs| {
            let (count, result) = allocations(|| eval(context, state, node, inputs));
            if node.op.name().starts_with("Rcwm") {
                ours += count;
            }
            result
        });
        run.unwrap();
    }
    (whole, ours)
}

#[test]
fn a_steady_tick_allocates_in_tracts_plan_only_and_little() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let segments = compile(&bundle, Optimizations::EXACT).unwrap();
    let counts: Vec<(u64, u64)> = segments.iter().map(of_segment).collect();
    for (segment, (_, ours)) in segments.iter().zip(&counts) {
        assert_eq!(*ours, 0, "our operators in {} (late: {}) allocate", segment.part, segment.late);
    }
    let sum = |late: bool| -> u64 {
        segments
            .iter()
            .zip(&counts)
            .filter(|(segment, _)| segment.late == late)
            .map(|(_, count)| count.0)
            .sum()
    };
    let mut policy = policy(&bundle);
    let image = image(0);
    let mut executed = None;
    for step in 0..20 {
        let (ahead, result) = allocations(|| policy.work_ahead(executed.as_ref()));
        result.unwrap();
        let (observed, decision) = allocations(|| policy.observe(&image, executed.as_ref()));
        executed = Some(decision.unwrap().action);
        if step >= 5 {
            assert_eq!((ahead, observed), (sum(false), sum(true)), "step {step}: more than tract's");
        }
    }
    println!(
        "allocations of a tick, all of them tract's: {} ahead, {} once the image is there",
        sum(false),
        sum(true)
    );
    assert!(sum(true) <= 60 && sum(false) <= 400, "{} {}", sum(true), sum(false));
}

#[test]
fn memory_stays_as_it_is_over_a_hundred_thousand_ticks() {
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let mut policy = Policy::new(&bundle, EngineSettings::tract(), Sampling::Mode).unwrap();
    let images: Vec<_> = (0..16).map(image).collect();
    let mut executed = None;
    let mut settled_kb = 0;
    for tick in 0..100_000_usize {
        let decision = policy.observe(&images[tick % 16], executed.as_ref()).unwrap();
        executed = (tick % 250 != 249).then_some(decision.action);
        policy.work_ahead(executed.as_ref()).unwrap();
        if tick == 5_000 {
            settled_kb = resident_kb();
        }
    }
    let grown_kb = resident_kb().saturating_sub(settled_kb);
    assert!(grown_kb <= 512, "grew by {grown_kb} kB over {settled_kb} kB");
}

fn resident_kb() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}
