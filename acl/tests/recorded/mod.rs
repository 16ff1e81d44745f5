//! The recordings in `tests/vectors` and their expected values.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::fs;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use fipa_acl::Message;
use fipa_acl::json::message_to_json;
use serde_json::Value;

/// Converts a message to JSON with its content in Base64, as in the recorded JSON.
pub(crate) fn with_base64(message: &Message) -> Value {
    let mut json = message_to_json(message);
    let object = json.as_object_mut().unwrap();
    if let Some(text) = object.remove("content") {
        let encoded = BASE64.encode(text.as_str().unwrap());
        object.insert("content_base64".into(), Value::String(encoded));
    }
    json
}

/// Reads the expected JSON of a recording.
pub(crate) fn expected(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path.with_extension("json")).unwrap()).unwrap()
}

/// Returns the name of a recording without its extension.
pub(crate) fn name(path: &Path) -> &str {
    path.file_stem().unwrap().to_str().unwrap()
}

/// Returns the path of a recording.
pub(crate) fn vector(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/vectors")
        .join(name)
}

/// Returns the paths of all recordings with this first letter and this extension.
pub(crate) fn vectors(initial: char, extension: &str) -> Vec<PathBuf> {
    let mut found: Vec<_> = fs::read_dir(vector(""))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|ext| ext == extension))
        .filter(|path| name(path).starts_with(initial))
        .collect();
    found.sort();
    found
}
