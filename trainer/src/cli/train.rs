use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use rcwm_trainer::training::{Phase, TrainingSettings};

use super::online::Online;

/// Learn a task by acting and learning, from scratch
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer train --task button-press --preset small --out runs/scratch --simulators 2 --masks
  rcwm-trainer train --task hammer --preset paper --model vanilla --out runs/baseline --set \\
      finetune.steps=250000
  rcwm-trainer train --out runs/scratch --resume

The replay begins with successful episodes of the scripted expert and random steps, as that of
finetune does; set finetune.expert_episodes=0 to start without an expert. A step is one decision
of the policy, two steps of the environment.")]
pub struct Train {
    /// Sizes to start from
    #[arg(long, value_enum, default_value = "small", conflicts_with = "resume")]
    preset: super::PresetName,
    /// Which world model
    #[arg(long, value_enum, default_value = "rcwm", conflicts_with = "resume")]
    model: super::ModelName,
    #[command(flatten)]
    online: Online,
}

impl Train {
    pub fn run(self) -> Result<ExitCode> {
        self.online.run(None, || {
            let mut settings =
                TrainingSettings::preset(self.preset.preset(), self.model.kind(), PathBuf::new());
            settings.phase = Phase::Train;
            Ok(settings)
        })
    }
}
