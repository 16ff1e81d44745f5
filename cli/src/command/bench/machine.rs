//! The machine that something is measured on, and whether it has anything else to do.

use std::fmt;
use std::fs;
use std::time::Duration;

use rustix::thread::CpuSet;
use serde::Serialize;

/// More than this share of the processors in use by others makes times doubtful.
const BUSY: f64 = 0.10;

/// How long the machine is looked at.
const LOOK: Duration = Duration::from_millis(500);

/// The machine, as it is told with every figure.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Machine {
    pub(super) processor: String,
    pub(super) cores: usize,
    pub(super) memory_bytes: u64,
    pub(super) system: String,
    pub(super) fipa: &'static str,
    /// Whether the command was built with optimisation.
    pub(super) optimised: bool,
    /// The share of all processors that others used just before.
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
        if self.optimised {
            Ok(())
        } else {
            f.write_str(" without optimization")
        }
    }
}

impl Machine {
    /// Looks at this machine for half a second, in which nothing of ours should be running.
    pub(super) async fn look() -> Self {
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
            optimised: !cfg!(debug_assertions),
            busy,
        }
    }

    /// Why times should not be trusted, if so.
    pub(super) fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.busy > BUSY {
            warnings.push(format!(
                "other processes use {:.0} % of the CPU time: times will be too long and scattered; \
                 ratios are less affected",
                self.busy * 100.0
            ));
        }
        if !self.optimised {
            warnings.push(
                "this command was built without optimization; run: cargo run --release -- bench"
                    .to_owned(),
            );
        }
        if self.cores < 2 {
            warnings.push(
                "this machine has one CPU: sender and receiver share it, and a spinning process delays \
                 the other one"
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

/// This process works on one processor from now on.
pub(super) fn keep_to(core: usize) -> Result<(), String> {
    let mut only = CpuSet::new();
    only.set(core);
    rustix::thread::sched_setaffinity(None, &only)
        .map_err(|error| format!("cannot pin the process to CPU {core}: {error}"))
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

/// Time of all processors so far, in units of the kernel.
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
