//! The recording thread.

use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;

use rcwm_models::episode::EpisodeBuilder;
use rcwm_models::wire::{Observation, ObservationFlags};

use super::canvas::Canvas;
use super::panels::{Decoded, Shown, film_frame, strip_panels};
use super::{Frame, RecordError, Recorded, film};
use crate::engine::{Input, Output, Part};
use crate::policy::State;

/// Longest film, in ticks; longer episodes are filmed to here and kept whole as `.npz`.
const FILM_TICKS_MAX: usize = 1000;

/// Niceness of the recording thread: Linux keeps one per thread.
const NICENESS: i32 = 10;

pub(super) struct Worker {
    folder: PathBuf,
    decoder: Option<Box<dyn Part>>,
    decoded: Decoded,
    /// Films play at the rate of the policy unless the simulator says its own.
    rate_hz: f64,
    recorded: Recorded,
    /// Number of the next episode.
    number: u64,
    episode: Option<Running>,
}

/// The episode being recorded.
struct Running {
    film: Vec<Canvas>,
    panels: Vec<Vec<Canvas>>,
    builder: EpisodeBuilder,
    last_step: Option<u32>,
    broken: bool,
}

impl Worker {
    pub(super) fn new(folder: &Path, decoder: Option<Box<dyn Part>>, rate_hz: f64) -> Self {
        Self {
            folder: folder.to_path_buf(),
            number: next_number(folder),
            decoder,
            decoded: Decoded::new(),
            rate_hz,
            recorded: Recorded::default(),
            episode: None,
        }
    }

    pub(super) fn run(mut self, frames: &Receiver<Box<Frame>>) -> Result<Recorded, RecordError> {
        // Drawing must not take the processor from the loop; where that is not granted, it is drawn as fast as may be.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
        while let Ok(frame) = frames.recv() {
            if frame.is_first {
                self.finish()?;
            }
            self.take(&frame)?;
            if frame.observation.is(ObservationFlags::LAST) {
                self.finish()?;
            }
        }
        self.finish()?;
        Ok(self.recorded)
    }

    fn take(&mut self, frame: &Frame) -> Result<(), RecordError> {
        self.decode(&frame.state)?;
        let observation = &frame.observation;
        if observation.period_ns > 0 {
            self.rate_hz = 1e9 / observation.period_ns as f64;
        }
        let running = self.episode.get_or_insert_with(Running::new);
        let shown = Shown {
            image: &observation.image,
            decoded: self.decoder.is_some().then_some(&self.decoded),
            action: frame.answer.action,
            source: frame.answer.source,
            step: observation.step,
            return_sum: frame.return_sum,
            success: frame.success,
        };
        if running.film.len() < FILM_TICKS_MAX {
            running.film.push(film_frame(&shown));
            running.panels.push(strip_panels(&shown));
        }
        running.add(observation);
        Ok(())
    }

    fn decode(&mut self, state: &State) -> Result<(), RecordError> {
        let Some(decoder) = &mut self.decoder else { return Ok(()) };
        let inputs = [
            Input::I64(&state.robot.z),
            Input::F32(&state.robot.h),
            Input::I64(&state.environment.z),
            Input::F32(&state.environment.h),
        ];
        let Decoded { image, robot_image, robot_mask, environment_image, environment_mask } =
            &mut self.decoded;
        let outputs = [image, robot_image, robot_mask, environment_image, environment_mask];
        Ok(decoder.run(&inputs, &mut outputs.map(|values| Output::F32(values)))?)
    }

    fn finish(&mut self) -> Result<(), RecordError> {
        let Some(mut running) = self.episode.take() else { return Ok(()) };
        // Numbered in the order of recording: a simulator that was started again counts from 0 again.
        let number = self.number;
        self.number += 1;
        let path = |ending: &str| self.folder.join(format!("episode-{number:04}.{ending}"));
        // The data before the pictures: on a full disk it is what must not be lost.
        match running.builder.finish() {
            Some(episode) if !running.broken => {
                episode.write(&path("npz"))?;
                self.recorded.episodes.push(path("npz"));
            }
            _ => self.recorded.broken_episodes += 1,
        }
        film::write_film(&path("gif"), &running.film, self.rate_hz)?;
        let columns: Vec<_> = film::strip_choice(running.panels.len())
            .into_iter()
            .map(|index| running.panels[index].as_slice())
            .collect();
        film::write_strip(&path("png"), &columns)?;
        self.recorded.films.push(path("gif"));
        Ok(())
    }
}

/// Behind all episodes that the folder holds, whatever there is of each.
fn next_number(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let number = |name: &str| name.strip_prefix("episode-")?.split('.').next()?.parse::<u64>().ok();
    entries.filter_map(|entry| number(&entry.file_name().to_string_lossy())).max().map_or(0, |last| last + 1)
}

impl Running {
    fn new() -> Self {
        Self {
            film: Vec::new(),
            panels: Vec::new(),
            builder: EpisodeBuilder::new(),
            last_step: None,
            broken: false,
        }
    }

    fn add(&mut self, observation: &Observation) {
        // A transition over a gap would teach the trainer a dynamics that does not exist.
        self.broken |= self.last_step.is_some_and(|last| last.wrapping_add(1) != observation.step);
        self.last_step = Some(observation.step);
        if !self.broken {
            self.broken = self.builder.push(observation).is_err();
        }
    }
}
