//! What an endpoint counts, for people who look at it.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;

macro_rules! counters {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// What happened at an endpoint since it was made.
        #[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
        #[non_exhaustive]
        pub struct Counters {
            $($(#[$doc])* pub $name: u64,)*
        }

        /// The counters while they count.
        #[derive(Debug, Default)]
        pub(crate) struct Tally {
            $(pub(crate) $name: AtomicU64,)*
        }

        impl Tally {
            pub(crate) fn read(&self) -> Counters {
                Counters { $($name: self.$name.load(Ordering::Relaxed),)* }
            }
        }
    };
}

counters! {
    /// Connections now open with peers that introduced themselves.
    connections,
    /// Connections opened from this side, with a hello from the other.
    dialled,
    /// Connections opened by peers that introduced themselves.
    accepted,
    /// Connections that could not be opened.
    dial_failures,
    /// Parcels (letters, reports, credits) handed to the kernel.
    parcels_out,
    /// Parcels that arrived in frames.
    parcels_in,
    /// Large contents that were read from the socket into the memory they are passed on from.
    placed,
    /// Bytes of these that had been read together with what stands in front, and were copied.
    placed_moved_bytes,
    /// Old peers' letters that arrived.
    unframed_in,
    /// Letters handed to old peers.
    unframed_out,
    /// Connections closed because of what the peer sent, or because it was too slow.
    refused_nonsense,
    /// Letters refused because the peer's certificate does not speak for their senders.
    refused_senders,
    /// Connections that had to prove who is there, and did not, or whose peer said that it is a service
    /// that is connected.
    refused_unproved,
    /// Connections refused or pushed out because there were too many.
    refused_crowd,
    /// How often a peer was read from later, because it had sent more than it may.
    held_back,
    /// Failures of the operating system to hand out a new connection.
    accept_failures,
}

pub(crate) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}
