//! Checkpoints of other implementations: our numbers against theirs over 50 steps, and what is refused.
//!
//! `tests/data/import` holds small models with random weights, as `torch.save` wrote them, and what the implementations' own code makes of
//! 50 observations: h, logits, the actor's mode, reward, continuation, value and a picture, always with the most probable classes.

#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};

use candle_core::{D, Device, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::tensors::{Tensors, Values};
use rcwm_trainer::import::{Format, Imported, import};
use rcwm_trainer::model::agent::Agent;
use rcwm_trainer::model::latent::{FirstSteps, Sampler};

const STEPS: usize = 50;
const CLASSES: usize = 8;
/// The step whose picture they drew.
const PICTURE: usize = 25;

fn data(name: &str) -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "..", "tests", "data", "import", name].iter().collect()
}

/// The pictures that the values were made from.
fn pictures() -> Tensor {
    let byte = |at: usize| {
        let (t, y, x, c) = (at / 12288, at / 192 % 64, at / 3 % 64, at % 3);
        ((t * 7 + y * 3 + x * 5 + c * 40) % 256) as u8
    };
    let bytes: Vec<u8> = (0..STEPS * 12288).map(byte).collect();
    Tensor::from_vec(bytes, (1, STEPS, 64, 64, 3), &Device::Cpu).unwrap()
}

fn largest_difference(found: &Tensor, expected: &[f32]) -> f32 {
    let found: Vec<f32> = found.flatten_all().unwrap().to_vec1().unwrap();
    assert_eq!(found.len(), expected.len());
    found.iter().zip(expected).fold(0.0, |most, (a, b)| most.max((a - b).abs()))
}

fn compare(format: Format, name: &str) {
    let Imported { parameters, settings, .. } =
        import(&data(&format!("{name}.pt")), format, CLASSES).unwrap();
    let golden = Tensors::from_bytes(&std::fs::read(data(&format!("{name}.safetensors"))).unwrap()).unwrap();
    let values = |name: &str| match golden.get(name).unwrap() {
        Values::F32(values) => values.iter().copied().collect::<Vec<f32>>(),
        other => panic!("{other:?}"),
    };
    let agent = Agent::new(&parameters.frozen(), &settings).unwrap();
    let actions = Tensor::from_vec(values("actions"), (1, STEPS, 4), &Device::Cpu).unwrap();
    let first = FirstSteps::new((0..STEPS).map(|t| t == 0 || t == 30).collect(), STEPS);
    let embeds = agent.world.encode(&pictures(), None).unwrap();
    let posteriors = agent.world.observe(&embeds, &actions, &first, &mut Sampler::Mode).unwrap().posteriors;
    let features = posteriors.features().unwrap();
    let mut found = vec![
        ("action", agent.actor.forward(&features).unwrap().mean),
        ("reward", agent.heads.reward.mean(&agent.heads.reward.logits(&features).unwrap()).unwrap()),
        ("value", agent.critic.mean(&agent.critic.logits(&features).unwrap()).unwrap()),
        ("continue", agent.heads.continue_probability(&features).unwrap()),
    ];
    let decoded = agent.world.decode(&posteriors).unwrap().image; // [1, T, 64, 64, 3]
    found.push(("picture", decoded.narrow(1, PICTURE, 1).unwrap()));
    let names: &[[&str; 2]] = match format {
        Format::RcwmAuthors => &[["robot_h", "robot_logits"], ["environment_h", "environment_logits"]],
        Format::Dreamerv3Torch => &[["h", "logits"]],
    };
    assert_eq!(posteriors.branches.len(), names.len());
    for (branch, [h, logits]) in posteriors.branches.iter().zip(names) {
        found.push((h, branch.h.clone()));
        found.push((logits, branch.logits.flatten_from(D::Minus2).unwrap()));
    }
    let mut worst = 0f32;
    for (what, tensor) in found {
        let difference = largest_difference(&tensor, &values(what));
        eprintln!("{name}: {what} {difference:.1e}");
        worst = worst.max(difference);
    }
    assert!(worst <= 1e-5, "{name}: differs by {worst:e}");
    // The critic's slow copy was set apart by 0.01.
    let of = |name: &str| parameters.get(name).unwrap().flatten_all().unwrap();
    let (slow, critic) = (of("slow_critic.1.linear.weight"), of("critic.1.linear.weight"));
    let apart: Vec<f32> = (critic + 0.01).unwrap().to_vec1().unwrap();
    assert!(largest_difference(&slow, &apart) < 1e-6);
}

#[test]
fn the_authors_model_gives_the_authors_numbers() {
    compare(Format::RcwmAuthors, "rcwm-authors");
}

#[test]
fn dreamerv3_torchs_model_gives_its_numbers() {
    compare(Format::Dreamerv3Torch, "dreamerv3-torch");
}

#[test]
fn every_tensor_is_accounted_for() {
    let authors = import(&data("rcwm-authors.pt"), Format::RcwmAuthors, CLASSES).unwrap();
    assert_eq!((authors.taken + authors.copies + authors.left.len(), authors.left.len()), (384, 6));
    assert!(authors.left.iter().all(|name| name.starts_with("_wm.robot_predictor.")), "{:?}", authors.left);
    assert_eq!(authors.taken, authors.parameters.iter().count());
    let dreamer = import(&data("dreamerv3-torch.pt"), Format::Dreamerv3Torch, CLASSES).unwrap();
    assert_eq!(
        (dreamer.taken + dreamer.copies + dreamer.left.len(), &*dreamer.left),
        (228, &["_task_behavior.ema_vals".to_owned()][..])
    );
    // The actor's output comes in two pieces, weight and bias.
    assert_eq!(dreamer.taken, dreamer.parameters.iter().count() + 2);
}

fn refused(path: &Path, format: Format, classes: usize) -> String {
    let error = import(path, format, classes).expect_err("refused").to_string();
    assert!(!error.contains('\n') && error.contains(&*path.to_string_lossy()), "{error}");
    error
}

#[test]
fn the_wrong_format_and_the_wrong_number_of_classes_are_named() {
    let error = refused(&data("rcwm-authors.pt"), Format::Dreamerv3Torch, CLASSES);
    assert!(error.contains("no tensor _wm.dynamics.W; is it of another --format?"), "{error}");
    let error = refused(&data("dreamerv3-torch.pt"), Format::RcwmAuthors, CLASSES);
    assert!(error.contains("robot_env_atten"), "{error}");
    let error = refused(&data("dreamerv3-torch.pt"), Format::Dreamerv3Torch, 5);
    assert!(error.contains("32 rows, expected a multiple of 5 classes, 2 or more (--classes)"), "{error}");
}

#[test]
fn nothing_in_a_file_is_executed() {
    // The file asks for a command that would make this one.
    let trace = Path::new("/tmp/rcwm-was-executed");
    let before = trace.exists();
    refused(&data("hostile.pt"), Format::RcwmAuthors, CLASSES);
    assert!(before || !trace.exists());
}

#[test]
fn a_file_that_was_cut_short_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("latest.pt");
    let whole = std::fs::read(data("dreamerv3-torch.pt")).unwrap();
    for part in 0..40 {
        std::fs::write(&path, &whole[..part * whole.len() / 40]).unwrap();
        refused(&path, Format::Dreamerv3Torch, CLASSES);
    }
    std::fs::write(&path, b"not a checkpoint").unwrap();
    refused(&path, Format::Dreamerv3Torch, CLASSES);
    refused(folder.path(), Format::Dreamerv3Torch, CLASSES);
}

#[test]
fn a_damaged_file_is_refused_or_read_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("latest.pt");
    let whole = std::fs::read(data("dreamerv3-torch.pt")).unwrap();
    // Where the description of the tensors lies, and the directory at the end.
    let mut generator = ChaCha8Rng::seed_from_u64(5);
    for round in 0..300 {
        let mut bytes = whole.clone();
        for _ in 0..1 + round % 4 {
            let at = match round % 3 {
                0 => generator.random_range(0..30_000),
                1 => generator.random_range(bytes.len() - 30_000..bytes.len()),
                _ => generator.random_range(0..bytes.len()),
            };
            bytes[at] = generator.random();
        }
        std::fs::write(&path, &bytes).unwrap();
        if let Err(error) = import(&path, Format::Dreamerv3Torch, CLASSES) {
            assert!(!error.to_string().contains('\n'), "{error}");
        }
    }
}
