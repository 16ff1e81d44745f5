//! Removal of the files of dead processes, and of what iceoryx2 leaves.

use std::collections::{HashMap, HashSet};
use std::fs::DirEntry;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

use iceoryx2::node::{NodeState, NodeView};
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::service::Service;
use rustix::fs::{AtFlags, Stat, fstat, lstat, unlinkat};

use super::{DomainFiles, files_in};
use crate::layout::Svc;
use crate::presence;
use crate::secret::{self, Secret};
use crate::shared_files::shared_files;

impl DomainFiles {
    /// Removes empty files of processes that were killed between creating a file and extending it.
    /// iceoryx2 0.10 waits without limit for such a file to grow. The caller must hold the lock,
    /// under which no other process creates connections or services.
    pub(super) fn remove_empty_files(&self, nodes: &[NodeState<Svc>], lock: &OwnedFd) {
        let prefix = self.prefix();
        let mut ports = Vec::new();
        for node in nodes {
            let NodeState::Dead(dead) = node else {
                continue;
            };
            let directory = self.config.root.join("nodes");
            let tags = files_in(&directory.join(dead.id().value().to_string()));
            ports.extend(tags.filter_map(|tag| self.id_of(&tag, ".port_tag")));
        }
        for file in shared_files() {
            let name = file.file_name();
            let name = name.to_string_lossy();
            let is_empty = || file.metadata().is_ok_and(|metadata| metadata.len() == 0);
            let nobody_makes_it = [".connection", ".dynamic", ".global_mgmt"]
                .iter()
                .any(|end| name.ends_with(end))
                || ports.iter().any(|port| name.contains(port));
            if name.starts_with(&prefix) && nobody_makes_it && is_empty() {
                self.remove_file(&file.path(), lock);
            }
        }
    }

    /// Removes the nodes whose process was killed while it created or removed them: iceoryx2 takes
    /// them for nodes that are being created, or for invalid ones. The caller must hold the lock,
    /// under which no process creates a node. A process that removes its node tolerates the help.
    pub(super) fn remove_partial_nodes(&self, nodes: &[NodeState<Svc>], lock: &OwnedFd) {
        let whole: HashSet<String> = nodes
            .iter()
            .filter_map(|node| match node {
                NodeState::Alive(node) => Some(node.id().value().to_string()),
                NodeState::Dead(node) => Some(node.id().value().to_string()),
                _ => None,
            })
            .collect();
        let prefix = self.prefix();
        for file in files_in(&self.config.root.join("nodes")) {
            let name = file.file_name();
            let name = name.to_string_lossy();
            // A directory is named by the number alone; the files that show whether the node is
            // alive are named by prefix, number and suffix.
            let id = name.strip_prefix(&prefix).unwrap_or(&name);
            let id = id.split('.').next().unwrap_or_default();
            if !id.is_empty() && id.bytes().all(|b| b.is_ascii_digit()) && !whole.contains(id) {
                self.remove_node(id, lock);
            }
        }
    }

    /// Removes the services that no node claims to use. A process leaves one if it is killed
    /// between creating a service and tagging it, or while it removes one. The caller must hold the
    /// lock, under which no process creates a service.
    ///
    /// iceoryx2 0.10 also leaves one if the process that removes the last node from a service is
    /// killed before it locks the service: a later process finds no node to remove, and so does not
    /// consider itself the last one.
    pub(super) fn remove_untagged_services(&self, lock: &OwnedFd) {
        // Without the complete list of used services, unused ones cannot be told apart.
        let Ok(used) = self.tagged(".service_tag") else {
            return;
        };
        let untagged: HashMap<String, PathBuf> = files_in(&self.services())
            .filter_map(|file| Some((self.id_of(&file, ".service")?, file.path())))
            .filter(|(service, _)| !used.contains(service))
            .collect();
        if untagged.is_empty() {
            return;
        }
        // Only the service's own file names its shared memory, so it is removed last.
        let mut ids = HashSet::new();
        let listed = Svc::list(&self.ice, |service| {
            let details = service.static_details;
            if untagged.contains_key(details.service_hash().as_str()) {
                ids.insert(details.unique_service_id().value().to_string());
            }
            match ids.len() < untagged.len() {
                true => CallbackProgression::Continue,
                false => CallbackProgression::Stop,
            }
        });
        if listed.is_err() {
            return;
        }
        let shared = shared_files().filter(|file| {
            let id = self.id_of(file, ".dynamic");
            id.is_some_and(|id| ids.contains(&id))
        });
        for file in shared.map(|file| file.path()).chain(untagged.into_values()) {
            self.remove_file(&file, lock);
        }
    }

    /// Removes connections of ports that no process has. iceoryx2 0.10 leaves one if a
    /// process is killed between creating its file and recording its own end: then neither end is
    /// the last to close. The caller must hold the lock, under which no process creates a port. A
    /// port is tagged before it connects, and as long as it exists.
    ///
    /// A living process that still has such a connection open keeps its memory and does not need
    /// the file.
    pub(super) fn remove_orphaned_connections(&self, lock: &OwnedFd) {
        // Without the complete list of ports, missing ones cannot be told apart.
        let Ok(ports) = self.tagged(".port_tag") else {
            return;
        };
        for file in shared_files() {
            let name = file.file_name();
            let name = name.to_string_lossy();
            let ends = name
                .strip_prefix(&self.prefix())
                .and_then(|name| name.strip_suffix(".connection"))
                .map(|name| name.rsplitn(3, '_'));
            let Some(mut ends) = ends else {
                continue;
            };
            if let (Some(receiver), Some(sender)) = (ends.next(), ends.next())
                && [sender, receiver].iter().any(|port| !ports.contains(*port))
            {
                self.remove_file(&file.path(), lock);
            }
        }
    }

    /// Identifiers in the tags with this suffix, of all nodes including dead ones.
    fn tagged(&self, end: &str) -> std::io::Result<HashSet<String>> {
        let mut tagged = HashSet::new();
        for node in std::fs::read_dir(self.config.root.join("nodes"))? {
            let node = node?;
            if !node.file_type()?.is_dir() {
                continue;
            }
            let tags = match std::fs::read_dir(node.path()) {
                Ok(tags) => tags,
                // The node was just removed.
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => continue,
                Err(e) => return Err(e),
            };
            for tag in tags {
                tagged.extend(self.id_of(&tag?, end));
            }
        }
        Ok(tagged)
    }

    /// The identifier in the name of a file of this domain with this suffix.
    fn id_of(&self, file: &DirEntry, end: &str) -> Option<String> {
        let name = file.file_name();
        let name = name.to_str()?.strip_prefix(&self.prefix())?;
        let id = name.strip_suffix(end)?.rsplit('_').next()?;
        Some(id.to_owned())
    }

    /// Removes the files of a node.
    pub(super) fn remove_node(&self, id: &str, lock: &OwnedFd) {
        let nodes = self.config.root.join("nodes");
        let name = format!("{}{id}.", self.prefix());
        self.remove_files(files_in(&nodes), &name, lock);
        self.remove_files(files_in(&nodes.join(id)), &self.prefix(), lock);
        self.remove_directory(&nodes.join(id), lock);
    }

    /// Removes all files with the domain's prefix, whatever secret follows it: processes may have been
    /// killed after another program had removed the secret. The caller holds the lock, and no process
    /// of the domain runs. Also removes what iceoryx2 leaves for the next process, and structures that
    /// it cannot interpret after a process was killed.
    pub(super) fn remove_all(&self, lock: &OwnedFd) {
        let prefix = format!("{}_", self.config.prefix);
        self.remove_files(shared_files(), &prefix, lock);
        for directory in ["nodes", "services", "processes"] {
            let directory = self.config.root.join(directory);
            for node in files_in(&directory) {
                self.remove_files(files_in(&node.path()), &prefix, lock);
                // Fails for a file, and for a directory with files of another prefix.
                self.remove_directory(&node.path(), lock);
            }
            self.remove_files(files_in(&directory), &prefix, lock);
            self.remove_directory(&directory, lock);
        }
        // The next process that starts uses a secret that could not be removed.
        self.remove_file(&secret::path(&self.config.root), lock);
    }

    /// Removes the files with this prefix.
    fn remove_files(&self, files: impl Iterator<Item = DirEntry>, prefix: &str, lock: &OwnedFd) {
        for file in files {
            if file.file_name().to_string_lossy().starts_with(prefix) {
                self.remove_file(&file.path(), lock);
            }
        }
    }

    /// Removes a file. If another program has removed the directory of the domain, other processes may have created
    /// it again, and the lock of the removed one says nothing about their files. So a file of the directory is removed
    /// from the one that is locked, and a file in `/dev/shm` only if the locked directory is still in its place.
    ///
    /// A failed removal is retried by the next cleanup.
    pub(super) fn remove_file(&self, path: &Path, lock: &OwnedFd) {
        if let Ok(name) = path.strip_prefix(&self.config.root) {
            let _ = unlinkat(lock, name, AtFlags::empty());
        } else if self.is_current(lock) {
            presence::remove_file(path);
        }
    }

    /// Removes an empty directory from the locked directory of the domain.
    fn remove_directory(&self, path: &Path, lock: &OwnedFd) {
        if let Ok(name) = path.strip_prefix(&self.config.root) {
            let _ = unlinkat(lock, name, AtFlags::REMOVEDIR);
        }
    }

    /// Whether the lock is that of the directory. If another program has removed the directory, other
    /// processes may have created it again, and the lock of the removed one says nothing about their
    /// files.
    pub(super) fn is_current(&self, lock: &OwnedFd) -> bool {
        let is_same = |(held, found): (Stat, Stat)| {
            (held.st_dev, held.st_ino) == (found.st_dev, found.st_ino)
        };
        let found = fstat(lock).and_then(|held| Ok((held, lstat(&self.config.root)?)));
        found.is_ok_and(is_same)
            && Secret::read(&self.config.root).is_ok_and(|secret| secret == self.secret)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ShmConfig;
    use fipa_transport::Incarnation;

    /// Another program moves the directory away while a process cleans up, and another process creates it again.
    #[test]
    fn a_cleanup_removes_no_file_of_a_directory_that_it_has_not_locked() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("shm");
        let prefix = format!("fipatest-cleanup-{}", std::process::id());
        let gone = Incarnation::from_u64(7);
        let config = ShmConfig::new(&root, prefix, gone);
        let (domain, lock) = DomainFiles::enter(&config).unwrap();
        let node = format!("{}1.details", domain.prefix());
        let files = || {
            let paths = domain.paths();
            let node = root.join("nodes").join(&node);
            vec![
                paths.liveness_fifo(gone),
                paths.doorbell(gone),
                node,
                secret::path(&root),
            ]
        };
        let create = || {
            for file in files() {
                std::fs::create_dir_all(file.parent().unwrap()).unwrap();
                if !file.exists() {
                    std::fs::write(file, "").unwrap();
                }
            }
            std::fs::write(domain.paths().status_page(gone), "").unwrap();
        };
        create();
        // After the file was found, and before it is removed.
        let moved = files_in(&root.join("nodes")).inspect(|_| {
            std::fs::rename(&root, directory.path().join("away")).unwrap();
            create();
        });
        domain.remove_files(moved, &domain.prefix(), &lock);
        assert!(!directory.path().join("away/nodes").join(&node).exists());
        let clean = |lock| {
            domain
                .paths()
                .remove(&[gone], |path| domain.remove_file(path, lock));
            domain.remove_node("1", lock);
            domain.remove_all(lock);
        };
        clean(&lock);
        for file in files()
            .into_iter()
            .chain([domain.paths().status_page(gone)])
        {
            assert!(file.exists(), "{}", file.display());
        }
        // The secret of the domain is in the directory now.
        std::fs::remove_file(secret::path(&root)).unwrap();
        domain.secret.as_ref().unwrap().store(&root).unwrap();
        clean(&domain.lock().unwrap());
        for file in files()
            .into_iter()
            .chain([domain.paths().status_page(gone)])
        {
            assert!(!file.exists(), "{}", file.display());
        }
    }
}
