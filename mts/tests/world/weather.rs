//! What goes wrong in a simulated world.

use std::time::Duration;

use fipa_mts::core::MAX_DEADLINE;
use fipa_transport::Kind;

/// How long most letters may take.
pub(super) const DEADLINE: Duration = Duration::from_millis(2500);

/// Which deadlines letters have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Deadlines {
    /// [`DEADLINE`] for each, and longer than any delay when the world has healed.
    Same,
    /// From 10 ms to the maximum, drawn for each letter.
    Mixed,
}

impl Deadlines {
    pub(super) fn draw(self, random: &mut fastrand::Rng, healed: bool) -> Duration {
        match self {
            Self::Same if healed => DEADLINE * 20,
            Self::Same => DEADLINE,
            Self::Mixed => match random.u32(..16) {
                0 => Duration::from_millis(10),
                1 => Duration::from_millis(random.u64(10..50)),
                2 => Duration::from_millis(random.u64(50..400)),
                3 | 4 => Duration::from_millis(random.u64(400..2500)),
                5 => MAX_DEADLINE,
                _ => Duration::from_secs(random.u64(10..60)),
            },
        }
    }
}

/// What goes wrong, and how often, until the world heals. Only what belongs to the traffic itself
/// goes on after that: short deadlines, large letters, and refusals of single letters.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Weather {
    /// A parcel is lost on the way; its sender hears that it is unconfirmed.
    pub loss: f64,
    /// A parcel arrives, its answer is lost.
    pub answer_loss: f64,
    /// Nothing leaves, and that is known.
    pub refusal: f64,
    /// A parcel is lost, and nothing is ever heard of it.
    pub silence: f64,
    /// A parcel between hosts is late, by up to [`late_ms`](Self::late_ms), and others overtake
    /// it: more than transports allow themselves.
    pub overtaken: f64,
    /// A parcel between hosts arrives a second time, up to [`late_ms`](Self::late_ms) later: more
    /// than transports allow themselves, too. A letter only if its attempt may have delivered it.
    pub copies: f64,
    /// Longest delay of late parcels and of copies. Longer than an attempt may take in these
    /// worlds, so that parcels of abandoned attempts arrive, too.
    pub late_ms: u64,
    /// How often a host is cut off from the others for a while: nothing passes, and nobody is told.
    pub partitions: u32,
    /// How often TCP between a host and the others stands still for a while: parcels wait in
    /// sockets and outboxes, in order.
    pub stalls: u32,
    /// How many processes die in the course of the run. Most come back as a new life.
    pub deaths: u32,
    /// How many gateways die, and come back.
    pub gateway_deaths: u32,
    /// How many robot processes close in order: they give up what is under way, refuse more, and end.
    pub closings: u32,
    /// How many robot processes are killed and started again, with agents of the same names.
    pub restarts: u32,
    /// How often an agent leaves its process and is registered in another one, mostly elsewhere.
    pub moves: u32,
    /// How long news of registrations and addresses take to another host, at most.
    pub news_ms: u64,
    /// How often a gateway's address of one kind changes; nothing reaches the old one.
    pub addresses: u32,
    /// How many hosts there are.
    pub hosts: usize,
    /// How often one kind of transport stops working on one host for a while.
    pub outages: u32,
    /// How long agents wait between two letters they read.
    pub reading_pause_ms: u64,
    /// How long an answer may be on its way back.
    pub answering_ms: u64,
    /// How long a parcel between two processes of a host may take, beyond the usual.
    pub local_ms: u64,
    /// Bound of each agent's queue.
    pub queue: usize,
    /// Bound of each lane.
    pub lane: usize,
    /// Bytes in each agent's queue.
    pub queue_bytes: usize,
    /// Bytes in each lane.
    pub lane_bytes: usize,
    /// Bytes that a gateway has in custody.
    pub custody_bytes: usize,
    /// The transports in order of preference.
    pub order: &'static [Kind],
    /// Which deadlines letters have.
    pub deadlines: Deadlines,
    /// Share of letters that are larger than a datagram.
    pub large: f64,
    /// Share of letters that every gateway refuses.
    pub refused_by_gateways: f64,
    /// Share of letters that every receiving process refuses.
    pub refused_by_receivers: f64,
    /// How often a gateway refuses all letters for one name, for a while.
    pub denials: u32,
    /// Letters a second that a gateway takes from one host; 0 for any number.
    pub rate: f64,
    /// Letters that it sends then, less than this.
    pub burst: u32,
    /// How often an agent sends a few letters.
    pub bursts: u32,
    /// Pairs of agents that send without a pause from the beginning to the end, also after the
    /// world has healed.
    pub streams: usize,
    /// Whether a gateway and a process lie, also after the world has healed. Gateways have keys then.
    pub liars: bool,
}

impl Weather {
    /// Nothing goes wrong.
    pub(crate) fn calm() -> Self {
        Self {
            loss: 0.0,
            answer_loss: 0.0,
            refusal: 0.0,
            silence: 0.0,
            overtaken: 0.0,
            copies: 0.0,
            late_ms: 500,
            partitions: 0,
            stalls: 0,
            deaths: 0,
            restarts: 0,
            moves: 0,
            news_ms: 0,
            addresses: 0,
            hosts: 2,
            outages: 0,
            reading_pause_ms: 1,
            answering_ms: 2,
            local_ms: 0,
            queue: 64,
            lane: 32,
            queue_bytes: 64 << 20,
            lane_bytes: 64 << 20,
            custody_bytes: 256 << 20,
            gateway_deaths: 0,
            closings: 0,
            burst: 6,
            order: &[Kind::Shm, Kind::Udp, Kind::Tcp],
            deadlines: Deadlines::Same,
            large: 0.0,
            refused_by_gateways: 0.0,
            refused_by_receivers: 0.0,
            denials: 0,
            rate: 0.0,
            bursts: 100,
            streams: 1,
            liars: false,
        }
    }

    /// Nothing goes wrong, and a few agents send without a pause, with all kinds of deadlines.
    pub(crate) fn busy() -> Self {
        Self {
            deadlines: Deadlines::Mixed,
            bursts: 50,
            streams: 2,
            queue: 256,
            lane: 1024,
            ..Self::calm()
        }
    }

    /// The same, with a gateway and a process that lie.
    pub(crate) fn with_liars(self) -> Self {
        Self {
            liars: true,
            ..self
        }
    }

    /// What still goes wrong once the world has healed.
    pub(super) fn healed(self) -> Self {
        Self {
            loss: 0.0,
            answer_loss: 0.0,
            refusal: 0.0,
            silence: 0.0,
            overtaken: 0.0,
            copies: 0.0,
            rate: 0.0,
            ..self
        }
    }

    /// Whether nothing but slow reading goes wrong: then letters fail because queues are full.
    pub(super) fn is_slow_only(&self) -> bool {
        let read_at_once = Self {
            queue: 64,
            deadlines: Deadlines::Same,
            reading_pause_ms: 1,
            ..*self
        };
        self.reading_pause_ms > 1 && self.lane >= 1024 && read_at_once.is_calm()
    }

    pub(super) fn is_calm(&self) -> bool {
        self.loss + self.answer_loss + self.refusal + self.silence == 0.0
            && self.overtaken + self.copies == 0.0
            && self.partitions + self.stalls + self.outages + self.addresses == 0
            && self.deaths + self.restarts + self.moves + self.gateway_deaths + self.closings == 0
            && self.refused_by_gateways + self.refused_by_receivers + self.rate == 0.0
            && self.denials == 0
            && self.deadlines == Deadlines::Same
            && self.queue >= 64
    }
}
