//! Coalitions with a leader: the founder and the members.

use fipa::blocking::Wait;
use fipa::coalitions::{CoalitionOptions, LedCoalition, Membership};
use fipa::{Message, MessageBuilder};
use fipa_bindings::{Failure, FailureKind, OrFail, coalition};
use futures_util::stream::unfold;

use crate::agent::OwnAgent;
use crate::failure::{FipaResult, call};
use crate::item::{Event, FipaEvent, OperationHandle};
use crate::locks::{FipaOwnOptions, own_options};
use crate::raw::{FipaText, Place, texts};
use crate::table::{self, FipaHandle, Object};

/// A coalition that an agent has founded.
struct FoundedCoalition(LedCoalition);

/// The part of an agent in a coalition.
struct CoalitionMember {
    membership: Membership,
    operation: OperationHandle,
}

impl Object for FoundedCoalition {}

impl Object for CoalitionMember {
    fn close(&self) -> Result<(), Failure> {
        self.operation.close()
    }

    fn guard(&self, message: MessageBuilder) -> Option<Result<MessageBuilder, Failure>> {
        let guarded = self.membership.guard(message);
        Some(guarded.map_err(|error| Failure::new(FailureKind::Lost, error.to_string())))
    }

    fn check(&self, message: &Message) -> Option<Result<(), Failure>> {
        Some(self.membership.check(message).map(drop).or_fail())
    }
}

/// Founds a coalition: one name for these agents. Letters to it go to the leader, the member that holds the lock
/// `coalition/NAME`, which this agent owns. `options` may be NULL, and is as for `fipa_own`. `fipa_close` dissolves it.
///
/// # Safety
/// The texts must be readable. `options` is NULL or as its documentation says. `coalition` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_found_coalition(
    agent: FipaHandle,
    name: FipaText,
    members: *const FipaText,
    member_count: usize,
    options: *const FipaOwnOptions,
    coalition: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let coalition = unsafe { Place::of(coalition, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let name = unsafe { name.required("the name") }?;
        // SAFETY: The caller promises it.
        let members = unsafe { texts(members, member_count, "a member") }?;
        let options = CoalitionOptions {
            // SAFETY: The caller promises it.
            lock: unsafe { own_options(options) }?,
            ..CoalitionOptions::default()
        };
        let founded = own.agent.found_coalition(name, members, options).wait();
        let founded =
            founded.map_err(|error| Failure::new(FailureKind::Failed, error.to_string()))?;
        Ok(table::give(coalition, FoundedCoalition(founded)))
    })
}

/// Replaces the members of a coalition that an agent of this process has founded.
///
/// # Safety
/// The texts must be readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_change_coalition(
    coalition: FipaHandle,
    members: *const FipaText,
    member_count: usize,
) -> FipaResult {
    call(|| {
        let founded = table::get::<FoundedCoalition>(coalition)?;
        // SAFETY: The caller promises it.
        let members = unsafe { texts(members, member_count, "a member") }?;
        let changed = founded.0.change(members).wait();
        changed.map_err(|error| Failure::new(FailureKind::Failed, error.to_string()))?;
        Ok(FipaResult::Ok)
    })
}

/// Takes part in a coalition, which may be founded later: the agent leads when it is its turn. Each change is an item
/// of the kind `FIPA_EVENT_CHANGE`, a JSON text with `members`, `leader` (null if there is none at present) and
/// `leads`. While the agent leads, `lock` of a message may be this handle, and the message carries the fence of the
/// leader; `fipa_check_fence` with this handle checks the commands of a leader. `fipa_close` ends the membership.
///
/// # Safety
/// The text must be readable. `member` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_join_coalition(
    agent: FipaHandle,
    name: FipaText,
    tag: u64,
    member: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let member = unsafe { Place::of(member, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let name = unsafe { name.required("the name") }?;
        let membership = own.agent.join_coalition(name).or_fail()?;
        let changes = unfold(membership.changes(), |mut changes| async {
            let state = coalition(&changes.next().await?);
            let event = Event::json(FipaEvent::Change, &state);
            Some((event, changes))
        });
        let joined = CoalitionMember {
            membership,
            operation: OperationHandle::of(own.items.follow(tag, changes)),
        };
        Ok(table::give(member, joined))
    })
}

/// Gives up the lead of a coalition, if the agent leads. The other members are asked first to lead again.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_resign(member: FipaHandle) -> FipaResult {
    call(|| {
        table::get::<CoalitionMember>(member)?.membership.resign();
        Ok(FipaResult::Ok)
    })
}
