//! Suzuki-Kasami: an agent enters when it has the token.
//!
//! A request has a number and goes to all members. The token has the number of the last request of
//! each agent that was served, and a queue. Its holder adds each agent with a higher number to the
//! queue when it leaves, and passes the token to the first agent of the queue. An agent that has the
//! token enters without a message.
//!
//! In the extended form the token goes from the owner to one agent and back. The owner makes a token of
//! a new generation when that agent is gone, when its grant has ended without the token's return, or
//! when it asks again. Tokens of older generations are discarded. The owner keeps a copy of the token that it has sent,
//! and changes the copy when an agent has another registration, or asks again. What returns changes the copy in
//! the number of the agent that had the token, and in nothing else: the owner knows all requests itself.
//!
//! **Overtaking.** After a request has reached the agent that passes the token on next (in the extended
//! form: the owner), each other agent enters at most once before it, in addition to the agent that has
//! entered or is about to receive the token. The queue is first in, first out, and agents that ask again are
//! added behind.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::{Algorithm, Context, MutualExclusion, Step};
use crate::faults::fault;
use crate::{Act, Conversation, LockDialect, LockPeer, Millis, OwnerGate, Token};

/// Maximum number of a request: `distributed_locking` reads a 32-bit integer.
const MAX_NUMBER: u64 = i32::MAX as u64;

/// State of one agent for one resource.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct SuzukiKasami {
    me: LockPeer,
    extended: bool,
    /// Latest request of each other agent, by name, as in the token.
    requests: BTreeMap<Arc<str>, Request>,
    /// Number of the last request of this agent.
    number: u64,
    /// Whether the token for `number` has not arrived. It arrives also after a withdrawal. The next
    /// request uses this number again: an agent of `distributed_locking` serves a number only if it
    /// served the one before.
    pending: bool,
    own: Option<OwnRequest>,
    /// Conversation of the request that this agent leaves or has withdrawn, during that call: the token's
    /// return is its report.
    leaving: Option<Conversation>,
    token: Option<Token>,
    /// In the extended form, the conversation in which an owner of `distributed_locking` has sent the token. It
    /// expects the return there, and uses that of an earlier request if the last one has not arrived.
    arrived: Option<Conversation>,
    /// Newest generation.
    generation: u64,
    /// Version of the archive that a legacy agent wrote last.
    archive: Option<u16>,
    /// At the owner in the extended form: the agent that has the token.
    away: Option<Away>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Request {
    peer: LockPeer,
    number: u64,
    conversation: Conversation,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct OwnRequest {
    conversation: Conversation,
    entered: bool,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Away {
    to: LockPeer,
    /// Number of the request that the token was sent for.
    number: u64,
    /// The token as it was sent.
    token: Token,
    /// Time after which the token may be replaced.
    until: Millis,
    /// Whether it may be replaced when no grant is live: the agent is lost, its grant has ended, or the
    /// time is over.
    over: bool,
    /// Whether the agent is gone: another registration of its name counts its requests from 1.
    gone: bool,
}

impl SuzukiKasami {
    fn is_owner(&self, context: &Context<'_>) -> bool {
        context.owner == Some(&self.me)
    }

    fn ask(&self, own: &OwnRequest, to: &LockPeer) -> Step {
        Step::Send {
            to: to.clone(),
            conversation: own.conversation.clone(),
            act: Act::RequestToken {
                number: self.number,
            },
        }
    }

    fn enter(&mut self, out: &mut Vec<Step>) {
        if let Some(own) = &mut self.own
            && !own.entered
        {
            own.entered = true;
            out.push(Step::Entered);
        }
    }

    fn record(&mut self, from: &LockPeer, number: u64, conversation: &Conversation) -> bool {
        let name = from.shared_name();
        let known = self.requests.get(name);
        let restarted = known.is_some_and(|known| known.peer != *from);
        if !restarted && known.is_some_and(|known| known.number >= number) {
            return false;
        }
        if restarted {
            self.forget(name);
        }
        let request = Request {
            peer: from.clone(),
            number,
            conversation: conversation.clone(),
        };
        self.requests.insert(name.clone(), request);
        true
    }

    /// Removes an agent. A new registration of its name counts its requests from 1.
    fn forget(&mut self, name: &Arc<str>) {
        self.requests.remove(name);
        let away = self.away.as_mut().map(|away| &mut away.token);
        for token in self.token.as_mut().into_iter().chain(away) {
            token.last.remove(name);
            token.queue.retain(|queued| queued != name);
        }
    }

    /// Passes the token on, unless this agent has entered.
    fn pass(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if self.own.as_ref().is_some_and(|own| own.entered) {
            return;
        }
        let Some(token) = &mut self.token else {
            return;
        };
        let owner = context.owner.filter(|owner| **owner != self.me);
        if let (true, Some(owner)) = (self.extended, owner) {
            let to = owner.clone();
            let conversation = self.leaving.clone();
            self.send_token(context, to, conversation, out);
            return;
        }
        for (name, request) in &self.requests {
            let last = token.last.get(name).copied().unwrap_or(0);
            if request.number > last && !token.queue.contains(name) {
                token.queue.push_back(name.clone());
            }
        }
        let me = self.me.shared_name();
        let waits = self.own.is_some();
        token.queue.retain(|name| name != me || waits);
        if waits && !token.queue.contains(me) {
            token.queue.push_back(me.clone());
        }
        // An agent that has no request here was lost, or has sent a request that has not arrived.
        let known = |name: &Arc<str>| {
            let request = self.requests.get(name);
            request.filter(|request| context.members.contains_key(&request.peer))
        };
        let next = match context.gate {
            // The first agent waits for the end of the live grant, and so do those behind it.
            OwnerGate::Closed => {
                let first = token
                    .queue
                    .iter()
                    .position(|name| name == me || known(name).is_some());
                first.filter(|first| token.queue.get(*first) == Some(me))
            }
            gate => token.queue.iter().position(|name| {
                let may = |peer| gate.lets_pass(context.dialect(peer));
                name == me || known(name).is_some_and(|request| may(&request.peer))
            }),
        };
        let Some(name) = next.and_then(|next| token.queue.remove(next)) else {
            return;
        };
        if name == *me {
            token.last.insert(name, self.number);
            self.enter(out);
        } else if let Some(request) = self.requests.get(&name) {
            let to = request.peer.clone();
            self.send_token(context, to, None, out);
        }
    }

    /// Handles a repeated request at the owner: a token that was sent for it was lost. If the repetition
    /// was late, the agent discards the older token and returns the newer one.
    fn serve_again(
        &mut self,
        context: &Context<'_>,
        from: &LockPeer,
        number: u64,
        out: &mut Vec<Step>,
    ) {
        let name = from.shared_name();
        let latest = self.requests.get(name);
        if !latest.is_some_and(|latest| latest.number == number && latest.peer == *from) {
            return;
        }
        match &mut self.away {
            Some(away) if away.to == *from => {
                // A request that crossed the token does not show a loss.
                let sent = away.until.saturating_sub(context.lease);
                let crossed = context.now < sent.saturating_add(context.retry);
                if !crossed && context.gate.lets_pass(context.dialect(from)) {
                    self.generation = self.generation.saturating_add(1);
                    self.token = Some(away.token.clone());
                    self.send_token(context, from.clone(), None, out);
                }
            }
            away => {
                let away = away.as_mut().map(|away| &mut away.token);
                for token in self.token.as_mut().into_iter().chain(away) {
                    if let Some(last) = token.last.get_mut(name) {
                        *last = number.saturating_sub(1).min(*last);
                    }
                }
                self.pass(context, out);
            }
        }
    }

    /// Sends the token. The conversation is that of the receiver's request, unless another is given.
    fn send_token(
        &mut self,
        context: &Context<'_>,
        to: LockPeer,
        conversation: Option<Conversation>,
        out: &mut Vec<Step>,
    ) {
        let Some(mut token) = self.token.take() else {
            return;
        };
        token.generation = Some(self.generation);
        let legacy = |peer: &LockPeer| context.dialect(peer) == LockDialect::Legacy;
        let archive = context.members.keys().any(legacy) || legacy(&to);
        token.archive = archive.then(|| self.archive.unwrap_or(Token::ARCHIVE));
        let request = self.requests.get(to.shared_name());
        if self.extended && self.is_owner(context) {
            self.away = Some(Away {
                to: to.clone(),
                number: request.map_or(0, |request| request.number),
                token: token.clone(),
                until: context.now.saturating_add(context.lease),
                over: false,
                gone: false,
            });
        }
        let of_request = || request.map(|request| request.conversation.clone());
        let conversation = conversation
            .or_else(of_request)
            .unwrap_or_else(|| Conversation::new(self.me.shared_name().clone(), 0));
        out.push(Step::Send {
            to,
            conversation,
            act: Act::Token(token),
        });
    }

    /// Replaces the token that another agent has, if it may be replaced.
    fn replace(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if context.gate == OwnerGate::Closed || !self.away.as_ref().is_some_and(|away| away.over) {
            return;
        }
        if let Some(away) = self.away.take() {
            // The agent had its turn. If it had not, it asks again.
            let token = self.after_turn(away, None);
            self.renew(context, token, out);
        }
    }

    /// Returns the token after the turn of the agent that had it, with the number that the agent has put into it.
    fn after_turn(&self, away: Away, number: Option<u64>) -> Token {
        let mut token = away.token;
        let name = away.to.shared_name();
        let latest = self.requests.get(name);
        let is_present = !away.gone && latest.is_none_or(|latest| latest.peer == away.to);
        // Another registration of the name counts its requests from 1.
        if is_present {
            let number = number.unwrap_or(0).min(MAX_NUMBER).max(away.number);
            token.last.insert(name.clone(), number);
        }
        token
    }

    fn renew(&mut self, context: &Context<'_>, token: Token, out: &mut Vec<Step>) {
        self.generation = self.generation.saturating_add(1);
        self.token = Some(token);
        self.pass(context, out);
    }

    fn take(
        &mut self,
        context: &Context<'_>,
        from: &LockPeer,
        conversation: &Conversation,
        token: &Token,
        out: &mut Vec<Step>,
    ) {
        if token.archive.is_some() {
            self.archive = token.archive;
        }
        let generation = token.generation.unwrap_or(self.generation);
        let newer = generation > self.generation;
        if self.extended {
            // The token goes between the owner and one agent only.
            let expected = match self.is_owner(context) {
                true => self.away.as_ref().is_some_and(|away| away.to == *from) && !newer,
                false => context.owner == Some(from),
            };
            if !expected {
                return;
            }
        }
        if generation < self.generation || (self.token.is_some() && !newer) {
            return;
        }
        self.generation = generation;
        let mut token = token.clone();
        if let Some(away) = self.away.take() {
            // An agent of distributed_locking that does not want the token leaves its number as it was.
            let number = token.last.get(away.to.shared_name()).copied();
            if fault!(context.fault, TakeWhole) {
                let number = number.unwrap_or(0).max(away.number);
                token.last.insert(away.to.shared_name().clone(), number);
            } else {
                token = self.after_turn(away, number);
            }
        }
        if let Some(served) = token.last.get(self.me.shared_name()) {
            // A registration before this one used higher numbers.
            self.number = self.number.max((*served).min(MAX_NUMBER));
        }
        self.pending = false;
        token
            .last
            .insert(self.me.shared_name().clone(), self.number);
        let returned = self.extended && self.is_owner(context);
        if !returned {
            let me = self.me.shared_name();
            token.queue.retain(|name| name != me);
        }
        self.token = Some(token);
        let owner = context.owner.filter(|owner| **owner != self.me);
        let of_legacy = owner.is_some_and(|owner| context.dialect(owner) == LockDialect::Legacy);
        self.arrived = (self.extended && of_legacy).then(|| conversation.clone());
        if !returned {
            self.enter(out);
        }
        // The owner waits for its turn, since the token returns to it after each.
        self.leaving = (!returned).then(|| conversation.clone());
        self.pass(context, out);
        self.leaving = None;
    }
}

impl Token {
    /// Version of the archives that current versions of Boost write.
    const ARCHIVE: u16 = 18;
}

impl MutualExclusion for SuzukiKasami {
    fn new(kind: Algorithm, me: LockPeer, owns: bool) -> Self {
        Self {
            me,
            extended: kind.is_extended(),
            requests: BTreeMap::new(),
            number: 0,
            pending: false,
            own: None,
            leaving: None,
            token: owns.then(Token::default),
            arrived: None,
            generation: 0,
            archive: None,
            away: None,
        }
    }

    fn request(&mut self, context: &Context<'_>, conversation: &Conversation, out: &mut Vec<Step>) {
        let own = OwnRequest {
            conversation: conversation.clone(),
            entered: false,
        };
        if self.token.is_some() {
            self.own = Some(own);
            self.enter(out);
            return;
        }
        if !self.pending {
            self.pending = true;
            self.number = (self.number + 1).min(MAX_NUMBER);
        }
        out.extend(context.members.keys().map(|peer| self.ask(&own, peer)));
        self.own = Some(own);
    }

    fn leave(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if let Some(own) = self.own.take() {
            let arrived = self.arrived.take();
            self.leaving = Some(arrived.unwrap_or(own.conversation));
            self.pass(context, out);
            self.leaving = None;
        }
    }

    fn handle(
        &mut self,
        context: &Context<'_>,
        from: &LockPeer,
        conversation: &Conversation,
        act: &Act,
        out: &mut Vec<Step>,
    ) {
        match act {
            Act::RequestToken { number } => {
                if self.record(from, *number, conversation) {
                    self.pass(context, out);
                } else if self.extended && self.is_owner(context) {
                    self.serve_again(context, from, *number, out);
                }
            }
            Act::Token(token) => self.take(context, from, conversation, token, out),
            _ => {}
        }
    }

    fn gate_changed(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if context.gate != OwnerGate::Closed {
            self.replace(context, out);
            self.pass(context, out);
        }
    }

    fn grant_ended(&mut self, holder: &LockPeer) {
        if let Some(away) = &mut self.away
            && away.to == *holder
        {
            away.over = true;
        }
    }

    fn own(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if self.token.is_none() && self.away.is_none() {
            self.renew(context, Token::default(), out);
        }
    }

    fn owner_changed(&mut self) {
        if self.extended {
            // Generations and the token are those of the owner.
            self.generation = 0;
            self.token = None;
        }
    }

    fn joined(&mut self, _: &Context<'_>, peer: &LockPeer, out: &mut Vec<Step>) {
        if let Some(own) = &self.own
            && !own.entered
        {
            out.push(self.ask(own, peer));
        }
    }

    fn lost(&mut self, context: &Context<'_>, peer: &LockPeer, gone: bool, out: &mut Vec<Step>) {
        let name = peer.shared_name();
        let known = self.requests.get(name);
        if gone && known.is_some_and(|known| known.peer == *peer) {
            self.forget(&name.clone());
        }
        if let Some(away) = &mut self.away
            && away.to == *peer
        {
            away.over = true;
            away.gone |= gone;
            self.replace(context, out);
        }
        self.pass(context, out);
    }

    fn repeat(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if let Some(own) = &self.own
            && self.extended
            && !own.entered
        {
            let owner = context.owner.filter(|owner| **owner != self.me);
            let owner = owner.filter(|owner| context.accepts_repetition(owner));
            out.extend(owner.map(|owner| self.ask(own, owner)));
        }
    }

    fn handle_timeout(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if let Some(away) = &mut self.away {
            away.over |= away.until <= context.now;
        }
        self.replace(context, out);
    }

    fn poll_timeout(&self) -> Option<Millis> {
        let away = self.away.as_ref()?;
        (!away.over).then_some(away.until)
    }

    fn has_entered(&self) -> bool {
        self.own.as_ref().is_some_and(|own| own.entered)
    }

    fn awaited(&self) -> BTreeSet<LockPeer> {
        match &self.away {
            Some(away) if self.extended && !away.over => BTreeSet::from([away.to.clone()]),
            _ => BTreeSet::new(),
        }
    }

    fn ahead(&self) -> Option<usize> {
        let waiting = self.own.as_ref().is_some_and(|own| !own.entered);
        Some(usize::from(waiting) + self.requests.len().saturating_sub(1))
    }

    #[cfg(test)]
    fn rebase(&mut self, by: Millis) {
        if let Some(away) = &mut self.away {
            away.until = away.until.saturating_sub(by);
        }
    }
}
