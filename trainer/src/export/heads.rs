//! Actor, reward and continuation as graphs.

use rcwm_models::bundle::PartName;

use super::blocks::Part;
use crate::ops::bins;

impl Part<'_> {
    /// State -> mean and standard deviation of the action.
    pub fn actor(&mut self) {
        let (inputs, _) = PartName::Actor.signature(self.settings);
        let state = self.state_inputs(&inputs);
        let out = self.head("actor", &state);
        let action = self.settings.action;
        let halves = self.graph.split(&out, 1, &[action, action]);
        let mean = self.graph.unary("Tanh", &halves[0]);
        let std = self.graph.shift(&halves[1], 2.0);
        let std = self.graph.unary("Sigmoid", &std);
        let std = self.graph.affine(&std, 0.9, 0.1);
        self.graph.output("mean", &mean);
        self.graph.output("std", &std);
    }

    /// State -> expected reward.
    pub fn reward(&mut self) {
        let (inputs, _) = PartName::Reward.signature(self.settings);
        let state = self.state_inputs(&inputs);
        let hidden = self.head_hidden("heads.reward", &state);
        // Bins in the order 0, then upwards, then downwards: b and -b then lie side by side (see `ops::two_hot_mean`).
        let (count, half) = (self.settings.bins, self.settings.bins / 2);
        let order: Vec<usize> = (half..count).chain((0..half).rev()).collect();
        let logits = self.reordered_linear("heads.reward.out", &hidden, &order); // [1, bins]
        let p = self.graph.softmax(&logits);
        let pieces = self.graph.split(&p, 1, &[1, half, half]);
        let difference = self.graph.binary("Sub", &pieces[1], &pieces[2]);
        let positive: Vec<f32> = bins(count).skip(half + 1).collect();
        let positive = self.graph.floats("positive_bins", &[half, 1], &positive);
        let mean = self.graph.matmul(&difference, &positive); // [1, 1], in symlog space
        let sign = self.graph.unary("Sign", &mean);
        let size = self.graph.unary("Abs", &mean);
        let size = self.graph.unary("Exp", &size);
        let size = self.graph.shift(&size, -1.0);
        let reward = self.graph.mul(&sign, &size);
        self.graph.output("reward", &reward);
    }

    /// State -> probability that the episode goes on.
    pub fn continues(&mut self) {
        let (inputs, _) = PartName::Continue.signature(self.settings);
        let state = self.state_inputs(&inputs);
        let logit = self.head("heads.continue", &state);
        let probability = self.graph.unary("Sigmoid", &logit);
        self.graph.output("continue_probability", &probability);
    }
}
