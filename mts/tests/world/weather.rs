//! The faults of a simulation.

use std::time::Duration;

use fipa_mts::core::MAX_DEADLINE;
use fipa_transport::Kind;

/// Deadline of most letters.
pub(super) const DEADLINE: Duration = Duration::from_millis(2500);

/// Distribution of the letters' deadlines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Deadlines {
    /// [`DEADLINE`] for each, which is longer than any delay after the simulation has healed.
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

/// Kinds and rates of faults until the simulation heals. Only properties of the traffic itself
/// continue after that: short deadlines, large letters, and refusals of single letters.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Weather {
    /// A parcel is lost in transit; its sender gets an unconfirmed conclusion.
    pub loss: f64,
    /// A parcel arrives, and its answer is lost.
    pub answer_loss: f64,
    /// A parcel does not leave, and its sender learns that.
    pub refusal: f64,
    /// A parcel is lost without any conclusion.
    pub silence: f64,
    /// A parcel between hosts is late, by up to [`late_ms`](Self::late_ms), and others overtake it,
    /// which real transports do not allow.
    pub overtaken: f64,
    /// A parcel between hosts arrives a second time, up to [`late_ms`](Self::late_ms) later, which
    /// real transports do not allow either. A letter only if its attempt may have delivered it.
    pub copies: f64,
    /// Maximum delay of late parcels and of duplicates. Longer than the timeout of an attempt here,
    /// so that parcels of abandoned attempts also arrive.
    pub late_ms: u64,
    /// Number of temporary disconnections of a host from the others: nothing passes, without a
    /// notification.
    pub partitions: u32,
    /// Number of temporary TCP stalls between a host and the others: parcels wait in sockets and
    /// outboxes, in order.
    pub stalls: u32,
    /// Number of processes that die during the run. Most restart with a new incarnation.
    pub deaths: u32,
    /// Number of gateways that die and restart.
    pub gateway_deaths: u32,
    /// Number of robot processes that close gracefully: they abandon letters in transit, refuse
    /// more, and end.
    pub closings: u32,
    /// Number of gateways that close gracefully: they return the letters in their custody, take no
    /// more, and end.
    pub gateway_closings: u32,
    /// Number of robot processes that are killed and restarted, with agents of the same names.
    pub restarts: u32,
    /// Number of agents that leave their process and are registered in another one, usually on
    /// another host.
    pub moves: u32,
    /// Maximum time for changes of registrations and addresses to reach another host.
    pub news_ms: u64,
    /// Maximum time for a new agent to reach the views of other processes of its host, unless these
    /// refresh them.
    pub lag_ms: u64,
    /// Maximum time of a refresh of a view.
    pub refresh_ms: u64,
    /// Number of changes of a gateway's address of one kind; nothing reaches the old one.
    pub addresses: u32,
    /// Number of hosts.
    pub hosts: usize,
    /// Number of temporary outages of one kind of transport on one host.
    pub outages: u32,
    /// Pause of agents between two letters that they read.
    pub reading_pause_ms: u64,
    /// Maximum delay of an answer.
    pub answering_ms: u64,
    /// Maximum extra delay of a parcel between two processes of a host.
    pub local_ms: u64,
    /// Limit of each agent's queue.
    pub queue: usize,
    /// Limit of each lane.
    pub lane: usize,
    /// Maximum bytes in each agent's queue.
    pub queue_bytes: usize,
    /// Maximum bytes in each lane.
    pub lane_bytes: usize,
    /// Maximum bytes in a gateway's custody.
    pub custody_bytes: usize,
    /// Transports in order of preference.
    pub order: &'static [Kind],
    /// Distribution of the letters' deadlines.
    pub deadlines: Deadlines,
    /// Fraction of letters that are larger than a datagram.
    pub large: f64,
    /// Fraction of letters that every gateway refuses.
    pub refused_by_gateways: f64,
    /// Fraction of letters that every receiving process refuses.
    pub refused_by_receivers: f64,
    /// Number of times that a gateway temporarily refuses all letters for one name.
    pub denials: u32,
    /// Letters per second that a gateway accepts from one host; 0 for no limit.
    pub rate: f64,
    /// Letters that an agent sends at a time are fewer than this.
    pub burst: u32,
    /// Number of times that an agent sends a few letters.
    pub bursts: u32,
    /// Number of pairs of agents that send without a pause from start to end, also after the
    /// simulation has healed.
    pub streams: usize,
    /// Whether a gateway and a process are hostile, also after the simulation has healed. Gateways
    /// then have keys.
    pub liars: bool,
}

impl Weather {
    /// No faults.
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
            lag_ms: 0,
            refresh_ms: 0,
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
            gateway_closings: 0,
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

    /// No faults, and a few agents that send without a pause, with all kinds of deadlines.
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

    /// The same, with a hostile gateway and a hostile process.
    pub(crate) fn with_liars(self) -> Self {
        Self {
            liars: true,
            ..self
        }
    }

    /// The faults that remain after the simulation has healed.
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

    /// Whether slow reading is the only fault: then letters fail because queues are full.
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
            && self.deaths + self.restarts + self.moves == 0
            && self.gateway_deaths + self.closings + self.gateway_closings == 0
            && self.refused_by_gateways + self.refused_by_receivers + self.rate == 0.0
            && self.denials == 0
            && self.deadlines == Deadlines::Same
            && self.queue >= 64
    }
}
