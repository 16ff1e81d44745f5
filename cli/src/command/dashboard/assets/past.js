// The last minutes again: the domain at a time that a slider chooses.

import { clock, element, facts, link, problems, rate, span, table } from './elements.js';
import { chart } from './chart.js';
import { letterTable } from './letters.js';

/** The time that the slider covers, in seconds. */
const COVERED = 300;

/** The time before the chosen one of which events are listed, in seconds. */
const RECENT = 60;

/** Maximum number of names that are listed in a row. */
const MAX_NAMES = 20;

/** Minimum times between two questions for letters, in milliseconds: while the slider moves, and while time passes. */
const PACE = 250;
const PRESENT_PACE = 2000;

const atOf = (time) => Date.parse(time) / 1000;

/** Whether an agent was registered at the end of a second. */
function wasThere(row, at) {
  return atOf(row.registered) < at + 1 && (!row.ended || atOf(row.ended) > at + 1);
}

/** The state of the link with a host at a time, from the present one and the time since when it is so. */
function linkAt(host, now, at) {
  if (host.seconds === null) return 'does not answer';
  const isSince = now - host.seconds <= at;
  if (host.state === 'connected') return isSince ? 'connected' : 'not connected';
  return isSince ? 'lost' : 'connected';
}

const HOSTS = [{ title: 'Host' }, { title: 'Link' }, { title: 'Agents', class: 'number' }, { title: 'Names', class: 'optional' }];

function hostRow({ name, state, agents }) {
  const more = agents.length - MAX_NAMES;
  return element('tr', { class: state === 'lost' ? 'ended' : null },
    element('td', { class: 'name' }, name), element('td', { class: 'short' }, state),
    element('td', { class: 'number' }, String(agents.length)),
    element('td', { class: 'optional' }, agents.slice(0, MAX_NAMES).join(', '), more > 0 ? ` and ${more} more` : ''));
}

const EVENTS = [{ title: 'Time' }, { title: 'Event' }];

function eventRow({ at, name, text, isBad, isAgent }) {
  return element('tr', {}, element('td', { class: 'short' }, clock(at * 1000)),
    element('td', { class: isBad ? 'bad-text' : null }, isAgent ? link('agent', name) : name, ` ${text}`));
}

/** The events of the time before the chosen one, the newest first. */
function events(agents, hosts, now, at) {
  const found = [];
  const add = (key, event) => {
    if (event.at < at + 1 && event.at > at - RECENT) found.push([key, event]);
  };
  for (const [name, row] of agents) {
    add(`began ${name}`, { at: atOf(row.registered), name, text: 'registered', isAgent: true });
    if (row.ended) add(`ended ${name}`, { at: atOf(row.ended), name, text: 'ended', isBad: true, isAgent: true });
  }
  for (const [name, host] of hosts) {
    if (host.seconds === null) continue;
    const isLost = host.state !== 'connected';
    add(`host ${name}`, { at: now - host.seconds, name: `host ${name}`, text: isLost ? 'lost' : 'connected', isBad: isLost });
  }
  return found.sort(([, a], [, b]) => b.at - a.at).slice(0, 50);
}

const CONVERSATIONS = [{ title: 'Conversation' }, { title: 'Protocol' }, { title: 'Letters', class: 'number' }, { title: 'Problems' }];

function conversationRow(row) {
  return element('tr', { class: row.violations ? 'bad' : null },
    element('td', { class: 'name' }, link('conversation', row.id),
      element('div', { class: 'faint' }, [...row.names].join(', '))),
    element('td', {}, row.protocol ?? ''), element('td', { class: 'number' }, String(row.letters)),
    element('td', { class: 'bad-text' }, problems(row)));
}

/** The conversations of letters, which are the newest first. */
function conversationsOf(letters) {
  const found = new Map();
  for (const letter of letters) {
    if (!letter.conversation) continue;
    const row = found.get(letter.conversation)
      ?? { id: letter.conversation, protocol: null, names: [], letters: 0, violations: 0, failures: 0 };
    row.protocol ??= letter.protocol;
    for (const name of [letter.from, letter.to]) if (!row.names.includes(name)) row.names.push(name);
    row.letters += 1;
    row.violations += letter.violation ? 1 : 0;
    row.failures += letter.fate.outcome === 'failed' ? 1 : 0;
    found.set(letter.conversation, row);
  }
  return [...found];
}

function totals(point, at, agents, hosts) {
  const shown = [['Time', clock(at * 1000)], ['Agents', agents], ['Hosts', hosts], ['Letters/s', rate(point?.letters_per_second) || '–'], ['Not delivered/s', rate(point?.failures_per_second) || '–',
      point?.failures_per_second > 0], ['Delivery', span(point?.median_us) || '–']];
  return facts(shown);
}

export function past(start) {
  let chosen = /^\d+$/.test(start) ? Number(start) : null;
  let latest = {};
  const rates = chart();
  const slider = element('input', { type: 'range', name: 'time', step: 1 });
  const numbers = element('dl', { class: 'totals' });
  const hosts = table('Hosts at this time', HOSTS, hostRow);
  const recent = table('Agents and hosts in the minute before', EVENTS, eventRow);
  const quiet = element('p', { class: 'faint' }, 'nothing began or ended in the minute before');
  const talks = table('Conversations of the letters below', CONVERSATIONS, conversationRow);
  const talkBox = element('div', { class: 'card' }, talks.node);
  const since = element('p', { class: 'faint' });
  const letters = letterTable();

  let shownAt = null;
  let askedAt = -Infinity;
  let isAsking = false;
  /** Asks for the letters of the time, one question after the other. */
  const ask = async (at) => {
    const isDue = chosen !== null || performance.now() - askedAt >= PRESENT_PACE;
    if (isAsking || at === shownAt || !isDue) return;
    isAsking = true;
    askedAt = performance.now();
    const answer = await fetch(`api/past?at=${at}`).catch(() => null);
    if (answer?.ok) {
      const { letters: found, domain } = await answer.json();
      shownAt = at;
      const kept = domain.totals.since;
      since.textContent = !kept ? 'no letters since this page observes the domain'
        : Object.keys(found).length === 0 ? `no letters: the gateway has those since ${clock(kept)}`
          : `The newest 200 letters of this time. The gateway has those since ${clock(kept)}.`;
      letters.show(found);
      const newest = Object.values(found).sort((a, b) => b.number - a.number);
      const all = conversationsOf(newest);
      talks.rows.show(all);
      talkBox.hidden = all.length === 0;
    }
    setTimeout(() => {
      isAsking = false;
      draw();
    }, PACE);
  };

  const draw = () => {
    if (!node.isConnected) return;
    const times = Object.keys(latest.history ?? {}).map(Number).sort((a, b) => a - b);
    if (times.length === 0) return;
    const now = times.at(-1);
    const first = Math.max(times[0], now - COVERED);
    const at = chosen === null ? now : Math.min(Math.max(chosen, first), now);
    slider.min = first;
    slider.max = now;
    slider.value = at;
    const said = chosen === null ? 'now' : clock(at * 1000);
    if (slider.getAttribute('aria-valuetext') !== said) slider.setAttribute('aria-valuetext', said);
    follow.setAttribute('aria-pressed', String(chosen === null));
    rates.mark(at);
    rates.show(Object.fromEntries(Object.entries(latest.history).filter(([time]) => time >= first)));
    const own = latest.domain?.totals?.gateway ?? latest.domain?.totals?.host ?? 'this host';
    const peers = Object.entries(latest.hosts ?? {}).filter(([name]) => name !== own);
    const groups = new Map([[own, { name: own, state: 'this host', agents: [] }]]);
    for (const [name, host] of peers) groups.set(name, { name, state: linkAt(host, now, at), agents: [] });
    const agents = Object.entries(latest.agents ?? {});
    const present = agents.filter(([, row]) => !row.members && wasThere(row, at));
    for (const [name, row] of present) {
      const host = row.here ? own : row.host ?? 'another host';
      if (!groups.has(host)) groups.set(host, { name: host, state: 'known without a connection', agents: [] });
      groups.get(host).agents.push(name);
    }
    const connected = [...groups.values()].filter((row) => ['this host', 'connected'].includes(row.state));
    // A second may have no point of its own.
    const point = latest.history[times.findLast((time) => time <= at)];
    numbers.replaceChildren(...totals(point, at, present.length, connected.length));
    hosts.rows.show([...groups].filter(([, row]) => row.agents.length > 0 || row.state !== 'not connected'));
    const found = events(agents, peers, now, at);
    recent.rows.show(found);
    recent.node.hidden = found.length === 0;
    quiet.hidden = found.length > 0;
    ask(at);
  };

  const choose = (at) => {
    chosen = at;
    history.replaceState(null, '', at === null ? '#/past' : `#/past/${at}`);
    draw();
  };
  const step = (seconds) => () => choose(Math.min(Math.max(Number(slider.value) + seconds, Number(slider.min)), Number(slider.max)));
  slider.addEventListener('input', () => choose(Number(slider.value)));
  const button = (text, click, attributes = {}) => element('button', { type: 'button', on: { click }, ...attributes }, text);
  const follow = button('Now', () => choose(null), { 'aria-pressed': 'true' });
  const node = element('div', {},
    rates.node,
    element('form', { class: 'time', on: { submit: (event) => event.preventDefault() } },
      element('label', { class: 'wide-label' }, 'Time, the last five minutes', slider),
      button('10 s earlier', step(-10)), button('10 s later', step(10)), follow),
    numbers,
    element('div', { class: 'beside' }, element('div', { class: 'card' }, hosts.node),
      element('div', { class: 'card' }, recent.node, quiet)),
    element('h3', {}, 'Letters up to this time'), since, talkBox, letters.node);
  const update = (sections) => {
    latest = sections;
    draw();
  };
  return { node, path: 'fleet', update, close: rates.close };
}
