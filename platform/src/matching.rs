//! Searches: the comparison of a template with a description (FIPA00023 clause 6.4.2.1), and the bounds
//! of its work.

use std::fmt;

use crate::description::{matches_agent, matches_property};
use crate::{AgentDescription, Exception, ServiceDescription, limits};

/// The number of comparisons that a search may still make.
#[derive(Debug)]
pub(crate) struct Comparisons(usize);

impl Default for Comparisons {
    fn default() -> Self {
        Self(limits::COMPARISONS)
    }
}

impl Comparisons {
    /// Counts one comparison, and each that it stands for.
    fn count(&mut self, number: usize) -> Result<(), Exhausted> {
        self.0 = self.0.checked_sub(number).ok_or(Exhausted)?;
        Ok(())
    }

    /// Whether each text of the template is among the texts of the description.
    fn texts(&mut self, template: &[String], texts: &[String]) -> Result<bool, Exhausted> {
        for wanted in template {
            self.count(texts.len() + 1)?;
            if !texts.iter().any(|text| text.eq_ignore_ascii_case(wanted)) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn text(
        &mut self,
        template: Option<&String>,
        text: Option<&String>,
    ) -> Result<bool, Exhausted> {
        self.count(1)?;
        Ok(match (template, text) {
            (None, _) => true,
            (Some(template), Some(text)) => template.eq_ignore_ascii_case(text),
            (Some(_), None) => false,
        })
    }

    /// Whether a description matches the template: each slot of the template has its counterpart.
    pub(crate) fn agent(
        &mut self,
        template: &AgentDescription,
        description: &AgentDescription,
    ) -> Result<bool, Exhausted> {
        if let Some(wanted) = &template.name {
            let addresses = description
                .name
                .as_ref()
                .map_or(0, |it| it.addresses().len());
            self.count(1 + addresses)?;
            let agent = description.name.as_ref();
            if !agent.is_some_and(|agent| matches_agent(wanted, agent)) {
                return Ok(false);
            }
        }
        for (template, texts) in [
            (&template.protocols, &description.protocols),
            (&template.ontologies, &description.ontologies),
            (&template.languages, &description.languages),
            (&template.scope, &description.scope),
        ] {
            if !self.texts(template, texts)? {
                return Ok(false);
            }
        }
        for wanted in &template.services {
            let mut found = false;
            for service in &description.services {
                if self.service(wanted, service)? {
                    found = true;
                    break;
                }
            }
            if !found {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn service(
        &mut self,
        template: &ServiceDescription,
        service: &ServiceDescription,
    ) -> Result<bool, Exhausted> {
        for (template, text) in [
            (&template.service_type, &service.service_type),
            (&template.name, &service.name),
            (&template.ownership, &service.ownership),
        ] {
            if !self.text(template.as_ref(), text.as_ref())? {
                return Ok(false);
            }
        }
        for (template, texts) in [
            (&template.protocols, &service.protocols),
            (&template.ontologies, &service.ontologies),
            (&template.languages, &service.languages),
        ] {
            if !self.texts(template, texts)? {
                return Ok(false);
            }
        }
        for wanted in &template.properties {
            self.count(service.properties.len() + 1)?;
            let mut properties = service.properties.iter();
            if !properties.any(|property| matches_property(wanted, property)) {
                return Ok(false);
            }
        }
        Ok(true)
    }
}

/// The search needs more comparisons than [`limits::COMPARISONS`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Exhausted;

impl fmt::Display for Exhausted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the search needs too many comparisons; give a template with fewer parts")
    }
}

impl From<Exhausted> for Exception {
    fn from(exhausted: Exhausted) -> Self {
        Self::InternalError(exhausted.to_string())
    }
}

/// Returns the number of descriptions that an answer may have: 1 without `max-results` (FIPA00023), and
/// never more than [`limits::RESULTS`].
pub(crate) fn max_results(asked: Option<i64>) -> usize {
    match asked {
        None => 1,
        Some(most) => usize::try_from(most).map_or(limits::RESULTS, |it| it.min(limits::RESULTS)),
    }
}
