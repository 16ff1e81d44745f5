//! Fences that this agent or a device of it has seen, and the reports of them to their owners.

use super::{Actions, Locks};
use crate::{Act, Fence, LockDialect, LockPeer, Millis, MutualExclusion, Resource};

/// Maximum number of owners of a resource whose fences are kept.
const MAX_SEEN: usize = 16;

impl<A: MutualExclusion> Locks<A> {
    /// Records a fence that a device of this agent has admitted. With `tell`, tells its owner: the device
    /// refuses a grant of it for this fence ([`NotAdmitted::OtherRun`](crate::NotAdmitted::OtherRun)).
    ///
    /// An owner that starts asks for the highest recorded fence, in order to grant higher ones.
    pub fn saw(&mut self, now: Millis, fence: &Fence, tell: bool, out: &mut Actions) {
        let Ok(resource) = Resource::new(fence.resource()) else {
            return;
        };
        self.entry(&resource);
        self.remember(fence);
        if tell {
            self.tell(now, fence, &resource, out);
        }
        self.settle(now, out);
    }

    /// Keeps a fence if it is the highest one of its owner. Of two runs with the same epoch, it keeps the
    /// first one, as a device does.
    pub(super) fn remember(&mut self, fence: &Fence) {
        let entry = Resource::new(fence.resource())
            .ok()
            .and_then(|resource| self.resources.get_mut(&resource));
        let Some(entry) = entry else {
            return;
        };
        let count = entry.seen.len();
        match entry.seen.get_mut(fence.owner()) {
            Some(seen) if seen.run() != fence.run() && fence.epoch() <= seen.epoch() => {}
            Some(seen) if fence.position() > seen.position() => *seen = fence.clone(),
            None if count < MAX_SEEN => {
                drop(entry.seen.insert(fence.owner().into(), fence.clone()))
            }
            Some(_) | None => {}
        }
    }

    /// Tells an owner the highest fence of it that was seen here.
    pub(super) fn tell_seen(
        &mut self,
        now: Millis,
        owner: &LockPeer,
        resource: &Resource,
        out: &mut Actions,
    ) {
        let entry = self.resources.get(resource);
        let seen = entry.and_then(|entry| entry.seen.get(owner.shared_name()));
        if let Some(fence) = seen.cloned() {
            self.report_to(now, owner.clone(), &fence, resource, out);
        }
    }

    /// Tells a fence to its owner.
    pub(super) fn tell(
        &mut self,
        now: Millis,
        fence: &Fence,
        resource: &Resource,
        out: &mut Actions,
    ) {
        if fence.owner() == self.me.name() {
            self.at_owner(resource, out, |core, _| core.seen(now, fence));
        } else if let Some(owner) = self.owner_of(resource).cloned()
            && owner.name() == fence.owner()
        {
            self.report_to(now, owner, fence, resource, out);
        }
    }

    fn report_to(
        &mut self,
        now: Millis,
        owner: LockPeer,
        fence: &Fence,
        resource: &Resource,
        out: &mut Actions,
    ) {
        let dialect = self.members.get(&owner).map(|member| member.dialect);
        if dialect == Some(LockDialect::Own) {
            let act = Act::Seen {
                fence: fence.clone(),
            };
            let conversation = self.side_conversation("fence", now);
            self.send(owner, resource, conversation, act, out);
        }
    }
}
