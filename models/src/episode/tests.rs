use super::*;
use crate::wire::{Format, OwnedObservation};

fn observation(step: u32, last: bool, mask: bool) -> OwnedObservation {
    let mut whole = OwnedObservation::zeroed(&Format::metaworld());
    let mut observation = whole.edit();
    observation.step = step;
    observation.flags = ObservationFlags::default()
        .with(ObservationFlags::FIRST, step == 0)
        .with(ObservationFlags::LAST, last)
        .with(ObservationFlags::MASK_VALID, mask)
        .0;
    observation.reward = step as f32;
    observation.image(0)[step as usize] = 200;
    observation.mask(0).unwrap()[step as usize] = 255;
    observation.executed()[1] = -0.25;
    observation.state()[17] = 0.5;
    whole
}

#[test]
fn an_episode_survives_the_file() {
    let mut builder = EpisodeBuilder::new();
    for step in 0..4 {
        builder.push(&observation(step, step == 3, true).view()).unwrap();
    }
    let episode = builder.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("episode.npz");
    episode.write(&path).unwrap();
    assert_eq!(Episode::read(&path).unwrap(), episode);
    assert_eq!((episode.len(), episode.total_reward()), (4, 6.0));
    assert!(episode.is_last[3] && !episode.is_last[2]);
}

#[test]
fn masks_are_kept_only_when_every_step_has_one() {
    let mut builder = EpisodeBuilder::new();
    builder.push(&observation(0, false, true).view()).unwrap();
    builder.push(&observation(1, true, false).view()).unwrap();
    assert!(builder.finish().unwrap().robot_mask.is_none());
    assert!(builder.finish().is_none(), "the builder starts anew");
}

#[test]
fn an_episode_neither_restarts_nor_goes_on_after_its_end() {
    let mut builder = EpisodeBuilder::new();
    builder.push(&observation(0, false, true).view()).unwrap();
    assert!(builder.push(&observation(0, false, true).view()).is_err());
    builder.push(&observation(1, true, true).view()).unwrap();
    assert!(builder.push(&observation(2, false, true).view()).is_err());
    let mut poisoned = observation(0, false, true);
    poisoned.reward = f32::NAN;
    assert!(EpisodeBuilder::new().push(&poisoned.view()).is_err());
}

#[test]
fn a_second_look_survives_the_file_and_a_pipe_in_its_place_is_not_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("episode.npz");
    let plain = Episode::blank(3);
    plain.write(&path).unwrap();
    assert!(!Episode::is_disturbed(&path).unwrap());
    let image = Array4::from_elem((3, IMAGE_SIDE, IMAGE_SIDE, IMAGE_CHANNELS), 7);
    let disturbed = Episode { disturbed: Some(image), ..plain };
    disturbed.write(&path).unwrap();
    assert!(Episode::is_disturbed(&path).unwrap());
    assert_eq!(Episode::read(&path).unwrap(), disturbed);
    assert_eq!(Episode::read(&path).unwrap().shortened(2).disturbed.unwrap().shape()[0], 2);
    let pipe = folder.path().join("pipe.npz");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    assert!(matches!(Episode::is_disturbed(&pipe), Err(EpisodeError::File(FileError::NotAFile { .. }))));
}

#[test]
fn a_damaged_file_is_one_clear_error() {
    let mut builder = EpisodeBuilder::new();
    builder.push(&observation(0, true, true).view()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("episode.npz");
    builder.finish().unwrap().write(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    for len in (0..bytes.len()).step_by(97) {
        std::fs::write(&path, &bytes[..len]).unwrap();
        assert!(Episode::read(&path).is_err(), "{len} bytes were accepted");
    }
}
