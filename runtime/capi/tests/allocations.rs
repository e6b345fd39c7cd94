//! A tick through C allocates no more than one in Rust, and its actions have the same bits.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::ffi::CString;
use std::ptr;

use rcwm::{Code, Decision, Picture, PolicyOptions};
use rcwm_runtime::{EngineKind, EngineSettings, Policy};
use rcwm_testkit::counting::{Counting, allocations};
use rcwm_testkit::{image, smallest_bundle};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn a_tick_allocates_no_more_than_in_rust_and_decides_the_same() {
    let bundle = smallest_bundle();
    let settings = EngineSettings::single_threaded(EngineKind::Tract);
    let mut in_rust = Policy::load(&bundle, settings).unwrap();
    let folder = CString::new(bundle.to_str().unwrap()).unwrap();
    let options = PolicyOptions { size: size_of::<PolicyOptions>(), threads: 1, half_weights: 0 };
    let mut in_c = ptr::null_mut();
    // SAFETY: all three are ours.
    let opened = unsafe { rcwm::rcwm_policy_open(folder.as_ptr(), &raw const options, &raw mut in_c) };
    assert_eq!(opened, Code::RcwmOk);
    // SAFETY: numbers only, of which zeros are one.
    let mut decision: Decision = unsafe { std::mem::zeroed() };
    decision.size = size_of::<Decision>();
    let mut executed = None;
    for step in 0..20 {
        let image = image(step);
        let (rust, decided) = allocations(|| in_rust.observe(&image, executed.as_ref()).unwrap());
        let picture = Picture { bytes: image.as_ptr(), len: image.len() };
        let (values, count) = executed.as_ref().map_or((ptr::null(), 0), |all| (all.as_ptr(), all.len()));
        let observe = || {
            // SAFETY: an open policy, and memory of ours.
            unsafe {
                rcwm::rcwm_policy_observe(
                    in_c,
                    &raw const picture,
                    1,
                    ptr::null(),
                    0,
                    values,
                    count,
                    &raw mut decision,
                )
            }
        };
        let (c, code) = allocations(observe);
        assert_eq!(code, Code::RcwmOk);
        let bits: Vec<u32> = decision.action[..decision.numbers].iter().map(|x| x.to_bits()).collect();
        assert_eq!(bits, decided.action.to_bits(), "step {step}");
        if step >= 5 {
            assert_eq!(c, rust, "step {step}");
        }
        executed = Some(decided.action);
        let (rust, ahead) = allocations(|| in_rust.work_ahead(executed.as_ref()));
        ahead.unwrap();
        // SAFETY: an open policy, and numbers of ours.
        let work =
            || unsafe { rcwm::rcwm_policy_work_ahead(in_c, decided.action.as_ptr(), decided.action.len()) };
        let (c, code) = allocations(work);
        assert!(
            code == Code::RcwmOk && (step < 5 || c == rust),
            "step {step}: {c} allocations, {rust} in Rust"
        );
    }
    // SAFETY: opened above, and not used any more.
    assert_eq!(unsafe { rcwm::rcwm_policy_close(in_c) }, Code::RcwmOk);
}
