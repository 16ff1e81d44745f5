//! The content of FIPA messages: FIPA-SL (FIPA00008), and Rust values in it by serde.
//!
//! This crate has the values of the content language, the code that turns them into text and back,
//! and the forms that conversations need. It has no input and output, no clocks, no threads and no
//! `unsafe`. Messages around the content are in `fipa-acl`.
//!
//! * [`Content`], [`Wff`] and [`Term`] are parsed text. They borrow from the message, or own their
//!   text after `into_owned()`. [`Printer`] writes them, on one line or indented, for readers of the
//!   standard or of JADE ([`SlDialect`]).
//! * [`to_vec`] and [`from_slice`] convert Rust values to the text of a term and back, without an
//!   intermediate tree.
//! * [`ActionExpression::new`], [`Wff::done`], [`Wff::result`], [`Content::of_refusal`] and
//!   [`Query`] build the contents of conversations. Each has a counterpart that reads.
//! * [`Profile`] checks the subset that `:language` names: `fipa-sl0`, `fipa-sl1`, `fipa-sl2`,
//!   `fipa-sl`.
//!
//! ```
//! use fipa_acl::AgentId;
//! use fipa_content::{ActionExpression, Content, Printer, Profile, Wff};
//! use serde::{Deserialize, Serialize};
//!
//! #[derive(Debug, PartialEq, Serialize, Deserialize)]
//! #[serde(rename = "pose")]
//! struct Pose {
//!     x: f64,
//!     y: f64,
//!     frame: Option<String>,
//! }
//!
//! #[derive(Debug, PartialEq, Serialize, Deserialize)]
//! #[serde(rename_all = "kebab-case")]
//! enum Act {
//!     Dock { target: Pose },
//!     EmergencyStop,
//! }
//!
//! // The client asks.
//! let target = Pose { x: 1.5, y: 0.2, frame: None };
//! let action = ActionExpression::new(&AgentId::new("crex")?, &Act::Dock { target })?;
//! let request = Printer::new().print(&Content::from(action))?;
//! assert_eq!(
//!     request,
//!     b"((action (agent-identifier :name crex) (dock :target (pose :x 1.5 :y 0.2))))"
//! );
//!
//! // The robot reads, and answers.
//! let content = Content::parse(&request)?;
//! Profile::Sl0.check(&content)?;
//! let action = content.action()?;
//! let (agent, act): (AgentId, Act) = action.read()?;
//! assert_eq!(agent.name(), "crex");
//! assert!(matches!(act, Act::Dock { target } if target.x == 1.5));
//! let inform = Printer::new().print(&Content::from(Wff::done(action.clone())))?;
//! assert_eq!(Content::parse(&inform)?.done()?, action);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Rust values as terms
//!
//! | Rust | SL |
//! |---|---|
//! | struct | functional term with parameters: `(pose :x 1.5 :y 0.2)`. Arguments by position are read, too, in the order of the fields |
//! | tuple struct | functional term with arguments by position: `(plus 1 2)` |
//! | unit struct | functional term without arguments: `(brake)` |
//! | newtype struct | the value inside |
//! | enum | its variant: a word for a unit variant, `active` (`(active)` is read, too); otherwise a functional term, `(lift 3)`, `(plus 1 2)`, `(dock :speed 0.5)` |
//! | `Vec`, slice, array, tuple, any set | `(sequence 1 2)`; sets are read, too |
//! | the same in [`Set`] | `(set 1 2)`; sequences are read, too |
//! | map | a set of properties: `(set (property :name speed :value 0.5))`. A functional term with parameters is read, too, its slots as keys. Of a key that is there twice, the last value counts for most types of maps |
//! | `Option` | the value, or a slot that is left out, argument of a newtype variant included. `None` anywhere else is an error |
//! | `()` | `(sequence)` |
//! | `bool` | the words `true` and `false`; as strings, they are in quotation marks |
//! | integers | decimal digits, all 128 bits; hexadecimal ones are read, too. JADE has 64 bits with a sign: larger ones are errors in its dialect |
//! | floats | the fewest digits that read as the same value; integers are read, too. NaN and infinities are errors, and numbers beyond the range of the type, too |
//! | `str`, `String`, `char` | a word, or a string in quotation marks |
//! | bytes (`serialize_bytes`) | byte-length encoded string: `#3"abc`; in JADE's dialect, Base64 |
//! | [`DateTime`] | date-time: `20000508T042651481Z` |
//! | [`Agent`] | agent identifier |
//! | [`Term`] | any term, as it is |
//!
//! Function symbols and slots are the names of serde, to the letter: `#[serde(rename = "pose")]` and
//! `#[serde(rename_all = "kebab-case")]` give those that FIPA has. Unknown slots are ignored, unless
//! the type has `#[serde(deny_unknown_fields)]`. A slot that is there twice, and two fields with one
//! slot, are errors. Structs with `#[serde(flatten)]` are maps.
//!
//! Errors name the offset and the slot: `slot target.x: at byte 24: found the string "far" where f64
//! should be`.
//!
//! # Hostile text
//!
//! Any bytes give a value or a typed error, in time proportional to their number. Parentheses nest at
//! most [`MAX_DEPTH`] deep, and a tree has at most [`MAX_NODES`] terms and formulas; values read by
//! serde take memory for what is there, never for what a length announces.

mod act;
mod agent;
mod chars;
mod content;
mod dialect;
mod error;
mod lex;
mod number;
mod parse;
mod print;
mod profile;
mod query;
mod serde;
mod term;
mod wff;
mod write;

use std::borrow::Cow;

pub use self::serde::{
    Agent, DateTime, DeserializeError, DeserializeErrorKind, SerializeError, Set, from_slice,
    from_slice_in, to_vec, to_vec_in,
};
pub use act::ReadError;
pub use agent::AgentTermError;
pub use content::{Content, ContentExpression};
pub use dialect::SlDialect;
pub use error::{ParseError, PrintError, Problem};
pub use number::Number;
pub use print::{Expression, Printer};
pub use profile::{Profile, ProfileError};
pub use query::Query;
pub use term::{
    ActionExpression, Arguments, FunctionalTerm, IdentifyingExpression, Parameter,
    ReferentialOperator, Term,
};
pub use wff::{LogicalOperator, ModalOperator, Quantifier, Wff};

/// Maximum number of nested parentheses that are read and written.
pub const MAX_DEPTH: usize = 128;

/// Maximum number of terms and formulas in one parsed tree, which bounds the memory that hostile
/// text takes.
pub const MAX_NODES: usize = 1 << 20;

fn into_owned(text: Cow<'_, str>) -> Cow<'static, str> {
    Cow::Owned(text.into_owned())
}
