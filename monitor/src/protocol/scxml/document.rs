//! Reads XML into elements with line numbers. References between elements are not checked yet.

use std::borrow::Cow;

use quick_xml::XmlVersion;
use quick_xml::events::{BytesStart, Event};
use quick_xml::name::{Namespace, ResolveResult};
use quick_xml::reader::NsReader;

use super::{Doubt, MAX_FILE, MAX_MISTAKES, Mistake, NAMESPACE, Problem, Warning};

/// Maximum nesting depth of elements. A protocol needs three levels. Other elements are skipped.
const MAX_DEPTH: usize = 32;
const MAX_STATES: usize = 500;
const MAX_TRANSITIONS: usize = 2_000;
/// Maximum length of the value of an attribute, in bytes.
const MAX_VALUE: usize = 256;
/// Maximum number of attributes of an element.
const MAX_ATTRIBUTES: usize = 64;

/// The attributes and states of an `<scxml>` element.
#[derive(Debug, Default)]
pub(super) struct Document {
    pub(super) line: usize,
    pub(super) initial: Option<String>,
    /// Whether [`NAMESPACE`] is declared.
    pub(super) extended: bool,
    pub(super) name: Option<String>,
    pub(super) aliases: Option<String>,
    pub(super) title: Option<String>,
    pub(super) scope: Option<String>,
    pub(super) cancel: Option<String>,
    pub(super) states: Vec<State>,
}

#[derive(Debug, Default)]
pub(super) struct State {
    pub(super) line: usize,
    pub(super) id: String,
    pub(super) is_final: Option<String>,
    pub(super) transitions: Vec<Transition>,
    pub(super) subprotocols: Vec<Subprotocol>,
}

#[derive(Debug, Default)]
pub(super) struct Transition {
    pub(super) line: usize,
    pub(super) performative: Option<String>,
    pub(super) from: Option<String>,
    pub(super) to: Option<String>,
    pub(super) target: String,
    pub(super) optional: Option<String>,
    pub(super) after: Option<String>,
    pub(super) at_most: Option<String>,
    pub(super) when: Option<String>,
}

#[derive(Debug, Default)]
pub(super) struct Subprotocol {
    pub(super) line: usize,
    pub(super) name: String,
    pub(super) from: String,
    pub(super) proxied_to: Option<String>,
}

/// Reads a document up to its first mistake.
pub(super) fn read(text: &str) -> Result<(Document, Vec<Warning>), Mistake> {
    if text.len() > MAX_FILE {
        let problem = Problem::TooLarge(text.len());
        return Err(Mistake { line: 1, problem });
    }
    let mut reader = Reader {
        text,
        xml: NsReader::from_str(text.strip_prefix('\u{feff}').unwrap_or(text)),
        counted: 0,
        line: 1,
        transitions: 0,
        warnings: Vec::new(),
    };
    let document = reader.document()?;
    Ok((document, reader.warnings))
}

struct Reader<'a> {
    text: &'a str,
    xml: NsReader<&'a [u8]>,
    /// Offset up to which lines were counted.
    counted: usize,
    /// Line at that offset.
    line: usize,
    transitions: usize,
    warnings: Vec<Warning>,
}

enum Tag<'a> {
    /// An element, and whether it has content.
    Begin(BytesStart<'a>, bool),
    End,
    Eof,
}

impl<'a> Reader<'a> {
    fn document(&mut self) -> Result<Document, Mistake> {
        let (root, has_content) = match self.next()? {
            Tag::Begin(root, has_content) => (root, has_content),
            Tag::End | Tag::Eof => return Err(self.wrong(Problem::Empty)),
        };
        let name = local(&root);
        if name != "scxml" {
            return Err(self.wrong(Problem::NotScxml(shown(&name))));
        }
        let mut document = self.root(&root)?;
        if has_content {
            self.states(&mut document)?;
        }
        match self.next()? {
            Tag::Eof => Ok(document),
            Tag::Begin(element, _) => {
                let element = shown(&local(&element));
                let problem = Problem::Xml(format!("<{element}> follows </scxml>"));
                Err(self.wrong(problem))
            }
            Tag::End => Err(self.wrong(Problem::Xml("an end tag without a start tag".to_owned()))),
        }
    }

    fn states(&mut self, document: &mut Document) -> Result<(), Mistake> {
        loop {
            let (element, has_content) = match self.next()? {
                Tag::Begin(element, has_content) => (element, has_content),
                Tag::End => return Ok(()),
                Tag::Eof => return Err(self.truncated()),
            };
            match local(&element).as_ref() {
                name @ ("state" | "final") => {
                    if document.states.len() == MAX_STATES {
                        return Err(self.too_many("states", MAX_STATES));
                    }
                    let mut state = self.state(&element, name == "final")?;
                    if has_content {
                        self.inside(&mut state)?;
                    }
                    document.states.push(state);
                }
                name @ ("transition" | "subprotocol") => {
                    return Err(self.misplaced(name, "scxml"));
                }
                _ if has_content => self.skip()?,
                _ => {}
            }
        }
    }

    fn root(&mut self, element: &BytesStart<'a>) -> Result<Document, Mistake> {
        let mut document = Document {
            line: self.line,
            ..Document::default()
        };
        const KNOWN: &str = "name, aliases, title, scope, cancel";
        for (ours, key, value) in self.attributes(element)? {
            let value = Some(value);
            match (ours, key.as_ref()) {
                (false, "initial") => document.initial = value,
                (true, "name") => document.name = value,
                (true, "aliases") => document.aliases = value,
                (true, "title") => document.title = value,
                (true, "scope") => document.scope = value,
                (true, "cancel") => document.cancel = value,
                (true, other) => return Err(self.unknown("scxml", other, KNOWN)),
                // SCXML requires the version.
                (false, "version" | "datamodel") => {}
                (false, other) => self.ignored(
                    "scxml",
                    other,
                    "initial, and in the namespace: name, aliases, title, scope, cancel",
                ),
            }
        }
        let mut bindings = self.xml.resolver().bindings();
        document.extended = bindings.any(|(_, namespace)| namespace == Namespace(NAMESPACE));
        Ok(document)
    }

    fn state(&mut self, element: &BytesStart<'a>, is_final: bool) -> Result<State, Mistake> {
        let mut state = State {
            line: self.line,
            is_final: is_final.then(|| "yes".to_owned()),
            ..State::default()
        };
        let mut id = None;
        for (ours, key, value) in self.attributes(element)? {
            match (ours, key.as_ref()) {
                (false, "id") => id = Some(value),
                (false, "final") => state.is_final = Some(value),
                (true, other) => return Err(self.unknown("state", other, "none")),
                (false, other) => self.ignored("state", other, "id, final"),
            }
        }
        state.id = self.required("state", "id", id)?;
        Ok(state)
    }

    fn inside(&mut self, state: &mut State) -> Result<(), Mistake> {
        loop {
            let (element, has_content) = match self.next()? {
                Tag::Begin(element, has_content) => (element, has_content),
                Tag::End => return Ok(()),
                Tag::Eof => return Err(self.truncated()),
            };
            match local(&element).as_ref() {
                "transition" => state.transitions.push(self.transition(&element)?),
                "subprotocol" => state.subprotocols.push(self.subprotocol(&element)?),
                // fipa_acl ignores these silently.
                name @ ("state" | "final" | "parallel" | "initial" | "history") => {
                    return Err(self.misplaced(name, "state"));
                }
                _ => {}
            }
            self.transitions += 1;
            if self.transitions > MAX_TRANSITIONS {
                return Err(self.too_many("transitions", MAX_TRANSITIONS));
            }
            if has_content {
                self.skip()?;
            }
        }
    }

    fn transition(&mut self, element: &BytesStart<'a>) -> Result<Transition, Mistake> {
        let mut transition = Transition {
            line: self.line,
            ..Transition::default()
        };
        let mut target = None;
        const KNOWN: &str = "optional, after, at-most, when";
        for (ours, key, value) in self.attributes(element)? {
            let value = Some(value);
            match (ours, key.as_ref()) {
                (false, "performative") => transition.performative = value,
                (false, "from") => transition.from = value,
                (false, "to") => transition.to = value,
                (false, "target") => target = value,
                (true, "optional") => transition.optional = value,
                (true, "after") => transition.after = value,
                (true, "at-most") => transition.at_most = value,
                (true, "when") => transition.when = value,
                (true, other) => return Err(self.unknown("transition", other, KNOWN)),
                (false, other) => self.ignored(
                    "transition",
                    other,
                    "performative, from, to, target, and in the namespace: optional, after, \
                     at-most, when",
                ),
            }
        }
        transition.target = self.required("transition", "target", target)?;
        Ok(transition)
    }

    fn subprotocol(&mut self, element: &BytesStart<'a>) -> Result<Subprotocol, Mistake> {
        let (mut name, mut from, mut proxied_to) = (None, None, None);
        for (ours, key, value) in self.attributes(element)? {
            match (ours, key.as_ref()) {
                (false, "name") => name = Some(value),
                (false, "from") => from = Some(value),
                (false, "proxied_to") => proxied_to = Some(value).filter(|role| !role.is_empty()),
                (true, other) => return Err(self.unknown("subprotocol", other, "none")),
                (false, other) => self.ignored("subprotocol", other, "name, from, proxied_to"),
            }
        }
        Ok(Subprotocol {
            line: self.line,
            name: self.required("subprotocol", "name", name)?,
            from: self.required("subprotocol", "from", from)?,
            proxied_to,
        })
    }

    /// Returns the attributes: whether they have [`NAMESPACE`], their local names and their values.
    fn attributes(&self, element: &BytesStart<'a>) -> Result<Vec<(bool, String, String)>, Mistake> {
        let mut found = Vec::new();
        // A check for duplicates takes quadratic time. The last one counts.
        for attribute in element.attributes().with_checks(false) {
            let attribute =
                attribute.map_err(|error| self.wrong(Problem::Xml(error.to_string())))?;
            if found.len() == MAX_ATTRIBUTES {
                return Err(self.too_many("attributes of an element", MAX_ATTRIBUTES));
            }
            if attribute.value.len() > MAX_VALUE {
                return Err(self.too_many("bytes in an attribute", MAX_VALUE));
            }
            let value = attribute
                .normalized_value(XmlVersion::Implicit1_0)
                .map_err(|error| self.wrong(Problem::Xml(error.to_string())))?;
            if attribute.key.as_namespace_binding().is_some() {
                continue;
            }
            let (namespace, key) = self.xml.resolver().resolve_attribute(attribute.key);
            let ours = namespace == ResolveResult::Bound(Namespace(NAMESPACE));
            // Attributes of other namespaces are ignored.
            if ours || namespace == ResolveResult::Unbound {
                found.push((ours, shown(key.into_inner()), value.into_owned()));
            }
        }
        Ok(found)
    }

    /// Skips the current element, including its end.
    fn skip(&mut self) -> Result<(), Mistake> {
        let mut depth = 1_usize;
        while depth > 0 {
            match self.next()? {
                Tag::Begin(_, true) => depth += 1,
                Tag::Begin(_, false) => {}
                Tag::End => depth -= 1,
                Tag::Eof => return Err(self.truncated()),
            }
            if depth > MAX_DEPTH {
                return Err(self.too_many("levels of elements", MAX_DEPTH));
            }
        }
        Ok(())
    }

    fn next(&mut self) -> Result<Tag<'a>, Mistake> {
        loop {
            let begin = self.xml.buffer_position();
            let event = self.xml.read_event();
            // An element has the line of its start, and an error the line of its position.
            let offset = match &event {
                Ok(Event::Start(_) | Event::Empty(_)) => begin,
                Ok(_) => self.xml.buffer_position(),
                Err(_) => self.xml.error_position(),
            };
            self.count_lines(usize::try_from(offset).unwrap_or(usize::MAX));
            match event {
                Ok(Event::Start(tag)) => return Ok(Tag::Begin(tag, true)),
                Ok(Event::Empty(tag)) => return Ok(Tag::Begin(tag, false)),
                Ok(Event::End(_)) => return Ok(Tag::End),
                Ok(Event::Eof) => return Ok(Tag::Eof),
                Ok(Event::DocType(_)) => return Err(self.wrong(Problem::DocumentType)),
                Ok(_) => {}
                Err(error) => return Err(self.wrong(Problem::Xml(error.to_string()))),
            }
        }
    }

    /// Sets the line to that of `offset`.
    fn count_lines(&mut self, offset: usize) {
        let mark = self.text.len() - self.text.trim_start_matches('\u{feff}').len();
        let offset = offset.saturating_add(mark).min(self.text.len());
        let passed = self.text.as_bytes().get(self.counted..offset);
        self.line += passed
            .unwrap_or_default()
            .iter()
            .filter(|byte| **byte == b'\n')
            .count();
        self.counted = self.counted.max(offset);
    }

    fn required(
        &self,
        element: &'static str,
        attribute: &'static str,
        value: Option<String>,
    ) -> Result<String, Mistake> {
        value
            .filter(|value| !value.is_empty())
            .ok_or_else(|| self.wrong(Problem::Missing { element, attribute }))
    }

    fn unknown(&self, element: &'static str, attribute: &str, known: &'static str) -> Mistake {
        self.wrong(Problem::UnknownAttribute {
            element,
            attribute: attribute.to_owned(),
            known,
        })
    }

    fn ignored(&mut self, element: &'static str, attribute: &str, known: &'static str) {
        if self.warnings.len() < MAX_MISTAKES {
            let doubt = Doubt::Ignored {
                element,
                attribute: attribute.to_owned(),
                known,
            };
            let line = self.line;
            self.warnings.push(Warning { line, doubt });
        }
    }

    fn misplaced(&self, element: &str, inside: &str) -> Mistake {
        self.wrong(Problem::Misplaced {
            element: element.to_owned(),
            inside: inside.to_owned(),
        })
    }

    fn too_many(&self, what: &'static str, limit: usize) -> Mistake {
        self.wrong(Problem::TooMany { what, limit })
    }

    fn truncated(&self) -> Mistake {
        self.wrong(Problem::Xml("the file ends inside an element".to_owned()))
    }

    fn wrong(&self, problem: Problem) -> Mistake {
        Mistake {
            line: self.line,
            problem,
        }
    }
}

fn local<'t>(element: &'t BytesStart<'_>) -> Cow<'t, str> {
    Cow::Borrowed(element.local_name().into_inner())
}

/// Truncates a name of the file for an error.
fn shown(name: &str) -> String {
    name.chars().take(60).collect()
}
