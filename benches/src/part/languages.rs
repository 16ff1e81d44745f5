//! An agent that sends requests, and one that answers each with the first and the last byte of its content.
//!
//! `languages/ends.py` has the same two in Python. The sender copies content of the application, as there.

use fipa::{Agent, AgentId, Config, MessageBuilder, Performative};
use tokio::io::{BufReader, Lines, Stdin};

use super::agent::{Steps, listed, play as play_agent};
use super::orders::{End, Letters, Sent, byte_of, now_ns};
use crate::error::chain_text;

/// Length from which a content is written into loaned memory.
const LARGE: usize = 4096;

/// Plays an end. Its address is the name of its agent.
pub(super) fn play(config: &Config, end: End) -> Result<(), String> {
    let name = match end {
        End::Sender => "rust-sender",
        End::Receiver => "rust-receiver",
    };
    play_agent(config, name, |agent, orders| {
        Ok(Correspondent {
            agent,
            to: None,
            orders,
        })
    })
}

struct Correspondent {
    agent: Agent,
    /// A request to the other end, without content.
    to: Option<MessageBuilder>,
    orders: Lines<BufReader<Stdin>>,
}

impl Steps for Correspondent {
    fn orders(&mut self) -> &mut Lines<BufReader<Stdin>> {
        &mut self.orders
    }

    async fn find(&mut self, to: &str) -> Result<(), String> {
        listed(&self.agent, to).await?;
        let to = AgentId::new(to).map_err(chain_text)?;
        self.to = Some(self.agent.message(Performative::Request).receiver(to));
        Ok(())
    }

    async fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let mut sent = Sent::with_room(letters);
        let mut content = vec![0; letters.size];
        for number in 0..letters.count {
            let byte = byte_of(number);
            content.first_mut().into_iter().for_each(|it| *it = byte);
            content.last_mut().into_iter().for_each(|it| *it = byte);
            sent.began.push(now_ns());
            self.request(&content).await?;
            let answer = self.agent.receive().await.map_err(chain_text)?;
            let answer = answer.content().ok_or("no content")?;
            sent.ended.push(now_ns());
            if *answer != [byte, byte] {
                return Err(format!("letter {number} was answered with {answer:?}"));
            }
        }
        Ok(sent)
    }

    async fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let mut at = Vec::with_capacity(letters.count);
        for _ in 0..letters.count {
            let incoming = self.agent.receive().await.map_err(chain_text)?;
            let content = incoming.content().ok_or("no content")?;
            let ends = content.first().zip(content.last());
            let answer = ends.map(|(first, last)| vec![*first, *last]);
            let message = incoming.message();
            let reply = self.agent.reply(message, Performative::Inform);
            let sending = self.agent.send(reply.content(answer.unwrap_or_default()));
            drop((content, incoming));
            sending.await.map_err(chain_text)?;
            at.push(now_ns());
        }
        Ok(at)
    }
}

impl Correspondent {
    async fn request(&self, content: &[u8]) -> Result<(), String> {
        let to = self.to.clone().ok_or("the other end was not found yet")?;
        let deliveries = if content.len() < LARGE {
            self.agent.send(to.content(content.to_vec())).await
        } else {
            let mut loan = self.agent.loan(to, content.len()).map_err(chain_text)?;
            loan.content_mut().copy_from_slice(content);
            self.agent.send_loan(loan).await
        };
        let deliveries = deliveries.map_err(chain_text)?;
        match deliveries.all_succeeded() {
            true => Ok(()),
            false => Err(deliveries.to_string()),
        }
    }
}
