//! One connection without its socket. Letters travel only from the side that opened it, as those of
//! fipa_services do.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_transport::{
    AttemptId, Conclusion, TransportError, TransportErrorKind, log_limit, quota_address,
};

use super::SYN;
use super::config::UdtLimits;
use super::counters::UdtCounters;
use super::packet::{
    self, CONCLUSION, Control, DATAGRAMS, Data, Handshake, MAX_PACKET, MIN_PACKET, REFUSAL,
    REQUEST, VERSION,
};
use super::receiver::{Arrived, Dropped, Receiver, WINDOW};
use super::sender::Sender;
use crate::datagrams::dialing::Greeting;
use crate::datagrams::{Outbound, Path};
use crate::end::ConnectionEnd;

/// The handshake of a connection that this side opens.
pub(crate) type Dialing = crate::datagrams::dialing::Dialing<OwnHandshake>;

/// Time without a packet from the peer after which a keep-alive is sent, as libudt does.
const KEEP_ALIVE: Duration = Duration::from_millis(300);

/// Minimum number of keep-alives or retransmissions before a peer counts as silent.
const MIN_TRIES: u32 = 2;

/// Maximum number of full packets in one call of the system.
const BATCH: usize = 16;

/// The handshake of this side.
#[derive(Debug)]
pub(crate) struct OwnHandshake {
    /// The socket of this side.
    pub(crate) id: u32,
    pub(crate) initial: u32,
}

impl Greeting for OwnHandshake {
    type Cookie = u32;

    fn datagram(&self, to: SocketAddr, cookie: Option<u32>) -> Vec<u8> {
        let handshake = Handshake {
            version: VERSION,
            kind: DATAGRAMS,
            initial: self.initial,
            max_packet: MAX_PACKET,
            window: WINDOW,
            request: if cookie.is_some() {
                CONCLUSION
            } else {
                REQUEST
            },
            socket: self.id,
            cookie: cookie.unwrap_or(0),
            address: packet::address_words(to),
        };
        packet::control(&Control::Handshake(handshake), 0, 0)
    }
}

#[derive(Debug)]
pub(crate) struct Connection {
    limits: UdtLimits,
    /// The socket of this side, and that of the peer once it is known.
    id: u32,
    peer_id: u32,
    initial: u32,
    path: Option<Path>,
    role: Role,
    begun: Instant,
    /// Time of the last packet of the peer.
    last_received: Instant,
    /// Time of the last packet to the peer, and their number since then.
    spoken: Instant,
    tries: u32,
    /// Time of the last letter.
    busy: Instant,
    /// Answers to packets of the peer.
    replies: Vec<Control>,
}

/// The sockets of a connection, by the numbers that UDT gives them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SocketIds {
    pub(crate) own: u32,
    /// Zero until it is known.
    pub(crate) peer: u32,
}

#[derive(Debug)]
enum Role {
    /// This side opens the connection. Letters wait meanwhile.
    Dialing(Dialing, Box<Sender>),
    Sending(Box<Sender>),
    Receiving(Box<Receiver>),
}

impl Connection {
    /// Creates a connection that this side opens.
    pub(crate) fn dialing(limits: UdtLimits, id: u32, initial: u32, now: Instant) -> Self {
        let dialing = Dialing::new(OwnHandshake { id, initial }, now + limits.connect_timeout);
        let sender = Sender::new(limits.clone(), initial, now);
        let role = Role::Dialing(dialing, Box::new(sender));
        let sockets = SocketIds { own: id, peer: 0 };
        Self::new(limits, sockets, initial, None, role, now)
    }

    /// Creates a connection that a peer has opened, after the peer has returned its cookie.
    pub(crate) fn accepted(
        limits: UdtLimits,
        sockets: SocketIds,
        initial: u32,
        path: Path,
        receiver: Receiver,
        now: Instant,
    ) -> Self {
        let role = Role::Receiving(Box::new(receiver));
        Self::new(limits, sockets, initial, Some(path), role, now)
    }

    fn new(
        limits: UdtLimits,
        sockets: SocketIds,
        initial: u32,
        path: Option<Path>,
        role: Role,
        now: Instant,
    ) -> Self {
        Self {
            limits,
            id: sockets.own,
            peer_id: sockets.peer,
            initial,
            path,
            role,
            begun: now,
            last_received: now,
            spoken: now,
            tries: 0,
            busy: now,
            replies: Vec::new(),
        }
    }

    pub(crate) fn id(&self) -> u32 {
        self.id
    }

    pub(crate) fn path(&self) -> Option<Path> {
        self.path
    }

    /// Whether the peer has not answered the handshake yet.
    pub(crate) fn is_opening(&self) -> bool {
        matches!(self.role, Role::Dialing(..))
    }

    /// Returns the handshake while it is not complete.
    pub(crate) fn dialing_mut(&mut self) -> Option<&mut Dialing> {
        match &mut self.role {
            Role::Dialing(dialing, _) => Some(dialing),
            _ => None,
        }
    }

    /// Returns the sender, if this side opened the connection.
    pub(crate) fn sender(&self) -> Option<&Sender> {
        match &self.role {
            Role::Dialing(_, sender) | Role::Sending(sender) => Some(sender),
            Role::Receiving(_) => None,
        }
    }

    /// Returns the sender to change it, if this side opened the connection.
    pub(crate) fn sender_mut(&mut self) -> Option<&mut Sender> {
        match &mut self.role {
            Role::Dialing(_, sender) | Role::Sending(sender) => Some(sender),
            Role::Receiving(_) => None,
        }
    }

    fn receiver_mut(&mut self) -> Option<&mut Receiver> {
        match &mut self.role {
            Role::Receiving(receiver) => Some(receiver),
            _ => None,
        }
    }

    /// Returns the time since which no part of a letter has been under way.
    pub(crate) fn idle_since(&self) -> Option<Instant> {
        let is_idle = match &self.role {
            Role::Dialing(_, sender) | Role::Sending(sender) => sender.is_idle(),
            Role::Receiving(receiver) => receiver.is_idle(),
        };
        is_idle.then_some(self.busy)
    }

    /// Handles a handshake of the peer that this side dials.
    ///
    /// # Errors
    /// When the peer refuses the connection, or speaks another protocol.
    pub(crate) fn handle_handshake(
        &mut self,
        path: Path,
        handshake: &Handshake,
        now: Instant,
    ) -> Result<(), ConnectionEnd> {
        let Role::Dialing(dialing, _) = &mut self.role else {
            // The answer to a handshake that was sent twice.
            return Ok(());
        };
        match handshake.request {
            REQUEST => {
                dialing.handle_cookie(path, handshake.cookie, now);
                return Ok(());
            }
            CONCLUSION => {}
            REFUSAL => {
                return Err(refused(
                    "the peer refused the connection; its maximum number of clients may be reached",
                ));
            }
            other => {
                let detail = format!("the peer refused the connection with the code {other}");
                return Err(refused(detail));
            }
        }
        let is_fit = handshake.version == VERSION
            && handshake.kind == DATAGRAMS
            && (MIN_PACKET..=MAX_PACKET).contains(&handshake.max_packet);
        if !is_fit {
            let detail = format!(
                "the peer speaks another protocol (UDT version {}, socket type {}, packets of {} bytes)",
                handshake.version, handshake.kind, handshake.max_packet
            );
            let error = TransportError::new(TransportErrorKind::Incompatible, detail);
            return Err(ConnectionEnd::NotOpened(error));
        }
        if handshake.initial != self.initial {
            // An answer to an earlier connection.
            return Ok(());
        }
        let nothing = Sender::new(self.limits.clone(), 0, now);
        if let Some(sender) = self.sender_mut() {
            let mut sender = std::mem::replace(sender, nothing);
            sender.connected(handshake.max_packet, handshake.window, now);
            self.role = Role::Sending(Box::new(sender));
        }
        self.path = Some(path);
        self.peer_id = handshake.socket;
        (self.last_received, self.spoken, self.busy) = (now, now, now);
        Ok(())
    }

    /// Handles a packet with a part of a letter.
    pub(crate) fn handle_data(
        &mut self,
        data: &Data<'_>,
        now: Instant,
        counters: &mut UdtCounters,
    ) {
        self.record_arrival(now);
        let Some(receiver) = self.receiver_mut() else {
            // Letters come over the peer's own connection.
            counters.ignored += 1;
            return;
        };
        match receiver.handle_data(data, now) {
            Ok(()) => {
                counters.packets_in += 1;
                self.busy = now;
            }
            Err(Dropped::Duplicate) => counters.duplicates += 1,
            Err(Dropped::NoRoom) => counters.held_back += 1,
        }
        self.count_refused(counters);
    }

    /// Handles any other packet of a connection that is open.
    ///
    /// # Errors
    /// When the peer closes the connection.
    pub(crate) fn handle_control(
        &mut self,
        control: &Control,
        now: Instant,
        counters: &mut UdtCounters,
    ) -> Result<(), ConnectionEnd> {
        self.record_arrival(now);
        match (control, &mut self.role) {
            (Control::Shutdown, _) => return Err(ConnectionEnd::Hangup),
            (Control::Ack(ack), Role::Sending(sender)) => {
                match sender.handle_ack(ack, now) {
                    Ok(Some(number)) if self.replies.is_empty() => {
                        self.replies.push(Control::Ack2(number));
                    }
                    Ok(_) => {}
                    Err(_) => counters.ignored += 1,
                }
                if sender.is_idle() {
                    self.busy = now;
                }
            }
            (Control::Loss(losses), Role::Sending(sender)) => {
                if sender.handle_losses(losses, now).is_err() {
                    counters.ignored += 1;
                }
            }
            (Control::Ack2(number), Role::Receiving(receiver)) => {
                receiver.handle_ack2(*number, now);
            }
            (
                Control::Drop {
                    message,
                    first,
                    last,
                },
                Role::Receiving(receiver),
            ) => receiver.handle_drop(*message, *first, *last, now),
            (Control::KeepAlive, _) => {}
            _ => counters.ignored += 1,
        }
        self.count_refused(counters);
        Ok(())
    }

    /// Returns the next letter that has arrived.
    pub(crate) fn poll_arrived(&mut self) -> Option<Arrived> {
        self.receiver_mut()?.poll_arrived()
    }

    /// Returns the beginning of the next letter that is too large.
    pub(crate) fn poll_too_large(&mut self) -> Option<Bytes> {
        self.receiver_mut()?.poll_too_large()
    }

    /// Returns the next conclusion.
    pub(crate) fn poll_concluded(&mut self) -> Option<(AttemptId, Conclusion)> {
        self.sender_mut()?.poll_concluded()
    }

    pub(crate) fn has_events(&self) -> bool {
        match &self.role {
            Role::Dialing(_, sender) | Role::Sending(sender) => sender.has_concluded(),
            Role::Receiving(receiver) => receiver.has_arrived(),
        }
    }

    /// Returns the next datagrams, and the size of each except the last if there are several.
    pub(crate) fn poll_transmit(
        &mut self,
        now: Instant,
        counters: &mut UdtCounters,
    ) -> Option<(Path, Vec<u8>, Option<usize>)> {
        if let Role::Dialing(dialing, _) = &mut self.role {
            let (path, contents) = dialing.poll_transmit(now)?;
            return Some((path, contents, None));
        }
        let (path, to, time) = (self.path?, self.peer_id, self.time(now));
        if let Some(reply) = self.replies.pop() {
            self.spoken = now;
            return Some((path, packet::control(&reply, time, to), None));
        }
        let polled = match &mut self.role {
            Role::Dialing(..) => None,
            Role::Sending(sender) => {
                let full = sender.full();
                let mut contents = Vec::with_capacity(full);
                let mut count = 0;
                // Only the last datagram may be shorter.
                while count < BATCH
                    && contents.len() == count * full
                    && sender.poll_packet(now, time, to, &mut contents)
                {
                    count += 1;
                }
                counters.packets_out += count as u64;
                let segment = (count > 1).then_some(full);
                (count > 0).then_some((contents, segment))
            }
            Role::Receiving(receiver) => receiver
                .poll_control(now)
                .map(|control| (packet::control(&control, time, to), None)),
        };
        let (contents, segment) = match polled {
            Some(polled) => polled,
            None if self.keep_alive_at() <= now => {
                self.tries = self.tries.saturating_add(1);
                (packet::control(&Control::KeepAlive, time, to), None)
            }
            None => return None,
        };
        self.spoken = now;
        Some((path, contents, segment))
    }

    /// Returns the time at which something is to be sent or checked.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let role = match &self.role {
            Role::Dialing(dialing, _) => return Some(dialing.due()),
            Role::Sending(sender) => sender.poll_timeout(),
            Role::Receiving(receiver) => receiver.poll_timeout(),
        };
        let due = [
            role,
            Some(self.keep_alive_at()),
            Some(self.silent_at()),
            self.idle_at(),
        ];
        due.into_iter().flatten().min()
    }

    /// Handles the timers that are due.
    ///
    /// # Errors
    /// When the connection ends for that reason.
    pub(crate) fn handle_timeout(&mut self, now: Instant) -> Result<(), ConnectionEnd> {
        match &mut self.role {
            Role::Dialing(dialing, _) => {
                return dialing.handle_timeout(now, self.limits.connect_timeout);
            }
            Role::Sending(sender) => {
                if sender.is_stalled(now) {
                    return Err(ConnectionEnd::TooSlow(
                        "the peer stopped reading (stall_timeout)",
                    ));
                }
                sender.handle_timeout(now);
            }
            Role::Receiving(receiver) => {
                if receiver.handle_timeout(now) {
                    return Err(ConnectionEnd::TooSlow(
                        "the letter arrived too slowly (stall_timeout)",
                    ));
                }
            }
        }
        if self.silent_at() <= now {
            return Err(ConnectionEnd::Silent);
        }
        if self.idle_at().is_some_and(|at| at <= now) {
            return Err(ConnectionEnd::Idle);
        }
        Ok(())
    }

    /// Concludes every letter. Returns the conclusions and the shutdown for the peer.
    pub(crate) fn end(
        self,
        end: &ConnectionEnd,
        now: Instant,
    ) -> (Vec<(AttemptId, Conclusion)>, Option<Outbound>) {
        let time = self.time(now);
        let shutdown = match (self.path, end) {
            (None, _) | (_, ConnectionEnd::Hangup | ConnectionEnd::Broken(_)) => None,
            (Some(path), _) => {
                let shutdown = packet::control(&Control::Shutdown, time, self.peer_id);
                Some((path, shutdown))
            }
        };
        let concluded = match self.role {
            Role::Dialing(_, sender) | Role::Sending(sender) => sender.end(&end.after()).collect(),
            Role::Receiving(_) => Vec::new(),
        };
        (concluded, shutdown)
    }

    /// Returns the answer to the handshake of the peer that opened the connection.
    pub(crate) fn answer(&self, handshake: &Handshake, max_packet: u32) -> Vec<u8> {
        let answer = Handshake {
            max_packet,
            window: WINDOW,
            request: CONCLUSION,
            socket: self.id,
            address: self
                .path
                .map_or([0; 4], |path| packet::address_words(path.remote)),
            ..*handshake
        };
        packet::control(&Control::Handshake(answer), 0, self.peer_id)
    }

    fn record_arrival(&mut self, now: Instant) {
        self.last_received = now;
        self.tries = 0;
    }

    /// Returns the time since the connection began, in microseconds; it wraps around.
    fn time(&self, now: Instant) -> u32 {
        now.saturating_duration_since(self.begun).as_micros() as u32
    }

    /// Returns the time of the next keep-alive: later and later, so that the peer, which sends its
    /// own only after a pause, gets the opportunity.
    fn keep_alive_at(&self) -> Instant {
        let after = KEEP_ALIVE * self.tries.saturating_add(1).min(10);
        self.last_received.max(self.spoken) + after
    }

    /// Returns the time at which the peer counts as silent.
    fn silent_at(&self) -> Instant {
        let timeout = match &self.role {
            Role::Receiving(_) => self.limits.idle_close,
            _ => self.limits.silence,
        };
        let silent = self.last_received + timeout;
        match self.tries >= MIN_TRIES {
            true => silent,
            // At least one more keep-alive.
            false => silent.max(self.keep_alive_at() + SYN),
        }
    }

    /// Returns the time at which this side closes a connection that it opened.
    fn idle_at(&self) -> Option<Instant> {
        match &self.role {
            Role::Sending(_) => Some(self.idle_since()? + self.limits.idle_close),
            _ => None,
        }
    }

    fn count_refused(&mut self, counters: &mut UdtCounters) {
        let Some(receiver) = self.receiver_mut() else {
            return;
        };
        let refused = std::mem::take(&mut receiver.refused);
        if refused > 0 {
            log_limit::warn!(
                of: self.path.map(|path| quota_address(path.remote.ip())),
                "a letter of a legacy peer over UDT is incomplete or exceeds max_letter"
            );
            counters.refused_nonsense += refused;
        }
    }
}

fn refused(detail: impl std::fmt::Display) -> ConnectionEnd {
    ConnectionEnd::NotOpened(TransportError::new(TransportErrorKind::Refused, detail))
}
