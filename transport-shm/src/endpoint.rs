//! An endpoint: who is known, and who does what when.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Instant;

use fipa_transport::{
    Abandoned, AttemptId, Conclusion, Incarnation, Location, Parcel, Sink, WayError, WayFault,
};
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::prelude::{ServiceName, SignalHandlingMode};
use parking_lot::{Mutex, RwLock};
use tokio::runtime::Handle;

use crate::counters::{Tally, count};
use crate::domain::{Domain, file_error};
use crate::fork::Owner;
use crate::inbox::{Inbox, mailbox_name};
use crate::layout::Svc;
use crate::library::Library;
use crate::loan::ShmLoan;
use crate::memory::{Budget, SHM};
use crate::outbox::{Opening, Outbox, Posted};
use crate::peers::Peer;
use crate::pool::Pool;
use crate::presence::{Bell, GLANCE, Neighbour, Presence, wait_for_looks};
use crate::shift::Shift;
use crate::storage::{self, Shortage};
use crate::{ShmConfig, ShmError};

/// What a transport and its tasks share.
pub(crate) struct Endpoint {
    config: ShmConfig,
    /// Files by which others find this process.
    files: Vec<PathBuf>,
    owner: Owner,
    runtime: Handle,
    sink: OnceLock<Arc<dyn Sink>>,
    closed: AtomicBool,
    /// The mailbox; whoever has it looks after answers, too.
    inbox: Shift<Option<Inbox>>,
    /// How many parcels have no answer yet.
    waiting: Arc<AtomicUsize>,
    /// Who has been answered, and has not been made to look for it yet.
    answered: Mutex<Vec<Incarnation>>,
    /// A peer has ended that is not forgotten yet.
    ended: AtomicBool,
    peers: RwLock<BTreeMap<Incarnation, Arc<Peer>>>,
    /// Counts uses of peers, to find the one not used for longest.
    uses: AtomicU64,
    node: Mutex<Option<Node<Svc>>>,
    presence: RwLock<Option<Presence>>,
    bell: Arc<Bell>,
    /// How often cleaning up was asked for.
    dirty: AtomicU64,
    cleaning: AtomicBool,
    budget: Arc<Budget>,
    /// Content of this process for many, and that of others.
    pool: Arc<Pool>,
    library: Arc<Library>,
    tally: Arc<Tally>,
    // Last: ends with the process's last trace.
    domain: Arc<Domain>,
}

impl Endpoint {
    pub(crate) fn open(config: ShmConfig, runtime: Handle) -> Result<Arc<Self>, ShmError> {
        let domain = Domain::new(&config)?;
        let budget = Arc::new(Budget::new(&config));
        // Under the lock, so that nobody takes what is half made for the traces of the dead.
        let lock = domain.enter()?;
        let domain = Arc::new(domain.joined());
        let opened = Self::open_locked(config, runtime, budget, Arc::clone(&domain));
        // Before the domain, whose last owner takes the lock to clean up when nothing was opened.
        drop(lock);
        let endpoint = opened?;
        endpoint.clean_soon();
        Ok(endpoint)
    }

    fn open_locked(
        config: ShmConfig,
        runtime: Handle,
        budget: Arc<Budget>,
        domain: Arc<Domain>,
    ) -> Result<Arc<Self>, ShmError> {
        budget.check_start()?;
        let tally = Arc::new(Tally::default());
        let presence = Presence::create(domain.names().clone(), config.incarnation)
            .map_err(|e| file_error("cannot make files in", domain.names().directory(), e))?;
        let bell = presence.bell().clone();
        let failed = |what: &'static str, reason: String, shortage: Option<Shortage>| {
            if let Some(shortage) = shortage {
                return ShmError::Full {
                    path: SHM,
                    needed: shortage.needed,
                    source: shortage.error.into(),
                };
            }
            ShmError::Iceoryx {
                what,
                reason,
                prefix: config.prefix.clone(),
            }
        };
        let (node, shortage) = storage::watch(|| {
            NodeBuilder::new()
                .config(domain.iceoryx())
                .signal_handling_mode(SignalHandlingMode::Disabled)
                .create::<Svc>()
        });
        let node = node.map_err(|e| failed("cannot make a node", format!("{e:?}"), shortage))?;
        domain.close_to_others()?;
        let library = Arc::new(Library::new(domain.clone()));
        let told = (bell.clone(), presence.looks());
        let (inbox, shortage) =
            storage::watch(|| Inbox::create(&config, &node, told, tally.clone(), library.clone()));
        let inbox = inbox.map_err(|reason| failed("cannot make the mailbox", reason, shortage))?;
        let pool = Pool::new(
            config.incarnation,
            config.share_from,
            budget.clone(),
            domain.clone(),
        );
        Ok(Arc::new(Self {
            files: domain.files_of(config.incarnation, inbox.service_hash()),
            config,
            owner: domain.owner(),
            runtime,
            sink: OnceLock::new(),
            closed: AtomicBool::new(false),
            inbox: Shift::new(Some(inbox)),
            waiting: Arc::default(),
            answered: Mutex::default(),
            ended: AtomicBool::new(false),
            peers: RwLock::default(),
            uses: AtomicU64::new(0),
            node: Mutex::new(Some(node)),
            presence: RwLock::new(Some(presence)),
            bell,
            dirty: AtomicU64::new(0),
            cleaning: AtomicBool::new(false),
            budget,
            pool: Arc::new(pool),
            library,
            tally,
            domain,
        }))
    }

    pub(crate) fn config(&self) -> &ShmConfig {
        &self.config
    }

    pub(crate) fn owner(&self) -> Owner {
        self.owner
    }

    pub(crate) fn runtime(&self) -> &Handle {
        &self.runtime
    }

    pub(crate) fn bell(&self) -> &Arc<Bell> {
        &self.bell
    }

    pub(crate) fn pool(&self) -> &Arc<Pool> {
        &self.pool
    }

    pub(crate) fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Whether others can find this process, as far as can be told.
    pub(crate) fn is_there(&self) -> bool {
        let missing = |file: &PathBuf| {
            let found = std::fs::symlink_metadata(file);
            found.is_err_and(|error| error.kind() == ErrorKind::NotFound)
        };
        !self.files.iter().any(missing)
    }

    /// Removes what is left of these files after closing: iceoryx2 leaves a mailbox while content
    /// from it is held.
    pub(crate) fn remove_files(&self) {
        for file in &self.files {
            // Mostly they are gone.
            let _ = std::fs::remove_file(file);
        }
    }

    pub(crate) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::SeqCst)
    }

    /// Who is told from now on; `false` if somebody is already, or nobody may any more.
    pub(crate) fn tell_to(&self, sink: Arc<dyn Sink>) -> bool {
        !self.is_closed() && self.sink.set(sink).is_ok()
    }

    /// Works on the calling thread; meanwhile nobody needs to ring.
    pub(crate) fn drive(self: &Arc<Self>) -> bool {
        if !self.owner.is_this() {
            return false;
        }
        let presence = self.presence.read();
        let Some(presence) = presence.as_ref() else {
            return false;
        };
        let mut found = false;
        for _ in 0..ROUNDS {
            let looking = presence.looking();
            // Several times, so that in a caller's loop the page says "looking" most of the time.
            found |= (0..LOOKS).any(|_| self.work());
            self.wait_for_answered();
            drop(looking);
            // What is found now is worked on while the page says so again.
            if !self.has_work() {
                self.wake_answered();
                return found;
            }
        }
        found |= self.work();
        self.wake_answered();
        found
    }

    /// Works because the bell has been rung, and was silenced.
    pub(crate) fn work_after_bell(self: &Arc<Self>) {
        let looked_after = self.presence.read().as_ref().is_some_and(|presence| {
            presence.heard();
            presence.is_looking()
        });
        self.pool.trim_if_waiting();
        // Whoever is at it is not disturbed.
        if !looked_after {
            self.work();
            self.wake_answered();
        }
    }

    /// Gives those who were answered a moment to look by themselves, or to send something more.
    fn wait_for_answered(&self) {
        let mut began = None;
        loop {
            let mut answered = self.answered.lock();
            let peers = self.peers.read();
            let lively = |one| peers.get(one).is_some_and(|peer| peer.was_looking());
            answered.retain(|one| !peers.get(one).is_some_and(|peer| peer.is_awake()));
            if !answered.iter().any(lively) {
                return;
            }
            drop((peers, answered));
            if began.get_or_insert_with(Instant::now).elapsed() > GLANCE || self.has_work() {
                return;
            }
        }
    }

    /// Makes those look for an answer who do not by themselves.
    fn wake_answered(self: &Arc<Self>) {
        let answered = std::mem::take(&mut *self.answered.lock());
        for sender in answered {
            self.wake(sender);
        }
    }

    /// Whether `work` would find something. When another thread is working, that one looks again.
    fn has_work(&self) -> bool {
        self.inbox.has_any(|inbox| {
            inbox.as_ref().is_some_and(Inbox::has_parcels)
                || self.waits_for_answers()
                    && self.peers.read().values().any(|peer| peer.has_answer())
        })
    }

    fn waits_for_answers(&self) -> bool {
        self.waiting.load(Ordering::SeqCst) > 0
    }

    /// Looks into the mailbox and after answers. Says whether there was anything. When another
    /// thread is at it, that one looks again.
    pub(crate) fn work(self: &Arc<Self>) -> bool {
        self.inbox.work(|inbox| match (inbox, self.sink.get()) {
            (Some(inbox), Some(sink)) => self.work_once(inbox, &**sink),
            _ => false,
        })
    }

    fn work_once(self: &Arc<Self>, inbox: &mut Inbox, sink: &dyn Sink) -> bool {
        let mut found = inbox.drain(sink, &self.answered);
        if self.ended.swap(false, Ordering::SeqCst) || self.waits_for_answers() {
            let mut concluded = Vec::new();
            let mut ended = Vec::new();
            for peer in self.peers.read().values() {
                if peer.collect(&mut concluded) {
                    ended.push(peer.incarnation());
                }
            }
            for incarnation in ended {
                self.peers.write().remove(&incarnation);
            }
            found |= !concluded.is_empty();
            tell(sink, concluded);
        }
        found
    }

    /// Makes a process look for its answers.
    fn wake(self: &Arc<Self>, sender: Incarnation) {
        let rung = match self.peer(sender) {
            Ok(peer) => peer.wake(),
            // It has ended and needs no answer, or too many are known already.
            Err(_) => {
                self.domain.names().ring_once(sender);
                true
            }
        };
        if rung {
            count(&self.tally.rung);
        }
    }

    pub(crate) fn post(
        self: &Arc<Self>,
        attempt: AttemptId,
        to: &Location,
        parcel: &Parcel,
    ) -> Result<(), WayError> {
        self.check_owner()?;
        if self.sink.get().is_none() {
            return Err(closed());
        }
        // A second try when the outbox takes nothing any more.
        for _ in 0..2 {
            let peer = self.peer_at(to)?;
            match self.outbox(&peer)?.post(attempt, parcel)? {
                Posted::Yes => {
                    count(&self.tally.sent);
                    if peer.wake() {
                        count(&self.tally.rung);
                    }
                    return Ok(());
                }
                Posted::Retired => peer.renew(),
            }
        }
        Err(WayError::new(
            WayFault::Congested,
            "the connection is being renewed",
        ))
    }

    /// Ends an attempt. The parcel lies in the other process's mailbox, and may be taken.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> Abandoned {
        let peers = self.peers.read();
        let _known = peers.values().any(|peer| peer.abandon(attempt));
        Abandoned::Unconfirmed
    }

    pub(crate) fn loan(
        self: &Arc<Self>,
        to: &Location,
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Result<ShmLoan, WayError> {
        self.check_owner()?;
        let peer = self.peer_at(to)?;
        self.outbox(&peer)?.loan(head_room, len, tail_room)
    }

    fn check_owner(&self) -> Result<(), WayError> {
        match self.owner.is_this() {
            true => Ok(()),
            false => Err(WayError::new(
                WayFault::Closed,
                "this process was forked from the one that opened shared memory",
            )),
        }
    }

    /// Opens a mailbox if that was not done before.
    fn outbox(&self, peer: &Peer) -> Result<Arc<Outbox>, WayError> {
        peer.outbox(|| {
            let node = self.node.lock();
            let name = mailbox_name(peer.incarnation());
            let service = ServiceName::new(&name)
                .map_err(|e| WayError::new(WayFault::Unreachable, format_args!("{e:?}")))?;
            Outbox::open(Opening {
                node: node.as_ref().ok_or_else(closed)?,
                service: &service,
                own: self.config.incarnation,
                waiting: self.waiting.clone(),
                max_loans: self.config.max_loans,
                budget: self.budget.clone(),
                pool: self.pool.clone(),
                tally: self.tally.clone(),
                domain: self.domain.clone(),
            })
        })
    }

    fn peer_at(self: &Arc<Self>, to: &Location) -> Result<Arc<Peer>, WayError> {
        let incarnation: Incarnation = to.address().parse().map_err(|e| {
            WayError::new(WayFault::Unreachable, format_args!("not a mailbox: {e}"))
        })?;
        if to.incarnation().is_known() && to.incarnation() != incarnation {
            return Err(WayError::new(
                WayFault::WrongIncarnation,
                format_args!("the mailbox is that of {incarnation}"),
            ));
        }
        self.peer(incarnation)
    }

    /// A process, looked for if it was not known before.
    fn peer(self: &Arc<Self>, incarnation: Incarnation) -> Result<Arc<Peer>, WayError> {
        let now = self.uses.fetch_add(1, Ordering::Relaxed);
        if let Some(peer) = self.peers.read().get(&incarnation) {
            peer.mark_used(now);
            return Ok(peer.clone());
        }
        let mut peers = self.peers.write();
        if self.is_closed() {
            return Err(closed());
        }
        if let Some(peer) = peers.get(&incarnation) {
            return Ok(peer.clone());
        }
        if peers.len() >= self.config.max_peers {
            let idle = peers.values().filter(|peer| peer.is_idle());
            let oldest = idle.min_by_key(|peer| peer.last_used());
            let oldest = oldest.map(|peer| peer.incarnation()).ok_or_else(|| {
                WayError::new(
                    WayFault::Congested,
                    format_args!(
                        "letters to {} processes are without an answer (max_peers)",
                        self.config.max_peers
                    ),
                )
            })?;
            if let Some(oldest) = peers.remove(&oldest) {
                oldest.end();
            }
        }
        let names = self.domain.names();
        let neighbour = Neighbour::open(names, incarnation).map_err(|e| match e.kind() {
            ErrorKind::NotFound => WayError::new(
                WayFault::Unreachable,
                format_args!(
                    "no process {incarnation} in {}",
                    names.directory().display()
                ),
            ),
            _ => WayError::new(
                WayFault::Congested,
                format_args!("the files of process {incarnation} cannot be opened: {e}"),
            ),
        })?;
        let peer = Arc::new(Peer::new(incarnation, neighbour));
        let endpoint = Arc::downgrade(self);
        let ended = move || {
            if let Some(endpoint) = endpoint.upgrade() {
                endpoint.peer_ended(incarnation);
            }
        };
        peer.watch(&self.runtime, ended).map_err(|e| {
            WayError::new(
                WayFault::Congested,
                format_args!("the process {incarnation} cannot be watched: {e}"),
            )
        })?;
        peer.mark_used(now);
        peers.insert(incarnation, peer.clone());
        Ok(peer)
    }

    /// A process has ended: concludes what waits for it, and removes its traces.
    pub(crate) fn peer_ended(self: &Arc<Self>, incarnation: Incarnation) {
        let peer = self.peers.read().get(&incarnation).cloned();
        if let Some(peer) = peer {
            peer.end();
            self.ended.store(true, Ordering::SeqCst);
            count(&self.tally.peers_gone);
        }
        // Its last letters are taken, and its answers.
        self.work();
        self.wake_answered();
        self.library.forget(incarnation);
        self.clean_soon();
    }

    /// Removes the traces of dead processes, after the living have taken their letters.
    pub(crate) fn clean_soon(self: &Arc<Self>) {
        self.dirty.fetch_add(1, Ordering::SeqCst);
        if self.is_closed() || self.cleaning.swap(true, Ordering::SeqCst) {
            return;
        }
        let endpoint = Arc::downgrade(self);
        // On a thread of its own: it takes milliseconds of file system calls, and waits.
        self.runtime.spawn_blocking(move || {
            loop {
                let Some(now) = endpoint.upgrade() else {
                    return;
                };
                let seen = now.dirty.load(Ordering::SeqCst);
                let turn = now.domain.turn(now.config.incarnation);
                drop(now);
                // One after the other: mostly, the first one does it for all.
                std::thread::sleep(turn);
                let Some(now) = endpoint.upgrade().filter(|now| !now.is_closed()) else {
                    return;
                };
                let domain = now.domain.clone();
                drop(now);
                let alive = match domain.has_dead() {
                    true => domain.settle().unwrap_or(0),
                    false => 0,
                };
                drop(domain);
                let Some(now) = endpoint.upgrade().filter(|now| !now.is_closed()) else {
                    return;
                };
                // What fails is tried again at the next occasion, by this process or another.
                if alive > 0 {
                    let _ = now.domain.clean(false);
                }
                now.cleaning.store(false, Ordering::SeqCst);
                let more = now.dirty.load(Ordering::SeqCst) != seen;
                if !more || now.cleaning.swap(true, Ordering::SeqCst) {
                    return;
                }
            }
        });
    }

    /// Closes the endpoint. Must not be called by the sink while it is told something.
    pub(crate) fn close(&self) {
        if !self.owner.is_this() || self.closed.swap(true, Ordering::SeqCst) {
            return;
        }
        // While others still know that this process is there.
        self.pool.close();
        // What others have not taken yet they must take before the way it came is gone.
        let peers: Vec<_> = self.peers.read().values().cloned().collect();
        peers.iter().for_each(|peer| peer.retire());
        wait_for_looks(peers.iter().filter_map(|peer| peer.untaken()), || false);
        drop(peers);
        let mut concluded = Vec::new();
        let peers = {
            let mut inbox = self.inbox.lock();
            // First nothing more is taken, then others are told, then our own letters end.
            *inbox = None;
            *self.presence.write() = None;
            let peers = std::mem::take(&mut *self.peers.write());
            for peer in peers.values() {
                peer.close(&mut concluded);
            }
            peers
        };
        drop(peers);
        *self.node.lock() = None;
        if let Some(sink) = self.sink.get() {
            tell(&**sink, concluded);
        }
        // Nobody to report to; what cannot be removed is removed by the next who starts.
        let _ = self.domain.leave();
    }
}

/// How often [`Endpoint::drive`] looks at a time: a microsecond or two.
const LOOKS: usize = 8;

/// How often [`Endpoint::drive`] begins again when there is more.
const ROUNDS: usize = 4;

fn tell(sink: &dyn Sink, concluded: Vec<(AttemptId, Conclusion)>) {
    for (attempt, conclusion) in concluded {
        sink.concluded(attempt, conclusion);
    }
}

fn closed() -> WayError {
    WayError::new(WayFault::Closed, "")
}
