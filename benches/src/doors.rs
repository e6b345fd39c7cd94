//! The same ticks through every door to a policy: Rust, C, and programs of other languages. Actions bit for bit, and what a door costs.
//!
//!     cargo run --release -p rcwm-benches --bin doors [-- --bundle DIR] [--door NAME=COMMAND]
//!
//! Rust and C take turns within one process, tick by tick, each with a policy of its own: the difference of the same tick is what the
//! border costs. Then each program has the same inputs in a process of its own: the one in C that lies beside (`doors.c`, compiled here),
//! and those named by `--door`.
//!
//! A program is given BUNDLE INPUTS OUT. INPUTS holds, a tick after the other, the bundle's pictures and then its states (f32), each in
//! the order of `policy.inputs`. It feeds back what it decided, one episode long, with one thread, and works ahead after each tick. OUT
//! gets all actions as little-endian f32, then the time of each `observe` as little-endian u64 in ns.

use std::ffi::CString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use anyhow::{Context, bail, ensure};
use clap::Parser;
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::bundle::{Bundle, Manifest};
use rcwm_models::outln;
use rcwm_models::wire::ActionValues;
use rcwm_runtime::policy::InputReader;
use rcwm_runtime::{EngineKind, EngineSettings, Policy};
use serde_json::{Value, json};

/// The same ticks through Rust, C and other programs
#[derive(Debug, Parser)]
struct Arguments {
    #[arg(long, default_value = "models/bundles/untrained")]
    bundle: PathBuf,
    #[arg(long, default_value_t = 2000, value_parser = clap::value_parser!(u32).range(2..))]
    ticks: u32,
    /// Of the random pictures
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// One more program, for example python='python3 doors.py'; is given BUNDLE INPUTS OUT
    #[arg(long, value_name = "NAME=COMMAND")]
    door: Vec<String>,
    /// Writes the table to this file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// What one door has decided, and how long each `observe` took.
#[derive(Default)]
struct Through {
    actions: Vec<ActionValues>,
    times_ns: Vec<u64>,
}

impl Through {
    fn note(&mut self, action: ActionValues, start: Instant) {
        self.times_ns.push(start.elapsed().as_nanos() as u64);
        self.actions.push(action);
    }
}

/// The pictures and states of all ticks, in one piece.
struct Ticks {
    bytes: Vec<u8>,
    pictures: Vec<usize>,
    states: Vec<usize>,
}

impl Ticks {
    fn new(manifest: &Manifest, ticks: u32, seed: u64) -> Self {
        let pictures: Vec<usize> = manifest.cameras().map(|camera| camera.shape.iter().product()).collect();
        let is_camera = |name: &&String| manifest.cameras().any(|camera| camera.name == **name);
        let states = manifest.policy.inputs.iter().filter(|name| !is_camera(name));
        let states: Vec<usize> =
            states.filter_map(|name| manifest.interface.state_range(name)).map(|range| range.len()).collect();
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut bytes = Vec::new();
        for _ in 0..ticks {
            let from = bytes.len();
            bytes.resize(from + pictures.iter().sum::<usize>(), 0);
            random.fill_bytes(&mut bytes[from..]);
            for _ in 0..states.iter().sum() {
                bytes.extend((random.next_u32() as f32 / u32::MAX as f32 - 0.5).to_le_bytes());
            }
        }
        Self { bytes, pictures, states }
    }

    fn all(&self) -> impl Iterator<Item = (Vec<&[u8]>, Vec<Vec<f32>>)> {
        let tick_bytes = self.pictures.iter().sum::<usize>() + 4 * self.states.iter().sum::<usize>();
        self.bytes.chunks_exact(tick_bytes).map(|mut left| {
            let mut take = |bytes: usize| left.split_off(..bytes).unwrap_or_default();
            let pictures = self.pictures.iter().map(|bytes| take(*bytes)).collect();
            let floats = |bytes: &[u8]| bytes.as_chunks().0.iter().map(|x| f32::from_le_bytes(*x)).collect();
            let states = self.states.iter().map(|numbers| floats(take(4 * numbers))).collect();
            (pictures, states)
        })
    }
}

/// A policy behind the functions of `rcwm.h`.
struct InC(*mut rcwm::PolicyHandle);

fn check(code: rcwm::Code) -> anyhow::Result<()> {
    if code == rcwm::Code::RcwmOk {
        return Ok(());
    }
    // SAFETY: a text that ends with a zero and lives as long as this thread.
    let text = unsafe { std::ffi::CStr::from_ptr(rcwm::rcwm_last_error()) };
    bail!("{}", text.to_string_lossy())
}

impl InC {
    fn open(bundle: &Path) -> anyhow::Result<Self> {
        let folder = CString::new(bundle.to_str().context("the bundle's path is not UTF-8")?)?;
        let options =
            rcwm::PolicyOptions { size: size_of::<rcwm::PolicyOptions>(), threads: 1, half_weights: 0 };
        let mut policy = std::ptr::null_mut();
        // SAFETY: all three are ours.
        check(unsafe { rcwm::rcwm_policy_open(folder.as_ptr(), &raw const options, &raw mut policy) })?;
        Ok(Self(policy))
    }

    fn observe(
        &mut self,
        pictures: &[rcwm::Picture],
        states: &[rcwm::Numbers],
        executed: Option<&ActionValues>,
        decision: &mut rcwm::Decision,
    ) -> anyhow::Result<()> {
        let (values, count) = executed.map_or((std::ptr::null(), 0), |all| (all.as_ptr(), all.len()));
        // SAFETY: an open policy, and slices of ours.
        check(unsafe {
            rcwm::rcwm_policy_observe(
                self.0,
                pictures.as_ptr(),
                pictures.len(),
                states.as_ptr(),
                states.len(),
                values,
                count,
                decision,
            )
        })
    }

    fn work_ahead(&mut self, executed: &ActionValues) -> anyhow::Result<()> {
        // SAFETY: an open policy, and numbers of ours.
        check(unsafe { rcwm::rcwm_policy_work_ahead(self.0, executed.as_ptr(), executed.len()) })
    }
}

impl Drop for InC {
    fn drop(&mut self) {
        // SAFETY: opened once, closed here. It is not in use: there is nothing to tell.
        unsafe { rcwm::rcwm_policy_close(self.0) };
    }
}

/// Rust and C by turns, each first in every second tick.
fn by_turns(bundle: &Path, ticks: &Ticks) -> anyhow::Result<[Through; 2]> {
    let settings = EngineSettings::single_threaded(EngineKind::Tract);
    let mut in_rust = Policy::load(bundle, settings)?;
    let (mut in_c, mut reader) = (InC::open(bundle)?, InputReader::of(in_rust.manifest()));
    let [mut rust, mut c] = [Through::default(), Through::default()];
    // SAFETY: numbers only, of which zeros are one.
    let mut decision: rcwm::Decision = unsafe { std::mem::zeroed() };
    decision.size = size_of::<rcwm::Decision>();
    for (tick, (pictures, states)) in ticks.all().enumerate() {
        let as_c = |bytes: &&[u8]| rcwm::Picture { bytes: bytes.as_ptr(), len: bytes.len() };
        let pictures_in_c: Vec<_> = pictures.iter().map(as_c).collect();
        let as_c = |values: &Vec<f32>| rcwm::Numbers { values: values.as_ptr(), len: values.len() };
        let states_in_c: Vec<_> = states.iter().map(as_c).collect();
        for turn in 0..2 {
            if (tick + turn) % 2 == 0 {
                let start = Instant::now();
                let inputs = reader.arrange(pictures.iter().copied(), states.iter().map(Vec::as_slice));
                let decided = in_rust.observe(inputs, rust.actions.last())?.action;
                rust.note(decided, start);
                in_rust.work_ahead(Some(&decided))?;
            } else {
                let start = Instant::now();
                in_c.observe(&pictures_in_c, &states_in_c, c.actions.last(), &mut decision)?;
                let decided = ActionValues::of(&decision.action[..decision.numbers]);
                let decided = decided.context("an action of C is too long")?;
                c.note(decided, start);
                in_c.work_ahead(&decided)?;
            }
        }
    }
    Ok([rust, c])
}

/// Compiles the program in C that lies beside this one, against the library that cargo has built for it.
fn program_in_c(folder: &Path) -> anyhow::Result<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let own = std::env::current_exe()?;
    let built = own.parent().context("a program lies in a folder")?.join("deps");
    run(Command::new(root.join("scripts/install-capi")).arg(folder).arg("--built").arg(built))?;
    let program = folder.join("doors");
    let mut compile = Command::new("cc");
    compile.args(["-std=c11", "-D_POSIX_C_SOURCE=200809L", "-O2"]).arg(root.join("benches/src/doors.c"));
    compile.arg("-I").arg(folder.join("include")).arg("-L").arg(folder.join("lib")).arg("-lrcwm");
    run(compile.arg(format!("-Wl,-rpath,{}/lib", folder.display())).arg("-o").arg(&program))?;
    Ok(program.display().to_string())
}

fn run(command: &mut Command) -> anyhow::Result<()> {
    let output = command.output().with_context(|| format!("{command:?} does not start"))?;
    let told = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{command:?}: {}: {}", output.status, told.trim());
    Ok(())
}

/// The ticks through a program.
fn through(
    command: &str,
    bundle: &Path,
    inputs: &Path,
    out: &Path,
    numbers: usize,
    ticks: u32,
) -> anyhow::Result<Through> {
    // A path may hold blanks; a command's own arguments are told apart by them.
    let mut words = if Path::new(command).is_file() { vec![command] } else { command.split(' ').collect() };
    let program = words.remove(0);
    run(Command::new(program).args(words).arg(bundle).arg(inputs).arg(out))?;
    let bytes = std::fs::read(out).with_context(|| format!("{program} has written nothing"))?;
    let (actions, times) = bytes.split_at_checked(4 * numbers * ticks as usize).unwrap_or_default();
    let found = (actions.len() / 4 / numbers.max(1), times.len() / 8);
    ensure!(
        found == (ticks as usize, ticks as usize),
        "{program} has written {} bytes, expected {ticks} actions of {numbers} f32 and {ticks} times of u64",
        bytes.len()
    );
    let actions: Vec<f32> = actions.as_chunks().0.iter().map(|x| f32::from_le_bytes(*x)).collect();
    Ok(Through {
        actions: actions.chunks_exact(numbers).filter_map(ActionValues::of).collect(),
        times_ns: times.as_chunks().0.iter().map(|x| u64::from_le_bytes(*x)).collect(),
    })
}

/// p50, p99 and the most of them.
fn quantiles_us(times_ns: impl Iterator<Item = i64>) -> [f64; 3] {
    let mut sorted: Vec<i64> = times_ns.collect();
    sorted.sort_unstable();
    [50, 99, 100].map(|percent| sorted[(sorted.len() - 1) * percent / 100] as f64 / 1e3)
}

fn row(name: &str, found: &Through, rust: &Through, paired: bool) -> anyhow::Result<Value> {
    let times = || found.times_ns.iter().map(|time| *time as i64);
    let [p50, p99, most] = quantiles_us(times());
    let pairs = found.actions.iter().zip(&rust.actions);
    let same = pairs.filter(|(action, rust)| action.to_bits() == rust.to_bits()).count();
    // Of each tick, how much longer than in Rust.
    let more = times().zip(&rust.times_ns).map(|(time, rust)| time - *rust as i64);
    let overhead = paired.then(|| quantiles_us(more));
    let shown = overhead.map_or_else(
        || "                       -".to_owned(),
        |[p50, p99, _]| format!("{p50:>12.3} {p99:>11.3}"),
    );
    outln!("{name:<24} {p50:>9.2} {p99:>9.2} {most:>9.2} {shown}   {same} of {}", rust.actions.len());
    Ok(json!({
        "door": name, "ticks": found.times_ns.len(), "p50_us": p50, "p99_us": p99, "max_us": most,
        "overhead_p50_us": overhead.map(|x| x[0]), "overhead_p99_us": overhead.map(|x| x[1]), "same_bits": same,
    }))
}

fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    let Arguments { bundle, ticks: count, .. } = &arguments;
    let manifest = Bundle::open(bundle)?.manifest;
    let ticks = Ticks::new(&manifest, *count, arguments.seed);
    let [rust, c] = by_turns(bundle, &ticks)?;

    outln!(
        "{:<24} {:>9} {:>9} {:>9} {:>12} {:>11}   same bits",
        "observe, us",
        "p50",
        "p99",
        "max",
        "more: p50",
        "p99"
    );
    let mut rows = vec![row("Rust", &rust, &rust, false)?, row("C, by turns", &c, &rust, true)?];
    let folder = tempfile::tempdir()?;
    let [inputs, out] = ["inputs", "out"].map(|name| folder.path().join(name));
    std::fs::write(&inputs, &ticks.bytes)?;
    let mut programs = vec![("C, a program".to_owned(), program_in_c(folder.path())?)];
    for door in &arguments.door {
        let (name, command) = door.split_once('=').context("--door: expected NAME=COMMAND")?;
        programs.push((format!("{name}, a program"), command.to_owned()));
    }
    for (name, command) in programs {
        let found = through(&command, bundle, &inputs, &out, manifest.interface.action_numbers(), *count)?;
        rows.push(row(&name, &found, &rust, false)?);
        std::fs::remove_file(&out)?;
    }
    if let Some(path) = &arguments.json {
        let text = serde_json::to_string_pretty(
            &json!({ "bundle": bundle, "seed": arguments.seed, "doors": rows }),
        )?;
        rcwm_models::files::write_atomic(path, text.as_bytes())?;
    }
    let differs = rows.iter().find(|row| row["same_bits"] != *count);
    ensure!(differs.is_none(), "the actions of a door differ: {}", differs.unwrap_or(&Value::Null));
    Ok(())
}
