//! Joining a domain and registering a name while another process holds the lock of the domain's
//! directory: other tasks of the thread go on, and a dropped future leaves nothing registered.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::fs::{File, TryLockError};
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::pin::Pin;
use std::task::Poll;

use fipa::error::RegisterError;
use fipa::{Change, Config, Domain, RegisterOptions};

/// Makes a configuration for a domain that no other test uses.
fn config() -> Config {
    support::config(&["mts.transports=unix"])
}

/// The directory of a domain with the files and locks of its processes.
fn directory(config: &Config) -> PathBuf {
    let base = std::env::var_os("FIPA_RUNTIME_DIR").filter(|value| !value.is_empty());
    let base = base.map_or_else(
        || {
            let user = std::fs::metadata("/proc/self").unwrap().uid();
            PathBuf::from(format!("/tmp/fipa-{user}"))
        },
        PathBuf::from,
    );
    base.join(&config.domain).join("directory")
}

/// Takes the lock of a domain, as a process does that changes the directory.
fn lock(config: &Config) -> File {
    let lock = File::open(directory(config).join("lock")).unwrap();
    lock.lock().unwrap();
    lock
}

/// Polls a future once, and then waits until a thread of this process waits for the domain's lock.
async fn begin<F: Future + Unpin>(future: &mut F, config: &Config) {
    let polled = std::future::poll_fn(|context| {
        let polled = Pin::new(&mut *future).poll(context);
        Poll::Ready(polled.is_pending())
    });
    assert!(polled.await, "the lock is held");
    // The thread that waits holds the lock of the directory itself.
    let turn = File::open(directory(config)).unwrap();
    loop {
        match turn.try_lock() {
            Err(TryLockError::WouldBlock) => return,
            taken => taken.unwrap(),
        }
        turn.unlock().unwrap();
        tokio::task::yield_now().await;
    }
}

#[tokio::test]
async fn a_registration_that_waits_holds_up_no_task() {
    let config = config();
    let domain = Domain::open(&config).await.unwrap();
    let held = lock(&config);
    let (agent, ()) = tokio::join!(domain.register("arm"), async { drop(held) });
    assert_eq!(agent.unwrap().name(), "arm");
}

#[tokio::test]
async fn a_process_that_waits_to_join_holds_up_no_task() {
    let config = config();
    let _member = Domain::open(&config).await.unwrap();
    let held = lock(&config);
    let (joined, ()) = tokio::join!(Domain::open(&config), async { drop(held) });
    joined.unwrap();
}

#[cfg(feature = "net")]
#[tokio::test]
async fn a_gateway_that_waits_to_join_holds_up_no_task() {
    let config = config();
    let _member = Domain::open(&config).await.unwrap();
    let held = lock(&config);
    let (gateway, ()) = tokio::join!(fipa::Gateway::open(&config), async { drop(held) });
    gateway.unwrap();
}

#[tokio::test]
async fn a_dropped_registration_leaves_no_name() {
    dropped_leaves_no_name(|domain| {
        Box::pin(async { assert_eq!(domain.register("arm").await.unwrap().name(), "arm") })
    })
    .await;
}

#[tokio::test]
async fn a_dropped_coalition_leaves_no_name() {
    dropped_leaves_no_name(|domain| {
        Box::pin(async {
            let options = RegisterOptions::default();
            let arm = domain.form("arm", ["leg"], None, options).await.unwrap();
            assert_eq!(arm.name(), "arm");
        })
    })
    .await;
}

/// Drops the registration of the name `arm` before it has begun, and while it waits.
async fn dropped_leaves_no_name(
    register: impl Fn(&Domain) -> Pin<Box<dyn Future<Output = ()> + '_>>,
) {
    let config = config();
    let domain = Domain::open(&config).await.unwrap();
    let mut watch = domain.directory().watch();
    for has_begun in [false, true] {
        let held = lock(&config);
        let mut registration = register(&domain);
        if has_begun {
            begin(&mut registration, &config).await;
        }
        drop(registration);
        drop(held);
        // The threads of a process wait for the lock one after the other.
        let leg = domain.register("leg").await.unwrap();
        loop {
            match watch.next().await.unwrap() {
                Change::Joined(entry) if &*entry.name == "leg" => break,
                Change::Left(entry) if &*entry.name == "leg" => {}
                other => panic!("{other:?}"),
            }
        }
        drop(leg);
    }
    register(&domain).await;
}

#[cfg(feature = "net")]
#[tokio::test]
async fn a_dropped_gateway_leaves_no_name() {
    let config = config();
    let member = Domain::open(&config).await.unwrap();
    let held = lock(&config);
    let mut opening = Box::pin(fipa::Gateway::open(&config));
    begin(&mut opening, &config).await;
    drop(opening);
    drop(held);
    // The domain has no other gateway.
    let gateway = fipa::Gateway::open(&config).await.unwrap();
    gateway.close().await;
    member.close().await;
}

#[tokio::test]
async fn a_dropped_process_leaves_the_domain() {
    let config = config();
    let member = Domain::open(&config).await.unwrap();
    let held = lock(&config);
    let mut opening = Box::pin(Domain::open(&config));
    begin(&mut opening, &config).await;
    drop(opening);
    drop(held);
    member.close().await;
    // The last process removes the directory, so the next one creates it.
    let next = Domain::open(&config).await.unwrap();
    next.close().await;
    assert!(!directory(&config).exists());
}

#[test]
fn a_domain_without_its_runtime_registers_no_agent() {
    let config = config();
    let runtime = || {
        let builder = &mut tokio::runtime::Builder::new_current_thread();
        builder.enable_all().build().unwrap()
    };
    let (first, second) = (runtime(), runtime());
    let domain = first.block_on(Domain::open(&config)).unwrap();
    drop(first);
    let registered = second.block_on(domain.register("arm"));
    assert!(matches!(registered, Err(RegisterError::Closed)));
}
