//! The owner's queue: an agent asks the owner of the resource only, which grants it in the order of arrival.
//!
//! The queue is at the owner ([`Owner`](crate::Owner)). A member knows its own request, and its place if it is
//! one of the first.

use std::collections::BTreeSet;

use super::{Algorithm, Context, MutualExclusion, Step};
use crate::{Act, Conversation, LockPeer, Millis};

/// State of one agent for one resource.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct OwnerQueue {
    own: Option<Conversation>,
    place: Option<u32>,
}

impl MutualExclusion for OwnerQueue {
    fn new(_: Algorithm, _: LockPeer, _: bool) -> Self {
        Self {
            own: None,
            place: None,
        }
    }

    /// No other agent has to agree: the request goes to the owner at once.
    fn request(&mut self, _: &Context<'_>, conversation: &Conversation, out: &mut Vec<Step>) {
        self.own = Some(conversation.clone());
        self.place = None;
        out.push(Step::Entered);
    }

    fn leave(&mut self, _: &Context<'_>, _: &mut Vec<Step>) {
        self.own = None;
        self.place = None;
    }

    fn handle(
        &mut self,
        context: &Context<'_>,
        from: &LockPeer,
        conversation: &Conversation,
        act: &Act,
        _: &mut Vec<Step>,
    ) {
        if let Act::Place { place } = act
            && context.owner == Some(from)
            && self.own.as_ref() == Some(conversation)
        {
            self.place = Some(*place);
        }
    }

    fn gate_changed(&mut self, _: &Context<'_>, _: &mut Vec<Step>) {}

    fn grant_ended(&mut self, _: &LockPeer) {}

    fn own(&mut self, _: &Context<'_>, _: &mut Vec<Step>) {}

    fn owner_changed(&mut self) {}

    fn joined(&mut self, _: &Context<'_>, _: &LockPeer, _: &mut Vec<Step>) {}

    fn lost(&mut self, _: &Context<'_>, _: &LockPeer, _: bool, _: &mut Vec<Step>) {}

    /// The holder repeats the request itself.
    fn repeat(&mut self, _: &Context<'_>, _: &mut Vec<Step>) {}

    fn handle_timeout(&mut self, _: &Context<'_>, _: &mut Vec<Step>) {}

    fn poll_timeout(&self) -> Option<Millis> {
        None
    }

    fn has_entered(&self) -> bool {
        self.own.is_some()
    }

    fn awaited(&self) -> BTreeSet<LockPeer> {
        BTreeSet::new()
    }

    /// The holder and the agents before this one. Only the first are told their places.
    fn ahead(&self) -> Option<usize> {
        self.place
            .map(|place| usize::try_from(place).unwrap_or(usize::MAX))
    }

    fn place(&self) -> Option<u32> {
        self.place
    }

    #[cfg(test)]
    fn rebase(&mut self, _: Millis) {}
}
