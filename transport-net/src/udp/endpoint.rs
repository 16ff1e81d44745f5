//! The thin shell around [`Core`]: its sockets, its clock and its sink.
//!
//! A sending thread hands its datagrams to the system itself. One task per socket reads, and one
//! task handles timers; each of them may call the sink, one at a time.

use std::collections::HashMap;
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use fipa_transport::{
    Abandoned, Answer, Arrival, AttemptId, Kind, ListenError, Location, Parcel, Sink, Ticket,
    TransportError, TransportErrorKind, Verdict,
};
use parking_lot::Mutex;
use tokio::net::lookup_host;
use tokio::runtime::Handle;
use tokio::sync::Notify;
use tokio::task::AbortHandle;
use tokio::time::{sleep, sleep_until};

use super::config::UdpConfig;
use super::connection::Path;
use super::core::{Core, CoreEvent, Random};
use super::counters::UdpCounters;
use super::socket::{Buffers, Sent, Socket};
use crate::address::{self, Listening, Target};
use crate::end::ConnectionEnd;
use crate::interfaces::Changes;

/// Maximum number of addresses of one name that get a hello.
const MAX_TARGETS: usize = 8;

/// Pause of reading after an error on a listening socket.
const READ_RETRY_DELAY: Duration = Duration::from_millis(10);

pub(crate) struct Endpoint {
    pub(crate) config: UdpConfig,
    runtime: Handle,
    state: Mutex<State>,
    /// OutOfOrderParcel while the sink is called.
    delivering: Mutex<()>,
    wake: Notify,
    this: Weak<Self>,
}

#[derive(Default)]
struct State {
    phase: Phase,
    core: Option<Core>,
    sink: Option<Arc<dyn Sink>>,
    sockets: HashMap<u32, (Arc<Socket>, AbortHandle)>,
    last_socket: u32,
    /// Time at which the timer task wakes.
    armed: Option<Instant>,
    listening: Listening,
    /// Watches the interfaces.
    watch: Option<AbortHandle>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Phase {
    #[default]
    New,
    Open,
    Closed,
}

impl Endpoint {
    pub(crate) fn new(config: UdpConfig, runtime: Handle) -> Arc<Self> {
        Arc::new_cyclic(|this| Self {
            config,
            runtime,
            state: Mutex::default(),
            delivering: Mutex::default(),
            wake: Notify::new(),
            this: this.clone(),
        })
    }

    pub(crate) fn counters(&self) -> UdpCounters {
        let state = self.state.lock();
        state.core.as_ref().map(Core::counters).unwrap_or_default()
    }

    /// Opens the sockets and starts the tasks. Returns the present locations of the endpoint; the
    /// sink is notified when they change.
    pub(crate) fn open(
        &self,
        sink: Arc<dyn Sink>,
        random: Random,
    ) -> Result<Vec<Location>, ListenError> {
        let mut state = self.state.lock();
        if state.phase != Phase::New {
            return Err(ListenError::OpenedBefore);
        }
        let _inside = self.runtime.enter();
        let unavailable =
            |error: &dyn std::fmt::Display| ListenError::Unavailable(error.to_string());
        let mut sockets = Vec::new();
        let mut bound = Vec::new();
        for text in &self.config.listen {
            let address = address::numeric(text).map_err(|error| unavailable(&error))?;
            let number = state.last_socket + 1;
            state.last_socket = number;
            let cannot = |error| address::cannot_bind(text, &error);
            let socket = Socket::listen(number, address).map_err(cannot)?;
            bound.push(socket.address().map_err(cannot)?);
            sockets.push(socket);
        }
        // Subscribed before the interfaces are listed, so that no change is missed.
        let changes = bound
            .iter()
            .any(|bound| !bound.ip().is_loopback())
            .then(Changes::subscribe);
        state.listening = Listening::new(bound).map_err(|error| unavailable(&error))?;
        let UdpConfig {
            identity, limits, ..
        } = &self.config;
        let locations = state.listening.locations(Kind::Udp, identity.incarnation);
        let locations = locations.map_err(|error| unavailable(&error))?;
        let listening = state.listening.texts();
        let now = Instant::now();
        let core = Core::new(identity.clone(), limits.clone(), listening, random, now);
        state.core = Some(core);
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
        let (sink, told) = {
            let mut state = self.state.lock();
            let moved = match state.listening.refresh() {
                Ok(moved) => moved,
                Err(error) => {
                    tracing::warn!(kind = %Kind::Udp, %error, "cannot refresh the locations; keeping the previous ones");
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
            let incarnation = self.config.identity.incarnation;
            let told = moved
                .relocated
                .then(|| state.listening.locations(Kind::Udp, incarnation));
            (state.sink.clone(), told)
        };
        match (sink, told) {
            (Some(sink), Some(Ok(locations))) => sink.relocated(locations),
            (_, Some(Err(error))) => {
                tracing::warn!(kind = %Kind::Udp, %error, "cannot refresh the locations; keeping the previous ones");
            }
            _ => {}
        }
    }

    pub(crate) fn dispatch(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: &Parcel,
    ) -> Result<(), TransportError> {
        let mut state = self.state.lock();
        let now = Instant::now();
        let core = match (state.phase, state.core.as_mut()) {
            (Phase::Open, Some(core)) => core,
            (Phase::New, _) => {
                return Err(TransportError::new(
                    TransportErrorKind::Closed,
                    "`listen` has not been called",
                ));
            }
            _ => return Err(ConnectionEnd::Closed.after()),
        };
        if let Some(fresh) = core.dispatch(now, attempt, to, parcel)? {
            self.dial(&mut state, fresh, to.address());
        }
        self.flush_and_wake(&mut state);
        Ok(())
    }

    pub(crate) fn abandon(&self, attempt: AttemptId) -> Abandoned {
        let mut state = self.state.lock();
        let core = state.core.as_mut();
        core.map_or(Abandoned::Unconfirmed, |core| core.abandon(attempt))
    }

    pub(crate) fn answer(&self, ticket: Ticket, answer: &Answer) {
        let mut state = self.state.lock();
        if let Some(core) = state.core.as_mut() {
            core.answer(Instant::now(), ticket, answer);
        }
        self.flush_and_wake(&mut state);
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
    fn start(&self, state: &mut State, socket: Socket) {
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
    fn dial(&self, state: &mut State, connection: u32, text: &str) {
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

    fn begin(&self, state: &mut State, connection: u32, addresses: &[SocketAddr]) {
        let core = state.core.as_ref();
        if !core.is_some_and(|core| core.is_opening(connection)) {
            // The lookup took longer than the connect timeout: these sockets would never be closed.
            return;
        }
        let _inside = self.runtime.enter();
        let mut paths = Vec::new();
        let mut fault = "the name has no address".to_owned();
        for remote in addresses.iter().take(MAX_TARGETS) {
            state.last_socket = state.last_socket.wrapping_add(1);
            match Socket::connect(state.last_socket, connection, *remote) {
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
    fn flush_and_wake(&self, state: &mut State) {
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

    fn flush(&self, state: &mut State) {
        let State { core, sockets, .. } = state;
        let Some(core) = core else { return };
        let now = Instant::now();
        while let Some(transmit) = core.poll_transmit(now) {
            let path = transmit.path;
            let Some((socket, _)) = sockets.get(&path.socket) else {
                continue;
            };
            match (socket.send(path, &transmit.contents), transmit.connection) {
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
            let (told, sink) = {
                let mut state = self.state.lock();
                let told = state.core.as_mut().and_then(Core::poll_event);
                match (told, state.sink.clone()) {
                    (Some(told), Some(sink)) => (told, sink),
                    _ => return,
                }
            };
            match told {
                CoreEvent::Concluded(attempt, conclusion) => sink.concluded(attempt, conclusion),
                CoreEvent::Introduced(peer) => sink.introduced(&peer),
                CoreEvent::Parted(peer) => sink.parted(&peer),
                CoreEvent::Arrived {
                    parcel,
                    from,
                    ticket,
                } => {
                    let verdict = sink.arrived(Arrival {
                        parcel: *parcel,
                        from,
                        ticket,
                    });
                    if let (Verdict::Now(answer), Some(core)) =
                        (verdict, self.state.lock().core.as_mut())
                    {
                        core.answer(Instant::now(), ticket, &answer);
                    }
                }
            }
        }
    }
}

/// Reads a socket until it is closed.
async fn read(endpoint: Arc<Endpoint>, socket: Arc<Socket>) {
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

async fn look_up(endpoint: Arc<Endpoint>, connection: u32, name: String, port: u16) {
    let found: io::Result<Vec<SocketAddr>> = lookup_host((name.as_str(), port))
        .await
        .map(Iterator::collect);
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
async fn follow_interfaces(endpoint: Weak<Endpoint>, mut changes: Changes) {
    loop {
        changes.next().await;
        match endpoint.upgrade() {
            Some(endpoint) => endpoint.interfaces_changed(),
            None => return,
        }
    }
}

/// Handles timers until the endpoint is closed.
async fn run_timers(task: TimerTask) {
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
            state.armed = state.core.as_ref().and_then(Core::poll_timeout);
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
struct TimerTask(Arc<Endpoint>);

impl Drop for TimerTask {
    fn drop(&mut self) {
        self.0.close();
        self.0.deliver();
    }
}

#[cfg(test)]
mod tests {

    use fipa_acl::Letter;
    use fipa_transport::{Conclusion, Incarnation, LegacySource};

    use super::*;
    use crate::{Identity, UdpLimits};

    struct IgnoringSink;

    impl Sink for IgnoringSink {
        fn arrived(&self, _: Arrival) -> Verdict {
            Verdict::Later
        }

        fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

        fn concluded(&self, _: AttemptId, _: Conclusion) {}
    }

    #[tokio::test]
    async fn addresses_resolved_too_late_open_no_sockets() {
        let config = UdpConfig {
            listen: Vec::new(),
            identity: Identity {
                name: "mts".into(),
                incarnation: Incarnation::from_u64(1),
                domain: "test".into(),
                host: "here".into(),
            },
            limits: UdpLimits::default(),
        };
        let endpoint = Endpoint::new(config, Handle::current());
        let random = Box::new(|| Incarnation::random().as_u64());
        endpoint.open(Arc::new(IgnoringSink), random).unwrap();
        let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let found = [silent.local_addr().unwrap()];
        let sockets = |state: &State| state.sockets.len();
        let mut state = endpoint.state.lock();
        let to = Location::new(Kind::Udp, &found[0].to_string()).unwrap();
        let core = state.core.as_mut().unwrap();
        let (now, attempt) = (Instant::now(), AttemptId(1));
        let parcel = Parcel {
            receiver: "arm".into(),
            stream: fipa_transport::Stream {
                sender: Incarnation::from_u64(1),
                receiver: Incarnation::from_u64(2),
            },
            sequence: 1,
            after: 0,
            remaining: Duration::from_secs(1),
            transfer: 0,
            body: fipa_transport::Body::Credit,
        };
        let fresh = core.dispatch(now, attempt, &to, &parcel).unwrap().unwrap();
        endpoint.begin(&mut state, fresh, &found);
        assert_eq!(sockets(&state), 1);
        let core = state.core.as_mut().unwrap();
        core.handle_timeout(now + endpoint.config.limits.connect_timeout);
        endpoint.flush(&mut state);
        assert_eq!(sockets(&state), 0);
        endpoint.begin(&mut state, fresh, &found);
        assert_eq!(sockets(&state), 0);
        drop(state);
        endpoint.close();
    }
}
