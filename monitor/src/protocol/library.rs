//! Libraries of protocols by name.

use crate::Machine;
use crate::protocol::index::MachineIndex;
use crate::protocol::scxml::ScxmlError;
use crate::protocol::spelling::one_edit_apart;

/// Maximum number of protocols in a library.
const MAX_MACHINES: usize = 256;

macro_rules! standard {
    ($name:literal) => {
        (
            concat!($name, ".scxml"),
            include_str!(concat!("../../protocols/", $name, ".scxml")),
        )
    };
}

/// The files of the standard protocols, and of those of locks. Each file contains the name of its protocol.
const STANDARD: [(&str, &str); 20] = [
    standard!("request"),
    standard!("query"),
    standard!("request-when"),
    standard!("propose"),
    standard!("subscribe"),
    standard!("contract-net"),
    standard!("iterated-contract-net"),
    standard!("english-auction"),
    standard!("dutch-auction"),
    standard!("brokering"),
    standard!("recruiting"),
    standard!("cancel"),
    standard!("rock-query"),
    standard!("dlm_discover"),
    standard!("dlm_probe"),
    standard!("owner_queue"),
    standard!("ricart_agrawala"),
    standard!("ricart_agrawala_extended"),
    standard!("suzuki_kasami"),
    standard!("suzuki_kasami_extended"),
];

/// A set of protocols with distinct names.
#[derive(Debug, Clone, Default)]
pub struct Library {
    machines: Vec<Machine>,
}

impl Library {
    /// Creates a library without protocols.
    #[must_use]
    pub fn empty() -> Self {
        Self::default()
    }

    /// Creates a library of the protocols of the FIPA standards, and of locks.
    #[must_use]
    pub fn standard() -> Self {
        let read = |(file, text): &(&str, &str)| Machine::read(file, text);
        // The tests below fail if a file of this crate has a mistake.
        let machines = STANDARD.iter().filter_map(|file| read(file).ok());
        Self {
            machines: machines.collect(),
        }
    }

    /// Returns the SCXML text of the standard protocol with this name or alias. Case is ignored.
    #[must_use]
    pub fn standard_text(name: &str) -> Option<&'static str> {
        let library = Self::standard();
        let name = library.find(name)?.name();
        let mut files = STANDARD.iter();
        let file = files.find(|(file, text)| {
            let read = Machine::read(file, text);
            read.is_ok_and(|machine| machine.name() == name)
        });
        file.map(|(_, text)| *text)
    }

    /// Adds a protocol. It replaces a protocol with the same name. Its aliases take precedence over
    /// those of earlier protocols.
    ///
    /// # Errors
    /// The library is full.
    pub fn add(&mut self, machine: Machine) -> Result<(), LibraryFull> {
        let same = |known: &Machine| known.name().eq_ignore_ascii_case(machine.name());
        self.machines.retain(|known| !same(known));
        if self.machines.len() == MAX_MACHINES {
            return Err(LibraryFull);
        }
        self.machines.insert(0, machine);
        Ok(())
    }

    /// Reads a protocol and adds it: see [`Machine::read`] and [`add`](Self::add).
    ///
    /// # Errors
    /// The file has mistakes, or the library is full.
    pub fn read(&mut self, file: &str, text: &str) -> Result<(), LibraryError> {
        self.add(Machine::read(file, text)?)?;
        Ok(())
    }

    /// Finds the protocol with this name or alias. Names take precedence over aliases. Case is
    /// ignored.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<&Machine> {
        self.machine(self.index_of(name)?)
    }

    /// Finds the protocol from whose name or alias an unknown name differs by one edit: an inserted, a
    /// deleted, a replaced or two swapped characters. The name is probably a typing error.
    #[must_use]
    pub fn near(&self, name: &str) -> Option<&Machine> {
        match self.index_of(name) {
            Some(_) => None,
            None => self.machine(self.index_near(name, |_| true)?),
        }
    }

    /// Iterates over all protocols, the one added last first.
    pub fn iter(&self) -> impl Iterator<Item = &Machine> {
        self.machines.iter()
    }

    pub(crate) fn index_of(&self, name: &str) -> Option<MachineIndex> {
        let named = |machine: &Machine| machine.name().eq_ignore_ascii_case(name);
        let mut machines = self.machines.iter();
        let found = machines.position(named).or_else(|| {
            let mut machines = self.machines.iter();
            machines.position(|machine| machine.is_called(name))
        });
        found.map(MachineIndex::new)
    }

    /// Finds the protocol, among those that `is_meant` admits, from whose name or alias this one differs
    /// by one edit.
    pub(crate) fn index_near(
        &self,
        name: &str,
        is_meant: impl Fn(&Machine) -> bool,
    ) -> Option<MachineIndex> {
        /// Maximum length of a name that is compared with the known ones.
        const MAX_COMPARED: usize = 128;
        if name.len() > MAX_COMPARED {
            return None;
        }
        let name = name.to_ascii_lowercase();
        let is_near = |known: &str| one_edit_apart(&known.to_ascii_lowercase(), &name);
        let found = self.machines.iter().position(|machine| {
            let mut aliases = machine.aliases().iter();
            is_meant(machine) && (is_near(machine.name()) || aliases.any(|alias| is_near(alias)))
        });
        found.map(MachineIndex::new)
    }

    #[inline]
    pub(crate) fn machine(&self, index: MachineIndex) -> Option<&Machine> {
        self.machines.get(index.index())
    }
}

/// Error of adding a protocol to a full library.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a library holds at most {MAX_MACHINES} protocols")]
pub struct LibraryFull;

/// Error of reading and adding a protocol.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LibraryError {
    /// The file has mistakes.
    #[error(transparent)]
    Scxml(#[from] ScxmlError),
    /// The library is full.
    #[error(transparent)]
    Full(#[from] LibraryFull),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_standard_files_have_no_mistakes() {
        for (file, text) in STANDARD {
            if let Err(error) = Machine::read(file, text) {
                panic!("{error}");
            }
        }
        assert_eq!(Library::standard().iter().count(), STANDARD.len());
    }

    #[test]
    fn standard_protocols_are_found_by_name_and_by_the_names_of_peers() {
        let library = Library::standard();
        for (name, aliases) in [
            ("fipa-request", &["request"][..]),
            ("fipa-query", &[]),
            ("query", &[]),
            ("fipa-request-when", &["request-when"]),
            ("fipa-propose", &["propose"]),
            ("fipa-subscribe", &["subscribe"]),
            ("fipa-contract-net", &["contractNet"]),
            ("fipa-iterated-contract-net", &["iteratedContractNet"]),
            ("fipa-auction-english", &["fipa-english-auction"]),
            (
                "fipa-auction-dutch",
                &["dutchAuction", "fipa-dutch-auction"],
            ),
            ("fipa-brokering", &["brokering"]),
            ("fipa-recruiting", &["recruiting"]),
            ("fipa-cancel", &["cancel"]),
            ("dlm_discover", &[]),
            ("dlm_probe", &[]),
            ("owner_queue", &[]),
            ("ricart_agrawala_extended", &[]),
            ("suzuki_kasami", &[]),
        ] {
            let upper = name.to_uppercase();
            for called in aliases.iter().copied().chain([name, &upper]) {
                let found = library.find(called).map(Machine::name);
                assert_eq!(found, Some(name), "{called}");
            }
        }
        assert!(library.find("fipa").is_none());
    }

    #[test]
    fn the_text_of_each_standard_protocol_is_that_of_its_file() {
        for machine in Library::standard().iter() {
            for called in machine
                .aliases()
                .iter()
                .map(String::as_str)
                .chain([machine.name()])
            {
                let text = Library::standard_text(called).unwrap();
                let read = Machine::read("exported", text).unwrap();
                assert_eq!(read.name(), machine.name(), "{called}");
                assert_eq!(read.states().len(), machine.states().len());
            }
        }
        assert_eq!(Library::standard_text("fipa-dance"), None);
    }

    #[test]
    fn the_protocol_of_a_name_with_a_typing_error_is_found() {
        let library = Library::standard();
        let near = |name| library.near(name).map(Machine::name);
        assert_eq!(near("fipa-reqest"), Some("fipa-request"));
        assert_eq!(near("contract-nett"), Some("fipa-contract-net"));
        assert_eq!(near("fipa-request"), None, "it is known");
        assert_eq!(near("fipa-dance"), None);
        // Long names are not compared.
        let own = r#"<scxml initial="1">
            <state id="1"><transition performative="inform" from="a" to="b" target="2"/></state>
            <state id="2" final="yes"/></scxml>"#;
        for (length, is_compared) in [(127, true), (128, false)] {
            let mut library = Library::empty();
            library.read(&"x".repeat(length), own).unwrap();
            let name = "x".repeat(length + 1);
            assert_eq!(library.near(&name).is_some(), is_compared, "{length}");
        }
    }

    #[test]
    fn added_protocols_take_precedence() {
        let mut library = Library::standard();
        let own = r#"<scxml initial="1">
            <state id="1"><transition performative="inform" from="a" to="b" target="2"/></state>
            <state id="2" final="yes"/></scxml>"#;
        library.read("protocols/request", own).unwrap();
        assert_eq!(
            library.find("request").map(|own| own.states().len()),
            Some(2)
        );
        assert_eq!(
            library.find("fipa-request").map(Machine::name),
            Some("fipa-request")
        );
        library.read("fipa-request.scxml", own).unwrap();
        assert_eq!(
            library.find("fipa-request").map(|own| own.states().len()),
            Some(2)
        );
        assert_eq!(library.iter().count(), STANDARD.len() + 1);
        for number in 0.. {
            match library.read(&format!("p{number}"), own) {
                Ok(()) => assert!(number < MAX_MACHINES),
                Err(error) => return assert_eq!(error, LibraryError::Full(LibraryFull)),
            }
        }
    }
}
