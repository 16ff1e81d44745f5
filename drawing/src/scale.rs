//! From values to positions, and the marks of axes.

use crate::canvas::sane;

/// Least value of a logarithmic scale.
const LEAST: f64 = 1e-9;

/// Maps a range of values to a range of positions.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scale {
    from: f64,
    until: f64,
    low: f64,
    high: f64,
    logarithmic: bool,
}

impl Scale {
    /// Returns a linear scale. An empty range is widened.
    pub(crate) fn linear((from, until): (f64, f64), (low, high): (f64, f64)) -> Self {
        let (from, until) = (sane(from), sane(until));
        let least = (from.abs() * 1e-6).max(LEAST);
        let until = if until - from < least {
            from + 1.0
        } else {
            until
        };
        Self {
            from,
            until,
            low,
            high,
            logarithmic: false,
        }
    }

    /// Returns a logarithmic scale. An empty range is widened.
    pub(crate) fn logarithmic((from, until): (f64, f64), (low, high): (f64, f64)) -> Self {
        let from = sane(from).max(LEAST);
        Self {
            from,
            until: sane(until).max(from * 1.1),
            low,
            high,
            logarithmic: true,
        }
    }

    /// Returns the position of a value. It is within the scale.
    pub(crate) fn place(&self, value: f64) -> f64 {
        let value = sane(value).clamp(self.from, self.until);
        let share = match self.logarithmic {
            true => (value / self.from).ln() / (self.until / self.from).ln(),
            false => (value - self.from) / (self.until - self.from),
        };
        self.low + (self.high - self.low) * share
    }

    /// Returns the values of at most about `most` marks: round numbers, or powers of ten.
    pub(crate) fn marks(&self, most: f64) -> Vec<f64> {
        if self.logarithmic {
            let (first, last) = (
                self.from.log10().ceil() as i32,
                self.until.log10().floor() as i32,
            );
            return (first..=last).map(|power| 10_f64.powi(power)).collect();
        }
        self.marks_by(round_step((self.until - self.from) / most))
    }

    /// Returns the multiples of a step, at most about a hundred.
    pub(crate) fn marks_by(&self, step: f64) -> Vec<f64> {
        let first = (self.from / step - 1e-6).ceil();
        let count = ((self.until / step + 1e-6).floor() - first).clamp(0.0, 100.0) as i32;
        (0..=count)
            .map(|at| (first + f64::from(at)) * step)
            .collect()
    }
}

/// Rounds the distance of marks up to 1, 2 or 5 times a power of ten.
pub(crate) fn round_step(distance: f64) -> f64 {
    let power = 10_f64.powf(distance.max(LEAST).log10().floor());
    match distance / power {
        share if share <= 1.0 => power,
        share if share <= 2.0 => 2.0 * power,
        share if share <= 5.0 => 5.0 * power,
        _ => 10.0 * power,
    }
}

/// Writes a number of an axis without the error of its calculation.
pub(crate) fn number(value: f64) -> String {
    format!("{}", (value * 1e6).round() / 1e6 + 0.0)
}

/// Returns minimum and maximum of the finite values.
pub(crate) fn span(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let finite = values.filter(|value| value.is_finite()).map(sane);
    finite.fold(None, |span, value| {
        let (least, most) = span.unwrap_or((value, value));
        Some((value.min(least), value.max(most)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_are_round() {
        let scale = Scale::linear((0.0, 48.3), (0.0, 100.0));
        assert_eq!(scale.marks(6.0), [0.0, 10.0, 20.0, 30.0, 40.0]);
        assert_eq!(scale.place(48.3), 100.0);
        let scale = Scale::logarithmic((0.1, 1000.0), (0.0, 100.0));
        assert_eq!(scale.marks(6.0).len(), 5);
        assert!((scale.place(10.0) - 50.0).abs() < 1e-9);
    }

    #[test]
    fn strange_ranges_have_few_marks() {
        for (from, until) in [
            (f64::NAN, f64::NAN),
            (5.0, 5.0),
            (-1e300, 1e300),
            (1e9, 1e9 - 1.0),
        ] {
            let scale = Scale::linear((from, until), (0.0, 100.0));
            assert!(scale.marks(6.0).len() < 20);
            assert!(scale.place(f64::INFINITY).is_finite());
        }
    }
}
