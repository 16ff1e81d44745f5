//! Content languages: notations of the same contents.

use std::fmt;

use fipa_acl::AgentId;
use fipa_content::{ParseError, PrintError, ReadError, SerializeError};

use crate::message::{ActionAnswer, Ask};
use crate::{Json, Sl};

/// A content language of messages about actions. The performative and the protocol of a message are
/// independent of it.
pub trait Language: fmt::Debug + Send + Sync {
    /// Name of the language, the value of `language` in messages.
    fn name(&self) -> &'static str;

    /// Writes a message to this robot.
    ///
    /// # Errors
    /// If the language has no notation for a value.
    fn write_ask(&self, robot: &AgentId, ask: &Ask) -> Result<Vec<u8>, LanguageError>;

    /// Reads a message to a robot, and the name of the robot.
    ///
    /// # Errors
    /// If the bytes are not such a message.
    fn read_ask(&self, bytes: &[u8]) -> Result<(String, Ask), LanguageError>;

    /// Writes the answer of this robot to a message.
    ///
    /// # Errors
    /// If the language has no notation for a value.
    fn write_answer(
        &self,
        robot: &AgentId,
        to: &Ask,
        answer: &ActionAnswer,
    ) -> Result<Vec<u8>, LanguageError>;

    /// Reads the `agree` or `inform` of a robot to a message.
    ///
    /// # Errors
    /// If the bytes are not such an answer.
    fn read_answer(&self, to: &Ask, bytes: &[u8]) -> Result<ActionAnswer, LanguageError>;

    /// Reads the `refuse` or `failure` of a robot.
    ///
    /// # Errors
    /// If the bytes are not such an answer.
    fn read_rejection(&self, is_refusal: bool, bytes: &[u8])
    -> Result<ActionAnswer, LanguageError>;
}

/// Returns the content language with this name: that of `language` of a message, FIPA-SL without one.
#[must_use]
pub fn language(name: Option<&str>) -> Option<&'static dyn Language> {
    let name = name.unwrap_or("fipa-sl");
    let is = |known: &str| name.eq_ignore_ascii_case(known);
    if ["fipa-sl", "fipa-sl0", "fipa-sl1", "fipa-sl2"]
        .iter()
        .any(|it| is(it))
    {
        return Some(&Sl);
    }
    is("json").then_some(&Json)
}

/// The error of writing or reading a content.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LanguageError {
    /// The bytes are not SL.
    #[error(transparent)]
    Parse(#[from] ParseError),
    /// The bytes are not JSON.
    #[error("the content is not JSON of the ontology")]
    Json(#[from] serde_json::Error),
    /// The SL content has another form.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The content has another form.
    #[error("the content is not {0}")]
    Form(&'static str),
    /// A value has no notation in SL.
    #[error(transparent)]
    Print(#[from] PrintError),
    /// A value has no notation in SL.
    #[error(transparent)]
    Serialize(#[from] SerializeError),
    /// A value has no notation in JSON.
    #[error("JSON has no notation for {0}")]
    NoNotation(&'static str),
}
