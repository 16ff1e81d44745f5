//! Hands received messages to their readers: a call that leads a conversation, a server of a protocol,
//! or `receive`.
//!
//! A message belongs to a conversation if it has the conversation's id and is from one of its
//! parties, as far as the connection proves its sender. Every agent can choose any conversation id, so
//! an agent that takes no part cannot put a message into the conversation of others. A conversation that another agent
//! begins with a server starts when its first message is set aside for the server: the messages that follow at once
//! belong to it, too.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use fipa_acl::Message;
use fipa_sds::Entry;
use fipa_transport::{Incarnation, log_limit};
use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::agent::endpoint::Endpoint;
use crate::agent::incoming::Incoming;
use crate::agent::lock_slot;
use crate::agent::reader_key::ReaderKey;
use crate::domain::presence;
use crate::error::ReceiveError;

/// Maximum number of messages that are set aside for one reader while another reader receives.
/// Beyond it letters stay in the agent's queue, and their senders wait.
const MAX_SET_ASIDE: usize = 1_024;

/// Maximum bytes of the letters of such messages. One message is always set aside.
const MAX_SET_ASIDE_BYTES: usize = 64 << 20;

/// The messages that one reader received for another.
///
/// Each reader waits for its own queue, so an arrival wakes two readers at most: the one that receives it,
/// and the one to which it belongs.
#[derive(Default)]
pub(crate) struct Demultiplexer {
    state: Mutex<State>,
    /// Held while a letter of the agent is taken, checked and handed to its reader, so that two readers cannot reverse
    /// two letters. The other readers of the agent wait while the files of the directory are read, or while the sender
    /// of a letter gets a `not-understood`.
    taking: Mutex<()>,
    /// Notified when a queue becomes full, and when none is full any longer.
    room: Notify,
}

#[derive(Default)]
struct State {
    led: Led,
    served: Vec<Served>,
    others: SetAside,
    /// Whether the application has ever read the other messages.
    is_read: bool,
}

/// The led conversations.
#[derive(Default)]
struct Led {
    /// By conversation id. Several agents may have begun one with the same id.
    by_id: HashMap<Arc<str>, Vec<Conversation>>,
    /// Number of readers that were created, including servers.
    readers: u64,
    full: FullQueues,
}

/// Number of full queues of conversations and servers.
type FullQueues = Arc<AtomicUsize>;

struct Conversation {
    number: u64,
    from: Admitted,
    /// Whether messages that are left at the end are discarded.
    is_internal: bool,
    queue: SetAside,
}

/// The order in which servers are asked for a message, independent of the order in which the application has started
/// them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Precedence {
    /// A part of the conversations of a protocol, such as those about actions or a topic.
    Part,
    /// All conversations of a protocol.
    Protocol,
    /// What no other server handles.
    Rest,
}

struct Served {
    number: u64,
    precedence: Precedence,
    opens: Opens,
    /// Whether its messages begin conversations.
    takes_part: bool,
    queue: SetAside,
}

/// The messages that are set aside for one reader, in order.
#[derive(Default)]
struct SetAside {
    messages: VecDeque<Incoming>,
    /// Bytes of their letters.
    bytes: usize,
    /// Whether the queue reached its bound and has not had room for an eighth of it since. So a reader that is
    /// slow wakes the others once for many messages.
    is_full: bool,
    /// Counts this queue while it is full.
    full: FullQueues,
    /// Notified when a message is added.
    arrived: Arc<Notify>,
}

impl SetAside {
    fn new(full: &FullQueues) -> Self {
        let mut queue = Self::default();
        queue.full = Arc::clone(full);
        queue
    }

    fn push_back(&mut self, message: Incoming) {
        self.bytes = self.bytes.saturating_add(message.bytes());
        self.messages.push_back(message);
        self.arrived.notify_one();
        if self.is_at_bound() {
            self.set_full(true);
        }
    }

    fn pop_front(&mut self) -> Option<Incoming> {
        let message = self.messages.pop_front()?;
        self.bytes = self.bytes.saturating_sub(message.bytes());
        if self.messages.len() <= MAX_SET_ASIDE / 8 * 7 && self.bytes <= MAX_SET_ASIDE_BYTES / 8 * 7
        {
            self.set_full(false);
        }
        if !self.messages.is_empty() {
            // Several callers may read one queue, and each notification wakes one.
            self.arrived.notify_one();
        }
        Some(message)
    }

    fn is_at_bound(&self) -> bool {
        self.messages.len() >= MAX_SET_ASIDE || self.bytes >= MAX_SET_ASIDE_BYTES
    }

    fn set_full(&mut self, is_full: bool) {
        match (self.is_full, is_full) {
            (false, true) => self.full.fetch_add(1, Ordering::Relaxed),
            (true, false) => self.full.fetch_sub(1, Ordering::Relaxed),
            _ => return,
        };
        self.is_full = is_full;
    }

    fn is_empty(&self) -> bool {
        self.messages.is_empty()
    }

    /// Removes all messages.
    fn take(&mut self) -> VecDeque<Incoming> {
        self.bytes = 0;
        self.set_full(false);
        std::mem::take(&mut self.messages)
    }
}

impl Drop for SetAside {
    fn drop(&mut self) {
        self.set_full(false);
    }
}

/// Decides whether a message is for a server.
pub(crate) type Opens = Box<dyn Fn(&Message) -> bool + Send + Sync>;

/// The agents whose messages belong to a conversation.
#[derive(Debug, Clone)]
pub(crate) enum Admitted {
    /// These agents, and the services that [report](crate::agent::delivery_report) undelivered messages to them.
    Parties(Vec<Party>),
    /// The sender of the message that has begun the conversation, until a task takes part in it.
    Sender(Sender),
    /// Every agent.
    All,
}

/// The sender of a message, as far as its connection proves it.
#[derive(Debug, Clone)]
pub(crate) struct Sender {
    name: Arc<str>,
    /// Its registration; unknown for an agent of this process, and for one of a legacy peer.
    agent: Incarnation,
    is_of_this_process: bool,
}

impl Sender {
    fn of(message: &Incoming) -> Option<Self> {
        Some(Self {
            name: (*message.view().sender()?.name().as_str()).into(),
            agent: message.sender,
            is_of_this_process: message.via.is_none(),
        })
    }

    fn has_sent(&self, message: &Incoming) -> bool {
        let view = message.view();
        let name = view.sender().map(|sender| sender.name());
        self.agent == message.sender
            && self.is_of_this_process == message.via.is_none()
            && name.is_some_and(|name| *name.as_str() == *self.name)
    }
}

/// An agent that takes part in a conversation.
#[derive(Debug, Clone)]
pub(crate) struct Party {
    pub(crate) name: Arc<str>,
    /// Its registration; unknown for an agent of a legacy peer.
    pub(crate) agent: Incarnation,
}

impl Party {
    /// Creates a party with the registration that the directory has.
    pub(crate) fn new(name: &str, entry: Option<&Entry>) -> Self {
        Self {
            name: name.into(),
            agent: entry.map_or(Incarnation::UNKNOWN, |entry| entry.incarnation),
        }
    }
}

/// A reader that waits for a message.
#[derive(Clone, Copy)]
enum Reader<'a> {
    Conversation(&'a ReaderKey),
    Server(&'a ReaderKey),
    Others,
    /// None: the caller only hands a message over.
    Absent,
}

/// The next letter of an agent.
enum Taken {
    /// Its message is for the reader that has taken it.
    Own(Incoming),
    /// It is set aside for another reader, or cannot be decoded.
    SetAside,
    /// No letter has arrived.
    Nothing,
    /// A queue is full.
    NoRoom,
}

/// Whether each queue has room for a further message.
struct HasRoom(bool);

impl Demultiplexer {
    /// Starts a queue for a conversation that a call leads.
    pub(crate) fn begin(&self, id: &str, from: Admitted) -> ReaderKey {
        self.lead(id, from, false)
    }

    /// Starts a queue for a conversation with a service, whose messages the application never reads.
    pub(crate) fn begin_internal(&self, id: &str, from: Admitted) -> ReaderKey {
        self.lead(id, from, true)
    }

    fn lead(&self, id: &str, from: Admitted, is_internal: bool) -> ReaderKey {
        self.state.lock().led.begin(id, from, is_internal)
    }

    /// Takes over the queue of the conversation that a message has begun, or starts one. The messages of the same sender
    /// that have arrived since are in it.
    pub(crate) fn join(&self, id: &str, first: &Incoming, from: Admitted) -> ReaderKey {
        self.change(|state| {
            if let Some(begun) = &first.begun
                && let Some(conversation) = state.led.get(begun)
            {
                conversation.from = from;
                return begun.clone();
            }
            let key = state.led.begin(id, from, false);
            if let Some(sender) = Sender::of(first) {
                state.claim(&key, &sender);
            }
            key
        })
    }

    /// Gives up the conversation that a message has begun, and [ends](Self::end) it.
    pub(crate) fn abandon(&self, first: &Incoming) {
        if let Some(begun) = &first.begun {
            self.end(begun);
        }
    }

    /// Adds an agent to a conversation.
    pub(crate) fn admit(&self, key: &ReaderKey, party: Party) {
        if let Some(conversation) = self.state.lock().led.get(key)
            && let Admitted::Parties(parties) = &mut conversation.from
        {
            parties.retain(|known| known.name != party.name);
            parties.push(party);
        }
    }

    /// Adds every agent to a conversation.
    pub(crate) fn admit_all(&self, key: &ReaderKey) {
        if let Some(conversation) = self.state.lock().led.get(key) {
            conversation.from = Admitted::All;
        }
    }

    /// Ends a conversation. Its unread messages go to a server that handles them, or to `receive`.
    pub(crate) fn end(&self, key: &ReaderKey) {
        self.change(|state| state.end(key));
    }

    /// Starts a queue for the messages that a server handles: those for which `opens` returns true and that belong to no
    /// led conversation, also if they wait for `receive` already. One with a sender and a conversation id begins a
    /// conversation, which the server [joins](Self::join) or [abandons](Self::abandon).
    pub(crate) fn serve(&self, opens: Opens, precedence: Precedence) -> ReaderKey {
        self.add_server(opens, precedence, true)
    }

    /// Starts a queue like [`serve`](Self::serve) for a server to which all messages of its conversations go.
    pub(crate) fn serve_all(&self, opens: Opens, precedence: Precedence) -> ReaderKey {
        self.add_server(opens, precedence, false)
    }

    fn add_server(&self, opens: Opens, precedence: Precedence, takes_part: bool) -> ReaderKey {
        self.change(|state| {
            let key = state.led.key("");
            let served = Served {
                number: key.number,
                precedence,
                opens,
                takes_part,
                queue: SetAside::new(&state.led.full),
            };
            let after = |other: &Served| other.precedence > precedence;
            let at = state.served.iter().position(after);
            let at = at.unwrap_or(state.served.len());
            state.served.insert(at, served);
            // Messages that have arrived before it.
            let waiting = state.others.take();
            waiting
                .into_iter()
                .for_each(|message| state.put_again(message));
            key
        })
    }

    /// Ends a server. Its unread messages go to another one that handles them, or to `receive`.
    pub(crate) fn end_serving(&self, key: &ReaderKey) {
        self.change(|state| {
            if let Some(at) = state.served.iter().position(|it| it.number == key.number) {
                for mut first in state.served.remove(at).queue.take() {
                    let begun = first.begun.take();
                    let begun = begun.and_then(|begun| state.led.remove(&begun));
                    state.put_again(first);
                    let further = begun.into_iter().flat_map(|mut begun| begun.queue.take());
                    further.for_each(|message| state.put_again(message));
                }
            }
        });
    }

    /// Waits for the next message of a conversation.
    pub(crate) async fn next_of(
        &self,
        endpoint: &Endpoint,
        key: &ReaderKey,
    ) -> Result<Incoming, ReceiveError> {
        self.next(endpoint, Reader::Conversation(key)).await
    }

    /// Returns the next message of a conversation, if one is available now.
    pub(crate) fn now_of(&self, endpoint: &Endpoint, key: &ReaderKey) -> Option<Incoming> {
        self.now(endpoint, Reader::Conversation(key)).ok()?
    }

    /// Waits for the next message for a server.
    pub(crate) async fn next_served(
        &self,
        endpoint: &Endpoint,
        key: &ReaderKey,
    ) -> Result<Incoming, ReceiveError> {
        self.next(endpoint, Reader::Server(key)).await
    }

    /// Returns the next message for a server, if one is available now.
    pub(crate) fn now_served(&self, endpoint: &Endpoint, key: &ReaderKey) -> Option<Incoming> {
        self.now(endpoint, Reader::Server(key)).ok()?
    }

    /// Waits for the next message of no led conversation.
    pub(crate) async fn next_other(&self, endpoint: &Endpoint) -> Result<Incoming, ReceiveError> {
        self.next(endpoint, Reader::Others).await
    }

    /// Returns the next message of no led conversation, if one is available now.
    pub(crate) fn other_now(&self, endpoint: &Endpoint) -> Result<Option<Incoming>, ReceiveError> {
        self.now(endpoint, Reader::Others)
    }

    /// Removes and returns all messages that were set aside.
    pub(crate) fn drain(&self) -> Vec<Incoming> {
        // Waits for the letter that a reader has taken and not handed over.
        let _taken = self.taking.lock();
        self.change(|state| {
            let mut all: Vec<Incoming> = state.others.take().into();
            // A message that begins a conversation precedes the others of it.
            let served = state.served.iter_mut();
            all.extend(served.flat_map(|server| server.queue.take()));
            all.iter_mut().for_each(|first| first.begun = None);
            let led = state
                .led
                .by_id
                .drain()
                .flat_map(|(_, conversations)| conversations);
            let led = led.filter(|conversation| !conversation.is_internal);
            all.extend(led.flat_map(|mut conversation| conversation.queue.take()));
            all
        })
    }

    /// Changes the queues. Wakes the readers that wait for room, or that receive, if this changes whether there is
    /// room.
    fn change<T>(&self, change: impl FnOnce(&mut State) -> T) -> T {
        let mut state = self.state.lock();
        let had_room = state.has_room();
        let result = change(&mut state);
        let is_same = state.has_room() == had_room;
        drop(state);
        if !is_same {
            self.room.notify_waiters();
        }
        result
    }

    async fn next(
        &self,
        endpoint: &Endpoint,
        reader: Reader<'_>,
    ) -> Result<Incoming, ReceiveError> {
        loop {
            // Created before the check, so that no change after the check is missed.
            let room = self.room.notified();
            let set_aside = self.change(|state| match state.take(reader) {
                Some(set_aside) => Ok(set_aside),
                None => Err((state.arrived(reader), state.has_room())),
            });
            let (arrived, has_room) = match set_aside {
                Ok(set_aside) => return Ok(set_aside),
                Err(waiting) => waiting,
            };
            tokio::select! {
                biased;
                () = arrived.notified() => {}
                () = room => {}
                waits = endpoint.until_letter(), if has_room => {
                    waits?;
                    if let Taken::Own(own) = self.take(endpoint, reader)? {
                        return Ok(own);
                    }
                    // Letters for others must not keep this task running.
                    tokio::task::consume_budget().await;
                }
                () = endpoint.closed(), if !has_room => return Err(ReceiveError::Closed),
            }
        }
    }

    fn now(
        &self,
        endpoint: &Endpoint,
        reader: Reader<'_>,
    ) -> Result<Option<Incoming>, ReceiveError> {
        // Letters for others that go on to arrive do not keep the caller.
        for _ in 0..MAX_SET_ASIDE {
            match self.take(endpoint, reader)? {
                Taken::Own(own) => return Ok(Some(own)),
                Taken::SetAside => {}
                Taken::NoRoom if endpoint.is_closed() => return Err(ReceiveError::Closed),
                Taken::Nothing | Taken::NoRoom => return Ok(None),
            }
        }
        Ok(None)
    }

    /// Returns the next message of a reader that is set aside.
    fn take_set_aside(&self, reader: Reader<'_>) -> Result<Incoming, HasRoom> {
        let mut state = self.state.lock();
        if state.queue(reader).is_none_or(|queue| queue.is_empty()) {
            // A program that polls an empty queue pays for nothing else.
            state.is_read |= matches!(reader, Reader::Others);
            return Err(HasRoom(state.has_room()));
        }
        drop(state);
        self.change(|state| state.take(reader).ok_or_else(|| HasRoom(state.has_room())))
    }

    /// Returns the next message of the caller that is set aside, or takes the next letter of the agent and hands it to its
    /// reader.
    fn take(&self, endpoint: &Endpoint, caller: Reader<'_>) -> Result<Taken, ReceiveError> {
        let _in_order = self.taking.lock();
        match self.take_set_aside(caller) {
            Ok(own) => return Ok(Taken::Own(own)),
            Err(HasRoom(false)) => return Ok(Taken::NoRoom),
            Err(HasRoom(true)) => {}
        }
        let Some(received) = endpoint.letter_now()? else {
            return Ok(Taken::Nothing);
        };
        let decoded = endpoint.decode(received);
        let own = decoded.and_then(|message| self.put(endpoint, message, caller));
        Ok(own.map_or(Taken::SetAside, Taken::Own))
    }

    /// Hands a message to its reader: returns it if that is the caller, and otherwise sets it aside.
    fn put(&self, endpoint: &Endpoint, received: Incoming, caller: Reader<'_>) -> Option<Incoming> {
        let is_known = received.sender.is_known();
        let put = self.change(|state| match is_known && state.leads(&received) {
            true => Err(received),
            false => Ok(state.put(received, None, caller)),
        });
        let received = match put {
            Ok(own) => return own,
            Err(received) => received,
        };
        // Outside of the lock, because a miss reads the files of the directory.
        let registered = received.registered(endpoint.domain.directory());
        self.change(|state| state.put(received, registered.as_deref(), caller))
    }
}

impl Led {
    fn key(&mut self, id: &str) -> ReaderKey {
        self.readers += 1;
        ReaderKey {
            id: id.into(),
            number: self.readers,
        }
    }

    fn begin(&mut self, id: &str, from: Admitted, is_internal: bool) -> ReaderKey {
        let key = self.key(id);
        let queue = SetAside::new(&self.full);
        let conversations = self.by_id.entry(Arc::clone(&key.id)).or_default();
        conversations.push(Conversation {
            number: key.number,
            from,
            is_internal,
            queue,
        });
        key
    }

    fn get(&mut self, key: &ReaderKey) -> Option<&mut Conversation> {
        let mut conversations = self.by_id.get_mut(&key.id)?.iter_mut();
        conversations.find(|conversation| conversation.number == key.number)
    }

    fn remove(&mut self, key: &ReaderKey) -> Option<Conversation> {
        let conversations = self.by_id.get_mut(&key.id)?;
        let at = conversations.iter().position(|it| it.number == key.number);
        let removed = at.map(|at| conversations.remove(at));
        if conversations.is_empty() {
            self.by_id.remove(&key.id);
        }
        removed
    }
}

impl State {
    /// Moves the messages of this sender that belong to a conversation from those for `receive` to its queue.
    fn claim(&mut self, key: &ReaderKey, sender: &Sender) {
        let belongs = |message: &Incoming| {
            let id = message.conversation_id();
            id.is_some_and(|id| *id.as_str() == *key.id) && sender.has_sent(message)
        };
        if !self.others.messages.iter().any(belongs) {
            return;
        }
        for message in self.others.take() {
            match self.led.get(key).filter(|_| belongs(&message)) {
                Some(conversation) => conversation.queue.push_back(message),
                None => self.others.push_back(message),
            }
        }
    }

    fn end(&mut self, key: &ReaderKey) {
        let ended = self.led.remove(key).filter(|ended| !ended.is_internal);
        let unread = ended.into_iter().flat_map(|mut ended| ended.queue.take());
        unread.for_each(|message| self.put_again(message));
    }

    /// Adds a message to the queue of its reader, which is another one than when it arrived.
    fn put_again(&mut self, message: Incoming) {
        let own = self.put(message, None, Reader::Absent);
        debug_assert!(own.is_none(), "the caller reads nothing");
    }

    fn queue(&mut self, reader: Reader<'_>) -> Option<&mut SetAside> {
        match reader {
            Reader::Conversation(key) => Some(&mut self.led.get(key)?.queue),
            Reader::Server(key) => {
                let mut served = self.served.iter_mut();
                let server = served.find(|server| server.number == key.number)?;
                Some(&mut server.queue)
            }
            Reader::Others => Some(&mut self.others),
            Reader::Absent => None,
        }
    }

    fn take(&mut self, reader: Reader<'_>) -> Option<Incoming> {
        self.is_read |= matches!(reader, Reader::Others);
        self.queue(reader)?.pop_front()
    }

    /// Returns what is notified when a message is added to the reader's queue.
    fn arrived(&mut self, reader: Reader<'_>) -> Arc<Notify> {
        let queue = self.queue(reader);
        queue.map_or_else(Arc::default, |queue| Arc::clone(&queue.arrived))
    }

    /// Whether calls lead conversations with the message's id.
    fn leads(&self, received: &Incoming) -> bool {
        // Most agents lead none.
        !self.led.by_id.is_empty()
            && received
                .conversation_id()
                .is_some_and(|id| self.led.by_id.contains_key(&*id.as_str()))
    }

    /// Returns the led conversation to which a message belongs.
    fn conversation_of(
        &mut self,
        received: &Incoming,
        registered: Option<&Entry>,
    ) -> Option<&mut Conversation> {
        if self.led.by_id.is_empty() {
            return None;
        }
        let id = received.conversation_id()?;
        let conversations = self.led.by_id.get_mut(&*id.as_str())?;
        // The conversation that began last is the first choice.
        let mut admitting = conversations.iter_mut().rev();
        admitting.find(|it| it.from.admits(received, registered))
    }

    fn has_room(&self) -> bool {
        // An application that only serves reads no other messages.
        let are_read = self.is_read || self.served.is_empty();
        self.led.full.load(Ordering::Relaxed) == 0 && !(are_read && self.others.is_full)
    }

    /// Adds a message to the queue of its reader, or returns it if the reader is the caller, for which no
    /// earlier message waits. `registered` is the directory's entry of the sender.
    fn put(
        &mut self,
        mut received: Incoming,
        registered: Option<&Entry>,
        caller: Reader<'_>,
    ) -> Option<Incoming> {
        if let Some(conversation) = self.conversation_of(&received, registered) {
            let is_own =
                matches!(caller, Reader::Conversation(key) if key.number == conversation.number);
            return put_unless(is_own, received, &mut conversation.queue);
        }
        // An answer of the gateway, or the report of an undelivered question, after the end of the call.
        if is_about_presence(&received) {
            return None;
        }
        let mut served = self.served.iter_mut();
        let is_legal = received.violation().is_none();
        if let Some(server) = served.find(|server| is_legal && (server.opens)(received.message())) {
            if server.takes_part
                && let Some(sender) = Sender::of(&received)
                && let Some(id) = received.conversation_id()
            {
                let begun = self
                    .led
                    .begin(&id.as_str(), Admitted::Sender(sender), false);
                received.begun = Some(begun);
            }
            let is_own = matches!(caller, Reader::Server(key) if key.number == server.number);
            return put_unless(is_own, received, &mut server.queue);
        }
        if lock_slot::is_for_locks(&received) {
            return None;
        }
        if matches!(caller, Reader::Others) && self.others.is_empty() {
            return Some(received);
        }
        self.put_other(received);
        None
    }

    /// Adds a message to those for `receive`.
    fn put_other(&mut self, message: Incoming) {
        while !self.is_read && !self.served.is_empty() && self.others.is_at_bound() {
            let dropped = self.others.pop_front();
            let sender = dropped.as_ref().and_then(|it| it.message().sender());
            log_limit::warn!(
                sender = sender.map(|sender| sender.name()),
                "dropped a message: this agent serves protocols and reads no other messages; call \
                 Agent::receive to read them"
            );
        }
        self.others.push_back(message);
    }
}

/// Returns the message if it is the caller's own and the queue is empty; otherwise adds it to the queue.
fn put_unless(is_own: bool, received: Incoming, queue: &mut SetAside) -> Option<Incoming> {
    if is_own && queue.is_empty() {
        return Some(received);
    }
    queue.push_back(received);
    None
}

/// Whether a message is about the presence of agents.
fn is_about_presence(received: &Incoming) -> bool {
    let id = received.conversation_id();
    received
        .ontology()
        .is_some_and(|name| name == presence::ONTOLOGY)
        || id.is_some_and(|id| id.as_str().starts_with(presence::CONVERSATION))
}

impl Admitted {
    /// Whether a message with the id of the conversation belongs to it.
    fn admits(&self, incoming: &Incoming, registered: Option<&Entry>) -> bool {
        let parties = match self {
            Self::Parties(parties) => parties,
            Self::Sender(sender) => return sender.has_sent(incoming),
            Self::All => return true,
        };
        let view = incoming.view();
        let Some(sender) = view.sender().map(|sender| sender.name().as_str()) else {
            return false;
        };
        let is_own = incoming.via.is_none();
        let agent = incoming.sender;
        // The gateway of this host hands over the letters of legacy peers in its own name.
        let is_of_gateway = registered.is_some_and(|it| it.is_own_gateway());
        if let Some(party) = parties.iter().find(|party| *party.name == *sender) {
            return match registered {
                _ if is_own => true,
                Some(_) if is_of_gateway && !party.agent.is_known() => true,
                Some(registered) => *registered.name == *sender,
                None => party.agent == agent,
            };
        }
        let lost = incoming.undelivered_to.as_deref();
        lost.is_some_and(|lost| parties.iter().any(|party| *party.name == *lost))
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use fipa_acl::{AgentId, Performative};
    use fipa_mts::core::Received;
    use fipa_mts::letter_for;
    use fipa_sds::{Directory, MemoryDirectory, MtsId, Reach, Registration, Role};
    use fipa_transport::Kind;

    use super::*;

    const ARM: Incarnation = Incarnation::from_u64(7);
    const MALLORY: Incarnation = Incarnation::from_u64(8);
    const ARMS_MTS: Incarnation = Incarnation::from_u64(9);

    /// Adds a message for a reader other than the caller.
    fn set_aside(state: &mut State, received: Incoming, registered: Option<&Entry>) {
        let own = state.put(received, registered, Reader::Absent);
        assert!(own.is_none());
    }

    /// Creates a received message with the conversation id `c`.
    fn message(sender: &str, from: Incarnation, act: Performative) -> Incoming {
        message_with(sender, from, act, "")
    }

    fn message_with(
        sender: &str,
        from: Incarnation,
        act: Performative,
        content: impl Into<bytes::Bytes>,
    ) -> Incoming {
        let message = Message::builder(act)
            .sender(AgentId::new(sender).unwrap())
            .receiver(AgentId::new("rover").unwrap())
            .conversation_id("c")
            .content(content)
            .build()
            .unwrap();
        let letter = letter_for(&message, SystemTime::UNIX_EPOCH).unwrap();
        let received = Received {
            letter,
            sender: from,
            via: Some(Kind::Shm),
            service: Incarnation::from_u64(1),
            peer: fipa_transport::PeerId::THIS_HOST,
            remote: false,
        };
        Incoming::new(received).unwrap()
    }

    fn entry(name: &str, incarnation: Incarnation) -> Arc<Entry> {
        let directory = MemoryDirectory::new(MtsId::new("mts", ARMS_MTS));
        let agent = Registration::new(name, incarnation, Vec::new());
        directory.register(agent).unwrap()
    }

    fn state() -> (Demultiplexer, ReaderKey) {
        let demultiplexer = Demultiplexer::default();
        let arm = Party::new("arm", Some(&entry("arm", ARM)));
        let key = demultiplexer.begin("c", Admitted::Parties(vec![arm]));
        (demultiplexer, key)
    }

    #[test]
    fn a_message_for_the_caller_is_set_aside_only_behind_an_earlier_one() {
        let (demultiplexer, key) = state();
        let arm = entry("arm", ARM);
        let mut state = demultiplexer.state.lock();
        let inform = || message("arm", ARM, Performative::Inform);
        let conversation = Reader::Conversation(&key);
        // Of the led conversation, for its own reader and for another one.
        assert!(state.put(inform(), Some(&arm), conversation).is_some());
        assert!(state.put(inform(), Some(&arm), Reader::Others).is_none());
        assert!(state.put(inform(), Some(&arm), conversation).is_none());
        assert_eq!(state.led.get(&key).unwrap().queue.messages.len(), 2);
        // Of no conversation.
        let other = || message("mallory", MALLORY, Performative::Inform);
        assert!(state.put(other(), None, Reader::Others).is_some());
        assert!(state.put(other(), None, conversation).is_none());
        assert!(state.put(other(), None, Reader::Others).is_none());
        assert_eq!(state.others.messages.len(), 2);
    }

    /// The gateway of the host is the sender of the stream in which their letters arrive.
    #[test]
    fn messages_of_a_legacy_peer_belong_to_their_conversation() {
        let demultiplexer = Demultiplexer::default();
        let echo = Party::new("echo@jade", None);
        let key = demultiplexer.begin("c", Admitted::Parties(vec![echo]));
        let mut state = demultiplexer.state.lock();
        let (gateway, mallory) = (Incarnation::from_u64(6), entry("mallory", MALLORY));
        let relay = Entry {
            role: Role::Gateway,
            ..Entry::clone(&entry("gateway", gateway))
        };
        let elsewhere = Entry {
            reach: Reach::Remote { gateway },
            ..relay.clone()
        };
        for (registered, from, sender, act, belongs) in [
            (&relay, gateway, "echo@jade", Performative::Inform, true),
            (&relay, gateway, "ams@jade", Performative::Failure, false),
            (&relay, gateway, "other@jade", Performative::Inform, false),
            (&*mallory, MALLORY, "echo@jade", Performative::Inform, false),
            (&*mallory, MALLORY, "ams@jade", Performative::Failure, false),
            (
                &elsewhere,
                gateway,
                "echo@jade",
                Performative::Inform,
                false,
            ),
        ] {
            set_aside(&mut state, message(sender, from, act), Some(registered));
            let conversation = state.led.get(&key).unwrap();
            let found = conversation.queue.pop_front().is_some();
            assert_eq!(found, belongs, "{sender} by {}", registered.name);
        }
    }

    #[test]
    fn a_message_of_an_outsider_goes_to_receive_also_under_the_name_of_a_party() {
        let (demultiplexer, key) = state();
        let mut state = demultiplexer.state.lock();
        let mallory = entry("mallory", MALLORY);
        set_aside(
            &mut state,
            message("mallory", MALLORY, Performative::Inform),
            Some(&mallory),
        );
        set_aside(
            &mut state,
            message("arm", MALLORY, Performative::Inform),
            Some(&mallory),
        );
        // A letter of a legacy peer proves nothing.
        let unknown = Incarnation::UNKNOWN;
        set_aside(
            &mut state,
            message("arm", unknown, Performative::Inform),
            None,
        );
        // A failure that is no proved report, and a report about another agent.
        set_aside(
            &mut state,
            message("mts", MALLORY, Performative::Failure),
            None,
        );
        let mut about_mallory = message("mts", MALLORY, Performative::Failure);
        about_mallory.undelivered_to = Some("mallory".into());
        set_aside(&mut state, about_mallory, None);
        assert!(state.take(Reader::Conversation(&key)).is_none());
        assert_eq!(state.others.messages.len(), 5);
    }

    #[test]
    fn messages_of_the_parties_and_of_their_services_reach_the_conversation() {
        let (demultiplexer, key) = state();
        demultiplexer.admit(&key, Party::new("legacy", None));
        let mut state = demultiplexer.state.lock();
        let unknown = Incarnation::UNKNOWN;
        let arm = entry("arm", ARM);
        set_aside(
            &mut state,
            message("arm", ARM, Performative::Inform),
            Some(&arm),
        );
        // The registration has left the directory.
        set_aside(&mut state, message("arm", ARM, Performative::Inform), None);
        // A new registration of the name.
        let again = entry("arm", MALLORY);
        set_aside(
            &mut state,
            message("arm", MALLORY, Performative::Inform),
            Some(&again),
        );
        set_aside(
            &mut state,
            message("legacy", unknown, Performative::Inform),
            None,
        );
        for lost in ["arm", "legacy"] {
            let mut report = message("mts", ARMS_MTS, Performative::Failure);
            report.undelivered_to = Some(lost.into());
            set_aside(&mut state, report, None);
        }
        assert_eq!(state.others.messages.len(), 0);
        let taken = std::iter::from_fn(|| state.take(Reader::Conversation(&key)));
        assert_eq!(taken.count(), 6);
    }

    #[test]
    fn conversations_with_one_id_and_different_parties_coexist() {
        let (demultiplexer, with_arm) = state();
        let leg_entry = entry("leg", MALLORY);
        let leg = Party::new("leg", Some(&leg_entry));
        let with_leg = demultiplexer.begin("c", Admitted::Parties(vec![leg]));
        {
            let mut state = demultiplexer.state.lock();
            let arm = entry("arm", ARM);
            set_aside(
                &mut state,
                message("arm", ARM, Performative::Inform),
                Some(&arm),
            );
            set_aside(
                &mut state,
                message("leg", MALLORY, Performative::Inform),
                Some(&leg_entry),
            );
            let name = |taken: Option<Incoming>| {
                let message = taken.unwrap().into_message();
                message.sender().unwrap().name().to_owned()
            };
            assert_eq!(name(state.take(Reader::Conversation(&with_arm))), "arm");
            assert_eq!(name(state.take(Reader::Conversation(&with_leg))), "leg");
        }
        demultiplexer.end(&with_arm);
        let mut state = demultiplexer.state.lock();
        set_aside(
            &mut state,
            message("leg", MALLORY, Performative::Inform),
            Some(&leg_entry),
        );
        assert!(state.take(Reader::Conversation(&with_leg)).is_some());
    }

    /// A request, and two cancels of its conversation, the second one of an outsider.
    fn request_and_cancels(state: &mut State) {
        let (arm, mallory) = (entry("arm", ARM), entry("mallory", MALLORY));
        for (from, sender, act) in [
            (ARM, &arm, Performative::Request),
            (ARM, &arm, Performative::Cancel),
            (MALLORY, &mallory, Performative::Cancel),
        ] {
            set_aside(state, message("arm", from, act), Some(sender));
        }
    }

    fn serve_requests(demultiplexer: &Demultiplexer) -> ReaderKey {
        let is_request = |message: &Message| *message.performative() == Performative::Request;
        demultiplexer.serve(Box::new(is_request), Precedence::Protocol)
    }

    /// Takes all messages for a reader: their performatives and senders.
    fn taken(state: &mut State, reader: Reader<'_>) -> Vec<(Performative, Incarnation)> {
        let taken = std::iter::from_fn(|| state.take(reader));
        taken
            .map(|it| (it.message().performative().clone(), it.sender))
            .collect()
    }

    #[test]
    fn messages_that_follow_at_once_wait_for_the_server_that_takes_part() {
        let demultiplexer = Demultiplexer::default();
        let server = serve_requests(&demultiplexer);
        let first = {
            let mut state = demultiplexer.state.lock();
            request_and_cancels(&mut state);
            let first = state.take(Reader::Server(&server)).unwrap();
            let others = taken(&mut state, Reader::Others);
            assert_eq!(others, [(Performative::Cancel, MALLORY)]);
            first
        };
        let arm = Party::new("arm", Some(&entry("arm", ARM)));
        let key = demultiplexer.join("c", &first, Admitted::Parties(vec![arm]));
        let mut state = demultiplexer.state.lock();
        let conversation = taken(&mut state, Reader::Conversation(&key));
        assert_eq!(conversation, [(Performative::Cancel, ARM)]);
        assert_eq!(state.led.by_id.len(), 1);
    }

    /// The sender of a letter of this process is as unknown as that of a letter of a legacy peer.
    #[test]
    fn a_begun_conversation_admits_the_sender_of_its_first_message_only() {
        let unknown = Incarnation::UNKNOWN;
        let gateway = Incarnation::from_u64(6);
        let relay = Entry {
            role: Role::Gateway,
            ..Entry::clone(&entry("gateway", gateway))
        };
        let of = |agent, via, act| {
            let mut message = message("arm", agent, act);
            message.via = via;
            message
        };
        let shm = Some(Kind::Shm);
        for (first, next, registered, belongs) in [
            ((unknown, None), (unknown, None), None, true),
            ((unknown, None), (unknown, shm), None, false),
            ((unknown, None), (gateway, shm), Some(&relay), false),
            ((ARM, shm), (gateway, shm), Some(&relay), false),
            ((gateway, shm), (gateway, shm), Some(&relay), true),
        ] {
            let demultiplexer = Demultiplexer::default();
            let server = serve_requests(&demultiplexer);
            let mut state = demultiplexer.state.lock();
            let request = of(first.0, first.1, Performative::Request);
            set_aside(&mut state, request, registered);
            let cancel = of(next.0, next.1, Performative::Cancel);
            set_aside(&mut state, cancel.clone(), registered);
            let began = state.take(Reader::Server(&server)).unwrap();
            drop(state);
            let key = demultiplexer.join("c", &began, Admitted::All);
            let mut state = demultiplexer.state.lock();
            let found = state.take(Reader::Conversation(&key)).is_some();
            assert_eq!(found, belongs, "{first:?}, {next:?}");
            // The same holds if the application reads the first message.
            let key = state.led.begin("c", Admitted::All, false);
            state.others.push_back(cancel);
            state.claim(&key, &Sender::of(&began).unwrap());
            let found = state.take(Reader::Conversation(&key)).is_some();
            assert_eq!(found, belongs, "{first:?}, {next:?}");
        }
    }

    #[test]
    fn messages_that_wait_for_receive_go_to_the_server_that_starts() {
        let demultiplexer = Demultiplexer::default();
        let (arm, leg) = (entry("arm", ARM), entry("leg", MALLORY));
        let mut state = demultiplexer.state.lock();
        set_aside(
            &mut state,
            message("leg", MALLORY, Performative::Inform),
            Some(&leg),
        );
        for act in [Performative::Request, Performative::Cancel] {
            set_aside(&mut state, message("arm", ARM, act), Some(&arm));
        }
        drop(state);
        let server = serve_requests(&demultiplexer);
        let mut state = demultiplexer.state.lock();
        let first = state.take(Reader::Server(&server)).unwrap();
        assert!(state.take(Reader::Server(&server)).is_none());
        let others = taken(&mut state, Reader::Others);
        assert_eq!(others, [(Performative::Inform, MALLORY)]);
        let key = first.begun.unwrap();
        let conversation = taken(&mut state, Reader::Conversation(&key));
        assert_eq!(conversation, [(Performative::Cancel, ARM)]);
    }

    #[test]
    fn messages_of_a_server_that_ends_go_to_another_one() {
        let demultiplexer = Demultiplexer::default();
        let former = serve_requests(&demultiplexer);
        request_and_cancels(&mut demultiplexer.state.lock());
        let server = serve_requests(&demultiplexer);
        demultiplexer.end_serving(&former);
        let mut state = demultiplexer.state.lock();
        let first = state.take(Reader::Server(&server)).unwrap();
        let key = first.begun.unwrap();
        let conversation = taken(&mut state, Reader::Conversation(&key));
        assert_eq!(conversation, [(Performative::Cancel, ARM)]);
        assert_eq!(state.led.by_id.len(), 1);
    }

    #[test]
    fn a_second_request_with_the_id_of_the_first_one_is_served_after_it() {
        let demultiplexer = Demultiplexer::default();
        let server = serve_requests(&demultiplexer);
        let mut state = demultiplexer.state.lock();
        request_and_cancels(&mut state);
        let first = state.take(Reader::Server(&server)).unwrap();
        request_and_cancels(&mut state);
        assert!(state.take(Reader::Server(&server)).is_none());
        drop(state);
        demultiplexer.abandon(&first);
        let mut state = demultiplexer.state.lock();
        assert!(state.take(Reader::Server(&server)).is_some());
    }

    #[test]
    fn messages_of_an_abandoned_conversation_are_bounded() {
        let demultiplexer = Demultiplexer::default();
        let server = serve_requests(&demultiplexer);
        let arm = entry("arm", ARM);
        for _ in 0..3 {
            let mut state = demultiplexer.state.lock();
            request_and_cancels(&mut state);
            for _ in 0..MAX_SET_ASIDE / 2 {
                let cancel = message("arm", ARM, Performative::Cancel);
                set_aside(&mut state, cancel, Some(&arm));
            }
            let first = state.take(Reader::Server(&server)).unwrap();
            drop(state);
            demultiplexer.abandon(&first);
        }
        let state = demultiplexer.state.lock();
        assert_eq!(state.others.messages.len(), MAX_SET_ASIDE);
        assert!(state.has_room());
    }

    #[test]
    fn unread_messages_name_no_conversation_of_the_agent_that_has_ended() {
        let demultiplexer = Demultiplexer::default();
        let _server = serve_requests(&demultiplexer);
        request_and_cancels(&mut demultiplexer.state.lock());
        let unread = demultiplexer.drain();
        assert!(unread.iter().all(|it| it.begun.is_none()));
        let acts = unread.iter().map(|it| it.message().performative().clone());
        let (request, cancel) = (Performative::Request, Performative::Cancel);
        assert_eq!(acts.collect::<Vec<_>>(), [cancel.clone(), request, cancel]);
    }

    #[test]
    fn messages_that_follow_one_without_a_server_go_to_receive() {
        let cancels = [(Performative::Cancel, MALLORY), (Performative::Cancel, ARM)];
        let demultiplexer = Demultiplexer::default();
        let server = serve_requests(&demultiplexer);
        let first = {
            let mut state = demultiplexer.state.lock();
            request_and_cancels(&mut state);
            state.take(Reader::Server(&server)).unwrap()
        };
        // The server cannot take part.
        demultiplexer.abandon(&first);
        let mut state = demultiplexer.state.lock();
        assert_eq!(taken(&mut state, Reader::Others), cancels);
        assert!(state.led.by_id.is_empty());
        // The server has ended before.
        request_and_cancels(&mut state);
        drop(state);
        demultiplexer.end_serving(&server);
        let mut state = demultiplexer.state.lock();
        let [outsider, own] = cancels;
        let request = (Performative::Request, ARM);
        assert_eq!(taken(&mut state, Reader::Others), [outsider, request, own]);
        assert!(state.led.by_id.is_empty());
    }

    #[test]
    fn messages_that_wait_for_receive_belong_to_the_conversation_that_the_application_joins() {
        let demultiplexer = Demultiplexer::default();
        let first = {
            let mut state = demultiplexer.state.lock();
            request_and_cancels(&mut state);
            state.take(Reader::Others).unwrap()
        };
        let arm = Party::new("arm", Some(&entry("arm", ARM)));
        let key = demultiplexer.join("c", &first, Admitted::Parties(vec![arm]));
        let mut state = demultiplexer.state.lock();
        let conversation = taken(&mut state, Reader::Conversation(&key));
        assert_eq!(conversation, [(Performative::Cancel, ARM)]);
        let others = taken(&mut state, Reader::Others);
        assert_eq!(others, [(Performative::Cancel, MALLORY)]);
    }

    #[test]
    fn set_aside_messages_are_bounded_in_bytes() {
        let demultiplexer = Demultiplexer::default();
        let never = demultiplexer.serve(Box::new(|_| false), Precedence::Part);
        let mut state = demultiplexer.state.lock();
        let content = bytes::Bytes::from(vec![0; MAX_SET_ASIDE_BYTES / 4]);
        let large = message_with("arm", ARM, Performative::Inform, content);
        for _ in 0..20 {
            set_aside(&mut state, large.clone(), None);
            assert!(state.others.bytes <= MAX_SET_ASIDE_BYTES + MAX_SET_ASIDE_BYTES / 4);
        }
        state.is_read = true;
        assert!(!state.has_room());
        while state.others.pop_front().is_some() {}
        assert_eq!(state.others.bytes, 0);
        drop(state);
        demultiplexer.end_serving(&never);
    }

    #[test]
    fn an_arrival_wakes_its_own_reader_only() {
        let (demultiplexer, key) = state();
        let another = demultiplexer.begin("d", Admitted::All);
        let mut state = demultiplexer.state.lock();
        let readers = [
            Reader::Conversation(&key),
            Reader::Conversation(&another),
            Reader::Others,
        ];
        let arrived = readers.map(|reader| state.arrived(reader));
        let mut waiting = arrived.each_ref().map(|it| Box::pin(it.notified()));
        let arm = entry("arm", ARM);
        let inform = message("arm", ARM, Performative::Inform);
        set_aside(&mut state, inform, Some(&arm));
        let are_awake = waiting.each_mut().map(|it| it.as_mut().enable());
        assert_eq!(are_awake, [true, false, false]);
    }

    /// A slow reader wakes the others once for many messages.
    #[test]
    fn readers_wait_for_room_until_an_eighth_of_a_full_queue_is_read() {
        let (demultiplexer, key) = state();
        let arm = entry("arm", ARM);
        let inform = || message("arm", ARM, Performative::Inform);
        let mut changed = Box::pin(demultiplexer.room.notified());
        let put = |state: &mut State| set_aside(state, inform(), Some(&arm));
        (1..MAX_SET_ASIDE).for_each(|_| demultiplexer.change(put));
        assert!(!changed.as_mut().enable());
        demultiplexer.change(put);
        assert!(changed.as_mut().enable());
        assert!(!demultiplexer.state.lock().has_room());

        let take = |state: &mut State| state.take(Reader::Conversation(&key)).unwrap();
        let mut changed = Box::pin(demultiplexer.room.notified());
        (1..MAX_SET_ASIDE / 8).for_each(|_| drop(demultiplexer.change(take)));
        assert!(!changed.as_mut().enable());
        drop(demultiplexer.change(take));
        assert!(changed.as_mut().enable());
        assert!(demultiplexer.state.lock().has_room());
        // A queue that ends leaves no place taken, although its messages fill another one.
        (0..MAX_SET_ASIDE / 8).for_each(|_| demultiplexer.change(put));
        assert!(!demultiplexer.state.lock().has_room());
        demultiplexer.end(&key);
        assert!(!demultiplexer.state.lock().has_room());
        while demultiplexer
            .change(|state| state.take(Reader::Others))
            .is_some()
        {}
        assert!(demultiplexer.state.lock().has_room());
    }

    #[test]
    fn an_agent_that_only_serves_does_not_wait_for_a_reader_of_other_messages() {
        let demultiplexer = Demultiplexer::default();
        let query = Performative::QueryIf;
        let key = demultiplexer.serve(
            Box::new(move |message| *message.performative() == query),
            Precedence::Protocol,
        );
        let mut state = demultiplexer.state.lock();
        let other = || message("arm", ARM, Performative::Inform);
        for _ in 0..MAX_SET_ASIDE + 10 {
            assert!(state.has_room());
            set_aside(&mut state, other(), None);
        }
        assert_eq!(state.others.messages.len(), MAX_SET_ASIDE);
        set_aside(&mut state, message("arm", ARM, Performative::QueryIf), None);
        assert!(state.take(Reader::Server(&key)).is_some());
        state.is_read = true;
        assert!(!state.has_room());
    }
}
