//! Cuts of power at each step of a change, with a file system that keeps no more than it must.
//!
//! The change runs on a real directory, and its steps are recorded. A cut after some of them keeps what was synced. Of
//! the rest it keeps a random part: contents in full, in part, as zeros or not at all, and any of the later changes of
//! directories without the earlier ones. What it keeps is written to another directory, which is then read as after a
//! start.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::{DirBuilderExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

/// Number of random remainders of each cut.
const ROUNDS: u64 = 180;

/// A step of a change.
#[derive(Debug, Clone)]
pub(super) enum Step {
    Write(PathBuf, Vec<u8>),
    Sync(PathBuf),
    Link(PathBuf, PathBuf),
    Rename(PathBuf, PathBuf),
    Remove(PathBuf),
    Directory(PathBuf),
    SyncDirectory(PathBuf),
}

thread_local! {
    static RECORDED: RefCell<Option<Vec<Step>>> = const { RefCell::new(None) };
}

/// Records a step of this thread, while a change is recorded.
pub(super) fn record(step: Step) {
    RECORDED.with_borrow_mut(|recorded| {
        if let Some(steps) = recorded {
            steps.push(step);
        }
    });
}

/// Runs a change in a directory that `before` has filled, and cuts it at each step. `after` examines the directory of
/// each cut, and gets the value of the change if the cut came after its end. Returns the number of cuts.
pub(crate) fn of<T>(
    before: impl FnOnce(&Path),
    change: impl FnOnce(&Path) -> T,
    after: impl Fn(&Path, Option<&T>),
) -> u64 {
    let scene = tempfile::tempdir().unwrap();
    before(scene.path());
    let start = Disk::of(scene.path());
    RECORDED.set(Some(Vec::new()));
    let value = change(scene.path());
    let steps = RECORDED.take().unwrap_or_default();
    assert!(!steps.is_empty(), "the change has no steps");
    let mut cuts = 0;
    for done in 0..=steps.len() {
        for round in 0..ROUNDS {
            let mut disk = start.clone();
            for step in &steps[..done] {
                disk.apply(scene.path(), step);
            }
            let remains = tempfile::tempdir().unwrap();
            let mut random = fastrand::Rng::with_seed(round << 32 | done as u64);
            disk.write(remains.path(), &mut random);
            after(remains.path(), (done == steps.len()).then_some(&value));
            cuts += 1;
        }
    }
    cuts
}

/// A file system, with paths relative to its root.
#[derive(Debug, Clone, Default)]
struct Disk {
    files: Vec<Stored>,
    changes: Vec<Change>,
}

#[derive(Debug, Clone)]
struct Stored {
    bytes: Vec<u8>,
    is_synced: bool,
}

/// A change of directory entries.
#[derive(Debug, Clone)]
struct Change {
    entries: Vec<(PathBuf, Option<Node>)>,
    /// The directories that are to be synced before it is sure.
    unsynced: BTreeSet<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Node {
    Directory,
    /// A file, by its index.
    File(usize),
}

impl Disk {
    /// A file system with the synced contents of a directory.
    fn of(root: &Path) -> Self {
        let mut disk = Self::default();
        disk.add_below(root, root);
        disk.changes.iter_mut().for_each(|it| it.unsynced.clear());
        disk
    }

    fn add_below(&mut self, root: &Path, directory: &Path) {
        for entry in fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                self.apply(root, &Step::Directory(path.clone()));
                self.add_below(root, &path);
            } else {
                let bytes = fs::read(&path).unwrap();
                self.apply(root, &Step::Write(path.clone(), bytes));
                self.apply(root, &Step::Sync(path));
            }
        }
    }

    fn apply(&mut self, root: &Path, step: &Step) {
        let below = |path: &Path| path.strip_prefix(root).unwrap().to_owned();
        match step {
            Step::Write(path, bytes) => {
                let node = Node::File(self.files.len());
                self.files.push(Stored {
                    bytes: bytes.clone(),
                    is_synced: false,
                });
                self.change(vec![(below(path), Some(node))]);
            }
            Step::Sync(path) => {
                if let Some(Node::File(file)) = self.node(&below(path)) {
                    self.files[file].is_synced = true;
                }
            }
            Step::Link(from, to) => {
                let node = self.node(&below(from));
                self.change(vec![(below(to), node)]);
            }
            Step::Rename(from, to) => {
                let node = self.node(&below(from));
                self.change(vec![(below(to), node), (below(from), None)]);
            }
            Step::Remove(path) => self.change(vec![(below(path), None)]),
            Step::Directory(path) => self.change(vec![(below(path), Some(Node::Directory))]),
            Step::SyncDirectory(directory) => {
                let directory = below(directory);
                for change in &mut self.changes {
                    change.unsynced.remove(&directory);
                }
            }
        }
    }

    fn change(&mut self, entries: Vec<(PathBuf, Option<Node>)>) {
        let parents = entries.iter().filter_map(|(path, _)| path.parent());
        let unsynced = parents.map(Path::to_owned).collect();
        self.changes.push(Change { entries, unsynced });
    }

    fn node(&self, path: &Path) -> Option<Node> {
        let entries = self.changes.iter().rev().flat_map(|it| &it.entries);
        entries.clone().find(|(it, _)| it == path)?.1
    }

    /// Writes what remains after a cut.
    fn write(&self, root: &Path, random: &mut fastrand::Rng) {
        let mut nodes: BTreeMap<&Path, Node> = BTreeMap::new();
        for change in &self.changes {
            if !change.unsynced.is_empty() && random.bool() {
                continue;
            }
            for (path, node) in &change.entries {
                match node {
                    Some(node) => nodes.insert(path, *node),
                    None => nodes.remove(path.as_path()),
                };
            }
        }
        let root_mode = fs::Permissions::from_mode(0o700);
        fs::set_permissions(root, root_mode).unwrap();
        // Directories precede their files. A file in a directory that is lost is lost, too.
        for (path, node) in nodes {
            let path = root.join(path);
            if !path.parent().unwrap().is_dir() {
                continue;
            }
            match node {
                Node::Directory => fs::DirBuilder::new().mode(0o700).create(path).unwrap(),
                Node::File(file) => {
                    fs::write(&path, self.files[file].remainder(random)).unwrap();
                    fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
                }
            }
        }
    }
}

impl Stored {
    fn remainder(&self, random: &mut fastrand::Rng) -> Vec<u8> {
        let mut bytes = self.bytes.clone();
        if !self.is_synced {
            let kept = random.usize(..=bytes.len());
            match random.u8(..3) {
                0 => bytes.truncate(kept),
                1 => bytes[kept..].fill(0),
                _ => {}
            }
        }
        bytes
    }
}

/// A writer that syncs nothing is found.
#[test]
fn an_unsynced_change_is_lost_at_some_cut() {
    let lost = std::cell::Cell::new(false);
    let rename_without_sync = |root: &Path| {
        let (new, file) = (root.join("file.new"), root.join("file"));
        fs::write(&new, "after").unwrap();
        record(Step::Write(new.clone(), b"after".to_vec()));
        fs::rename(&new, &file).unwrap();
        record(Step::Rename(new, file));
    };
    of(
        |root| fs::write(root.join("file"), "before").unwrap(),
        rename_without_sync,
        |root, _| {
            let read = fs::read(root.join("file")).unwrap_or_default();
            lost.set(lost.get() || (read != b"before" && read != b"after"));
        },
    );
    assert!(lost.get());
}
