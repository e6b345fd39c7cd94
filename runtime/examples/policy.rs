//! A policy inside a program of your own, without shared memory.
//!
//! ```text
//! cargo run --release -p rcwm-runtime --example policy -- models/bundles/untrained
//! ```
//!
//! Replace `Table` by your robot: an upright 64 x 64 RGB picture, and four numbers in [-1, 1].

mod table;

use rcwm_runtime::policy::Surprise;
use rcwm_runtime::{EngineSettings, Policy};
use table::Table;

fn main() -> anyhow::Result<()> {
    let folder = std::env::args().nth(1).unwrap_or_else(|| "models/bundles/untrained".into());
    let mut policy = Policy::load(folder.as_ref(), EngineSettings::tract())?;
    let mut robot = Table::new(0);
    let mut image = vec![0; policy.image_bytes()];
    let mut executed = None; // nothing yet: an episode starts
    for step in 0..50 {
        robot.draw(&mut image);
        let decision = policy.observe(&image, executed.as_ref())?;
        // What was really executed, which may be another action than was asked for.
        executed = Some(robot.step(decision.action));
        // Idle time until the next picture: what needs only the action is computed now.
        policy.work_ahead(executed.as_ref())?;
        if let Some(Surprise::Rcwm { robot, environment }) = decision.surprise {
            let [x, y, z, gripper] = *decision.action else {
                anyhow::bail!("a bundle of four numbers is needed")
            };
            println!(
                "step {step:>2}: action {x:>6.3} {y:>6.3} {z:>6.3} {gripper:>6.3}  surprise of the robot {:>6.2} nats, of its \
                 environment {:>6.2}",
                robot, environment
            );
        }
    }
    println!("reward at the end: {:.3}", robot.reward());
    Ok(())
}
