//! Coalitions: one name for several agents.

use std::sync::Arc;

use fipa_sds::{
    DeregisterError, Directory, Members, MembersError, RegisterError, Registration, Role,
};
use fipa_transport::Incarnation;

use crate::domain::{Domain, warn_of_name};
use crate::{AgentId, RegisterOptions};

/// A name of its own for several agents, wherever they are: a message to it reaches all members
/// but its sender, each with an outcome of its own, or the leader only when there is one.
///
/// Members are named, not held: one that moves to another host stays a member, and one that is
/// not there fails as an unknown name does. A member may be a coalition itself, up to four deep.
///
/// The coalition is this process's as long as it is held, and leaves the directory when dropped.
pub struct Coalition {
    domain: Domain,
    registration: Registration,
    members: Members,
    formed: bool,
}

impl Domain {
    /// Forms a coalition of these agents under a name of its own.
    ///
    /// # Errors
    /// When somebody else has the name, it is no name, or these cannot be its members.
    pub fn form<N: Into<Arc<str>>>(
        &self,
        name: &str,
        members: impl IntoIterator<Item = N>,
        leader: Option<&str>,
        options: RegisterOptions,
    ) -> Result<Coalition, CoalitionError> {
        let members = Members::new(members, leader.map(Into::into))?;
        let registration = Registration {
            agent_type: options.agent_type,
            description: options.description,
            role: Role::Coalition(members.clone()),
            ..Registration::new(name, Incarnation::random(), Vec::new())
        };
        self.inner.service.host.register(registration.clone())?;
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

impl Coalition {
    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.registration.name
    }

    /// Who belongs to it, and who leads it.
    #[must_use]
    pub fn members(&self) -> &Members {
        &self.members
    }

    /// Has these members and this leader from now on.
    ///
    /// # Errors
    /// When these cannot be its members, or the directory cannot be written. Nothing has changed
    /// then.
    pub fn change<N: Into<Arc<str>>>(
        &mut self,
        members: impl IntoIterator<Item = N>,
        leader: Option<&str>,
    ) -> Result<(), CoalitionError> {
        let members = Members::new(members, leader.map(Into::into))?;
        self.replace(members, Vec::new(), &[])
    }

    /// Takes in all members of another coalition, whose name is gone. Nobody who watches sees both
    /// or neither. The leader stays who it is.
    ///
    /// # Errors
    /// When they are too many together, or the directory cannot be written. The other coalition
    /// comes back with the error, and nothing has changed.
    pub fn merge(&mut self, mut other: Self) -> Result<(), Box<(CoalitionError, Self)>> {
        let names = self.members.names().iter().chain(other.members.names());
        // One of them may have been a member of the other.
        let gone = Arc::clone(&other.registration.name);
        let names = names.filter(|name| **name != gone).cloned();
        let members = Members::new(names, self.members.leader().cloned());
        let leaving = [(&*gone, other.registration.incarnation)];
        let merged = members
            .map_err(CoalitionError::from)
            .and_then(|members| self.replace(members, Vec::new(), &leaving));
        match merged {
            Ok(()) => {
                other.formed = false;
                Ok(())
            }
            Err(error) => Err(Box::new((error, other))),
        }
    }

    /// Makes these members, who belong to this coalition, a coalition with a name of its own.
    /// Nobody who watches sees them in both or in neither. If the leader goes with them, those who
    /// stay have none.
    ///
    /// # Errors
    /// When one of them is no member, nobody would stay, somebody has the name, or the directory
    /// cannot be written. Nothing has changed then.
    pub fn split(
        &mut self,
        name: &str,
        members: &[&str],
        leader: Option<&str>,
        options: RegisterOptions,
    ) -> Result<Self, CoalitionError> {
        let is_ours = |name: &&str| self.members.names().iter().any(|ours| **ours == **name);
        if let Some(stranger) = members.iter().find(|name| !is_ours(name)) {
            return Err(CoalitionError::NoMember((*stranger).to_owned()));
        }
        let parting = Members::new(members.iter().copied(), leader.map(Into::into))?;
        let stays = |name: &&Arc<str>| !members.contains(&&***name);
        let staying = self.members.names().iter().filter(stays).cloned();
        let staying = Members::new(staying, self.members.leader().filter(stays).cloned())?;
        let registration = Registration {
            agent_type: options.agent_type,
            description: options.description,
            role: Role::Coalition(parting.clone()),
            ..Registration::new(name, Incarnation::random(), Vec::new())
        };
        self.replace(staying, vec![registration.clone()], &[])?;
        Ok(Self {
            domain: self.domain.clone(),
            registration,
            members: parting,
            formed: true,
        })
    }

    /// Takes the name out of the directory.
    ///
    /// # Errors
    /// When the directory cannot be written.
    pub fn dissolve(mut self) -> Result<(), DeregisterError> {
        self.leave()
    }

    /// Has these members, while others are formed and dissolved, in one go.
    fn replace(
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

    fn leave(&mut self) -> Result<(), DeregisterError> {
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
        // In a forked child it stays formed for the parent.
        if self.formed && self.domain.inner.owner.is_this() {
            match self.leave() {
                // The domain was closed before, and has taken the name with it.
                Ok(()) | Err(DeregisterError::Closed) => {}
                Err(error) => {
                    tracing::warn!(%error, coalition = self.name(), "not dissolved");
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

/// Why a coalition was not formed or changed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CoalitionError {
    /// These cannot be its members.
    #[error(transparent)]
    Members(#[from] MembersError),
    /// Who was to part does not belong to it.
    #[error("{0:?} is no member of this coalition")]
    NoMember(String),
    /// The directory does not take it.
    #[error(transparent)]
    Register(#[from] RegisterError),
}
