//! The answers of commands that run an agent.

use fipa::error::ErrorChain;
use fipa::{Agent, Incoming, MessageBuilder, SenderTasks, log_limit};

/// Sends the answers of an agent, those to each sender in order. A sender that takes no answers delays no other.
pub(crate) struct Answers<'a> {
    agent: &'a Agent,
    tasks: SenderTasks,
}

impl<'a> Answers<'a> {
    pub(crate) fn new(agent: &'a Agent) -> Self {
        Self {
            agent,
            tasks: SenderTasks::default(),
        }
    }

    /// Sends the answer to a message. A failed answer does not end the agent.
    pub(crate) async fn send(&mut self, incoming: &Incoming, answer: MessageBuilder) {
        let agent = self.agent.clone();
        let to = incoming.message().sender().map(|it| it.name().to_owned());
        let key = to.clone();
        let sent = async move {
            let answer = match answer.build() {
                Ok(answer) if answer.receivers().is_empty() => {
                    return log_limit::warn!("cannot answer: the message has no sender");
                }
                Ok(answer) => answer,
                Err(error) => {
                    return log_limit::warn!(of: key, error = %ErrorChain(&error), "cannot answer");
                }
            };
            match agent.send(answer).await {
                Ok(deliveries) if deliveries.all_succeeded() => {}
                Ok(deliveries) => {
                    log_limit::warn!(of: key, "the answer was not delivered: {deliveries}");
                }
                Err(error) => {
                    log_limit::warn!(of: key, error = %ErrorChain(&error), "cannot answer");
                }
            }
        };
        if !self.tasks.run(incoming, sent).await {
            log_limit::warn!(of: to, "a message is not answered: the sender takes no answers");
        }
    }

    /// Waits until each answer has an outcome.
    pub(crate) async fn finish(self) {
        self.tasks.finish().await;
    }
}
