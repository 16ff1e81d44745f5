//! Where actors play: a domain of its own, the processes in it, what they have said, and what must
//! be true of that.

use std::collections::{BTreeSet, HashMap};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::actor::{PART, Part};

/// What ends a test that hangs.
const WATCHDOG: Duration = Duration::from_secs(90);

/// Waits until something is so; after a long time gives up with what is said then.
pub(crate) fn wait_for(mut is_so: impl FnMut() -> bool, otherwise: impl FnOnce() -> String) {
    let began = Instant::now();
    while !is_so() {
        assert!(began.elapsed() < WATCHDOG, "{}", otherwise());
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// What all actors have said.
#[derive(Debug, Default)]
pub(crate) struct Ledger {
    letters: HashMap<u64, Letter>,
    problems: Vec<String>,
}

#[derive(Debug, Default)]
struct Letter {
    to: String,
    outcome: Option<String>,
    taken_by: Option<u32>,
}

impl Ledger {
    fn note(&mut self, tag: u32, line: &str) {
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
            (["torn", ..], _) => self.problems.push(format!("{tag}: {line}")),
            _ => {}
        }
    }

    /// The letters of an actor.
    fn of(&self, tag: u32) -> impl Iterator<Item = (u64, &Letter)> {
        let letters = self.letters.iter().map(|(id, letter)| (*id, letter));
        letters.filter(move |(id, _)| id >> 32 == u64::from(tag))
    }
}

/// A process that plays a part.
pub(crate) struct Actor {
    pub(crate) tag: u32,
    pub(crate) name: String,
    child: Child,
    said: Arc<Mutex<Vec<String>>>,
}

impl Actor {
    pub(crate) fn signal(&self, signal: Signal) {
        let pid = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw);
        kill_process(pid.unwrap(), signal).unwrap();
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    pub(crate) fn has_said(&self, line: &str) -> bool {
        self.said.lock().unwrap().iter().any(|said| said == line)
    }

    /// What it has said after this word.
    pub(crate) fn said_after(&self, word: &str) -> String {
        let said = self.said.lock().unwrap();
        let mut rest = said.iter().filter_map(|said| said.strip_prefix(word));
        rest.next().unwrap().trim_start().to_owned()
    }

    pub(crate) fn wait_until(&self, line: &str) {
        wait_for(
            || self.has_said(line),
            || format!("{} ({}) did not say {line:?}", self.name, self.tag),
        );
    }

    pub(crate) fn tell(&mut self, line: &str) {
        writeln!(self.child.stdin.as_mut().unwrap(), "{line}").unwrap();
    }

    /// Ends in order.
    fn quit(&mut self) {
        self.tell("quit");
        let mut ended = None;
        wait_for(
            || {
                ended = self.child.try_wait().unwrap();
                ended.is_some()
            },
            || format!("{} ({}) did not quit", self.name, self.tag),
        );
        assert!(
            ended.unwrap().success(),
            "{} ended with {ended:?}",
            self.name
        );
    }
}

impl Drop for Actor {
    fn drop(&mut self) {
        // Ended already, or the test has failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// How many segments for many a process has at most.
const SEGMENTS: usize = 8;

/// What the survivors of a domain use.
#[derive(Debug, PartialEq, Eq)]
struct Uses {
    files: BTreeSet<PathBuf>,
    /// How long the files in shared memory are together: what they can come to take at most. What
    /// they take grows until every part of them has been used once.
    length: u64,
    descriptors: Vec<usize>,
}

/// A domain of its own, with two actors that survive: `anchor` takes, and `pulse` sends.
pub(crate) struct Stage {
    directory: tempfile::TempDir,
    domain: String,
    settings: String,
    ledger: Arc<Mutex<Ledger>>,
    anchor: Option<Actor>,
    pulse: Option<Actor>,
    start: Option<Uses>,
    /// The pages of the survivors.
    pages: BTreeSet<PathBuf>,
    memory: u64,
    told: u32,
    pub(crate) kills: usize,
}

impl Stage {
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
        let mut stage = Self {
            directory: tempfile::tempdir().unwrap(),
            settings: settings.join(" "),
            domain,
            ledger: Arc::default(),
            anchor: None,
            pulse: None,
            start: None,
            pages: BTreeSet::new(),
            memory: 0,
            told: 0,
            kills: 0,
        };
        stage.anchor = Some(stage.enter_as("anchor", "take", "nothing", ""));
        stage.pulse = Some(stage.enter_as("pulse", "take", "nothing", ""));
        for survivor in [&stage.anchor, &stage.pulse] {
            survivor.as_ref().unwrap().wait_until("ready");
        }
        // Whatever the survivors will need, they have after this.
        for size in crate::actor::SIZES {
            stage.talk(100, size);
            // The other way go credits, at least.
            let anchor = stage.anchor.as_mut().unwrap();
            anchor.tell(&format!("send back-{size} pulse 100 {size}"));
            anchor.wait_until(&format!("done back-{size}"));
        }
        let pages = stage.files().into_iter();
        let is_page = |file: &PathBuf| file.extension().is_some_and(|end| end == "page");
        stage.pages = pages.filter(is_page).collect();
        assert_eq!(stage.pages.len(), 2);
        stage.start = Some(stage.uses());
        stage.memory = stage.private_memory();
        stage
    }

    /// A new actor of a name that only this one has.
    pub(crate) fn enter(&self, receives: &str, sends: &str, to: &str) -> Actor {
        self.enter_as("", receives, sends, to)
    }

    /// A new actor as if on another host: one that only gateways reach.
    pub(crate) fn enter_afar(&self, receives: &str) -> Actor {
        let own = format!("domain={}", self.domain);
        let settings = self.settings.replacen(&own, &format!("{own}-far"), 1);
        self.enter_with("", receives, "nothing", "", settings)
    }

    /// A gateway of this domain that knows the one at this address.
    pub(crate) fn enter_knowing(&self, at: &str) -> Actor {
        let known = format!("discovery.static={{far=[\"tcp://{at}\"]}}");
        let settings = format!("{} {known}", self.settings);
        self.enter_with("", "gateway", "nothing", "", settings)
    }

    /// A new actor of a given name.
    pub(crate) fn enter_as(&self, name: &str, receives: &str, sends: &str, to: &str) -> Actor {
        self.enter_with(name, receives, sends, to, self.settings.clone())
    }

    fn enter_with(
        &self,
        name: &str,
        receives: &str,
        sends: &str,
        to: &str,
        settings: String,
    ) -> Actor {
        static NEXT: AtomicU32 = AtomicU32::new(1);
        let tag = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = if name.is_empty() {
            format!("actor-{tag}")
        } else {
            name.to_owned()
        };
        let part = Part {
            name: name.clone(),
            tag,
            receives: receives.to_owned(),
            sends: sends.to_owned(),
            to: to.to_owned(),
            settings,
        };
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args([
                "--ignored",
                "--exact",
                "--nocapture",
                "a_process_of_its_own",
            ])
            .env(PART, part.to_words())
            .env("FIPA_RUNTIME_DIR", self.directory.path().join("run"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let said = Arc::new(Mutex::new(Vec::new()));
        let lines = BufReader::new(child.stdout.take().unwrap());
        let (ledger, heard) = (self.ledger.clone(), said.clone());
        std::thread::spawn(move || {
            let mut lines = lines;
            let mut line = String::new();
            // The last line of a killed process may be a part of one, which does not count.
            while lines.read_line(&mut line).is_ok_and(|len| len > 0) && line.ends_with('\n') {
                let words = line.trim_end();
                ledger.lock().unwrap().note(tag, words);
                let first = words.split(' ').next().unwrap_or_default();
                if matches!(first, "ready" | "at" | "loaned" | "done" | "bye") {
                    heard.lock().unwrap().push(words.to_owned());
                }
                line.clear();
            }
        });
        Actor {
            tag,
            name,
            child,
            said,
        }
    }

    /// SIGKILL.
    pub(crate) fn kill(&mut self, mut actor: Actor) {
        actor.child.kill().unwrap();
        actor.child.wait().unwrap();
        self.kills += 1;
    }

    /// Lets an actor end in order. All its letters must have outcomes then.
    pub(crate) fn dismiss(&self, mut actor: Actor) {
        let drops = actor.name.starts_with("actor");
        if drops {
            actor.tell("drop");
        }
        actor.quit();
    }

    /// Tells `pulse` to send letters, and does not wait for their outcomes, but says what to wait
    /// for.
    pub(crate) fn pulse_sends(&mut self, to: &str, count: usize, size: usize) -> String {
        self.told += 1;
        let token = self.told.to_string();
        let pulse = self.pulse.as_mut().unwrap();
        pulse.tell(&format!("send {token} {to} {count} {size}"));
        token
    }

    pub(crate) fn wait_for_pulse(&self, token: &str) {
        self.pulse
            .as_ref()
            .unwrap()
            .wait_until(&format!("done {token}"));
    }

    /// `pulse` sends to this one until one letter arrives.
    pub(crate) fn pulse_reaches(&mut self, to: &str) {
        let began = Instant::now();
        let arrived = |ledger: &Ledger| {
            let mut letters = ledger.letters.values();
            letters.any(|letter| letter.to == to && letter.taken_by.is_some())
        };
        while !arrived(&self.ledger.lock().unwrap()) {
            assert!(began.elapsed() < WATCHDOG, "{to} is not reached");
            let one = self.pulse_sends(to, 1, 40);
            self.wait_for_pulse(&one);
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// How many letters of an actor were sent, and how many of those have outcomes.
    pub(crate) fn sent(&self, actor: &Actor) -> (usize, usize) {
        let ledger = self.ledger.lock().unwrap();
        let letters = ledger.of(actor.tag);
        letters.fold((0, 0), |(sent, known), (_, letter)| {
            (sent + 1, known + usize::from(letter.outcome.is_some()))
        })
    }

    /// How many letters an actor has taken.
    pub(crate) fn taken(&self, actor: &Actor) -> usize {
        let ledger = self.ledger.lock().unwrap();
        let by = |letter: &&Letter| letter.taken_by == Some(actor.tag);
        ledger.letters.values().filter(by).count()
    }

    /// The survivors exchange letters, all of which arrive.
    fn talk(&mut self, count: usize, size: usize) {
        let pulse = self.pulse.as_ref().unwrap().tag;
        let before: BTreeSet<u64> = {
            let ledger = self.ledger.lock().unwrap();
            ledger.of(pulse).map(|(id, _)| id).collect()
        };
        let token = self.pulse_sends("anchor", count, size);
        self.wait_for_pulse(&token);
        let ledger = self.ledger.lock().unwrap();
        let new = ledger.of(pulse).filter(|(id, _)| !before.contains(id));
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

    /// What must be true after a round, when only the survivors are left.
    pub(crate) fn check(&mut self) {
        self.talk(4, 1500);
        let (anchor, pulse) = (self.anchor.as_ref().unwrap(), self.pulse.as_ref().unwrap());
        let open = |ledger: &Ledger| {
            let open = ledger.of(pulse.tag).filter(|(_, letter)| {
                let delivered = letter.outcome.as_deref() == Some("Delivered");
                let missing = letter.to == "anchor" && letter.taken_by.is_none();
                letter.outcome.is_none() || delivered && missing
            });
            open.map(|(id, letter)| format!("{id:x} {letter:?}"))
                .collect::<Vec<_>>()
        };
        wait_for(
            || open(&self.ledger.lock().unwrap()).is_empty(),
            || format!("open letters: {:?}", open(&self.ledger.lock().unwrap())),
        );
        let mut ledger = self.ledger.lock().unwrap();
        for (id, letter) in &ledger.letters {
            let may_be_taken = ["Delivered", "Unconfirmed", "TimedOut"];
            let outcome = letter.outcome.as_deref();
            let denied = outcome.is_some_and(|outcome| !may_be_taken.contains(&outcome));
            assert!(!(denied && letter.taken_by.is_some()), "{id:x} {letter:?}");
            let lost = letter.to == "anchor"
                && outcome == Some("Delivered")
                && letter.taken_by != Some(anchor.tag);
            assert!(!lost, "{id:x} {letter:?}");
        }
        assert_eq!(ledger.problems, Vec::<String>::new());
        // What comes late has nothing to be compared with, and is a problem of its own.
        ledger.letters.retain(|_, letter| letter.outcome.is_none());
        drop(ledger);
        // Who starts cleans up; so do the survivors, after those they know.
        let newcomer = self.enter("take", "nothing", "");
        newcomer.wait_until("ready");
        self.dismiss(newcomer);
        let start = self.start.as_ref().unwrap();
        // Segments for many are kept, and those of the other survivor kept open.
        let most = start.descriptors.iter().map(|count| count + 2 * SEGMENTS);
        let most: Vec<usize> = most.collect();
        let mut now = self.uses();
        wait_for(
            || {
                now = self.uses();
                now.files == start.files && now.length <= start.length && now.descriptors <= most
            },
            || {
                let now = self.uses();
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

    /// The end: after the survivors, nothing is left.
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

    fn survivors(&self) -> impl Iterator<Item = &Actor> {
        [&self.anchor, &self.pulse].into_iter().flatten()
    }

    /// Whether this is a segment for many of a survivor, of which each has some.
    fn is_kept(&self, file: &Path) -> bool {
        let name = file.to_string_lossy();
        let life = name.strip_suffix(".content");
        let life = life.and_then(|name| name.rsplit_once('.'));
        let page = life.map(|(life, _)| PathBuf::from(format!("{life}.page")));
        page.is_some_and(|page| self.pages.contains(&page))
    }

    fn uses(&self) -> Uses {
        let descriptors = |actor: &Actor| {
            let descriptors = std::fs::read_dir(format!("/proc/{}/fd", actor.pid()));
            descriptors.unwrap().count()
        };
        let (kept, files): (BTreeSet<_>, BTreeSet<_>) = self
            .files()
            .into_iter()
            .partition(|file| self.is_kept(file));
        assert!(kept.len() <= 2 * SEGMENTS, "{kept:?}");
        Uses {
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
        let of = |actor: &Actor| {
            let status = std::fs::read_to_string(format!("/proc/{}/status", actor.pid())).unwrap();
            let line = status
                .lines()
                .find_map(|line| line.strip_prefix("RssAnon:"));
            let kib: u64 = line
                .unwrap()
                .trim()
                .trim_end_matches(" kB")
                .parse()
                .unwrap();
            kib << 10
        };
        self.survivors().map(of).sum()
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
