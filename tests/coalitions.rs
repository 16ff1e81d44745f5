//! Coalitions: one name for several agents, on two hosts whose gateways know each other.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fipa::error::CoalitionError;
use fipa::{
    Agent, AgentId, Change, Coalition, Config, Deliveries, Domain, Entry, FailureReason, Gateway,
    Kind, Members, Outcome, Performative, RegisterOptions, Role,
};
use fipa_testbed::until_async;
use support::config;

struct Host {
    gateway: Gateway,
    domain: Domain,
    config: Config,
}

impl Host {
    async fn start(peer: Option<&Self>) -> Self {
        let mut set = Vec::new();
        if let Some(peer) = peer {
            let mut locations = peer.gateway.locations().into_iter();
            let location = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
            let address = location.address();
            set.push(format!(
                "discovery.static={{ peer = [\"tcp://{address}\"] }}"
            ));
        }
        let config = config(&set.iter().map(String::as_str).collect::<Vec<_>>());
        Self {
            gateway: Gateway::open(&config).await.unwrap(),
            domain: Domain::open(&config).await.unwrap(),
            config,
        }
    }

    async fn form(&self, name: &str, members: &[&str], leader: Option<&str>) -> Coalition {
        let options = RegisterOptions::default();
        let formed = self
            .domain
            .form(name, members.iter().copied(), leader, options);
        formed.await.unwrap()
    }

    async fn until_known(&self, names: &[&str]) {
        let directory = self.domain.directory();
        until_async(&format!("{names:?} are known"), || {
            names.iter().all(|name| directory.known(name).is_some())
        })
        .await;
    }
}

async fn send(from: &Agent, to: &str, content: &str) -> Deliveries {
    let message = from
        .message(Performative::Inform)
        .receiver(AgentId::new(to).unwrap())
        .content(content.to_owned())
        .build()
        .unwrap();
    from.send(message).await.unwrap()
}

async fn receives(agent: &Agent, content: &str) {
    let received = agent.receive().await.unwrap();
    assert_eq!(received.message().content().unwrap(), content);
}

fn to(deliveries: &Deliveries) -> BTreeSet<&str> {
    deliveries.0.iter().map(|one| &*one.receiver).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_to_a_coalition_reaches_its_members_or_its_leader() {
    let near = Host::start(None).await;
    let far = Host::start(Some(&near)).await;
    let rover = near.domain.register("rover").await.unwrap();
    let arm = far.domain.register("arm").await.unwrap();
    let camera = far.domain.register("camera").await.unwrap();
    let mut team = near.form("team", &["rover", "arm", "camera"], None).await;
    far.until_known(&["team", "rover"]).await;
    near.until_known(&["arm", "camera"]).await;

    // The sender is a member on another host than the owner of the coalition.
    let sent = send(&camera, "team", "all").await;
    assert!(sent.all_succeeded(), "{sent}");
    assert_eq!(to(&sent), BTreeSet::from(["arm", "rover"]));
    receives(&rover, "all").await;
    receives(&arm, "all").await;
    assert!(camera.try_receive().unwrap().is_none());

    // The leader is on the other host.
    team.change(["rover", "arm", "camera"], Some("arm"))
        .unwrap();
    let sent = send(&rover, "team", "lead").await;
    assert_eq!(to(&sent), BTreeSet::from(["arm"]), "{sent}");
    assert!(sent.all_succeeded());
    receives(&arm, "lead").await;

    // A loan works although its memory cannot be shared by several receivers.
    team.change(["arm", "camera"], None).unwrap();
    let message = rover
        .message(Performative::Inform)
        .receiver(AgentId::new("team").unwrap())
        .build()
        .unwrap();
    let mut loan = rover.loan(message, 5).unwrap();
    loan.content_mut().copy_from_slice(b"large");
    let sent = rover.send_loan(loan).await.unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    receives(&arm, "large").await;
    receives(&camera, "large").await;

    // A member that is not registered has an outcome, too.
    team.change(["arm", "leg"], None).unwrap();
    let sent = send(&rover, "team", "unregistered").await;
    assert_eq!(to(&sent), BTreeSet::from(["arm", "leg"]));
    let leg = sent.0.iter().find(|one| &*one.receiver == "leg").unwrap();
    assert!(matches!(
        leg.outcome,
        Outcome::Failed {
            reason: FailureReason::NoSuchAgent,
            ..
        }
    ));
    receives(&arm, "unregistered").await;
    team.dissolve().unwrap();
    assert!(!send(&rover, "team", "dissolved").await.all_succeeded());
    for host in [near, far] {
        host.gateway.close().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn refused_changes_leave_a_coalition_as_it_was() {
    let host = Host::start(None).await;
    let mut team = host.form("team", &["a", "b"], Some("b")).await;
    let options = RegisterOptions::default;
    let form = async |name: &str, members: &[&str]| {
        host.domain
            .form(name, members.iter().copied(), None, options())
            .await
    };
    assert!(matches!(
        form("team", &["a"]).await,
        Err(CoalitionError::Register(_))
    ));
    assert!(matches!(
        form("x", &[]).await,
        Err(CoalitionError::Members(_))
    ));
    let stranger = team.split("other", &["c"], None, options());
    assert!(matches!(stranger, Err(CoalitionError::NoMember(name)) if name == "c"));
    assert!(team.split("other", &["a", "b"], None, options()).is_err());
    let taken = form("taken", &["z"]).await.unwrap();
    assert!(team.split("taken", &["a"], None, options()).is_err());
    let many: Vec<String> = (0..Members::MAX_MEMBERS).map(|n| n.to_string()).collect();
    let many = host
        .domain
        .form("many", many, None, options())
        .await
        .unwrap();
    let (error, many) = *team.merge(many).unwrap_err();
    assert!(matches!(error, CoalitionError::Members(_)));
    // A coalition of another domain cannot be merged.
    let elsewhere = Host::start(None).await;
    let foreign = elsewhere.form("foreign", &["q"], None).await;
    let (error, foreign) = *team.merge(foreign).unwrap_err();
    assert!(matches!(error, CoalitionError::Register(_)), "{error}");
    let names: Vec<String> = team
        .members()
        .names()
        .iter()
        .map(ToString::to_string)
        .collect();
    assert_eq!(names, ["a", "b"]);
    let seen = host.domain.directory().lookup("team").unwrap();
    assert_eq!(seen.role, Role::Coalition(team.members().clone()));
    // If the leader is split off, the rest has no leader.
    let part = team.split("part", &["b"], Some("b"), options()).unwrap();
    assert_eq!(team.members().leader(), None);
    team.merge(part).unwrap();
    drop((taken, many, foreign));
}

/// The members of each coalition, as a watcher of the directory sees them.
#[derive(Default)]
struct Seen(BTreeMap<Arc<str>, Members>);

impl Seen {
    fn put(&mut self, entry: &Entry) {
        if let Role::Coalition(members) = &entry.role {
            self.0.insert(Arc::clone(&entry.name), members.clone());
        }
    }

    fn take(&mut self, change: &Change) {
        for change in change.single() {
            match change {
                Change::Joined(entry) | Change::Changed { after: entry, .. } => self.put(entry),
                Change::Left(entry) => drop(self.0.remove(&entry.name)),
                other => panic!("{other:?}"),
            }
        }
    }

    /// Checks that each module is in exactly one coalition.
    fn check(&self) {
        let mut all: Vec<&str> = self
            .0
            .values()
            .flat_map(|members| members.names().iter().map(|name| &**name))
            .collect();
        all.sort_unstable();
        assert_eq!(all, ["m0", "m1", "m2", "m3", "m4", "m5"], "{:?}", self.0);
    }
}

async fn watch(domain: Domain, over: Arc<AtomicBool>) -> usize {
    let mut changes = domain.directory().watch();
    let mut seen = Seen::default();
    for entry in domain.directory().entries().iter() {
        seen.put(entry);
    }
    seen.check();
    let mut changed = 0;
    while !over.load(Ordering::Relaxed) {
        let waited = tokio::time::timeout(Duration::from_millis(20), changes.next()).await;
        if let Ok(Some(change)) = waited {
            seen.take(&change);
            seen.check();
            changed += 1;
        }
        // A lookup sees no intermediate state either.
        let mut current = Seen::default();
        for entry in domain.directory().entries().iter() {
            current.put(entry);
        }
        current.check();
    }
    changed
}

#[tokio::test(flavor = "multi_thread")]
async fn a_merger_or_split_is_atomic_for_watchers() {
    let near = Host::start(None).await;
    let far = Host::start(Some(&near)).await;
    let modules = ["m0", "m1", "m2", "m3", "m4", "m5"];
    let mut whole = near.form("whole", &modules, Some("m0")).await;
    far.until_known(&["whole"]).await;
    let over = Arc::new(AtomicBool::new(false));
    let beside = Domain::open(&near.config).await.unwrap();
    until_async("it is known beside", || {
        beside.directory().lookup("whole").is_some()
    })
    .await;
    let watching: Vec<_> = [beside, near.domain.clone(), far.domain.clone()]
        .map(|domain| tokio::spawn(watch(domain, Arc::clone(&over))))
        .into();
    for round in 0..40 {
        let parting = ["m1", modules[2 + round % 4]];
        let part = whole.split(
            &format!("part {round}"),
            &parting,
            None,
            RegisterOptions::default(),
        );
        let part = part.unwrap();
        tokio::time::sleep(Duration::from_millis(3)).await;
        whole.merge(part).unwrap();
        assert_eq!(&**whole.members().leader().unwrap(), "m0");
    }
    let last = whole
        .split("last", &["m5"], None, RegisterOptions::default())
        .unwrap();
    far.until_known(&["last"]).await;
    over.store(true, Ordering::Relaxed);
    for watching in watching {
        assert!(watching.await.unwrap() > 0, "no change was reported");
    }
    drop((whole, last));
    for host in [near, far] {
        host.gateway.close().await;
    }
}
