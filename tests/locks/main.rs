//! Locks between agents of several memberships, which represent processes, on one and on two hosts.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod counter;
#[path = "../../examples/lock.rs"]
#[allow(dead_code, reason = "the test does not call `main`")]
mod example;
mod greetings;
mod hosts;
mod legacy;
mod queued;
#[path = "../support/mod.rs"]
mod support;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use fipa::locks::{
    AdmitError, Algorithm, Ending, Fence, Lock, LockError, LockOptions, OwnError, OwnOptions,
    OwnerEvent, StateFileError, with_fences,
};
use fipa::{Agent, AgentId, Config, Domain, Gateway, Kind, Message, Performative};
use fipa_testbed::until_async;
use support::{config, inform, two};
use tempfile::TempDir;

/// Longer than any test runs.
const FOREVER: Duration = Duration::from_secs(600);

/// Number of locks that each agent of a test takes in turn.
const TURNS: u64 = 5;

/// Fails a test that waits without end.
async fn watched<T>(test: impl Future<Output = T>) -> T {
    let ended = tokio::time::timeout(Duration::from_secs(300), test).await;
    ended.expect("the test ends within 300 s")
}

/// Options with a short claim.
fn options(algorithm: Algorithm) -> LockOptions {
    LockOptions {
        algorithm,
        claim: Duration::from_millis(50),
        retry: Duration::from_secs(1),
        // A loaded machine may be slow to answer. Repetitions would add to its load.
        discovery: Duration::from_secs(30),
        probe_timeout: Duration::from_secs(30),
        ..LockOptions::default()
    }
}

/// Repeats a request for a lock if its time was over before the owner was found.
async fn with_owner(request: impl AsyncFn() -> Result<Lock, LockError>) -> Result<Lock, LockError> {
    loop {
        match request().await {
            Err(LockError::OwnerNotFound { .. }) => {}
            result => return result,
        }
    }
}

async fn agent(domain: &Domain, name: &str) -> Agent {
    agent_with(domain, name, Algorithm::default()).await
}

async fn agent_with(domain: &Domain, name: &str, algorithm: Algorithm) -> Agent {
    let agent = domain.register(name).await.unwrap();
    agent.use_locks(options(algorithm)).unwrap();
    agent
}

/// Options of an owner, with a state directory.
fn kept(directory: &TempDir, lease: Duration) -> OwnOptions {
    OwnOptions {
        lease,
        state_dir: Some(directory.path().to_owned()),
        volatile: false,
        forget: true,
    }
}

fn request(from: &Agent, to: &str) -> fipa::MessageBuilder {
    from.message(Performative::Request)
        .receiver(AgentId::new(to).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn agents_take_turns_with_each_algorithm() {
    watched(async {
        for algorithm in Algorithm::ALL {
            let (here, there) = two(&config(&[])).await;
            let files = tempfile::tempdir().unwrap();
            let crane = agent_with(&here, "crane", algorithm).await;
            let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
            let is_used = Arc::new(AtomicBool::new(false));
            let last = Arc::new(AtomicU64::new(0));
            let mut users = Vec::new();
            for (number, domain) in [&here, &there, &there].into_iter().enumerate() {
                let user = agent_with(domain, &format!("rover-{number}"), algorithm).await;
                let (is_used, last) = (Arc::clone(&is_used), Arc::clone(&last));
                users.push(tokio::spawn(async move {
                    for _ in 0..TURNS {
                        let lock = user.lock("bay").await.unwrap();
                        assert!(!is_used.swap(true, Ordering::SeqCst), "{algorithm}");
                        let fence = lock.fence().unwrap();
                        assert_eq!(fence.owner(), "crane");
                        let before = last.swap(fence.number(), Ordering::SeqCst);
                        assert!(before < fence.number(), "{algorithm}");
                        tokio::task::yield_now().await;
                        assert!(lock.is_held() && lock.remaining().unwrap() > Duration::ZERO);
                        is_used.store(false, Ordering::SeqCst);
                        lock.release();
                    }
                    user
                }));
            }
            // In the basic form of Suzuki-Kasami, an agent that leaves takes the token with it.
            let mut stay = Vec::new();
            for user in users {
                stay.push(user.await.unwrap());
            }
            assert_eq!(last.load(Ordering::SeqCst), 3 * TURNS, "{algorithm}");
            until_async("the bay is free", || bay.status().holder.is_none()).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_is_admitted_with_the_fence_of_the_live_grant_only() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&here, "crane").await;
        let rover = agent(&there, "rover").await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let lock = rover.lock("bay").await.unwrap();
        let fence = lock.fence().unwrap().clone();
        assert_eq!(bay.status().holder.as_deref(), Some("rover"));
        assert_eq!(bay.status().fence.as_ref(), Some(&fence));
        let granted = OwnerEvent::Granted {
            holder: "rover".into(),
            fence: Some(fence.clone()),
        };
        assert_eq!(bay.next().await, Some(granted));

        // The command goes to the name of the resource, which the directory lists.
        let guarded = lock.guard(request(&rover, "lock:bay")).build().unwrap();
        assert!(rover.send(guarded.clone()).await.unwrap().all_succeeded());
        // No message of the lock precedes it.
        let received = crane.receive().await.unwrap().into_message();
        assert_eq!(bay.check(&received), Ok(fence.clone()));
        let bare = request(&rover, "crane").build().unwrap();
        assert!(matches!(
            bay.check(&bare),
            Err(AdmitError::Missing { owner, .. }) if owner == "crane"
        ));

        lock.release();
        let ended = OwnerEvent::Ended {
            holder: "rover".into(),
            fence: Some(fence.clone()),
            how: Ending::Released,
        };
        assert_eq!(bay.next().await, Some(ended));
        assert!(!bay.admit(&fence));
        assert!(matches!(
            bay.check(&guarded),
            Err(AdmitError::Stale { fence: stale, .. }) if stale == fence
        ));
        // Fences of another owner and of another resource, with the numbers of the live grant.
        let lock = rover.lock("bay").await.unwrap();
        let live = lock.fence().unwrap();
        assert!(bay.admit(live));
        for names in ["arm#bay", "crane#dock"] {
            let (epoch, number) = live.position();
            let run = live.run();
            let text = format!("{epoch}.{number}.{run:016x}@{names}");
            let foreign: Fence = text.parse().unwrap();
            assert!(!bay.admit(&foreign), "{foreign}");
            let message = with_fences(request(&rover, "crane"), [&foreign]);
            let checked = bay.check(&message.build().unwrap());
            assert!(matches!(checked, Err(AdmitError::Missing { .. })));
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_that_is_withdrawn_does_not_stay_in_the_queue() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&here, "crane").await;
        let (rover, arm) = (agent(&here, "rover").await, agent(&there, "arm").await);
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let lock = rover.lock("bay").await.unwrap();

        let within = Duration::from_millis(50);
        let late = with_owner(async || arm.lock_within("bay", within).await).await;
        assert!(matches!(late, Err(LockError::TimedOut { .. })), "{late:?}");
        let late = with_owner(async || arm.try_lock("bay").await).await;
        assert!(matches!(late, Err(LockError::TimedOut { .. })), "{late:?}");
        // A future that is dropped.
        let dropped = tokio::time::timeout(Duration::from_millis(50), arm.lock("bay")).await;
        assert!(dropped.is_err());
        assert!(lock.is_held());
        lock.release();
        // The owner grants none of the three, so the next request gets it.
        let lock = arm.lock("bay").await.unwrap();
        assert_eq!(bay.status().waiting, 0);
        assert_eq!(bay.status().holder.as_deref(), Some("arm"));
        // The same agent waits for itself.
        let again = arm.try_lock("bay").await;
        assert!(
            matches!(again, Err(LockError::TimedOut { .. })),
            "{again:?}"
        );
        drop(lock);
        let lock = arm.try_lock("bay").await.unwrap();
        assert!(lock.is_held());
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_resource_without_an_owner_and_a_wrong_name_are_errors() {
    watched(async {
        let config = config(&[]);
        let domain = Domain::open(&config).await.unwrap();
        let rover = domain.register("rover").await.unwrap();
        let zero = LockOptions {
            retry: Duration::ZERO,
            ..LockOptions::default()
        };
        assert!(matches!(rover.use_locks(zero), Err(LockError::Options(_))));
        let quick = LockOptions {
            discovery: Duration::from_millis(200),
            ..LockOptions::default()
        };
        rover.use_locks(quick).unwrap();
        let free = rover.lock("bay").await;
        assert!(matches!(free, Err(LockError::NoOwner { resource }) if resource == "bay"));
        let long = rover.lock(&"x".repeat(10_000)).await;
        assert!(matches!(long, Err(LockError::Name(_))));
        assert!(matches!(rover.use_locks(quick), Err(LockError::Started)));
        let owned = rover.own(
            "bay",
            OwnOptions {
                lease: Duration::ZERO,
                ..OwnOptions::default()
            },
        );
        assert!(matches!(owned.await, Err(OwnError::Options(_))));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn waiting_agents_fail_and_leases_end_when_the_owner_has_ended() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&here, "crane").await;
        let (rover, arm) = (agent(&there, "rover").await, agent(&there, "arm").await);
        let short = Duration::from_secs(3);
        let bay = crane.own("bay", kept(&files, short)).await.unwrap();
        let dock = crane.own("dock", kept(&files, FOREVER)).await.unwrap();
        let _held = rover.lock("dock").await.unwrap();
        let lock = rover.lock("bay").await.unwrap();
        let arm = Arc::new(arm);
        let asking = Arc::clone(&arm);
        let waiting = tokio::spawn(async move { asking.lock("dock").await });
        until_async("the arm waits", || {
            dock.status().waiters.iter().any(|name| name == "arm")
        })
        .await;
        drop(crane);
        let unreachable = waiting.await.unwrap();
        assert!(
            matches!(&unreachable, Err(LockError::Unreachable { owner, .. }) if owner == "crane"),
            "{unreachable:?}"
        );
        // The lease is used to its end.
        assert!(matches!(lock.lost().await, LockError::Lost { .. }));
        assert!(!lock.is_held());
        assert_eq!(lock.remaining(), Some(Duration::ZERO));
        assert_eq!(bay.next().await.map(|_| ()), Some(()));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_lock_of_an_agent_that_left_is_granted_at_once() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&here, "crane").await;
        let (rover, arm) = (agent(&there, "rover").await, agent(&here, "arm").await);
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let lock = rover.lock("bay").await.unwrap();
        let stale = lock.fence().unwrap().clone();
        let waiting = tokio::spawn(async move { arm.lock("bay").await.map(|lock| (lock, arm)) });
        // Its process ends without a release.
        std::mem::forget(lock);
        std::mem::forget(rover);
        there.close().await;
        let (lock, _arm) = waiting.await.unwrap().unwrap();
        assert!(bay.admit(lock.fence().unwrap()));
        assert!(!bay.admit(&stale));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn several_resources_are_locked_all_or_none() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&here, "crane").await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let arm = crane.own("arm", kept(&files, FOREVER)).await.unwrap();
        let users = [
            (agent(&here, "rover-1").await, ["bay", "arm"]),
            (agent(&there, "rover-2").await, ["arm", "bay"]),
        ];
        let users = users.map(|(user, resources)| {
            tokio::spawn(async move {
                for _ in 0..TURNS {
                    let lock = user.lock_all(&resources).await.unwrap();
                    assert!(lock.is_held());
                    assert_eq!(lock.resources().count(), 2);
                    assert_ne!(lock.fence_of("bay"), lock.fence_of("arm"));
                }
                user
            })
        });
        let [first, second] = users;
        let (first, second) = (first.await.unwrap(), second.await.unwrap());
        let both = first.lock_all(&["bay", "arm"]).await.unwrap();
        let command = both.guard(request(&first, "crane")).build().unwrap();
        assert_eq!(bay.check(&command).as_ref().ok(), both.fence_of("bay"));
        drop(both);
        // The lock of one resource gives no access to another of the same owner.
        let held = first.lock("bay").await.unwrap();
        let other = second.lock("arm").await.unwrap();
        assert!(!arm.admit(held.fence().unwrap()));
        let command = held.guard(request(&first, "crane")).build().unwrap();
        assert!(matches!(
            arm.check(&command),
            Err(AdmitError::Missing { resource, .. }) if resource == "arm"
        ));
        drop((held, other));
        // The one that is free is not kept while the other is in use.
        let held = first.lock("bay").await.unwrap();
        loop {
            let within = Duration::from_millis(300);
            match second.lock_all_within(&["bay", "arm"], within).await {
                Err(LockError::TimedOut { resource, .. }) if resource == "bay" => break,
                // The time was over before the arm was acquired, or an owner was found.
                Err(LockError::TimedOut { resource, .. }) if resource == "arm" => {}
                Err(LockError::OwnerNotFound { .. }) => {}
                other => panic!("{other:?}"),
            }
        }
        until_async("the arm is free", || arm.status().holder.is_none()).await;
        assert!(held.is_held());
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_of_locks_never_reach_the_application() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        // An agent that uses no locks.
        let camera = there.register("camera").await.unwrap();
        let crane = agent(&here, "crane").await;
        let rover = agent(&there, "rover").await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let lock = rover.lock("bay").await.unwrap();
        for (from, to) in [(&crane, &camera), (&rover, &camera), (&crane, &rover)] {
            // Letters of one sender keep their order.
            let marker = inform(from, to.name(), "marker");
            assert!(from.send(marker).await.unwrap().all_succeeded());
            assert_eq!(text(to.receive().await.unwrap().message()), "marker");
        }
        assert_eq!(rover.locks().len(), 1);
        assert!(rover.locks()[0].is_held && camera.locks().is_empty());
        let unread = rover.deregister().unwrap();
        assert!(unread.is_empty(), "{unread:?}");
        assert!(!lock.is_held());
        assert!(matches!(lock.lost().await, LockError::Closed));
        until_async("the bay is free", || bay.status().holder.is_none()).await;
    })
    .await;
}

fn text(message: &Message) -> &str {
    std::str::from_utf8(message.content().unwrap()).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_fences_of_an_owner_rise_over_its_restarts() {
    watched(async {
        let domain = Domain::open(&config(&[])).await.unwrap();
        let files = tempfile::tempdir().unwrap();
        let rover = agent(&domain, "rover").await;
        let lease = Duration::from_secs(2);
        let mut last: Option<Fence> = None;
        for life in 0..4 {
            let crane = agent(&domain, "crane").await;
            let bay = crane.own("bay", kept(&files, lease)).await.unwrap();
            if let Some(last) = &last {
                assert!(!bay.admit(last));
            }
            let lock = rover.lock("bay").await.unwrap();
            let fence = lock.fence().unwrap().clone();
            assert_eq!(fence.number(), 1);
            assert!(
                last.is_none_or(|last| last.epoch() < fence.epoch() && last.run() != fence.run())
            );
            last = Some(fence);
            if life % 2 == 1 {
                lock.release();
                until_async("the bay is free", || bay.status().holder.is_none()).await;
                bay.release().await;
            } else {
                // This life ends while a grant is live.
                drop(bay);
            }
        }
    })
    .await;
}

/// The second host has no state file of the owner. The waits are those of an owner without memory: 15 s.
#[tokio::test(flavor = "multi_thread")]
async fn a_fence_never_comes_back_on_another_host() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let [first, second] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let [rover, arm] = [agent(&here, "rover").await, agent(&here, "arm").await];
        let gate = agent(&here, "gate").await;
        let device = gate.device("crane", "bay").unwrap();
        let lease = Duration::from_secs(5);
        let crane = agent(&there, "crane").await;
        let bay = crane.own("bay", kept(&first, lease)).await.unwrap();
        let lock = rover.lock("bay").await.unwrap();
        let stale = lock.fence().unwrap().clone();
        let late = lock.guard(request(&rover, "crane")).build().unwrap();
        assert_eq!(device.check(&late), Ok(stale.clone()));
        // The owner ends while the grant is live.
        drop(bay);
        drop(crane);

        let crane = agent(&here, "crane").await;
        let moved = OwnOptions {
            forget: false,
            ..kept(&second, lease)
        };
        let bay = crane.own("bay", moved).await.unwrap();
        assert!(bay.silence() > Duration::from_secs(10), "{bay:?}");
        let lock = arm.lock("bay").await.unwrap();
        let live = lock.fence().unwrap().clone();
        assert!(live.epoch() > stale.epoch() && live.run() != stale.run());
        assert!(matches!(
            bay.check(&late),
            Err(AdmitError::Stale { fence, .. }) if fence == stale
        ));
        let command = lock.guard(request(&arm, "crane")).build().unwrap();
        assert_eq!(bay.check(&command), Ok(live.clone()));
        assert_eq!(device.check(&command), Ok(live.clone()));
        assert!(matches!(
            device.check(&late),
            Err(AdmitError::OtherRun { fence, highest, .. }) if fence == stale && highest == live
        ));
        assert_eq!(device.highest(), Some(live));
    })
    .await;
}

/// The device has seen an epoch that the owner's clock and file do not reach.
#[tokio::test(flavor = "multi_thread")]
async fn an_owner_grants_above_the_fence_of_a_device() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&here, "crane").await;
        let rover = agent(&there, "rover").await;
        let gate = agent(&there, "gate").await;
        let lease = Duration::from_secs(5);
        let bay = crane.own("bay", kept(&files, lease)).await.unwrap();
        let device = gate.device("crane", "bay").unwrap();
        let ahead = "200000000000.7.00000000000000aa@crane#bay";
        let ahead: Fence = ahead.parse().unwrap();
        // The grant comes first: the owner asks for higher fences when it starts, and this fence must not
        // be among the answers.
        let lock = rover.lock("bay").await.unwrap();
        let low = lock.fence().unwrap().clone();
        device.admit(&ahead).unwrap();
        // The live grant goes on, and the device refuses it.
        assert!(matches!(
            device.admit(&low),
            Err(AdmitError::OtherRun { highest, .. }) if highest == ahead
        ));
        lock.release();
        // The owner waits for the end of the grants that the other life may have made.
        let next = loop {
            let lock = match rover.lock("bay").await {
                Err(LockError::Lost { .. }) => continue,
                granted => granted.unwrap(),
            };
            let fence = lock.fence().unwrap().clone();
            if device.admit(&fence).is_ok() {
                break fence;
            }
        };
        assert_eq!(next.epoch(), 200_000_000_001);
        assert_eq!(next.run(), low.run());
        until_async("the bay is free", || bay.status().holder.is_none()).await;
        bay.release().await;
        // The file has the epoch.
        let bay = crane.own("bay", kept(&files, lease)).await.unwrap();
        let lock = rover.lock("bay").await.unwrap();
        assert_eq!(lock.fence().unwrap().position(), (200_000_000_002, 1));
        drop((lock, bay));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_owner_needs_its_state_file_and_its_resource() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&here, "crane").await;
        let file = files.path().join("file");
        std::fs::write(&file, "").unwrap();
        let no_directory = OwnOptions {
            state_dir: Some(file),
            ..OwnOptions::default()
        };
        let refused = crane.own("bay", no_directory.clone()).await;
        assert!(
            matches!(
                &refused,
                Err(OwnError::StateFile(StateFileError::Io { .. }))
            ),
            "{refused:?}"
        );
        // The same call works without a file.
        let volatile = OwnOptions {
            volatile: true,
            forget: true,
            lease: Duration::from_secs(2),
            ..no_directory
        };
        let bay = crane.own("bay", volatile).await.unwrap();
        let lock = crane.lock("bay").await.unwrap();
        // The time of day.
        assert!(lock.fence().unwrap().epoch() > 1_000_000_000);
        let again = crane.own("bay", kept(&files, FOREVER)).await;
        assert!(
            matches!(again, Err(OwnError::AlreadyOwned { .. })),
            "{again:?}"
        );
        let other = agent(&there, "arm").await;
        let taken = other.own("bay", kept(&files, FOREVER)).await;
        assert!(
            matches!(&taken, Err(OwnError::Taken { owner, .. }) if owner == "crane"),
            "{taken:?}"
        );
        drop(bay);
        // The entry of the directory is removed on another thread.
        until_async("the bay is not listed", || {
            there.directory().lookup("lock:bay").is_none()
        })
        .await;
        let bay = other.own("bay", kept(&files, FOREVER)).await.unwrap();
        assert_eq!(bay.status().owner.as_deref(), Some("arm"));
    })
    .await;
}

struct Host {
    gateway: Gateway,
    domain: Domain,
}

impl Host {
    async fn start(peer: Option<&Self>) -> Self {
        let config: Config = match peer {
            None => config(&[]),
            Some(peer) => {
                let mut locations = peer.gateway.locations().into_iter();
                let location = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
                let address = location.address();
                config(&[&format!(
                    "discovery.static={{ peer = [\"tcp://{address}\"] }}"
                )])
            }
        };
        Self {
            gateway: Gateway::open(&config).await.unwrap(),
            domain: Domain::open(&config).await.unwrap(),
        }
    }

    async fn until_known(&self, names: &[&str]) {
        let directory = self.domain.directory();
        until_async(&format!("{names:?} are known"), || {
            names.iter().all(|name| directory.known(name).is_some())
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn agents_of_two_hosts_share_a_resource() {
    watched(async {
        let first = Host::start(None).await;
        let second = Host::start(Some(&first)).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent(&first.domain, "crane").await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        second.until_known(&["crane", "lock:bay"]).await;
        let rover = agent(&second.domain, "rover").await;
        let arm = agent(&first.domain, "arm").await;
        let lock = rover.lock("bay").await.unwrap();
        let fence = lock.fence().unwrap().clone();
        assert!(bay.admit(&fence));
        let rival = second.domain.register("rival").await.unwrap();
        let patient = LockOptions {
            claim: Duration::from_secs(60),
            ..options(Algorithm::default())
        };
        rival.use_locks(patient).unwrap();
        let taken = rival.own("bay", kept(&files, FOREVER)).await;
        assert!(
            matches!(&taken, Err(OwnError::Taken { owner, .. }) if owner == "crane"),
            "{taken:?}"
        );
        let listed = arm.query_locks(Duration::from_secs(60)).await.unwrap();
        assert_eq!(listed.len(), 1);
        assert_eq!(listed[0].holder.as_deref(), Some("rover"));
        assert_eq!(listed[0].fence.as_ref(), Some(&fence));
        // The registration ends without a release. Its own gateway proves that, long before the lease ends.
        let waiting = tokio::spawn(async move { arm.lock("bay").await.map(|lock| (lock, arm)) });
        std::mem::forget(lock);
        std::mem::forget(rover);
        second.domain.close().await;
        let (lock, _arm) = waiting.await.unwrap().unwrap();
        assert!(!bay.admit(&fence) && bay.admit(lock.fence().unwrap()));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_malicious_peer_cannot_stop_others() {
    watched(async {
        let (here, there) = two(&config(&[])).await;
        let files = tempfile::tempdir().unwrap();
        let crane = agent_with(&here, "crane", Algorithm::RicartAgrawalaExtended).await;
        let mallory = there.register("mallory").await.unwrap();
        let rover = agent(&there, "rover").await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let send = async |act: Performative, protocol: &str, id: String, content: String| {
            let message = mallory
                .message(act)
                .receiver(AgentId::new("crane").unwrap())
                .ontology("fipa-locking")
                .protocol(protocol.to_owned())
                .conversation_id(id)
                .reply_with("1")
                .content(content);
            mallory.send(message.build().unwrap()).await.unwrap();
        };
        let protocol = Algorithm::RicartAgrawalaExtended.protocol();
        let long = "x".repeat(10_000);
        for number in 0..80 {
            let id = format!("mallory_{number}");
            send(
                Performative::Request,
                protocol,
                id.clone(),
                format!("1\nbay-{number}"),
            )
            .await;
            send(
                Performative::Confirm,
                protocol,
                id.clone(),
                format!("other-{number}"),
            )
            .await;
            send(
                Performative::QueryIf,
                "dlm_discover",
                id.clone(),
                long.clone(),
            )
            .await;
            send(Performative::Inform, "dlm_discover", id, "a\nb".to_owned()).await;
        }
        // Reports without a request, of which the owner keeps the last, and a foreign release.
        for number in 0..80 {
            let id = format!("mallory_{number}");
            send(Performative::Confirm, protocol, id, "bay".to_owned()).await;
        }
        until_async("mallory holds the bay", || {
            bay.status().holder.as_deref() == Some("mallory")
        })
        .await;
        assert!(bay.status().waiting <= 1);
        assert_eq!(crane.locks().len(), 1);
        mallory.deregister().unwrap();
        let lock = rover.lock("bay").await.unwrap();
        assert!(bay.admit(lock.fence().unwrap()));
        let fake = there.register("rover-2").await.unwrap();
        for number in 0..10 {
            // The release of another agent's conversation.
            let id = format!("rover_{number}");
            let message = fake
                .message(Performative::Disconfirm)
                .receiver(AgentId::new("crane").unwrap())
                .protocol(protocol)
                .conversation_id(id)
                .content("bay");
            fake.send(message.build().unwrap()).await.unwrap();
        }
        let marker = inform(&fake, "crane", "marker");
        fake.send(marker).await.unwrap();
        crane.receive().await.unwrap();
        assert!(lock.is_held() && bay.admit(lock.fence().unwrap()));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_example_refuses_late_commands() {
    watched(async {
        let domain = Domain::open(&config(&[])).await.unwrap();
        let files = tempfile::tempdir().unwrap();
        let answers = example::share(&domain, kept(&files, FOREVER))
            .await
            .unwrap();
        for (number, answer) in answers.iter().enumerate() {
            let expected = match number % 2 {
                0 => "agree",
                _ => "refuse",
            };
            assert!(answer.contains(expected), "{answer}");
        }
        assert_eq!(answers.len(), 4);
    })
    .await;
}
