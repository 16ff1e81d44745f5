//! Reads a TOML document, or a `--set` argument, into a configuration.
//!
//! Sources are read from the highest to the lowest priority: a value that is already set stays.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;

use toml_edit::{Array, Document, Item, Value as Toml};

use super::keys::{InvalidValue, KEYS, Key, MAPS, Map, Shape, dotted};
use super::{Config, Mistake, Origin, check};

/// A configuration that is being read.
#[derive(Debug)]
pub(super) struct Reader {
    pub(super) config: Config,
    pub(super) origins: BTreeMap<Vec<String>, Origin>,
    pub(super) mistakes: Vec<Mistake>,
    /// The paths of the values that could not be read.
    invalid: BTreeSet<Vec<String>>,
}

impl Reader {
    /// Creates a reader that holds the defaults.
    pub(super) fn new(host_name: &str) -> Self {
        Self {
            config: Config::for_host(host_name),
            origins: BTreeMap::new(),
            mistakes: Vec::new(),
            invalid: BTreeSet::new(),
        }
    }

    /// Reads a file.
    pub(super) fn file(&mut self, path: &Path, text: &str) {
        let layer = Layer::File { path, text };
        match Document::parse(text) {
            Ok(document) => self.table(&layer, &mut Vec::new(), document.as_item()),
            Err(error) => {
                let line = error.span().and_then(|span| text.get(..span.start));
                let line = line.map_or("", |before| {
                    text.lines().nth(newlines(before)).unwrap_or("")
                });
                self.mistake(
                    layer.origin(error.span()),
                    format!("not TOML: {}", error.message().replace('\n', ", ")),
                    format!("correct the line {:?}", shortened(line.trim())),
                );
            }
        }
    }

    /// Reads a `--set` argument: a key as in TOML, `=`, and a value as in TOML. Text needs no quotes,
    /// and a list needs no brackets.
    pub(super) fn set(&mut self, assignment: &str) {
        let layer = Layer::Set(assignment);
        let Some((path, raw)) = split(assignment) else {
            self.mistake(
                layer.origin(None),
                "not of the form key=value".to_owned(),
                "write for example --set mts.deadline=9s".to_owned(),
            );
            return;
        };
        let parts: Vec<&str> = path.iter().map(String::as_str).collect();
        let shape = match Node::at(&parts) {
            Node::Key(key) => Some(key.shape),
            Node::Entry(..) => Some(Shape::List),
            Node::Section | Node::Unknown => None,
        };
        self.item(&layer, path, None, &Item::Value(set_value(shape, raw)));
    }

    /// Reads `$FIPA_DOMAIN`.
    pub(super) fn domain(&mut self, name: &str) {
        let path = vec!["domain".to_owned()];
        let item = Item::Value(Toml::from(name));
        self.item(&Layer::Variable("FIPA_DOMAIN"), path, None, &item);
    }

    /// Checks the values that could be read, and adds the mistakes. If a value could not be read, its
    /// default is in place, and conditions on several values are not checked.
    pub(super) fn check(&mut self) {
        for finding in check::findings(&self.config) {
            let is_checked = self.invalid.is_empty() || !finding.on_several_values;
            if is_checked && !self.invalid.contains(&finding.path) {
                self.add(finding);
            }
        }
    }

    /// Adds a finding, with the origin of its value.
    pub(super) fn add(&mut self, finding: check::Finding) {
        let place = self.origin(&finding.path);
        self.mistakes.push(finding.at(Some(place)));
    }

    /// Returns the origin of the value at this path; for a table, that of its first entry.
    pub(super) fn origin(&self, path: &[String]) -> Origin {
        let from_here = self.origins.range(path.to_vec()..);
        let inside = from_here
            .take_while(|(other, _)| other.starts_with(path))
            .next();
        inside.map_or(Origin::Default, |(_, origin)| origin.clone())
    }

    fn table(&mut self, layer: &Layer<'_>, path: &mut Vec<String>, item: &Item) {
        let Some(table) = item.as_table_like() else {
            let name = quoted_path(path);
            self.mistake(
                layer.origin(item.span()),
                format!("`{name}` is a section, not a value"),
                format!(
                    "write [{name}] and below it some of its keys: {}",
                    children(path)
                ),
            );
            return;
        };
        for (name, child) in table.iter() {
            let span = table.get_key_value(name).and_then(|(key, _)| key.span());
            path.push(name.to_owned());
            self.item(layer, path.clone(), span, child);
            path.pop();
        }
    }

    fn item(
        &mut self,
        layer: &Layer<'_>,
        mut path: Vec<String>,
        span: Option<Range<usize>>,
        item: &Item,
    ) {
        let parts: Vec<&str> = path.iter().map(String::as_str).collect();
        match Node::at(&parts) {
            Node::Section => self.table(layer, &mut path, item),
            Node::Key(key) => {
                self.value(layer, &path, span, item, key.expected, |config, value| {
                    (key.write)(config, value)
                });
            }
            Node::Entry(map, name) => {
                self.value(layer, &path, span, item, map.expected, |config, value| {
                    (map.write)(config, name, value)
                });
            }
            Node::Unknown => {
                let what = format!("unknown key `{}`", dotted(&parts));
                self.mistake(layer.origin(span), what, suggestion(&parts));
            }
        }
    }

    fn value(
        &mut self,
        layer: &Layer<'_>,
        path: &[String],
        span: Option<Range<usize>>,
        item: &Item,
        expected: &str,
        write: impl FnOnce(&mut Config, &Toml) -> Result<(), InvalidValue>,
    ) {
        let written = match item.as_value() {
            // A source of higher priority has set the value; this one is only checked for mistakes.
            Some(value) if self.origins.contains_key(path) => {
                write(&mut Config::for_host(""), value)
            }
            Some(value) => write(&mut self.config, value),
            None => Err(InvalidValue {
                span: None,
                reason: "a table is not allowed here (a name with dots needs quotes)".to_owned(),
            }),
        };
        match written {
            Ok(()) => {
                let origin = layer.origin(span);
                self.origins.entry(path.to_vec()).or_insert(origin);
            }
            Err(invalid) => {
                self.invalid.insert(path.to_vec());
                self.mistake(
                    layer.origin(invalid.span.or(span)),
                    format!("`{}` is invalid: {}", quoted_path(path), invalid.reason),
                    format!("expected {expected}"),
                );
            }
        }
    }

    fn mistake(&mut self, place: Origin, what: String, help: String) {
        let place = Some(place);
        self.mistakes.push(Mistake { place, what, help });
    }
}

/// The source that is being read.
enum Layer<'a> {
    File { path: &'a Path, text: &'a str },
    Variable(&'static str),
    Set(&'a str),
}

impl Layer<'_> {
    fn origin(&self, span: Option<Range<usize>>) -> Origin {
        match self {
            Self::File { path, text } => {
                let before = span.and_then(|span| text.get(..span.start)).unwrap_or("");
                Origin::File {
                    path: path.to_path_buf(),
                    line: newlines(before) + 1,
                }
            }
            Self::Variable(variable) => Origin::Environment { variable },
            Self::Set(assignment) => Origin::Set {
                assignment: (*assignment).to_owned(),
            },
        }
    }
}

fn newlines(text: &str) -> usize {
    text.bytes().filter(|byte| *byte == b'\n').count()
}

/// The element of the configuration at a path.
enum Node<'a> {
    Section,
    Key(&'static Key),
    Entry(&'static Map, &'a str),
    Unknown,
}

impl<'a> Node<'a> {
    fn at(path: &[&'a str]) -> Self {
        if let Some(key) = KEYS.iter().find(|key| key.path == path) {
            return Self::Key(key);
        }
        if let Some((name, section)) = path.split_last()
            && let Some(map) = MAPS.iter().find(|map| map.path == section)
        {
            return Self::Entry(map, name);
        }
        if known().any(|known| known.len() >= path.len() && known.starts_with(path)) {
            return Self::Section;
        }
        Self::Unknown
    }
}

fn known() -> impl Iterator<Item = &'static [&'static str]> {
    let keys = KEYS.iter().map(|key| key.path);
    keys.chain(MAPS.iter().map(|map| map.path))
}

/// Lists the keys and sections directly in a section, in their order.
fn children<T: AsRef<str>>(section: &[T]) -> String {
    let mut names: Vec<&str> = Vec::new();
    for path in known().filter(|path| path.len() > section.len()) {
        let (front, rest) = path.split_at(section.len());
        let inside = front.iter().zip(section).all(|(a, b)| *a == b.as_ref());
        if let Some(name) = rest.first()
            && inside
            && !names.contains(name)
        {
            names.push(name);
        }
    }
    if names.is_empty() {
        "names of your choice".to_owned()
    } else {
        names.join(", ")
    }
}

/// Suggests a replacement for an unknown key.
fn suggestion(path: &[&str]) -> String {
    let text = path.join(".");
    let last = path.last().copied().unwrap_or_default();
    // Sections are candidates, too: `[discover]` is nearer to `discovery` than to any key in it.
    let candidates = known().flat_map(|path| (1..=path.len()).filter_map(|end| path.get(..end)));
    let nearest = candidates
        .map(|candidate| {
            let whole = strsim::damerau_levenshtein(&text, &candidate.join("."));
            // The distance of the right key in the wrong section.
            let moved = candidate.last().map_or(usize::MAX, |name| {
                strsim::damerau_levenshtein(last, name).saturating_add(1)
            });
            (whole.min(moved), candidate)
        })
        .min_by_key(|(distance, _)| *distance);
    let section = path.split_last().map_or(&[][..], |(_, section)| section);
    let place = match dotted(section) {
        top if top.is_empty() => "at the top".to_owned(),
        name => format!("in [{name}]"),
    };
    let is_related = |path: &[&str]| path.starts_with(section) || section.starts_with(path);
    let listed = match known().any(is_related) {
        true => format!("known {place}: {}", children(section)),
        false => format!("known at the top: {}", children::<&str>(&[])),
    };
    match nearest {
        Some((distance, candidate)) if distance <= 1 + last.chars().count() / 3 => {
            format!("did you mean `{}`? ({listed})", candidate.join("."))
        }
        _ => listed,
    }
}

fn quoted_path(path: &[String]) -> String {
    let parts: Vec<&str> = path.iter().map(String::as_str).collect();
    dotted(&parts)
}

/// Splits an assignment at the first `=` outside of a quoted key.
fn split(assignment: &str) -> Option<(Vec<String>, &str)> {
    assignment.match_indices('=').find_map(|(at, _)| {
        let (key, value) = assignment.split_at_checked(at)?;
        let path = toml_edit::Key::parse(key.trim()).ok()?;
        let path = path.iter().map(|key| key.get().to_owned()).collect();
        Some((path, value.strip_prefix('=')?.trim()))
    })
}

/// Parses the value of a `--set` argument according to the kind of value that the key has.
fn set_value(shape: Option<Shape>, raw: &str) -> Toml {
    let parsed: Option<Toml> = raw.parse().ok();
    match (shape, parsed) {
        (Some(Shape::Text), Some(value)) if value.is_str() => value,
        (Some(Shape::Text), _) => Toml::from(raw),
        (Some(Shape::List), Some(value)) if value.is_array() => value,
        (Some(Shape::List), _) => {
            let items = raw
                .split(',')
                .map(str::trim)
                .filter(|item| !item.is_empty());
            Toml::from(items.collect::<Array>())
        }
        (_, Some(value)) => value,
        (_, None) => Toml::from(raw),
    }
}

fn shortened(text: &str) -> String {
    text.chars().take(80).collect()
}
