//! The directory of one host, with real processes that start, end and are killed.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

mod common;

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Write as _};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{ChildStdin, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use common::{conforms, next, registration};
use fipa_sds::{
    Cancellation, Change, Directory, Entry, HostConfig, HostDirectory, HostError, MtsId, Reach,
    RegisterError, Role, Source,
};
use fipa_testbed::{ChildGuard, until_some_async};
use fipa_transport::counts::{Counts, Direction, LetterOutcome, Totals};
use fipa_transport::{DirectoryError, DomainUsers, Incarnation};

fn config(dir: &Path) -> HostConfig {
    HostConfig {
        brief: false,
        users: DomainUsers::This,
        dir: dir.to_owned(),
        mts: MtsId::new("mts", Incarnation::random()),
        gateway: false,
    }
}

fn open(dir: &Path) -> HostDirectory {
    HostDirectory::open(config(dir)).unwrap()
}

fn files(dir: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(dir).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.collect()
}

/// A path that does not exist yet, in a temporary directory.
fn fresh_dir() -> (tempfile::TempDir, PathBuf) {
    let parent = tempfile::tempdir().unwrap();
    let dir = parent.path().join("domain");
    (parent, dir)
}

/// An agent of another host, as its gateway publishes it.
fn of_another_host(name: &str) -> Entry {
    Entry {
        name: name.into(),
        agent_type: "sensor".to_owned(),
        incarnation: Incarnation::random(),
        locations: vec!["shm://gateway".parse().unwrap()],
        mts: MtsId::new("far-mts", Incarnation::random()),
        description: String::new(),
        registered: std::time::UNIX_EPOCH,
        source: Source::Mdns,
        reach: Reach::Local,
        peer: fipa_transport::PeerId::THIS_HOST,
        role: Role::Agent,
    }
}

/// Another process of the domain: this test binary again, running only [`child_process`].
struct Process {
    child: ChildGuard,
    commands: ChildStdin,
    answers: BufReader<ChildStdout>,
}

const DIR_VARIABLE: &str = "FIPA_SDS_TEST_DIR";

impl Process {
    fn start(dir: &Path) -> Self {
        let mut process = Self::start_unready(dir);
        assert_eq!(process.answer(), "ready");
        process
    }

    /// A process that gets no inotify instance, like the 119th of a user. Where this user may not
    /// create user namespaces, prints that, returns `None`, and fails if `CI=true`.
    fn start_without_inotify(dir: &Path) -> Option<Self> {
        let unshare = || {
            let mut unshare = Command::new("unshare");
            let limit = "echo 0 >/proc/sys/user/max_inotify_instances && exec \"$@\"";
            unshare.args(["--user", "--map-root-user", "sh", "-c", limit, "sh"]);
            unshare
        };
        if !unshare()
            .arg("true")
            .status()
            .is_ok_and(|status| status.success())
        {
            let in_ci = std::env::var("CI").as_deref() == Ok("true");
            assert!(!in_ci, "needs user namespaces");
            eprintln!("SKIPPED, not a success: needs user namespaces");
            return None;
        }
        let mut command = unshare();
        command.arg(std::env::current_exe().unwrap());
        let mut process = Self::run(command, dir);
        assert_eq!(process.answer(), "ready");
        Some(process)
    }

    fn start_unready(dir: &Path) -> Self {
        Self::run(Command::new(std::env::current_exe().unwrap()), dir)
    }

    fn run(mut command: Command, dir: &Path) -> Self {
        command
            .args(["--exact", "child_process", "--ignored", "--nocapture", "-q"])
            .env(DIR_VARIABLE, dir)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped());
        let mut child = ChildGuard::start(&mut command);
        Self {
            commands: child.child().stdin.take().unwrap(),
            answers: BufReader::new(child.child().stdout.take().unwrap()),
            child,
        }
    }

    fn tell(&mut self, command: &str) {
        writeln!(self.commands, "{command}").unwrap();
    }

    /// The next answer; other output of the test harness is skipped.
    fn answer(&mut self) -> String {
        let mut line = String::new();
        loop {
            line.clear();
            let read = self.answers.read_line(&mut line).unwrap();
            assert_ne!(read, 0, "the other process ended");
            if let Some((_, answer)) = line.trim_end().split_once("@@") {
                return answer.to_owned();
            }
        }
    }

    fn ask(&mut self, command: &str) -> String {
        self.tell(command);
        self.answer()
    }

    fn kill(&mut self) {
        self.child.kill();
    }
}

#[test]
#[ignore = "is the other process of the other tests"]
fn child_process() {
    let dir = PathBuf::from(std::env::var_os(DIR_VARIABLE).expect("started by another test"));
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _context = runtime.enter();
    let directory = open(&dir);
    println!("@@ready");
    let (mut listening, mut connected) = (Vec::new(), None);
    for line in std::io::stdin().lines() {
        let line = line.unwrap();
        let (command, name) = line.split_once(' ').unwrap_or((&line, ""));
        let answer = match command {
            "register" => match directory.register(registration(name)) {
                Ok(_) => "ok".to_owned(),
                Err(RegisterError::AlreadyRegistered { .. }) => "taken".to_owned(),
                Err(other) => other.to_string(),
            },
            "many" => {
                let one = |number| directory.register(registration(&format!("{name}_{number}")));
                let failed = (0..AGENTS).find_map(|number| one(number).err());
                failed.map_or("ok".to_owned(), |error| error.to_string())
            }
            "lookup" => directory.lookup(name).is_some().to_string(),
            // Unlike a lookup, it reads nothing: only the task updates it.
            "sees" => {
                let entries = directory.search(&fipa_sds::Query::all());
                entries.iter().any(|entry| &*entry.name == name).to_string()
            }
            "churn" => {
                for round in 0..25 {
                    let visitor = open(&dir);
                    visitor
                        .register(registration(&format!("{name}_{round}")))
                        .unwrap();
                    visitor.close().unwrap();
                }
                "ok".to_owned()
            }
            "listen" => {
                listening.push(directory.listen().unwrap());
                "ok".to_owned()
            }
            "connect" => {
                let sockets = directory.sockets();
                let found = runtime.block_on(until_some_async("a socket", || {
                    sockets.borrow().first().copied()
                }));
                connected = Some(directory.connect(found).unwrap());
                "ok".to_owned()
            }
            "hear" => {
                use rustix::net::{RecvFlags, recv};
                let mut buffer = [0; 8];
                let socket = connected.as_ref().unwrap();
                let (_, len) = runtime.block_on(until_some_async("a word", || {
                    recv(socket, &mut buffer, RecvFlags::empty()).ok()
                }));
                String::from_utf8(buffer[..len].to_vec()).unwrap()
            }
            "close" => {
                directory.close().unwrap();
                "ok".to_owned()
            }
            other => panic!("unknown command {other}"),
        };
        println!("@@{answer}");
    }
}

#[tokio::test]
async fn host_conforms() {
    let (_parent, dir) = fresh_dir();
    let (one, two) = (open(&dir), open(&dir));
    conforms(&one, &two).await;
    conforms(&two, &two).await;
}

#[tokio::test]
async fn the_directory_is_private_and_empty_after_the_last() {
    let (_parent, dir) = fresh_dir();
    let (one, two) = (open(&dir), open(&dir));
    let mode = std::fs::metadata(&dir).unwrap().permissions().mode();
    assert_eq!(mode & 0o7777, 0o700);
    one.register(registration("arm")).unwrap();
    two.register(registration("leg")).unwrap();
    for name in files(&dir) {
        let mode = std::fs::metadata(dir.join(name)).unwrap().permissions();
        assert_eq!(mode.mode() & 0o7777, 0o600);
    }
    one.close().unwrap();
    assert!(matches!(
        one.register(registration("foot")),
        Err(RegisterError::Closed)
    ));
    assert!(two.lookup("leg").is_some());
    drop(two);
    assert_eq!(files(&dir), Vec::<String>::new());
}

#[tokio::test]
async fn a_name_that_was_just_registered_is_found() {
    let (_parent, dir) = fresh_dir();
    let (one, two) = (open(&dir), open(&dir));
    for round in 0..200 {
        let name = format!("agent_{round}");
        one.register(registration(&name)).unwrap();
        // No await in between: the watcher's task has not run.
        assert!(two.lookup(&name).is_some(), "{name}");
    }
}

#[tokio::test]
async fn two_processes_cannot_have_one_name() {
    const NAMES: usize = 40;
    let (_parent, dir) = fresh_dir();
    let mut processes: Vec<_> = (0..4).map(|_| Process::start(&dir)).collect();
    for number in 0..NAMES {
        for process in &mut processes {
            process.tell(&format!("register agent_{number}"));
        }
    }
    let mut owners = BTreeMap::new();
    for process in &mut processes {
        for number in 0..NAMES {
            let owner: &mut usize = owners.entry(number).or_default();
            match process.answer().as_str() {
                "ok" => *owner += 1,
                answer => assert_eq!(answer, "taken"),
            }
        }
    }
    assert!(owners.values().all(|owners| *owners == 1), "{owners:?}");
    let directory = open(&dir);
    assert_eq!(directory.entries().len(), NAMES);
}

#[tokio::test]
async fn a_killed_process_loses_its_names_at_once() {
    let (_parent, dir) = fresh_dir();
    let mut victim = Process::start(&dir);
    let mut witness = Process::start(&dir);
    let directory = open(&dir);
    let mut watch = directory.watch();
    for name in ["arm", "leg"] {
        assert_eq!(victim.ask(&format!("register {name}")), "ok");
        assert!(matches!(next(&mut watch).await, Change::Joined(_)));
        assert_eq!(witness.ask(&format!("lookup {name}")), "true");
    }

    victim.kill();
    let mut departed_names = Vec::new();
    for _ in 0..2 {
        match next(&mut watch).await {
            Change::Left(entry) => departed_names.push(entry.name.to_string()),
            other => panic!("{other:?}"),
        }
    }
    departed_names.sort();
    assert_eq!(departed_names, ["arm", "leg"]);
    assert_eq!(directory.lookup("arm"), None);
    while witness.ask("lookup leg") == "true" {}
    assert_eq!(witness.ask("register arm"), "ok");
    // Two processes, two lock files; and the entries of the one with a registration.
    until_some_async("its files are removed", || {
        (files(&dir).len() == 4).then_some(())
    })
    .await;

    witness.kill();
    until_some_async("the other's files are removed", || {
        (files(&dir).len() == 2).then_some(())
    })
    .await;
    drop(directory);
    assert_eq!(files(&dir), Vec::<String>::new());
}

#[tokio::test]
async fn a_name_is_free_before_the_death_of_its_process_is_detected() {
    let (_parent, dir) = fresh_dir();
    let directory = open(&dir);
    for _ in 0..10 {
        let mut victim = Process::start(&dir);
        assert_eq!(victim.ask("register arm"), "ok");
        assert!(directory.lookup("arm").is_some());
        victim.kill();
        // No await in between: the watcher's task has not run.
        let again = registration("arm");
        directory.register(again.clone()).unwrap();
        directory.deregister("arm", again.incarnation).unwrap();
    }
}

#[tokio::test]
async fn the_end_of_every_process_is_reported() {
    let (_parent, dir) = fresh_dir();
    let directory = open(&dir);
    let mut departures = directory.departures();
    let departed = async |departures: &mut fipa_sds::Departures| {
        let watchdog = Duration::from_secs(60);
        tokio::time::timeout(watchdog, departures.next())
            .await
            .unwrap()
    };
    // Neither process has registered an agent.
    let mut killed = Process::start(&dir);
    killed.kill();
    assert!(departed(&mut departures).await);
    let mut leaves = Process::start(&dir);
    assert_eq!(leaves.ask("close"), "ok");
    assert!(departed(&mut departures).await);
    drop(directory);
    while departed(&mut departures).await {}
}

#[tokio::test]
async fn without_inotify_the_directory_is_polled() {
    let (_parent, dir) = fresh_dir();
    let Some(mut polling) = Process::start_without_inotify(&dir) else {
        return;
    };
    let directory = open(&dir);
    directory.register(registration("arm")).unwrap();
    while polling.ask("sees arm") == "false" {}
    assert_eq!(polling.ask("register leg"), "ok");
    assert!(directory.lookup("leg").is_some());
    let _listening = directory.listen().unwrap();
    assert_eq!(polling.ask("connect"), "ok");
    // A graceful end,
    drop(directory);
    while polling.ask("sees arm") == "true" {}
    // and ends that no other process reports, of more processes than one poll checks.
    let mut victims: Vec<Process> = (0..10).map(|_| Process::start(&dir)).collect();
    for (number, victim) in victims.iter_mut().enumerate() {
        assert_eq!(victim.ask(&format!("register agent_{number}")), "ok");
        while polling.ask(&format!("sees agent_{number}")) == "false" {}
    }
    victims.iter_mut().for_each(Process::kill);
    for number in 0..victims.len() {
        while polling.ask(&format!("sees agent_{number}")) == "true" {}
    }
    // The files of dead processes are removed: the lock, and two files of the process itself.
    until_some_async("their files are removed", || {
        (files(&dir).len() == 3).then_some(())
    })
    .await;
}

#[tokio::test]
async fn the_last_one_cleans_up_after_the_killed() {
    let (_parent, dir) = fresh_dir();
    let mut victims = [Process::start(&dir), Process::start(&dir)];
    for (number, victim) in victims.iter_mut().enumerate() {
        assert_eq!(victim.ask(&format!("register agent_{number}")), "ok");
    }
    victims.iter_mut().for_each(Process::kill);
    assert_ne!(files(&dir), Vec::<String>::new());
    let directory = open(&dir);
    assert_eq!(directory.lookup("agent_0"), None);
    assert_eq!(directory.entries().len(), 0);
    drop(directory);
    assert_eq!(files(&dir), Vec::<String>::new());
}

/// Number of agents that the command `many` registers.
const AGENTS: usize = 20;

#[tokio::test]
async fn many_processes_register_at_once_and_all_succeed() {
    const PROCESSES: usize = 50;
    let (_parent, dir) = fresh_dir();
    let directory = open(&dir);
    let mut processes: Vec<_> = (0..PROCESSES)
        .map(|_| Process::start_unready(&dir))
        .collect();
    for (number, process) in processes.iter_mut().enumerate() {
        process.tell(&format!("many agent_{number}"));
    }
    for process in &mut processes {
        assert_eq!(process.answer(), "ready");
        assert_eq!(process.answer(), "ok");
    }
    for process in 0..PROCESSES {
        for number in 0..AGENTS {
            let name = format!("agent_{process}_{number}");
            assert!(directory.lookup(&name).is_some(), "{name} is missing");
        }
    }
}

#[tokio::test]
async fn canceled_calls_end_without_the_lock_and_change_nothing() {
    let runtime = tokio::runtime::Handle::current();
    let (_parent, dir) = fresh_dir();
    let member = open(&dir);
    let before = files(&dir);
    let lock = std::fs::File::open(dir.join("lock")).unwrap();
    lock.lock().unwrap();
    let cancellation = Cancellation::new();
    std::thread::scope(|scope| {
        let joining = scope.spawn(|| {
            let _context = runtime.enter();
            HostDirectory::open_unless(config(&dir), &cancellation).map(drop)
        });
        let registering =
            scope.spawn(|| member.register_unless(registration("arm"), &cancellation));
        cancellation.cancel();
        assert!(matches!(joining.join().unwrap(), Err(HostError::Canceled)));
        match registering.join().unwrap() {
            Err(RegisterError::Failed(error)) => {
                let error = error.downcast_ref::<HostError>();
                assert!(matches!(error, Some(HostError::Canceled)));
            }
            other => panic!("{other:?}"),
        }
    });
    drop(lock);
    assert_eq!(files(&dir), before);
    assert!(member.entries().is_empty());
}

#[tokio::test]
async fn a_process_that_is_stopped_in_its_turn_does_not_block_others() {
    let (_parent, dir) = fresh_dir();
    let directory = open(&dir);
    // Holds the turn lock, as a stopped process would; the new process has had no turn yet.
    let stopped = std::fs::File::open(&dir).unwrap();
    stopped.lock().unwrap();
    let newcomer = open(&dir);
    newcomer.register(registration("other")).unwrap();
    assert!(directory.lookup("other").is_some());
    drop(stopped);
}

#[tokio::test]
async fn concurrent_joins_and_leaves_leave_no_files() {
    let (_parent, dir) = fresh_dir();
    let mut processes: Vec<_> = (0..3).map(|_| Process::start(&dir)).collect();
    for process in &mut processes {
        assert_eq!(process.ask("close"), "ok");
    }
    assert_eq!(files(&dir), Vec::<String>::new());
    // Without a remaining process, the lock file is also removed and created again.
    for (number, process) in processes.iter_mut().enumerate() {
        process.tell(&format!("churn visitor_{number}"));
    }
    for process in &mut processes {
        assert_eq!(process.answer(), "ok");
    }
    assert_eq!(files(&dir), Vec::<String>::new());
}

#[tokio::test]
async fn a_directory_that_is_not_private_is_refused() {
    let refused = |dir: &Path| match HostDirectory::open(config(dir)) {
        Err(HostError::Directory(DirectoryError::NotPrivate { intrusion, .. })) => {
            intrusion.to_string()
        }
        other => panic!("{other:?}"),
    };
    let parent = tempfile::tempdir().unwrap();
    let real = parent.path().join("real");
    std::fs::create_dir(&real).unwrap();
    std::fs::set_permissions(&real, PermissionsExt::from_mode(0o750)).unwrap();
    assert!(refused(&real).contains("750"));
    std::fs::set_permissions(&real, PermissionsExt::from_mode(0o700)).unwrap();
    drop(open(&real));

    let link = parent.path().join("link");
    symlink(&real, &link).unwrap();
    assert!(refused(&link).contains("link"));
    assert!(refused(&link.join("")).contains("link"), "trailing slash");
    let file = parent.path().join("file");
    std::fs::write(&file, "").unwrap();
    assert!(refused(&file).contains("file"));

    // Only root can change the owner of a directory.
    if rustix::process::geteuid().is_root() {
        std::os::unix::fs::chown(&real, Some(12345), None).unwrap();
        assert!(refused(&real).contains("12345"));
    }
}

#[tokio::test]
async fn planted_files_are_rejected_and_links_not_followed() {
    let (parent, dir) = fresh_dir();
    let directory = open(&dir);
    let mut other = Process::start(&dir);
    assert_eq!(other.ask("register arm"), "ok");
    assert!(directory.lookup("arm").is_some());
    let theirs = files(&dir)
        .into_iter()
        .find(|name| name.ends_with(".entries"));
    let theirs = dir.join(theirs.unwrap());
    let good = std::fs::read_to_string(&theirs).unwrap();

    let plant = |bytes: &str| {
        let temporary = parent.path().join("written");
        std::fs::write(&temporary, bytes).unwrap();
        std::fs::rename(&temporary, &theirs).unwrap();
    };
    let nonsense = [
        String::new(),
        "{".to_owned(),
        good.replace("\"version\":1", "\"version\":9"),
        good.replace("\"arm\"", "\"a\\nm\""),
        good.replace("\"arm\"", &format!("\"{}\"", "x".repeat(2000))),
        good.replace("shm://", "carrier-pigeon://"),
        good.replace("\"entries\":[", "\"entries\":[{},"),
    ];
    for bytes in nonsense {
        assert_ne!(bytes, good);
        plant(&bytes);
        until_some_async(&format!("refused: {bytes:.200}"), || {
            directory.known("arm").is_none().then_some(())
        })
        .await;
        plant(&good);
        until_some_async("believed", || directory.known("arm")).await;
    }

    // A pipe, and a symbolic link.
    std::fs::remove_file(&theirs).unwrap();
    rustix::fs::mknodat(
        rustix::fs::CWD,
        &theirs,
        rustix::fs::FileType::Fifo,
        rustix::fs::Mode::RWXU,
        0,
    )
    .unwrap();
    let newcomer = open(&dir);
    assert_eq!(newcomer.lookup("arm"), None);
    drop(newcomer);
    std::fs::remove_file(&theirs).unwrap();
    let precious = parent.path().join("precious");
    std::fs::write(&precious, &good).unwrap();
    symlink(&precious, &theirs).unwrap();
    let newcomer = open(&dir);
    assert_eq!(newcomer.lookup("arm"), None);
    drop(newcomer);
    assert_eq!(other.ask("register leg"), "ok");
    assert!(directory.lookup("leg").is_some());
    assert_eq!(std::fs::read_to_string(&precious).unwrap(), good);
}

/// Counters of a process that has sent a letter.
fn counted() -> Totals {
    let counts = Counts::default();
    counts.letter(Direction::Sent, None, LetterOutcome::Failed);
    counts.totals()
}

fn twice(values: &Totals) -> Totals {
    let mut sum = values.clone();
    sum.add(values);
    sum
}

#[tokio::test]
async fn planted_counters_keep_no_process_from_joining_and_are_not_counted() {
    let (parent, dir) = fresh_dir();
    let directory = open(&dir);
    let values = counted();
    drop(directory.create_counts(&values).unwrap());
    let precious = parent.path().join("precious");
    std::fs::write(&precious, values.to_page()).unwrap();
    symlink(&precious, dir.join("0000000000000001.counts")).unwrap();
    symlink(&precious, dir.join("ended.counts")).unwrap();
    std::fs::create_dir(dir.join("0000000000000002.counts")).unwrap();
    let (fifo, fifo_type) = (
        dir.join("0000000000000003.counts"),
        rustix::fs::FileType::Fifo,
    );
    rustix::fs::mknodat(rustix::fs::CWD, fifo, fifo_type, rustix::fs::Mode::RWXU, 0).unwrap();
    std::fs::write(dir.join("0000000000000004.counts"), [0xff; 100]).unwrap();

    let sums = directory.sum_counts().unwrap();
    assert_eq!(
        (sums.running, sums.ended),
        (values.clone(), Totals::default())
    );
    let newcomer = open(&dir);
    drop(newcomer.create_counts(&values).unwrap());
    let sums = directory.sum_counts().unwrap();
    assert_eq!(sums.running, twice(&values));
    drop(newcomer);
    let sums = directory.sum_counts().unwrap();
    assert_eq!((&sums.running, &sums.ended), (&values, &values));
    let planted = files(&dir)
        .into_iter()
        .filter(|name| name.starts_with("000000000000000"));
    assert_eq!(planted.collect::<Vec<_>>(), ["0000000000000002.counts"]);
    assert_eq!(std::fs::read(&precious).unwrap(), values.to_page());
}

#[test]
fn counters_of_an_ended_process_survive_a_full_disk() {
    fipa_testbed::isolated(
        "inside_counters_of_an_ended_process_survive_a_full_disk",
        &[],
    );
}

#[tokio::test]
#[ignore = "is run by the other test in namespaces of its own"]
async fn inside_counters_of_an_ended_process_survive_a_full_disk() {
    fipa_testbed::enter();
    let disk = fipa_testbed::directory().join("disk");
    std::fs::create_dir(&disk).unwrap();
    fipa_testbed::run(&format!(
        "mount -t tmpfs -o size=256k,mode=0700 tmpfs {}",
        disk.display()
    ));
    let dir = disk.join("domain");
    let directory = open(&dir);
    let values = counted();
    drop(directory.create_counts(&values).unwrap());
    let other = open(&dir);
    drop(other.create_counts(&values).unwrap());
    let mut filler = std::fs::File::create(disk.join("filler")).unwrap();
    while filler.write_all(&[0; 512]).is_ok() {}

    drop(other);
    let all = || {
        let sums = directory.sum_counts().unwrap();
        let mut all = sums.running;
        all.add(&sums.ended);
        all
    };
    assert_eq!(all(), twice(&values));
    // A process that joins does not need the space, either.
    drop(open(&dir));
    assert_eq!(all(), twice(&values));
    filler.set_len(0).unwrap();
    drop(open(&dir));
    let sums = directory.sum_counts().unwrap();
    assert_eq!((&sums.running, &sums.ended), (&values, &values));
    drop(directory);
    assert_eq!(files(&dir), Vec::<String>::new());
}

#[tokio::test]
async fn a_gateway_publishes_agents_of_other_hosts() {
    let (_parent, dir) = fresh_dir();
    let directory = open(&dir);
    let entry = of_another_host("camera");
    let denied = directory.publish_remote(&[Arc::new(entry.clone())], &[]);
    assert!(matches!(denied, Err(HostError::NoGateway)));

    let gateway = HostDirectory::open(HostConfig {
        brief: false,
        gateway: true,
        ..config(&dir)
    })
    .unwrap();
    let incarnation = gateway
        .register(registration("gateway"))
        .unwrap()
        .mts
        .incarnation;
    gateway
        .publish_remote(&[Arc::new(entry.clone())], &[])
        .unwrap();
    let found = directory.lookup("camera").unwrap();
    let expected = Entry {
        source: Source::Mdns,
        reach: Reach::Remote {
            gateway: incarnation,
        },
        ..entry.clone()
    };
    assert_eq!(*found, expected);
    assert_eq!(gateway.lookup("camera"), None);
    match directory.register(registration("camera")) {
        Err(RegisterError::AlreadyRegistered { holder }) => assert_eq!(*holder, expected),
        other => panic!("{other:?}"),
    }

    // Agents of this host precede those of the network, even if those state an earlier time.
    let local = directory.register(registration("arm")).unwrap();
    let impostor = Entry {
        name: "arm".into(),
        ..entry
    };
    let lost = vec![Arc::new(expected.clone())];
    gateway
        .publish_remote(&[Arc::new(impostor)], &lost)
        .unwrap();
    let third = open(&dir);
    assert_eq!(third.lookup("arm").unwrap().incarnation, local.incarnation);
    until_some_async("camera is withdrawn", || {
        directory.lookup("camera").is_none().then_some(())
    })
    .await;
    // Its gateway fell silent: the agent is no entry, but it is known.
    for process in [&directory, &third] {
        process.refresh();
        let lost = process.view().lost_agent("camera").unwrap();
        assert_eq!(lost.mts.shown(), "far-mts");
        assert_eq!(lost.locations, expected.locations);
        assert!(process.entries().iter().all(|it| *it.name != *"camera"));
    }
    drop(gateway);
    assert!(third.lookup("arm").is_some());
    until_some_async(
        "lost agents end with the gateway that publishes them",
        || {
            third.refresh();
            third.view().lost_agents().is_empty().then_some(())
        },
    )
    .await;
}

/// A sender that finds an agent neither listed nor lost takes it for one that does not exist.
#[tokio::test]
async fn an_agent_that_is_lost_and_returns_is_known_all_the_time() {
    const CHANGES: usize = 1000;
    let (_parent, dir) = fresh_dir();
    let gateway = HostDirectory::open(HostConfig {
        gateway: true,
        ..config(&dir)
    })
    .unwrap();
    gateway.register(registration("gateway")).unwrap();
    let camera = [Arc::new(of_another_host("camera"))];
    gateway.publish_remote(&camera, &[]).unwrap();
    let process = open(&dir);
    assert!(process.lookup("camera").is_some());
    std::thread::scope(|scope| {
        let changes = scope.spawn(|| {
            for change in 0..CHANGES {
                match change % 2 {
                    0 => gateway.publish_remote(&[], &camera).unwrap(),
                    _ => gateway.publish_remote(&camera, &[]).unwrap(),
                };
                process.refresh();
            }
        });
        while !changes.is_finished() {
            let view = process.view();
            assert!(view.named("camera").is_some() || view.lost_agent("camera").is_some());
        }
    });
}

#[tokio::test]
async fn processes_connect_to_the_sockets_they_find() {
    use rustix::net::{RecvFlags, SendFlags, SocketFlags, accept_with, recv, send};
    let (_parent, dir) = fresh_dir();
    // Longer than the path of a socket may be.
    let dir = dir.with_file_name("x".repeat(120));
    let (one, mut other) = (open(&dir), Process::start(&dir));
    let mut sockets = one.sockets();
    assert_eq!(*sockets.borrow_and_update(), []);
    assert_eq!(other.ask("listen"), "ok");
    sockets.changed().await.unwrap();
    let found = sockets.borrow_and_update().clone();
    assert_eq!(found.len(), 1);
    let _connected = one.connect(found[0]).unwrap();
    assert_eq!(
        open(&dir).sockets().borrow().clone(),
        found,
        "a new process sees it too"
    );
    let name = files(&dir)
        .into_iter()
        .find(|name| name.ends_with(".socket"));
    let mode = std::fs::metadata(dir.join(name.unwrap()))
        .unwrap()
        .permissions();
    assert_eq!(mode.mode() & 0o7777, 0o600);

    let listening = one.listen().unwrap();
    assert_eq!(other.ask("connect"), "ok");
    let accepted = accept_with(&listening, SocketFlags::CLOEXEC).unwrap();
    send(&accepted, b"hello", SendFlags::empty()).unwrap();
    assert_eq!(other.ask("hear"), "hello");

    other.kill();
    sockets.changed().await.unwrap();
    assert_eq!(*sockets.borrow_and_update(), []);
    assert!(one.connect(found[0]).is_err());
    let mut buffer = [0; 8];
    let (_, len) = recv(&accepted, &mut buffer, RecvFlags::empty()).unwrap();
    assert_eq!(len, 0, "the end of a process is the end of its connections");
    one.close().unwrap();
    assert_eq!(files(&dir), Vec::<String>::new());
}

#[tokio::test]
async fn connections_to_files_that_are_not_sockets_of_this_user_are_refused() {
    let (_parent, dir) = fresh_dir();
    let (one, two) = (open(&dir), open(&dir));
    let mut sockets = one.sockets();
    let _listening = two.listen().unwrap();
    sockets.changed().await.unwrap();
    let socket = sockets.borrow_and_update()[0];
    let name = files(&dir)
        .into_iter()
        .find(|name| name.ends_with(".socket"))
        .unwrap();
    let elsewhere = dir.join("elsewhere");
    std::fs::rename(dir.join(&name), &elsewhere).unwrap();
    symlink(&elsewhere, dir.join(&name)).unwrap();
    assert!(matches!(
        one.connect(socket),
        Err(HostError::NotPrivate { .. })
    ));
    std::fs::remove_file(dir.join(&name)).unwrap();
    std::fs::write(dir.join(&name), "").unwrap();
    assert!(matches!(
        one.connect(socket),
        Err(HostError::NotPrivate { .. })
    ));
}

#[tokio::test]
async fn the_removal_of_watched_files_is_reported() {
    let (parent, dir) = fresh_dir();
    let one = open(&dir);
    let within = parent.path().join("within");
    std::fs::create_dir(&within).unwrap();
    let [removed, moved] = ["removed", "moved"].map(|name| parent.path().join(name));
    let child = within.join("child");
    assert!(one.watch_files(std::slice::from_ref(&removed)).is_err());
    for file in [&removed, &moved, &child] {
        std::fs::write(file, "").unwrap();
    }
    let open_file = std::fs::File::open(&removed).unwrap();
    let watched = [removed.clone(), moved.clone(), within];
    one.watch_files(&watched).unwrap();
    // A second watch of the same file is not reported.
    one.watch_files(&watched).unwrap();
    let mut disturbed = Box::pin(one.disturbed());
    let quiet = tokio::time::timeout(Duration::from_millis(50), &mut disturbed);
    assert!(quiet.await.is_err());
    std::fs::remove_file(&removed).unwrap();
    disturbed.await;
    drop(open_file);
    std::fs::rename(&moved, parent.path().join("away")).unwrap();
    one.disturbed().await;
    std::fs::remove_file(&child).unwrap();
    one.disturbed().await;
    // The watches of the directory itself still work.
    notices_a_killed_process(&one, &dir).await;
}

/// Starts a process with an agent in this directory, kills it, and waits until the agent has left.
async fn notices_a_killed_process(one: &HostDirectory, dir: &Path) {
    let mut victim = Process::start(dir);
    assert_eq!(victim.ask("register foot"), "ok");
    assert!(one.lookup("foot").is_some());
    victim.kill();
    until_some_async("its end is noticed", || {
        one.known("foot").is_none().then_some(())
    })
    .await;
}

#[tokio::test]
async fn a_directory_that_was_removed_is_joined_again() {
    let (_parent, dir) = fresh_dir();
    let (one, two) = (open(&dir), open(&dir));
    let arm = registration("arm");
    one.register(arm.clone()).unwrap();
    two.register(registration("leg")).unwrap();
    assert!(one.is_there().unwrap());
    assert!(!one.rejoin().unwrap());
    for way in ["removed", "moved away", "one file removed"] {
        // The removal of a file is reported for each process.
        match way {
            "removed" => std::fs::remove_dir_all(&dir).unwrap(),
            "moved away" => std::fs::rename(&dir, dir.with_extension(way)).unwrap(),
            _ => {
                let mut files = files(&dir).into_iter();
                let entries = files.find(|name| name.ends_with(".entries"));
                std::fs::remove_file(dir.join(entries.unwrap())).unwrap();
            }
        }
        one.disturbed().await;
        let rejoined = [&one, &two].map(|directory| directory.rejoin().unwrap());
        let needed = if way == "one file removed" { 1 } else { 2 };
        assert_eq!(rejoined.iter().filter(|it| **it).count(), needed, "{way}");
        for directory in [&one, &two] {
            assert!(directory.is_there().unwrap(), "{way}");
            for name in ["arm", "leg"] {
                until_some_async(name, || directory.lookup(name).map(|_| ())).await;
            }
        }
        let newcomer = open(&dir);
        assert!(newcomer.lookup("arm").is_some() && newcomer.lookup("leg").is_some());
        newcomer.register(registration(way)).unwrap();
        assert!(one.lookup(way).is_some());
        drop(newcomer);
        // The watcher of the new directory.
        notices_a_killed_process(&one, &dir).await;
    }
    one.deregister("arm", arm.incarnation).unwrap();
    drop(one);
    drop(two);
    assert_eq!(files(&dir), Vec::<String>::new());
}

#[tokio::test]
async fn a_name_that_was_registered_meanwhile_is_lost() {
    let (_parent, dir) = fresh_dir();
    let directory = open(&dir);
    let ours = registration("arm");
    directory.register(ours.clone()).unwrap();
    directory.register(registration("leg")).unwrap();
    std::fs::remove_dir_all(&dir).unwrap();
    let newcomer = open(&dir);
    let theirs = registration("arm");
    newcomer.register(theirs.clone()).unwrap();
    assert!(directory.rejoin().unwrap());
    for directory in [&directory, &newcomer] {
        assert_eq!(
            directory.lookup("arm").unwrap().incarnation,
            theirs.incarnation
        );
        assert!(directory.lookup("leg").is_some());
    }
    assert!(directory.deregister("arm", ours.incarnation).is_err());
}

/// A late letter of an agent that has left makes it a contact on the host to which it moves.
#[tokio::test]
async fn a_contact_keeps_no_agent_from_its_name() {
    let (_parent, dir) = fresh_dir();
    let gateway = HostDirectory::open(HostConfig {
        brief: false,
        gateway: true,
        ..config(&dir)
    })
    .unwrap();
    let directory = open(&dir);
    let contact = Entry {
        name: "rover".into(),
        agent_type: String::new(),
        incarnation: Incarnation::random(),
        locations: vec!["shm://gateway".parse().unwrap()],
        mts: MtsId::unnamed(Incarnation::random()),
        description: String::new(),
        registered: std::time::UNIX_EPOCH,
        source: Source::Contact,
        reach: Reach::Local,
        peer: fipa_transport::PeerId::THIS_HOST,
        role: Role::Agent,
    };
    gateway.publish_remote(&[Arc::new(contact)], &[]).unwrap();
    assert_eq!(directory.lookup("rover").unwrap().source, Source::Contact);

    let rover = directory.register(registration("rover")).unwrap();
    let third = open(&dir);
    assert_eq!(
        third.lookup("rover").unwrap().incarnation,
        rover.incarnation
    );
    match third.register(registration("rover")) {
        Err(RegisterError::AlreadyRegistered { holder }) => {
            assert_eq!(holder.incarnation, rover.incarnation)
        }
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn changes_during_the_removal_of_the_directory_are_written_afterwards() {
    let (_parent, dir) = fresh_dir();
    let gateway = HostDirectory::open(HostConfig {
        brief: false,
        gateway: true,
        ..config(&dir)
    })
    .unwrap();
    let arm = registration("arm");
    let entry = gateway.register(arm.clone()).unwrap();
    std::fs::remove_dir_all(&dir).unwrap();
    let remote = Entry {
        name: "far".into(),
        ..Entry::clone(&entry)
    };
    gateway.publish_remote(&[Arc::new(remote)], &[]).unwrap();
    gateway.deregister("arm", arm.incarnation).unwrap();
    assert!(gateway.rejoin().unwrap());
    let newcomer = open(&dir);
    assert!(newcomer.lookup("far").is_some());
    assert!(newcomer.lookup("arm").is_none());
}

/// Returns an agent at this gateway.
fn remote(gateway: u64, number: u64, description: &str) -> Arc<Entry> {
    Arc::new(Entry {
        name: format!("{gateway}-agent-{number}").into(),
        agent_type: String::new(),
        incarnation: Incarnation::from_u64(gateway * 100_000 + number),
        locations: vec!["shm://0123456789abcdef#0123456789abcdef".parse().unwrap()],
        mts: MtsId::new("theirs", Incarnation::from_u64(gateway)),
        description: description.to_owned(),
        registered: std::time::UNIX_EPOCH,
        source: Source::Exchange,
        reach: Reach::Local,
        peer: fipa_transport::PeerId::THIS_HOST,
        role: Role::Agent,
    })
}

#[tokio::test]
async fn a_gateway_with_too_many_agents_hides_no_agent_of_others() {
    let (_parent, dir) = fresh_dir();
    let gateway = HostConfig {
        gateway: true,
        ..config(&dir)
    };
    let gateway = HostDirectory::open(gateway).unwrap();
    let directory = open(&dir);
    let quoted = "\"".repeat(Entry::MAX_DESCRIPTION);
    let liars = (1..=4).flat_map(|liar| (0..10_000).map(move |number| (liar, number)));
    let mut all: Vec<Arc<Entry>> = liars
        .map(|(liar, number)| remote(liar, number, &quoted))
        .collect();
    all.extend((0..50).map(|number| remote(9, number, "honest")));
    // An invalid entry is left out alone.
    all.push(remote(8, 0, "two\nlines"));
    all.push(remote(8, 1, "one line"));
    gateway.publish_remote(&all, &[]).unwrap();
    directory.refresh();
    let entries = directory.entries();
    let of = |gateway: u64| {
        let of = |entry: &&Arc<Entry>| entry.mts.incarnation == Incarnation::from_u64(gateway);
        entries.iter().filter(of).count()
    };
    assert_eq!((of(9), of(8)), (50, 1));
    let liars = [of(1), of(2), of(3), of(4)];
    assert!(
        liars.iter().all(|liar| (5_000..10_000).contains(liar)),
        "{liars:?}"
    );
    let largest = std::fs::read_dir(&dir).unwrap();
    let largest = largest
        .map(|file| file.unwrap().metadata().unwrap().len())
        .max();
    assert!(largest.unwrap() <= 64 << 20, "{largest:?}");
    // The gateway can still register agents of its own.
    gateway.register(registration("own")).unwrap();
    assert!(directory.lookup("own").is_some());
}

/// A process that is behind by more changes than the directory remembers reads all files. Its watcher does not run
/// meanwhile, because the test does not wait.
#[tokio::test]
async fn a_process_that_is_far_behind_finds_every_agent() {
    let (_parent, dir) = fresh_dir();
    let directory = open(&dir);
    let other = open(&dir);
    let third = open(&dir);
    directory.register(registration("here")).unwrap();
    directory.refresh();
    third.register(registration("third")).unwrap();
    for number in 0..600 {
        let name = format!("agent-{}", number % 7);
        let incarnation = Incarnation::from_u64(number + 1);
        let mut agent = registration(&name);
        agent.incarnation = incarnation;
        other.register(agent).unwrap();
        if number + 7 < 600 {
            other.deregister(&name, incarnation).unwrap();
        }
    }
    let expected: Vec<String> = (0..7).map(|number| format!("agent-{number}")).collect();
    for name in expected.iter().map(String::as_str).chain(["third"]) {
        assert!(directory.lookup(name).is_some(), "{name}");
    }
}

/// Returns the next changes of a watch, until one concerns this name.
async fn changes_until(watch: &mut fipa_sds::Watch, name: &str) -> Vec<Change> {
    let mut changes = Vec::new();
    loop {
        let change = next(watch).await;
        let singles = change.single();
        let is_last = singles.iter().any(|it| match it {
            Change::Joined(entry) | Change::Left(entry) | Change::Changed { after: entry, .. } => {
                *entry.name == *name
            }
            _ => false,
        });
        changes.extend(singles.to_vec());
        if is_last {
            return changes;
        }
    }
}

/// Returns the kinds of the changes, and the names that they concern.
fn kinds(changes: &[Change]) -> Vec<String> {
    let mut kinds: Vec<String> = changes
        .iter()
        .map(|change| match change {
            Change::Joined(entry) => format!("+{}", entry.name),
            Change::Left(entry) => format!("-{}", entry.name),
            Change::Changed { before, after } => {
                format!(
                    "{}>{} {}",
                    before.description, after.description, after.name
                )
            }
            other => format!("{other:?}"),
        })
        .collect();
    kinds.sort();
    kinds
}

#[tokio::test]
async fn watchers_receive_the_changes_of_agents_of_other_hosts() {
    let (_parent, dir) = fresh_dir();
    let gateway = HostConfig {
        gateway: true,
        ..config(&dir)
    };
    let gateway = HostDirectory::open(gateway).unwrap();
    let directory = open(&dir);
    let mut watch = directory.watch();
    let all: Vec<Arc<Entry>> = (0..5).map(|number| remote(2, number, "old")).collect();
    let end = |number| remote(3, number, "end");
    let publish = |agents: &[Arc<Entry>], ended| {
        let agents: Vec<Arc<Entry>> = agents.iter().cloned().chain([end(ended)]).collect();
        gateway.publish_remote(&agents, &[]).unwrap();
    };
    publish(&all, 1);
    let changes = changes_until(&mut watch, "3-agent-1").await;
    assert_eq!(changes.len(), 6, "{changes:?}");
    let view = directory.view();
    let changed = [
        remote(2, 0, "old"),
        remote(2, 1, "new"),
        remote(2, 7, "old"),
    ];
    publish(&changed, 2);
    let changes = changes_until(&mut watch, "3-agent-2").await;
    let expected = [
        "+2-agent-7",
        "+3-agent-2",
        "-2-agent-2",
        "-2-agent-3",
        "-2-agent-4",
        "-3-agent-1",
        "old>new 2-agent-1",
    ];
    assert_eq!(kinds(&changes), expected);
    // A view still has the agents of its time.
    assert_eq!(view.named("2-agent-1").unwrap().description, "old");
    assert_eq!(view.all().len(), 6);
    assert!(directory.known("2-agent-4").is_none());
    assert_eq!(directory.entries().len(), 4);
    let found = directory.by_incarnation(changed[2].incarnation).unwrap();
    assert_eq!(&*found.name, "2-agent-7");

    // An agent of this host hides one of another host of its name.
    let mut local = registration("2-agent-7");
    local.description = "local".to_owned();
    let other = open(&dir);
    gateway.publish_remote(&[end(3)], &[]).unwrap();
    changes_until(&mut watch, "3-agent-3").await;
    other.register(local.clone()).unwrap();
    directory.refresh();
    publish(&changed, 9);
    let changes = changes_until(&mut watch, "3-agent-9").await;
    let of_name = |change: &&Change| match change {
        Change::Joined(entry) | Change::Left(entry) | Change::Changed { after: entry, .. } => {
            *entry.name == *"2-agent-7"
        }
        _ => false,
    };
    let of_name: Vec<&Change> = changes.iter().filter(of_name).collect();
    assert!(
        matches!(&*of_name, [Change::Left(_), Change::Joined(entry)] if entry.description == "local")
            || matches!(&*of_name, [Change::Joined(entry)] if entry.description == "local"),
        "{changes:?}"
    );
    assert_eq!(directory.known("2-agent-7").unwrap().description, "local");
    assert!(
        directory
            .known_incarnation(changed[2].incarnation)
            .is_none()
    );
    assert_eq!(directory.entries().len(), 4);
    other.deregister("2-agent-7", local.incarnation).unwrap();
    let changes = changes_until(&mut watch, "2-agent-7").await;
    assert_eq!(kinds(&changes), ["local>old 2-agent-7"]);
    assert_eq!(directory.known("2-agent-7").unwrap().description, "old");
    // More changes than a watch holds are reported as one.
    let many: Vec<Arc<Entry>> = (0..2000).map(|number| remote(4, number, "")).collect();
    gateway.publish_remote(&many, &[]).unwrap();
    assert_eq!(next(&mut watch).await, Change::Lagged);
    assert_eq!(directory.entries().len(), 2000);
    drop(gateway);
    assert_eq!(next(&mut watch).await, Change::Lagged);
    assert_eq!(directory.entries().len(), 0);
}

#[tokio::test]
async fn of_several_agents_with_one_incarnation_the_last_one_published_has_it() {
    let (_parent, dir) = fresh_dir();
    let gateway = HostConfig {
        gateway: true,
        ..config(&dir)
    };
    let gateway = HostDirectory::open(gateway).unwrap();
    let directory = open(&dir);
    let of_same = |name: &str| {
        Arc::new(Entry {
            name: name.into(),
            ..Entry::clone(&remote(2, 5, ""))
        })
    };
    let claims = [of_same("a"), of_same("c"), of_same("b")];
    gateway.publish_remote(&claims, &[]).unwrap();
    let found = directory.by_incarnation(claims[0].incarnation).unwrap();
    assert_eq!(&*found.name, "b");
    for name in ["a", "b", "c"] {
        assert_eq!(&*directory.known(name).unwrap().name, name);
    }
    assert_eq!(
        HostDirectory::peek(&dir, DomainUsers::This).unwrap().len(),
        3
    );
}
