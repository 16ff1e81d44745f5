//! The thin shell around a [`Protocol`]: its sockets, its clock and its sink.
//!
//! A sending thread hands its datagrams to the system itself. One task per socket reads, and one
//! task handles timers; each of them may call the sink, one at a time.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use fipa_transport::{
    Incarnation, ListenError, Location, Sink, TransportError, TransportErrorKind, log_limit,
};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::sync::Notify;
use tokio::task::AbortHandle;
use tokio::time::{sleep, sleep_until};

use super::socket::{Buffers, Sent, Socket};
use super::{Path, Protocol};
use crate::address::{self, Listening, Target};
use crate::end::ConnectionEnd;
use crate::interfaces::Changes;

/// Maximum number of addresses of one name that get a hello.
const MAX_TARGETS: usize = 8;

/// Pause of reading after an error on a listening socket.
const READ_RETRY_DELAY: Duration = Duration::from_millis(10);

/// An endpoint of a protocol.
pub(crate) struct Endpoint<P: Protocol> {
    /// Addresses to listen on.
    listen: Vec<String>,
    /// The incarnation in the locations of this endpoint.
    incarnation: Incarnation,
    runtime: Handle,
    state: Mutex<State<P>>,
    /// Held while the sink is called.
    delivering: Mutex<()>,
    wake: Notify,
    this: Weak<Self>,
}

struct State<P> {
    phase: Phase,
    core: Option<P>,
    sink: Option<Arc<dyn Sink>>,
    sockets: HashMap<u32, (Arc<Socket>, AbortHandle)>,
    last_socket: u32,
    /// Time at which the timer task wakes.
    armed: Option<Instant>,
    listening: Listening,
    /// Watches the interfaces.
    watch: Option<AbortHandle>,
}

impl<P> Default for State<P> {
    fn default() -> Self {
        Self {
            phase: Phase::New,
            core: None,
            sink: None,
            sockets: HashMap::new(),
            last_socket: 0,
            armed: None,
            listening: Listening::default(),
            watch: None,
        }
    }
}

impl<P> State<P> {
    /// Returns the protocol of an open endpoint.
    fn open(&mut self) -> Result<&mut P, TransportError> {
        match (self.phase, self.core.as_mut()) {
            (Phase::Open, Some(core)) => Ok(core),
            (Phase::New, _) => Err(TransportError::new(
                TransportErrorKind::Closed,
                "`listen` has not been called",
            )),
            _ => Err(ConnectionEnd::Closed.after()),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    New,
    Open,
    Closed,
}

impl<P: Protocol> Endpoint<P> {
    pub(crate) fn new(listen: Vec<String>, incarnation: Incarnation, runtime: Handle) -> Arc<Self> {
        Arc::new_cyclic(|this| Self {
            listen,
            incarnation,
            runtime,
            state: Mutex::default(),
            delivering: Mutex::default(),
            wake: Notify::new(),
            this: this.clone(),
        })
    }

    /// Returns the result of a function of the protocol; `None` before [`open`](Self::open).
    pub(crate) fn read<T>(&self, read: impl FnOnce(&P) -> T) -> Option<T> {
        self.state.lock().core.as_ref().map(read)
    }

    /// Opens the sockets and starts the tasks. Returns the present locations of the endpoint; the
    /// sink is notified when they change. `protocol` makes the protocol for the listening addresses.
    pub(crate) fn open(
        &self,
        sink: Arc<dyn Sink>,
        protocol: impl FnOnce(Vec<String>, Instant) -> P,
    ) -> Result<Vec<Location>, ListenError> {
        let mut state = self.state.lock();
        if state.phase != Phase::New {
            return Err(ListenError::OpenedBefore);
        }
        let _inside = self.runtime.enter();
        let unavailable =
            |error: &dyn std::fmt::Display| ListenError::Unavailable(error.to_string());
        let opened = address::bind_all(&self.listen, |address| {
            state.last_socket += 1;
            let socket = Socket::listen(state.last_socket, address, P::FRAGMENTS)?;
            let bound = socket.address()?;
            Ok((socket, bound))
        });
        let (sockets, bound): (Vec<Socket>, Vec<SocketAddr>) = opened?.into_iter().unzip();
        // Subscribed before the interfaces are listed, so that no change is missed.
        let changes = bound
            .iter()
            .any(|bound| !bound.ip().is_loopback())
            .then(Changes::subscribe);
        state.listening = Listening::new(bound).map_err(|error| unavailable(&error))?;
        let locations = state.listening.locations(P::KIND, self.incarnation);
        let locations = locations.map_err(|error| unavailable(&error))?;
        let listening = state.listening.texts();
        state.core = Some(protocol(listening, Instant::now()));
        state.sink = Some(sink);
        state.phase = Phase::Open;
        for socket in sockets {
            self.start(&mut state, socket);
        }
        if let Some(this) = self.this.upgrade() {
            let watch = changes.map(|changes| {
                let watch = follow_interfaces(Weak::clone(&self.this), changes);
                self.runtime.spawn(watch).abort_handle()
            });
            state.watch = watch;
            self.runtime.spawn(run_timers(TimerTask(this)));
        }
        Ok(locations)
    }

    /// Handles a change of the network interfaces: reports the new locations to the sink, and ends
    /// the connections of local addresses that no longer exist.
    fn interfaces_changed(&self) {
        let (sink, locations) = {
            let mut state = self.state.lock();
            let moved = match state.listening.refresh() {
                Ok(moved) => moved,
                Err(error) => {
                    log_limit::warn!(kind = %P::KIND, %error, "cannot refresh the locations; keeping the previous ones");
                    return;
                }
            };
            let texts = state.listening.texts();
            let State { core, sockets, .. } = &mut *state;
            if let Some(core) = core {
                core.listens_on(texts);
                core.lost(&moved.lost, |socket| {
                    let (socket, _) = sockets.get(&socket)?;
                    Some(socket.address().ok()?.ip())
                });
            }
            self.flush_and_wake(&mut state);
            let locations = moved
                .relocated
                .then(|| state.listening.locations(P::KIND, self.incarnation));
            (state.sink.clone(), locations)
        };
        match (sink, locations) {
            (Some(sink), Some(Ok(locations))) => sink.relocated(locations),
            (_, Some(Err(error))) => {
                log_limit::warn!(kind = %P::KIND, %error, "cannot refresh the locations; keeping the previous ones");
            }
            _ => {}
        }
    }

    /// Calls a function of the protocol that sends to a location. It returns the number of the
    /// connection if that is new.
    pub(crate) fn post(
        &self,
        to: &Location,
        send: impl FnOnce(&mut P, Instant) -> Result<Option<u32>, TransportError>,
    ) -> Result<(), TransportError> {
        let mut state = self.state.lock();
        if let Some(fresh) = send(state.open()?, Instant::now())? {
            self.dial(&mut state, fresh, to.address());
        }
        self.flush_and_wake(&mut state);
        Ok(())
    }

    /// Calls a function of the open protocol after which there is nothing to send and no event.
    #[cfg(feature = "udt")]
    pub(crate) fn queue<T>(
        &self,
        queue: impl FnOnce(&mut P) -> Result<T, TransportError>,
    ) -> Result<T, TransportError> {
        queue(self.state.lock().open()?)
    }

    /// Calls a function of the protocol, and sends what it has to send.
    pub(crate) fn call<T>(&self, call: impl FnOnce(&mut P, Instant) -> T) -> Option<T> {
        let mut state = self.state.lock();
        let called = state.core.as_mut().map(|core| call(core, Instant::now()));
        self.flush_and_wake(&mut state);
        called
    }

    /// Closes every connection. The timer task concludes outstanding attempts.
    pub(crate) fn close(&self) {
        let mut state = self.state.lock();
        state.phase = Phase::Closed;
        if let Some(core) = state.core.as_mut() {
            core.close();
        }
        self.flush(&mut state);
        for (_, (_, task)) in state.sockets.drain() {
            task.abort();
        }
        if let Some(watch) = state.watch.take() {
            watch.abort();
        }
        self.wake.notify_one();
    }

    /// Begins to read a socket.
    fn start(&self, state: &mut State<P>, socket: Socket) {
        let Some(this) = self.this.upgrade() else {
            return;
        };
        let socket = Arc::new(socket);
        let task = self.runtime.spawn(read(this, socket.clone()));
        state
            .sockets
            .insert(socket.number, (socket, task.abort_handle()));
    }

    /// Resolves the addresses of a peer.
    fn dial(&self, state: &mut State<P>, connection: u32, text: &str) {
        let error = match address::target(text) {
            Ok(Target::Numeric(address)) => return self.begin(state, connection, &[address]),
            Ok(Target::Named(name, port)) => match self.this.upgrade() {
                Some(this) => {
                    self.runtime.spawn(look_up(this, connection, name, port));
                    return;
                }
                None => ConnectionEnd::Closed.after(),
            },
            Err(error) => TransportError::new(TransportErrorKind::Unreachable, error),
        };
        if let Some(core) = state.core.as_mut() {
            core.cannot_begin(connection, error);
        }
    }

    fn begin(&self, state: &mut State<P>, connection: u32, addresses: &[SocketAddr]) {
        let core = state.core.as_ref();
        if !core.is_some_and(|core| core.is_opening(connection)) {
            // The lookup took longer than the connect timeout: these sockets would never be closed.
            return;
        }
        let _inside = self.runtime.enter();
        let mut paths = Vec::new();
        let mut fault = "the name has no address".to_owned();
        for remote in addresses.iter().take(MAX_TARGETS) {
            if state.listening.is_own(*remote) {
                fault = address::itself(*remote);
                continue;
            }
            state.last_socket = state.last_socket.wrapping_add(1);
            match Socket::connect(state.last_socket, connection, *remote, P::FRAGMENTS) {
                Ok(socket) => {
                    paths.push(Path {
                        socket: socket.number,
                        remote: *remote,
                        local: None,
                    });
                    self.start(state, socket);
                }
                Err(error) => fault = format!("{remote}: {error}"),
            }
        }
        let Some(core) = state.core.as_mut() else {
            return;
        };
        if paths.is_empty() {
            core.cannot_begin(
                connection,
                TransportError::new(TransportErrorKind::Unreachable, fault),
            );
        } else {
            core.begin(Instant::now(), connection, paths);
        }
    }

    /// Sends pending datagrams, and wakes the timer task when necessary.
    fn flush_and_wake(&self, state: &mut State<P>) {
        self.flush(state);
        let Some(core) = &state.core else { return };
        let due = core.poll_timeout();
        let earlier = match (due, state.armed) {
            (Some(due), Some(armed)) => due < armed,
            (due, None) => due.is_some(),
            (None, Some(_)) => false,
        };
        if earlier || core.has_events() {
            self.wake.notify_one();
        }
    }

    fn flush(&self, state: &mut State<P>) {
        let State { core, sockets, .. } = state;
        let Some(core) = core else { return };
        let now = Instant::now();
        while let Some(transmit) = core.poll_transmit(now) {
            let path = transmit.path;
            let Some((socket, _)) = sockets.get(&path.socket) else {
                continue;
            };
            match (socket.send(&transmit), transmit.connection) {
                (Sent::TooBig, Some(number)) => core.too_big(number, transmit.contents.len()),
                (Sent::Broken(error), Some(number)) => {
                    core.handle_error(now, number, path, &error.to_string());
                }
                _ => {}
            }
        }
        while let Some(gone) = core.poll_gone() {
            sockets.retain(|_, (socket, task)| {
                let stays = socket.owner != Some(gone);
                if !stays {
                    task.abort();
                }
                stays
            });
        }
    }

    /// Delivers events to the sink. Must not be called with the state locked.
    fn deliver(&self) {
        let _one_at_a_time = self.delivering.lock();
        loop {
            let (event, sink) = {
                let mut state = self.state.lock();
                let event = state.core.as_mut().and_then(P::poll_event);
                match (event, state.sink.clone()) {
                    (Some(event), Some(sink)) => (event, sink),
                    _ => return,
                }
            };
            P::deliver(event, &*sink, &|call| {
                if let Some(core) = self.state.lock().core.as_mut() {
                    call(core);
                }
            });
        }
    }
}

/// Reads a socket until it is closed.
async fn read<P: Protocol>(endpoint: Arc<Endpoint<P>>, socket: Arc<Socket>) {
    let mut buffers = Buffers::new();
    while let Ok(readiness) = socket.readable().await {
        let received = {
            let mut state = endpoint.state.lock();
            let Some(core) = state.core.as_mut() else {
                return;
            };
            let now = Instant::now();
            let listening = socket.owner.is_none();
            let received = socket.receive(readiness, &mut buffers, |path, bytes| {
                core.handle_datagram(now, path, listening, bytes);
            });
            if let (Err(error), Some(owner)) = (&received, socket.owner)
                && let Ok(remote) = socket.peer()
            {
                let path = Path {
                    socket: socket.number,
                    remote,
                    local: None,
                };
                core.handle_error(now, owner, path, &error.to_string());
            }
            received
        };
        if matches!(received, Ok(0)) {
            continue;
        }
        endpoint.deliver();
        endpoint.flush_and_wake(&mut endpoint.state.lock());
        if received.is_err() {
            sleep(READ_RETRY_DELAY).await;
        }
    }
}

async fn look_up<P: Protocol>(
    endpoint: Arc<Endpoint<P>>,
    connection: u32,
    name: String,
    port: u16,
) {
    let found = address::look_up(name.clone(), port).await;
    let mut state = endpoint.state.lock();
    match found {
        Ok(addresses) => endpoint.begin(&mut state, connection, &addresses),
        Err(error) => {
            let error =
                TransportError::new(TransportErrorKind::Unreachable, format!("{name}: {error}"));
            if let Some(core) = state.core.as_mut() {
                core.cannot_begin(connection, error);
            }
        }
    }
    endpoint.flush_and_wake(&mut state);
}

/// Reports interface changes to an endpoint until the endpoint is dropped or the task is aborted.
async fn follow_interfaces<P: Protocol>(endpoint: Weak<Endpoint<P>>, mut changes: Changes) {
    loop {
        changes.next().await;
        match endpoint.upgrade() {
            Some(endpoint) => endpoint.interfaces_changed(),
            None => return,
        }
    }
}

/// Handles timers until the endpoint is closed.
async fn run_timers<P: Protocol>(task: TimerTask<P>) {
    let endpoint = &task.0;
    loop {
        {
            let mut state = endpoint.state.lock();
            if let Some(core) = state.core.as_mut() {
                core.handle_timeout(Instant::now());
            }
            endpoint.flush(&mut state);
        }
        endpoint.deliver();
        let due = {
            let mut state = endpoint.state.lock();
            endpoint.flush(&mut state);
            if state.phase == Phase::Closed {
                break;
            }
            state.armed = state.core.as_ref().and_then(P::poll_timeout);
            state.armed
        };
        match due {
            Some(due) => tokio::select! {
                () = sleep_until(due.into()) => {}
                () = endpoint.wake.notified() => {}
            },
            None => endpoint.wake.notified().await,
        }
    }
}

/// The timer task. Dropping it closes the endpoint and concludes every attempt.
struct TimerTask<P: Protocol>(Arc<Endpoint<P>>);

impl<P: Protocol> Drop for TimerTask<P> {
    fn drop(&mut self) {
        self.0.close();
        self.0.deliver();
    }
}

#[cfg(test)]
mod tests {
    use fipa_acl::Letter;
    use fipa_transport::{Arrival, AttemptId, Conclusion, Kind, LegacySource, Parcel, Reaction};

    use super::*;
    use crate::datagrams::DatagramCore;
    use crate::udp::Core;
    use crate::{Identity, UdpLimits};

    struct IgnoringSink;

    impl Sink for IgnoringSink {
        fn arrived(&self, _: Arrival) -> Reaction {
            Reaction::Later
        }

        fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

        fn concluded(&self, _: AttemptId, _: Conclusion) {}
    }

    #[tokio::test]
    async fn addresses_resolved_too_late_open_no_sockets() {
        let identity = Identity {
            name: "mts".into(),
            incarnation: Incarnation::from_u64(1),
            domain: "test".into(),
            host: "here".into(),
        };
        let limits = UdpLimits::default();
        let connect_timeout = limits.connect_timeout;
        let endpoint = Endpoint::new(Vec::new(), identity.incarnation, Handle::current());
        let random = Box::new(|| Incarnation::random().as_u64());
        endpoint
            .open(Arc::new(IgnoringSink), |listening, now| {
                Core::new(identity, limits, listening, random, now)
            })
            .unwrap();
        let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let found = [silent.local_addr().unwrap()];
        let sockets = |state: &State<Core>| state.sockets.len();
        let mut state = endpoint.state.lock();
        let to = Location::new(Kind::Udp, &found[0].to_string()).unwrap();
        let core = state.core.as_mut().unwrap();
        let (now, attempt) = (Instant::now(), AttemptId(1));
        let parcel = Parcel {
            receiver: "arm".into(),
            stream: fipa_transport::Stream::between(
                Incarnation::from_u64(1),
                Incarnation::from_u64(2),
            ),
            sequence: 1,
            after: 0,
            remaining: Duration::from_secs(1),
            transfer: 0,
            body: fipa_transport::Body::Credit,
        };
        let fresh = core.post(now, attempt, &to, &parcel).unwrap().unwrap();
        endpoint.begin(&mut state, fresh, &found);
        assert_eq!(sockets(&state), 1);
        let core = state.core.as_mut().unwrap();
        core.handle_timeout(now + connect_timeout);
        endpoint.flush(&mut state);
        assert_eq!(sockets(&state), 0);
        endpoint.begin(&mut state, fresh, &found);
        assert_eq!(sockets(&state), 0);
        drop(state);
        endpoint.close();
    }
}
