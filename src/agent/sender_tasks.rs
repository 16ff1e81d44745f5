//! Tasks that answer messages, one per sender.

use std::collections::{HashMap, VecDeque};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use fipa_transport::{Incarnation, PeerId};
use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio::time::{Instant, timeout_at};

use crate::agent::incoming::Incoming;

/// Maximum number of senders with a task.
const MAX_SENDERS: usize = 64;
/// Maximum number of works of one sender that wait.
const MAX_WAITING: usize = 1024;
/// Maximum number of bytes of the messages whose works wait or run, beyond which senders lose their tasks.
const MAX_BYTES: usize = 64 << 20;
/// Number of bytes that a message counts as at least: its work takes memory, too.
const MIN_BYTES: usize = 2048;
/// Time after which a running work counts as stalled. Most answers are delivered sooner.
const STALLED_AFTER: Duration = Duration::from_millis(50);

/// Runs the works that received messages cause, for example the sending of answers: those of one sender one after
/// the other, those of different senders at the same time. An agent that waits for the outcome of each answer in its
/// own loop reads nothing meanwhile, so one sender that takes no answers would delay those to all others.
///
/// At most 64 senders have a task. One more, or more than 64 MiB of messages, ends a task of the host with most tasks or
/// bytes: the one whose present work runs longest. If it sends a letter, the letter stays on its way. A sender is the
/// agent as far as the connection proves it, otherwise a name, of one host or certificate.
///
/// ```no_run
/// # async fn example(echo: fipa::Agent) -> fipa::Result<()> {
/// use fipa::{Performative::Inform, SenderTasks};
///
/// let mut tasks = SenderTasks::default();
/// loop {
///     let incoming = echo.receive().await?;
///     let answer = echo.reply(incoming.message(), Inform).content("ok");
///     let agent = echo.clone();
///     let send = async move { drop(agent.send(answer).await) };
///     if !tasks.run(&incoming, send).await {
///         eprintln!("too many answers wait for {:?}", incoming.message().sender());
///     }
/// }
/// # }
/// ```
///
/// Dropping it ends the tasks; [`finish`](Self::finish) waits for them.
#[derive(Debug, Default)]
pub struct SenderTasks(HashMap<Sender, SenderTask>);

/// A sender of messages.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Sender {
    peer: PeerId,
    agent: Agent,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Agent {
    Registration(Incarnation),
    Name(Option<Box<str>>),
}

type Work = Pin<Box<dyn Future<Output = ()> + Send>>;

/// The task of a sender. Dropping it ends the task.
#[derive(Debug)]
struct SenderTask {
    queue: Arc<WorkQueue>,
    task: JoinHandle<()>,
}

#[derive(Debug)]
struct WorkQueue {
    state: Mutex<QueueState>,
    /// Notified when a work ends.
    ended: Notify,
}

struct QueueState {
    waiting: VecDeque<(usize, Work)>,
    /// Bytes of the messages whose works wait or run.
    bytes: usize,
    /// Time at which the present work began.
    began: Instant,
    /// Whether the task has run all works, and takes no more.
    is_over: bool,
}

impl SenderTasks {
    /// Runs a work after the earlier ones of the sender of this message. Waits at most 50 ms for room among them.
    /// Returns whether the work will run: it is dropped if 1,024 others of the sender wait and the present one takes
    /// longer.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub async fn run(
        &mut self,
        incoming: &Incoming,
        work: impl Future<Output = ()> + Send + 'static,
    ) -> bool {
        let sender = Sender::of(incoming);
        let bytes = incoming.bytes().max(MIN_BYTES);
        self.run_of(sender, bytes, Box::pin(work)).await
    }

    async fn run_of(&mut self, sender: Sender, bytes: usize, work: Work) -> bool {
        self.0.retain(|_, it| !it.queue.state.lock().is_over);
        self.make_room(&sender, bytes);
        let mut work = work;
        if let Some(known) = self.0.get(&sender) {
            let room = MAX_BYTES.saturating_sub(self.bytes() - known.queue.state.lock().bytes);
            match known.queue.push(bytes, room, work).await {
                Pushed::Done => return true,
                Pushed::Full => return false,
                Pushed::Over(it) => work = it,
            }
            self.0.remove(&sender);
        }
        let queue = Arc::new(WorkQueue {
            state: Mutex::new(QueueState {
                waiting: VecDeque::from([(bytes, work)]),
                bytes,
                began: Instant::now(),
                is_over: false,
            }),
            ended: Notify::new(),
        });
        let task = tokio::spawn(Arc::clone(&queue).run());
        self.0.insert(sender, SenderTask { queue, task });
        true
    }

    /// Waits until all works have run.
    pub async fn finish(mut self) {
        for (_, mut it) in self.0.drain() {
            // A work that panics ends its task only.
            let _ = (&mut it.task).await;
        }
    }

    /// Ends tasks until another message of this sender has room. Only tasks of the peer with most end, so another peer
    /// always has room for one message. A sender with a task waits for its own peer.
    fn make_room(&mut self, sender: &Sender, bytes: usize) {
        let is_known = self.0.contains_key(sender);
        loop {
            let too_many = self.0.len() + usize::from(!is_known) > MAX_SENDERS;
            if !too_many && self.bytes() + bytes <= MAX_BYTES {
                return;
            }
            let used = self.used(sender, bytes);
            let of_most = match too_many {
                true => used.iter().max_by_key(|(_, (senders, _))| *senders),
                false => used.iter().max_by_key(|(_, (_, bytes))| *bytes),
            };
            let of_most = of_most.filter(|(peer, _)| !is_known || **peer != sender.peer);
            let Some(longest) = of_most.and_then(|(peer, _)| self.longest_of(peer)) else {
                return;
            };
            self.0.remove(&longest);
        }
    }

    /// Returns the number of tasks and bytes of each peer, with another message of this sender.
    fn used(&self, sender: &Sender, bytes: usize) -> HashMap<PeerId, (usize, usize)> {
        let new = usize::from(!self.0.contains_key(sender));
        let mut used = HashMap::from([(sender.peer.clone(), (new, bytes))]);
        for (sender, it) in &self.0 {
            let (senders, bytes) = used.entry(sender.peer.clone()).or_default();
            *senders += 1;
            *bytes += it.queue.state.lock().bytes;
        }
        used
    }

    /// Returns the sender of this peer whose present work runs longest.
    fn longest_of(&self, peer: &PeerId) -> Option<Sender> {
        let of_peer = self.0.iter().filter(|(sender, _)| sender.peer == *peer);
        let longest = of_peer.min_by_key(|(_, it)| it.queue.state.lock().began);
        longest.map(|(sender, _)| sender.clone())
    }

    fn bytes(&self) -> usize {
        self.0.values().map(|it| it.queue.state.lock().bytes).sum()
    }
}

impl Sender {
    fn of(incoming: &Incoming) -> Self {
        let agent = match incoming.sender {
            proved if proved.is_known() => Agent::Registration(proved),
            _ => Agent::Name(incoming.message().sender().map(|it| it.name().into())),
        };
        Self {
            peer: incoming.peer(),
            agent,
        }
    }
}

impl Drop for SenderTask {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The result of [`WorkQueue::push`].
enum Pushed {
    Done,
    Full,
    /// The task has ended. Returns the work.
    Over(Work),
}

impl WorkQueue {
    /// Adds a work if it fits this number of bytes, with those that wait.
    async fn push(&self, bytes: usize, room: usize, work: Work) -> Pushed {
        loop {
            // Before the check, so that no notification is missed.
            let ended = self.ended.notified();
            let stalled = {
                let mut state = self.state.lock();
                if state.is_over {
                    return Pushed::Over(work);
                }
                let has_room = state.waiting.len() < MAX_WAITING
                    && (state.waiting.is_empty() || state.bytes + bytes <= room);
                if has_room {
                    state.bytes += bytes;
                    state.waiting.push_back((bytes, work));
                    return Pushed::Done;
                }
                state.began + STALLED_AFTER
            };
            if timeout_at(stalled, ended).await.is_err() {
                return Pushed::Full;
            }
        }
    }

    async fn run(self: Arc<Self>) {
        loop {
            let (bytes, work) = {
                let mut state = self.state.lock();
                let Some(next) = state.waiting.pop_front() else {
                    state.is_over = true;
                    return;
                };
                state.began = Instant::now();
                next
            };
            work.await;
            self.state.lock().bytes -= bytes;
            self.ended.notify_waiters();
        }
    }
}

impl std::fmt::Debug for QueueState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            waiting,
            bytes,
            began,
            is_over,
        } = self;
        f.debug_struct("QueueState")
            .field("waiting", &waiting.len())
            .field("bytes", bytes)
            .field("began", began)
            .field("is_over", is_over)
            .finish()
    }
}

#[cfg(test)]
mod tests {
    use std::future::pending;

    use tokio::sync::mpsc;

    use super::*;

    fn sender(number: usize) -> Sender {
        sender_of(PeerId::THIS_HOST, number)
    }

    fn sender_of(peer: PeerId, number: usize) -> Sender {
        Sender {
            peer,
            agent: Agent::Registration(Incarnation::from_u64(number as u64 + 1)),
        }
    }

    fn done(number: usize, log: &mpsc::UnboundedSender<usize>) -> Work {
        let log = log.clone();
        Box::pin(async move {
            tokio::task::yield_now().await;
            log.send(number).unwrap();
        })
    }

    #[tokio::test]
    async fn works_of_one_sender_run_in_order_and_all_of_a_burst() {
        let mut tasks = SenderTasks::default();
        let (log, mut finished) = mpsc::unbounded_channel();
        for number in 0..5 * MAX_WAITING {
            assert!(tasks.run_of(sender(1), 100, done(number, &log)).await);
        }
        tasks.finish().await;
        for number in 0..5 * MAX_WAITING {
            assert_eq!(finished.recv().await, Some(number));
        }
    }

    #[tokio::test]
    async fn a_sender_whose_works_stall_delays_no_other_and_keeps_a_bounded_number() {
        let mut tasks = SenderTasks::default();
        let mut running = 0;
        for _ in 0..3 * MAX_WAITING {
            running += usize::from(tasks.run_of(sender(1), 100, Box::pin(pending())).await);
        }
        // One more runs.
        assert!(running <= MAX_WAITING + 1, "{running}");
        let (log, mut finished) = mpsc::unbounded_channel();
        assert!(tasks.run_of(sender(2), 100, done(7, &log)).await);
        assert_eq!(finished.recv().await, Some(7));
    }

    #[tokio::test]
    async fn more_senders_end_the_task_that_runs_longest() {
        let mut tasks = SenderTasks::default();
        for number in 0..3 * MAX_SENDERS {
            assert!(tasks.run_of(sender(number), 100, Box::pin(pending())).await);
            assert!(tasks.0.len() <= MAX_SENDERS);
            tokio::task::yield_now().await;
        }
        assert!(!tasks.0.contains_key(&sender(0)));
        assert!(tasks.0.contains_key(&sender(3 * MAX_SENDERS - 1)));
    }

    #[tokio::test]
    async fn the_bytes_of_messages_are_bounded_over_all_senders() {
        let mut tasks = SenderTasks::default();
        for number in 0..20 {
            let work = Box::pin(pending());
            assert!(tasks.run_of(sender(number), MAX_BYTES / 4, work).await);
            assert!(tasks.bytes() <= MAX_BYTES);
        }
        // A larger message takes all the room.
        let work = Box::pin(pending());
        assert!(tasks.run_of(sender(99), 2 * MAX_BYTES, work).await);
        assert_eq!(tasks.0.len(), 1);
    }

    #[tokio::test]
    async fn a_peer_with_many_senders_ends_its_own_tasks_only() {
        let mut tasks = SenderTasks::default();
        let honest = sender_of(PeerId::of_ip([192, 0, 2, 1].into()), 1);
        assert!(tasks.run_of(honest.clone(), 100, Box::pin(pending())).await);
        for number in 0..3 * MAX_SENDERS {
            tokio::task::yield_now().await;
            let greedy = sender_of(PeerId::of_ip([192, 0, 2, 2].into()), number);
            let bytes = MAX_BYTES / 8;
            assert!(tasks.run_of(greedy, bytes, Box::pin(pending())).await);
            assert!(tasks.0.len() <= MAX_SENDERS && tasks.bytes() <= MAX_BYTES);
        }
        assert!(tasks.0.contains_key(&honest));
        let newcomer = sender_of(PeerId::of_ip([192, 0, 2, 3].into()), 1);
        let (log, mut finished) = mpsc::unbounded_channel();
        assert!(tasks.run_of(newcomer, 100, done(7, &log)).await);
        assert_eq!(finished.recv().await, Some(7));
    }
}
