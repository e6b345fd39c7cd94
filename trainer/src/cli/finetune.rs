use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use rcwm_trainer::checkpoint::Checkpoint;
use rcwm_trainer::training::{Phase, Reset};

use super::bars::{self, absolute};
use super::online::Online;

/// The rates of the two sides with --separate-rates.
const ENVIRONMENT_RATE: f64 = 1e-4;
const ROBOT_RATE: f64 = 5e-5;

/// Learn a task by acting and learning, from a pre-trained model
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  rcwm-trainer finetune --from runs/small/checkpoints/last --task hammer --out runs/hammer \\
      --simulators 2
  rcwm-trainer finetune --from runs/small/checkpoints/last --task hammer --out runs/hammer \\
      --data data/hammer --reset heads --separate-rates --set finetune.train_ratio=128
  rcwm-trainer finetune --from runs/few-shot/checkpoints/last --task hammer --out runs/hammer \\
      --reset none --keep-behaviour
  rcwm-trainer finetune --from runs/small/checkpoints/last --task reach --out runs/reach \\
      --join arm1 --join arm2
  rcwm-trainer finetune --out runs/hammer --resume

The replay begins with successful episodes of the scripted expert and random steps, recorded on
the spot into OUT/episodes or taken from --data. A step is one decision of the policy, two steps
of the environment. Ctrl-C saves; --resume brings back weights, optimisers, counters and the
replay, and the simulators begin new episodes.")]
pub struct Finetune {
    /// Checkpoint of the model to start from
    #[arg(long, value_name = "CHECKPOINT", required_unless_present = "resume", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Amounts to start from [default: those of the checkpoint's preset, else small]
    #[arg(long, value_enum, conflicts_with = "resume")]
    preset: Option<super::PresetName>,
    /// What of the model is drawn anew; the vanilla baseline keeps everything
    #[arg(long, value_enum, default_value = "all-but-robot", conflicts_with = "resume")]
    reset: Reset,
    /// Keep actor and critic: for a model that has learned to act
    #[arg(long, conflicts_with = "resume")]
    keep_behaviour: bool,
    /// Learn the environment's side at 1e-4 and the robot's at 5e-5
    #[arg(long, conflicts_with = "resume")]
    separate_rates: bool,
    #[command(flatten)]
    online: Online,
}

impl Finetune {
    pub fn run(self) -> Result<ExitCode> {
        let source = self.online.source(self.from.as_deref())?;
        self.online.run(source.as_ref(), || {
            let source = source.as_ref().ok_or_else(|| anyhow::anyhow!("--from is missing"))?;
            let mut settings = bars::settings_from(source, Phase::Finetune, self.preset);
            let from = Checkpoint::locate(self.from.as_deref().unwrap_or(&self.online.out))?;
            settings.from = absolute(&from)?;
            settings.reset.parts = self.reset;
            settings.reset.keep_behaviour = self.keep_behaviour;
            if self.separate_rates {
                settings.world.adam.learning_rate = ROBOT_RATE;
                settings.world.environment_learning_rate = ENVIRONMENT_RATE;
            }
            Ok(settings)
        })
    }
}
