use std::sync::atomic::AtomicBool;

use candle_core::Device;
use serde::{Deserialize, Serialize};

use super::{Draft, Measurement, ReportError, shown_words};
use crate::checkpoint::{Checkpoint, CheckpointSettings};
use crate::evaluation::{
    Attention, AttentionFilm, BRIGHTEST_TIMES_EVEN, Latents, OpenLoopSettings, Recordings, TaskReport,
    TaskTrajectories, measure,
};
use crate::model::agent::Agent;

/// What data are called in which nothing was disturbed.
pub const UNDISTURBED: &str = "none";
/// Steps from one picture of a strip to the next.
const STRIP_EVERY: usize = 8;
/// Steps imagined beside the attention (paper, Fig. 5).
const ATTENTION_STEPS: usize = 64;

/// A model that is measured.
#[derive(Debug)]
pub struct Subject {
    pub name: String,
    pub settings: CheckpointSettings,
    agent: Agent,
}

/// What a model was measured on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DynamicsSource {
    /// The model's name.
    pub model: String,
    pub weights_sha256: String,
    pub task: String,
    /// How the data were disturbed.
    pub disturb: String,
    /// Of the task's episodes.
    pub data_sha256: String,
    /// How trajectories were chosen and imagined.
    pub settings: OpenLoopSettings,
}

/// A model on a task's trajectories.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Dynamics {
    /// The model's settings.
    pub checkpoint: CheckpointSettings,
    /// Means, intervals and errors of every step.
    pub report: TaskReport,
    /// Which episode each trajectory is of.
    pub episode_of: Vec<usize>,
    /// Mean robot dynamics error of each trajectory.
    pub robot_errors: Vec<Option<f64>>,
    /// Which of the part's pictures show two action sequences from one start.
    #[serde(default)]
    pub response_pictures: Vec<usize>,
}

/// What the attention of a model was drawn from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AttentionSource {
    /// The model's name.
    pub model: String,
    pub weights_sha256: String,
    pub task: String,
    /// Of the task's episodes.
    pub data_sha256: String,
    /// Steps that are seen.
    pub context: usize,
    /// How latents are chosen.
    pub latents: Latents,
    /// Which episode, and the draws.
    pub seed: u64,
    /// How many times the even weight the brightest colour stands for; 0 in parts whose colours went from the film's least weight to its
    /// largest.
    #[serde(default)]
    pub brightest_times_even: f32,
}

/// The attention of a model on one trajectory; none for a model without interaction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AttentionPart {
    /// Steps that were seen before.
    pub context: usize,
    /// In numbers.
    pub attention: Attention,
}

impl Measurement for Dynamics {
    const KIND: &'static str = "dynamics";
    type Source = DynamicsSource;

    fn names(source: &DynamicsSource) -> Vec<&str> {
        vec![&source.task, &source.disturb, &source.model]
    }
}

impl Measurement for AttentionPart {
    const KIND: &'static str = "attention";
    type Source = AttentionSource;

    fn names(source: &AttentionSource) -> Vec<&str> {
        vec![&source.task, &source.model]
    }
}

impl Subject {
    /// A checkpoint's model.
    ///
    /// # Errors
    /// [`ReportError::Checkpoint`].
    pub fn new(name: &str, checkpoint: &Checkpoint) -> Result<Self, ReportError> {
        let data = shown_words(&checkpoint.settings.data);
        let settings = CheckpointSettings { data, ..checkpoint.settings.clone() };
        let agent = Agent::new(&checkpoint.parameters.frozen(), &settings.model)
            .map_err(crate::checkpoint::CheckpointError::from)?;
        Ok(Self { name: name.to_owned(), settings, agent })
    }

    /// What its part on these data would be measured from.
    #[must_use]
    pub fn source(
        &self,
        task: &str,
        disturb: &str,
        data_sha256: &str,
        settings: &OpenLoopSettings,
    ) -> DynamicsSource {
        DynamicsSource {
            model: self.name.clone(),
            weights_sha256: self.settings.weights_sha256.clone(),
            task: task.to_owned(),
            disturb: disturb.to_owned(),
            data_sha256: data_sha256.to_owned(),
            settings: *settings,
        }
    }

    /// What its attention on these data would be drawn from.
    #[must_use]
    pub fn attention_source(
        &self,
        task: &str,
        data_sha256: &str,
        settings: &OpenLoopSettings,
    ) -> AttentionSource {
        AttentionSource {
            model: self.name.clone(),
            weights_sha256: self.settings.weights_sha256.clone(),
            task: task.to_owned(),
            data_sha256: data_sha256.to_owned(),
            context: settings.context,
            latents: settings.latents,
            seed: settings.seed,
            brightest_times_even: BRIGHTEST_TIMES_EVEN,
        }
    }

    /// Measures it on a task's trajectories, and draws strips of the first ones; `seen` hears of every trajectory.
    pub fn measure(
        &self,
        task: &TaskTrajectories,
        settings: &OpenLoopSettings,
        device: &Device,
        draft: &mut Draft,
        stop: &AtomicBool,
        seen: impl FnMut(usize),
    ) -> Result<Dynamics, ReportError> {
        let measured = measure(&self.agent, task, settings, device, stop, seen)?;
        for (number, film) in measured.films.iter().enumerate() {
            film.write_strip(STRIP_EVERY, &draft.picture(&format!("strip-{number}.png")))?;
        }
        let mut response_pictures = Vec::new();
        for (number, film) in measured.response_films.iter().enumerate() {
            response_pictures.push(draft.pictures());
            film.write_strip(STRIP_EVERY, &draft.picture(&format!("response-{number}.png")))?;
        }
        Ok(Dynamics {
            checkpoint: self.settings.clone(),
            report: TaskReport::of(task, &measured, settings),
            episode_of: task.numbers(),
            robot_errors: measured.robot_errors(),
            response_pictures,
        })
    }

    /// Whether there is attention to look at.
    #[must_use]
    pub fn has_attention(&self) -> bool {
        matches!(self.agent.world, crate::model::world::World::Rcwm(_))
    }

    /// Imagines an episode of the task from its beginning and draws the attention; none if there is no such episode, or no interaction.
    pub fn attend(
        &self,
        recordings: &Recordings,
        source: &AttentionSource,
        device: &Device,
        draft: &mut Draft,
    ) -> Result<Option<AttentionPart>, ReportError> {
        let length = source.context + ATTENTION_STEPS;
        let Some(task) = TaskTrajectories::whole(recordings, &source.task, length, source.seed) else {
            return Ok(None);
        };
        let context = source.context.min(task.length - 1);
        let film = AttentionFilm::of(&self.agent, &task, context, source.latents, source.seed, device)?;
        let Some(film) = film else { return Ok(None) };
        film.write_strip(STRIP_EVERY, &draft.picture("strip.png"))?;
        Ok(Some(AttentionPart { context, attention: film.summary() }))
    }
}
