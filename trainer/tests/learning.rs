//! Learning: the authors' numbers, who gets a gradient in which phase, and that the same seed gives the same weights.

#![allow(clippy::unwrap_used)]

mod support;

use std::path::Path;

use candle_core::{Device, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_models::{ACTION_LEN, IMAGE_BYTES, MASK_BYTES};
use rcwm_trainer::behaviour::{BehaviourLearner, BehaviourSettings, Horizon};
use rcwm_trainer::learning::CloningLoss;
use rcwm_trainer::learning::{
    Batch, Gradients, HostBatch, Imitation, Side, Trained, WorldLearner, WorldSettings, side_of,
};
use rcwm_trainer::model::agent;
use rcwm_trainer::model::latent::Sampler;
use rcwm_trainer::model::parameters::Parameters;
use rcwm_trainer::ops;
use rcwm_trainer::parity::{self, Group};
use support::lively_parameters;

/// A softmax does not see what is added to all of its inputs: the true gradient of the keys' bias is 0.
const BLIND: &str = "interaction.key.bias";

#[test]
fn one_update_of_the_authors_implementation_is_ours_in_every_number() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/rcwm-small.safetensors");
    let report = parity::check_file(&file, &Group::ALL, &Device::Cpu, &mut |_| ()).unwrap();
    for group in &report.groups {
        assert!(group.passes(), "{}: {:?}", group.group.as_str(), group.worst());
    }
    assert!(report.unchecked.is_empty(), "{:?}", report.unchecked);
}

/// The actor learns with the world model.
const IMITATION: Imitation = Imitation { scale: 10.0, loss: CloningLoss::SquaredError, learning_rate: 1e-3 };

fn batch(rows: usize, length: usize, masks: bool) -> Batch {
    let mut generator = ChaCha8Rng::seed_from_u64(3);
    let steps = rows * length;
    let mut bytes =
        |count: usize, most: u8| (0..count).map(|_| generator.random_range(0..=most)).collect::<Vec<u8>>();
    let image = bytes(steps * IMAGE_BYTES, 255);
    let robot_mask = if masks { bytes(steps * MASK_BYTES, 1) } else { Vec::new() };
    let mut first = vec![false; steps];
    first[0] = true;
    first[steps - 1] = true;
    let host = HostBatch {
        side: 64,
        rows,
        length,
        image,
        action: (0..steps * ACTION_LEN).map(|_| generator.random_range(-1.5..1.5)).collect(),
        reward: (0..steps).map(|_| generator.random_range(-1.0..10.0)).collect(),
        terminal: (0..steps).map(|step| step == 1).collect(),
        first,
        robot_mask,
        masks,
        pushed: vec![false; steps],
        ..HostBatch::default()
    };
    host.into_tensors(&Device::Cpu).unwrap()
}

/// Asserts that exactly the trained parameters get a gradient from `loss`, and a finite one that is not 0.
fn assert_gradients(phase: &str, loss: &Tensor, parameters: &Parameters, trained: Trained) {
    let store = loss.backward().unwrap();
    let trains = trained.filter();
    for (name, var) in parameters.iter() {
        match store.get(var) {
            None => assert!(!trains(name), "{phase}: {name} gets no gradient"),
            Some(gradient) => {
                assert!(trains(name), "{phase}: {name} is frozen and gets a gradient");
                let largest = gradient.abs().unwrap().flatten_all().unwrap().max(0).unwrap();
                let largest = largest.to_scalar::<f32>().unwrap();
                let finite =
                    gradient.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap().is_finite();
                assert!(finite && (largest > 0.0 || name == BLIND), "{phase}: {name}: {largest}");
            }
        }
    }
}

fn assert_gradients_in_every_phase(preset: Preset, kind: ModelKind, rows: usize) {
    let model = ModelSettings::preset(preset, kind);
    let parameters = lively_parameters(&model);
    let settings = WorldSettings { free_nats: 0.0, ..WorldSettings::default() };
    let mut phases = vec![
        ("warm-up with masks", true, Trained::World),
        ("mask-free", false, Trained::World),
        ("environment's side only, with masks", true, Trained::Environment),
        ("environment's side only", false, Trained::Environment),
    ];
    if kind == ModelKind::Vanilla {
        // The baseline has one branch: no part of it but the heads is the environment's.
        phases.truncate(2);
    }
    let mut start = None;
    let mut learner = WorldLearner::new(&parameters, &model, &settings, Trained::World).unwrap();
    for (phase, masks, trained) in phases {
        learner.train(trained, None).unwrap();
        let losses = learner.losses(&batch(rows, 3, masks), &mut Sampler::seeded(4)).unwrap();
        assert_eq!(losses.robot_mask.is_some(), masks);
        assert_gradients(phase, &losses.total, &parameters, trained);
        start = Some(losses.observed.posteriors.map(|x| x.detach().flatten(0, 1)).unwrap());
    }
    for trained in [Trained::WorldAndActor, Trained::EnvironmentAndActor] {
        if kind == ModelKind::Rcwm || trained == Trained::WorldAndActor {
            learner.train(trained, Some(IMITATION)).unwrap();
            let losses = learner.losses(&batch(rows, 3, false), &mut Sampler::seeded(4)).unwrap();
            assert_gradients("imitation", &losses.total, &parameters, trained);
        }
    }
    let settings = BehaviourSettings {
        horizon: Horizon { length: 3, ..Horizon::default() },
        ..BehaviourSettings::default()
    };
    let learner = BehaviourLearner::new(&parameters, &model, &settings).unwrap();
    let imagined = learner.imagine(&start.unwrap(), &mut Sampler::seeded(5)).unwrap();
    let actor = rcwm_trainer::behaviour::actor_loss(&imagined, 1.0, settings.entropy_scale).unwrap();
    assert_gradients("behaviour, actor", &actor, &parameters, Trained::Actor);
    let critic = learner.critic_loss(&imagined).unwrap();
    assert_gradients("behaviour, critic", &critic, &parameters, Trained::Critic);
}

#[test]
fn exactly_the_trained_variables_of_the_debug_preset_get_gradients_in_every_phase() {
    assert_gradients_in_every_phase(Preset::Debug, ModelKind::Rcwm, 2);
    assert_gradients_in_every_phase(Preset::Debug, ModelKind::Vanilla, 2);
}

#[test]
fn exactly_the_trained_variables_of_the_small_preset_get_gradients_in_every_phase() {
    assert_gradients_in_every_phase(Preset::Small, ModelKind::Rcwm, 2);
    assert_gradients_in_every_phase(Preset::Small, ModelKind::Vanilla, 2);
}

#[test]
fn exactly_the_trained_variables_of_the_paper_preset_get_gradients_in_every_phase() {
    assert_gradients_in_every_phase(Preset::Paper, ModelKind::Rcwm, 1);
    assert_gradients_in_every_phase(Preset::Paper, ModelKind::Vanilla, 1);
}

fn values(parameters: &Parameters) -> Vec<(String, Vec<f32>)> {
    let values = |var: &candle_core::Var| var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    parameters.iter().map(|(name, var)| (name.to_owned(), values(var))).collect()
}

#[test]
fn an_update_moves_what_it_trains_and_nothing_else() {
    let model = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let parameters = lively_parameters(&model);
    let before = values(&parameters);
    let settings = WorldSettings { free_nats: 0.0, ..WorldSettings::default() };
    let mut learner = WorldLearner::new(&parameters, &model, &settings, Trained::Environment).unwrap();
    let update = learner.update(&batch(2, 3, false), &mut Sampler::seeded(4)).unwrap();
    let between = values(&parameters);
    for ((name, old), (_, new)) in before.iter().zip(&between) {
        assert_eq!(old != new, side_of(name) == Side::Environment, "{name}");
    }
    let mut learner = BehaviourLearner::new(&parameters, &model, &BehaviourSettings::default()).unwrap();
    let start = update.posteriors.map(|x| x.flatten(0, 1)).unwrap();
    learner.update(&start, &mut Sampler::seeded(5)).unwrap();
    for ((name, old), (_, new)) in between.iter().zip(&values(&parameters)) {
        let moves = matches!(side_of(name), Side::Actor | Side::Critic | Side::SlowCritic);
        assert_eq!(old != new, moves, "{name}");
    }
}

/// Asserts that two sets of gradients are the same but for rounding: that of a tensor whose terms nearly cancel is as large as the
/// others'.
fn assert_agree(found: &Gradients, expected: &Gradients) {
    let largest = |x: &Tensor| {
        f64::from(x.abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar::<f32>().unwrap())
    };
    for ((name, x), (other, y)) in found.iter().zip(expected.iter()) {
        let (error, scale) = (largest(&(x - y).unwrap()), largest(y));
        let allowed = 1e-4 * scale + 1e-6 * expected.norm();
        assert!(name == other && error <= allowed, "{name}: {error:e} of {scale:e}, allowed {allowed:e}");
    }
}

#[test]
fn gradients_do_not_depend_on_how_many_threads_share_the_batch() {
    let model = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let parameters = lively_parameters(&model);
    let settings = WorldSettings { free_nats: 0.0, ..WorldSettings::default() };
    let world = WorldLearner::new(&parameters, &model, &settings, Trained::World).unwrap();
    let behaviour = BehaviourLearner::new(&parameters, &model, &BehaviourSettings::default()).unwrap();
    let batch = batch(3, 4, true);
    let run = || {
        let (losses, gradients) = world.gradients(&batch, &mut Sampler::seeded(7)).unwrap();
        let start = losses.observed.posteriors.map(|x| x.flatten(0, 1)).unwrap();
        let mut sampler = Sampler::seeded(8);
        let imagined = behaviour.imagine_shares(&start, &mut sampler).unwrap();
        let behaviour = behaviour.clone().gradients(imagined).unwrap();
        let next = sampler.gumbel(&[3], &Device::Cpu).unwrap().unwrap().to_vec1::<f32>().unwrap();
        (losses.values().unwrap(), gradients, behaviour, next)
    };
    let shared = run();
    // As one of very many tasks, each has a single thread.
    let alone = ops::in_parallel((0..1000).collect(), |index| if index == 0 { Some(run()) } else { None });
    let alone = alone.into_iter().flatten().next().unwrap();
    for (found, expected) in [
        (shared.0.total, alone.0.total),
        (shared.0.robot_kl, alone.0.robot_kl),
        (shared.0.robot_mask.unwrap(), alone.0.robot_mask.unwrap()),
        (shared.2.values.actor_loss, alone.2.values.actor_loss),
        (shared.2.values.critic_loss, alone.2.values.critic_loss),
    ] {
        assert!((found - expected).abs() <= 1e-5 * expected.abs().max(0.1), "{found} {expected}");
    }
    assert_agree(&shared.1, &alone.1);
    assert_agree(&shared.2.actor, &alone.2.actor);
    assert_agree(&shared.2.critic, &alone.2.critic);
    assert_eq!(shared.3, alone.3);
}

#[test]
fn learning_on_one_batch_lowers_its_loss() {
    for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
        let model = ModelSettings::preset(Preset::Debug, kind);
        let parameters = agent::initialise(&model, 1, &Device::Cpu).unwrap();
        let mut settings = WorldSettings::default();
        settings.adam.learning_rate = 1e-3;
        let mut learner = WorldLearner::new(&parameters, &model, &settings, Trained::World).unwrap();
        let batch = batch(2, 4, true);
        let losses: Vec<f64> = (0..20)
            .map(|n| learner.update(&batch, &mut Sampler::numbered(6, n)).unwrap().losses.total)
            .collect();
        assert!(losses[19] < 0.9 * losses[0], "{losses:?}");
    }
}

#[test]
fn a_loss_that_is_not_finite_leaves_the_parameters_as_they_were() {
    let model = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let parameters = agent::initialise(&model, 1, &Device::Cpu).unwrap();
    let before = values(&parameters);
    let mut learner =
        WorldLearner::new(&parameters, &model, &WorldSettings::default(), Trained::World).unwrap();
    let mut batch = batch(1, 2, false);
    batch.terminal = (batch.terminal * f64::NAN).unwrap();
    let error = learner.update(&batch, &mut Sampler::seeded(1)).unwrap_err();
    assert!(error.to_string().contains("resume from the last checkpoint"), "{error}");
    assert_eq!(values(&parameters), before);
}

#[test]
fn what_is_imitated_reaches_posteriors_and_encoders() {
    let model = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let parameters = lively_parameters(&model);
    // Nothing but the imitation is left of the loss.
    let settings = WorldSettings {
        image_scale: 0.0,
        reward_scale: 0.0,
        continue_scale: 0.0,
        dynamics_scale: 0.0,
        representation_scale: 0.0,
        ..WorldSettings::default()
    };
    let mut learner = WorldLearner::new(&parameters, &model, &settings, Trained::World).unwrap();
    learner.train(Trained::WorldAndActor, Some(IMITATION)).unwrap();
    let batch = batch(2, 3, false);
    let losses = learner.losses(&batch, &mut Sampler::seeded(4)).unwrap();
    let (total, cloning) =
        (losses.total.to_scalar::<f32>().unwrap(), losses.values().unwrap().cloning.unwrap());
    assert!((f64::from(total) - IMITATION.scale * cloning).abs() < 1e-5 * cloning, "{total} {cloning}");
    let gradients = losses.total.backward().unwrap();
    for name in [
        "actor.out.weight",
        "robot.posterior.logits.weight",
        "environment.posterior.logits.weight",
        "encoder.environment.0.conv.weight",
        "encoder.shared.0.conv.weight",
    ] {
        let gradient = gradients.get(parameters.get(name).unwrap()).unwrap();
        let size = gradient.abs().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(size > 0.0 && size.is_finite(), "{name}: {size}");
    }
}

/// Threads share a batch by its rows, which differ in examples; one may have none.
#[test]
fn the_cloning_loss_is_the_mean_over_examples_however_they_are_shared_out() {
    let model = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let parameters = lively_parameters(&model);
    let mut learner =
        WorldLearner::new(&parameters, &model, &WorldSettings::default(), Trained::World).unwrap();
    learner.train(Trained::WorldAndActor, Some(IMITATION)).unwrap();
    let (rows, steps) = (4, 5);
    let mut batch = batch(rows, steps, false);
    // The first row keeps all its examples, the second one, the others none.
    batch.pushed = (0..rows * steps).map(|index| index >= steps + 2).collect();
    let mean = learner.losses(&batch, &mut Sampler::seeded(4)).unwrap().values().unwrap().cloning.unwrap();
    let (shared, gradients) = learner.gradients(&batch, &mut Sampler::seeded(4)).unwrap();
    let shared = shared.values().unwrap().cloning.unwrap();
    assert!(mean > 0.0 && (shared - mean).abs() < 1e-4 * mean, "{shared} in shares, {mean} in one");
    let whole = learner.losses(&batch, &mut Sampler::seeded(4)).unwrap().total.backward().unwrap();
    let name = "actor.out.weight";
    let difference =
        (gradients.get(name).unwrap() - whole.get(parameters.get(name).unwrap()).unwrap()).unwrap();
    let size = |x: &candle_core::Tensor| x.abs().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap();
    assert!(size(&difference) < 1e-3 * size(gradients.get(name).unwrap()), "{}", size(&difference));
    batch.pushed.fill(true);
    let (none, gradients) = learner.gradients(&batch, &mut Sampler::seeded(4)).unwrap();
    assert_eq!(none.values().unwrap().cloning, Some(0.0), "no example is no loss, not NaN");
    assert!(gradients.norm().is_finite());
}

#[test]
fn steps_that_are_decoded_take_turns_and_cover_all() {
    let model = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let parameters = lively_parameters(&model);
    let image = |every: usize, number: u64| {
        let settings = WorldSettings { decode_every: every, ..WorldSettings::default() };
        let learner = WorldLearner::new(&parameters, &model, &settings, Trained::World).unwrap();
        let batch = Batch { number, ..batch(2, 6, true) };
        let losses = learner.losses(&batch, &mut Sampler::seeded(4)).unwrap().values().unwrap();
        [losses.image, losses.robot_mask.unwrap()]
    };
    for every in [2, 3] {
        let turns: Vec<_> = (0..every as u64).map(|number| image(every, 5 + number)).collect();
        for (which, whole) in image(1, 5).into_iter().enumerate() {
            let mean = turns.iter().map(|losses| losses[which]).sum::<f64>() / every as f64;
            assert!((mean - whole).abs() < 1e-4 * whole, "{every}: {mean} {whole}");
            assert!((turns[0][which] - whole).abs() > 1e-4 * whole, "{every}: the turns are all alike");
        }
    }
}
