//! The smallest controller: answers each observation with a random action.
//!
//! ```text
//! rcwm-simulator serve --task hammer --episodes 2 &
//! cargo run --release -p rcwm-simulator --example random_controller -- rcwm
//! ```

use std::time::{Duration, Instant};

use anyhow::Result;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::wire::{
    Action, ActionSource, ActionValues, ControllerLink, LinkSettings, ObservationFlags, Wait,
};

fn main() -> Result<()> {
    let instance = std::env::args().nth(1).unwrap_or_else(|| "rcwm".to_owned());
    let link = ControllerLink::open(LinkSettings::new(&instance), |_| Vec::new())?;
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let (mut answered, mut repeated, mut sequence_gaps) = (0_u64, 0_u64, 0_u64);
    let mut last = None;
    let mut start = Instant::now();
    loop {
        let observation = match link.wait_observation(Duration::from_secs(1))? {
            Wait::Message(observation) => observation,
            Wait::TimedOut => continue,
            Wait::Closed => break,
        };
        let again = observation.is(ObservationFlags::REPEATED);
        repeated += u64::from(again);
        if last.is_none() {
            start = Instant::now();
        }
        sequence_gaps += u64::from(!again && last.is_some_and(|last| observation.sequence != last + 1));
        last = Some(observation.sequence);
        link.send(&Action {
            answers: observation.sequence,
            published_ns: 0,
            source: ActionSource::Policy as u32,
            action: ActionValues::from_fn(4, |_| random.random_range(-1.0..=1.0)),
        })?;
        answered += 1;
    }
    let rate = answered as f64 / start.elapsed().as_secs_f64();
    println!(
        "{answered} answers, {repeated} to repeated observations, {sequence_gaps} gaps, {rate:.1} a second"
    );
    Ok(())
}
