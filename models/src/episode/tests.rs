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
    let image = Array4::from_elem((3, 64, 64, 3), 7);
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

/// Two cameras of 128 x 128, seven numbers of action, three of state; every pixel of a step differs from its neighbours.
fn large() -> Episode {
    let mut action = Array2::from_elem((2, 7), 0.5);
    action.row_mut(0).fill(0.0);
    let image = Array4::from_shape_fn((2, 128, 128, 6), |(t, y, x, c)| (t + 3 * y + 5 * x + 40 * c) as u8);
    Episode {
        disturbed: Some(image.mapv(|value| value / 2)),
        image,
        action,
        robot_mask: Some(Array3::from_shape_fn((2, 128, 256), |(t, y, x)| (t + y + x) % 3 == 0)),
        proprio: Some(Array2::from_shape_fn((2, 3), |(t, i)| (10 * t + i) as f32)),
        ..Episode::blank_of(2, 128, 2, 7)
    }
}

#[test]
fn several_cameras_of_128_and_vectors_of_any_length_survive_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("episode.npz");
    large().write(&path).unwrap();
    assert_eq!(Episode::read(&path).unwrap(), large());
    assert_eq!(npz::has(&path, "image_2").unwrap(), npz::has(&path, "robot_mask_2").unwrap());
    assert!(!npz::has(&path, "image_3").unwrap());
}

#[test]
fn what_does_not_fit_a_model_is_named_with_what_was_found_and_what_is_needed() {
    use crate::settings::{ModelKind, Preset};
    let small = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let fits = ModelSettings { image_side: 128, cameras: 2, action: 7, state: 3, ..small.clone() };
    assert_eq!(large().misfit(&fits), None);
    assert_eq!(large().misfit(&ModelSettings { state: 0, ..fits.clone() }), None, "not looked at");
    let said = |episode: &Episode, model: ModelSettings| {
        let Misfit { key, found, expected } = episode.misfit(&model).unwrap();
        format!("{key}: {found}, {expected}")
    };
    assert_eq!(said(&large(), small), "image: 128 x 128 of 2 cameras, 64 x 64 of 1 camera");
    let other = ModelSettings { action: 4, ..fits.clone() };
    assert_eq!(said(&large(), other), "action: of 7 numbers, of 4 numbers");
    let other = ModelSettings { state: 14, ..fits.clone() };
    assert_eq!(said(&large(), other), "proprio: of 3 numbers, of 14 numbers");
    assert_eq!(said(&Episode { proprio: None, ..large() }, fits), "proprio: missing, of 3 numbers");
}
