//! What is filmed is what was seen.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::path::Path;

use rcwm_lab::film::{Filmed, film};
use rcwm_lab::log::Replayer;
use rcwm_models::episode::Episode;
use rcwm_models::wire::{ObservationFlags, OwnedObservation};
use rcwm_runtime::log::{LogReader, LogSettings};
use rcwm_runtime::policy::Sampling;
use rcwm_runtime::{EngineSettings, Policy};
use rcwm_testkit::{ask, image, observation, own_link, smallest_bundle, start_logging};

/// What is filmed of a run on these observations.
fn filmed(folder: &Path, observations: &[OwnedObservation]) -> Filmed {
    let (link, file) = (own_link(), folder.join("run.rcwmlog"));
    let peer = link.peer();
    let policy = Policy::load(&smallest_bundle(), EngineSettings::tract()).unwrap();
    let settings = LogSettings::new("test", EngineSettings::tract(), Sampling::Mode);
    let controller = start_logging(policy, &link, &file, settings, 512, |_| ());
    observations.iter().for_each(|sent| _ = ask(&peer, sent));
    peer.close().unwrap();
    let summary = controller.join().unwrap();
    assert_eq!(summary.bundles, [smallest_bundle()]);
    let mut log = LogReader::open(&summary.file).unwrap();
    let replayer = Replayer::new(log.header(), &summary.bundles, None).unwrap();
    film(&mut log, Some(replayer), folder, 10, &mut |_| true).unwrap()
}

#[test]
fn an_episode_is_recorded_as_it_was_published_and_filmed() {
    let folder = tempfile::tempdir().unwrap();
    let sent = (0..20).map(|step| {
        let mut sent = observation(u64::from(step), step);
        sent.reward = step as f32;
        sent.flags |= if step == 19 { ObservationFlags::LAST.0 } else { 0 };
        sent
    });
    let recorded = filmed(folder.path(), &sent.collect::<Vec<_>>());
    assert_eq!((recorded.films.len(), recorded.episodes.len(), recorded.broken_episodes), (1, 1, 0));
    let episode = Episode::read(&recorded.episodes[0]).unwrap();
    assert_eq!((episode.len(), episode.total_reward()), (20, 190.0));
    for step in 0..20_u32 {
        let expected = observation(0, step);
        assert!(episode.image.index_axis(ndarray::Axis(0), step as usize).iter().eq(image(step).iter()));
        for index in 0..4 {
            assert_eq!(episode.action[[step as usize, index]], expected.view().executed_action()[index]);
        }
    }
    for ending in ["gif", "png"] {
        let film = recorded.films[0].with_extension(ending);
        assert!(image::ImageReader::open(film).unwrap().decode().is_ok());
    }
}

/// A transition over a gap would teach a dynamics that does not exist.
#[test]
fn an_episode_with_a_gap_is_filmed_but_not_kept_as_data() {
    let folder = tempfile::tempdir().unwrap();
    let recorded = filmed(folder.path(), &[0, 1, 4, 5].map(|step| observation(u64::from(step), step)));
    assert_eq!((recorded.films.len(), recorded.episodes.len(), recorded.broken_episodes), (1, 0, 1));
}
