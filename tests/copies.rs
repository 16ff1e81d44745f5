//! Between two hosts, nobody but the kernel touches large content: it is written into shared memory
//! by its author, goes from there to the socket, and from the socket into the shared memory that
//! its receiver reads it in. Every way there is to copy it on the way is counted, and stays at zero.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::{AgentId, Message, Performative};
use fipa_mts::core::{CoreConfig, Received, Submission};
use fipa_mts::{Mts, RuntimeConfig, Started, letter_around};
use fipa_sds::{Directory as _, MemoryDirectory, Registration};
use fipa_transport::{Incarnation, Kind, Location, Transport};
use fipa_transport_net::{Counters, Identity, Limits, TcpConfig, TcpTransport};
use fipa_transport_shm::{ShmConfig, ShmCounters, ShmTransport};
use tempfile::TempDir;
use tokio::runtime::Handle;
use tokio::time::timeout;

const ROVER: Incarnation = Incarnation::from_u64(0x50e4);
const ARM: Incarnation = Incarnation::from_u64(0xa53);
const LETTERS: usize = 24;
/// With every letter of another length.
const LEN: usize = 1 << 20;

/// A service: a robot process, or a gateway.
struct Place {
    mts: Mts,
    directory: Arc<MemoryDirectory>,
    shm: Arc<ShmTransport>,
    tcp: Option<Arc<TcpTransport>>,
    locations: Vec<Location>,
}

impl Place {
    fn process(host: &Path, name: &str) -> Self {
        Self::start(host, name, false)
    }

    fn gateway(host: &Path, name: &str) -> Self {
        Self::start(host, name, true)
    }

    fn start(host: &Path, name: &str, forwards: bool) -> Self {
        let incarnation = Incarnation::random();
        let handle = Handle::current();
        let mark = host.file_name().unwrap().to_str().unwrap();
        let prefix = format!("fipa_{}_{}", mark, std::process::id());
        let config = ShmConfig::new(host.join("shm"), prefix, incarnation);
        let shm = Arc::new(ShmTransport::new(config, handle.clone()).unwrap());
        let tcp = forwards.then(|| {
            let config = TcpConfig {
                listen: vec!["127.0.0.1:0".to_owned()],
                identity: Identity {
                    name: name.into(),
                    incarnation,
                    domain: mark.into(),
                    host: mark.into(),
                },
                limits: Limits::default(),
                #[cfg(feature = "secure")]
                security: None,
            };
            Arc::new(TcpTransport::new(config, handle.clone()))
        });
        let mut transports: Vec<Arc<dyn Transport>> = vec![shm.clone()];
        transports.extend(tcp.clone().map(|tcp| tcp as Arc<dyn Transport>));
        let directory = Arc::new(MemoryDirectory::new(fipa_sds::Mts::new(name, incarnation)));
        let core = CoreConfig {
            forwards,
            ..CoreConfig::new(name, incarnation, vec![Kind::Shm, Kind::Tcp])
        };
        let runtime = RuntimeConfig {
            spin: Duration::ZERO,
            unframed_deadline: Duration::from_secs(5),
            contacts: None,
            tap: None,
        };
        let Started {
            mts,
            locations,
            failed,
        } = Mts::start(core, runtime, directory.clone(), transports, &handle);
        assert!(failed.is_empty(), "{failed:?}");
        Self {
            mts,
            directory,
            shm,
            tcp,
            locations,
        }
    }

    /// Where this is by this kind of transport.
    fn at(&self, kind: Kind) -> Location {
        let mut locations = self.locations.iter();
        locations.find(|it| it.kind() == kind).unwrap().clone()
    }

    /// Letters for the arm go from here to there.
    fn knows_arm_at(&self, there: Location) {
        let arm = Registration::new("arm", ARM, vec![there]);
        self.directory.register(arm).unwrap();
    }

    fn shm(&self) -> ShmCounters {
        self.shm.counters()
    }

    fn tcp(&self) -> Counters {
        self.tcp.as_ref().unwrap().counters()
    }
}

/// The directory of a host that no other test has.
fn host() -> TempDir {
    let mut builder = tempfile::Builder::new();
    builder.prefix("copies-").tempdir().unwrap()
}

/// What is sent; the content is filled in place.
fn message() -> Message {
    Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap()
}

async fn received(place: &Place) -> Received {
    let letter = timeout(Duration::from_secs(60), place.mts.receive(ARM)).await;
    letter.unwrap().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn large_content_is_touched_by_the_kernel_alone() {
    let (here, there) = (host(), host());
    let (rovers, near) = (
        Place::process(here.path(), "rovers"),
        Place::gateway(here.path(), "near"),
    );
    let (far, arms) = (
        Place::gateway(there.path(), "far"),
        Place::process(there.path(), "arms"),
    );
    rovers.knows_arm_at(near.at(Kind::Shm));
    near.knows_arm_at(far.at(Kind::Tcp));
    far.knows_arm_at(arms.at(Kind::Shm));
    arms.knows_arm_at(arms.at(Kind::Shm));
    rovers.mts.register("rover".into(), ROVER);
    arms.mts.register("arm".into(), ARM);

    let message = message();
    for number in 0..LETTERS {
        let len = LEN + number;
        let (head, tail) = message.around_content(len).unwrap();
        let room = 4096 + head.len();
        let mut loan = rovers.mts.loan(ROVER, &["arm"], room, len, tail.len());
        loan.content_mut().fill(number as u8);
        let letter = letter_around(&message, loan.freeze(), SystemTime::now()).unwrap();
        let sending = rovers.mts.send(Submission {
            sender: ROVER,
            letter,
            receivers: vec!["arm".into()],
            deadline: Duration::from_secs(60),
        });
        let content = received(&arms).await.letter.into_payload().content;
        assert_eq!(content.len(), len);
        assert!(content.iter().all(|byte| *byte == number as u8));
        let outcomes = sending.outcomes().await;
        assert!(outcomes[0].1.is_success(), "{outcomes:?}");
    }

    let all = LETTERS as u64;
    // From its author's hands into shared memory, and held there by the gateway.
    let ShmCounters {
        loans_sent,
        loans_copied,
        ..
    } = rovers.shm();
    assert_eq!((loans_sent, loans_copied), (all, 0));
    let ShmCounters {
        in_place,
        copied_full,
        ..
    } = near.shm();
    assert_eq!((in_place, copied_full), (all, 0));
    // From there to the socket in pieces, which `transport-net` has tests for: a frame is written
    // from the letter's own memory. From the socket to where the receiver reads it:
    let Counters {
        placed,
        placed_moved_bytes,
        ..
    } = far.tcp();
    assert_eq!(placed, all);
    // Of the first one, what the hello before it was read together with.
    assert!(
        placed_moved_bytes < 16 << 10,
        "{placed_moved_bytes} bytes were moved"
    );
    let ShmCounters {
        loans_sent,
        loans_copied,
        ..
    } = far.shm();
    assert_eq!((loans_sent, loans_copied), (all, 0));
    let ShmCounters {
        in_place,
        copied_full,
        ..
    } = arms.shm();
    assert_eq!((in_place, copied_full), (all, 0));

    for place in [&rovers, &near, &far, &arms] {
        place.mts.close(Duration::from_secs(1)).await;
    }
}
