//! The launcher: it starts the processes, causes the fault, and collects the reports. It decides nothing.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::Write as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::PathBuf;
use std::process::Stdio;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::process::{Child, ChildStdin, Command};
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout_at};

use crate::part::{Failed, Mutant, Part, Platform, Role, Stop};
pub use crate::relay::Link;
use crate::relay::Relay;
use crate::report::{Claim, Report, now};
use crate::telling::told;
use crate::{Fault, PROTOCOL};

/// Maximum time for a process to start or end.
const STEP: Duration = Duration::from_secs(20);
/// Maximum time of a run: the attempts of the operator, each with its wait for answers, on a busy machine.
const RUN: Duration = Duration::from_secs(240);
/// Duration of the cut of the link.
const CUT: Duration = Duration::from_secs(10);
/// Duration of the stop of the master, longer than the lease.
const PAUSE: Duration = Duration::from_secs(6);

/// The hosts, each with its agents.
const HOSTS: [(&str, &[(&str, Role)]); 2] = [
    (
        "sherpa",
        &[
            ("sherpa", Role::Sherpa),
            ("payload_1", Role::Item),
            ("payload_2", Role::Item),
        ],
    ),
    (
        "crex",
        &[("crex", Role::Crex), ("operator", Role::Operator)],
    ),
];

/// The options of a run.
#[derive(Debug, Clone, Default)]
#[expect(clippy::exhaustive_structs, reason = "the caller writes each field")]
pub struct Options {
    /// The fault.
    pub fault: Option<Fault>,
    /// The seed of the world.
    pub seed: u64,
    /// The link between the hosts.
    pub link: Link,
    /// A defect that is built in.
    pub mutant: Option<Mutant>,
    /// The program that runs a [`Part`], and its arguments before the part.
    pub program: Vec<OsString>,
    /// The program of the items, if it is another one.
    pub item: Option<Vec<OsString>>,
    /// The program of the operator, if it is another one.
    pub operator: Option<Vec<OsString>>,
    /// Whether the first gateway has an HTTP listener. The run then waits for a line of standard input before its work, and
    /// before its end.
    pub dashboard: bool,
}

/// The result of a run.
#[derive(Debug)]
#[non_exhaustive]
pub struct Outcome {
    /// All reports, in the order of their times.
    pub reports: Vec<Report>,
    /// The claims that the checker found to be true.
    pub passed: Vec<String>,
    /// Those that are not.
    pub failed: Vec<String>,
}

impl Outcome {
    /// Returns the number of steps of guidance in a phase, `approach` or `align`.
    #[must_use]
    pub fn steps(&self, of: &str) -> usize {
        let is_step = |it: &&Report| matches!(&it.claim, Claim::Step { phase, .. } if phase == of);
        self.reports.iter().filter(is_step).count()
    }

    /// Returns the time from the first award of the operator to the end of its work, in seconds.
    #[must_use]
    pub fn seconds(&self) -> Option<f64> {
        let at = |is_it: fn(&Claim) -> bool| {
            let found = self.reports.iter().find(|it| is_it(&it.claim));
            found.map(|it| it.at)
        };
        let start = at(|claim| matches!(claim, Claim::Award { .. }))?;
        let end = at(|claim| matches!(claim, Claim::Finished { .. }))?;
        Some(end.saturating_sub(start) as f64 / 1e6)
    }
}

struct Process {
    child: Child,
    /// Dropping it asks the process to end.
    orders: Option<ChildStdin>,
}

struct Run<'a> {
    options: &'a Options,
    dir: TempDir,
    processes: BTreeMap<String, Process>,
    sender: mpsc::UnboundedSender<Report>,
    reports: mpsc::UnboundedReceiver<Report>,
    recording: std::fs::File,
    all: Vec<Report>,
    relay: Option<Relay>,
}

/// Runs the application once. `show` gets each report when it arrives.
///
/// # Errors
/// If a process cannot be started, or does not end.
pub async fn run(options: &Options, show: &mut dyn FnMut(&Report)) -> Result<Outcome, Failed> {
    // Private and with a random name: another user cannot create it first.
    let dir = tempfile::Builder::new()
        .prefix("dock-")
        .permissions(std::fs::Permissions::from_mode(0o700))
        .tempdir()?;
    let (sender, reports) = mpsc::unbounded_channel();
    let mut run = Run {
        options,
        recording: std::fs::File::create(dir.path().join("recording.json"))?,
        dir,
        processes: BTreeMap::new(),
        sender,
        reports,
        all: Vec::new(),
        relay: None,
    };
    let ran = run.scenario(show).await;
    let ended = run.end(show).await;
    let left = run.clear();
    ran?;
    ended?;
    let mut reports = run.all;
    reports.sort_by_key(|report| report.at);
    let (passed, failed) = reports
        .iter()
        .rev()
        .find_map(|report| match &report.claim {
            Claim::Checked { passed, failed } => Some((passed.clone(), failed.clone())),
            _ => None,
        })
        .ok_or("the checker has not reported")?;
    let (mut passed, mut failed) = (passed, failed);
    let check = "no files are left behind";
    match left.first() {
        None => passed.push(check.to_owned()),
        Some(first) => failed.push(format!("{check}: {} are, the first is {first}", left.len())),
    }
    Ok(Outcome {
        reports,
        passed,
        failed,
    })
}

impl Run<'_> {
    async fn scenario(&mut self, show: &mut dyn FnMut(&Report)) -> Result<(), Failed> {
        std::fs::write(self.dir.path().join("dock.scxml"), PROTOCOL)?;
        let fault = self.options.fault.map_or("none", Fault::as_str);
        self.claim(
            Claim::Started {
                fault: fault.to_owned(),
                seed: self.options.seed,
            },
            show,
        )?;
        self.start("world", Role::World, "", show).await?;
        let [(here, _), (there, _)] = HOSTS;
        let gateway = |host: &str| format!("{host}-mts");
        self.start(&gateway(here), Role::Gateway, here, show)
            .await?;
        let behind = self
            .address(&gateway(here), "tcp:")
            .and_then(|it| it.strip_prefix("tcp://")?.parse().ok())
            .ok_or("the gateway has no TCP address")?;
        self.relay = Some(Relay::start(behind, self.options.link).await?);
        self.start(&gateway(there), Role::Gateway, there, show)
            .await?;
        for (host, _) in HOSTS {
            self.start(&format!("{host}-watcher"), Role::Watcher, host, show)
                .await?;
        }
        let mut input = self.options.dashboard.then(Stop::default);
        self.wait_for_line(&mut input, "start", show).await?;
        if self.options.fault == Some(Fault::Rogue) {
            self.start("rogue", Role::Rogue, here, show).await?;
        }
        for (host, agents) in HOSTS {
            for (name, role) in agents {
                self.spawn(name, *role, host)?;
            }
        }
        let until = Instant::now() + RUN;
        let mut fault = self.options.fault;
        // The fault may last beyond the end of the work.
        while !self
            .all
            .iter()
            .any(|report| matches!(report.claim, Claim::Finished { .. }))
        {
            let report = self.next(until, show).await?;
            if let Some(cause) = fault
                && self.is_time(cause, &report)
            {
                fault = None;
                self.cause(cause, show).await?;
            }
        }
        self.spawn("checker", Role::Checker, here)?;
        while !matches!(self.next(until, show).await?.claim, Claim::Checked { .. }) {}
        self.wait_for_line(&mut input, "end", show).await
    }

    /// Waits for a line of standard input, or for its end. Returns at once without a dashboard.
    async fn wait_for_line(
        &mut self,
        input: &mut Option<Stop>,
        step: &str,
        show: &mut dyn FnMut(&Report),
    ) -> Result<(), Failed> {
        let Some(input) = input else { return Ok(()) };
        let step = step.to_owned();
        self.claim(Claim::Waits { step }, show)?;
        input.line().await;
        Ok(())
    }

    /// Whether the fault is to be caused after this report.
    fn is_time(&self, fault: Fault, report: &Report) -> bool {
        match (fault, &report.claim) {
            (Fault::LinkCut, Claim::Step { .. }) => {
                let steps = self
                    .all
                    .iter()
                    .filter(|it| matches!(it.claim, Claim::Step { .. }));
                steps.count() as u64 > self.options.seed % 30
            }
            (Fault::MasterStopped, Claim::Aligned { .. }) => true,
            // The second docking: the item is in the gripper.
            (Fault::ItemKilled, Claim::Step { phase, .. }) => {
                let is_second = self
                    .all
                    .iter()
                    .any(|it| matches!(it.claim, Claim::Docked { .. }));
                is_second && phase == "align"
            }
            _ => false,
        }
    }

    async fn cause(&mut self, fault: Fault, show: &mut dyn FnMut(&Report)) -> Result<(), Failed> {
        let until = |pause: Duration| Instant::now() + pause;
        match fault {
            Fault::ItemKilled => {
                let Some(item) = self.held_item() else {
                    return Err("no item is held".into());
                };
                if let Some(process) = self.processes.get_mut(&item) {
                    process.child.start_kill()?;
                }
                self.report(&format!("{item} is killed"), show)?;
            }
            Fault::LinkCut => {
                self.pass(false);
                self.report("the link passes nothing", show)?;
                self.until(until(CUT), show).await?;
                self.pass(true);
                self.report("the link passes again", show)?;
            }
            Fault::MasterStopped => {
                self.signal("sherpa", Signal::STOP)?;
                self.report("sherpa is stopped", show)?;
                self.until(until(PAUSE), show).await?;
                self.signal("sherpa", Signal::CONT)?;
                self.report("sherpa goes on", show)?;
                self.go_on("sherpa").await?;
            }
            Fault::Rogue | Fault::Cancel => {}
        }
        Ok(())
    }

    /// Returns the item in the gripper.
    fn held_item(&self) -> Option<String> {
        self.all.iter().find_map(|report| match &report.claim {
            Claim::Fetched { item, held: true } => Some(item.clone()),
            _ => None,
        })
    }

    fn pass(&self, passes: bool) {
        if let Some(relay) = &self.relay {
            relay.pass(passes);
        }
    }

    fn signal(&self, name: &str, signal: Signal) -> Result<(), Failed> {
        let process = self.processes.get(name).and_then(|it| it.child.id());
        let pid = process.and_then(|it| Pid::from_raw(i32::try_from(it).ok()?));
        Ok(kill_process(pid.ok_or("the process has ended")?, signal)?)
    }

    async fn go_on(&mut self, name: &str) -> Result<(), Failed> {
        let orders = self
            .processes
            .get_mut(name)
            .and_then(|it| it.orders.as_mut());
        Ok(orders
            .ok_or("the process has ended")?
            .write_all(b"go\n")
            .await?)
    }

    /// Starts a process, and waits until it is ready.
    async fn start(
        &mut self,
        name: &str,
        role: Role,
        host: &str,
        show: &mut dyn FnMut(&Report),
    ) -> Result<(), Failed> {
        self.spawn(name, role, host)?;
        let until = Instant::now() + STEP;
        loop {
            let report = self.next(until, show).await?;
            if report.by == name && report.claim == Claim::Ready {
                return Ok(());
            }
        }
    }

    fn spawn(&mut self, name: &str, role: Role, host: &str) -> Result<(), Failed> {
        let part = Part {
            platform: self.platform(role, host)?,
            role,
            name: name.to_owned(),
            set: self.settings(name, role, host),
            world: self.path("world"),
            recording: self.path("recording.json"),
            seed: self.options.seed,
            fault: self.options.fault,
            mutant: self.options.mutant,
        };
        let own = match role {
            Role::Item => self.options.item.as_ref(),
            Role::Operator => self.options.operator.as_ref(),
            _ => None,
        };
        let program = own.unwrap_or(&self.options.program);
        let (program, arguments) = program.split_first().ok_or("no program")?;
        let failed = |error| format!("cannot start {}: {error}", program.display());
        let mut command = Command::new(program);
        if role == Role::Item {
            // A module has little memory. Each thread of glibc would get an arena of its own.
            command.env("MALLOC_ARENA_MAX", "1");
        }
        let mut child = command
            .args(arguments)
            .arg(serde_json::to_string(&part)?)
            .env("FIPA_RUNTIME_DIR", self.dir.path())
            .env_remove("FIPA_CONFIG")
            .current_dir("/")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // Ctrl-C is sent to the launcher only, which ends its processes in order.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(failed)?;
        let orders = child.stdin.take();
        let output = child.stdout.take().ok_or("no standard output")?;
        let sender = self.sender.clone();
        let by = name.to_owned();
        tokio::spawn(async move {
            let mut lines = BufReader::new(output).lines();
            // A run ends with the report of the operator, so it cannot go on without one.
            let mut is_awaited = role == Role::Operator;
            while let Ok(Some(line)) = lines.next_line().await {
                let Ok(report) = serde_json::from_str::<Report>(&line) else {
                    continue;
                };
                let ends = matches!(report.claim, Claim::Finished { .. } | Claim::Broken { .. });
                is_awaited &= !ends;
                if sender.send(report).is_err() {
                    return;
                }
            }
            if is_awaited {
                let error = "the program has ended without the claim `finished`".to_owned();
                let claim = Claim::Broken { error };
                let at = now();
                // The run may have ended.
                let _ = sender.send(Report { at, by, claim });
            }
        });
        self.processes
            .insert(name.to_owned(), Process { child, orders });
        Ok(())
    }

    fn settings(&self, name: &str, role: Role, host: &str) -> Vec<String> {
        let protocol = self.path("dock.scxml");
        let is_platform = role == Role::Gateway && self.options.operator.is_some();
        let transports = if is_platform {
            "shm,unix,tcp,http"
        } else {
            "shm,unix,tcp"
        };
        let mut set = vec![
            format!("domain={}-{host}", self.name()),
            format!("mts.name={name}"),
            // No traffic leaves this machine, and the domains meet no others.
            "discovery.mdns=false".to_owned(),
            format!("mts.transports={transports}"),
            // Letters outlive a cut of the link.
            "mts.deadline=20s".to_owned(),
            format!("monitor.protocols=[{:?}]", protocol.display().to_string()),
        ];
        if role != Role::Rogue && self.options.mutant != Some(Mutant::EnforcementOff) {
            set.push("monitor.check=enforce".to_owned());
        }
        match self.relay.as_ref().filter(|_| role == Role::Gateway) {
            // It does not listen, so that all connections between the gateways pass the relay.
            Some(relay) => {
                let (here, _) = HOSTS[0];
                set.push(format!(
                    "discovery.static={{ {here}-mts = [\"tcp://{}\"] }}",
                    relay.address
                ));
                set.push("transport.tcp.listen=[]".to_owned());
            }
            None => set.push("transport.tcp.listen=127.0.0.1:0".to_owned()),
        }
        if is_platform {
            set.push("transport.http.listen=127.0.0.1:0".to_owned());
        }
        if role == Role::Gateway && host == HOSTS[0].0 && self.options.dashboard {
            set.push("http.listen=127.0.0.1:0".to_owned());
        }
        set
    }

    /// Returns the unique name of the run, with which the names of its domains begin.
    fn name(&self) -> String {
        let name = self.dir.path().file_name().unwrap_or_default();
        name.to_string_lossy().into_owned()
    }

    /// Removes the files in shared memory that processes have left. Returns their names.
    fn clear(&self) -> Vec<String> {
        let mark = format!("fipa_{}-", self.name());
        let files = std::fs::read_dir("/dev/shm")
            .into_iter()
            .flatten()
            .flatten();
        let ours = files.filter(|file| file.file_name().to_string_lossy().starts_with(&mark));
        let removed = ours.map(|file| {
            // Another process may have removed it.
            let _ = std::fs::remove_file(file.path());
            file.file_name().to_string_lossy().into_owned()
        });
        removed.collect()
    }

    fn path(&self, file: &str) -> PathBuf {
        self.dir.path().join(file)
    }

    /// Returns where a gateway listens with this transport, for example `http://127.0.0.1:7778/acc`.
    fn address(&self, gateway: &str, transport: &str) -> Option<&str> {
        let locations = self.all.iter().find_map(|report| match &report.claim {
            Claim::Listening { locations } if report.by == gateway => Some(locations),
            _ => None,
        })?;
        let location = locations.iter().find(|it| it.starts_with(transport))?;
        location.split('#').next()
    }

    /// Returns the gateway of the host as a platform, if the part is that of an operator of another program.
    fn platform(&self, role: Role, host: &str) -> Result<Option<Platform>, Failed> {
        if role != Role::Operator || self.options.operator.is_none() {
            return Ok(None);
        }
        let name = format!("{host}-mts");
        let address = self.address(&name, "http:");
        let address = address.ok_or("the gateway has no HTTP address")?.to_owned();
        Ok(Some(Platform { name, address }))
    }

    /// Records a fault.
    fn report(&mut self, what: &str, show: &mut dyn FnMut(&Report)) -> Result<(), Failed> {
        let what = what.to_owned();
        self.claim(Claim::Fault { what }, show)
    }

    /// Records a claim of the launcher.
    fn claim(&mut self, claim: Claim, show: &mut dyn FnMut(&Report)) -> Result<(), Failed> {
        let report = Report {
            at: now(),
            by: "launcher".to_owned(),
            claim,
        };
        self.record(report, show)
    }

    fn record(&mut self, report: Report, show: &mut dyn FnMut(&Report)) -> Result<(), Failed> {
        show(&report);
        let line = serde_json::to_string(&report)?;
        writeln!(self.recording, "{line}")?;
        self.all.push(report);
        Ok(())
    }

    /// Returns the next report, which is recorded.
    async fn next(
        &mut self,
        until: Instant,
        show: &mut dyn FnMut(&Report),
    ) -> Result<Report, Failed> {
        let Ok(report) = timeout_at(until, self.reports.recv()).await else {
            let lines: Vec<String> = self.all.iter().filter_map(told).collect();
            let last = lines
                .get(lines.len().saturating_sub(8)..)
                .unwrap_or_default();
            return Err(format!(
                "the run has not ended in time; the last reports:\n{}",
                last.join("\n")
            )
            .into());
        };
        let report = report.ok_or("no process runs")?;
        self.record(report.clone(), show)?;
        match &report.claim {
            Claim::Broken { error } => Err(format!("{}: {error}", report.by).into()),
            _ => Ok(report),
        }
    }

    /// Records the reports up to a time.
    async fn until(&mut self, until: Instant, show: &mut dyn FnMut(&Report)) -> Result<(), Failed> {
        while let Ok(Some(report)) = timeout_at(until, self.reports.recv()).await {
            self.record(report, show)?;
        }
        Ok(())
    }

    /// Ends all processes, the agents before their gateways and the world.
    async fn end(&mut self, show: &mut dyn FnMut(&Report)) -> Result<(), Failed> {
        let is_late = |name: &str| name.ends_with("-mts") || name == "world";
        let mut stuck = Vec::new();
        for late in [false, true] {
            let mut ending: Vec<_> = self
                .processes
                .iter_mut()
                .filter(|(name, _)| is_late(name) == late)
                .collect();
            for (_, process) in &mut ending {
                process.orders = None;
            }
            let until = Instant::now() + STEP;
            for (name, process) in ending {
                if timeout_at(until, process.child.wait()).await.is_err() {
                    stuck.push(name.clone());
                    process.child.kill().await?;
                }
            }
        }
        while let Ok(report) = self.reports.try_recv() {
            self.record(report, show)?;
        }
        match stuck.as_slice() {
            [] => Ok(()),
            names => Err(format!("these processes did not end: {}", names.join(", ")).into()),
        }
    }
}

/// Returns the program of a part with the name of this process, for a launcher of the same executable.
///
/// # Errors
/// If the path of the executable is unknown.
pub fn own_program(arguments: &[&str]) -> std::io::Result<Vec<OsString>> {
    let program = std::env::current_exe()?.into_os_string();
    Ok(std::iter::once(program)
        .chain(arguments.iter().map(OsString::from))
        .collect())
}
