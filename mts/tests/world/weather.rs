//! What goes wrong in a simulated world.

/// Longer than an attempt may take in these worlds, so that what was given up arrives, too.
pub(super) const LATE_MS: u64 = 500;

/// What goes wrong, and how often.
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
    /// A parcel between hosts is late, by up to [`LATE_MS`], and others overtake it: more than
    /// transports allow themselves.
    pub overtaken: f64,
    /// A parcel between hosts arrives a second time, up to [`LATE_MS`] later: more than transports
    /// allow themselves, too.
    pub copies: f64,
    /// How often a host is cut off from the others for a while: nothing passes, and nobody is told.
    pub partitions: u32,
    /// How many processes die in the course of the run. Most come back as a new life.
    pub deaths: u32,
    /// How often an agent leaves its process and is registered in another one, mostly elsewhere.
    pub moves: u32,
    /// How long news of that takes to another host, at most.
    pub news_ms: u64,
    /// How many hosts there are.
    pub hosts: usize,
    /// How often one kind of transport stops working on one host for a while.
    pub outages: u32,
    /// How long agents wait between two letters they read.
    pub reading_pause_ms: u64,
    /// How long an answer may be on its way back.
    pub(crate) answering_ms: u64,
    /// Bound of each agent's queue.
    pub queue: usize,
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
            partitions: 0,
            deaths: 0,
            moves: 0,
            news_ms: 0,
            hosts: 2,
            outages: 0,
            reading_pause_ms: 1,
            answering_ms: 2,
            queue: 64,
        }
    }

    pub(super) fn is_calm(&self) -> bool {
        self.loss + self.answer_loss + self.refusal + self.silence == 0.0
            && self.overtaken + self.copies == 0.0
            && self.partitions == 0
            && self.deaths == 0
            && self.moves == 0
            && self.outages == 0
            && self.queue >= 64
    }
}
