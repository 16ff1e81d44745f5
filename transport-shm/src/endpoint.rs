//! The endpoint of a process: its mailbox, its peers, polling, wake-ups and cleanup.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use fipa_transport::{
    Abandoned, Answer, AttemptId, Incarnation, Location, Parcel, Sink, Ticket, TransportError,
    TransportErrorKind, log_limit, threads,
};
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::prelude::{ServiceName, SignalHandlingMode};
use parking_lot::{Condvar, Mutex, RwLock};
use tokio::runtime::Handle;

use crate::answered::Answered;
use crate::combiner::Combiner;
use crate::counters::{Tally, count};
use crate::deferred::LateAnswers;
use crate::domain_files::{DomainFiles, file_error};
use crate::errors::{self, closed, opening};
use crate::fork::OwnerMark;
use crate::inbox::{Inbox, mailbox_name};
use crate::layout::Svc;
use crate::loan::ShmLoan;
use crate::memory::Budget;
use crate::outbox::Concluded;
use crate::outbox::{AnswerLook, MemoryLock, Opening, Outbox};
use crate::peer_segments::PeerSegments;
use crate::peers::{BacklogLimits, BacklogStep, Dispatched, OpenOutbox, Peer, gone};
use crate::pool::Pool;
use crate::presence::{Doorbell, POLL_GRACE, PeerProcess, Presence, WordLender, wait_for_polls};
use crate::shared_files::SHM;
use crate::storage::{self, Shortage};
use crate::{ShmConfig, ShmError};

/// The state that a transport and its tasks share.
pub(crate) struct Endpoint {
    config: ShmConfig,
    /// The files by which other processes find this one.
    files: Vec<PathBuf>,
    owner: OwnerMark,
    runtime: Handle,
    sink: OnceLock<Arc<dyn Sink>>,
    closed: AtomicBool,
    /// The mailbox. The thread that works on it also collects answers.
    inbox: Combiner<Option<Inbox>>,
    /// Number of unanswered parcels.
    waiting: Arc<AtomicUsize>,
    answered: Answered,
    /// Parcels that are answered later.
    deferred: Arc<LateAnswers>,
    /// Whether a peer has ended and is still in `peers`.
    ended: AtomicBool,
    peers: RwLock<BTreeMap<Incarnation, Arc<Peer>>>,
    /// Counts uses of peers, to find the least recently used one.
    uses: AtomicU64,
    node: Mutex<Option<Node<Svc>>>,
    backlogs: Arc<BacklogThreads>,
    closing: Arc<Closing>,
    presence: RwLock<Option<Presence>>,
    lender: Arc<WordLender>,
    doorbell: Arc<Doorbell>,
    /// Number of requests for a cleanup.
    dirty: AtomicU64,
    cleaning: AtomicBool,
    budget: Arc<Budget>,
    /// Segments of this process and of others.
    pool: Arc<Pool>,
    peer_segments: Arc<PeerSegments>,
    tally: Arc<Tally>,
    // Last: the last owner removes the domain's files.
    domain: Arc<DomainFiles>,
}

impl Endpoint {
    /// Opens the endpoint. `generation` differs from that of all mailboxes that this process had before.
    pub(crate) fn open(
        config: ShmConfig,
        generation: u64,
        runtime: Handle,
    ) -> Result<Arc<Self>, ShmError> {
        let budget = Arc::new(Budget::new(&config));
        // Under the lock, so that no other process takes unfinished files for those of a dead one.
        let (domain, lock) = DomainFiles::enter(&config)?;
        let domain = Arc::new(domain.for_endpoint());
        let opened = Self::open_locked(config, generation, runtime, budget, Arc::clone(&domain));
        // Before `domain` is dropped: after a failure, its last owner takes the lock to clean up.
        drop(lock);
        let endpoint = opened?;
        endpoint.start_cleanup();
        Ok(endpoint)
    }

    fn open_locked(
        config: ShmConfig,
        generation: u64,
        runtime: Handle,
        budget: Arc<Budget>,
        domain: Arc<DomainFiles>,
    ) -> Result<Arc<Self>, ShmError> {
        budget.check_start()?;
        let tally = Arc::new(Tally::default());
        let presence = Presence::create(domain.paths().clone(), config.incarnation)
            .map_err(|e| file_error("cannot create files in", domain.paths().directory(), e))?;
        let doorbell = presence.doorbell().clone();
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
        let (node, shortage) = storage::with_shortage(|| {
            NodeBuilder::new()
                .config(domain.iceoryx())
                .signal_handling_mode(SignalHandlingMode::Disabled)
                .create::<Svc>()
        });
        let node = node.map_err(|e| failed("cannot create a node", errors::words(&e), shortage))?;
        domain.restrict_permissions()?;
        let peer_segments = Arc::new(PeerSegments::new(domain.clone()));
        let deferred = Arc::<LateAnswers>::default();
        let (inbox, shortage) = storage::with_shortage(|| {
            Inbox::create(
                &config,
                generation,
                &node,
                &presence,
                tally.clone(),
                (peer_segments.clone(), deferred.clone()),
            )
        });
        let inbox =
            inbox.map_err(|reason| failed("cannot create the mailbox", reason, shortage))?;
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
            inbox: Combiner::new(Some(inbox)),
            waiting: Arc::default(),
            answered: Answered::default(),
            deferred,
            ended: AtomicBool::new(false),
            peers: RwLock::default(),
            uses: AtomicU64::new(0),
            node: Mutex::new(Some(node)),
            backlogs: Arc::default(),
            closing: Arc::default(),
            lender: presence.lender().clone(),
            presence: RwLock::new(Some(presence)),
            doorbell,
            dirty: AtomicU64::new(0),
            cleaning: AtomicBool::new(false),
            budget,
            pool: Arc::new(pool),
            peer_segments,
            tally,
            domain,
        }))
    }

    pub(crate) fn config(&self) -> &ShmConfig {
        &self.config
    }

    pub(crate) fn owner(&self) -> OwnerMark {
        self.owner
    }

    pub(crate) fn runtime(&self) -> &Handle {
        &self.runtime
    }

    pub(crate) fn doorbell(&self) -> &Arc<Doorbell> {
        &self.doorbell
    }

    pub(crate) fn pool(&self) -> &Arc<Pool> {
        &self.pool
    }

    pub(crate) fn tally(&self) -> &Tally {
        &self.tally
    }

    /// The files by which other processes find this one.
    pub(crate) fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// Whether all files exist by which other processes find this one.
    pub(crate) fn is_there(&self) -> bool {
        let missing = |file: &PathBuf| {
            let found = std::fs::symlink_metadata(file);
            found.is_err_and(|error| error.kind() == ErrorKind::NotFound)
        };
        !self.files.iter().any(missing)
    }

    pub(crate) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::SeqCst)
    }

    /// Sets the sink. Returns false if there is one already or the endpoint is closed.
    pub(crate) fn set_sink(&self, sink: Arc<dyn Sink>) -> bool {
        !self.is_closed() && self.sink.set(sink).is_ok()
    }

    /// Works on the calling thread. Peers do not ring meanwhile. Returns whether there was work.
    pub(crate) fn drive(self: &Arc<Self>) -> bool {
        if !self.owner.is_this() {
            return false;
        }
        let presence = self.presence.read();
        let Some(presence) = presence.as_ref() else {
            return false;
        };
        let mut found = false;
        for round in 0..MAX_ROUNDS {
            let polling = presence.page().words().begin_polling();
            // Several times, so that the page states "polling" most of the time in a caller's loop.
            // A round after the first one has a reason to look into the mailbox.
            found |= (0..POLLS_PER_ROUND).any(|poll| match poll {
                0 => self.look(round > 0, AnswerLook::Thorough),
                _ => self.look(false, AnswerLook::Quick),
            });
            self.wait_for_answered();
            drop(polling);
            // Work that arrived meanwhile is done in the next round, in which the page states
            // "polling" again. Without work there is time to look for parcels that were not
            // announced, so a faulty peer cannot hide parcels of others.
            if !self.has_work(!found) {
                self.wake_answered();
                return found;
            }
        }
        found |= self.work(true);
        self.wake_answered();
        found
    }

    /// Works after a wake-up. The caller has cleared the doorbell.
    pub(crate) fn work_after_wakeup(self: &Arc<Self>) {
        let polling_elsewhere = self.presence.read().as_ref().is_some_and(|presence| {
            let words = presence.page().words();
            words.count_wakeup();
            words.is_polling()
        });
        self.pool.trim_if_waiting();
        // A thread that polls does the work.
        if !polling_elsewhere {
            self.work(true);
            self.wake_answered();
        }
    }

    /// Gives answered senders a moment to poll by themselves or to send more.
    fn wait_for_answered(&self) {
        let mut began = None;
        while self.answered.has_any() {
            let peers = self.peers.read();
            let polled_recently = self.answered.retain(
                |one| !peers.get(one).is_some_and(|peer| peer.is_awake()),
                |one| peers.get(one).is_some_and(|peer| peer.was_polling()),
            );
            drop(peers);
            if !polled_recently {
                return;
            }
            let waited = began.get_or_insert_with(Instant::now).elapsed();
            if waited > POLL_GRACE || self.has_work(false) {
                return;
            }
        }
    }

    /// Wakes the answered senders that are not polling.
    fn wake_answered(self: &Arc<Self>) {
        for sender in self.answered.take() {
            self.wake(sender);
        }
    }

    /// Whether `work` would find something. False if another thread works, which then looks again.
    fn has_work(&self, unannounced: bool) -> bool {
        self.inbox.has_any(|inbox| {
            inbox
                .as_ref()
                .is_some_and(|inbox| inbox.has_parcels(unannounced))
                || self.waits_for_answers()
                    && self.peers.read().values().any(|peer| peer.has_answer())
        })
    }

    fn waits_for_answers(&self) -> bool {
        self.waiting.load(Ordering::SeqCst) > 0
    }

    /// Takes parcels from the mailbox and collects answers. Returns whether there was any. Looks
    /// into the mailbox if a parcel was announced, or with `unannounced` in any case. If another
    /// thread works, that one makes another pass instead.
    pub(crate) fn work(self: &Arc<Self>, unannounced: bool) -> bool {
        self.look(unannounced, AnswerLook::Thorough)
    }

    fn look(self: &Arc<Self>, unannounced: bool, answers: AnswerLook) -> bool {
        self.inbox.work(|inbox| match (inbox, self.sink.get()) {
            (Some(inbox), Some(sink)) => self.work_once(inbox, &**sink, unannounced, answers),
            _ => false,
        })
    }

    fn work_once(
        self: &Arc<Self>,
        inbox: &mut Inbox,
        sink: &dyn Sink,
        unannounced: bool,
        answers: AnswerLook,
    ) -> bool {
        let page_of = |sender| {
            let peers = self.peers.read();
            peers.get(&sender).map(|peer| Arc::clone(peer.page()))
        };
        let mut found = inbox.drain(sink, &self.answered, &page_of, unannounced);
        let has_ended =
            self.ended.load(Ordering::SeqCst) && self.ended.swap(false, Ordering::SeqCst);
        if has_ended || self.waits_for_answers() {
            let mut concluded = Concluded::new();
            let mut ended = Vec::new();
            for peer in self.peers.read().values() {
                if peer.collect(answers, &mut concluded) {
                    ended.push(peer.incarnation());
                }
            }
            for incarnation in ended {
                self.peers.write().remove(&incarnation);
            }
            found |= !concluded.is_empty();
            report_conclusions(sink, concluded);
        }
        found
    }

    /// Wakes a process so that it collects its answers.
    fn wake(self: &Arc<Self>, sender: Incarnation) {
        let rung = match self.peer(sender) {
            Ok(peer) => peer.wake(),
            // The process has ended and needs no answer, or too many peers are open already.
            Err(_) => {
                self.domain.paths().ring_once(sender);
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
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        self.check_owner()?;
        if self.sink.get().is_none() {
            return Err(closed());
        }
        let peer = self.peer_at(to)?;
        let limits = BacklogLimits {
            letters: self.config.window,
            parcels: self.config.places(),
            bytes: self.config.max_letter,
        };
        match peer.post(attempt, parcel, limits)? {
            Dispatched::Sent => self.wake_for_parcel(&peer),
            Dispatched::Queued => {}
            Dispatched::QueuedFirst => self.start_backlog(peer),
        }
        Ok(())
    }

    fn wake_for_parcel(&self, peer: &Peer) {
        count(&self.tally.sent);
        if peer.wake() {
            count(&self.tally.rung);
        }
    }

    /// Starts a thread that opens a peer's mailbox and sends its backlog. Both may wait for other
    /// processes.
    fn start_backlog(self: &Arc<Self>, peer: Arc<Peer>) {
        let (endpoint, threads) = (Arc::downgrade(self), Arc::clone(&self.backlogs));
        let (runtime, served) = (self.runtime.clone(), Arc::clone(&peer));
        let started = threads::spawn(move || {
            let _inside = runtime.enter();
            let _running = threads.enter();
            // Without the endpoint, the parcels are concluded already.
            if let Some(endpoint) = endpoint.upgrade() {
                endpoint.serve_backlog(&served);
            }
        });
        if let Err(error) = started {
            let error = TransportError::new(TransportErrorKind::Congested, error);
            let endpoint = Arc::downgrade(self);
            // A task, because the sink must not be called from within `post`.
            self.runtime.spawn(async move {
                if let Some(endpoint) = endpoint.upgrade() {
                    let mut concluded = Concluded::new();
                    peer.fail_backlog(&error, &mut concluded);
                    endpoint.report(concluded);
                }
            });
        }
    }

    fn serve_backlog(&self, peer: &Peer) {
        let mut lock = None;
        loop {
            let mut concluded = Concluded::new();
            let step = peer.send_next(lock.take(), &mut concluded);
            match step {
                BacklogStep::Sent => self.wake_for_parcel(peer),
                BacklogStep::Failed => {}
                BacklogStep::NeedsMemory => match self.budget.lock() {
                    Ok(taken) => lock = Some(taken),
                    Err(error) => peer.fail_next(error, &mut concluded),
                },
                BacklogStep::NotOpen => {
                    if let Err(error) = self.open_waiting(peer) {
                        peer.fail_backlog(&error, &mut concluded);
                        self.report(concluded);
                        return;
                    }
                }
                BacklogStep::Empty => return,
            }
            self.report(concluded);
        }
    }

    /// Answers a parcel that was not answered when it arrived.
    pub(crate) fn answer(self: &Arc<Self>, ticket: Ticket, answer: &Answer) {
        if self.owner.is_this()
            && let Some(sender) = self.deferred.answer(ticket, answer)
        {
            self.wake(sender);
        }
    }

    /// Abandons an attempt to this process. The parcel may be in its mailbox, and the process may still
    /// take it.
    pub(crate) fn abandon(&self, attempt: AttemptId, process: Incarnation) -> Abandoned {
        let peer = self.peers.read().get(&process).cloned();
        let abandoned = peer.and_then(|peer| peer.abandon(attempt));
        abandoned.unwrap_or(Abandoned::Unconfirmed)
    }

    pub(crate) fn loan(
        self: &Arc<Self>,
        to: &Location,
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Result<ShmLoan, TransportError> {
        self.check_owner()?;
        let peer = self.peer_at(to)?;
        let outbox = match peer.outbox()? {
            OpenOutbox::Open(outbox) => outbox,
            OpenOutbox::Claimed => {
                let opened = self.open_at_once(&peer);
                // Parcels that were queued meanwhile, or the mailbox if it could not be opened
                // without a wait.
                let waits = matches!(opened, Ok(None));
                if waits || !peer.leave_backlog() {
                    self.start_backlog(peer);
                }
                opened?.ok_or_else(opening)?
            }
        };
        outbox.loan(head_room, len, tail_room)
    }

    fn check_owner(&self) -> Result<(), TransportError> {
        match self.owner.is_this() {
            true => Ok(()),
            false => Err(TransportError::new(
                TransportErrorKind::Closed,
                "this process was forked from the one that opened shared memory",
            )),
        }
    }

    /// Opens a peer's mailbox. Waits for other processes.
    fn open_waiting(&self, peer: &Peer) -> Result<(), TransportError> {
        if peer.is_open() {
            return Ok(());
        }
        let lock = self
            .domain
            .lock_shared()
            .map_err(|e| TransportError::new(TransportErrorKind::Congested, e))?;
        let node = self.node.lock();
        self.open_outbox(peer, node.as_ref(), lock, MemoryLock::Wait)
            .map(drop)
    }

    /// Opens a peer's mailbox. `None` if that would take a wait.
    fn open_at_once(&self, peer: &Peer) -> Result<Option<Arc<Outbox>>, TransportError> {
        let Some(node) = self.node.try_lock() else {
            return Ok(None);
        };
        let lock = self
            .domain
            .try_lock_shared()
            .map_err(|e| TransportError::new(TransportErrorKind::Congested, e))?;
        let Some(lock) = lock else {
            return Ok(None);
        };
        self.open_outbox(peer, node.as_ref(), lock, MemoryLock::Try)
            .map(Some)
    }

    /// Opens a peer's mailbox. The node stays locked meanwhile, so that it outlives the outbox if
    /// the peer has ended.
    fn open_outbox(
        &self,
        peer: &Peer,
        node: Option<&Node<Svc>>,
        lock: OwnedFd,
        memory: MemoryLock,
    ) -> Result<Arc<Outbox>, TransportError> {
        let node = node.filter(|_| !self.is_closed()).ok_or_else(closed)?;
        let name = mailbox_name(peer.incarnation(), peer.page().words().generation());
        let service = ServiceName::new(&name).map_err(|e| {
            TransportError::new(
                TransportErrorKind::Unreachable,
                format_args!("{}", errors::words(&e)),
            )
        })?;
        let opened = Outbox::open(Opening {
            node,
            service: &service,
            own: self.config.incarnation,
            lender: self.lender.clone(),
            page: Arc::clone(peer.page()),
            waiting: self.waiting.clone(),
            max_loans: self.config.max_loans,
            budget: self.budget.clone(),
            pool: self.pool.clone(),
            tally: self.tally.clone(),
            domain: self.domain.clone(),
            lock,
            memory,
        });
        peer.opened(opened.map_err(|error| self.short_of_descriptors(error))?)
    }

    /// Returns the error of a mailbox that could not be opened. iceoryx2 has no text for a lack of descriptors. Then
    /// idle connections are given up, so that a later attempt finds descriptors.
    fn short_of_descriptors(&self, error: TransportError) -> TransportError {
        let Some(limit) = errors::reached_limit() else {
            return error;
        };
        if let Some(mut peers) = self.peers.try_write() {
            let _ = (0..GIVEN_UP).all(|_| give_up_idle(&mut peers));
        }
        let detail = format_args!("{}: {}", error.detail, errors::limit_text(limit));
        TransportError::new(TransportErrorKind::Congested, detail)
    }

    fn peer_at(self: &Arc<Self>, to: &Location) -> Result<Arc<Peer>, TransportError> {
        let incarnation: Incarnation = to.address().parse().map_err(|e| {
            TransportError::new(
                TransportErrorKind::Unreachable,
                format_args!("not the address of a mailbox: {e}"),
            )
        })?;
        if to.incarnation().is_known() && to.incarnation() != incarnation {
            return Err(TransportError::new(
                TransportErrorKind::WrongIncarnation,
                format_args!("the mailbox belongs to incarnation {incarnation}"),
            ));
        }
        self.peer(incarnation)
    }

    /// Returns a peer; opens its files if necessary.
    fn peer(self: &Arc<Self>, incarnation: Incarnation) -> Result<Arc<Peer>, TransportError> {
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
            give_up_idle(&mut peers).then_some(()).ok_or_else(|| {
                TransportError::new(
                    TransportErrorKind::Congested,
                    format_args!(
                        "letters to {} processes are unanswered; raise max_peers",
                        self.config.max_peers
                    ),
                )
            })?;
        }
        let paths = self.domain.paths();
        let mut opened = PeerProcess::open(paths, incarnation);
        // The descriptors of a connection become free when its last user has dropped it; the next attempt finds them.
        if opened.as_ref().is_err_and(errors::lacks_descriptors) && give_up_idle(&mut peers) {
            opened = PeerProcess::open(paths, incarnation);
        }
        if opened
            .as_ref()
            .is_err_and(|e| e.kind() == ErrorKind::BrokenPipe)
        {
            drop(peers);
            // The end of an open connection would have started it.
            self.start_cleanup();
            return Err(gone(incarnation));
        }
        let process = opened.map_err(|e| match e.kind() {
            ErrorKind::NotFound => TransportError::new(
                TransportErrorKind::Unreachable,
                format_args!(
                    "no process {incarnation} in {}",
                    paths.directory().display()
                ),
            ),
            _ => TransportError::new(
                TransportErrorKind::Congested,
                format_args!(
                    "cannot open the files of process {incarnation}: {}",
                    errors::with_limit(&e)
                ),
            ),
        })?;
        let peer = Arc::new(Peer::new(incarnation, process));
        let endpoint = Arc::downgrade(self);
        let ended = move || {
            if let Some(endpoint) = endpoint.upgrade() {
                endpoint.peer_ended(incarnation);
            }
        };
        peer.watch(&self.runtime, ended).map_err(|e| {
            TransportError::new(
                TransportErrorKind::Congested,
                format_args!(
                    "cannot watch process {incarnation}: {}",
                    errors::with_limit(&e)
                ),
            )
        })?;
        peer.mark_used(now);
        peers.insert(incarnation, peer.clone());
        Ok(peer)
    }

    /// Handles the end of a process: concludes the letters to it, and cleans up after it.
    pub(crate) fn peer_ended(self: &Arc<Self>, incarnation: Incarnation) {
        let peer = self.peers.read().get(&incarnation).cloned();
        if let Some(peer) = peer {
            peer.end();
            self.ended.store(true, Ordering::SeqCst);
            count(&self.tally.peers_gone);
        }
        // Takes its last letters and answers.
        self.work(true);
        self.wake_answered();
        self.peer_segments.forget(incarnation);
        self.start_cleanup();
    }

    /// Starts a cleanup in the background. If one runs, it is repeated afterwards.
    pub(crate) fn start_cleanup(self: &Arc<Self>) {
        self.dirty.fetch_add(1, Ordering::SeqCst);
        if self.is_closed() || self.cleaning.swap(true, Ordering::SeqCst) {
            return;
        }
        let (endpoint, closing) = (Arc::downgrade(self), Arc::clone(&self.closing));
        let runtime = self.runtime.clone();
        // On a thread of its own: it takes milliseconds of file system calls, and waits.
        let started = threads::spawn(move || {
            let _inside = runtime.enter();
            loop {
                let Some(now) = endpoint.upgrade() else {
                    return;
                };
                let seen = now.dirty.load(Ordering::SeqCst);
                let cleanup_delay = now.domain.cleanup_delay(now.config.incarnation);
                drop(now);
                // Processes clean up one after the other; mostly the first one removes everything.
                // A runtime that ends waits for this thread, so a process that ends ends the pause.
                closing.wait_for(cleanup_delay);
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
                // A failed cleanup is repeated at the next occasion, by this process or another.
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
        if let Err(error) = started {
            // Repeated at the next occasion.
            self.cleaning.store(false, Ordering::SeqCst);
            log_limit::warn!(%error, "cannot remove the files of ended processes now");
        }
    }

    fn report(&self, concluded: Concluded) {
        if let Some(sink) = self.sink.get() {
            report_conclusions(&**sink, concluded);
        }
    }

    /// Closes the endpoint. The sink must not call this from one of its methods.
    pub(crate) fn close(&self) {
        if !self.owner.is_this() || self.closed.swap(true, Ordering::SeqCst) {
            return;
        }
        self.domain.begin_closing();
        self.closing.begin();
        // While other processes still consider this process alive.
        self.pool.close();
        // Peers must take the remaining parcels before the outboxes are closed.
        let peers: Vec<_> = self.peers.read().values().cloned().collect();
        peers.iter().for_each(|peer| peer.retire());
        wait_for_polls(peers.iter().filter_map(|peer| peer.untaken()), || false);
        drop(peers);
        let mut concluded = Concluded::new();
        let peers = {
            let mut inbox = self.inbox.lock();
            // First the mailbox closes, then peers detect the end, then the own letters are
            // concluded.
            self.deferred.drop_all();
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
        // They hold files of the domain.
        self.backlogs.wait();
        self.report(concluded);
        // The error has no receiver; the next process that starts removes what is left.
        let _ = self.domain.leave();
    }
}

/// Number of idle connections that are given up when descriptors are short: their descriptors suffice for another one.
const GIVEN_UP: usize = 2;

/// Ends the connection that has been idle for the longest time. Returns whether there was one.
fn give_up_idle(peers: &mut BTreeMap<Incarnation, Arc<Peer>>) -> bool {
    let idle = peers.values().filter(|peer| peer.is_idle());
    let oldest = idle.min_by_key(|peer| peer.last_used());
    let oldest = oldest.map(|peer| peer.incarnation());
    let oldest = oldest.and_then(|oldest| peers.remove(&oldest));
    oldest.is_some_and(|oldest| {
        oldest.end();
        true
    })
}

/// Number of polls in one round of [`Endpoint::drive`]; they take one to two microseconds.
const POLLS_PER_ROUND: usize = 8;

/// Maximum number of rounds of [`Endpoint::drive`] while there is work.
const MAX_ROUNDS: usize = 4;

fn report_conclusions(sink: &dyn Sink, concluded: Concluded) {
    for (attempt, conclusion) in concluded {
        sink.concluded(attempt, conclusion);
    }
}

/// Whether the endpoint closes.
#[derive(Debug, Default)]
struct Closing {
    began: Mutex<bool>,
    changed: Condvar,
}

impl Closing {
    fn begin(&self) {
        *self.began.lock() = true;
        self.changed.notify_all();
    }

    /// Waits until the endpoint closes, at most this long.
    fn wait_for(&self, timeout: Duration) {
        let mut began = self.began.lock();
        let is_open = |began: &mut bool| !*began;
        self.changed.wait_while_for(&mut began, is_open, timeout);
    }
}

/// The threads that serve backlogs.
#[derive(Debug, Default)]
struct BacklogThreads {
    running: Mutex<usize>,
    ended: Condvar,
}

/// A running thread that serves a backlog.
struct BacklogThread<'a>(&'a BacklogThreads);

impl BacklogThreads {
    fn enter(&self) -> BacklogThread<'_> {
        *self.running.lock() += 1;
        BacklogThread(self)
    }

    /// Waits until none is running.
    fn wait(&self) {
        let mut running = self.running.lock();
        self.ended.wait_while(&mut running, |running| *running > 0);
    }
}

impl Drop for BacklogThread<'_> {
    fn drop(&mut self) {
        *self.0.running.lock() -= 1;
        self.0.ended.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_that_closes_ends_the_pause_of_its_cleanup() {
        let closing = Arc::new(Closing::default());
        let pausing = Arc::clone(&closing);
        // Hangs if the pause lasts as long as it may.
        let pause = std::thread::spawn(move || pausing.wait_for(Duration::from_secs(86_400)));
        closing.begin();
        pause.join().expect("the thread ends");
        // A pause that begins afterwards ends at once.
        closing.wait_for(Duration::from_secs(86_400));
    }
}
