//! Letters between the processes of one host, through shared memory.
//!
//! Every process has one mailbox: an iceoryx2 request-response service of which it is the only
//! server. A parcel is one request, whose memory the receiver reads in place. The answer is a word on
//! the status page of the sender, or the response if it has data. The receiver name in the parcel
//! selects the agent inside the process.
//!
//! * [`ShmTransport`] is the transport, [`ShmConfig`] its configuration.
//! * [`cleanup_dead`] removes the files of killed processes. Every endpoint also does so by itself.
//!   [`inspect`] reports on a domain without changing it.
//! * [`is_in_place`] tells whether content is read without a copy.
//! * [`ShmCounters`] counts parcels, copies and their reasons.
//!
//! | module | content |
//! |---|---|
//! | `endpoint` | the endpoint: mailbox, peers, polling, cleanup |
//! | `inbox`, `outbox` | receiving and sending side of a mailbox |
//! | `content` | writes a parcel, whose content is copied, loaned, or in a segment |
//! | `borrowed` | content that is read in place, and the slots that it holds |
//! | `layout` | types and byte layout in shared memory |
//! | `answer_words`, `deferred` | answers in words; parcels that are answered later |
//! | `loan` | memory that is handed out before its letter is sent |
//! | `segment`, `pool`, `peer_segments` | content stored once for several receivers: file format, sending side, receiving side |
//! | `presence` | liveness FIFO, doorbell and status page of a process |
//! | `peers` | the other processes that an endpoint has open |
//! | `combiner` | work that one thread does for all |
//! | `memory`, `storage`, `payload_files`, `sync_policy`, `variant` | free-space checks and page allocation; the files of iceoryx2 with allocated pages; fewer of them per port; the lock of its ports; the iceoryx2 service variant that uses them |
//! | `domain_files` | the files of a domain, their creation and cleanup |
//! | `errors` | mapping of iceoryx2 errors to transport errors |
//! | `fork` | detection of forked children |
//! | `raw` (feature `raw`) | bare iceoryx2, for comparison in benches |
//!
//! Routes, retries, agent names and deduplication belong to other crates. Each `unsafe` block
//! states its safety argument; no other crate of this project contains `unsafe`.
//!
//! # Trust
//! The processes that share memory run as one user, so each of them can already read and end the others.
//! Even so, no memory that another process can still change is parsed: headers, names and envelopes
//! are copied into private memory first. Only content is read in place; two reads of it give the
//! same bytes only if the sender is honest. A process whose announcements are wrong makes another one
//! poll more slowly; its own parcels may then be found late, and those of others by the next wake-up
//! or the next poll without work. A process that writes to words of another one without a parcel makes
//! outcomes of that one false, or leaves its parcels unconfirmed.

mod answer_words;
#[cfg(test)]
mod answer_words_tests;
mod answered;
mod borrowed;
mod combiner;
mod config;
mod counters;
mod counts_page;
mod deferred;
mod domain_files;
mod endpoint;
mod errors;
mod fork;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod inbox;
mod inspect;
mod layout;
mod loan;
mod memory;
mod outbox;
mod parcel_writer;
mod paths;
mod payload_files;
mod peer_segments;
mod peers;
mod pool;
mod presence;
#[cfg(feature = "raw")]
pub mod raw;
mod secret;
mod segment;
mod shared_files;
mod static_file;
mod storage;
mod sync;
mod sync_policy;
mod transport;
mod variant;
mod wakeup;

pub use borrowed::is_in_place;
pub use config::{ShmConfig, ShmError};
pub use counters::ShmCounters;
pub use counts_page::CountsPage;
pub use domain_files::{Cleaned, cleanup_dead};
pub use fork::OwnerMark;
pub use inspect::{Inspection, inspect};
pub use transport::ShmTransport;
