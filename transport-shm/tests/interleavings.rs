//! The shipped rules of wake-ups, announcements and the poll lock under all interleavings of a few threads, with
//! loom. Loom also tries all values that the memory model lets a load return. It cannot reorder a store before
//! an earlier load.
//!
//! The modules under test are compiled into this program with the atomics and locks of loom. The mailbox is one
//! counter for each peer, written with release and read with acquire, as iceoryx2 does it. The doorbell is a flag
//! under a lock. A missed wake-up is a deadlock, which loom reports.
//!
//! `FIPA_LOOM_PREEMPTIONS` is the maximum number of preemptions in one execution, 2 by default.

#![allow(
    dead_code,
    reason = "the modules under test have more items than the models use"
)]
#![expect(clippy::unwrap_used, reason = "a failed precondition fails the test")]

#[path = "../src/answer_words.rs"]
mod answer_words;
#[path = "../src/combiner.rs"]
mod combiner;
#[path = "../src/wakeup.rs"]
mod wakeup;

/// Takes the place of the crate's `sync`.
mod sync {
    use std::ops::{Deref, DerefMut};

    pub(crate) use loom::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};

    /// A mutex of loom with the methods of one of `parking_lot`.
    #[derive(Debug)]
    pub(crate) struct Mutex<T> {
        locked: loom::sync::Mutex<T>,
        unlocking: AtomicBool,
    }

    impl<T> Mutex<T> {
        pub(crate) fn new(value: T) -> Self {
            Self {
                locked: loom::sync::Mutex::new(value),
                unlocking: AtomicBool::new(false),
            }
        }

        pub(crate) fn lock(&self) -> MutexGuard<'_, T> {
            self.guard(self.locked.lock().unwrap())
        }

        pub(crate) fn try_lock(&self) -> Option<MutexGuard<'_, T>> {
            self.unlocking.store(false, Ordering::Relaxed);
            self.locked.try_lock().ok().map(|guard| self.guard(guard))
        }

        fn guard<'a>(&'a self, guard: loom::sync::MutexGuard<'a, T>) -> MutexGuard<'a, T> {
            MutexGuard {
                unlocking: &self.unlocking,
                guard,
            }
        }
    }

    pub(crate) struct MutexGuard<'a, T> {
        unlocking: &'a AtomicBool,
        guard: loom::sync::MutexGuard<'a, T>,
    }

    impl<T> Drop for MutexGuard<'_, T> {
        fn drop(&mut self) {
            // Loom switches threads before an access that depends on one of another thread, and unlocking is no
            // such access. This load depends on the store in `try_lock`.
            self.unlocking.load(Ordering::Relaxed);
        }
    }

    impl<T> Deref for MutexGuard<'_, T> {
        type Target = T;

        fn deref(&self) -> &T {
            &self.guard
        }
    }

    impl<T> DerefMut for MutexGuard<'_, T> {
        fn deref_mut(&mut self) -> &mut T {
            &mut self.guard
        }
    }
}

use std::convert::Infallible;

use answer_words::{AnswerWords, LentWords, WordPlace};
use combiner::Combiner;
use loom::sync::Arc;
use loom::sync::Condvar;
use loom::thread;
use sync::{AtomicBool, AtomicU64, Ordering, fence};
use wakeup::{Account, RingState, StatusWords};

/// Explores all executions of the model, up to the maximum number of preemptions.
fn explore(model: impl Fn() + Send + Sync + 'static) {
    let mut builder = loom::model::Builder::new();
    let preemptions = std::env::var("FIPA_LOOM_PREEMPTIONS").ok();
    builder.preemption_bound = Some(preemptions.map_or(2, |number| number.parse().unwrap()));
    builder.check(model);
}

const PEERS: usize = 2;

/// The memory that a process shares with its peers.
struct Process {
    words: StatusWords,
    /// Number of parcels that each peer has put into the mailbox.
    sent: [AtomicU64; PEERS],
    bell: loom::sync::Mutex<bool>,
    rung: Condvar,
}

impl Process {
    fn new() -> Arc<Self> {
        Arc::new(Self {
            words: StatusWords::default(),
            sent: [AtomicU64::new(0), AtomicU64::new(0)],
            bell: loom::sync::Mutex::new(false),
            rung: Condvar::new(),
        })
    }

    fn ring(&self) {
        *self.bell.lock().unwrap() = true;
        self.rung.notify_one();
    }

    /// Clears the doorbell. Returns whether it was rung.
    fn clear(&self) -> bool {
        std::mem::take(&mut *self.bell.lock().unwrap())
    }

    /// Waits for the doorbell, and clears it.
    fn sleep(&self) {
        let mut rung = self.bell.lock().unwrap();
        while !*rung {
            rung = self.rung.wait(rung).unwrap();
        }
        *rung = false;
    }

    /// Puts a parcel into the mailbox as `Outbox` does.
    fn put(&self, peer: usize) {
        let _announced = self.words.announce();
        self.sent[peer].fetch_add(1, Ordering::Release);
    }

    /// Sends a parcel as `Outbox` and `PeerProcess` do.
    fn send(&self, peer: usize, rings: &RingState) {
        self.put(peer);
        rings.wake(&self.words, || false, || self.ring());
    }
}

/// The mailbox as its process sees it.
struct Inbox {
    account: Account,
    taken: [u64; PEERS],
}

impl Inbox {
    fn new() -> Self {
        Self {
            account: Account::default(),
            taken: [0; PEERS],
        }
    }

    fn total(&self) -> u64 {
        self.taken.iter().sum()
    }

    /// Takes parcels, as `Inbox::drain` does. Returns whether there was any.
    fn drain(&mut self, process: &Process, unannounced: bool) -> bool {
        let before = self.total();
        let mut is_forced = unannounced;
        while is_forced || self.account.is_open(&process.words) {
            is_forced = false;
            let Self { account, taken } = self;
            let received = account.take(&process.words, || {
                let mut slots = process.sent.iter().zip(taken.iter_mut());
                let found = slots.find(|(sent, taken)| sent.load(Ordering::Acquire) > **taken);
                Ok::<_, Infallible>(found.map(|(_, taken)| *taken += 1))
            });
            if received.unwrap().is_none() {
                break;
            }
        }
        self.total() > before
    }

    /// Whether there is a parcel, as `Inbox::has_parcels` finds it.
    fn has_parcels(&self, process: &Process, unannounced: bool) -> bool {
        let mut slots = process.sent.iter().zip(&self.taken);
        (unannounced || self.account.must_look(&process.words))
            && slots.any(|(sent, taken)| sent.load(Ordering::Acquire) > *taken)
    }
}

/// Polls as `Endpoint::drive` does, until the mailbox seems empty.
fn drive(process: &Process, inbox: &Combiner<Inbox>) {
    let mut found = false;
    for round in 0.. {
        let polling = process.words.begin_polling();
        for poll in 0..2 {
            found |= inbox.work(|inbox| inbox.drain(process, round > 0 && poll == 0));
        }
        drop(polling);
        if !inbox.has_any(|inbox| inbox.has_parcels(process, !found)) {
            return;
        }
    }
}

/// Handles a cleared doorbell as `Endpoint::work_after_wakeup` does.
fn handle_wakeup(process: &Process, inbox: &Combiner<Inbox>) {
    process.words.count_wakeup();
    if !process.words.is_polling() {
        inbox.work(|inbox| inbox.drain(process, true));
    }
}

/// Sleeps and handles wake-ups until this many parcels were taken.
fn sleep_until_taken(process: &Process, inbox: &Combiner<Inbox>, parcels: u64) {
    while inbox.lock().total() < parcels {
        process.sleep();
        handle_wakeup(process, inbox);
    }
}

/// Starts a peer with one thread that sends this many parcels.
fn start_peer(process: &Arc<Process>, peer: usize, parcels: usize) -> thread::JoinHandle<()> {
    let process = Arc::clone(process);
    thread::spawn(move || {
        let rings = RingState::new();
        for _ in 0..parcels {
            process.send(peer, &rings);
        }
    })
}

#[test]
fn a_sleeping_process_is_woken_for_every_parcel() {
    explore(|| {
        let process = Process::new();
        let peer = start_peer(&process, 0, 2);
        let inbox = Combiner::new(Inbox::new());
        sleep_until_taken(&process, &inbox, 2);
        peer.join().unwrap();
    });
}

#[test]
fn a_process_is_woken_by_two_peers() {
    explore(|| {
        let process = Process::new();
        let peers = [0, 1].map(|peer| start_peer(&process, peer, 1));
        let inbox = Combiner::new(Inbox::new());
        sleep_until_taken(&process, &inbox, 2);
        for peer in peers {
            peer.join().unwrap();
        }
    });
}

/// The threads of a peer share what they know of the process's wake-ups.
#[test]
fn a_process_is_woken_by_two_threads_of_a_peer() {
    explore(|| {
        let process = Process::new();
        let rings = Arc::new(RingState::new());
        let peers: Vec<_> = (0..PEERS)
            .map(|slot| {
                let (process, rings) = (Arc::clone(&process), Arc::clone(&rings));
                thread::spawn(move || process.send(slot, &rings))
            })
            .collect();
        let inbox = Combiner::new(Inbox::new());
        sleep_until_taken(&process, &inbox, 2);
        for peer in peers {
            peer.join().unwrap();
        }
    });
}

#[test]
fn a_process_that_stops_polling_misses_no_parcel() {
    explore(|| {
        let process = Process::new();
        let peer = start_peer(&process, 0, 2);
        let inbox = Combiner::new(Inbox::new());
        drive(&process, &inbox);
        sleep_until_taken(&process, &inbox, 2);
        peer.join().unwrap();
    });
}

/// The final look of a process that has found something is not forced. A peer whose announcement was written off
/// sends before it.
#[test]
fn a_busy_process_finds_the_parcel_of_a_slow_peer() {
    explore(|| {
        let process = Process::new();
        let slow = start_peer(&process, 0, 1);
        let inbox = Combiner::new(Inbox::new());
        for _ in 0..Account::MAX_EMPTY_LOOKS {
            inbox.lock().drain(&process, false);
        }
        // Its peer sees that the process polls, and does not ring.
        process.put(1);
        drive(&process, &inbox);
        sleep_until_taken(&process, &inbox, 2);
        slow.join().unwrap();
    });
}

/// One thread polls, and another one handles wake-ups, which it leaves to the polling thread.
#[test]
fn a_parcel_is_found_by_the_polling_thread_or_the_woken_one() {
    explore(|| {
        let process = Process::new();
        let inbox = Arc::new(Combiner::new(Inbox::new()));
        let peer = start_peer(&process, 0, 1);
        let woken = {
            let (process, inbox) = (Arc::clone(&process), Arc::clone(&inbox));
            thread::spawn(move || {
                if process.clear() {
                    handle_wakeup(&process, &inbox);
                }
            })
        };
        drive(&process, &inbox);
        peer.join().unwrap();
        woken.join().unwrap();
        if process.clear() {
            handle_wakeup(&process, &inbox);
        }
        assert_eq!(inbox.lock().total(), 1);
    });
}

#[test]
fn a_parcel_that_never_arrives_hides_no_other_one() {
    explore(|| {
        let process = Process::new();
        let failing = {
            let process = Arc::clone(&process);
            thread::spawn(move || drop(process.words.announce()))
        };
        let sending = start_peer(&process, 0, 1);
        let mut inbox = Inbox::new();
        inbox.drain(&process, false);
        inbox.drain(&process, false);
        failing.join().unwrap();
        sending.join().unwrap();
        // Without a look that no announcement demands.
        inbox.drain(&process, false);
        assert_eq!(inbox.total(), 1);
        assert!(!inbox.account.is_open(&process.words));
    });
}

/// A peer is slow, or was killed, between its announcement and the parcel: the account writes the announcement
/// off. Another peer sends meanwhile.
#[test]
fn an_announcement_that_was_written_off_hides_no_parcel() {
    explore(|| {
        let process = Process::new();
        let killed = process.words.announce();
        std::mem::forget(killed);
        let mut inbox = Inbox::new();
        for _ in 0..Account::MAX_EMPTY_LOOKS {
            assert!(inbox.account.is_open(&process.words));
            inbox.drain(&process, false);
        }
        assert!(!inbox.account.is_open(&process.words));
        let peer = start_peer(&process, 0, 1);
        let inbox = Combiner::new(inbox);
        drive(&process, &inbox);
        sleep_until_taken(&process, &inbox, 1);
        peer.join().unwrap();
    });
}

#[test]
fn a_parcel_of_a_slow_peer_is_found_after_its_announcement_was_written_off() {
    explore(|| {
        let process = Process::new();
        let peer = start_peer(&process, 0, 1);
        let inbox = Combiner::new(Inbox::new());
        for _ in 0..Account::MAX_EMPTY_LOOKS {
            inbox.lock().drain(&process, false);
        }
        drive(&process, &inbox);
        sleep_until_taken(&process, &inbox, 1);
        peer.join().unwrap();
        // The next look corrects the account.
        inbox.lock().drain(&process, true);
        let inbox = inbox.lock();
        assert!(!inbox.account.must_look(&process.words));
    });
}

#[test]
fn a_request_for_work_is_never_lost() {
    explore(|| {
        let requests = Arc::new(AtomicU64::new(0));
        let combiner = Arc::new(Combiner::new(0));
        let take_all = |requests: &AtomicU64, combiner: &Combiner<u64>| {
            combiner.work(|done| {
                *done = requests.load(Ordering::Acquire);
                true
            });
        };
        let others: Vec<_> = (0..2)
            .map(|_| {
                let (requests, combiner) = (Arc::clone(&requests), Arc::clone(&combiner));
                thread::spawn(move || {
                    requests.fetch_add(1, Ordering::Release);
                    take_all(&requests, &combiner);
                })
            })
            .collect();
        let has_any = combiner.has_any(|done| requests.load(Ordering::Acquire) > *done);
        if has_any {
            take_all(&requests, &combiner);
        }
        for other in others {
            other.join().unwrap();
        }
        assert_eq!(*combiner.lock(), 2);
    });
}

/// The words for answers, and their sender's account of them.
fn page<const N: usize>() -> Arc<(AnswerWords<N>, LentWords<N>)> {
    let (words, lent) = (AnswerWords::default(), LentWords::new([7, 1 << 20]));
    words.set_page(lent.page());
    Arc::new((words, lent))
}

/// The receiver of the parcel with this token and word answers it.
fn start_receiver<const N: usize>(
    page: &Arc<(AnswerWords<N>, LentWords<N>)>,
    (token, place): (u64, WordPlace),
    code: u8,
) -> thread::JoinHandle<()> {
    let page = Arc::clone(page);
    thread::spawn(move || {
        assert!(page.0.has(place));
        page.0.answer(place, token, code);
    })
}

#[test]
fn a_sender_that_stops_polling_is_woken_for_an_answer_in_a_word() {
    explore(|| {
        let (process, page) = (Process::new(), page::<1>());
        let (token, place) = page.1.lend(&page.0);
        let receiver = {
            let (process, page) = (Arc::clone(&process), Arc::clone(&page));
            thread::spawn(move || {
                page.0.answer(place, token, 1);
                RingState::new().wake(&process.words, || false, || process.ring());
            })
        };
        let is_answered = || page.0.code(place, token) == Some(1);
        let polling = process.words.begin_polling();
        let found = is_answered();
        drop(polling);
        if !found && !is_answered() {
            process.sleep();
            process.words.count_wakeup();
            assert!(is_answered());
        }
        receiver.join().unwrap();
    });
}

/// The channel of iceoryx2 is a flag, written and read relaxed.
#[test]
fn a_sender_that_finds_the_channel_closed_finds_the_answer() {
    explore(|| {
        let page = page::<1>();
        let closed = Arc::new(AtomicBool::new(false));
        let (token, place) = page.1.lend(&page.0);
        let receiver = {
            let (page, closed) = (Arc::clone(&page), Arc::clone(&closed));
            thread::spawn(move || {
                page.0.answer(place, token, 1);
                closed.store(true, Ordering::Relaxed);
            })
        };
        if closed.load(Ordering::Relaxed) {
            fence(Ordering::Acquire);
            assert_eq!(page.0.code(place, token), Some(1));
        }
        receiver.join().unwrap();
    });
}

#[test]
fn the_late_answer_to_an_abandoned_parcel_changes_no_other_answer() {
    explore(|| {
        let page = page::<1>();
        let abandoned = page.1.lend(&page.0);
        let late = start_receiver(&page, abandoned, 3);
        page.1.give_back(abandoned.1);
        let (token, place) = page.1.lend(&page.0);
        assert_eq!(place, abandoned.1);
        let receiver = start_receiver(&page, (token, place), 1);
        assert!([None, Some(1)].contains(&page.0.code(place, token)));
        receiver.join().unwrap();
        assert_eq!(page.0.code(place, token), Some(1));
        late.join().unwrap();
        assert_eq!(page.0.code(place, token), Some(1));
    });
}

#[test]
fn threads_that_send_have_different_words() {
    explore(|| {
        let page = page::<1>();
        let send = |page: &(AnswerWords<1>, LentWords<1>), code| {
            let (token, place) = page.1.lend(&page.0);
            if place != WordPlace::NONE {
                assert_eq!(page.0.code(place, token), None);
                page.0.answer(place, token, code);
                assert_eq!(page.0.code(place, token), Some(code));
                page.1.give_back(place);
            }
        };
        let other = {
            let page = Arc::clone(&page);
            thread::spawn(move || send(&page, 2))
        };
        send(&page, 1);
        other.join().unwrap();
        // No word is lost.
        assert_ne!(page.1.lend(&page.0).1, WordPlace::NONE);
    });
}
