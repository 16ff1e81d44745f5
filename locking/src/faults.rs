//! Deliberate mistakes, for the tests that show that the model finds them. Other builds have none.

/// A mistake of the core.
#[cfg(test)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Fault {
    None,
    /// The holder counts its lease from the owner's last probe.
    RenewByProbe,
    /// The holder counts its lease from the arrival of the answer.
    CountFromArrival,
    /// A restarted owner grants at once.
    GrantAfterRestart,
    /// The owner applies a release to the sender's grant, whatever its conversation.
    ReleaseByName,
    /// The owner drops requests that arrive while a grant is live.
    DropDeferred,
    /// The owner gives the same number twice.
    ReuseFence,
    /// A restarted owner counts from the epoch of its life before.
    KeepEpoch,
    /// An owner without a file begins with the first epoch, and nothing but the file raises it: fences
    /// without run, clock and reports.
    FileOnly,
    /// An owner ignores the fences that agents and devices report.
    AskNobody,
    /// An owner without a file, a clock and a report begins with the first epoch.
    BeginAnyway,
    /// The runs of an owner have the same bits.
    SameRun,
    /// The owner agrees while a grant is live.
    IgnoreGate,
    /// A request that was withdrawn is granted by a late report.
    GrantWithdrawn,
    /// A request in the basic form of Ricart-Agrawala does not reach agents that join during it.
    AskNoNewcomer,
    /// The first request does not wait for answers to greetings.
    AwaitNoAnswer,
    /// The agreement of an agent of `distributed_locking` that has not asked this agent yet counts always.
    TrustStranger,
    /// An agent forgets the clocks of the requests that it answered before its first request.
    ForgetClock,
    /// The agent asks and answers like one of `distributed_locking`: it asks no newcomer, and its clock advances with
    /// each message.
    Foreign,
    /// The owner takes a token back as it is.
    TakeWhole,
}

#[cfg(test)]
impl Fault {
    pub(crate) const NO: Self = Self::None;
}

#[cfg(not(test))]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Fault;

#[cfg(not(test))]
impl Fault {
    pub(crate) const NO: Self = Self;
}

/// Whether the core makes one of these mistakes: never outside of tests.
macro_rules! fault {
    ($fault:expr, $($name:ident)|+) => {{
        #[cfg(test)]
        let is = matches!($fault, $(crate::faults::Fault::$name)|+);
        #[cfg(not(test))]
        let is = {
            let crate::faults::Fault = $fault;
            false
        };
        is
    }};
}
pub(crate) use fault;
