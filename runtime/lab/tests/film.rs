//! What is filmed is what was seen.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

mod crafted;

use std::path::Path;

use rcwm_lab::film::{FilmError, Filmed, film};
use rcwm_lab::log::{ReplayError, Replayer, write_episodes};
use rcwm_models::bundle::Bundle;
use rcwm_models::episode::{Episode, EpisodeError};
use rcwm_models::interface::{Camera, Interface};
use rcwm_models::wire::{ActionValues, Format, ObservationFlags, OwnedObservation};
use rcwm_runtime::log::pack::ImagePacker;
use rcwm_runtime::log::{BundleIdentity, LogReader, LogSettings, Record};
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

/// A robot like Meta-World's arm with cameras of these rows and columns, and so many numbers of action from 0 to 200.
fn robot(cameras: &[[usize; 2]], numbers: usize) -> Interface {
    let mut robot = Interface { rate_hz: 5.0, ..Interface::metaworld() };
    let first = robot.camera.remove(0);
    robot.camera.extend(cameras.iter().enumerate().map(|(at, [rows, columns])| Camera {
        name: format!("camera_{at}"),
        shape: [*rows, *columns, 3],
        ..first.clone()
    }));
    let action = &mut robot.action[0];
    action.elements = (0..numbers).map(|at| format!("j{at}")).collect();
    (action.low, action.high) = (vec![0.0; numbers], vec![200.0; numbers]);
    robot
}

/// A log of an episode of three ticks of this robot.
fn log_of(robot: Interface, bundle: BundleIdentity, folder: &Path) -> LogReader {
    let (path, format) = (folder.join("crafted.rcwmlog"), Format::of(robot));
    let mut images: Vec<_> = format.interface().camera.iter().map(|_| ImagePacker::default()).collect();
    let mut records = vec![Record::Interface(format.interface().canonical())];
    for step in 0..3 {
        let mut observation = OwnedObservation::zeroed(&format);
        observation.flags = ObservationFlags::default()
            .with(ObservationFlags::FIRST, step == 0)
            .with(ObservationFlags::LAST, step == 2)
            .0;
        (observation.step, observation.sequence) = (step, u64::from(step));
        for camera in 0..images.len() {
            let columns = format.interface().camera[camera].shape[1];
            let mut edited = observation.edit();
            for (at, pixel) in edited.image(camera).as_chunks_mut::<3>().0.iter_mut().enumerate() {
                let (row, column) = (at / columns, at % columns);
                *pixel = [(255 * column / columns) as u8, (row + column) as u8, 80 * step as u8];
            }
        }
        // From the lower limit of the first number to the upper one of the last.
        let numbers = format.action_numbers();
        let action = ActionValues::from_fn(numbers, |at| 200.0 * at as f32 / (numbers - 1).max(1) as f32);
        records.push(Record::Tick(Box::new(crafted::tick(&mut images, &observation, action))));
    }
    crafted::write(&path, &crafted::payloads(&crafted::header(bundle), &records));
    LogReader::open(&path).unwrap()
}

/// That of a bundle for actions of so many numbers, which nobody has.
fn nobodys(numbers: usize) -> BundleIdentity {
    let mut identity = BundleIdentity::of(&Bundle::open(&smallest_bundle()).unwrap().manifest);
    (identity.action_limits.low, identity.action_limits.high) = (vec![0.0; numbers], vec![200.0; numbers]);
    identity
}

#[test]
fn robots_with_other_cameras_and_actions_are_filmed_and_are_episodes_where_they_can_be() {
    for (cameras, numbers, panel, is_episode) in [
        (&[[64, 64]][..], 17, 64, true),
        (&[[128, 128], [128, 128]], 64, 128, true),
        (&[[48, 64], [480, 640], [8, 8]], 7, 128, false),
        (&[[1, 1]], 1, 64, false),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let mut log = log_of(robot(cameras, numbers), nobodys(numbers), folder.path());
        let filmed = film(&mut log, None, folder.path(), 10, &mut |_| true).unwrap();
        assert_eq!(filmed.log_damage, None);
        assert_eq!((filmed.films.len(), filmed.episodes.len()), (1, usize::from(is_episode)));
        let said = filmed.broken_because.unwrap_or_default();
        assert_eq!(said.contains("an episode holds 1 to 4 cameras"), !is_episode, "{said}");
        // The cameras side by side, the action below; in the strip one below the other.
        let columns = cameras.len() as u32;
        let file = std::fs::File::open(&filmed.films[0]).unwrap();
        let mut film = gif::DecodeOptions::new().read_info(file).unwrap();
        let size =
            [3 + columns * (panel + 3), 10 + 2 * (panel + 10)].map(|side| side * 192_u32.div_ceil(panel));
        assert_eq!([film.width(), film.height()].map(u32::from), size);
        // At the robot's own rate.
        assert_eq!(film.read_next_frame().unwrap().unwrap().delay, 20);
        let strip = image::open(filmed.films[0].with_extension("png")).unwrap();
        let size = [3, columns].map(|panels| (panels * (panel + 1) - 1) * 128 / panel);
        assert_eq!([strip.width(), strip.height()], size);

        let mut log = LogReader::open(&folder.path().join("crafted.rcwmlog")).unwrap();
        match write_episodes(&mut log, &folder.path().join("data"), &mut |_| true) {
            Ok(written) => assert!(is_episode && Episode::read(&written.files[0]).unwrap().len() == 3),
            Err(error) => {
                let unfit = matches!(&error, ReplayError::Episode(EpisodeError::Robot { .. }));
                assert!(unfit && !is_episode, "{error}");
            }
        }
    }
}

#[test]
fn what_cannot_be_filmed_is_said_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = log_of(robot(&[], 4), nobodys(4), folder.path());
    let error = film(&mut log, None, folder.path(), 10, &mut |_| true).unwrap_err();
    assert!(matches!(&error, FilmError::NoCamera { .. }), "{error}");

    // A bundle that reads a camera of another name, or another size.
    let bundle = Bundle::open(&smallest_bundle()).unwrap();
    let with = |name: &str, side: usize| {
        let mut robot = bundle.manifest.interface.clone();
        (robot.camera[0].name, robot.camera[0].shape) = (name.into(), [side, side, 3]);
        robot
    };
    for (robot, found) in [(with("other", 64), "missing"), (with("image", 128), "128 x 128 x 3")] {
        let mut log = log_of(robot, BundleIdentity::of(&bundle.manifest), folder.path());
        let replayer = Replayer::new(log.header(), &[smallest_bundle()], None).unwrap();
        let error = film(&mut log, Some(replayer), folder.path(), 10, &mut |_| true).unwrap_err();
        let FilmError::Camera { found: other, expected, .. } = &error else { panic!("{error}") };
        assert_eq!((other.as_str(), expected.as_str()), (found, "64 x 64 x 3"));
        assert!(!error.to_string().contains('\n'));
    }
}
