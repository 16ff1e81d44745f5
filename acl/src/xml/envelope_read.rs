//! Reader of envelopes (FIPA00085).

use crate::Text;
use crate::envelope::parts::{
    AclRepresentationView, Event, Events, Parameter, Part, ReceivedView, StampParts, UserDefined,
};
use crate::error::{DecodeError, Problem};
use crate::view::AgentIds;
use crate::xml::agent_id;
use crate::xml::reader::{Element, Elements};
use crate::xml::tag::Tag;
use crate::xml::value::Whitespace;

const CLAUSE: &str = "FIPA00085";

/// Maximum number of `params` elements: the same bound as for a bit-efficient base and its extensions.
const MAX_PARTS: usize = 1025;

/// Maximum nesting depth of `params` elements. Only JADE nests them. The depth of all elements has
/// the same bound.
const MAX_NESTING: usize = 64;

/// A pull parser of an envelope. A payload may follow the envelope.
#[derive(Debug, Clone)]
pub(crate) struct EnvelopeReader<'a> {
    elements: Elements<'a>,
    /// Offset of the outermost element, once it was read.
    root: Option<usize>,
    /// The open parts. Only the first `depth` are valid.
    open: [OpenPart; MAX_NESTING],
    depth: usize,
    /// Number of parts that have begun.
    parts: usize,
    /// Index of the part that began last.
    index: u64,
    ended: bool,
}

#[derive(Debug, Clone, Copy, Default)]
struct OpenPart {
    part: usize,
    index: u64,
}

impl<'a> EnvelopeReader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self {
            elements: Elements::new(bytes, CLAUSE),
            root: None,
            open: [OpenPart::default(); MAX_NESTING],
            depth: 0,
            parts: 0,
            index: 1,
            ended: false,
        }
    }

    fn begin_part(&mut self, begin: &Element<'a>) -> Result<Event<'a>, DecodeError> {
        let wrong = |problem| DecodeError::new(begin.offset, CLAUSE, problem);
        if self.parts >= MAX_PARTS {
            return Err(wrong(Problem::TooDeep("params")));
        }
        match self.elements.attribute(begin, "index")? {
            Some(value) if !value.is_empty() => {
                let number = value.trimmed("index")?.as_str().parse();
                self.index = number.map_err(|_| wrong(Problem::Number))?;
            }
            // Without an index, the part has the one of the previous part, and the order counts.
            _ => {}
        }
        self.parts += 1;
        let (part, index) = (self.parts, self.index);
        match self.open.get_mut(self.depth) {
            Some(open) => *open = OpenPart { part, index },
            None => return Err(wrong(Problem::TooDeep("params"))),
        }
        self.depth += 1;
        Ok(Event::Part(Part::Params { part, index }))
    }
}

impl<'a> Events<'a> for EnvelopeReader<'a> {
    fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError> {
        if self.ended {
            return Ok(None);
        }
        let root = match self.root {
            Some(root) => root,
            None => {
                let problem = "the outermost element is not envelope";
                let root = self.elements.root(Tag::Envelope, problem)?.offset;
                *self.root.insert(root)
            }
        };
        loop {
            let Some(child) = self.elements.child()? else {
                if self.depth == 0 {
                    self.ended = true;
                    if self.parts == 0 {
                        return Err(self.elements.error(root, Problem::Missing("params")));
                    }
                    return Ok(None);
                }
                self.depth -= 1;
                // The following elements belong to the enclosing part.
                let enclosing = self.depth.checked_sub(1).and_then(|at| self.open.get(at));
                match enclosing {
                    Some(OpenPart { part, index }) => {
                        let (part, index) = (*part, *index);
                        return Ok(Some(Event::Part(Part::Params { part, index })));
                    }
                    None => continue,
                }
            };
            if child.tag == Tag::Params {
                return self.begin_part(&child).map(Some);
            }
            if self.depth == 0 {
                self.elements.skip()?;
            } else if let Some(parameter) = parameter(&mut self.elements, &child)? {
                return Ok(Some(Event::Parameter(parameter)));
            }
        }
    }

    fn position(&self) -> usize {
        self.elements.position()
    }
}

/// Reads an element of a part, including its end. Returns `None` if it has no parameter.
fn parameter<'a>(
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<Option<Parameter<'a>>, DecodeError> {
    let text = |elements: &mut Elements<'a>, what| {
        let value = elements.value(child, &["value"])?;
        value.text(Whitespace::Preserve, what)
    };
    Ok(Some(match child.tag {
        Tag::To => Parameter::To(agents(elements, child)?),
        Tag::IntendedReceiver => Parameter::IntendedReceivers(agents(elements, child)?),
        Tag::From => match agent_id::read_one(elements)? {
            Some(agent) => Parameter::From(agent),
            None => return Ok(None),
        },
        Tag::Received => match received(elements, child)? {
            Some(received) => Parameter::Received(received),
            None => return Ok(None),
        },
        Tag::Date => Parameter::Date(elements.value(child, &["value"])?.time()?),
        Tag::Comments => Parameter::Comments(text(elements, "comments")?),
        Tag::PayloadEncoding => Parameter::PayloadEncoding(text(elements, "payload-encoding")?),
        Tag::TransportBehaviour => {
            Parameter::TransportBehaviour(text(elements, "transport-behaviour")?)
        }
        Tag::AclRepresentation => {
            let name = elements.value(child, &["value"])?;
            let name = name.trimmed("acl-representation")?;
            if name.is_empty() {
                return Ok(None);
            }
            Parameter::AclRepresentation(AclRepresentationView::Named(name))
        }
        Tag::PayloadLength => {
            let digits = elements.value(child, &["value"])?;
            let digits = digits.trimmed("payload-length")?;
            let digits = digits.as_str();
            // JADE writes -1 or an empty text for an unknown length.
            if digits.is_empty() || digits == "-1" {
                return Ok(None);
            }
            let wrong = |_| elements.error(child.offset, Problem::Number);
            Parameter::PayloadLength(digits.parse().map_err(wrong)?)
        }
        _ => match agent_id::user_defined(elements, child)? {
            Some((name, value)) => Parameter::UserDefined(UserDefined::Pair(name, value)),
            None => return Ok(None),
        },
    }))
}

fn agents<'a>(
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<AgentIds<'a>, DecodeError> {
    let mut agents = AgentIds::default();
    agent_id::read_all(elements, child, &mut agents)?;
    Ok(agents)
}

/// Reads a stamp with its parts in any order. Returns `None` if it has no `received-by`.
fn received<'a>(
    elements: &mut Elements<'a>,
    begin: &Element<'a>,
) -> Result<Option<ReceivedView<'a>>, DecodeError> {
    let (mut by, mut from, mut date, mut id, mut via) = (None, None, None, None, None);
    let start = elements.position();
    while let Some(child) = elements.child()? {
        let (text, what) = match child.tag {
            Tag::ReceivedDate => {
                date = Some(elements.value(&child, &["value"])?.time()?);
                continue;
            }
            Tag::ReceivedBy => (&mut by, "received-by"),
            Tag::ReceivedFrom => (&mut from, "received-from"),
            Tag::ReceivedId => (&mut id, "received-id"),
            Tag::ReceivedVia => (&mut via, "received-via"),
            _ => {
                agent_id::user_defined(elements, &child)?;
                continue;
            }
        };
        let value: Text<'a> = elements.value(&child, &["value"])?.trimmed(what)?;
        *text = (!value.is_empty()).then_some(value);
    }
    let inside = elements.bytes().get(start..elements.begin());
    let Some(by) = by else { return Ok(None) };
    let Some(date) = date else {
        return Err(elements.error(begin.offset, Problem::Missing("received-date")));
    };
    Ok(Some(ReceivedView {
        by,
        date,
        from,
        id,
        via,
        parts: StampParts::Xml(inside.unwrap_or_default()),
    }))
}

/// Reads the next user-defined parameter of a checked stamp.
pub(crate) fn next_received_user_defined<'a>(rest: &mut &'a [u8]) -> Option<UserDefined<'a>> {
    let mut elements = Elements::inside(rest);
    // An error cannot occur in checked bytes. It would end the iteration.
    while let Some(child) = elements.child().ok()? {
        let pair = match child.tag {
            Tag::ReceivedDate
            | Tag::ReceivedBy
            | Tag::ReceivedFrom
            | Tag::ReceivedId
            | Tag::ReceivedVia => elements.skip().ok().map(|()| None)?,
            _ => agent_id::user_defined(&mut elements, &child).ok()?,
        };
        *rest = elements.rest();
        if let Some((name, value)) = pair {
            return Some(UserDefined::Pair(name, value));
        }
    }
    None
}
