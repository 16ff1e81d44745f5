//! Checks the requirements of shared memory.

use std::path::Path;

use bytesize::ByteSize;
use fipa_acl::ErrorChain;
use fipa_transport::Incarnation;
use fipa_transport_shm::{Inspection, ShmConfig, inspect};
use rustix::fs::inotify;
use rustix::process::geteuid;

use super::{Area, Check, Severity};
use crate::Config;
use crate::admin::open_files;
use crate::domain::files::DomainDir;

const AREA: Area = Area("shared memory");

/// Number of file descriptors that a process needs without peers.
const OWN_DESCRIPTORS: u64 = 40;

/// Number of file descriptors that a process needs for each process it exchanges letters with.
const DESCRIPTORS_PER_PEER: u64 = 10;

/// Bytes of shared memory that a connection between two processes takes.
const PER_CONNECTION: u64 = 1 << 20;

/// Number of peer processes below which the limit of descriptors is a warning.
const FEW_PEERS: u64 = 32;

/// Number of inotify instances (one per process) below which the limit is a warning.
const FEW_INSTANCES: u64 = 64;

/// The lowest user identifier that is not of a system user; systemd's RemoveIPC applies from here on.
const FIRST_REGULAR_USER: u32 = 1000;

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    let dir = DomainDir::of(config);
    let settings = ShmConfig {
        capacity: config.transport.shm.capacity,
        ..ShmConfig::new(dir.memory(), dir.prefix(), Incarnation::random())
    };
    match inspect(&settings) {
        Ok(found) => {
            checks.push(size(&found, config.transport.shm.capacity));
            checks.push(leftovers(&found));
            checks.push(exposed(&found));
        }
        Err(error) => checks.push(AREA.problem(
            "/dev/shm",
            Severity::Bad,
            ErrorChain(&error).to_string(),
            "mount it (mount -t tmpfs tmpfs /dev/shm), or remove shm from mts.transports",
        )),
    }
    checks.push(descriptors());
    checks.extend(instances());
    checks.extend(remove_ipc(Path::new("/"), geteuid().as_raw()));
}

fn size(found: &Inspection, capacity: u64) -> Check {
    const CHECK: &str = "size of /dev/shm";
    let [total, free, need] = [found.total, found.free, capacity].map(ByteSize::b);
    let connections = room(found, capacity) / PER_CONNECTION;
    let text = format!(
        "{total}, of which {free} are free; capacity of the domain: {need}; space for {connections} more \
         connections, after which letters use the next transport"
    );
    let advice = "enlarge it (mount -o remount,size=512M /dev/shm; for containers --shm-size=512m), or \
                  lower transport.shm.capacity";
    // With less space than this no process can start.
    if found.free < 2 << 20 {
        AREA.problem(CHECK, Severity::Bad, text, advice)
    } else if found.free.saturating_add(found.used) < capacity {
        AREA.problem(CHECK, Severity::Warning, text, advice)
    } else {
        AREA.fine(CHECK, text)
    }
}

/// Returns the number of bytes that the domain can still take.
fn room(found: &Inspection, capacity: u64) -> u64 {
    found.free.min(capacity.saturating_sub(found.used))
}

fn leftovers(found: &Inspection) -> Check {
    const CHECK: &str = "leftovers of ended processes";
    let text = format!(
        "processes that run: {}; ended processes that left files behind: {}; shared memory in use: {}",
        found.alive,
        found.dead,
        ByteSize::b(found.used)
    );
    if found.dead == 0 {
        return AREA.fine(CHECK, text);
    }
    let advice = "start any process of the domain, for example `fipa agents`: it removes the files \
                  within seconds; if they remain, look for processes of the domain that hang";
    AREA.problem(CHECK, Severity::Warning, text, advice)
}

fn exposed(found: &Inspection) -> Check {
    const CHECK: &str = "permissions in /dev/shm";
    match found.exposed.first() {
        None => AREA.fine(CHECK, "no file of this domain is accessible to other users"),
        Some(file) => AREA.problem(
            CHECK,
            Severity::Bad,
            format!("{} is accessible to other users", file.display()),
            format!("chmod 600 {}", file.display()),
        ),
    }
}

fn descriptors() -> Check {
    const CHECK: &str = "limit of open files";
    // That of other programs: a command that examines has raised its own.
    let limit = open_files::inherited().unwrap_or(u64::MAX);
    let peers = limit.saturating_sub(OWN_DESCRIPTORS) / DESCRIPTORS_PER_PEER;
    let text = format!("{limit}: enough to exchange letters with {peers} processes");
    let advice = format!(
        "set mts.raise_open_files, or raise it (ulimit -n, or LimitNOFILE= of the service): a process needs \
         {OWN_DESCRIPTORS}, and {DESCRIPTORS_PER_PEER} more for each process that it exchanges letters with"
    );
    match peers {
        0 => AREA.problem(CHECK, Severity::Bad, text, advice),
        few if few < FEW_PEERS => AREA.problem(CHECK, Severity::Warning, text, advice),
        _ => AREA.fine(CHECK, text),
    }
}

fn instances() -> Option<Check> {
    const FILE: &str = "/proc/sys/fs/inotify/max_user_instances";
    let limit: u64 = std::fs::read_to_string(FILE).ok()?.trim().parse().ok()?;
    // A trial, closed at the end of this function.
    let one_more = inotify::init(inotify::CreateFlags::CLOEXEC);
    Some(instances_left(limit, one_more.is_ok()))
}

fn instances_left(limit: u64, one_more: bool) -> Check {
    const CHECK: &str = "inotify instances";
    let advice = "raise the limit: sysctl fs.inotify.max_user_instances=512";
    if !one_more {
        let text = format!(
            "all {limit} are in use: a process without one polls the directory of the domain every \
             100 ms"
        );
        return AREA.problem(CHECK, Severity::Warning, text, advice);
    }
    let text = format!("{limit}; every process of this user needs one");
    if limit >= FEW_INSTANCES {
        return AREA.fine(CHECK, text);
    }
    AREA.problem(CHECK, Severity::Warning, text, advice)
}

/// Checks systemd's RemoveIPC; returns `None` if systemd does not run.
fn remove_ipc(root: &Path, user: u32) -> Option<Check> {
    const CHECK: &str = "systemd's RemoveIPC";
    root.join("run/systemd/system").exists().then(|| {
        if user < FIRST_REGULAR_USER {
            return AREA.fine(CHECK, "does not apply to system users such as this one");
        }
        if !removes(root) {
            return AREA.fine(CHECK, "off");
        }
        AREA.problem(
            CHECK,
            Severity::Warning,
            "on: systemd removes the shared memory of this user when the last session ends, even while \
             processes use it",
            "set RemoveIPC=no in /etc/systemd/logind.conf, or run the processes as a system user",
        )
    })
}

/// Whether logind removes shared memory. The last assignment counts; the default is yes
/// (logind.conf(5)).
fn removes(root: &Path) -> bool {
    let mut files = vec![
        root.join("usr/lib/systemd/logind.conf"),
        root.join("etc/systemd/logind.conf"),
    ];
    let mut later = Vec::new();
    for directory in ["usr/lib", "run", "etc"] {
        let directory = root.join(directory).join("systemd/logind.conf.d");
        let found = std::fs::read_dir(directory).into_iter().flatten().flatten();
        later.extend(found.map(|file| file.path()));
    }
    // Drop-ins of all directories are applied in the order of their file names.
    later.sort_by_key(|path| path.file_name().map(ToOwned::to_owned));
    files.extend(later);
    let texts = files
        .iter()
        .filter_map(|file| std::fs::read_to_string(file).ok());
    let mut enabled = true;
    for text in texts {
        for line in text.lines() {
            if let Some(value) = line.trim().strip_prefix("RemoveIPC=") {
                enabled = !matches!(value.trim(), "no" | "false" | "0" | "off" | "n" | "f");
            }
        }
    }
    enabled
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn the_last_assignment_of_remove_ipc_counts() {
        let root = tempfile::tempdir().unwrap();
        let root = root.path();
        assert_eq!(remove_ipc(root, 1000), None);
        fs::create_dir_all(root.join("run/systemd/system")).unwrap();
        fs::create_dir_all(root.join("etc/systemd/logind.conf.d")).unwrap();
        let severity = |user| remove_ipc(root, user).unwrap().severity;
        assert_eq!(severity(1000), Severity::Warning);
        assert_eq!(severity(0), Severity::Fine);
        let main = root.join("etc/systemd/logind.conf");
        fs::write(&main, "[Login]\n#RemoveIPC=yes\nRemoveIPC=no\n").unwrap();
        assert_eq!(severity(1000), Severity::Fine);
        let part = root.join("etc/systemd/logind.conf.d/50-robot.conf");
        fs::write(part, "[Login]\nRemoveIPC=yes\n").unwrap();
        assert_eq!(severity(1000), Severity::Warning);
    }

    #[test]
    fn a_lack_of_inotify_instances_names_the_sysctl() {
        assert_eq!(instances_left(128, true).severity, Severity::Fine);
        for lacking in [instances_left(128, false), instances_left(16, true)] {
            assert_eq!(lacking.severity, Severity::Warning);
            let advice = lacking.advice.unwrap();
            assert!(advice.contains("fs.inotify.max_user_instances"), "{advice}");
        }
    }

    #[test]
    fn a_small_or_full_file_system_is_reported() {
        let found = |total, free, used| Inspection {
            total,
            free,
            used,
            ..Inspection::default()
        };
        let severity = |found| size(&found, 256 << 20).severity;
        assert_eq!(severity(found(1 << 30, 1 << 29, 0)), Severity::Fine);
        assert_eq!(severity(found(64 << 20, 64 << 20, 0)), Severity::Warning);
        assert_eq!(severity(found(1 << 30, 1 << 20, 0)), Severity::Bad);
        // Memory that the domain has taken already counts as usable by it.
        assert_eq!(
            severity(found(300 << 20, 100 << 20, 200 << 20)),
            Severity::Fine
        );
    }

    #[test]
    fn files_open_to_other_users_and_leftovers_are_reported() {
        let fine = Inspection::default();
        assert_eq!(
            (leftovers(&fine).severity, exposed(&fine).severity),
            (Severity::Fine, Severity::Fine)
        );
        let found = Inspection {
            dead: 2,
            exposed: vec!["/dev/shm/x".into()],
            ..Inspection::default()
        };
        assert_eq!(
            (leftovers(&found).severity, exposed(&found).severity),
            (Severity::Warning, Severity::Bad)
        );
        assert!(
            exposed(&found)
                .advice
                .unwrap()
                .contains("chmod 600 /dev/shm/x")
        );
    }
}
