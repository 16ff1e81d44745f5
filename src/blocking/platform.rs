//! The calls of [`crate::platform`] under the same names, blocking.

use std::time::Duration;

use super::{Agent, Background};
use crate::AgentId;
use crate::platform::{
    self, AgentDescription, AmsDescription, ApDescription, Constraints, PlatformError,
    ServiceDescription,
};

/// A directory facilitator; see [`crate::platform::Df`].
#[derive(Debug, Clone)]
pub struct Df<'a> {
    df: platform::Df<'a>,
    runtime: &'a Background,
}

/// A subscription to a directory facilitator; see [`crate::platform::Notifications`].
#[derive(Debug)]
#[must_use = "next() returns the notifications"]
pub struct Notifications<'a> {
    notifications: platform::Notifications,
    runtime: &'a Background,
}

/// An agent management system; see [`crate::platform::Ams`].
#[derive(Debug, Clone)]
pub struct Ams<'a> {
    ams: platform::Ams<'a>,
    runtime: &'a Background,
}

impl Agent {
    /// See [`crate::Agent::df`].
    ///
    /// # Errors
    /// If this host has none: it needs a gateway.
    pub fn df(&self) -> Result<Df<'_>, PlatformError> {
        let runtime = &self.runtime;
        self.agent.df().map(|df| Df { df, runtime })
    }

    /// See [`crate::Agent::df_of`].
    #[must_use]
    pub fn df_of(&self, df: AgentId) -> Df<'_> {
        let (df, runtime) = (self.agent.df_of(df), &self.runtime);
        Df { df, runtime }
    }

    /// See [`crate::Agent::ams`].
    ///
    /// # Errors
    /// If this host has none: it needs a gateway.
    pub fn ams(&self) -> Result<Ams<'_>, PlatformError> {
        let runtime = &self.runtime;
        self.agent.ams().map(|ams| Ams { ams, runtime })
    }

    /// See [`crate::Agent::ams_of`].
    #[must_use]
    pub fn ams_of(&self, ams: AgentId) -> Ams<'_> {
        let (ams, runtime) = (self.agent.ams_of(ams), &self.runtime);
        Ams { ams, runtime }
    }
}

/// Defines the blocking calls of one type, each with a link to the documentation of the async call.
macro_rules! blocking {
    ($type:ident.$inner:ident: $(
        fn $name:ident($($argument:ident: $of:ty),*) -> $output:ty;
    )*) => {
        impl $type<'_> {
            $(
                #[doc = concat!(
                    "See [`crate::platform::", stringify!($type), "::", stringify!($name), "`].\n\n"
                )]
                #[doc = "# Errors\nAs for the async call."]
                pub fn $name(&self, $($argument: $of),*) -> Result<$output, PlatformError> {
                    self.runtime.block_on(self.$inner.$name($($argument),*))
                }
            )*
        }
    };
}

blocking! { Df.df:
    fn register_service(service: ServiceDescription) -> AgentDescription;
    fn register(description: AgentDescription) -> AgentDescription;
    fn modify(description: AgentDescription) -> AgentDescription;
    fn deregister() -> ();
    fn search(template: &AgentDescription) -> Vec<AgentDescription>;
    fn search_within(
        template: &AgentDescription,
        constraints: &Constraints
    ) -> Vec<AgentDescription>;
}

blocking! { Ams.ams:
    fn search(template: &AmsDescription) -> Vec<AmsDescription>;
    fn description() -> ApDescription;
    fn register(description: &AmsDescription) -> ();
    fn modify(description: &AmsDescription) -> ();
    fn deregister() -> ();
}

impl<'a> Df<'a> {
    /// See [`crate::platform::Df::id`].
    #[must_use]
    pub fn id(&self) -> &AgentId {
        self.df.id()
    }

    /// See [`crate::platform::Df::subscribe`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn subscribe(
        &self,
        template: &AgentDescription,
    ) -> Result<Notifications<'a>, PlatformError> {
        let runtime = self.runtime;
        let notifications = runtime.block_on(self.df.subscribe(template))?;
        Ok(Notifications {
            notifications,
            runtime,
        })
    }
}

impl Ams<'_> {
    /// See [`crate::platform::Ams::id`].
    #[must_use]
    pub fn id(&self) -> &AgentId {
        self.ams.id()
    }
}

impl Notifications<'_> {
    /// See [`crate::platform::Notifications::next`].
    ///
    /// # Errors
    /// As for the async call.
    #[allow(
        clippy::should_implement_trait,
        reason = "unlike an iterator, it goes on after an error"
    )]
    pub fn next(&mut self) -> Result<Vec<AgentDescription>, PlatformError> {
        self.runtime.block_on(self.notifications.next())
    }

    /// See [`crate::platform::Notifications::cancel`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn cancel(self, timeout: Duration) -> Result<(), PlatformError> {
        self.runtime.block_on(self.notifications.cancel(timeout))
    }
}
