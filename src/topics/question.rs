//! The question for the topics of an agent: `query-ref` with the ontology [`ONTOLOGY`], and its answer.

use std::borrow::Cow;
use std::convert::Infallible;
use std::sync::Arc;

use fipa_acl::{AgentId, ErrorChain, Message, Performative};
use fipa_content::{
    Content, ParseError, PrintError, Printer, Query, ReadError, ReferentialOperator, Term, Wff,
};

use crate::agent::topics::TopicStatus;
use crate::agent::{Agent, AgentCore};
use crate::protocol::serving::serve_those;
use crate::protocol::{DialogueError, Reply, Server};

/// The ontology of questions for topics.
pub const ONTOLOGY: &str = "fipa-robot-topics";

/// The predicate of topics: `(publishes agent ?topic)`.
const PUBLISHES: &str = "publishes";

/// Maximum length of a question in bytes. A longer one is not parsed.
const MAX_QUESTION: usize = 16 << 10;

/// Maximum length of an answer in bytes. A longer one is not parsed.
const MAX_ANSWER: usize = 1 << 20;

/// The error of a question for the topics of an agent.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TopicsError {
    /// The conversation failed. [`DialogueError::TimedOut`] and [`DialogueError::NotUnderstood`] may mean that the
    /// agent publishes no topics.
    #[error(transparent)]
    Dialogue(#[from] DialogueError),
    /// The answer is longer than this number of bytes.
    #[error("the answer is longer than {0} bytes")]
    TooLarge(usize),
    /// The answer is not FIPA-SL.
    #[error("cannot parse the answer")]
    Parse(#[from] ParseError),
    /// The answer has another form.
    #[error("cannot read the answer")]
    Read(#[from] ReadError),
    /// The name of the agent has no notation in FIPA-SL.
    #[error(transparent)]
    Print(#[from] PrintError),
}

impl Agent {
    /// Asks an agent for its topics, by name.
    ///
    /// An agent with a [`Publisher`](super::Publisher) answers by itself (`query-ref` with the ontology
    /// [`ONTOLOGY`], FIPA00027), unless it [serves](Self::serve) `fipa-query` since before its first publisher.
    ///
    /// # Errors
    /// If the agent is gone, refuses, or does not answer in time.
    pub async fn topics_of(&self, agent: &AgentId) -> Result<Vec<TopicStatus>, TopicsError> {
        let content = Printer::new().print(&question(agent).content())?;
        let message = self
            .message(Performative::QueryRef)
            .receiver(agent.clone())
            .ontology(ONTOLOGY)
            .language("fipa-sl")
            .content(content);
        let timeout = self.domain().inner.answer_timeout();
        let answer = self.query(message, timeout).await?.result().await?;
        read_answer(answer.content().map_or(&[][..], |content| content))
    }
}

/// Answers the questions for the topics of an agent, until the result is dropped.
pub(super) fn answer_questions(core: &Arc<AgentCore>) -> Result<Server, DialogueError> {
    let is_question = |message: &Message| message.ontology() == Some(ONTOLOGY);
    let own = Arc::downgrade(core);
    serve_those(core, "fipa-query", is_question, move |task| {
        let core = own.upgrade();
        async move {
            let question = task.message().content().map_or(&[][..], |content| content);
            let reply = match (core, read_question(question)) {
                (Some(core), Ok(query)) => match print_answer(&query, core.topics.status()) {
                    Ok(answer) => Reply::Inform(answer.into()),
                    Err(error) => Reply::Failure(error.into()),
                },
                (_, Err(error)) => Reply::Refuse(error.into()),
                (None, _) => Reply::Nothing,
            };
            Ok::<_, Infallible>(reply)
        }
    })
}

fn question(agent: &AgentId) -> Query {
    let topic = Term::Variable(Cow::Borrowed("x"));
    Query::all(["x"], Wff::predicate(PUBLISHES, [Term::from(agent), topic]))
}

/// Reads a question. The error is the reason of a refusal.
pub(super) fn read_question(bytes: &[u8]) -> Result<Query, String> {
    if bytes.len() > MAX_QUESTION {
        return Err(format!("the question is longer than {MAX_QUESTION} bytes"));
    }
    let content = Content::parse(bytes).map_err(|error| ErrorChain(&error).to_string())?;
    let query = Query::read(&content).map_err(|error| ErrorChain(&error).to_string())?;
    let expression = query.expression();
    match &expression.wff {
        Wff::Predicate { symbol, arguments }
            if **symbol == *PUBLISHES
                && matches!(&arguments[..], [_, Term::Variable(_)])
                && expression.operator == ReferentialOperator::All =>
        {
            Ok(query)
        }
        _ => Err(format!("expected ((all ?x ({PUBLISHES} agent ?x)))")),
    }
}

fn print_answer(query: &Query, topics: Vec<TopicStatus>) -> Result<Vec<u8>, String> {
    let content = query.answer_all(topics);
    let content = content.map_err(|error| ErrorChain(&error).to_string())?;
    let printed = Printer::new().print(&content);
    printed.map_err(|error| ErrorChain(&error).to_string())
}

fn read_answer(bytes: &[u8]) -> Result<Vec<TopicStatus>, TopicsError> {
    if bytes.len() > MAX_ANSWER {
        return Err(TopicsError::TooLarge(MAX_ANSWER));
    }
    let content = Content::parse(bytes)?;
    // Other agents may repeat the question in another notation, so it is not compared.
    let Wff::Equal(_, topics) = content.wff()? else {
        return Err(ReadError::Expression("((= (all …) (set …)))").into());
    };
    Ok(topics.read().map_err(ReadError::from)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent::topics::SubscriberStatus;

    fn camera() -> AgentId {
        AgentId::new("camera").unwrap()
    }

    #[test]
    fn an_answer_is_read_back() {
        let topics = vec![
            TopicStatus {
                name: "image".to_owned(),
                media_type: Some("image/jpeg".to_owned()),
                rate: Some(30.0),
                measured_rate: Some(29.5),
                published: 7,
                bytes: Some(1_000_000),
                subscribers: 1,
                first_subscribers: vec![SubscriberStatus {
                    name: "viewer".to_owned(),
                    keep: "latest(1)".to_owned(),
                    delivered: 5,
                    replaced: 1,
                    failed: 0,
                    waiting: 1,
                    last_failure: None,
                }],
            },
            TopicStatus {
                name: "a \"b\" (c) ?".to_owned(),
                media_type: None,
                rate: None,
                measured_rate: None,
                published: 0,
                bytes: None,
                subscribers: 0,
                first_subscribers: Vec::new(),
            },
        ];
        let question = question(&camera());
        let printed = Printer::new().print(&question.content()).unwrap();
        let read = read_question(&printed).unwrap();
        let answer = print_answer(&read, topics.clone()).unwrap();
        assert_eq!(read_answer(&answer).unwrap(), topics);
        let answer = print_answer(&read, Vec::new()).unwrap();
        assert_eq!(read_answer(&answer).unwrap(), []);
    }

    #[test]
    fn another_question_is_refused_with_the_form() {
        for other in [
            "((all ?x (offers (agent-identifier :name camera) ?x)))",
            "((iota ?x (publishes (agent-identifier :name camera) ?x)))",
            "((all ?x (publishes ?x)))",
        ] {
            let error = read_question(other.as_bytes()).unwrap_err();
            assert!(error.contains("(publishes agent ?x)"), "{error}");
        }
        assert!(read_question(b"((").is_err());
        assert!(read_question(&[b' '; MAX_QUESTION + 1]).is_err());
        assert!(read_answer(b"((done x))").is_err());
    }
}
