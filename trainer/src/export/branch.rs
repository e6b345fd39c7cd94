//! The branches as graphs, each with its encoder.

use rcwm_models::bundle::{PartName, TensorSpec};
use rcwm_models::settings::ModelKind;

use super::blocks::Part;
use super::graph::Value;
use crate::model::layers::NORM_EPS;

impl Part<'_> {
    /// The encoder, of RCWM the convolutions that both branches share: image -> features.
    pub fn encoder(&mut self) {
        let (inputs, _) = PartName::Encoder.signature(self.settings);
        let image = self.graph.input(&inputs[0]);
        let x = self.graph.cast_to_float(&image); // [1, S, S, 3 C]
        let full = self.graph.scalar(255.0);
        let x = self.graph.binary("Div", &x, &full);
        let x = self.graph.shift(&x, -0.5);
        let x = self.graph.transpose(&x, &[0, 3, 1, 2]);
        let features = match self.settings.kind {
            ModelKind::Rcwm => self.conv_stack("encoder.shared", x, 2), // [1, 2c, S/4, S/4]
            ModelKind::Vanilla => self.conv_stack("encoder", x, self.settings.stages()), // [1, 8c, 4, 4]
        };
        self.graph.output("features", &features);
    }

    /// The robot branch (eq. 5, 6 left): z, h, action, features, noise -> h', prior and posterior.
    pub fn robot(&mut self) {
        self.acting("robot", PartName::Robot, |part, features| {
            let stages = part.settings.stages() - 2;
            part.conv_stack("encoder.robot", features.clone(), stages) // [1, 4c, 4, 4]
        });
    }

    /// The vanilla model's one branch, whose picture is encoded before: as the robot's.
    pub fn dynamics(&mut self) {
        self.acting("dynamics", PartName::Dynamics, |_, features| features.clone()); // [1, 8c, 4, 4]
    }

    /// A branch that takes the action and, where the model looks at it, the measured state.
    fn acting(&mut self, name: &str, part: PartName, encode: impl Fn(&mut Self, &Value) -> Value) {
        let (inputs, _) = part.signature(self.settings);
        let (inputs, state) = inputs.split_at(5);
        let [z, h, action, features, noise] = self.inputs(inputs);
        let state = state.first().map(|spec| self.graph.input(spec));
        let state = state.map(|state| self.measured(&state));
        let nm = self.settings.stoch_width();
        let weight = format!("{name}.input.linear.weight");
        let z_share = self.one_hot_product(&format!("{weight}.z"), &z, self.weights.rows(&weight, 0, nm));
        let action = self.normalised_action(&action);
        let action_share = self.linear_share(&format!("{name}.input.linear"), &action, nm);
        let sum = self.graph.add(&z_share, &action_share);
        let encode = |part: &mut Self| encode(part, &features);
        self.branch(name, &sum, &h, encode, state.as_ref(), &noise);
    }

    /// The environment branch (eq. 5, 6 right): e, h, features, noise -> h', prior and posterior.
    pub fn environment(&mut self) {
        let (inputs, _) = PartName::Environment.signature(self.settings);
        let [e, h, features, noise] = self.inputs(&inputs);
        let e = self.graph.reshape(&e, &[1, self.settings.stoch_width()]);
        let sum = self.linear_share("environment.input.linear", &e, 0);
        let encode = |part: &mut Self| {
            let stages = part.settings.stages() - 2;
            part.conv_stack("encoder.environment", features.clone(), stages) // [1, 4c, 4, 4]
        };
        self.branch("environment", &sum, &h, encode, None, &noise);
    }

    /// Declares the inputs.
    pub fn inputs<const N: usize>(&mut self, specs: &[TensorSpec]) -> [Value; N] {
        let values: Vec<Value> = specs.iter().map(|spec| self.graph.input(spec)).collect();
        values.try_into().expect("the part has as many inputs as its signature")
    }

    /// What the encoder makes of the measured state [1, state]: [1, hidden].
    fn measured(&mut self, state: &Value) -> Value {
        let (sign, size) = (self.graph.unary("Sign", state), self.graph.unary("Abs", state));
        let size = self.graph.shift(&size, 1.0);
        let size = self.graph.unary("Log", &size);
        let symlog = self.graph.mul(&sign, &size);
        let one = self.graph.scalar(1.0);
        let one = self.graph.reshape(&one, &[1, 1]);
        let x = self.graph.concat(&[&symlog, &one], 1);
        let x = self.dense("encoder.state.0", &x);
        self.dense("encoder.state.1", &x)
    }

    /// `a / max(1, |a|)`.
    fn normalised_action(&mut self, action: &Value) -> Value {
        let size = self.graph.unary("Abs", action);
        let one = self.graph.scalar(1.0);
        let divisor = self.graph.binary("Max", &size, &one);
        self.graph.binary("Div", action, &divisor)
    }

    /// What every branch does after its input layer's product; `encode` gives its picture's map.
    fn branch(
        &mut self,
        name: &str,
        input: &Value,
        h: &Value,
        encode: impl FnOnce(&mut Self) -> Value,
        state: Option<&Value>,
        noise: &Value,
    ) {
        let d = self.settings.deter;
        let x = self.norm_silu(&format!("{name}.input.norm"), input);
        let h_next = self.cell(name, &x, h);
        let noise = self.graph.split(noise, 0, &[1, 1]);

        let hidden = self.dense(&format!("{name}.prior.dense"), &h_next);
        let prior = self.log_probs(&format!("{name}.prior.logits"), &hidden);
        let prior_z = self.draw(&prior, &noise[0]);

        let embed = encode(self);
        let width = embed.shape().iter().product();
        let embed = self.graph.reshape(&embed, &[1, width]);
        // The share of h' needs no image, and can be ready when it comes.
        let dense = format!("{name}.posterior.dense");
        let h_share = self.linear_share(&format!("{dense}.linear"), &h_next, 0);
        let embed_share = self.linear_share(&format!("{dense}.linear"), &embed, d);
        let mut sum = self.graph.add(&h_share, &embed_share);
        if let Some(state) = state {
            let state_share = self.linear_share(&format!("{dense}.linear"), state, d + width);
            sum = self.graph.add(&sum, &state_share);
        }
        let hidden = self.norm_silu(&format!("{dense}.norm"), &sum);
        let posterior = self.log_probs(&format!("{name}.posterior.logits"), &hidden);
        let posterior_z = self.draw(&posterior, &noise[1]);

        self.graph.output("h_next", &h_next);
        self.graph.output("prior_z", &prior_z);
        self.graph.output("posterior_z", &posterior_z);
        self.graph.output("prior_log_probs", &prior);
        self.graph.output("posterior_log_probs", &posterior);
    }

    /// The recurrent cell.
    fn cell(&mut self, name: &str, x: &Value, h: &Value) -> Value {
        let d = self.settings.deter;
        let both = self.graph.concat(&[x, h], 1);
        let product = self.linear_share(&format!("{name}.cell.linear"), &both, 0); // [1, 3d]
        let gates = self.norm(&format!("{name}.cell.norm"), &product, NORM_EPS);
        let gates = self.graph.split(&gates, 1, &[d, d, d]);
        let reset = self.graph.unary("Sigmoid", &gates[0]);
        let cand = self.graph.mul(&reset, &gates[1]);
        let cand = self.graph.unary("Tanh", &cand);
        let update = self.graph.shift(&gates[2], -1.0);
        let update = self.graph.unary("Sigmoid", &update);
        let change = self.graph.binary("Sub", &cand, h);
        let change = self.graph.mul(&update, &change);
        self.graph.add(h, &change)
    }

    /// Log-probabilities [1, n, m] with the uniform share mixed in.
    fn log_probs(&mut self, name: &str, hidden: &Value) -> Value {
        let (n, m) = (self.settings.categoricals, self.settings.classes);
        let logits = self.linear(name, hidden);
        let logits = self.graph.reshape(&logits, &[1, n, m]);
        let p = self.graph.softmax(&logits);
        let unimix = self.settings.unimix;
        let p = self.graph.affine(&p, (1.0 - unimix) as f32, (unimix / m as f64) as f32);
        self.graph.unary("Log", &p)
    }

    /// Class indices [1, n].
    fn draw(&mut self, log_probs: &Value, noise: &Value) -> Value {
        let scores = self.graph.add(log_probs, noise);
        self.graph.arg_max(&scores)
    }

    /// Convolutions with their normalisations.
    fn conv_stack(&mut self, name: &str, x: Value, stages: usize) -> Value {
        (0..stages).fold(x, |x, index| {
            let weight = self.parameter(&format!("{name}.{index}.conv.weight"));
            let x = self.graph.conv_down(&x, &weight);
            self.channel_norm_silu(&format!("{name}.{index}.norm"), &x)
        })
    }
}
