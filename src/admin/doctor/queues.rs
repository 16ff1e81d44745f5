//! Checks the memory that waiting letters can take.

use std::fs;

use bytesize::ByteSize;

use super::{Area, Check, Severity};
use crate::Config;

const AREA: Area = Area("queues");

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    let available = fs::read_to_string("/proc/meminfo");
    let available = available.ok().and_then(|text| available_in(&text));
    checks.push(queues(config, available));
}

fn queues(config: &Config, available: Option<u64>) -> Check {
    const CHECK: &str = "memory of waiting letters";
    let bytes = config.mts.queue_bytes;
    let per_agent = format!(
        "up to {} letters or {} wait for each agent",
        config.mts.queue,
        ByteSize::b(bytes)
    );
    match available {
        Some(available) if available < bytes => AREA.problem(
            CHECK,
            Severity::Warning,
            format!(
                "{per_agent}, but only {} of memory is available",
                ByteSize::b(available)
            ),
            "lower mts.queue_bytes, so that the queue of one slow agent cannot take all memory",
        ),
        _ => AREA.fine(CHECK, per_agent),
    }
}

/// Returns the bytes of available memory from the text of `/proc/meminfo`.
fn available_in(meminfo: &str) -> Option<u64> {
    let line = meminfo
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kib.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_queue_larger_than_available_memory_is_a_warning() {
        let config = Config::for_host("sherpa");
        assert_eq!(queues(&config, None).severity, Severity::Fine);
        assert_eq!(queues(&config, Some(1 << 30)).severity, Severity::Fine);
        let small = queues(&config, Some(1 << 20));
        assert_eq!(small.severity, Severity::Warning);
        assert!(small.found.contains("64.0 MiB"), "{}", small.found);
    }

    #[test]
    fn available_memory_is_read() {
        let text = "MemTotal:  100 kB\nMemAvailable:   12 kB\n";
        assert_eq!(available_in(text), Some(12 * 1024));
        assert_eq!(available_in("MemAvailable: x kB"), None);
        assert_eq!(available_in(""), None);
    }
}
