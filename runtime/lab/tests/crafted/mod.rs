//! Logs that no run has written.

use std::path::Path;

use rcwm_models::wire::{ActionSource, ActionValues, OwnedObservation};
use rcwm_runtime::EngineSettings;
use rcwm_runtime::controller::Fallback;
use rcwm_runtime::log::frames::{write_frame, write_start};
use rcwm_runtime::log::pack::{ImagePacker, PackedMask};
use rcwm_runtime::log::{
    Answer, BundleIdentity, DIGEST_BYTES, Header, Machine, Observed, Record, TickRecord,
};
use rcwm_runtime::policy::Sampling;

pub fn header(bundle: BundleIdentity) -> Header {
    Header {
        program: "test".into(),
        started_unix_s: 0,
        monotonic_to_unix_ns: None,
        instance: "test".into(),
        bundle,
        engine: EngineSettings::tract(),
        sampling: Sampling::Sample { seed: 1 },
        fallback: Fallback::Hold,
        rate_max: Some(0.1),
        stages: Vec::new(),
        machine: Machine::here(),
    }
}

/// A tick without calls; `images` pack those of each camera.
pub fn tick(images: &mut [ImagePacker], observation: &OwnedObservation, action: ActionValues) -> TickRecord {
    let (is_first, view) = (observation.step == 0, observation.view());
    let pack = |(camera, packer): (usize, &mut ImagePacker)| packer.pack(view.image(camera), is_first);
    let masks = (0..images.len()).map(|camera| view.mask(camera).map(PackedMask::pack)).collect();
    let images = images.iter_mut().enumerate().map(pack).collect();
    let source = ActionSource::Policy as u32;
    TickRecord {
        dropped_before: 0,
        resumes: false,
        is_first,
        observed: Some(Observed::of(&view, images, masks)),
        scheduled_ns: 10,
        received_ns: 20,
        overtaken: false,
        calls: Vec::new(),
        answer: Answer { answers: observation.sequence, published_ns: 30, source, action },
        digest: [0; DIGEST_BYTES],
        state: None,
    }
}

pub fn payloads(header: &Header, records: &[Record]) -> Vec<Vec<u8>> {
    let header = serde_json::to_vec(header).unwrap();
    let records = records.iter().map(|record| postcard::to_allocvec(record).unwrap());
    std::iter::once(header).chain(records).collect()
}

pub fn write(path: &Path, payloads: &[Vec<u8>]) {
    let mut bytes = Vec::new();
    write_start(&mut bytes).unwrap();
    for payload in payloads {
        write_frame(&mut bytes, payload).unwrap();
    }
    std::fs::write(path, bytes).unwrap();
}
