//! Warnings about what others do to us.

/// Warns the first time, the second, the fourth, the eighth …: what others do to us must not fill
/// our log.
pub(crate) fn warn_seldom(times_before: u64, what: std::fmt::Arguments<'_>) {
    let times = times_before.saturating_add(1);
    if times.is_power_of_two() {
        tracing::warn!(times, "{what}");
    } else {
        tracing::debug!(times, "{what}");
    }
}
