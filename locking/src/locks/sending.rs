//! Messages of this agent.

use std::sync::Arc;

use super::event::Action;
use super::{Actions, Locks};
use crate::{
    Act, Algorithm, Content, Conversation, LockDialect, LockMessage, LockPeer, Millis,
    MutualExclusion, Resource,
};

impl<A: MutualExclusion> Locks<A> {
    /// Asks an agent for a sign of life.
    pub fn probe(&mut self, now: Millis, to: LockPeer, out: &mut Actions) {
        let message = LockMessage {
            conversation: self.side_conversation("probe", now),
            dialect: LockDialect::Own,
            algorithm: None,
            content: Content::Probe,
        };
        out.push(Action::Send { to, message });
    }

    pub(super) fn send(
        &mut self,
        to: LockPeer,
        resource: &Resource,
        conversation: Conversation,
        act: Act,
        out: &mut Actions,
    ) {
        let kind = self.kind_of(resource);
        self.send_in(kind, to, resource, conversation, act, out);
    }

    /// Sends a message of an algorithm.
    pub(super) fn send_in(
        &mut self,
        kind: Algorithm,
        to: LockPeer,
        resource: &Resource,
        conversation: Conversation,
        act: Act,
        out: &mut Actions,
    ) {
        let message = LockMessage {
            conversation,
            dialect: LockDialect::Own,
            algorithm: self.algorithm_in(&act, kind, &to),
            content: Content::Lock {
                resource: resource.clone(),
                act,
            },
        };
        if to == self.me {
            self.local.push_back(message);
        } else {
            out.push(Action::Send { to, message });
        }
    }

    /// A conversation beside those of requests. Its number is the time, or the next one that is free.
    pub(super) fn side_conversation(&mut self, kind: &str, now: Millis) -> Conversation {
        let number = now.max(self.next_side_conversation);
        self.next_side_conversation = number.saturating_add(1);
        let prefix: Arc<str> = format!("{}_{kind}", self.me.name()).into();
        Conversation::new(prefix, number)
    }
}
