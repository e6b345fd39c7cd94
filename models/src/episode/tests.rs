use super::*;
use crate::interface::Interface;
use crate::wire::{Format, ObservationFlags, OwnedObservation};

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

/// A robot like Meta-World's arm with other cameras, all of this size.
fn robot(cameras: usize, [rows, columns]: [usize; 2]) -> Interface {
    let mut robot = Interface::metaworld();
    let mut camera = robot.camera.remove(0);
    for number in 0..cameras {
        (camera.name, camera.shape) = (format!("camera{number}"), [rows, columns, 3]);
        robot.camera.push(camera.clone());
    }
    robot
}

fn pushed(robot: Interface) -> Result<Option<Episode>, EpisodeError> {
    let mut builder = EpisodeBuilder::new();
    builder.push(&OwnedObservation::zeroed(&Format::of(robot)).view())?;
    Ok(builder.finish())
}

#[test]
fn what_is_recorded_of_any_robot_is_read_back_or_refused_at_its_first_observation() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("episode.npz");
    let without_state = Interface { state: Vec::new(), ..robot(1, [64, 64]) };
    let mut many_numbers = robot(1, [64, 64]);
    many_numbers.action[0].elements = (0..64).map(|at| at.to_string()).collect();
    (many_numbers.action[0].low, many_numbers.action[0].high) = (vec![-2.0; 64], vec![2.0; 64]);
    for robot in [robot(1, [64, 64]), robot(4, [128, 128]), without_state, many_numbers] {
        let episode = pushed(robot).unwrap().unwrap();
        episode.write(&path).unwrap();
        assert_eq!(Episode::read(&path).unwrap(), episode);
    }
    let mut two_sizes = robot(2, [64, 64]);
    two_sizes.camera[1].shape = [128, 128, 3];
    let mut large_state = robot(1, [64, 64]);
    let state = crate::interface::State {
        elements: (0..600).map(|at| at.to_string()).collect(),
        ..large_state.state[0].clone()
    };
    large_state.state =
        ["a", "b"].map(|name| crate::interface::State { name: name.into(), ..state.clone() }).into();
    for (robot, found) in [
        (robot(0, [0, 0]), "no camera"),
        (robot(1, [480, 640]), "a camera of 480 x 640 x 3"),
        (robot(1, [32, 32]), "a camera of 32 x 32 x 3"),
        (robot(5, [64, 64]), "5 cameras of 64 x 64 x 3, "),
        (two_sizes, "2 cameras of 64 x 64 x 3, 128 x 128 x 3"),
        (large_state, "a state of 1200 numbers"),
    ] {
        let said = match pushed(robot) {
            Err(error @ EpisodeError::Robot { .. }) => error.to_string(),
            other => panic!("{found}: {other:?}"),
        };
        assert!(said.contains(found) && said.contains("an episode holds") && !said.contains('\n'), "{said}");
    }
}

#[test]
fn an_episode_that_could_not_be_read_back_is_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("episode.npz");
    let blank = || Episode::blank(2);
    for (episode, key, found) in [
        (Episode::blank_of(2, 32, 1, 4), "image", "[2, 32, 32, 3]"),
        (Episode::blank_of(2, 64, 5, 4), "image", "of 15 channels"),
        (Episode::blank_of(2, 64, 0, 4), "image", "missing"),
        (Episode::blank_of(0, 64, 1, 4), "image", "[0, 64, 64, 3]"),
        (Episode::blank_of(2, 64, 1, 65), "action", "[2, 65]"),
        (Episode { action: Array2::from_elem((2, 4), 0.5), ..blank() }, "action", "not zero at step 0"),
        (Episode { reward: Array1::from_elem(2, f32::NAN), ..blank() }, "reward", "not finite"),
        (Episode { reward: Array1::zeros(3), ..blank() }, "reward", "[3]"),
        (Episode { proprio: Some(Array2::zeros((2, 1025))), ..blank() }, "proprio", "[2, 1025]"),
        (Episode { robot_mask: Some(Array3::from_elem((2, 64, 32), true)), ..blank() }, "robot_mask", "32"),
        (Episode { disturbed: Some(Array4::zeros((2, 64, 64, 6))), ..blank() }, "disturbed", "6]"),
    ] {
        let said = episode.write(&path).unwrap_err().to_string();
        assert!(said.contains(&format!("{key:?}")) && said.contains(found) && !path.exists(), "{said}");
    }
    Episode { proprio: Some(Array2::zeros((2, 0))), ..blank() }.write(&path).unwrap();
    assert_eq!(Episode::read(&path).unwrap().proprio, None);
}

#[test]
fn an_episode_that_nobody_ends_does_not_take_all_memory() {
    let step_bytes = Format::metaworld().layout().observation_bytes;
    let mut builder = EpisodeBuilder::of_at_most(3 * step_bytes + 1);
    for step in 0..3 {
        builder.push(&observation(step, false, true).view()).unwrap();
    }
    let error = builder.push(&observation(3, false, true).view()).unwrap_err();
    assert!(matches!(error, EpisodeError::Full { steps: 3, .. }), "{error}");
    assert!(error.to_string().contains("full after 3 steps"), "{error}");
    assert_eq!(builder.finish().unwrap().len(), 3, "what was pushed is kept");
    // Packed or not, what is recorded is a file that is read.
    const { assert!((RECORDED_BYTES_MAX as u64) < EPISODE_BYTES_MAX / 100 * 99) };
}
