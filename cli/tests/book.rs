//! The book (docs/book) and the other documents: links, included code, configurations and commands.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::collections::{BTreeSet, HashMap};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use common::Running;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_owned()
}

fn book() -> PathBuf {
    root().join("docs/book/src")
}

/// Adds the Markdown files in a directory; with `deep`, also those in its subdirectories.
fn markdown_in(directory: &Path, deep: bool, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && deep {
            markdown_in(&path, deep, files);
        } else if path.extension().is_some_and(|end| end == "md") {
            files.push(path);
        }
    }
}

/// The documents of the repository: those at the top, in docs, and beside each crate.
fn documents() -> Vec<PathBuf> {
    let mut files = Vec::new();
    markdown_in(&root(), false, &mut files);
    markdown_in(&root().join("docs"), true, &mut files);
    for entry in fs::read_dir(root()).unwrap() {
        let path = entry.unwrap().path();
        if path.join("Cargo.toml").exists() {
            markdown_in(&path, false, &mut files);
        }
    }
    files.sort();
    files
}

/// A fenced block of a document.
struct Block {
    language: String,
    text: String,
    /// Line of the fence, counted from 1.
    line: usize,
}

/// Splits a document into its text, in which code is blank, and its fenced blocks.
fn parts(document: &str) -> (String, Vec<Block>) {
    let mut text = String::new();
    let mut blocks = Vec::new();
    let mut open: Option<Block> = None;
    for (number, line) in document.lines().enumerate() {
        let fence = line.trim_start().strip_prefix("```");
        match (&mut open, fence) {
            (None, Some(language)) => {
                open = Some(Block {
                    language: language.to_owned(),
                    text: String::new(),
                    line: number + 1,
                });
            }
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (Some(block), None) => block.text.push_str(&format!("{line}\n")),
            (None, None) => text.push_str(&without_code(line)),
        }
        text.push('\n');
    }
    assert!(open.is_none(), "a fenced block is not closed: {document}");
    (text, blocks)
}

/// Replaces the parts between backquotes by blanks.
fn without_code(line: &str) -> String {
    let pieces: Vec<&str> = line.split('`').collect();
    let all = pieces.iter().enumerate().map(|(number, piece)| {
        // The last piece of an odd number of backquotes is text.
        let is_code = number % 2 == 1 && number + 1 < pieces.len();
        match is_code {
            true => " ".repeat(piece.len()),
            false => (*piece).to_owned(),
        }
    });
    all.collect::<Vec<_>>().join(" ")
}

/// The targets of the links in a text.
fn links(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for (at, _) in text.match_indices("](") {
        let target = &text[at + 2..];
        let target = target.split(')').next().unwrap();
        found.push(target.split_whitespace().next().unwrap_or("").to_owned());
    }
    found
}

/// The anchors that GitHub and mdBook give to the headings of a document.
fn anchors(document: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let mut in_block = false;
    let mut times: HashMap<String, usize> = HashMap::new();
    for line in document.lines() {
        in_block ^= line.trim_start().starts_with("```");
        let heading = line.trim_start_matches('#');
        if in_block || heading.len() == line.len() || !heading.starts_with(' ') {
            continue;
        }
        let slug: String = heading
            .trim()
            .to_lowercase()
            .chars()
            .filter_map(|c| match c {
                ' ' => Some('-'),
                c if c.is_alphanumeric() || c == '-' || c == '_' => Some(c),
                _ => None,
            })
            .collect();
        let count = times.entry(slug.clone()).or_default();
        found.insert(match *count {
            0 => slug.clone(),
            more => format!("{slug}-{more}"),
        });
        *count += 1;
    }
    found
}

/// The reason for which a link leads nowhere, if it does.
fn broken(document: &Path, link: &str) -> Option<String> {
    let (path, anchor) = match link.split_once('#') {
        Some((path, anchor)) => (path, Some(anchor)),
        None => (link, None),
    };
    let file = if path.contains("://") || path.starts_with("mailto:") {
        return None;
    } else if path.is_empty() {
        document.to_owned()
    } else {
        document.parent().unwrap().join(path)
    };
    if !file.exists() {
        return Some("no such file".to_owned());
    }
    let anchor = anchor?;
    if file.extension().is_none_or(|end| end != "md") {
        return None;
    }
    let known = anchors(&fs::read_to_string(&file).unwrap());
    (!known.contains(anchor)).then(|| format!("no such heading; there are {known:?}"))
}

#[test]
fn every_link_leads_to_a_file_and_a_heading() {
    let documents = documents();
    assert!(documents.contains(&book().join("SUMMARY.md")));
    let mut wrong = Vec::new();
    for document in &documents {
        let (text, _) = parts(&fs::read_to_string(document).unwrap());
        for link in links(&text) {
            if let Some(reason) = broken(document, &link) {
                wrong.push(format!("{}: {link}: {reason}", document.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn a_link_that_leads_nowhere_is_found() {
    let readme = root().join("README.md");
    for link in [
        "missing.md",
        "README.md#no-such-heading",
        "#no-such-heading",
    ] {
        assert!(broken(&readme, link).is_some(), "{link}");
    }
    for link in ["#promises", "docs/glossary.md", "https://example.org"] {
        assert_eq!(broken(&readme, link), None);
    }
    let (text, blocks) = parts("a [b](c) `[d](e)`\n```rust\n[f](g)\n```\n![h](i \"j\")\n");
    assert_eq!(links(&text), ["c", "i"]);
    assert_eq!((blocks.len(), blocks[0].line), (1, 2));
}

/// The chapters of the book, in the order of its summary.
fn chapters() -> Vec<PathBuf> {
    let summary = fs::read_to_string(book().join("SUMMARY.md")).unwrap();
    links(&summary)
        .iter()
        .map(|file| book().join(file))
        .collect()
}

#[test]
fn every_published_crate_has_a_readme() {
    for entry in fs::read_dir(root()).unwrap() {
        let path = entry.unwrap().path();
        let Ok(manifest) = fs::read_to_string(path.join("Cargo.toml")) else {
            continue;
        };
        if !manifest.contains("publish = false") {
            let readme = path.join("README.md");
            assert!(readme.is_file(), "{} is missing", readme.display());
        }
    }
}

#[test]
fn the_summary_lists_every_chapter_once() {
    let listed = chapters();
    let mut written = Vec::new();
    markdown_in(&book(), true, &mut written);
    written.retain(|file| file.file_name().is_some_and(|name| name != "SUMMARY.md"));
    let mut sorted = listed.clone();
    sorted.sort();
    written.sort();
    assert_eq!(sorted, written);
    for chapter in listed {
        let text = fs::read_to_string(&chapter).unwrap();
        let is_titled = text.starts_with("# ") || text.starts_with("{{#include ");
        assert!(is_titled, "{} begins with a title", chapter.display());
    }
}

/// The file and the anchor that each include of a text names.
fn includes(text: &str) -> Vec<(String, Option<String>)> {
    let inner = text.split("{{#include ").skip(1);
    let inner = inner.map(|rest| rest.split("}}").next().unwrap().trim());
    inner
        .map(|target| match target.split_once(':') {
            Some((file, anchor)) => (file.to_owned(), Some(anchor.to_owned())),
            None => (target.to_owned(), None),
        })
        .collect()
}

/// The lines between the comments of an anchor.
fn anchored(file: &str, anchor: &str) -> String {
    let is = |line: &str, word: &str| line.trim().ends_with(&format!("{word}: {anchor}"));
    let lines = file.lines().skip_while(|line| !is(line, "ANCHOR"));
    let lines: Vec<&str> = lines.skip(1).collect();
    let end = lines.iter().position(|line| is(line, "ANCHOR_END"));
    lines[..end.unwrap_or(0)].join("\n")
}

#[test]
fn rust_code_comes_from_tests_and_examples() {
    let mut count = 0;
    for chapter in chapters() {
        let text = fs::read_to_string(&chapter).unwrap();
        for (file, anchor) in includes(&text) {
            let path = chapter.parent().unwrap().join(&file);
            let included = fs::read_to_string(&path);
            let included = included.unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            let place = format!("{}: {file}:{anchor:?}", chapter.display());
            if let Some(anchor) = &anchor {
                assert!(!anchored(&included, anchor).trim().is_empty(), "{place}");
            }
            if file.ends_with(".rs") {
                let path = fs::canonicalize(&path).unwrap();
                let path = path
                    .strip_prefix(fs::canonicalize(root()).unwrap())
                    .unwrap();
                let is_run = ["tests", "cli/tests", "examples"]
                    .iter()
                    .any(|directory| path.starts_with(directory));
                assert!(is_run, "{place}: no test runs this file");
                count += 1;
            }
        }
        let (_, blocks) = parts(&text);
        for block in blocks
            .iter()
            .filter(|block| block.language.starts_with("rust"))
        {
            let is_included = block
                .text
                .lines()
                .all(|line| line.starts_with("{{#include ") && line.ends_with("}}"));
            assert!(
                is_included && !block.text.is_empty(),
                "{}:{}: Rust code that no test compiles",
                chapter.display(),
                block.line
            );
        }
    }
    assert!(count > 0);
}

/// A home directory with the files of the book, in which the commands of a chapter run.
struct Home(tempfile::TempDir);

impl Home {
    fn new() -> Self {
        let home = tempfile::tempdir().unwrap();
        for entry in fs::read_dir(book().join("files")).unwrap() {
            let path = entry.unwrap().path();
            fs::copy(&path, home.path().join(path.file_name().unwrap())).unwrap();
        }
        Self(home)
    }

    fn shell(&self, line: &str) -> Command {
        let programs = Path::new(env!("CARGO_BIN_EXE_fipa")).parent().unwrap();
        let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
        let mut command = Command::new("sh");
        command
            .args(["-c", line])
            .current_dir(self.0.path())
            .env_clear()
            .env("PATH", path)
            .env("HOME", self.0.path())
            .env("FIPA_RUNTIME_DIR", self.0.path().join("run"))
            .stdin(Stdio::null());
        command
    }
}

/// The blocks of a chapter in a language.
fn blocks(chapter: &Path, language: &str) -> Vec<Block> {
    let (_, blocks) = parts(&fs::read_to_string(chapter).unwrap());
    blocks
        .into_iter()
        .filter(|block| block.language == language)
        .collect()
}

#[test]
fn the_commands_of_the_book_run() {
    let mut count = 0;
    for chapter in chapters() {
        let blocks = blocks(&chapter, "console");
        if blocks.is_empty() {
            continue;
        }
        let home = Home::new();
        let arm = Running::new(home.shell("exec fipa echo arm_1"));
        for block in blocks {
            for line in block.text.lines() {
                let place = format!("{}:{}: {line}", chapter.display(), block.line);
                let line = line.strip_prefix("$ ");
                let line = line.unwrap_or_else(|| panic!("{place}: no command"));
                let done = home.shell(line).output().unwrap();
                assert!(done.status.success(), "{place}: {done:?}");
                count += 1;
            }
        }
        let (code, log) = arm.signal("-INT");
        assert_eq!(code, Some(0), "{}: {log}", chapter.display());
    }
    assert!(count > 0);
}

#[test]
fn the_configurations_of_the_book_are_valid() {
    let mut count = 0;
    for chapter in chapters() {
        for block in blocks(&chapter, "toml") {
            let home = Home::new();
            fs::write(home.0.path().join("fipa.toml"), &block.text).unwrap();
            let done = home.shell("fipa config show").output().unwrap();
            let place = format!("{}:{}", chapter.display(), block.line);
            assert!(done.status.success(), "{place}: {done:?}");
            count += 1;
        }
    }
    assert!(count > 0);
}
