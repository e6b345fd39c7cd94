//! What is measured beside one another.

use serde::Serialize;

use rcwm_runtime::compile::Optimizations;
use rcwm_runtime::engine::{EngineKind, EngineSettings, Form};

/// A way to run the tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Case {
    /// In tables.
    pub name: &'static str,
    /// How.
    #[serde(flatten)]
    pub settings: EngineSettings,
    /// Whether it gets ready before an image is expected, as a controller does.
    pub warms_caches: bool,
}

/// ONNX Runtime as the baseline: the five exported parts one after another, one thread.
pub(super) const BASELINE: EngineSettings = EngineSettings::ort(1);
/// ONNX Runtime with our schedule: what needs only the action worked ahead, one graph from image to action, warmed alike.
pub(super) const fn split(threads: usize) -> EngineSettings {
    EngineSettings::ort(threads).with_form(Form::Split)
}
/// The compiled tick on one thread.
pub(super) const SINGLE: EngineSettings = EngineSettings::single_threaded(EngineKind::Tract);

/// tract as it is deployed on one and on two threads; ONNX Runtime on one and on two, the exported parts one after another and, where there is
/// a world model, with our schedule.
#[must_use]
pub fn engines(kinds: &[EngineKind], has_world_model: bool) -> Vec<Case> {
    let case = |name, settings| Case { name, settings, warms_caches: true };
    let mut cases = Vec::new();
    for kind in kinds {
        match kind {
            EngineKind::Tract => {
                cases.push(case("tract", SINGLE));
                if EngineSettings::tract().threads > 1 {
                    cases.push(case("tract, 2 threads", EngineSettings::tract()));
                }
            }
            EngineKind::Ort => {
                cases.push(case("ort", BASELINE));
                cases.push(case("ort, 2 threads", EngineSettings::ort(2)));
                if has_world_model {
                    cases.push(case("ort, split", split(1)));
                    cases.push(case("ort, split, 2 threads", split(2)));
                }
            }
        }
    }
    cases
}

/// tract from the exported parts to what is deployed, one step at a time, each with all before it.
#[must_use]
pub fn ablation() -> Vec<Case> {
    let none = Optimizations::NONE;
    let norms = Optimizations { norms: true, ..none };
    let convolutions = Optimizations { convolutions: true, ..norms };
    let layers = Optimizations { layers: true, ..convolutions };
    let half = Optimizations { half_weights: true, ..layers };
    let compiled = |name, optimizations, warms_caches| Case {
        name,
        settings: SINGLE.with_form(Form::Compiled(optimizations)),
        warms_caches,
    };
    let mut cases = vec![
        Case { name: "exported parts", settings: SINGLE.with_form(Form::Exported), warms_caches: false },
        compiled("cut, worked ahead", none, false),
        compiled("+ norms fused", norms, false),
        compiled("+ convolutions", convolutions, false),
        compiled("+ layers", layers, false),
        compiled("+ caches warmed", layers, true),
        compiled("+ f16 weights", half, true),
    ];
    if EngineSettings::tract().threads > 1 {
        let two = |name, optimizations| {
            let settings = EngineSettings::tract().with_form(Form::Compiled(optimizations));
            Case { name, settings, warms_caches: true }
        };
        cases.extend([two("2 threads", layers), two("2 threads, f16 weights", half)]);
    }
    cases
}
