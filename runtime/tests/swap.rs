//! Policies exchanged under a running controller, asked for as a deployer asks.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rcwm_models::bundle::PartName;
use rcwm_models::wire::{ActionSource, ActionValues, ObservationFlags, SimulatorLink};
use rcwm_runtime::controller::{Controller, ControllerSettings, RunReport, TickLimits};
use rcwm_runtime::policy::{Sampling, SurpriseLimits};
use rcwm_runtime::swap::{Answer, SwapError, SwapSettings, Swapper, When, ask, name_of_server};
use rcwm_runtime::{EngineKind, EngineSettings, Policy};
use rcwm_testkit::{
    OwnLink, dividing_by_zero, dreamer_bundle, own_link, smallest_bundle, too_small_for_16_bits,
    with_manifest, with_nan_weight,
};

const EPISODE: u64 = 20;

/// A controller that takes swaps; ends when the peer closes.
fn start(link: &OwnLink) -> JoinHandle<RunReport> {
    start_on(link, EngineSettings::tract())
}

fn start_on(link: &OwnLink, engine: EngineSettings) -> JoinHandle<RunReport> {
    start_with_limits(link, engine, TickLimits::default())
}

fn start_with_limits(link: &OwnLink, engine: EngineSettings, ticks: TickLimits) -> JoinHandle<RunReport> {
    start_surprised(link, engine, ticks, SurpriseLimits::default())
}

fn start_surprised(
    link: &OwnLink,
    engine: EngineSettings,
    ticks: TickLimits,
    surprise: SurpriseLimits,
) -> JoinHandle<RunReport> {
    let policy = Policy::load(&smallest_bundle(), engine).unwrap();
    let settings = SwapSettings {
        link: link.0.clone(),
        engine,
        sampling: Sampling::Mode,
        interface: policy.manifest().interface.clone(),
        surprise,
    };
    let swapper = Swapper::start(settings).unwrap();
    let change = |settings: &mut ControllerSettings| {
        (settings.ticks, settings.surprise) = (ticks, surprise);
    };
    rcwm_testkit::start_changed(policy, link, change, move |controller: &mut Controller| {
        controller.take_swaps(swapper);
        let ended = controller.run(&AtomicBool::new(false), &mut []).unwrap();
        controller.report(EngineKind::Tract, ended)
    })
}

/// Asks from a thread of its own, for a swap that must not keep the peer from going on.
fn ask_aside(link: &OwnLink, bundle: &Path, when: When) -> JoinHandle<Result<Answer, SwapError>> {
    let (link, bundle) = (link.0.clone(), bundle.to_path_buf());
    std::thread::spawn(move || ask(&link, &bundle, when, None, &AtomicBool::new(false), &mut |_| {}))
}

/// A peer that plays episode after episode.
struct Peer<'a> {
    link: &'a SimulatorLink,
    sequence: u64,
}

impl Peer<'_> {
    /// So many ticks, which are those of a policy of this bundle that starts from its initial state here.
    fn hears_as_from(&mut self, bundle: &Path, ticks: u64) {
        let mut policy = Policy::load(bundle, EngineSettings::tract()).unwrap();
        for tick in 0..ticks {
            let step = self.sequence;
            let executed = rcwm_testkit::observation(step, step as u32).view().executed_action();
            let image = rcwm_testkit::image(step as u32);
            let expected = policy.observe(&image, (tick > 0).then_some(&executed)).unwrap();
            assert_eq!(self.tick(), expected.action, "step {step}");
        }
    }

    fn step(&self) -> u32 {
        (self.sequence % EPISODE) as u32
    }

    /// One observation, and the action that answers it: the policy's own, whatever happens beside it.
    fn tick(&mut self) -> ActionValues {
        let mut observation = rcwm_testkit::observation(self.sequence, self.step());
        observation.episode = self.sequence / EPISODE;
        observation.flags |= if self.step() == 19 { ObservationFlags::LAST.0 } else { 0 };
        let answer = rcwm_testkit::ask(self.link, &observation);
        assert_eq!(answer.source, ActionSource::Policy as u32, "sequence {}", self.sequence);
        self.sequence += 1;
        answer.action
    }

    /// Goes on until the one who asks has an answer.
    fn tick_until<T>(&mut self, asked: JoinHandle<T>) -> T {
        while !asked.is_finished() {
            self.tick();
        }
        asked.join().unwrap()
    }
}

/// The smallest bundle with other limits, so that its actions tell it from the first; golden values know no limits.
fn other_bundle() -> tempfile::TempDir {
    with_manifest(|manifest| {
        rcwm_testkit::limit(manifest, [0.5; 4], [0.75; 4]);
    })
}

fn is_of_other(action: ActionValues) -> bool {
    action.iter().all(|x| (0.5..=0.75).contains(x))
}

#[test]
fn a_new_bundle_takes_over_at_an_episode_s_start_and_no_tick_is_lost() {
    let link = own_link();
    let peer = link.peer();
    let controller = start(&link);
    let other = other_bundle();
    let mut peer_ticks = Peer { link: &peer, sequence: 0 };
    assert!(!is_of_other(peer_ticks.tick()));
    let answer = peer_ticks.tick_until(ask_aside(&link, other.path(), When::Episode)).unwrap();
    assert!(matches!(answer, Answer::Taken { .. }), "{answer:?}");
    assert!(is_of_other(peer_ticks.tick()));
    peer.close().unwrap();
    let report = controller.join().unwrap();
    assert_eq!((report.counters.swaps, report.counters.fallback_answers), (1, 0));
    assert_eq!(report.counters.missed_observations, 0);
}

#[test]
fn a_bundle_taken_at_once_starts_from_its_initial_state_in_the_middle_of_an_episode() {
    let link = own_link();
    let peer = link.peer();
    let controller = start(&link);
    let mut peer_ticks = Peer { link: &peer, sequence: 0 };
    for _ in 0..5 {
        peer_ticks.tick();
    }
    // Nothing is asked of the controller meanwhile: it is in the middle of an episode, and takes over while it waits.
    let answer = ask_aside(&link, &smallest_bundle(), When::Now).join().unwrap().unwrap();
    assert!(matches!(answer, Answer::Taken { .. }), "{answer:?}");
    peer_ticks.hears_as_from(&smallest_bundle(), 5);
    peer.close().unwrap();
    assert_eq!(controller.join().unwrap().counters.swaps, 1);
}

#[test]
fn a_policy_of_another_kind_takes_over_and_gives_way_again() {
    let link = own_link();
    let peer = link.peer();
    let controller = start(&link);
    let mut peer_ticks = Peer { link: &peer, sequence: 0 };
    for _ in 0..3 {
        peer_ticks.tick();
    }
    for (bundle, ticks) in [(dreamer_bundle(), 5), (smallest_bundle(), 4)] {
        let answer = ask_aside(&link, &bundle, When::Now).join().unwrap().unwrap();
        assert!(matches!(answer, Answer::Taken { .. }), "{answer:?}");
        peer_ticks.hears_as_from(&bundle, ticks);
    }
    peer.close().unwrap();
    let report = controller.join().unwrap();
    assert_eq!(report.counters.swaps, 2);
    // Each kind's surprises are told apart.
    let surprise = report.surprise.unwrap();
    assert!(surprise.robot.is_some() && surprise.environment.is_some() && surprise.dynamics.is_some());
}

#[test]
fn a_kind_without_the_surprise_that_the_run_limits_is_refused() {
    let link = own_link();
    let peer = link.peer();
    let surprise = SurpriseLimits { robot_max: Some(1e6), ..SurpriseLimits::default() };
    let controller = start_surprised(&link, EngineSettings::tract(), TickLimits::default(), surprise);
    let mut peer_ticks = Peer { link: &peer, sequence: 0 };
    let refused = peer_ticks.tick_until(ask_aside(&link, &dreamer_bundle(), When::Now)).unwrap();
    let Answer::Refused { reason } = refused else { panic!("{refused:?}") };
    assert!(reason.contains("--surprise-robot-max"), "{reason}");
    peer.close().unwrap();
    assert_eq!(controller.join().unwrap().counters.swaps, 0);
}

#[test]
fn a_policy_that_has_seen_nothing_yet_is_stood_in_for_by_as_many_fallbacks_as_allowed() {
    let link = own_link();
    let peer = link.peer();
    let ticks = TickLimits { imagined_ticks_max: 2, fallback_ticks_max: 3 };
    let controller = start_with_limits(&link, EngineSettings::tract(), ticks);
    rcwm_testkit::ask(&peer, &rcwm_testkit::observation(0, 0));
    let answer = ask_aside(&link, &smallest_bundle(), When::Now).join().unwrap().unwrap();
    assert!(matches!(answer, Answer::Taken { .. }), "{answer:?}");
    // The same again, from which on the next ones are due, and do not come.
    rcwm_testkit::ask(&peer, &rcwm_testkit::due_now(0));
    std::thread::sleep(Duration::from_nanos(10 * rcwm_testkit::PERIOD_NS));
    peer.close().unwrap();
    let counters = controller.join().unwrap().counters;
    assert_eq!((counters.imagined_answers, counters.fallback_answers), (0, 3), "{counters:?}");
    assert_eq!(counters.peers_lost, 1, "{counters:?}");
}

#[test]
fn a_bad_bundle_is_refused_with_one_line_and_the_old_one_runs_on() {
    let link = own_link();
    let peer = link.peer();
    let controller = start(&link);
    let mut peer_ticks = Peer { link: &peer, sequence: 0 };
    let slow = with_manifest(|manifest| manifest.interface.rate_hz = 20.0);
    let damaged = with_manifest(|manifest| manifest.parts[1].sha256.replace_range(..1, "x"));
    let sizes = with_manifest(|manifest| manifest.model.as_mut().unwrap().deter *= 2);
    let action = with_manifest(|manifest| manifest.model.as_mut().unwrap().action = 7);
    let golden = rcwm_testkit::with_golden(|mean| mean + 0.01);
    let missing = tempfile::tempdir().unwrap();
    for (bundle, word) in [
        (with_nan_weight(PartName::Robot), "NaN"),
        (dividing_by_zero(PartName::Actor), "not finite"),
        (slow, "20 Hz"),
        (damaged, "sha256"),
        (sizes, "expected"),
        (action, "action = 7"),
        (golden, "golden"),
        (missing, "manifest.toml"),
    ] {
        let answer = peer_ticks.tick_until(ask_aside(&link, bundle.path(), When::Now)).unwrap();
        let Answer::Refused { reason } = answer else { panic!("{word}: {answer:?}") };
        assert!(reason.contains(word) && !reason.contains('\n'), "{word}: {reason}");
    }
    peer_ticks.tick();
    peer.close().unwrap();
    let counters = controller.join().unwrap().counters;
    assert_eq!((counters.swaps, counters.fallback_answers), (0, 0));
}

#[test]
fn a_bundle_is_verified_in_the_form_that_will_run() {
    // Right in 32 bits, and zeros in 16.
    let bundle = too_small_for_16_bits(PartName::Actor);
    for (half_weights, accepted) in [(false, true), (true, false)] {
        let link = own_link();
        let peer = link.peer();
        let controller = start_on(&link, EngineSettings::tract().with_half_weights(half_weights));
        let mut peer_ticks = Peer { link: &peer, sequence: 0 };
        peer_ticks.tick();
        let sound = peer_ticks.tick_until(ask_aside(&link, &smallest_bundle(), When::Now)).unwrap();
        assert!(matches!(sound, Answer::Taken { .. }), "16-bit weights {half_weights}: {sound:?}");
        let answer = peer_ticks.tick_until(ask_aside(&link, bundle.path(), When::Now)).unwrap();
        match answer {
            Answer::Taken { .. } if accepted => {}
            Answer::Refused { reason } if !accepted => assert!(reason.contains("16-bit weights"), "{reason}"),
            other => panic!("16-bit weights {half_weights}: {other:?}"),
        }
        peer.close().unwrap();
        controller.join().unwrap();
    }
}

/// Makes the calling thread, and no other, one of this user.
fn become_user(user: u32) {
    // SAFETY: plain numbers; unlike the C library's function of this name the call is about one thread.
    assert_eq!(unsafe { libc::syscall(libc::SYS_setresuid, user, user, user) }, 0);
}

#[test]
fn nobody_asks_a_server_of_a_stranger() {
    use std::os::linux::net::SocketAddrExt;
    use std::os::unix::net::{SocketAddr, UnixListener};
    if !rustix::process::geteuid().is_root() {
        eprintln!("left out: only root can act as two other users");
        return;
    }
    let link = own_link();
    let name = name_of_server(&link.0);
    let stranger = std::thread::spawn(move || {
        become_user(65_533);
        UnixListener::bind_addr(&SocketAddr::from_abstract_name(name).unwrap()).unwrap()
    });
    let listener = stranger.join().unwrap();
    let settings = link.0.clone();
    let asks = std::thread::spawn(move || {
        become_user(65_534);
        ask(&settings, Path::new("secret"), When::Now, None, &AtomicBool::new(false), &mut |_| {})
    });
    let error = asks.join().unwrap().unwrap_err();
    assert!(matches!(error, SwapError::Stranger { user: 65_533, .. }), "{error:?}");
    // Nothing was said.
    listener.set_nonblocking(true).unwrap();
    let (mut stream, _) = listener.accept().unwrap();
    assert_eq!(std::io::Read::read(&mut stream, &mut [0; 64]).unwrap(), 0);
}

#[test]
fn a_bundle_is_withdrawn_when_the_one_who_asked_leaves() {
    let link = own_link();
    let peer = link.peer();
    let controller = start(&link);
    let mut peer_ticks = Peer { link: &peer, sequence: 0 };
    peer_ticks.tick();
    let stop = AtomicBool::new(false);
    // The episode does not end: nobody ticks.
    let answer = ask(&link.0, other_bundle().path(), When::Episode, None, &stop, &mut |answer| {
        stop.store(matches!(answer, Answer::Ready { .. }), Ordering::Relaxed);
    });
    assert_eq!(answer.unwrap(), Answer::Withdrawn);
    (0..2 * EPISODE).for_each(|_| assert!(!is_of_other(peer_ticks.tick())));
    peer.close().unwrap();
    assert_eq!(controller.join().unwrap().counters.swaps, 0);
}

#[test]
fn nobody_at_the_server_is_one_line_that_says_what_to_do() {
    let link = own_link();
    let stop = AtomicBool::new(false);
    let error = ask(&link.0, &smallest_bundle(), When::Now, None, &stop, &mut |_| {}).unwrap_err();
    let line = error.to_string();
    assert!(line.contains("rcwm-runtime run --bundle DIR --instance test") && !line.contains('\n'), "{line}");
}

#[test]
fn a_request_that_is_not_understood_is_refused_and_the_next_is_served() {
    use std::io::{Read, Write};
    use std::os::linux::net::SocketAddrExt;
    use std::os::unix::net::{SocketAddr, UnixStream};
    let link = own_link();
    let peer = link.peer();
    let controller = start(&link);
    let name = name_of_server(&link.0);
    for words in
        [&b"please\n"[..], b"{\"version\":9,\"bundle\":\"x\",\"when\":\"now\"}\n", &[0xff; 100_000], b""]
    {
        let address = SocketAddr::from_abstract_name(&name).unwrap();
        let mut stream = UnixStream::connect_addr(&address).unwrap();
        // The server may hang up before it has heard all of it.
        let _ = stream.write_all(words).and_then(|()| stream.shutdown(std::net::Shutdown::Write));
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        let answer = String::from_utf8(answer).unwrap();
        assert!(answer.is_empty() || answer.contains("refused"), "{answer}");
    }
    let answer = ask_aside(&link, &smallest_bundle(), When::Now);
    let mut peer_ticks = Peer { link: &peer, sequence: 0 };
    assert!(matches!(peer_ticks.tick_until(answer).unwrap(), Answer::Taken { .. }));
    peer.close().unwrap();
    controller.join().unwrap();
}
