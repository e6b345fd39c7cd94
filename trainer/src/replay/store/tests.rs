use super::*;
use ndarray::{Array3, Array4};

/// An episode whose rewards are `from`, `from + 1`, ...
fn episode(from: usize, steps: usize, masked: bool) -> Episode {
    Episode {
        image: Array4::from_shape_fn((steps, 64, 64, 3), |(t, ..)| (from + t) as u8),
        reward: (0..steps).map(|t| (from + t) as f32).collect(),
        robot_mask: masked.then(|| Array3::from_elem((steps, 64, 64), true)),
        ..Episode::blank(steps)
    }
}

#[test]
fn sequences_run_on_into_the_next_episode_and_say_so() {
    let mut replay = Replay::new(100);
    replay.add("reach", episode(0, 5, false)).unwrap();
    replay.add("reach", episode(5, 3, false)).unwrap();
    let mut starts = [0; 8];
    for number in 0..400 {
        let batch = replay.draw(2, 10, false, 7, number).unwrap();
        for row in 0..2 {
            let steps = &batch.reward[row * 10..][..10];
            let start = steps[0] as usize;
            starts[start] += 1;
            for (offset, reward) in steps.iter().enumerate() {
                let step = (start + offset) % 8;
                assert_eq!(*reward, step as f32);
                assert_eq!(batch.first[row * 10 + offset], step == 0 || step == 5);
                assert_eq!(batch.image[(row * 10 + offset) * 64 * 64 * 3], step as u8);
            }
        }
    }
    assert!(starts.iter().all(|count| (60..140).contains(count)), "not uniform: {starts:?}");
}

#[test]
fn every_other_sequence_begins_with_an_episode_where_that_is_asked_for() {
    let mut replay = Replay::new(100);
    for (from, steps) in [(0, 5), (5, 3), (8, 20)] {
        replay.add("reach", episode(from, steps, false)).unwrap();
    }
    let mut seen = [0; 28];
    for number in 0..300 {
        let batch = replay.draw_from(Starts::Episodes, 4, 3, false, 7, number).unwrap();
        for row in 0..4 {
            let start = batch.reward[row * 3] as usize;
            if row % 2 == 0 {
                assert!(batch.first[row * 3], "row {row} begins at {start}");
                seen[start] += 1;
            }
        }
        let anywhere = replay.draw(4, 3, false, 7, number).unwrap();
        assert_eq!((anywhere.number, batch.number), (number, number));
    }
    assert!([0, 5, 8].iter().all(|start| (160..240).contains(&seen[*start])), "{seen:?}");
}

#[test]
fn the_encoders_see_disturbed_pictures_where_there_are_some_and_the_decoder_draws_the_clean_ones() {
    let mut replay = Replay::new(100);
    let disturbed = |steps: usize| Array4::from_elem((steps, 64, 64, 3), 200);
    replay.add("a", Episode { disturbed: Some(disturbed(4)), ..episode(0, 4, false) }).unwrap();
    replay.add("a", episode(4, 4, false)).unwrap();
    assert!(replay.draw(2, 3, false, 7, 0).unwrap().seen.is_empty());
    let plain = replay.draw(8, 5, false, 7, 3).unwrap();
    replay.look(&LookSettings { disturbed: 1.0, jitter: 0.0 });
    let batch = replay.draw(8, 5, false, 7, 3).unwrap();
    assert_eq!((&batch.image, &batch.reward), (&plain.image, &plain.reward));
    for (step, reward) in batch.reward.iter().enumerate() {
        let expected = if *reward < 4.0 { 200 } else { *reward as u8 };
        assert_eq!(batch.seen[step * 64 * 64 * 3], expected);
    }
    replay.look(&LookSettings { disturbed: 0.0, jitter: 1.0 });
    let batch = replay.draw(8, 5, false, 7, 3).unwrap();
    assert_eq!(batch.image, plain.image);
    assert_ne!(batch.seen, batch.image);
}

#[test]
fn number_and_seed_decide_what_is_drawn() {
    let mut replay = Replay::new(1000);
    replay.add("reach", episode(0, 200, false)).unwrap();
    let draw = |seed, number| replay.draw(4, 3, false, seed, number).unwrap();
    assert_eq!(draw(1, 5), draw(1, 5));
    assert_ne!(draw(1, 5).reward, draw(1, 6).reward);
    assert_ne!(draw(1, 5).reward, draw(2, 5).reward);
}

#[test]
fn tasks_have_equal_shares_whatever_their_sizes() {
    let mut replay = Replay::new(1000);
    for (task, from, steps) in [("a", 0, 4), ("b", 50, 100), ("c", 200, 20)] {
        replay.add(task, episode(from, steps, false)).unwrap();
    }
    let mut shares = [0; 3];
    for number in 0..30 {
        for reward in replay.draw(4, 1, false, 0, number).unwrap().reward {
            shares[if reward < 50.0 {
                0
            } else if reward < 200.0 {
                1
            } else {
                2
            }] += 1;
        }
    }
    assert_eq!(shares, [40, 40, 40]);
}

#[test]
fn the_oldest_episodes_leave_when_it_is_full() {
    let mut replay = Replay::new(10);
    for from in [0, 4, 8] {
        replay.add("reach", episode(from, 4, false)).unwrap();
    }
    assert_eq!((replay.steps(), replay.episodes()), (8, 2));
    let rewards = replay.draw(8, 1, false, 0, 0).unwrap().reward;
    assert!(rewards.iter().all(|reward| *reward >= 4.0));
    assert!(matches!(replay.add("reach", episode(0, 11, false)), Err(ReplayError::TooLong { .. })));
}

#[test]
fn masks_come_only_from_episodes_that_have_them() {
    let mut replay = Replay::new(100);
    replay.add("reach", episode(0, 5, false)).unwrap();
    assert!(matches!(
        replay.masked().draw(1, 1, true, 0, 0),
        Err(ReplayError::NothingToDraw { masks: true })
    ));
    replay.add("reach", episode(5, 5, true)).unwrap();
    let batch = replay.masked().draw(3, 7, true, 0, 0).unwrap();
    assert!(batch.reward.iter().all(|reward| *reward >= 5.0));
    assert_eq!((batch.robot_mask.len(), batch.robot_mask[0]), (3 * 7 * 64 * 64, 1));
    assert!(matches!(replay.draw(9, 9, true, 0, 0), Err(ReplayError::NoMasks { .. })));
}

#[test]
fn numbers_that_are_not_finite_are_refused() {
    let mut replay = Replay::new(100);
    let mut poisoned = episode(0, 5, false);
    poisoned.reward[3] = f32::NAN;
    let error = replay.add("reach", poisoned).unwrap_err();
    assert!(error.to_string().contains("reward at step 3"), "{error}");
    assert_eq!(replay.episodes(), 0);
}
