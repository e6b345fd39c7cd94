//! A stand-in for a robot and its camera: a hand that slides over a table towards a goal.

use rcwm_models::IMAGE_SIDE;
use rcwm_models::wire::ActionValues;

/// The hand moves with the first two components of an action.
pub struct Table {
    hand: [f32; 2],
    goal: [f32; 2],
}

impl Table {
    pub fn new(episode: u64) -> Self {
        let turn = episode as f32 * 2.4;
        Self { hand: [0.5, 0.5], goal: [0.5 + 0.35 * turn.cos(), 0.5 + 0.35 * turn.sin()] }
    }

    /// Moves, and gives what was executed: the fingers of this hand do not move.
    pub fn step(&mut self, action: ActionValues) -> ActionValues {
        for (place, velocity) in self.hand.iter_mut().zip(action.iter()) {
            *place = (*place + 0.02 * velocity).clamp(0.0, 1.0);
        }
        [action[0], action[1], 0.0, 0.0].into()
    }

    /// Negative: the distance to the goal.
    pub fn reward(&self) -> f32 {
        -(self.hand[0] - self.goal[0]).hypot(self.hand[1] - self.goal[1])
    }

    /// 64 x 64 x 3, upright, RGB: the goal is red, the hand blue.
    pub fn draw(&self, image: &mut [u8]) {
        image.fill(150);
        for (place, colour) in [(self.goal, [200, 32, 32]), (self.hand, [32, 64, 200])] {
            let [column, row] = place.map(|at| (at * (IMAGE_SIDE - 4) as f32) as usize);
            for pixel in (0..16).map(|index| (row + index / 4) * IMAGE_SIDE + column + index % 4) {
                image[3 * pixel..3 * pixel + 3].copy_from_slice(&colour);
            }
        }
    }
}
