//! Agents that move between processes, usually to another host.

use std::sync::Arc;
use std::time::Duration;

use fipa_sds::{Directory, Entry, Reach, Role};
use fipa_transport::Incarnation;

use super::view::Registered;
use super::{Breach, Event, World};

impl World {
    /// An agent leaves its process, which returns its unread letters. Its host knows at once.
    pub(super) fn leave(&mut self) -> Result<(), Breach> {
        let movable: Vec<(usize, usize)> = self
            .robots()
            .flat_map(|at| (0..self.processes[at].agents.len()).map(move |agent| (at, agent)))
            .collect();
        let Some(&(at, agent)) = self.random.choice(&movable) else {
            return Ok(());
        };
        let (name, life) = self.processes[at].agents.remove(agent);
        self.trace(|| format!("{name} ({life}) leaves {at}"));
        while self.take(at, life) {}
        self.end_registrations(self.processes[at].host, &[life]);
        let now = self.clocks();
        self.processes[at].core.deregister(now, life);
        self.carry_out(at)?;
        let settles = self.after_ms(3, Event::Settle { name });
        self.fault_until(settles);
        Ok(())
    }

    /// These registrations, which were on this host, have ended.
    pub(super) fn end_registrations(&mut self, host: usize, lives: &[Incarnation]) {
        let mut seen: Vec<Vec<(usize, Arc<Entry>)>> = vec![Vec::new(); self.weather.hosts];
        for process in 0..self.processes.len() {
            if !self.processes[process].alive || self.processes[process].hostile {
                continue;
            }
            let host = self.processes[process].host;
            let view = self.view(process);
            let entries = lives
                .iter()
                .filter_map(|life| view.known_incarnation(*life));
            seen[host].extend(entries.map(|entry| (process, entry)));
            // The agents of a gateway leave with it.
            let all = view.entries();
            let behind = all.iter().filter(|entry| match entry.reach {
                Reach::Remote { gateway } => {
                    lives.contains(&gateway) && entry.incarnation != gateway
                }
                Reach::Local => false,
            });
            seen[host].extend(behind.map(|entry| (process, Arc::clone(entry))));
        }
        let times = self.news_times(host);
        for life in lives {
            self.registry.lock().end(*life, &times);
        }
        self.tell(&times, seen, lives);
    }

    /// The agent is registered in another process, under the same name.
    pub(super) fn settle(&mut self, name: Arc<str>) -> Result<(), Breach> {
        let robots: Vec<usize> = self.robots().collect();
        let Some(&at) = self.random.choice(&robots) else {
            let later = self.now + Duration::from_millis(100);
            self.at(later, Event::Settle { name });
            self.fault_until(later);
            return Ok(());
        };
        let life = self.incarnation();
        self.trace(|| format!("{name} ({life}) comes to {at}"));
        let known = self.news_times(self.processes[at].host);
        let process = &mut self.processes[at];
        process.core.register(Arc::clone(&name), life);
        process.agents.push((Arc::clone(&name), life));
        self.names.insert(life, Arc::clone(&name));
        self.honest.insert(life);
        self.registry.lock().register(Registered {
            name,
            incarnation: life,
            host: process.host,
            mts: process.incarnation,
            role: Role::Agent,
            since: self.now,
            ended: None,
            known: known.clone(),
            left_at: Vec::new(),
        });
        self.tell(&known, Vec::new(), &[]);
        Ok(())
    }

    /// The entries that the processes of a host have seen since these gateways ended, until now.
    fn came_and_left(
        &self,
        host: usize,
        departed: &[(usize, Arc<Entry>)],
        ended: &[Incarnation],
    ) -> Vec<(usize, Arc<Entry>)> {
        let mut late = Vec::new();
        self.registry.lock().now = Some(self.now - Duration::from_nanos(1));
        for at in 0..self.processes.len() {
            let process = &self.processes[at];
            if !process.alive || process.hostile || process.host != host {
                continue;
            }
            let all = self.view(at).entries();
            let unlisted = all.iter().filter(|entry| match entry.reach {
                Reach::Remote { gateway } => {
                    ended.contains(&gateway) && entry.incarnation != gateway
                }
                Reach::Local => false,
            });
            let is_told = |entry: &Entry| {
                departed.iter().any(|(by, entry_of_other)| {
                    *by == at && entry_of_other.incarnation == entry.incarnation
                })
            };
            late.extend(
                unlisted
                    .filter(|entry| !is_told(entry))
                    .map(|it| (at, Arc::clone(it))),
            );
        }
        self.registry.lock().now = Some(self.now);
        late
    }

    pub(super) fn news(
        &mut self,
        host: usize,
        mut departed: Vec<(usize, Arc<Entry>)>,
        ended: &[Incarnation],
    ) -> Result<(), Breach> {
        let now = self.clocks();
        departed.extend(self.came_and_left(host, &departed, ended));
        for (at, entry) in &departed {
            self.processes[*at].core.handle_departure(now, entry);
        }
        for at in 0..self.processes.len() {
            let process = &self.processes[at];
            if process.alive && !process.hostile && process.host == host {
                self.processes[at].core.handle_directory_change(now);
                self.carry_out(at)?;
            }
        }
        Ok(())
    }
}
