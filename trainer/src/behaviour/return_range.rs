use candle_core::{Result, Tensor};
use serde::{Deserialize, Serialize};

use super::BehaviourSettings;

/// Average range of the returns, by which they are scaled (as in DreamerV3). Starts at 0.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReturnRange {
    /// Average of the lower quantile.
    pub low: f64,
    /// Average of the upper quantile.
    pub high: f64,
}

impl ReturnRange {
    /// Takes in a batch of returns of any shape.
    pub fn update(&mut self, returns: &Tensor, settings: &BehaviourSettings) -> Result<()> {
        let mut sorted = returns.flatten_all()?.to_vec1::<f32>()?;
        sorted.sort_by(f32::total_cmp);
        let share = settings.return_range_share;
        let mix = |old: f64, q: f64| (1.0 - share) * old + share * quantile(&sorted, q);
        *self = Self {
            low: mix(self.low, settings.return_range_low),
            high: mix(self.high, settings.return_range_high),
        };
        Ok(())
    }

    /// What returns and values are divided by: small returns are not blown up.
    #[must_use]
    pub fn scale(&self) -> f64 {
        (self.high - self.low).max(1.0)
    }
}

/// Quantile with linear interpolation between neighbours.
fn quantile(sorted: &[f32], q: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return 0.0 };
    let place = q * last as f64;
    let below = (place.floor() as usize).min(last);
    let (low, high) = (f64::from(sorted[below]), f64::from(sorted[(below + 1).min(last)]));
    low + (high - low) * (place - below as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    #[test]
    fn quantiles_fall_between_neighbours() {
        let sorted: Vec<f32> = (0..=10).map(|x| x as f32).collect();
        assert!((quantile(&sorted, 0.95) - 9.5).abs() < 1e-9);
        assert_eq!((quantile(&sorted, 0.0), quantile(&sorted, 1.0), quantile(&[3.0], 0.5)), (0.0, 10.0, 3.0));
    }

    #[test]
    fn the_scale_follows_large_ranges_slowly_and_never_falls_below_one() {
        let settings = BehaviourSettings::default();
        let mut range = ReturnRange::default();
        let returns = Tensor::new(&[0f32, 1000.0], &Device::Cpu).unwrap();
        range.update(&returns, &settings).unwrap();
        assert!((range.scale() - 9.0).abs() < 1e-6, "{range:?}");
        assert_eq!(ReturnRange { low: 0.0, high: 0.5 }.scale(), 1.0);
    }
}
