//! Agents that move from process to process, and mostly from host to host.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_sds::{Directory, Entry, Role};

use super::view::{Registered, View};
use super::{Breach, Event, World};

impl World {
    /// An agent leaves its process, which hands it what it had not read. Its host knows at once.
    pub(super) fn leave(&mut self) -> Result<(), Breach> {
        let movable: Vec<(usize, usize)> = self
            .robots()
            .flat_map(|at| (0..self.processes[at].agents.len()).map(move |agent| (at, agent)))
            .collect();
        let Some(&(at, agent)) = self.random.choice(&movable) else {
            return Ok(());
        };
        let (name, life) = self.processes[at].agents.remove(agent);
        let mut seen: Vec<Vec<(usize, Arc<Entry>)>> = vec![Vec::new(); self.weather.hosts];
        for process in 0..self.processes.len() {
            let entry = self.view(process).known_incarnation(life);
            let host = self.processes[process].host;
            seen[host].extend(entry.map(|entry| (process, entry)));
        }
        let times = self.news_times(self.processes[at].host);
        let mut registry = self.registry.lock();
        let mut entries = registry.entries.iter_mut();
        if let Some(entry) = entries.find(|entry| entry.incarnation == life) {
            entry.left.clone_from(&times);
        }
        drop(registry);
        while self.take(at, life)? {}
        self.processes[at].core.deregister(life);
        self.carry_out(at)?;
        for (host, departed) in seen.into_iter().enumerate() {
            self.at(times[host], Event::News { host, departed });
        }
        self.after_ms(3, Event::Settle { name });
        Ok(())
    }

    /// It is registered in another process, under the same name.
    pub(super) fn settle(&mut self, name: Arc<str>) -> Result<(), Breach> {
        let robots: Vec<usize> = self.robots().collect();
        let Some(&at) = self.random.choice(&robots) else {
            let later = self.now + Duration::from_millis(100);
            self.at(later, Event::Settle { name });
            return Ok(());
        };
        let life = self.incarnation();
        let known = self.news_times(self.processes[at].host);
        for (host, time) in known.iter().enumerate() {
            let departed = Vec::new();
            self.at(*time, Event::News { host, departed });
        }
        let process = &mut self.processes[at];
        process.core.register(Arc::clone(&name), life);
        process.agents.push((Arc::clone(&name), life));
        self.names.insert(life, Arc::clone(&name));
        self.registry.lock().entries.push(Registered {
            name,
            incarnation: life,
            host: process.host,
            mts: process.incarnation,
            role: Role::Agent,
            known,
            left: Vec::new(),
        });
        Ok(())
    }

    pub(super) fn news(
        &mut self,
        host: usize,
        departed: &[(usize, Arc<Entry>)],
    ) -> Result<(), Breach> {
        let now = self.clocks();
        for (at, entry) in departed {
            self.processes[*at].core.handle_departure(now, entry);
        }
        for at in 0..self.processes.len() {
            if self.processes[at].alive && self.processes[at].host == host {
                self.processes[at].core.handle_directory_change(now);
                self.carry_out(at)?;
            }
        }
        Ok(())
    }

    /// When something that happens on this host now is known on each.
    fn news_times(&mut self, host: usize) -> Vec<Instant> {
        let times = (0..self.weather.hosts).map(|other| {
            let most = if other == host {
                0
            } else {
                self.weather.news_ms
            };
            self.now + Duration::from_micros(self.random.u64(..=most * 1000))
        });
        times.collect()
    }

    fn robots(&self) -> impl Iterator<Item = usize> {
        let robot = |at: &usize| self.processes[*at].alive && !self.processes[*at].gateway;
        (0..self.processes.len()).filter(robot)
    }

    fn view(&self, at: usize) -> View {
        View {
            registry: Arc::clone(&self.registry),
            host: self.processes[at].host,
            gateway: self.processes[at].gateway,
        }
    }
}
