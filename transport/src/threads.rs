//! Threads for work that blocks.
//!
//! A limit on threads is an error here, which names the limit. tokio's `spawn_blocking` panics when the system
//! refuses its first thread, so this project does not use it.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};

/// Maximum wait until the kernel has removed threads that have ended.
const REMOVAL_TIMEOUT: Duration = Duration::from_secs(1);

/// Maximum number of levels of control groups that are examined.
const MAX_GROUPS: usize = 64;

/// The error if the system refuses another thread.
#[derive(Debug, thiserror::Error)]
#[error("cannot start another thread: {limit}")]
pub struct ThreadError {
    limit: String,
    source: io::Error,
}

impl ThreadError {
    fn new(source: io::Error) -> Self {
        Self {
            limit: limit(Path::new("/")),
            source,
        }
    }
}

impl From<ThreadError> for io::Error {
    fn from(error: ThreadError) -> Self {
        Self::new(error.source.kind(), error)
    }
}

/// The number of threads of [`spawn`] that run.
static RUNNING: Mutex<usize> = Mutex::new(0);
static ENDED: Condvar = Condvar::new();

/// One of the [`RUNNING`] threads.
struct Running;

impl Running {
    fn begin() -> Self {
        *RUNNING.lock() += 1;
        Self
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        *RUNNING.lock() -= 1;
        ENDED.notify_all();
    }
}

/// Runs work on a thread of its own.
///
/// # Errors
/// If the system refuses another thread. The work is dropped then.
pub fn spawn(work: impl FnOnce() + Send + 'static) -> Result<(), ThreadError> {
    let running = Running::begin();
    let builder = thread::Builder::new().name("fipa-blocking".to_owned());
    let started = builder.spawn(move || {
        let _running = running;
        work();
    });
    started.map(drop).map_err(ThreadError::new)
}

/// Waits until all threads of [`spawn`] have ended, or until the timeout.
pub fn wait(timeout: Duration) {
    let deadline = Instant::now() + timeout;
    let mut running = RUNNING.lock();
    while *running > 0 && !ENDED.wait_until(&mut running, deadline).timed_out() {}
}

/// Checks that this process can start this number of threads, for code that panics when it cannot, such as the
/// start of a tokio runtime.
///
/// # Errors
/// If the system refuses a thread.
pub fn check(count: usize) -> Result<(), ThreadError> {
    let before = count_threads();
    let gate = Arc::new(Mutex::new(()));
    let closed = gate.lock();
    let mut started = Vec::new();
    let mut result = Ok(());
    for _ in 0..count {
        let gate = Arc::clone(&gate);
        match thread::Builder::new().spawn(move || drop(gate.lock())) {
            Ok(thread) => started.push(thread),
            Err(error) => {
                result = Err(ThreadError::new(error));
                break;
            }
        }
    }
    drop(closed);
    for thread in started {
        // It has no code that panics.
        let _ = thread.join();
    }
    // A thread counts until the kernel has removed it, which is after `join`.
    let began = Instant::now();
    while count_threads() > before && began.elapsed() < REMOVAL_TIMEOUT {
        thread::sleep(Duration::from_micros(100));
    }
    result
}

/// The number of threads of this process, or 0 without `/proc`.
fn count_threads() -> usize {
    std::fs::read_dir("/proc/self/task").map_or(0, Iterator::count)
}

/// Describes the limit on threads that is most likely reached, and how to raise it.
fn limit(root: &Path) -> String {
    if let Some((group, most)) = full_group(root) {
        return format!(
            "the control group {} has all of its {most} processes and threads (pids.max); end some, or raise the \
             limit (TasksMax= of the systemd unit, --pids-limit of the container)",
            group.display()
        );
    }
    if let Some(most) = max_of_user(root) {
        return format!(
            "this user has all of its {most} processes and threads (RLIMIT_NPROC); end some, or raise the limit \
             (ulimit -u, LimitNPROC= of the systemd unit, nproc in /etc/security/limits.conf)"
        );
    }
    "the system has no room for it; end processes, or raise kernel.threads-max and kernel.pid_max (sysctl) or the \
     limits on memory"
        .to_owned()
}

/// Returns the control group of this process whose limit is reached, and the limit.
fn full_group(root: &Path) -> Option<(PathBuf, u64)> {
    let text = std::fs::read_to_string(root.join("proc/self/cgroup")).ok()?;
    let (mount, group) = text.lines().find_map(|line| {
        let mut fields = line.splitn(3, ':').skip(1);
        let (controllers, group) = (fields.next()?, fields.next()?);
        let mount = match controllers {
            "" => "sys/fs/cgroup",
            _ if controllers.split(',').any(|it| it == "pids") => "sys/fs/cgroup/pids",
            _ => return None,
        };
        let mount = root.join(mount);
        mount.is_dir().then(|| (mount, group.to_owned()))
    })?;
    let number = |group: &Path, file: &str| {
        let path = mount.join(group).join(file);
        let text = std::fs::read_to_string(path).ok()?;
        text.trim().parse::<u64>().ok()
    };
    let group = Path::new(group.trim_start_matches('/'));
    group.ancestors().take(MAX_GROUPS).find_map(|group| {
        let most = number(group, "pids.max")?;
        let current = number(group, "pids.current")?;
        (current >= most).then(|| (Path::new("/").join(group), most))
    })
}

/// Returns the maximum number of processes and threads of this user, if it has one.
fn max_of_user(root: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(root.join("proc/self/limits")).ok()?;
    let line = text.lines().find_map(|it| it.strip_prefix("Max processes"));
    line?.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[test]
    fn work_runs_on_another_thread_and_is_waited_for() {
        let (done, finished) = mpsc::channel();
        spawn(move || done.send(thread::current().id()).unwrap()).unwrap();
        wait(Duration::from_secs(60));
        assert_ne!(finished.try_recv().unwrap(), thread::current().id());
        check(4).unwrap();
    }

    #[test]
    fn the_limit_that_is_reached_is_named() {
        let root = std::env::temp_dir().join(format!("fipa-threads-{}", std::process::id()));
        let write = |path: &str, text: &str| {
            let path = root.join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        assert!(limit(&root).contains("kernel.threads-max"));
        write(
            "proc/self/limits",
            "Max processes             12                   12                   processes \n",
        );
        let of_user = limit(&root);
        assert!(of_user.contains("all of its 12 "), "{of_user}");
        assert!(of_user.contains("RLIMIT_NPROC"), "{of_user}");
        write("proc/self/cgroup", "0::/robot.slice/arm.service\n");
        let group = "sys/fs/cgroup/robot.slice/arm.service";
        write(&format!("{group}/pids.max"), "max\n");
        write(&format!("{group}/pids.current"), "7\n");
        write("sys/fs/cgroup/robot.slice/pids.max", "9\n");
        write("sys/fs/cgroup/robot.slice/pids.current", "8\n");
        assert!(limit(&root).contains("RLIMIT_NPROC"), "{}", limit(&root));
        write("sys/fs/cgroup/robot.slice/pids.current", "9\n");
        let of_group = limit(&root);
        assert!(
            of_group.contains("the control group /robot.slice "),
            "{of_group}"
        );
        assert!(of_group.contains("TasksMax="), "{of_group}");
        std::fs::remove_dir_all(root).unwrap();
    }
}
