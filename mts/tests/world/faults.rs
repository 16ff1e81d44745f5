//! Faults with a start and an end: deaths, outages, stalls, changes of addresses.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{Incarnation, Kind};

use super::checks::Invariant;
use super::gates::Denied;
use super::{Breach, Event, PROCESSES, World};

/// Maximum time for which a sender keeps letters for an ended registration (rule 16 of the stream
/// protocol): letters for the next one wait for them.
pub(super) const ENDED: Duration = Duration::from_secs(2);

impl World {
    /// Every fault begins before the simulation heals.
    pub(super) fn plan_faults(&mut self) {
        let w = self.weather;
        type Fault = (u32, fn() -> Event);
        let faults: [Fault; 10] = [
            (w.deaths, || Event::Die),
            (w.gateway_deaths, || Event::GatewayDies),
            (w.closings, || Event::Close { gateway: false }),
            (w.gateway_closings, || Event::Close { gateway: true }),
            (w.restarts, || Event::Restart),
            (w.moves, || Event::Move),
            (w.partitions, || Event::CutOff),
            (w.stalls, || Event::Stall),
            (w.addresses, || Event::Readdress),
            (w.outages, || Event::Outage),
        ];
        for (count, fault) in faults {
            for _ in 0..count {
                let at = self.before_healing();
                self.at(at, fault());
            }
        }
    }

    pub(super) fn draw_denials(&mut self) {
        for _ in 0..self.weather.denials {
            let from = self.before_healing();
            let until = from + Duration::from_millis(self.random.u64(20..400));
            let host = self.random.usize(..self.weather.hosts);
            let name = format!("h{host}_p{}_0", self.random.usize(..PROCESSES));
            let gateway = self.random.usize(..self.weather.hosts);
            let name = name.as_str().into();
            self.denied.push((gateway, Denied { name, from, until }));
            self.fault_until(until);
        }
    }

    fn before_healing(&mut self) -> Instant {
        let active = (self.heals - self.start).as_micros() as u64;
        self.start + Duration::from_micros(self.random.u64(..active))
    }

    /// A process dies.
    pub(super) fn die(&mut self) -> Result<(), Breach> {
        let living: Vec<usize> = (0..self.processes.len())
            .filter(|&at| self.processes[at].alive && !self.processes[at].hostile)
            .collect();
        let Some(&dead) = self.random.choice(&living) else {
            return Ok(());
        };
        let returns = self.random.f64() < 0.8;
        self.kill(dead, returns)
    }

    /// A gateway is killed and started again.
    pub(super) fn gateway_dies(&mut self) -> Result<(), Breach> {
        let gateways = (0..self.processes.len()).filter(|at| {
            let process = &self.processes[*at];
            process.alive && process.gateway && !process.hostile
        });
        let gateways: Vec<usize> = gateways.collect();
        match self.random.choice(&gateways) {
            Some(&dead) => self.kill(dead, true),
            None => Ok(()),
        }
    }

    /// A robot process or a gateway abandons its letters in transit, refuses to send for a moment,
    /// and ends.
    pub(super) fn close(&mut self, gateway: bool) -> Result<(), Breach> {
        let open = (0..self.processes.len()).filter(|at| {
            let process = &self.processes[*at];
            process.alive
                && process.gateway == gateway
                && !process.hostile
                && process.closed.is_none()
        });
        let open: Vec<usize> = open.collect();
        let Some(&at) = self.random.choice(&open) else {
            return Ok(());
        };
        let now = self.clocks();
        self.processes[at].closed = Some(self.now);
        self.processes[at].core.give_up(now);
        self.carry_out(at)?;
        if self.processes[at].core.has_open_letters() {
            self.breach(Invariant::OneOutcome, || {
                "a closed service has open letters".into()
            });
        }
        let end = self.after_ms(100, Event::Closed { process: at });
        self.fault_until(end);
        Ok(())
    }

    pub(super) fn closed(&mut self, at: usize) -> Result<(), Breach> {
        match self.processes[at].alive {
            true => self.kill(at, true),
            false => Ok(()),
        }
    }

    /// A robot process is killed and restarted.
    pub(super) fn restart(&mut self) -> Result<(), Breach> {
        let robots: Vec<usize> = self.robots().collect();
        match self.random.choice(&robots) {
            Some(&dead) => self.kill(dead, true),
            None => Ok(()),
        }
    }

    /// The state of the process is gone, attempts to it break off, and after a moment the directory
    /// shows it.
    fn kill(&mut self, dead: usize, returns: bool) -> Result<(), Breach> {
        // Letters in its queues had been delivered: the guarantee ends there.
        for (_, agent) in self.processes[dead].agents.clone() {
            while self.take(dead, agent) {}
        }
        self.processes[dead].alive = false;
        self.part(dead);
        self.break_off(dead);
        let forgotten = Event::Forgotten {
            process: dead,
            returns,
        };
        let at = self.after_ms(200, forgotten);
        self.fault_until(at);
        Ok(())
    }

    /// The host of a dead process has noticed its death.
    pub(super) fn forgotten(&mut self, dead: usize, returns: bool) -> Result<(), Breach> {
        let process = &self.processes[dead];
        let (host, own) = (process.host, process.incarnation);
        let agents = process.agents.iter().map(|(_, agent)| *agent);
        let lives: Vec<Incarnation> = match process.gateway {
            true => vec![own],
            false => agents.collect(),
        };
        self.end_registrations(host, &lives);
        if returns {
            let pause = Duration::from_millis(self.random.u64(5..400));
            self.at(self.now + pause, Event::Reborn { process: dead });
            self.fault_until(self.now + pause);
        }
        Ok(())
    }

    pub(super) fn reborn(&mut self, dead: usize) -> Result<(), Breach> {
        let process = &self.processes[dead];
        let (host, gateway) = (process.host, process.gateway);
        let names: Vec<String> = match gateway {
            true => vec![format!("gateway{host}")],
            false => process.agents.iter().map(|(n, _)| n.to_string()).collect(),
        };
        let known = self.news_times(host);
        self.birth(host, gateway, &names, &known);
        self.tell(&known, Vec::new(), &[]);
        Ok(())
    }

    /// The gateway of a host gets another address of one kind.
    pub(super) fn readdress(&mut self) -> Result<(), Breach> {
        let host = self.random.usize(..self.weather.hosts);
        let kind = match self.random.bool() {
            true => Kind::Udp,
            false => Kind::Tcp,
        };
        let known = self.news_times(host);
        self.tell(&known, Vec::new(), &[]);
        self.registry.lock().readdress(host, kind, known);
        Ok(())
    }

    /// A host is disconnected from all others, for long enough that attempts time out.
    pub(super) fn cut_off(&mut self) {
        let host = self.random.usize(..self.weather.hosts);
        self.cut_off.insert(host);
        let end = self.after_ms(1500, Event::JoinedAgain { host });
        self.fault_until(end);
    }

    /// TCP between a host and the others stalls.
    pub(super) fn stall(&mut self) {
        let host = self.random.usize(..self.weather.hosts);
        let end = self.now + Duration::from_millis(self.random.u64(100..1500));
        let until = self.stalled.entry(host).or_insert(end);
        *until = (*until).max(end);
        self.fault_until(end);
    }

    /// One kind of transport stops working on one host.
    pub(super) fn outage(&mut self) {
        let host = self.random.usize(..self.weather.hosts);
        let kind = match self.random.u32(..3) {
            0 => Kind::Shm,
            1 => Kind::Tcp,
            _ => Kind::Udp,
        };
        self.down.insert((host, kind));
        let end = self.after_ms(800, Event::OutageEnds { host, kind });
        self.fault_until(end);
    }

    /// The time at which each host learns of an event on this host.
    pub(super) fn news_times(&mut self, host: usize) -> Vec<Instant> {
        let times = (0..self.weather.hosts).map(|other| {
            let most = match other == host {
                true => self.weather.lag_ms,
                false => self.weather.news_ms,
            };
            self.now + Duration::from_micros(self.random.u64(..=most * 1000))
        });
        times.collect()
    }

    /// Tells the processes of each host at its time that the directory has changed, and which
    /// entries have left it. `ended` has registrations that have ended.
    pub(super) fn tell(
        &mut self,
        times: &[Instant],
        departed: Vec<Vec<(usize, Arc<fipa_sds::Entry>)>>,
        ended: &[Incarnation],
    ) {
        let mut departed = departed.into_iter();
        for (host, time) in times.iter().enumerate() {
            let departed = departed.next().unwrap_or_default();
            let ended = ended.to_vec();
            let news = Event::News {
                host,
                departed,
                ended,
            };
            self.at(*time, news);
            self.fault_until(*time + ENDED);
        }
    }
}
