/// How values lie along the y axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// Evenly.
    Linear,
    /// By their logarithm; values of 0 and less are left out.
    Log,
}

impl Scale {
    /// Where a value lies on the axis; none where it has no place.
    pub(super) fn place(self, value: f64) -> Option<f64> {
        let place = match self {
            Self::Linear => value,
            Self::Log => value.log10(),
        };
        place.is_finite().then_some(place)
    }

    /// The value at a place.
    pub(super) fn value(self, place: f64) -> f64 {
        match self {
            Self::Linear => place,
            Self::Log => 10f64.powf(place),
        }
    }

    /// Places of ticks between `low` and `high`, about `count` of them, at round values.
    pub(super) fn ticks(self, low: f64, high: f64, count: usize) -> Vec<f64> {
        if self == Self::Linear || high - low < 0.35 {
            // Within less than half a decade a logarithm is nearly straight.
            let ticks = round_values(self.value(low), self.value(high), count);
            return ticks.into_iter().filter_map(|value| self.place(value)).collect();
        }
        let decades = high.ceil() as i32 - low.floor() as i32;
        let mantissas: &[f64] = match decades {
            ..=2 => &[1.0, 2.0, 5.0],
            3 => &[1.0, 3.0],
            _ => &[1.0],
        };
        let every = (decades as usize).div_ceil(count.max(1)).max(1);
        (low.floor() as i32..=high.ceil() as i32)
            .step_by(every)
            .flat_map(|decade| mantissas.iter().map(move |mantissa| f64::from(decade) + mantissa.log10()))
            .filter(|place| (low..=high).contains(place))
            .collect()
    }
}

/// About `count` multiples of 1, 2 or 5 times a power of ten between `low` and `high`.
pub(super) fn round_values(low: f64, high: f64, count: usize) -> Vec<f64> {
    let raw = (high - low).max(f64::MIN_POSITIVE) / count.max(1) as f64;
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|x| x * power).find(|x| *x >= raw).unwrap_or(raw);
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|index| index as f64 * step).collect()
}

/// A number as short as it can be at a tick.
pub(super) fn tick_label(value: f64) -> String {
    let size = value.abs();
    if size < 1e-12 {
        return "0".to_owned();
    }
    if !(1e-3..1e5).contains(&size) {
        let text = format!("{value:.1e}");
        return text.replace(".0e", "e");
    }
    if size >= 1000.0 && (value / 100.0).fract().abs() < 1e-9 {
        let text = format!("{:.1}k", value / 1000.0);
        return text.replace(".0k", "k");
    }
    let text = format!("{value:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_stand_at_round_values_within_the_axis() {
        assert_eq!(round_values(0.0, 10.0, 5), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        let values = |low: f64, high: f64| -> Vec<String> {
            let ticks = Scale::Log.ticks(low.log10(), high.log10(), 6);
            ticks.into_iter().map(|place| tick_label(Scale::Log.value(place))).collect()
        };
        assert_eq!(values(15.0, 600.0), ["20", "50", "100", "200", "500"]);
        assert_eq!(values(0.9, 2000.0), ["1", "10", "100", "1k"]);
        assert_eq!(values(199.0, 301.0), ["200", "220", "240", "260", "280", "300"]);
    }

    #[test]
    fn labels_are_short() {
        let labels = [0.0, 0.05, 1.0, 2500.0, 250_000.0, 2e-5, -3.25].map(tick_label);
        assert_eq!(labels, ["0", "0.05", "1", "2.5k", "2.5e5", "2e-5", "-3.25"]);
    }

    #[test]
    fn a_logarithm_has_no_place_for_zero() {
        assert_eq!(Scale::Log.place(0.0), None);
        assert_eq!(Scale::Linear.place(0.0), Some(0.0));
    }
}
