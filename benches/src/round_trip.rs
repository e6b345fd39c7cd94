//! The link's own cost: one observation over and one action back between two processes, nothing computed in between.
//!
//!     cargo run --release -p rcwm-benches --bin round-trip [ROUNDS] [FILE.json]
//!
//! The program starts itself again as the controller. Two ways of waiting are interleaved in blocks within one run: polling (what a
//! wait does for its spin time) and blocking on the event service. The baseline is the kernel's own wake-up: a byte over a
//! pair of pipes between the same processes.

use std::io::{Read, Write};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use rcwm_models::wire::{
    Action, ActionValues, ControllerLink, Format, LinkSettings, SimulatorLink, Wait, forget_prefix,
};

const BLOCKS: u64 = 20;
const PATIENCE: Duration = Duration::from_secs(10);
/// Longer than any round trip: the wait never blocks.
const SPIN: Duration = Duration::from_secs(1);

type Failure = Box<dyn std::error::Error>;

fn settings(prefix: &str, instance: &str, spin: Duration) -> LinkSettings {
    LinkSettings { instance: instance.to_owned(), prefix: Some(prefix.to_owned()), spin }
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().collect();
    if let [_, word, prefix, rounds] = arguments.as_slice()
        && word == "controller"
    {
        return answer(prefix, rounds.parse()?);
    }
    let rounds: u64 = arguments.get(1).map_or(Ok(20_000), |text| text.parse())?;
    measure(rounds.div_ceil(BLOCKS), arguments.get(2).map(String::as_str))
}

/// The controller's process: answers whatever comes, in the order in which `measure` asks.
fn answer(prefix: &str, rounds_per_block: u64) -> Result<(), Failure> {
    let polling = ControllerLink::open(settings(prefix, "polling", SPIN), |_| Vec::new())?;
    let blocking = ControllerLink::open(settings(prefix, "blocking", Duration::ZERO), |_| Vec::new())?;
    for link in [&polling, &blocking] {
        link.wait_robot(PATIENCE)?.ok_or("no robot came")?;
    }
    let (mut input, mut output) = (std::io::stdin(), std::io::stdout());
    output.write_all(b"!")?;
    output.flush()?;
    for _ in 0..BLOCKS {
        for link in [&polling, &blocking] {
            for _ in 0..rounds_per_block {
                let Wait::Message(observation) = link.wait_observation(PATIENCE)? else {
                    return Err("no observation came".into());
                };
                let (answers, action) = (observation.sequence, ActionValues::zeros(4));
                link.send(&Action { answers, published_ns: 0, source: 0, action })?;
            }
        }
        let mut byte = [0];
        for _ in 0..rounds_per_block {
            input.read_exact(&mut byte)?;
            output.write_all(&byte)?;
            output.flush()?;
        }
    }
    Ok(())
}

fn measure(rounds_per_block: u64, json: Option<&str>) -> Result<(), Failure> {
    let prefix = format!("rcwm_bench{}_", std::process::id());
    let format = Format::metaworld();
    let polling = SimulatorLink::open(settings(&prefix, "polling", SPIN), &format)?;
    let blocking = SimulatorLink::open(settings(&prefix, "blocking", Duration::ZERO), &format)?;
    let mut child = Command::new(std::env::current_exe()?)
        .args(["controller", &prefix, &rounds_per_block.to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    let mut to_child = child.stdin.take().ok_or("the child has an input")?;
    let mut from_child = child.stdout.take().ok_or("the child has an output")?;
    let mut byte = [0];
    // It asks for the interface.
    for link in [&polling, &blocking] {
        while !link.poll_events()?.hello {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    from_child.read_exact(&mut byte)?;
    // The controller has announced itself; a wait would end early to say so.
    polling.poll_events()?;
    blocking.poll_events()?;

    let mut times = [histogram()?, histogram()?, histogram()?];
    for block in 0..BLOCKS {
        for (link, times) in [&polling, &blocking].into_iter().zip(&mut times) {
            for round in 0..rounds_per_block {
                let start = Instant::now();
                link.publish(|observation| observation.sequence = block * rounds_per_block + round)?;
                let (Wait::Message(_), _) = link.wait_action(PATIENCE)? else {
                    return Err("no action came".into());
                };
                times.saturating_record(start.elapsed().as_nanos() as u64);
            }
        }
        for _ in 0..rounds_per_block {
            let start = Instant::now();
            to_child.write_all(&byte)?;
            from_child.read_exact(&mut byte)?;
            times[2].saturating_record(start.elapsed().as_nanos() as u64);
        }
    }
    child.wait()?;
    drop((polling, blocking));
    forget_prefix(&prefix);
    report(&times, json)
}

fn histogram() -> Result<Histogram<u64>, Failure> {
    Ok(Histogram::new_with_max(10_000_000_000, 3)?)
}

fn report(times: &[Histogram<u64>; 3], json: Option<&str>) -> Result<(), Failure> {
    let names = ["link, polling", "link, blocking", "pipe pair (baseline)"];
    rcwm_models::outln!(
        "{:<22} {:>9} {:>9} {:>9} {:>9}  p50 ratio",
        "round trip, us",
        "p50",
        "p99",
        "p99.9",
        "max"
    );
    let baseline_ns = times[2].value_at_quantile(0.5) as f64;
    let mut rows = Vec::new();
    for (name, times) in names.iter().zip(times) {
        let us = |quantile: f64| times.value_at_quantile(quantile) as f64 / 1e3;
        let (p50_us, p99_us, p999_us, max_us) = (us(0.5), us(0.99), us(0.999), times.max() as f64 / 1e3);
        let ratio = times.value_at_quantile(0.5) as f64 / baseline_ns;
        rcwm_models::outln!(
            "{name:<22} {p50_us:>9.2} {p99_us:>9.2} {p999_us:>9.2} {max_us:>9.2}  {ratio:.3}"
        );
        rows.push(serde_json::json!({
            "name": name, "rounds": times.len(), "p50_us": p50_us, "p99_us": p99_us, "p999_us": p999_us,
            "max_us": max_us, "ratio_p50_vs_pipe": ratio,
        }));
    }
    if let Some(path) = json {
        let text = serde_json::to_string_pretty(&rows)?;
        rcwm_models::files::write_atomic(path.as_ref(), text.as_bytes())?;
    }
    Ok(())
}
