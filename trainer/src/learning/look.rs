use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// How the encoders see what is learned from. What the decoder is to draw stays as it is, so that a state says what is there and not how
/// it looks.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LookSettings {
    /// Share of the sequences that are seen through the episodes' `disturbed` pictures, where they have some.
    pub disturbed: f64,
    /// Share of the sequences whose colours are changed: brightness, contrast, saturation, each channel's gain.
    pub jitter: f64,
}

impl LookSettings {
    /// Whether every sequence is seen as it is.
    #[must_use]
    pub fn is_plain(&self) -> bool {
        *self == Self::default()
    }

    /// What is wrong, if anything.
    pub(crate) fn invalid(&self) -> Option<String> {
        let shares = [("disturbed", self.disturbed), ("jitter", self.jitter)];
        let (name, share) = shares.into_iter().find(|(_, share)| !(0.0..=1.0).contains(share))?;
        Some(format!("replay.look.{name} = {share}, expected a share, 0 to 1"))
    }

    /// The look of row `row` of batch `number`.
    #[must_use]
    pub fn drawn(&self, seed: u64, number: u64, row: usize) -> Look {
        let mut generator = ChaCha8Rng::seed_from_u64(seed.rotate_left(29) ^ row as u64);
        generator.set_stream(number);
        let disturbed = generator.random_bool(self.disturbed);
        let jitter = generator.random_bool(self.jitter).then(|| Jitter::drawn(&mut generator));
        Look { disturbed, jitter }
    }
}

/// How one sequence is seen.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Look {
    /// Through the episode's disturbed pictures, where there are some.
    pub disturbed: bool,
    /// With other colours.
    pub jitter: Option<Jitter>,
}

/// A change of colours, one for a whole sequence: `gain * (colour + saturation * (grey - colour)) + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Jitter {
    pub gain: [f32; 3],
    /// By channel, of 255.
    pub offset: [f32; 3],
    /// Towards grey, or away from it where below 0.
    pub grey: f32,
}

impl Jitter {
    fn drawn(generator: &mut impl Rng) -> Self {
        let brightness = generator.random_range(0.5..1.4);
        let offset = generator.random_range(-25.0..25.0);
        Self {
            gain: std::array::from_fn(|_| brightness * generator.random_range(0.75..1.25)),
            offset: std::array::from_fn(|_| offset + generator.random_range(-15.0..15.0)),
            grey: generator.random_range(-0.4..0.7),
        }
    }

    /// Changes pictures [..., 3 C] in place.
    pub fn apply(&self, pictures: &mut [u8]) {
        for pixel in pictures.as_chunks_mut::<3>().0 {
            let grey = pixel.iter().map(|x| f32::from(*x)).sum::<f32>() / 3.0;
            for (channel, value) in pixel.iter_mut().enumerate() {
                let colour = f32::from(*value);
                let colour =
                    self.gain[channel] * (colour + self.grey * (grey - colour)) + self.offset[channel];
                // From a float, `as` saturates.
                *value = colour.round() as u8;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_kept_and_number_and_row_decide() {
        let settings = LookSettings { disturbed: 0.25, jitter: 0.75 };
        let looks: Vec<Look> = (0..2000).map(|number| settings.drawn(5, number, 1)).collect();
        let disturbed = looks.iter().filter(|look| look.disturbed).count();
        let jittered = looks.iter().filter(|look| look.jitter.is_some()).count();
        assert!(
            (430..570).contains(&disturbed) && (1430..1570).contains(&jittered),
            "{disturbed} {jittered}"
        );
        assert_eq!(settings.drawn(5, 7, 1), looks[7]);
        assert_ne!(looks[7].jitter, looks[8].jitter);
        assert!((0..100).all(|row| LookSettings::default().drawn(5, 7, row) == Look::default()));
    }

    #[test]
    fn colours_change_and_stay_within_a_byte() {
        let jitter = Jitter { gain: [2.0, 1.0, 0.5], offset: [0.0, -10.0, 0.0], grey: 1.0 };
        let mut pictures = [200, 100, 0, 0, 0, 0];
        jitter.apply(&mut pictures);
        assert_eq!(pictures, [200, 90, 50, 0, 0, 0]);
        let away = Jitter { gain: [2.0; 3], offset: [0.0; 3], grey: 0.0 };
        let mut pictures = [200, 100, 0];
        away.apply(&mut pictures);
        assert_eq!(pictures, [255, 200, 0]);
    }

    #[test]
    fn a_share_beyond_one_is_refused_by_name() {
        let text = LookSettings { jitter: 1.5, ..LookSettings::default() }.invalid().unwrap();
        assert!(text.contains("replay.look.jitter = 1.5"), "{text}");
        assert_eq!(LookSettings { disturbed: 1.0, jitter: 0.0 }.invalid(), None);
    }
}
