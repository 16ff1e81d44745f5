//! A domain of its own with child processes, a log of their output, and the checks after each
//! round.

use std::collections::{BTreeSet, HashMap};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use fipa_testbed::{ChildGuard, ignored_test, private_memory};
use rustix::process::{Pid, Signal, kill_process};

use crate::process::{ROLE, Role};

/// Timeout of a hanging test.
const WATCHDOG: Duration = Duration::from_secs(90);

/// Polls until the condition holds. Panics after a timeout, with the given message.
pub(crate) fn wait_for(mut condition: impl FnMut() -> bool, message: impl FnOnce() -> String) {
    let began = Instant::now();
    while !condition() {
        assert!(began.elapsed() < WATCHDOG, "{}", message());
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// The letters in the output of all processes.
#[derive(Debug, Default)]
pub(crate) struct LetterLog {
    letters: HashMap<u64, Letter>,
    problems: Vec<String>,
}

#[derive(Debug, Default)]
struct Letter {
    to: String,
    outcome: Option<String>,
    taken_by: Option<u32>,
}

impl LetterLog {
    fn record(&mut self, tag: u32, line: &str) {
        let words: Vec<&str> = line.split(' ').collect();
        let id = words.get(1).and_then(|word| word.parse::<u64>().ok());
        match (words.as_slice(), id) {
            (["sent", _, to], Some(id)) => self.letters.entry(id).or_default().to = (*to).into(),
            (["out", _, outcome], Some(id)) => {
                let before = self
                    .letters
                    .entry(id)
                    .or_default()
                    .outcome
                    .replace((*outcome).into());
                if let Some(before) = before {
                    let problem = format!("{id:x} has two outcomes: {before}, {outcome}");
                    self.problems.push(problem);
                }
            }
            (["took", _], Some(id)) => {
                let before = self.letters.entry(id).or_default().taken_by.replace(tag);
                if let Some(before) = before {
                    let problem = format!("{id:x} was taken twice: by {before}, then by {tag}");
                    self.problems.push(problem);
                }
            }
            (["corrupt", ..], _) => self.problems.push(format!("{tag}: {line}")),
            _ => {}
        }
    }

    /// The letters of a process.
    fn of(&self, tag: u32) -> impl Iterator<Item = (u64, &Letter)> {
        let letters = self.letters.iter().map(|(id, letter)| (*id, letter));
        letters.filter(move |(id, _)| id >> 32 == u64::from(tag))
    }
}

/// A child process with a role.
pub(crate) struct TestProcess {
    pub(crate) tag: u32,
    pub(crate) name: String,
    child: ChildGuard,
    output: Arc<Mutex<Vec<String>>>,
}

impl TestProcess {
    pub(crate) fn signal(&self, signal: Signal) {
        let pid = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw);
        kill_process(pid.unwrap(), signal).unwrap();
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    pub(crate) fn has_printed(&self, line: &str) -> bool {
        self.output
            .lock()
            .unwrap()
            .iter()
            .any(|output| output == line)
    }

    /// The rest of the first output line that starts with this word.
    pub(crate) fn output_after(&self, word: &str) -> String {
        let output = self.output.lock().unwrap();
        let mut rest = output.iter().filter_map(|output| output.strip_prefix(word));
        rest.next().unwrap().trim_start().to_owned()
    }

    pub(crate) fn wait_until(&self, line: &str) {
        wait_for(
            || self.has_printed(line),
            || {
                format!(
                    "timed out waiting for {line:?} from {} ({})",
                    self.name, self.tag
                )
            },
        );
    }

    pub(crate) fn command(&mut self, line: &str) {
        writeln!(self.child.child().stdin.as_mut().unwrap(), "{line}").unwrap();
    }

    /// Quits the process in an orderly way.
    fn quit(&mut self) {
        self.command("quit");
        let mut ended = None;
        wait_for(
            || {
                ended = self.child.ended();
                ended.is_some()
            },
            || format!("timed out waiting for {} ({}) to quit", self.name, self.tag),
        );
        assert!(
            ended.unwrap().success(),
            "{} ended with {ended:?}",
            self.name
        );
    }
}

/// Maximum number of idle segments of a process.
const SEGMENTS: usize = 8;

/// Maximum number of segments of other processes that a process keeps open.
const OPEN_SEGMENTS: usize = 32;

/// The resources that the survivors of a domain use.
#[derive(Debug, PartialEq, Eq)]
struct ResourceUse {
    files: BTreeSet<PathBuf>,
    /// Total length of the files in shared memory, which is the upper bound of what they use. The
    /// actual use grows until every part of them has been used once.
    length: u64,
    descriptors: Vec<usize>,
}

/// A domain of its own with two processes that survive: `anchor` receives, and `pulse` sends.
pub(crate) struct Cluster {
    directory: tempfile::TempDir,
    domain: String,
    settings: String,
    log: Arc<Mutex<LetterLog>>,
    anchor: Option<TestProcess>,
    pulse: Option<TestProcess>,
    start: Option<ResourceUse>,
    /// The status pages of the survivors.
    pages: BTreeSet<PathBuf>,
    memory: u64,
    commands: u32,
    pub(crate) kills: usize,
}

impl Cluster {
    pub(crate) fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let domain = format!("crash-{}-{number}", std::process::id());
        let settings = [
            &format!("domain={domain}"),
            "discovery.mdns=false",
            "mts.transports=shm,unix,tcp",
            "mts.deadline=10s",
            "mts.queue=24",
        ];
        let mut cluster = Self {
            directory: tempfile::tempdir().unwrap(),
            settings: settings.join(" "),
            domain,
            log: Arc::default(),
            anchor: None,
            pulse: None,
            start: None,
            pages: BTreeSet::new(),
            memory: 0,
            commands: 0,
            kills: 0,
        };
        cluster.anchor = Some(cluster.start_as("anchor", "take", "nothing", ""));
        cluster.pulse = Some(cluster.start_as("pulse", "take", "nothing", ""));
        for survivor in [&cluster.anchor, &cluster.pulse] {
            survivor.as_ref().unwrap().wait_until("ready");
        }
        // Afterwards the survivors have allocated everything that they need.
        for size in crate::process::SIZES {
            cluster.exchange_letters(100, size);
            // Credits are sent in the other direction.
            let anchor = cluster.anchor.as_mut().unwrap();
            anchor.command(&format!("send back-{size} pulse 100 {size}"));
            anchor.wait_until(&format!("done back-{size}"));
        }
        let pages = cluster.files().into_iter();
        let is_page = |file: &PathBuf| file.extension().is_some_and(|end| end == "page");
        cluster.pages = pages.filter(is_page).collect();
        assert_eq!(cluster.pages.len(), 2);
        cluster.start = Some(cluster.resource_use());
        cluster.memory = cluster.private_memory();
        cluster
    }

    /// Starts a process with a unique name.
    pub(crate) fn start_process(&self, receives: &str, sends: &str, to: &str) -> TestProcess {
        self.start_as("", receives, sends, to)
    }

    /// Starts a process in another domain, which only gateways can reach, as on another host.
    pub(crate) fn start_remote(&self, receives: &str) -> TestProcess {
        let own = format!("domain={}", self.domain);
        let settings = self.settings.replacen(&own, &format!("{own}-far"), 1);
        self.start_with("", receives, "nothing", "", settings)
    }

    /// Starts a gateway of this domain with a static entry for the gateway at this address.
    pub(crate) fn start_gateway_to(&self, at: &str) -> TestProcess {
        let known = format!("discovery.static={{far=[\"tcp://{at}\"]}}");
        let settings = format!("{} {known}", self.settings);
        self.start_with("", "gateway", "nothing", "", settings)
    }

    /// Starts a process with this name.
    pub(crate) fn start_as(
        &self,
        name: &str,
        receives: &str,
        sends: &str,
        to: &str,
    ) -> TestProcess {
        self.start_with(name, receives, sends, to, self.settings.clone())
    }

    fn start_with(
        &self,
        name: &str,
        receives: &str,
        sends: &str,
        to: &str,
        settings: String,
    ) -> TestProcess {
        static NEXT: AtomicU32 = AtomicU32::new(1);
        let tag = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = if name.is_empty() {
            format!("process-{tag}")
        } else {
            name.to_owned()
        };
        let role = Role {
            name: name.clone(),
            tag,
            receives: receives.to_owned(),
            sends: sends.to_owned(),
            to: to.to_owned(),
            settings,
        };
        let mut command = ignored_test("process_entry");
        command
            .env(ROLE, role.to_words())
            .env("FIPA_RUNTIME_DIR", self.directory.path().join("run"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped());
        let mut child = ChildGuard::start(&mut command);
        let output = Arc::new(Mutex::new(Vec::new()));
        let lines = BufReader::new(child.child().stdout.take().unwrap());
        let (log, lines_seen) = (self.log.clone(), output.clone());
        std::thread::spawn(move || {
            let mut lines = lines;
            let mut line = String::new();
            // The last line of a killed process may be incomplete. It does not count.
            while lines.read_line(&mut line).is_ok_and(|len| len > 0) && line.ends_with('\n') {
                let words = line.trim_end();
                log.lock().unwrap().record(tag, words);
                let first = words.split(' ').next().unwrap_or_default();
                if matches!(first, "ready" | "at" | "loaned" | "done" | "bye") {
                    lines_seen.lock().unwrap().push(words.to_owned());
                }
                line.clear();
            }
        });
        TestProcess {
            tag,
            name,
            child,
            output,
        }
    }

    /// Sends SIGKILL and waits for the end.
    pub(crate) fn kill(&mut self, mut process: TestProcess) {
        process.child.kill();
        self.kills += 1;
    }

    /// Lets a process quit in an orderly way.
    pub(crate) fn quit_process(&self, mut process: TestProcess) {
        let drops = process.name.starts_with("process");
        if drops {
            process.command("drop");
        }
        process.quit();
    }

    /// Makes `pulse` send letters. Returns the token of the command, for
    /// [`wait_for_pulse`](Self::wait_for_pulse).
    pub(crate) fn send_from_pulse(&mut self, to: &str, count: usize, size: usize) -> String {
        self.commands += 1;
        let token = self.commands.to_string();
        let pulse = self.pulse.as_mut().unwrap();
        pulse.command(&format!("send {token} {to} {count} {size}"));
        token
    }

    pub(crate) fn wait_for_pulse(&self, token: &str) {
        self.pulse
            .as_ref()
            .unwrap()
            .wait_until(&format!("done {token}"));
    }

    /// Makes `pulse` send to this receiver until a letter arrives.
    pub(crate) fn wait_until_reached(&mut self, to: &str) {
        let began = Instant::now();
        let arrived = |log: &LetterLog| {
            let mut letters = log.letters.values();
            letters.any(|letter| letter.to == to && letter.taken_by.is_some())
        };
        while !arrived(&self.log.lock().unwrap()) {
            assert!(
                began.elapsed() < WATCHDOG,
                "timed out waiting for a letter to reach {to}"
            );
            let one = self.send_from_pulse(to, 1, 40);
            self.wait_for_pulse(&one);
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Number of letters that a process has sent, and number of those with outcomes.
    pub(crate) fn sent(&self, process: &TestProcess) -> (usize, usize) {
        let log = self.log.lock().unwrap();
        let letters = log.of(process.tag);
        letters.fold((0, 0), |(sent, known), (_, letter)| {
            (sent + 1, known + usize::from(letter.outcome.is_some()))
        })
    }

    /// Number of letters that a process has received.
    pub(crate) fn taken(&self, process: &TestProcess) -> usize {
        let log = self.log.lock().unwrap();
        let by = |letter: &&Letter| letter.taken_by == Some(process.tag);
        log.letters.values().filter(by).count()
    }

    /// Makes the survivors exchange letters, all of which must be delivered.
    fn exchange_letters(&mut self, count: usize, size: usize) {
        let pulse = self.pulse.as_ref().unwrap().tag;
        let before: BTreeSet<u64> = {
            let log = self.log.lock().unwrap();
            log.of(pulse).map(|(id, _)| id).collect()
        };
        let token = self.send_from_pulse("anchor", count, size);
        self.wait_for_pulse(&token);
        let log = self.log.lock().unwrap();
        let new = log.of(pulse).filter(|(id, _)| !before.contains(id));
        let mut seen = 0;
        for (id, letter) in new {
            assert_eq!(
                letter.outcome.as_deref(),
                Some("Delivered"),
                "{id:x} {letter:?}"
            );
            seen += 1;
        }
        assert_eq!(seen, count);
    }

    /// Checks the letters and resources after a round, in which all processes but the survivors
    /// ended.
    pub(crate) fn check(&mut self) {
        self.exchange_letters(4, 1500);
        let (anchor, pulse) = (self.anchor.as_ref().unwrap(), self.pulse.as_ref().unwrap());
        let open = |log: &LetterLog| {
            let open = log.of(pulse.tag).filter(|(_, letter)| {
                let delivered = letter.outcome.as_deref() == Some("Delivered");
                let missing = letter.to == "anchor" && letter.taken_by.is_none();
                letter.outcome.is_none() || delivered && missing
            });
            open.map(|(id, letter)| format!("{id:x} {letter:?}"))
                .collect::<Vec<_>>()
        };
        wait_for(
            || open(&self.log.lock().unwrap()).is_empty(),
            || format!("open letters: {:?}", open(&self.log.lock().unwrap())),
        );
        let mut log = self.log.lock().unwrap();
        for (id, letter) in &log.letters {
            let may_be_taken = ["Delivered", "Unconfirmed", "TimedOut"];
            let outcome = letter.outcome.as_deref();
            let denied = outcome.is_some_and(|outcome| !may_be_taken.contains(&outcome));
            assert!(!(denied && letter.taken_by.is_some()), "{id:x} {letter:?}");
            let lost = letter.to == "anchor"
                && outcome == Some("Delivered")
                && letter.taken_by != Some(anchor.tag);
            assert!(!lost, "{id:x} {letter:?}");
        }
        assert_eq!(log.problems, Vec::<String>::new());
        // A later line on a removed letter creates an entry without an outcome, which the next
        // check reports as open.
        log.letters.retain(|_, letter| letter.outcome.is_none());
        drop(log);
        // A process cleans up when it starts. The survivors clean up after processes that they
        // talked to.
        let new_process = self.start_process("take", "nothing", "");
        new_process.wait_until("ready");
        self.quit_process(new_process);
        let start = self.start.as_ref().unwrap();
        // Segments are kept for reuse, and those of the other survivor are kept open.
        let kept = SEGMENTS + OPEN_SEGMENTS;
        let most = start.descriptors.iter().map(|count| count + kept);
        let most: Vec<usize> = most.collect();
        // A gateway leaves its state to its successor, and processes leave the sum of their counters.
        let resource_use = || {
            let mut now = self.resource_use();
            let stays =
                |file: &Path| file.ends_with("gateway.state") || file.ends_with("ended.counts");
            now.files.retain(|file| !stays(file));
            now
        };
        let mut now = resource_use();
        wait_for(
            || {
                now = resource_use();
                now.files == start.files && now.length <= start.length && now.descriptors <= most
            },
            || {
                let now = resource_use();
                format!(
                    "left over: {:?}; missing: {:?}; length {} (from {}); descriptors {:?} (from {:?})",
                    now.files.difference(&start.files).collect::<Vec<_>>(),
                    start.files.difference(&now.files).collect::<Vec<_>>(),
                    now.length,
                    start.length,
                    now.descriptors,
                    start.descriptors
                )
            },
        );
    }

    /// Stops the survivors and checks that no file remains.
    pub(crate) fn close(mut self) {
        let grown = self.private_memory().saturating_sub(self.memory);
        assert!(
            grown < 32 << 20,
            "the survivors' memory has grown by {grown} bytes"
        );
        for mut survivor in [self.pulse.take(), self.anchor.take()]
            .into_iter()
            .flatten()
        {
            survivor.quit();
        }
        assert_eq!(self.files(), BTreeSet::new());
    }

    fn survivors(&self) -> impl Iterator<Item = &TestProcess> {
        [&self.anchor, &self.pulse].into_iter().flatten()
    }

    /// Whether this is a segment of a survivor, which may keep some.
    fn is_survivors_segment(&self, file: &Path) -> bool {
        let name = file.to_string_lossy();
        let life = name.strip_suffix(".content");
        let life = life.and_then(|name| name.rsplit_once('.'));
        let page = life.map(|(life, _)| PathBuf::from(format!("{life}.page")));
        page.is_some_and(|page| self.pages.contains(&page))
    }

    fn resource_use(&self) -> ResourceUse {
        let descriptors = |process: &TestProcess| {
            let descriptors = std::fs::read_dir(format!("/proc/{}/fd", process.pid()));
            descriptors.unwrap().count()
        };
        let (kept, files): (BTreeSet<_>, BTreeSet<_>) = self
            .files()
            .into_iter()
            .partition(|file| self.is_survivors_segment(file));
        assert!(kept.len() <= 2 * SEGMENTS, "{kept:?}");
        ResourceUse {
            length: files
                .iter()
                .filter(|file| file.starts_with("/dev/shm"))
                .filter_map(|file| std::fs::metadata(file).ok())
                .map(|metadata| metadata.len())
                .sum(),
            files,
            descriptors: self.survivors().map(descriptors).collect(),
        }
    }

    /// Memory of the survivors that is not shared, in bytes.
    fn private_memory(&self) -> u64 {
        let survivors = self.survivors();
        survivors.map(|it| private_memory(it.pid())).sum()
    }

    /// All files of the domain.
    fn files(&self) -> BTreeSet<PathBuf> {
        let mut found = BTreeSet::new();
        let prefix = format!("fipa_{}_", self.domain);
        let shared = std::fs::read_dir("/dev/shm")
            .into_iter()
            .flatten()
            .flatten();
        found.extend(
            shared
                .filter(|file| file.file_name().to_string_lossy().starts_with(&prefix))
                .map(|file| file.path()),
        );
        collect(&self.directory.path().join("run"), &mut found);
        found
    }
}

fn collect(directory: &Path, found: &mut BTreeSet<PathBuf>) {
    for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            collect(&entry.path(), found);
        }
        found.insert(entry.path());
    }
}
