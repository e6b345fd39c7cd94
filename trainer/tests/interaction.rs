//! What the environment branch receives of the robot after a short training: more than one number.

#![allow(clippy::unwrap_used)]

use candle_core::{Device, Tensor};
use ndarray::{Array2, Array3, Array4};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rcwm_models::episode::Episode;
use rcwm_models::settings::{ModelKind, ModelSettings, Preset};
use rcwm_trainer::learning::{Trained, WorldLearner, WorldSettings};
use rcwm_trainer::model::agent::{self, Agent};
use rcwm_trainer::model::latent::Sampler;
use rcwm_trainer::model::parameters::Parameters;
use rcwm_trainer::model::rcwm::{ENVIRONMENT, ROBOT};
use rcwm_trainer::model::world::World;
use rcwm_trainer::replay::Replay;
use rcwm_trainer::spectrum::{RANK_ONE_SHARE, singular_values};

const UPDATES: u64 = 150;
const EPISODES: u64 = 12;
const STEPS: usize = 40;
const LAYERS: [&str; 5] = ["deter", "query", "key", "value", "output"];
/// B and T.
const BATCH: (usize, usize) = (4, 16);

/// A bright square, the robot, goes where the action says; a grey one, the environment, is drawn after it in both directions.
fn episode(seed: u64) -> Episode {
    let mut generator = ChaCha8Rng::seed_from_u64(seed);
    let mut place = || [generator.random_range(8.0..56.0f32), generator.random_range(8.0..56.0f32)];
    let (mut robot, mut object, mut goal) = (place(), place(), place());
    let (mut squares, mut action) = (vec![(robot, object)], Array2::zeros((STEPS, 4)));
    for t in 1..STEPS {
        if t % 8 == 0 {
            goal = place();
        }
        for axis in 0..2 {
            action[[t, axis]] = ((goal[axis] - robot[axis]) / 16.0).clamp(-1.0, 1.0);
            robot[axis] = (robot[axis] + 6.0 * action[[t, axis]]).clamp(8.0, 56.0);
            object[axis] += 0.5 * (robot[axis] - object[axis]);
        }
        squares.push((robot, object));
    }
    let inside = |[x, y]: [f32; 2], side: f32, (px, py): (usize, usize)| {
        (px as f32 - x).abs() < side && (py as f32 - y).abs() < side
    };
    Episode {
        image: Array4::from_shape_fn((STEPS, 64, 64, 3), |(t, y, x, channel)| {
            match (inside(squares[t].0, 6.0, (x, y)), inside(squares[t].1, 10.0, (x, y))) {
                (true, _) => 230,
                (false, true) => [150, 90, 40][channel],
                _ => 20,
            }
        }),
        reward: (0..STEPS).map(|t| f32::from(u8::from(squares[t].1[0] > 32.0))).collect(),
        robot_mask: Some(Array3::from_shape_fn((STEPS, 64, 64), |(t, y, x)| {
            inside(squares[t].0, 6.0, (x, y))
        })),
        action,
        ..Episode::blank(STEPS)
    }
}

fn replay() -> Replay {
    let mut replay = Replay::new(10_000);
    (0..EPISODES).for_each(|seed| replay.add("push", episode(seed)).unwrap());
    replay
}

fn train(model: &ModelSettings, parameters: &Parameters, replay: &Replay) {
    let mut settings = WorldSettings::default();
    settings.adam.learning_rate = 1e-3;
    settings.reward_scale = 1.0;
    let mut learner = WorldLearner::new(parameters, model, &settings, Trained::World).unwrap();
    for number in 0..UPDATES {
        let batch = replay.draw(BATCH.0, BATCH.1, true, 1, number).unwrap();
        let batch = batch.into_tensors(&Device::Cpu).unwrap();
        learner.update(&batch, &mut Sampler::numbered(1, number)).unwrap();
    }
}

/// x [S, n, m] and the attention map [S, n, n+k] at the posterior states of a batch, but for an episode's first ones.
fn received(model: &ModelSettings, parameters: &Parameters, replay: &Replay) -> (Tensor, Tensor) {
    let (rows, length) = (16, 32);
    let host = replay.draw(rows, length, false, 2, 0).unwrap();
    let steps: Vec<u32> = (0..rows * length)
        .filter(|step| step % length > 0 && !host.first[*step])
        .map(|step| step as u32)
        .collect();
    let batch = host.into_tensors(&Device::Cpu).unwrap();
    let agent = Agent::new(&parameters.frozen(), model).unwrap();
    let embeds = agent.world.encode(&batch.image, None).unwrap();
    let observed =
        agent.world.observe(&embeds, &batch.action, &batch.first, &mut Sampler::seeded(3)).unwrap();
    let at = |x: &Tensor, earlier: u32| {
        let index: Vec<u32> = steps.iter().map(|step| step - earlier).collect();
        let index = Tensor::from_vec(index, steps.len(), &Device::Cpu).unwrap();
        x.flatten(0, 1).unwrap().contiguous().unwrap().index_select(&index, 0).unwrap()
    };
    let (robot, environment) = (&observed.priors.branches[ROBOT], &observed.posteriors.branches[ENVIRONMENT]);
    let World::Rcwm(world) = &agent.world else { panic!("a vanilla model has no interaction") };
    world.interaction.attend(&at(&robot.z, 0), &at(&robot.h, 0), &at(&environment.z, 1)).unwrap()
}

/// Without the mean over the first dimension.
fn centred(x: &Tensor) -> Tensor {
    x.broadcast_sub(&x.mean_keepdim(0).unwrap()).unwrap()
}

/// How far rows of weights, each with sum 1, are from their mean over dimension `over`: the mean share of the weight that lies elsewhere.
fn spread(map: &Tensor, over: usize) -> f64 {
    let away = map.broadcast_sub(&map.mean_keepdim(over).unwrap()).unwrap().abs().unwrap();
    f64::from((away.sum(2).unwrap().mean_all().unwrap() * 0.5).unwrap().to_scalar::<f32>().unwrap())
}

/// What is asserted of an interaction: second by first singular value of the layer on the robot's h and of x, and how attention varies.
#[derive(Debug)]
struct Measures {
    deter: f64,
    /// Of x as [states * n, m], centred.
    rows_of_x: f64,
    /// Of x as [states, n * m], centred.
    states_of_x: f64,
    attention_between_queries: f64,
    attention_between_states: f64,
}

impl Measures {
    fn of(model: &ModelSettings, parameters: &Parameters, replay: &Replay) -> Self {
        let second_share = |name: &str, matrix: &Tensor| {
            let values = singular_values(matrix).unwrap();
            println!("{name:<12} singular values {:.4?}", &values[..4]);
            values[1] / values[0]
        };
        let deter = LAYERS.map(|layer| {
            second_share(layer, parameters.get(&format!("interaction.{layer}.weight")).unwrap())
        })[0];
        let (x, attention) = received(model, parameters, replay);
        Self {
            deter,
            rows_of_x: second_share("x, rows", &centred(&x.flatten(0, 1).unwrap())),
            states_of_x: second_share("x, states", &centred(&x.flatten_from(1).unwrap())),
            attention_between_queries: spread(&attention, 1),
            attention_between_states: spread(&attention, 0),
        }
    }
}

/// Measures after a short training from fresh weights, those of the interaction times `scale`.
fn measured_after_training(scale: f64) -> Measures {
    let model = ModelSettings::preset(Preset::Debug, ModelKind::Rcwm);
    let parameters = agent::initialise(&model, 1, &Device::Cpu).unwrap();
    for layer in LAYERS {
        let var = parameters.get(&format!("interaction.{layer}.weight")).unwrap();
        var.set(&(var.as_tensor() * scale).unwrap().detach()).unwrap();
    }
    let replay = replay();
    train(&model, &parameters, &replay);
    let measures = Measures::of(&model, &parameters, &replay);
    println!("{measures:#?}");
    measures
}

#[test]
fn after_a_short_training_the_environment_receives_more_than_one_number_of_the_robot() {
    let found = measured_after_training(1.0);
    for (what, share) in
        [("deter", found.deter), ("rows of x", found.rows_of_x), ("states of x", found.states_of_x)]
    {
        assert!(share >= RANK_ONE_SHARE, "{what}: second singular value {share:.4} of the first; {found:?}");
    }
    assert!(found.attention_between_queries > 0.02, "all queries attend to the same: {found:?}");
    assert!(found.attention_between_states > 0.02, "attention is the same in all states: {found:?}");
}

#[test]
fn from_a_start_near_zero_it_would_receive_one() {
    // Near 0 the product of the layers is a saddle, which Adam leaves along one direction.
    let found = measured_after_training(0.005);
    assert!(found.deter < RANK_ONE_SHARE && found.rows_of_x < RANK_ONE_SHARE, "{found:?}");
}
