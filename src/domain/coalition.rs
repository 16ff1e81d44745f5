//! Coalitions: one name for several agents.

use std::sync::Arc;

use fipa_acl::ErrorChain;
use fipa_sds::{
    Cancellation, DeregisterError, Directory, Members, RegisterError, Registration, Role,
};
use fipa_transport::{Incarnation, log_limit};

use crate::domain::{Domain, background, warn_of_name};
use crate::error::CoalitionError;
use crate::{AgentId, RegisterOptions};

/// One name for several agents on any hosts. If the coalition has a leader, a message to it reaches
/// only the leader. Otherwise it reaches all members except its sender, with one outcome per member.
///
/// Members are listed by name. An agent that moves to another host stays a member, and a member that
/// is not registered fails like an unknown name. A member may be a coalition itself, up to four
/// levels deep.
///
/// This process owns the coalition. Dropping it removes the name from the directory. Methods that change
/// the directory block the thread while another process changes it, up to a minute.
pub struct Coalition {
    domain: Domain,
    registration: Registration,
    members: Members,
    formed: bool,
}

impl Domain {
    /// Forms a coalition of these agents.
    ///
    /// Waits like [`register_with`](Self::register_with). Dropping the future ends the wait, and no
    /// coalition is formed.
    ///
    /// # Errors
    /// If the name is invalid or taken, if the members or the leader are invalid, or if the directory
    /// cannot be written.
    pub async fn form<N: Into<Arc<str>>>(
        &self,
        name: &str,
        members: impl IntoIterator<Item = N>,
        leader: Option<&str>,
        options: RegisterOptions,
    ) -> Result<Coalition, CoalitionError> {
        self.inner.owner.check().map_err(RegisterError::from)?;
        let members = Members::new(members, leader.map(Into::into))?;
        let (domain, name) = (self.clone(), name.to_owned());
        let formed = background::run(&self.inner.service.runtime, move |cancellation| {
            domain.form_unless(&name, members, options, cancellation)
        });
        formed.await.map_err(RegisterError::from)?
    }

    /// Forms a coalition on the calling thread.
    pub(crate) fn form_unless(
        &self,
        name: &str,
        members: Members,
        options: RegisterOptions,
        cancellation: &Cancellation,
    ) -> Result<Coalition, CoalitionError> {
        let registration = registration_of(name, &members, options);
        let host = &self.inner.service.host;
        host.register_unless(registration.clone(), cancellation)?;
        if let Ok(id) = AgentId::new(name) {
            warn_of_name(&id);
        }
        Ok(Coalition {
            domain: self.clone(),
            registration,
            members,
            formed: true,
        })
    }
}

fn registration_of(name: &str, members: &Members, options: RegisterOptions) -> Registration {
    Registration {
        agent_type: options.agent_type,
        description: options.description,
        role: Role::Coalition(members.clone()),
        ..Registration::new(name, Incarnation::random(), Vec::new())
    }
}

impl Coalition {
    /// Returns the name of the coalition.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.registration.name
    }

    /// Returns the members and the leader.
    #[must_use]
    pub fn members(&self) -> &Members {
        &self.members
    }

    /// Replaces the members and the leader.
    ///
    /// # Errors
    /// If the members or the leader are invalid, or if the directory cannot be written. The coalition
    /// is then unchanged.
    pub fn change<N: Into<Arc<str>>>(
        &mut self,
        members: impl IntoIterator<Item = N>,
        leader: Option<&str>,
    ) -> Result<(), CoalitionError> {
        let members = Members::new(members, leader.map(Into::into))?;
        self.replace(members, Vec::new(), &[])
    }

    /// Adds all members of another coalition and removes the name of that coalition, in one atomic
    /// change of the directory. The leader of this coalition stays.
    ///
    /// # Errors
    /// If there are too many members together, or if the directory cannot be written. The error then
    /// contains the other coalition, and both are unchanged.
    pub fn merge(&mut self, mut other: Self) -> Result<(), Box<(CoalitionError, Self)>> {
        let names = self.names_with(&other);
        let members = Members::new(names, self.members.leader().cloned());
        let members = members.map_err(CoalitionError::from);
        match members.and_then(|members| self.absorb(members, &mut other)) {
            Ok(()) => Ok(()),
            Err(error) => Err(Box::new((error, other))),
        }
    }

    /// Returns the members of this coalition and of another one, which may be a member of this one.
    pub(crate) fn names_with(&self, other: &Self) -> Vec<Arc<str>> {
        let names = self.members.names().iter().chain(other.members.names());
        let stays = |name: &&Arc<str>| **name != other.registration.name;
        names.filter(stays).cloned().collect()
    }

    /// Replaces the members and removes the name of another coalition, in one change.
    pub(crate) fn absorb(
        &mut self,
        members: Members,
        other: &mut Self,
    ) -> Result<(), CoalitionError> {
        let leaving = [(&*other.registration.name, other.registration.incarnation)];
        self.replace(members, Vec::new(), &leaving)?;
        other.formed = false;
        Ok(())
    }

    /// Moves these members to a new coalition, in one atomic change of the directory. If the leader is
    /// among them, this coalition has no leader afterwards.
    ///
    /// # Errors
    /// If one of them is not a member, if no member would remain, if the name is invalid or taken, or
    /// if the directory cannot be written. The coalition is then unchanged.
    pub fn split(
        &mut self,
        name: &str,
        members: &[&str],
        leader: Option<&str>,
        options: RegisterOptions,
    ) -> Result<Self, CoalitionError> {
        let staying = self.names_without(members)?;
        let parting = Members::new(members.iter().copied(), leader.map(Into::into))?;
        let leader = self.members.leader().filter(|it| staying.contains(it));
        let staying = Members::new(staying.iter().cloned(), leader.cloned())?;
        self.split_off(name, parting, staying, options)
    }

    /// Returns the members without these.
    pub(crate) fn names_without<N: AsRef<str>>(
        &self,
        parting: &[N],
    ) -> Result<Vec<Arc<str>>, CoalitionError> {
        let names = self.members.names();
        let is_ours = |name: &&N| names.iter().any(|ours| **ours == *name.as_ref());
        if let Some(foreign) = parting.iter().find(|name| !is_ours(name)) {
            return Err(CoalitionError::NoMember(foreign.as_ref().to_owned()));
        }
        let stays = |name: &&Arc<str>| !parting.iter().any(|it| *it.as_ref() == ***name);
        Ok(names.iter().filter(stays).cloned().collect())
    }

    /// Replaces the members and forms another coalition, in one change.
    pub(crate) fn split_off(
        &mut self,
        name: &str,
        parting: Members,
        staying: Members,
        options: RegisterOptions,
    ) -> Result<Self, CoalitionError> {
        let registration = registration_of(name, &parting, options);
        self.replace(staying, vec![registration.clone()], &[])?;
        Ok(Self {
            domain: self.domain.clone(),
            registration,
            members: parting,
            formed: true,
        })
    }

    /// Removes the name from the directory.
    ///
    /// # Errors
    /// If the directory cannot be written.
    pub fn dissolve(mut self) -> Result<(), DeregisterError> {
        self.remove()
    }

    /// Replaces the members, and forms and removes other coalitions in the same atomic change.
    pub(crate) fn replace(
        &mut self,
        members: Members,
        mut formed: Vec<Registration>,
        leaving: &[(&str, Incarnation)],
    ) -> Result<(), CoalitionError> {
        let own = Registration {
            role: Role::Coalition(members.clone()),
            ..self.registration.clone()
        };
        formed.push(own.clone());
        self.domain.inner.service.host.replace(formed, leaving)?;
        self.registration = own;
        self.members = members;
        Ok(())
    }

    /// Removes the name from the directory.
    pub(crate) fn remove(&mut self) -> Result<(), DeregisterError> {
        self.formed = false;
        let Registration {
            name, incarnation, ..
        } = &self.registration;
        self.domain
            .inner
            .service
            .host
            .deregister(name, *incarnation)
    }
}

impl Drop for Coalition {
    fn drop(&mut self) {
        // In a forked child, the coalition still belongs to the parent.
        if self.formed && self.domain.inner.owner.is_this() {
            match self.remove() {
                // Closing the domain has already removed the name.
                Ok(()) | Err(DeregisterError::Closed) => {}
                Err(error) => {
                    log_limit::warn!(error = %ErrorChain(&error), coalition = self.name(), "cannot remove a coalition");
                }
            }
        }
    }
}

impl std::fmt::Debug for Coalition {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Coalition")
            .field("name", &self.registration.name)
            .field("members", &self.members)
            .finish_non_exhaustive()
    }
}
