//! Draws as SVG, for documents, web pages and printers.
//!
//! Each drawing is a structure with public fields. Its `svg` returns an SVG document:
//!
//! * [`Sequence`]: letters between agents, repeated ones folded.
//! * [`Timeline`]: intervals in rows over a time axis.
//! * [`Plane`]: bodies and their paths in two dimensions.
//! * [`Page`]: several of these under headings.
//! * [`Automaton`]: a protocol as a state machine.
//! * [`Plot`] and [`Bars`]: measurements.
//!
//! ```
//! use fipa_drawing::{Arrow, Sequence, Step};
//!
//! let arrow = Arrow {
//!     from: "rover".to_owned(),
//!     to: "arm".to_owned(),
//!     label: "request".to_owned(),
//!     time: "0.2 s".to_owned(),
//!     ..Arrow::default()
//! };
//! let drawn = Sequence {
//!     lanes: Vec::new(),
//!     steps: vec![Step::Arrow(arrow)],
//! };
//! assert!(drawn.svg().starts_with("<svg "));
//! ```
//!
//! Any text and any number makes a well-formed document: texts are escaped for XML and cut to their space, what is no
//! finite number is left out, and the numbers of elements are limited. Callers write unprintable characters of texts
//! from outside as escapes; those that remain are replaced. The background is white. Colors differ also for the
//! color-blind, and no color is the only sign of a meaning.
//!
//! The crate measures nothing, reads no clock and does no I/O.

mod automaton;
mod bars;
mod canvas;
mod color;
mod page;
mod plane;
mod plot;
mod scale;
mod sequence;
#[cfg(test)]
mod tests;
mod text;
mod timeline;

pub use automaton::{Automaton, Row, State};
pub use bars::{Bar, Bars, Group};
pub use color::Color;
pub use page::{Drawing, Page, Section};
pub use plane::{Body, Plane, Pose, Shape};
pub use plot::{Line, Plot};
pub use sequence::{Arrow, Note, Sequence, Step};
pub use timeline::{Interval, Mark, Timeline, TimelineRow};
