// Hosts with their agents, and one agent.

import { clock, count, element, facts, link, longTable, problems, rate, seconds, span, table } from './elements.js';
import { chart } from './chart.js';
import { coalitions, members } from './coalitions.js';
import { conversationTable } from './conversations.js';
import { letterTable } from './letters.js';
import { post } from './live.js';
import { offers } from './offers.js';

/** Median time of letters to another host from which a link counts as slow, in microseconds. */
const SLOW = 100_000;
/** Maximum number of ended agents above the hosts. */
const MAX_ENDED = 5;

const COLUMNS = [
  { title: 'Agent' },
  { title: 'Sent/s', class: 'number' },
  { title: 'Received/s', class: 'number' },
  { title: 'Delivery', class: 'number optional' },
  { title: 'Problems' },
];

function agentRow(row) {
  const number = (value, isOptional = false) =>
    element('td', { class: isOptional ? 'number optional' : 'number' }, value);
  const about = row.members
    ? `coalition of ${row.members.length}${row.leader ? `, led by ${row.leader}` : ', without a leader'}`
    : row.type;
  const name = element('td', { class: 'name' }, link('agent', row.name),
    row.ended ? element('span', {}, ` ended ${clock(row.ended)}`) : null,
    about ? element('div', { class: 'faint' }, about) : null);
  return element('tr', { class: row.ended ? 'ended' : null }, name,
    number(rate(row.sent_per_second)), number(rate(row.received_per_second)), number(span(row.median_us), true),
    element('td', { class: 'bad-text' }, problems(row)));
}

/** The text about the link with another host. */
function aboutLink(host) {
  const parts = [];
  if (host.state === 'connected') parts.push(`connected for ${seconds(host.seconds)}`);
  if (host.transports.length) parts.push(host.transports.join(', '));
  if (host.encrypted !== null) parts.push(host.encrypted ? 'encrypted' : 'not encrypted');
  if (host.median_us !== null) parts.push(`letters take ${span(host.median_us)} (99 %: ${span(host.p99_us)})`);
  if (host.retries > 0) parts.push(count(host.retries, 'failed attempt'));
  return parts.join(' · ');
}

class HostCard {
  constructor(name, isOwn) {
    this.isOwn = isOwn;
    this.state = element('p', {});
    const agents = longTable(isOwn ? 'Agents of this host' : `Agents of ${name}`, COLUMNS, agentRow);
    this.agents = agents.rows;
    this.none = element('p', { class: 'faint' }, 'no agents');
    this.node = element('section', { class: 'card', 'aria-label': name },
      element('h2', {}, name, isOwn ? element('span', { class: 'faint' }, ' (this host)') : null),
      this.state, agents.node, this.none);
    this.table = agents.node;
  }

  show(host, rows) {
    const lost = host && host.state !== 'connected';
    this.node.classList.toggle('lost', Boolean(lost));
    this.state.className = lost || host?.median_us >= SLOW ? 'bad-text' : '';
    let text = this.isOwn ? 'the gateway of this page' : 'known without a connection';
    if (lost) text = host.state === 'lost' ? `LOST ${seconds(host.seconds)} ago` : 'does not answer';
    else if (host) text = aboutLink(host);
    if (this.state.textContent !== text) this.state.textContent = text;
    this.agents.show(rows);
    this.table.hidden = rows.length === 0;
    this.none.hidden = rows.length > 0;
  }
}

function totals(values) {
  const shown = [
    ['Agents', values.agents_here + values.agents_elsewhere],
    ['Letters/s', rate(values.letters_per_second)],
    ['Delivery', span(values.median_us) || '–'],
    ['Not delivered', values.failures, 'letters'],
    ['Violations', values.violations, 'conversations'],
  ];
  return facts(shown.map(([name, value, view]) =>
    [name, view && value > 0 ? element('a', { href: `#/${view}`, class: 'bad-text' }, value) : value]));
}

/** Hosts that are lost or slow, and agents that have ended, except commands of fipa. */
function alerts(hosts, agents) {
  const all = [];
  for (const [name, host] of Object.entries(hosts)) {
    if (host.state !== 'connected') all.push([`${name} `, host.state === 'lost' ? `has been lost for ${seconds(host.seconds)}` : 'does not answer']);
    else if (host.median_us >= SLOW) all.push([`Letters to ${name} are slow: they take ${span(host.median_us)}`]);
  }
  const ended = Object.values(agents).filter((row) => row.ended && !row.type?.startsWith('fipa-'));
  ended.sort((a, b) => (a.ended < b.ended ? 1 : -1));
  for (const row of ended.slice(0, MAX_ENDED)) {
    all.push([link('agent', row.name), ` on ${row.here ? 'this host' : row.host ?? 'another host'} ended ${clock(row.ended)}`]);
  }
  if (ended.length > MAX_ENDED) all.push([`${count(ended.length - MAX_ENDED, 'further agent')} ended`]);
  return all.map((parts) => element('li', {}, ...parts));
}

export function fleet() {
  const numbers = element('dl', { class: 'totals' });
  const problemList = element('ul', { class: 'card alerts', 'aria-label': 'Problems' });
  const rates = chart();
  const hosts = element('div', { class: 'hosts' });
  const groups = coalitions();
  const cards = new Map();
  const none = Object.create(null);
  const update = ({ domain, hosts: peers = none, agents = none, history = none }) => {
    const values = domain?.totals;
    if (values?.host === undefined) return;
    document.getElementById('title').textContent = `${values.domain} on ${values.host}`;
    numbers.replaceChildren(...totals(values));
    const found = alerts(peers, agents);
    problemList.hidden = found.length === 0;
    const isShown = found.length === problemList.childElementCount
      && found.every((item, index) => item.isEqualNode(problemList.children[index]));
    if (!isShown) problemList.replaceChildren(...found);
    rates.show(history);
    const own = values.gateway ?? values.host;
    groups.show(agents, own);
    const rowsOf = new Map([[own, []]]);
    for (const name of Object.keys(peers).sort()) if (name !== own) rowsOf.set(name, []);
    for (const [key, row] of Object.entries(agents)) {
      const host = row.here ? own : row.host ?? 'another host';
      if (!rowsOf.has(host)) rowsOf.set(host, []);
      rowsOf.get(host).push([key, row]);
    }
    for (const [name, rows] of rowsOf) {
      if (!cards.has(name)) {
        const card = new HostCard(name, name === own);
        cards.set(name, card);
        hosts.append(card.node);
      }
      rows.sort(([a], [b]) => (a < b ? -1 : 1));
      cards.get(name).show(peers[name], rows);
    }
    for (const [name, card] of cards) {
      if (!rowsOf.has(name)) {
        card.node.remove();
        cards.delete(name);
      }
    }
  };
  return { node: element('div', {}, numbers, problemList, rates.node, groups.node, hosts), path: 'fleet', update, close: rates.close };
}

const PERFORMATIVES = ['request', 'inform', 'query-ref', 'query-if', 'cancel', 'subscribe', 'cfp', 'accept-proposal',
  'reject-proposal', 'agree', 'refuse', 'failure', 'not-understood'];

/** A form that sends a message to an agent. Everything that it does is seen in the fleet. */
function messageForm(to) {
  const field = (title, node) => element('label', {}, title, node);
  const input = (name) => element('input', { name, autocomplete: 'off' });
  const [protocol, conversation] = [input('protocol'), input('conversation')];
  const performative = element('select', { name: 'performative' },
    PERFORMATIVES.map((name) => element('option', { value: name }, name)));
  const content = element('textarea', { name: 'content', rows: 2, cols: 40 });
  const result = element('p', { role: 'status' });
  const submit = async (event) => {
    event.preventDefault();
    result.textContent = 'sending';
    const order = { to, performative: performative.value };
    for (const { name, value } of [protocol, conversation, content]) if (value) order[name] = value;
    const answer = await post('api/send', order);
    if (!answer.ok) result.textContent = (await answer.text()).trim();
    else {
      const { deliveries } = await answer.json();
      result.textContent = deliveries.map((one) => `${one.receiver}: ${one.outcome} ${one.reason ?? `via ${one.via}`}`).join('; ');
    }
  };
  return element('details', { class: 'card', hidden: true },
    element('summary', {}, `Send a message to ${to}`),
    element('form', { on: { submit } }, field('Performative', performative), field('Protocol', protocol),
      field('Conversation', conversation), field('Content', content), element('button', {}, 'Send')),
    result);
}

function partnerRow(row) {
  return element('tr', {}, element('td', { class: 'name' }, link('agent', row.name)),
    element('td', { class: 'number' }, String(row.sent)), element('td', { class: 'number' }, String(row.received)),
    element('td', { class: 'bad-text' }, problems(row)));
}

function reasonRow(row) {
  return element('tr', {}, element('td', {}, row.reason),
    element('td', { class: 'number bad-text' }, String(row.failures)));
}

export function agent(name, topic) {
  const partners = table('Among the newest letters', [{ title: 'Partner' }, { title: 'Sent to', class: 'number' },
    { title: 'Received from', class: 'number' }, { title: 'Problems' }], partnerRow);
  const reasons = table('Letters of this agent that were not delivered', [{ title: 'Reason' },
    { title: 'Letters', class: 'number' }], reasonRow);
  const reasonBox = element('div', { class: 'card' }, reasons.node);
  const form = messageForm(name);
  const about = element('dl', { class: 'totals' });
  const talks = conversationTable();
  const letters = letterTable();
  const offer = offers(name);
  const group = members();
  const node = element('div', {},
    element('h2', {}, name), about, group.node, form, offer.node,
    element('h3', {}, 'Partners'), element('div', { class: 'beside' },
      element('div', { class: 'card' }, partners.node), reasonBox),
    element('h3', {}, 'Conversations'), talks.node, element('h3', {}, 'Letters'), letters.node);
  const update = (sections) => {
    const row = sections.agent?.[name];
    form.hidden = !sections.domain?.totals?.control;
    const known = row
      ? [['Host', row.host ?? 'this host'], ['Type', row.type || '–'], ['Since', clock(row.registered)],
        ['State', row.ended ? `ended ${clock(row.ended)}` : 'in the directory', Boolean(row.ended)]]
      : [['State', 'not in the directory', true]];
    about.replaceChildren(...facts(known));
    group.show(row);
    offer.update(sections);
    partners.rows.show(Object.entries(sections.partners ?? {}));
    reasons.rows.show(Object.entries(sections.reasons ?? {}));
    reasonBox.hidden = Object.keys(sections.reasons ?? {}).length === 0;
    talks.show(sections.conversations ?? {});
    letters.show(sections.letters ?? {});
  };
  const choice = topic ? `&topic=${encodeURIComponent(topic)}` : '';
  return { node, path: `agent?name=${encodeURIComponent(name)}${choice}`, update };
}
