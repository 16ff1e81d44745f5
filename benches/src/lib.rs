//! Measures how fast letters go on this machine, beside the bare mechanisms in the same rounds.
//!
//! Each measured path is a set of real processes: the calling program starts itself again as their
//! ends, in a directory of their own, so no domain of the user is touched. All paths are kept ready
//! and take turns of a few milliseconds, so that other load of the machine affects a path and its
//! limit alike.
//!
//! * [`Comparison`] measures agents, gateways and the bare mechanisms; [`play`] is the part of one
//!   process in it.
//! * [`Baseline`] is an earlier result, and [`Changes`] are the differences from it.
//! * [`Paper`] repeats the evaluation of the C++ libraries: lengths and times of all encodings.
//! * [`Peers`] measures conversations with an agent of JADE, beside those of another JADE platform.
//! * [`Locks`] measures locks, beside the same letters sent by hand.
//! * [`Topics`] measures publications to several subscribers, beside publish-subscribe of iceoryx2 and zenoh.
//! * [`Languages`] measures messages that are answered between Rust and Python, beside what Python has otherwise.
//! * [`Machine`] describes the machine that was measured.
//!
//! The crate has no argument parser and prints nothing; `fipa bench` is its shell.

mod baseline;
mod comparison;
mod error;
mod languages;
mod locks;
mod machine;
mod many;
mod measure;
mod paper;
mod part;
mod path;
mod peers;
mod plot;
mod report;
mod stage;
mod topics;

pub use baseline::{Baseline, Changes};
pub use comparison::{Comparison, Measurement, Program, Selection};
pub use error::{BenchError, PartError};
pub use languages::{Languages, LanguagesReport};
pub use locks::{Locks, LocksReport};
pub use machine::Machine;
pub use measure::Effort;
pub use paper::Paper;
pub use part::play;
pub use peers::{Conversations, Peers, PeersReport};
pub use topics::{Topics, TopicsReport};
