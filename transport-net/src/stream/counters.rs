//! Counters of an endpoint, for diagnosis.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;

macro_rules! counters {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// Counters of an endpoint since its creation.
        #[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
        #[non_exhaustive]
        pub struct Counters {
            $($(#[$doc])* pub $name: u64,)*
        }

        /// The live counters.
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
    /// Connections that are open now and whose peer has introduced itself.
    connections,
    /// Connections opened by this side whose peer has introduced itself.
    dialed,
    /// Connections opened by peers that introduced themselves.
    accepted,
    /// Connections that could not be opened.
    dial_failures,
    /// Parcels (letters, reports, credits) handed to the kernel.
    parcels_out,
    /// System calls, or calls of TLS and QUIC, that wrote frames.
    writes,
    /// Parcels that arrived in frames.
    parcels_in,
    /// Large contents that were read from the socket directly into memory of the sink.
    placed,
    /// Bytes of these contents that were read together with preceding bytes, and were copied.
    placed_moved_bytes,
    /// Letters of legacy peers that arrived.
    unframed_in,
    /// Letters handed to legacy peers.
    unframed_out,
    /// Connections closed because the peer violated the protocol or was too slow.
    refused_nonsense,
    /// Letters refused because the peer's certificate does not cover their senders.
    refused_senders,
    /// Connections refused because the peer did not prove its identity, or claimed to be a service
    /// that is already connected.
    refused_unproved,
    /// Connections refused because the peer has an earlier one from the same address, which is alive. A
    /// healthy peer opens another one when its first one is slow.
    refused_again,
    /// Connections refused or evicted because a limit was reached.
    refused_crowd,
    /// Number of times that reading from a peer paused because of its rate limit.
    held_back,
    /// Failures of the operating system to accept a connection.
    accept_failures,
}

/// Progress of writing on a connection.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Written {
    /// Number of parcels that were handed to the kernel.
    pub(crate) parcels: u64,
    /// Number of writes.
    pub(crate) writes: u64,
}

impl Tally {
    /// Counts parcels that were handed to the kernel, and writes.
    pub(crate) fn add_written(&self, written: Written) {
        self.parcels_out
            .fetch_add(written.parcels, Ordering::Relaxed);
        self.writes.fetch_add(written.writes, Ordering::Relaxed);
    }
}

pub(crate) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}
