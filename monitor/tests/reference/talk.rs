//! One state machine of the reference: the messages so far, and the effect of the next one.

use std::collections::HashMap;

use fipa_monitor::{After, Cancel, Machine, Scope, State, Transition};
use regex::Regex;

use super::Words;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Spot {
    At(String),
    /// The state before.
    NotUnderstood(String),
    Cancelling(String),
    /// The state behind a message that may have crossed the cancel: its answer may still come.
    Cancelled(Option<String>),
    Undelivered(Box<Spot>),
    /// The monitored agent does not know the state.
    Elsewhere,
}

#[derive(Debug, Clone)]
pub(super) struct Talk {
    pub(super) spot: Spot,
    pub(super) previous: Spot,
    pub(super) said: Vec<SentMessage>,
    pub(super) due: Option<u64>,
    /// Whether a failure that may have crossed a cancel was taken for the answer to it. After a
    /// not-understood: whether a cancel has no answer yet.
    pub(super) echo: bool,
    /// The talk before its last message, until that one fails.
    earlier: Option<Box<Talk>>,
    /// After a failure: the talk if the message has not arrived, and if it has.
    worlds: Option<Box<[Talk; 2]>>,
    /// Number of reported failures.
    pub(super) failures: usize,
}

#[derive(Debug, Clone)]
pub(super) struct SentMessage {
    pub(super) by_initiator: bool,
    pub(super) act: &'static str,
    pub(super) reply_with: Option<String>,
    /// A cancel that began cancelling.
    pub(super) cancels: bool,
    /// Sent before the cancel of the other side was received.
    pub(super) crossed: bool,
    /// The answer to a cancel.
    pub(super) answers_cancel: bool,
}

pub(super) struct Step {
    pub(super) spot: Spot,
    pub(super) roles: Option<(String, String)>,
    pub(super) crossed: bool,
    /// Answers a message before the last one.
    pub(super) void: bool,
    /// The transition has a rule about all participants.
    pub(super) guard: (Option<u16>, bool),
    /// The state that allows the message, after an undelivered one.
    pub(super) before: Option<Spot>,
    pub(super) echo: bool,
    /// Answers a cancel, and is no step of the protocol itself.
    pub(super) answers_cancel: bool,
    /// The number of the talk in [`Talk::worlds`] that the message fits.
    world: Option<usize>,
}

pub(super) fn to(spot: Spot) -> Step {
    Step {
        spot,
        roles: None,
        crossed: false,
        void: false,
        guard: (None, false),
        before: None,
        echo: false,
        answers_cancel: false,
        world: None,
    }
}

pub(crate) fn matches(pattern: &str, text: &str) -> bool {
    thread_local! {
        static KNOWN: std::cell::RefCell<HashMap<String, Regex>> = HashMap::new().into();
    }
    KNOWN.with_borrow_mut(|known| {
        let regex = known
            .entry(pattern.to_owned())
            .or_insert_with(|| Regex::new(&format!("^(?:{pattern})$")).expect("the file was read"));
        regex.is_match(text)
    })
}

pub(super) fn state<'m>(machine: &'m Machine, id: &str) -> &'m State {
    let found = machine.states().iter().find(|state| state.id() == id);
    found.expect("a state of the machine")
}

/// Whether another agent sends this to the initiator in this transition.
pub(super) fn is_answered(machine: &Machine, step: &Transition, act: &str) -> bool {
    let initiator = machine.initiator();
    let mut others = machine.roles().iter().filter(|role| *role != initiator);
    matches(step.performative(), act)
        && matches(step.to(), initiator)
        && others.any(|role| matches(step.from(), role))
}

/// Returns the transitions of a state, and those of the states that its optional transitions lead to.
pub(crate) fn options<'m>(machine: &'m Machine, id: &str) -> Vec<&'m Transition> {
    let mut all = Vec::new();
    for transition in state(machine, id).transitions() {
        all.push(transition);
        if transition.is_optional() {
            all.extend(options(machine, machine.target(transition)));
        }
    }
    all
}

pub(super) fn is_over(machine: &Machine, id: &str) -> bool {
    let here = state(machine, id);
    here.is_final() && here.transitions().is_empty() && here.subprotocols().is_empty()
}

impl Talk {
    pub(super) fn new(machine: &Machine) -> Self {
        let spot = Spot::At(machine.initial().id().to_owned());
        Self {
            previous: spot.clone(),
            spot,
            said: Vec::new(),
            due: None,
            echo: false,
            earlier: None,
            worlds: None,
            failures: 0,
        }
    }

    /// Whether the initiator sent the last message that counts. Without a message, it is the other side.
    pub(super) fn last_by_initiator(&self) -> bool {
        let last = self.said.iter().rev().find(|said| !said.crossed);
        last.is_some_and(|said| said.by_initiator)
    }

    pub(super) fn last_of(&self, initiator: bool) -> Option<&SentMessage> {
        let mut said = self.said.iter().rev();
        said.find(|said| said.by_initiator == initiator && !said.cancels && !said.answers_cancel)
    }

    /// Whether one of the questions before the last message may have this `reply-with`: the last six are
    /// known.
    pub(super) fn asked_earlier(&self, initiator: bool, text: &str) -> bool {
        let said = self.said.iter().rev();
        let own = said
            .filter(|said| said.by_initiator == initiator && !said.cancels && !said.answers_cancel);
        let mut asked = own.skip(1).filter_map(|said| said.reply_with.as_deref());
        let known: Vec<&str> = asked.by_ref().take(6).collect();
        known.len() == 6 || known.contains(&text)
    }

    /// The `reply-with` of the question before the last message.
    fn asked_before(&self, initiator: bool) -> Option<&str> {
        let said = self.said.iter().rev();
        let own = said
            .filter(|said| said.by_initiator == initiator && !said.cancels && !said.answers_cancel);
        own.skip(1).find_map(|said| said.reply_with.as_deref())
    }

    pub(super) fn cancel(&self) -> Option<&SentMessage> {
        self.said.iter().rev().find(|said| said.cancels)
    }

    pub(super) fn is_repeated(&self, words: &Words, initiator: bool) -> bool {
        let last = self.last_of(initiator);
        words.reply_with.is_some()
            && last.is_some_and(|said| said.act == words.act && said.reply_with == words.reply_with)
    }

    /// Creates the state of an agent that joined with an answer: known if only one state can follow.
    pub(super) fn joined(machine: &Machine, words: &Words, elsewhere: bool) -> Self {
        let mut in_time = vec![machine.initial().id()];
        for at in 0.. {
            let Some(id) = in_time.get(at) else { break };
            for step in state(machine, id).transitions() {
                if !in_time.contains(&machine.target(step)) {
                    in_time.push(machine.target(step));
                }
            }
        }
        let all = in_time.iter().flat_map(|id| options(machine, id));
        let mut targets: Vec<&str> = all
            .filter(|step| is_answered(machine, step, words.act))
            .map(|step| machine.target(step))
            .collect();
        targets.sort_unstable();
        targets.dedup();
        let spot = match targets[..] {
            _ if elsewhere
                && machine.cancel() != Cancel::Nobody
                && ["inform", "failure"].contains(&words.act) =>
            {
                Spot::Elsewhere
            }
            [only] if machine.scope() == Scope::Participant => Spot::At(only.to_owned()),
            _ => Spot::Elsewhere,
        };
        Self {
            previous: spot.clone(),
            spot,
            said: vec![SentMessage {
                by_initiator: false,
                act: words.act,
                reply_with: words.reply_with.clone(),
                cancels: false,
                crossed: false,
                answers_cancel: false,
            }],
            due: None,
            echo: false,
            earlier: None,
            worlds: None,
            failures: 0,
        }
    }

    pub(super) fn is_unknown(&self) -> bool {
        match &self.spot {
            Spot::Elsewhere => true,
            Spot::Undelivered(before) => **before == Spot::Elsewhere,
            _ => false,
        }
    }

    pub(super) fn name(&self) -> String {
        match &self.spot {
            Spot::At(id) => id.clone(),
            Spot::NotUnderstood(_) => "not-understood".into(),
            Spot::Cancelling(_) => "cancelling".into(),
            Spot::Cancelled(_) => "cancelled".into(),
            Spot::Undelivered(_) => "undelivered".into(),
            Spot::Elsewhere => "elsewhere".into(),
        }
    }

    pub(super) fn has_ended(&self, machine: &Machine) -> bool {
        match &self.spot {
            Spot::At(id) => state(machine, id).is_final(),
            Spot::Cancelling(_) | Spot::Elsewhere => false,
            _ => true,
        }
    }

    pub(super) fn expire(&mut self, machine: &Machine, now: u64) {
        let Spot::At(id) = &self.spot else { return };
        let timeout = state(machine, id).timeout();
        if let (Some(timeout), Some(due)) = (timeout, self.due)
            && due < now
        {
            self.previous = self.spot.clone();
            self.spot = Spot::At(machine.timeout_target(timeout).to_owned());
        }
    }
}

/// One message with respect to one talk: the possible roles, and whether the agents are known.
pub(super) struct View<'a> {
    pub(super) words: &'a Words,
    pub(super) by_initiator: bool,
    pub(super) from: Vec<String>,
    pub(super) to: Vec<String>,
    pub(super) known: bool,
    pub(super) compares: bool,
    pub(super) own: bool,
}

impl View<'_> {
    pub(super) fn fits(&self, transition: &Transition) -> bool {
        self.fits_ways(transition, &self.from, &self.to)
    }

    pub(super) fn fits_ways(
        &self,
        transition: &Transition,
        from: &[String],
        to: &[String],
    ) -> bool {
        let has = |pattern: &str, roles: &[String]| {
            pattern == ".*" || roles.iter().any(|role| matches(pattern, role))
        };
        matches(transition.performative(), self.words.act)
            && has(transition.from(), from)
            && has(transition.to(), to)
    }
}

pub(super) fn judge(machine: &Machine, talk: &Talk, view: &View<'_>) -> Result<Step, &'static str> {
    let act = view.words.act;
    let answers_cancel = ["inform", "failure", "not-understood"].contains(&act);
    let repeated = talk.is_repeated(view.words, view.by_initiator);
    match &talk.spot {
        Spot::At(id) => {
            if talk.echo
                && answers_cancel
                && let Some(cancel) = talk.cancel()
                && cancel.by_initiator != view.by_initiator
                && cancel.reply_with.is_some()
                && cancel.reply_with == view.words.in_reply_to
            {
                let next = to(match act {
                    "inform" => Spot::Cancelled(None),
                    "failure" => Spot::At(id.clone()),
                    _ => Spot::NotUnderstood(id.clone()),
                });
                return Ok(Step {
                    answers_cancel: true,
                    ..next
                });
            }
            judge_at(machine, talk, id, view)
        }
        Spot::Undelivered(before) => {
            let at = |spot: &Spot| match spot {
                Spot::At(id) => judge_at(machine, talk, id, view),
                // Only the protocol's own states.
                _ => Err("unexpected"),
            };
            let in_spot = |spot: &Spot| {
                let step = at(spot)?;
                Ok(Step {
                    before: Some(spot.clone()),
                    ..step
                })
            };
            let in_world = |world: usize| {
                let talks = talk.worlds.as_deref().expect("there are two");
                let step = judge(machine, &talks[world], view)?;
                Ok(Step {
                    world: Some(world),
                    ..step
                })
            };
            let over = matches!(&**before, Spot::At(id) if is_over(machine, id));
            let (first, second) = match act == "cancel" && over {
                _ if talk.worlds.is_some() => (in_world(0), in_world(1)),
                true => (in_spot(&talk.previous), in_spot(before)),
                false => (in_spot(before), in_spot(&talk.previous)),
            };
            // A void message counts in the other state, if it is not void there. If it is, it does not show
            // whether the failed message has arrived.
            match (first, second) {
                (Ok(void), Ok(other)) if void.void && !other.void => Ok(other),
                (Ok(void), Ok(_)) if void.void => Ok(Step {
                    spot: talk.spot.clone(),
                    world: None,
                    ..void
                }),
                (Err(_), Ok(other)) => Ok(other),
                (taken, _) => taken,
            }
        }
        Spot::Elsewhere => Err("unexpected"),
        Spot::NotUnderstood(back) => {
            let is_later = view.own || talk.last_by_initiator() == view.by_initiator;
            let on_its_way = match is_later {
                true => Err("ended"),
                false => judge_at(machine, talk, back, view),
            };
            if let Some(cancel) = talk.cancel().filter(|_| talk.echo)
                && cancel.by_initiator != view.by_initiator
                && answers_cancel
            {
                let both = cancel.reply_with.is_some() && view.words.in_reply_to.is_some();
                if !both || cancel.reply_with == view.words.in_reply_to {
                    return Ok(Step {
                        echo: !both && on_its_way.is_ok(),
                        answers_cancel: true,
                        ..to(talk.spot.clone())
                    });
                }
            }
            if let Ok(step) = on_its_way {
                let cancels = matches!(step.spot, Spot::Cancelling(_));
                let back = match step.spot {
                    Spot::At(id) => id,
                    _ => back.clone(),
                };
                return Ok(Step {
                    void: true,
                    echo: talk.echo || cancels,
                    ..to(Spot::NotUnderstood(back))
                });
            }
            Err(if repeated { "repeated" } else { "ended" })
        }
        Spot::Cancelled(back) => {
            let wrong = Err(if repeated { "repeated" } else { "ended" });
            let cancel = talk.cancel().expect("a cancel was sent");
            let asked = talk.last_of(!view.by_initiator);
            let answers_protocol = view.words.in_reply_to.is_some()
                && asked.is_some_and(|asked| asked.reply_with == view.words.in_reply_to);
            if act == "not-understood"
                && answers_protocol
                && view.by_initiator == cancel.by_initiator
                && view.by_initiator != talk.last_by_initiator()
                && !view.own
            {
                return Ok(Step {
                    void: true,
                    echo: talk.echo,
                    ..to(talk.spot.clone())
                });
            }
            let Some(back) = back else { return wrong };
            if view.by_initiator == cancel.by_initiator {
                return wrong;
            }
            let both = cancel.reply_with.is_some() && view.words.in_reply_to.is_some();
            let answers = answers_cancel && (!both || cancel.reply_with == view.words.in_reply_to);
            let on_its_way = judge_at(machine, talk, back, view);
            if act == "failure" && answers {
                return Ok(Step {
                    echo: !both && on_its_way.is_ok(),
                    answers_cancel: true,
                    ..to(Spot::At(back.clone()))
                });
            }
            if let Ok(step) = on_its_way
                && !(both && answers)
            {
                return Ok(to(match step.spot {
                    Spot::At(id) => Spot::Cancelled(Some(id)),
                    Spot::NotUnderstood(back) => Spot::NotUnderstood(back),
                    _ => Spot::Cancelled(Some(back.clone())),
                }));
            }
            match answers {
                true => Ok(Step {
                    answers_cancel: true,
                    ..to(Spot::Cancelled(None))
                }),
                false => wrong,
            }
        }
        Spot::Cancelling(back) => {
            let cancel = talk.cancel().expect("a cancel was sent");
            if machine.scope() == Scope::Participant && view.by_initiator == cancel.by_initiator {
                return match act {
                    "not-understood" => Ok(Step {
                        echo: true,
                        ..to(Spot::NotUnderstood(back.clone()))
                    }),
                    _ if repeated => Err("repeated"),
                    _ => Err("unexpected"),
                };
            }
            let both = cancel.reply_with.is_some() && view.words.in_reply_to.is_some();
            let on_its_way = judge_at(machine, talk, back, view);
            if answers_cancel && (!both || cancel.reply_with == view.words.in_reply_to) {
                let echo = act != "inform" && !both && on_its_way.is_ok();
                let next = to(match act {
                    "inform" => Spot::Cancelled(match on_its_way {
                        Ok(Step {
                            spot: Spot::At(id), ..
                        }) if !both => Some(id),
                        _ => None,
                    }),
                    "failure" => Spot::At(back.clone()),
                    _ => Spot::NotUnderstood(back.clone()),
                });
                return Ok(Step {
                    echo,
                    answers_cancel: true,
                    ..next
                });
            }
            on_its_way.map(|step| match step.spot {
                Spot::At(id) | Spot::Cancelling(id) => Step {
                    spot: Spot::Cancelling(id),
                    crossed: true,
                    roles: step.roles,
                    void: step.void,
                    guard: (None, false),
                    before: None,
                    echo: false,
                    world: None,
                    answers_cancel: false,
                },
                // During a cancel, a failure counts as a crossing message too.
                Spot::Undelivered(_) => Step {
                    crossed: true,
                    ..to(talk.spot.clone())
                },
                // The answer to the cancel follows.
                Spot::NotUnderstood(back) => Step {
                    echo: true,
                    ..to(Spot::NotUnderstood(back))
                },
                other => to(other),
            })
        }
    }
}

pub(super) fn judge_at(
    machine: &Machine,
    talk: &Talk,
    id: &str,
    view: &View<'_>,
) -> Result<Step, &'static str> {
    let words = view.words;
    let here = state(machine, id);
    let options = options(machine, id);
    if let Some(taken) = options.iter().find(|option| view.fits(option)) {
        let asked = talk
            .last_of(!view.by_initiator)
            .and_then(|said| said.reply_with.as_ref());
        if let (true, Some(asked), Some(answer)) = (view.compares, asked, &words.in_reply_to)
            && asked != answer
            // A message that crossed the not-understood answers the message before it.
            && !(matches!(talk.spot, Spot::NotUnderstood(_))
                && talk.asked_before(!view.by_initiator) == Some(answer))
        {
            return match talk.asked_earlier(!view.by_initiator, answer) {
                true if !view.own => Ok(Step {
                    void: true,
                    ..to(Spot::At(id.to_owned()))
                }),
                _ => Err("wrong-reply"),
            };
        }
        return Ok(Step {
            roles: Some((taken.from().to_owned(), taken.to().to_owned())),
            guard: (taken.at_most(), taken.needs_all()),
            ..to(Spot::At(machine.target(taken).to_owned()))
        });
    }
    for sub in here.subprotocols() {
        let proxied = |role: &str| {
            sub.proxied_to()
                .is_some_and(|pattern| matches(pattern, role))
        };
        if view.from.iter().any(|role| matches(sub.from(), role))
            && view.to.iter().any(|role| proxied(role))
        {
            return Ok(to(Spot::At(id.to_owned())));
        }
    }
    let over = is_over(machine, id);
    let received_last = talk.last_by_initiator() != view.by_initiator;
    let ended_by = talk.last_of(!view.by_initiator);
    let ends_crossed = !view.own
        && !over
        && ended_by.is_some_and(|said| {
            let states = machine.states().iter();
            let mut steps = states.flat_map(|state| super::options(machine, state.id()));
            steps.any(|step| {
                machine.target(step) == id
                    && matches(step.performative(), said.act)
                    && (step.from() == ".*"
                        || view.to.iter().any(|role| matches(step.from(), role)))
            })
        });
    if view.known && talk.said.iter().any(|said| !said.cancels) {
        let may_cancel = match machine.cancel() {
            Cancel::Initiator => view.by_initiator,
            Cancel::Anyone => true,
            _ => false,
        };
        match words.act {
            "not-understood" if !here.is_final() || received_last || ends_crossed => {
                return Ok(to(Spot::NotUnderstood(id.to_owned())));
            }
            "cancel" if may_cancel && (!over || (received_last && !view.own)) => {
                return Ok(to(Spot::Cancelling(id.to_owned())));
            }
            // In the format of fipa_acl. Only that format has one state per conversation here.
            "failure" if machine.scope() == Scope::Conversation && !here.is_final() => {
                return Ok(to(Spot::Undelivered(Box::new(Spot::At(id.to_owned())))));
            }
            _ => {}
        }
    }
    if has_crossed(machine, talk, id, view) {
        return Ok(Step {
            void: true,
            ..to(Spot::At(id.to_owned()))
        });
    }
    Err(if talk.is_repeated(words, view.by_initiator) {
        "repeated"
    } else if over {
        "ended"
    } else if options
        .iter()
        .any(|option| view.fits_ways(option, &view.to, &view.from))
    {
        "wrong-sender"
    } else if comes_later(machine, id, view, &mut Vec::new()) {
        "out-of-order"
    } else {
        "unexpected"
    })
}

/// Whether the message was sent before its sender had received the last ones.
fn has_crossed(machine: &Machine, talk: &Talk, now: &str, view: &View<'_>) -> bool {
    if view.own || !view.compares {
        return false;
    }
    let fits = |id: &str| options(machine, id).iter().any(|step| view.fits(step));
    let other = !view.by_initiator;
    match &view.words.in_reply_to {
        None => {
            let sends = |step: &&Transition| {
                step.from() == ".*" || view.to.iter().any(|role| matches(step.from(), role))
            };
            let led = |id: &str| {
                let mut steps = options(machine, id).into_iter().filter(sends);
                steps.any(|step| machine.target(step) == now)
            };
            talk.last_by_initiator() == other
                && matches!(&talk.previous, Spot::At(id) if fits(id) && led(id))
        }
        Some(answer) => {
            let asked = talk.last_of(other);
            asked.is_none_or(|asked| asked.reply_with.as_ref() != Some(answer))
                && talk.asked_earlier(other, answer)
                && machine.states().iter().any(|state| fits(state.id()))
        }
    }
}

pub(super) fn comes_later(
    machine: &Machine,
    id: &str,
    view: &View<'_>,
    seen: &mut Vec<String>,
) -> bool {
    if seen.iter().any(|other| other == id) {
        return false;
    }
    seen.push(id.to_owned());
    options(machine, id).iter().any(|option| view.fits(option))
        || state(machine, id)
            .transitions()
            .iter()
            .any(|step| comes_later(machine, machine.target(step), view, seen))
}

impl Talk {
    /// Whether the last message may be of this side: it sent the last one, or the last one that crossed no
    /// cancel.
    pub(super) fn may_have_last(&self, by_initiator: bool) -> bool {
        self.last_by_initiator() == by_initiator || self.takes_back(by_initiator)
    }

    fn takes_back(&self, by_initiator: bool) -> bool {
        let earlier = self.earlier.as_deref();
        let last = earlier.and_then(|earlier| self.said.get(earlier.said.len()));
        last.is_some_and(|last| last.by_initiator == by_initiator)
    }

    /// The last message of a side was not delivered.
    pub(super) fn fail(&mut self, by_initiator: bool) {
        self.failures += 1;
        if !matches!(self.spot, Spot::Undelivered(_))
            && self.takes_back(by_initiator)
            && let Some(missing) = self.earlier.take()
        {
            let (missing, arrived) = (*missing, self.clone());
            *self = Self {
                failures: self.failures,
                ..missing.clone()
            };
            // Nothing follows the other messages, if they have arrived.
            if !matches!(arrived.spot, Spot::NotUnderstood(_) | Spot::Cancelled(_)) {
                self.spot = Spot::Undelivered(Box::new(arrived.spot.clone()));
                self.worlds = Some(Box::new([missing, arrived]));
            }
            return;
        }
        self.spot = match self.spot.clone() {
            spot @ (Spot::At(_) | Spot::Elsewhere) => Spot::Undelivered(Box::new(spot)),
            // The cancel was not delivered.
            Spot::Cancelling(back) => Spot::At(back),
            // An ended conversation, or an earlier failure.
            other => other,
        };
    }

    /// Applies a step. Returns whether the talk began with it, and whether it was late.
    pub(super) fn go(
        &mut self,
        machine: &Machine,
        words: &Words,
        by_initiator: bool,
        step: Step,
        now: u64,
    ) -> (bool, bool) {
        let opened = !self.said.iter().any(|said| !said.cancels);
        if let Some((world, talks)) = step
            .world
            .zip(self.worlds.take_if(|_| step.world.is_some()))
        {
            *self = Self {
                failures: self.failures,
                ..talks[world].clone()
            };
        }
        let cancels_late = step.void && words.act == "cancel" && step.echo && !self.echo;
        let echo = std::mem::replace(&mut self.echo, step.echo);
        let late =
            self.due.is_some_and(|due| due < now) && self.last_by_initiator() != by_initiator;
        if step.void {
            self.spot = step.spot;
            if cancels_late {
                self.said.push(SentMessage {
                    by_initiator,
                    act: words.act,
                    reply_with: words.reply_with.clone(),
                    cancels: true,
                    crossed: true,
                    answers_cancel: false,
                });
            }
            return (opened, true);
        }
        if let Spot::Undelivered(_) = &step.spot {
            self.spot = step.spot;
            return (opened, late);
        }
        let cancels =
            matches!(step.spot, Spot::Cancelling(_)) && !matches!(self.spot, Spot::Cancelling(_));
        let earlier = Self {
            earlier: None,
            echo,
            ..self.clone()
        };
        self.earlier = Some(Box::new(earlier));
        self.previous = step.before.clone().unwrap_or_else(|| self.spot.clone());
        self.said.push(SentMessage {
            by_initiator,
            act: words.act,
            reply_with: words.reply_with.clone(),
            cancels,
            crossed: step.crossed,
            answers_cancel: step.answers_cancel,
        });
        self.spot = step.spot;
        self.due = words.reply_by;
        if let Spot::At(id) = &self.spot
            && let Some(timeout) = state(machine, id).timeout()
            && let After::Span(span) = timeout.after()
        {
            self.due = Some(now + u64::try_from(span.as_millis()).expect("a day at most"));
        }
        (opened, late)
    }
}
