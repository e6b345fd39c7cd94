//! What moves in recorded pictures.

use ndarray::Axis;
use rcwm_models::episode::Episode;

/// A pixel has changed where one of its channels differs by more than this many of 255 levels. Pictures of a scene that stands still
/// differ by nothing; slow shadows stay below.
pub const CHANGED_LEVELS: u8 = 16;
/// The robot moves at a step if this many pixels, robot before or after, have changed.
pub const ROBOT_PIXELS: usize = 16;

/// Whether a pixel has changed.
#[must_use]
pub fn changed(before: [u8; 3], after: [u8; 3]) -> bool {
    before.into_iter().zip(after).any(|(a, b)| a.abs_diff(b) > CHANGED_LEVELS)
}

/// At which steps of an episode with masks the robot moves; never at the first.
#[must_use]
pub fn robot_moves(episode: &Episode) -> Vec<bool> {
    let Some(masks) = &episode.robot_mask else { return vec![false; episode.len()] };
    let (images, masks) = (episode.image.as_standard_layout(), masks.as_standard_layout());
    let (Some(images), Some(masks)) = (images.as_slice(), masks.as_slice()) else {
        return vec![false; episode.image.len_of(Axis(0))];
    };
    let pixels = masks.len() / episode.len().max(1); // of all cameras
    let frame = |t: usize| (&images[3 * t * pixels..][..3 * pixels], &masks[t * pixels..][..pixels]);
    let moves = |t: usize| {
        let Some(before) = t.checked_sub(1) else { return false };
        let ((a, robot_a), (b, robot_b)) = (frame(before), frame(t));
        let pixels = a.as_chunks::<3>().0.iter().zip(b.as_chunks::<3>().0);
        let robot = robot_a.iter().zip(robot_b);
        let moved = pixels
            .zip(robot)
            .filter(|((a, b), (robot_a, robot_b))| (**robot_a || **robot_b) && changed(**a, **b));
        moved.count() >= ROBOT_PIXELS
    };
    (0..episode.len()).map(moves).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bright square of 8 x 8, the robot, goes two pixels a step up to step 4; a lamp beside it flickers at every step.
    fn episode() -> Episode {
        let inside = |t: usize, y: usize, x: usize| {
            (8..16).contains(&y) && (2 * t.min(4)..2 * t.min(4) + 8).contains(&x)
        };
        Episode {
            image: ndarray::Array4::from_shape_fn((8, 64, 64, 3), |(t, y, x, _)| {
                match (inside(t, y, x), y > 40) {
                    (true, _) => 200,
                    (_, true) => [90, 130][t % 2],
                    _ => 20,
                }
            }),
            robot_mask: Some(ndarray::Array3::from_shape_fn((8, 64, 64), |(t, y, x)| inside(t, y, x))),
            ..Episode::blank(8)
        }
    }

    #[test]
    fn the_robot_moves_where_its_own_pixels_change() {
        assert_eq!(robot_moves(&episode()), [false, true, true, true, true, false, false, false]);
        assert_eq!(robot_moves(&Episode { robot_mask: None, ..episode() }), [false; 8]);
    }

    #[test]
    fn a_pixel_has_changed_beyond_the_threshold_only() {
        assert!(!changed([100, 100, 100], [116, 84, 100]));
        assert!(changed([100, 100, 100], [100, 83, 100]) && changed([0, 0, 0], [0, 0, 17]));
    }
}
