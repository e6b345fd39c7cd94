//! What a model is made of.

#![allow(clippy::unwrap_used)]

mod support;

use assert_cmd::Command;
use candle_core::{DType, Device, Tensor};
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_trainer::model::agent::{self, Agent};
use rcwm_trainer::model::latent::{FirstSteps, Sampler};
use rcwm_trainer::model::parameters::{ParameterError, Parameters, Scope};

const KINDS: [ModelKind; 2] = [ModelKind::Rcwm, ModelKind::Vanilla];

fn values(parameters: &Parameters, name: &str) -> Vec<f32> {
    parameters.get(name).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

#[test]
fn the_papers_sizes_give_the_papers_numbers_of_parameters() {
    let millions = |kind| {
        let settings = ModelSettings::preset(Preset::Paper, kind);
        let total: usize = agent::parts(&settings).unwrap().iter().map(|part| part.parameters).sum();
        format!("{:.1}", total as f64 / 1e6)
    };
    assert_eq!(millions(ModelKind::Rcwm), "24.7");
    assert_eq!(millions(ModelKind::Vanilla), "19.1");
}

#[test]
fn the_same_seed_gives_the_same_weights_and_another_seed_others() {
    let settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let draw = |seed| agent::initialise(&settings, seed, &Device::Cpu).unwrap();
    let (one, same, other) = (draw(1), draw(1), draw(2));
    for (name, _) in one.iter() {
        assert_eq!(values(&one, name), values(&same, name), "{name}");
    }
    assert_ne!(values(&one, "robot.cell.linear.weight"), values(&other, "robot.cell.linear.weight"));
}

#[test]
fn weights_start_as_the_definition_says() {
    for kind in KINDS {
        let settings = ModelSettings::preset(Preset::Debug, kind);
        let parameters = agent::initialise(&settings, 1, &Device::Cpu).unwrap();
        for (name, _) in parameters.iter() {
            let values = values(&parameters, name);
            let all = |expected: f32| values.iter().all(|value| *value == expected);
            let starts_at_0 = ["heads.reward.out.", "critic.out.", "slow_critic.out."];
            if name.ends_with("bias")
                || name.ends_with("initial")
                || starts_at_0.iter().any(|p| name.starts_with(p))
            {
                assert!(all(0.0), "{name}");
            } else if name.ends_with("norm.weight") {
                assert!(all(1.0), "{name}");
            } else {
                assert!(values.iter().any(|value| *value != values[0]), "{name}");
            }
            if name.starts_with("interaction.") && name.ends_with("weight") && !name.contains("norm") {
                support::assert_full_scale(name, &values);
            }
            if let Some(rest) = name.strip_prefix("slow_") {
                assert_eq!(values, self::values(&parameters, rest), "the slow critic starts as a copy");
            }
        }
    }
}

/// A fixed direction, so that no sum of outputs cancels by symmetry.
fn weighted_sum(x: &Tensor) -> Tensor {
    let weights: Vec<f32> = (0..x.elem_count()).map(|i| ((i * 7919 % 1009) as f32 / 504.5) - 1.0).collect();
    let weights = Tensor::from_vec(weights, x.dims(), &Device::Cpu).unwrap();
    (x * weights).unwrap().sum_all().unwrap()
}

/// Everything the model puts out for a small batch, as one number.
fn everything(scope: &Scope<'_>, settings: &ModelSettings) -> Tensor {
    let (batch, length, device) = (2, 3, &Device::Cpu);
    let agent = Agent::new(scope, settings).unwrap();
    let pixels = (0..batch * length * 64 * 64 * 3).map(|i| (i * 131 % 251) as u8);
    let images = Tensor::from_iter(pixels, device).unwrap().reshape((batch, length, 64, 64, 3)).unwrap();
    let actions = Tensor::full(0.3f32, (batch, length, 4), device).unwrap();
    let first = FirstSteps::new(vec![true, false, false, true, false, true], length);
    let mut sampler = Sampler::seeded(7);
    let embeds = agent.world.encode(&images, None).unwrap();
    let observed = agent.world.observe(&embeds, &actions, &first, &mut sampler).unwrap();
    let features = observed.posteriors.features().unwrap();
    let decoded = agent.world.decode(&observed.posteriors).unwrap();
    let action = agent.actor.forward(&features).unwrap();
    let mut outputs = vec![
        decoded.image,
        observed.priors.features().unwrap(),
        agent.heads.reward.logits(&features).unwrap(),
        agent.heads.continue_logit(&features).unwrap(),
        agent.critic.logits(&features).unwrap(),
        agent.slow_critic.logits(&features).unwrap(),
        action.mean,
        action.std,
    ];
    outputs.extend(decoded.pictures.into_iter().map(|picture| picture.mask));
    let terms: Vec<Tensor> = outputs.iter().map(weighted_sum).collect();
    Tensor::stack(&terms, 0).unwrap().sum_all().unwrap()
}

/// Moves every parameter off its start: behind an output layer of zeros nothing gets a gradient.
fn stirred(settings: &ModelSettings) -> Parameters {
    let parameters = agent::initialise(settings, 3, &Device::Cpu).unwrap();
    let mut noise = Sampler::seeded(4);
    for (_, var) in parameters.iter() {
        let noise = noise.normal(var.dims(), &Device::Cpu).unwrap().unwrap();
        var.set(&(var.as_tensor() + (noise * 0.05).unwrap()).unwrap().detach()).unwrap();
    }
    parameters
}

#[test]
fn every_parameter_gets_a_finite_gradient_that_is_not_zero() {
    for kind in KINDS {
        let settings = ModelSettings::preset(Preset::Debug, kind);
        let parameters = stirred(&settings);
        let grads = everything(&parameters.trainable(), &settings).backward().unwrap();
        for (name, var) in parameters.iter() {
            let grad = grads.get(var.as_tensor()).unwrap_or_else(|| panic!("{name} has no gradient"));
            let grad: Vec<f32> = grad.flatten_all().unwrap().to_vec1().unwrap();
            assert!(grad.iter().all(|value| value.is_finite()), "{name}");
            assert!(grad.iter().any(|value| *value != 0.0), "the gradient of {name} is zero");
        }
    }
}

#[test]
fn frozen_parameters_get_no_gradient_and_show_every_update() {
    let settings = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let parameters = stirred(&settings);
    let number = |x: Tensor| x.to_scalar::<f32>().unwrap();
    let before = everything(&parameters.frozen(), &settings);
    let grads = before.backward().unwrap();
    assert!(parameters.iter().all(|(_, var)| grads.get(var.as_tensor()).is_none()));

    let frozen = Agent::new(&parameters.frozen(), &settings).unwrap();
    let state = || frozen.world.initial(1).unwrap().features().unwrap();
    let h_before = number(weighted_sum(&state()));
    let initial = parameters.get("robot.initial").unwrap();
    initial.set(&Tensor::ones(initial.dims(), DType::F32, &Device::Cpu).unwrap()).unwrap();
    assert_ne!(h_before, number(weighted_sum(&state())));
}

#[test]
fn a_model_of_another_kind_is_refused_with_the_parameters_name() {
    let rcwm = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let vanilla = ModelSettings::preset(Preset::Debug, ModelKind::Vanilla);
    let parameters = agent::initialise(&rcwm, 0, &Device::Cpu).unwrap();
    match Agent::new(&parameters.trainable(), &vanilla) {
        Err(ParameterError::Missing { name, .. }) => assert_eq!(name, "encoder.0.conv.weight"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn imagination_and_filtering_agree_where_no_image_is_seen() {
    // The prior of a filtered step is what one imagined step from the state before it gives.
    for kind in KINDS {
        let settings = ModelSettings::preset(Preset::Debug, kind);
        let parameters = stirred(&settings);
        let agent = Agent::new(&parameters.frozen(), &settings).unwrap();
        let device = &Device::Cpu;
        let images = Tensor::full(90u8, (1, 2, 64, 64, 3), device).unwrap();
        let actions = Tensor::full(1.7f32, (1, 2, 4), device).unwrap();
        let first = FirstSteps::new(vec![true, false], 2);
        let embeds = agent.world.encode(&images, None).unwrap();
        let observed = agent.world.observe(&embeds, &actions, &first, &mut Sampler::Mode).unwrap();
        let step = |t: usize| move |x: &Tensor| x.narrow(1, t, 1)?.squeeze(1);
        let before = observed.posteriors.map(step(0)).unwrap();
        let action = actions.narrow(1, 1, 1).unwrap().squeeze(1).unwrap();
        let imagined = agent.world.imagine_step(&before, &action, &mut Sampler::Mode).unwrap();
        let filtered = observed.priors.map(step(1)).unwrap();
        let difference = (imagined.features().unwrap() - filtered.features().unwrap()).unwrap();
        let largest = difference.abs().unwrap().flatten_all().unwrap().max(0).unwrap();
        assert!(largest.to_scalar::<f32>().unwrap() < 1e-5, "{kind:?}: {largest}");
    }
}

fn parameters_verb(arguments: &[&std::path::Path]) -> std::process::Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rcwm-trainer"));
    command.arg("parameters").args(arguments).output().unwrap()
}

#[test]
fn the_table_of_a_checkpoint_marks_what_is_of_rank_one() {
    let folder = tempfile::tempdir().unwrap();
    let (path, json) = (folder.path().join("checkpoint"), folder.path().join("table.json"));
    let checkpoint = support::untrained(ModelKind::Rcwm, 1);
    let deter = checkpoint.parameters.get("interaction.deter.weight").unwrap();
    let column = deter.narrow(1, 0, 1).unwrap().detach();
    deter.set(&column.matmul(&column.t().unwrap()).unwrap()).unwrap();
    checkpoint.write(&path).unwrap();

    let found = parameters_verb(&["--checkpoint".as_ref(), &path, "--json".as_ref(), &json]);
    let table = String::from_utf8(found.stdout).unwrap();
    let marked: Vec<_> = table.lines().filter(|line| line.contains("RANK 1")).collect();
    assert!(matches!(marked[..], [line] if line.starts_with("interaction.deter.weight ")), "{table}");
    let json: serde_json::Value = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
    let of_rank_one = |matrix: &&serde_json::Value| matrix["flag"] == "rank-one";
    let matrices = json["matrices"].as_array().unwrap();
    assert_eq!(matrices.iter().find(of_rank_one).unwrap()["shape"], serde_json::json!([32, 32]));
    let names = table.lines().filter(|line| line.contains(".weight ")).count();
    assert_eq!(names, matrices.len(), "a line each");
}

#[test]
fn a_folder_without_a_checkpoint_is_one_line_of_error() {
    let found = parameters_verb(&["--checkpoint".as_ref(), "/nowhere".as_ref()]);
    let error = String::from_utf8(found.stderr).unwrap();
    assert!(!found.status.success() && found.stdout.is_empty());
    assert!(error.lines().count() == 1 && error.contains("/nowhere: no such folder"), "{error}");
}
