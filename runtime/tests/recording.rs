//! What is recorded is what was seen.

mod support;

use rcwm_models::ACTION_LEN;
use rcwm_models::episode::Episode;
use rcwm_models::wire::ObservationFlags;
use support::{ask, image, observation, own_link, smallest_bundle, start_recording};

#[test]
fn an_episode_is_recorded_as_it_was_published_and_filmed() {
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let peer = link.peer();
    let controller = start_recording(&smallest_bundle(), &link, folder.path());
    for step in 0..20 {
        let mut sent = observation(u64::from(step), step);
        sent.reward = step as f32;
        sent.flags |= if step == 19 { ObservationFlags::LAST.0 } else { 0 };
        ask(&peer, &sent);
    }
    peer.close().unwrap();
    let recorded = controller.join().unwrap();
    assert_eq!((recorded.films.len(), recorded.episodes.len(), recorded.broken_episodes), (1, 1, 0));
    let episode = Episode::read(&recorded.episodes[0]).unwrap();
    assert_eq!((episode.len(), episode.total_reward()), (20, 190.0));
    for step in 0..20_u32 {
        let expected = observation(0, step);
        assert!(episode.image.index_axis(ndarray::Axis(0), step as usize).iter().eq(image(step).iter()));
        for index in 0..ACTION_LEN {
            assert_eq!(episode.action[[step as usize, index]], expected.executed_action[index]);
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
    let (link, folder) = (own_link(), tempfile::tempdir().unwrap());
    let peer = link.peer();
    let controller = start_recording(&smallest_bundle(), &link, folder.path());
    for step in [0, 1, 4, 5] {
        ask(&peer, &observation(u64::from(step), step));
    }
    peer.close().unwrap();
    let recorded = controller.join().unwrap();
    assert_eq!((recorded.films.len(), recorded.episodes.len(), recorded.broken_episodes), (1, 0, 1));
}
