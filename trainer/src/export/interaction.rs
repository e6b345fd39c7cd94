//! The interaction model as a graph (eq. 7).

use ndarray::Array2;
use rcwm_models::bundle::PartName;

use super::blocks::Part;
use super::graph::Value;
use crate::model::interaction::INTERACTION_NORM_EPS;

impl Part<'_> {
    /// Prior z and h of the robot, z of the environment -> e, attention.
    pub fn interaction(&mut self) {
        let (inputs, _) = PartName::Interaction.signature(self.settings);
        let [robot_z, robot_h, environment_z] = self.inputs(&inputs);
        let (k, m) = (self.settings.interaction_rows(), self.settings.classes);
        let g = self.linear("interaction.deter", &robot_h);
        let g = self.graph.reshape(&g, &[1, k, m]);
        let queries = self.of_one_hot("interaction.query", &environment_z); // [1, n, m]
        let keys = self.of_robot("interaction.key", &robot_z, &g); // [1, n+k, m]
        let values = self.of_robot("interaction.value", &robot_z, &g);

        let keys = self.graph.transpose(&keys, &[0, 2, 1]); // [1, m, n+k]
        let scores = self.graph.matmul(&queries, &keys); // [1, n, n+k]
        let scale = self.graph.scalar((1.0 / (m as f64).sqrt()) as f32);
        let scores = self.graph.mul(&scores, &scale);
        let attention = self.graph.softmax(&scores);
        let mixture = self.graph.matmul(&attention, &values); // [1, n, m]
        let x = self.linear("interaction.output", &mixture);
        let one_hots = self.matrix("one_hots", Array2::eye(m));
        let z = self.graph.gather(&one_hots, &environment_z); // [1, n, m]
        let sum = self.graph.add(&z, &x);
        let e = self.norm("interaction.norm", &sum, INTERACTION_NORM_EPS);
        self.graph.output("e", &e);
        self.graph.output("attention", &attention);
    }

    /// A linear layer on one-hot rows, looked up: z [1, n] to [1, n, m].
    fn of_one_hot(&mut self, name: &str, z: &Value) -> Value {
        let table = self.matrix(&format!("{name}.table"), self.weights.table(name));
        self.graph.gather(&table, z)
    }

    /// A linear layer on u_t = [z^R_t, g_t]: [1, n+k, m].
    fn of_robot(&mut self, name: &str, z: &Value, g: &Value) -> Value {
        let z_rows = self.of_one_hot(name, z);
        let g_rows = self.linear(name, g);
        self.graph.concat(&[&z_rows, &g_rows], 1)
    }
}
