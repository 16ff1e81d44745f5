//! Having others asked: brokering (FIPA00033) and recruiting (FIPA00034).

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};

use super::dialogue::{Dialogue, DialogueError, Heard, Standing, after, only_delivered};
use crate::agent::Agent;

impl Agent {
    /// Asks a broker to pass a message on to those whom it knows to be right for it, and to pass
    /// back their answers (`proxy`, FIPA00033). What to pass on, and to whom, is in the content.
    /// Waits until the broker has agreed and passed it on.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::{AgentId, Performative};
    ///
    /// let proxy = agent
    ///     .message(Performative::Proxy)
    ///     .receiver(AgentId::new("broker")?)
    ///     .content("(any-arm (query-ref (load ?x)))");
    /// let mut answers = agent.brokering(proxy, Duration::from_secs(5)).await?;
    /// println!("{}", answers.next(Duration::from_secs(5)).await?);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// When the message is none that begins the protocol, does not arrive, the broker refuses or
    /// finds nobody ([`DialogueError::Failed`]), or does not answer within `patience`.
    pub async fn brokering(
        &self,
        proxy: MessageBuilder,
        patience: Duration,
    ) -> Result<Proxied<'_>, DialogueError> {
        Proxied::begin(self, "fipa-brokering", proxy, patience).await
    }

    /// The same with a recruiter (FIPA00034): those whom it asks answer directly, in this
    /// conversation. Whether their first answers fit what they were asked cannot be checked here, as
    /// only they and the recruiter know that. Go on with [`Proxied::answer`].
    ///
    /// # Errors
    /// See [`brokering`](Self::brokering).
    pub async fn recruiting(
        &self,
        proxy: MessageBuilder,
        patience: Duration,
    ) -> Result<Proxied<'_>, DialogueError> {
        Proxied::begin(self, "fipa-recruiting", proxy, patience).await
    }
}

/// Something that was passed on to others. Dropped, their answers go to [`Agent::receive`].
#[must_use = "the answers come with next()"]
pub struct Proxied<'a> {
    dialogue: Dialogue<'a>,
    receivers: Vec<AgentId>,
    /// Answers that came before it was said that all had been asked.
    early: VecDeque<Message>,
}

/// Most answers that are kept so.
const MAX_EARLY: usize = 1_024;

impl<'a> Proxied<'a> {
    async fn begin(
        agent: &'a Agent,
        protocol: &str,
        proxy: MessageBuilder,
        patience: Duration,
    ) -> Result<Self, DialogueError> {
        let due = after(patience);
        let receivers = proxy.clone().build()?.receivers().to_vec();
        let (dialogue, sent) = Dialogue::open(agent, protocol, proxy, due).await?;
        only_delivered(&sent)?;
        let mut proxied = Self {
            dialogue,
            receivers,
            early: VecDeque::new(),
        };
        proxied.passed_on(due).await?;
        Ok(proxied)
    }

    async fn passed_on(&mut self, due: Option<Instant>) -> Result<(), DialogueError> {
        while self.early.len() < MAX_EARLY {
            let Heard { message, meaning } = self.dialogue.hear(due).await?;
            if meaning.standing == Standing::Elsewhere {
                self.early.push_back(message);
                continue;
            }
            match message.performative() {
                Performative::Refuse => return Err(DialogueError::Refused(Box::new(message))),
                Performative::Failure => return Err(DialogueError::Failed(Box::new(message))),
                Performative::Inform => break,
                // It agrees.
                _ => {}
            }
        }
        Ok(())
    }

    /// The conversation's id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// The next answer, whatever its performative; waits for it for so long. Nobody says which is the
    /// last.
    ///
    /// # Errors
    /// When none comes in time, or the broker says that it has failed.
    pub async fn next(&mut self, patience: Duration) -> Result<Message, DialogueError> {
        if let Some(early) = self.early.pop_front() {
            return Ok(early);
        }
        let due = after(patience);
        loop {
            let Heard { message, meaning } = self.dialogue.hear(due).await?;
            match message.performative() {
                _ if meaning.standing == Standing::Elsewhere => return Ok(message),
                Performative::Failure => return Err(DialogueError::Failed(Box::new(message))),
                // A recruiter has no answers, and may be slower than those it has recruited.
                _ if self.dialogue.follows("fipa-recruiting") => {}
                _ => return Ok(message),
            }
        }
    }

    /// Goes on with somebody who was recruited, in the protocol of its answer: accepts a proposal, for
    /// example. What it says next comes with [`next`](Self::next).
    ///
    /// ```no_run
    /// # use std::time::Duration;
    /// # use fipa::Performative;
    /// # use fipa::protocol::{DialogueError, Proxied};
    /// # async fn example(mut answers: Proxied<'_>) -> Result<(), DialogueError> {
    /// let patience = Duration::from_secs(5);
    /// let proposal = answers.next(patience).await?;
    /// let accept = Performative::AcceptProposal;
    /// answers.answer(&proposal, accept, "", patience).await?;
    /// println!("{}", answers.next(patience).await?);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// When that protocol does not allow it after this answer, as after those of a broker, or it does
    /// not arrive.
    pub async fn answer(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        patience: Duration,
    ) -> Result<(), DialogueError> {
        let due = after(patience);
        self.dialogue.answer_within(to, act, content, due).await
    }

    /// Cancels what was asked for, and waits until the broker or recruiter has confirmed that.
    ///
    /// # Errors
    /// When it is not cancelled ([`DialogueError::Failed`]), or it is not said in time whether it
    /// is.
    pub async fn cancel(mut self, patience: Duration) -> Result<(), DialogueError> {
        self.dialogue.cancel(self.receivers, after(patience)).await
    }
}
