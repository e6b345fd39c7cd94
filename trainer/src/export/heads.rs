//! Actor, reward and continuation as graphs.

use rcwm_models::bundle::PartName;

use super::blocks::Part;
use crate::ops::TWO_HOT_LIMIT;

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
        let logits = self.head("heads.reward", &state); // [1, bins]
        let p = self.graph.softmax(&logits);
        let count = self.settings.bins;
        let middle = (count / 2) as f64;
        let bins: Vec<f32> =
            (0..count).map(|index| ((index as f64 - middle) / middle * TWO_HOT_LIMIT) as f32).collect();
        let bins = self.graph.floats("bins", &[count, 1], &bins);
        let mean = self.graph.matmul(&p, &bins); // [1, 1], in symlog space
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
