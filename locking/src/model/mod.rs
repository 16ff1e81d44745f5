//! A model of locks: every order in which messages, faults and the passing of time can meet.
//!
//! Each agent is a [`Locks`], the core that ships. Agent 0 owns the resource. Time has ticks; all
//! times of a state are relative to its own time, so that equal situations at different times are
//! one state.
//!
//! * [`Time::Free`]: messages may be delayed for any number of ticks, up to a number of ticks in all.
//!   It shows what delayed messages, pauses and restarts can do.
//! * [`Time::Prompt`]: a message arrives before time passes, and time never ends. It shows that every
//!   claim ends: from each state, without further faults, a state in which all claims have ended can be
//!   reached.

mod graph;
mod queued;
mod system;
mod tests;
