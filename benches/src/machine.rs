//! The machine that runs a measurement, and its other load.

use std::fmt;
use std::fs;
use std::time::Duration;

use rustix::thread::CpuSet;
use serde::Serialize;

/// Share of the processors in use by other processes beyond which a warning is due.
const BUSY: f64 = 0.10;

/// Duration of the observation.
const LOOK: Duration = Duration::from_millis(500);

/// The machine that a measurement runs on.
#[derive(Debug, Clone, Serialize)]
pub struct Machine {
    pub(super) processor: String,
    pub(super) cores: usize,
    pub(super) memory_bytes: u64,
    pub(super) system: String,
    pub(super) fipa: &'static str,
    /// Whether the program was built with optimization.
    pub(super) optimized: bool,
    /// Share of all processors that other processes used just before, 0 to 1.
    pub(super) busy: f64,
}

impl fmt::Display for Machine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let gibibytes = self.memory_bytes as f64 / f64::from(1 << 30);
        let Self {
            processor,
            cores,
            system,
            fipa,
            ..
        } = self;
        write!(
            f,
            "{processor}, {cores} cores, {gibibytes:.0} GiB, {system}, fipa {fipa}"
        )?;
        if self.optimized {
            Ok(())
        } else {
            f.write_str(" without optimization")
        }
    }
}

impl Machine {
    /// The first line of a result: the machine, and its load before the measurement.
    pub(crate) fn heading(&self) -> String {
        format!(
            "{self}; {:.0} % of the CPU time used by other processes before the start\n",
            self.busy * 100.0,
        )
    }

    /// Observes this machine for half a second, in which the caller should start nothing.
    pub async fn observe() -> Self {
        let before = Jiffies::read();
        tokio::time::sleep(LOOK).await;
        let busy = Jiffies::read().busy_since(before);
        let system = rustix::system::uname();
        Self {
            processor: processor(),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_bytes: memory(),
            system: format!(
                "{} {}",
                system.sysname().to_string_lossy(),
                system.release().to_string_lossy()
            ),
            fipa: env!("CARGO_PKG_VERSION"),
            optimized: !cfg!(debug_assertions),
            busy,
        }
    }

    /// Reasons not to trust the times that are measured on this machine now.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.busy > BUSY {
            warnings.push(format!(
                "the machine is busy: other processes use {:.0} % of its processors. Times are too \
                 long and scatter; ratios are affected less",
                self.busy * 100.0
            ));
        }
        if !self.optimized {
            warnings.push(
                "this command was built without optimization: cargo run --profile dist -- bench"
                    .to_owned(),
            );
        }
        if self.cores < 2 {
            warnings.push(
                "with one processor both ends of a path share it, and an end that spins \
                 delays the other"
                    .to_owned(),
            );
        }
        warnings
    }
}

/// The processors that this process may use.
pub(super) fn cores() -> Vec<usize> {
    let allowed = rustix::thread::sched_getaffinity(None);
    let allowed = allowed.unwrap_or_else(|_| CpuSet::new());
    (0..CpuSet::MAX_CPU)
        .filter(|core| allowed.is_set(*core))
        .collect()
}

/// Pins this process to one processor.
pub(super) fn pin_to(core: usize) -> Result<(), String> {
    let mut only = CpuSet::new();
    only.set(core);
    rustix::thread::sched_setaffinity(None, &only)
        .map_err(|error| format!("cannot use processor {core}: {error}"))
}

fn processor() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = text.lines().find_map(|line| {
        let (key, value) = line.split_once(':')?;
        matches!(key.trim(), "model name" | "Model" | "Hardware").then(|| value.trim().to_owned())
    });
    model.unwrap_or_else(|| std::env::consts::ARCH.to_owned())
}

fn memory() -> u64 {
    let text = fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let kibibytes = text.lines().find_map(|line| {
        let value = line.strip_prefix("MemTotal:")?;
        value.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()
    });
    kibibytes.unwrap_or(0) * 1024
}

/// Memory of a process that it shares with no other process, in bytes.
pub(super) fn private_memory(pid: u32) -> Result<u64, String> {
    let file = format!("/proc/{pid}/smaps_rollup");
    let text = fs::read_to_string(&file).map_err(|error| format!("{file}: {error}"))?;
    let kibibytes = |name| number_in(&text, name).unwrap_or(0);
    Ok((kibibytes("Private_Clean:") + kibibytes("Private_Dirty:")) * 1024)
}

/// Number of times that threads of a process have waited and were woken.
pub(super) fn wakeups(pid: u32) -> Result<u64, String> {
    let directory = format!("/proc/{pid}/task");
    let threads = fs::read_dir(&directory).map_err(|error| format!("{directory}: {error}"))?;
    // A thread may end meanwhile.
    let texts = threads
        .flatten()
        .filter_map(|thread| fs::read_to_string(thread.path().join("status")).ok());
    Ok(texts
        .filter_map(|text| number_in(&text, "voluntary_ctxt_switches:"))
        .sum())
}

/// The number in the line that begins with this name.
fn number_in(text: &str, name: &str) -> Option<u64> {
    let value = text.lines().find_map(|line| line.strip_prefix(name))?;
    value.split_whitespace().next()?.parse().ok()
}

/// Accumulated time of all processors, in clock ticks.
#[derive(Debug, Clone, Copy)]
struct Jiffies {
    all: u64,
    idle: u64,
}

impl Jiffies {
    fn read() -> Self {
        let text = fs::read_to_string("/proc/stat").unwrap_or_default();
        let first = text.lines().next().unwrap_or_default();
        let fields = first.split_whitespace().skip(1);
        let fields: Vec<u64> = fields.map_while(|field| field.parse().ok()).collect();
        // user nice system idle iowait irq softirq steal; guests are counted within user.
        Self {
            all: fields.iter().take(8).sum(),
            idle: fields.iter().skip(3).take(2).sum(),
        }
    }

    fn busy_since(self, before: Self) -> f64 {
        let all = self.all.saturating_sub(before.all).max(1) as f64;
        1.0 - self.idle.saturating_sub(before.idle) as f64 / all
    }
}
