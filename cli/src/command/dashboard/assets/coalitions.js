// Coalitions as groups of agents.

import { clock, element, link, table } from './elements.js';

/** Maximum number of coalitions of which the members are shown. */
const MAX_SHOWN = 24;

const COLUMNS = [{ title: 'Member' }, { title: 'Host' }];

function memberRow({ name, isLeader, state, isBad }) {
  return element('tr', {},
    element('td', { class: 'name' }, link('agent', name), ' ', isLeader ? element('span', { class: 'tag' }, 'leader') : null),
    element('td', { class: isBad ? 'bad-text' : null }, state));
}

class Coalition {
  constructor(name) {
    this.title = element('span', {});
    this.about = element('p', {});
    const { node, rows } = table(`Members of ${name}`, COLUMNS, memberRow);
    this.rows = rows;
    this.node = element('section', { class: 'card', 'aria-label': `Coalition ${name}` },
      element('h3', {}, link('agent', name)), this.about, node);
  }

  show(row, agents, own) {
    const about = row.ended ? `ended ${clock(row.ended)}`
      : `letters go to ${row.leader ? `the leader ${row.leader}` : 'all members'}`;
    if (this.about.textContent !== about) this.about.textContent = about;
    this.node.classList.toggle('lost', Boolean(row.ended));
    const members = row.members.map((name) => {
      const member = agents[name];
      let [state, isBad] = ['not in the directory', true];
      if (member?.ended) state = `ended ${clock(member.ended)}`;
      else if (member) [state, isBad] = [member.here ? own : member.host ?? 'another host', false];
      return [name, { name, isLeader: name === row.leader, state, isBad }];
    });
    members.sort(([a], [b]) => (a === row.leader ? -1 : b === row.leader ? 1 : a < b ? -1 : 1));
    this.rows.show(members);
  }
}

/** The members of the coalition that a view shows. */
export function members() {
  const node = element('p', { hidden: true });
  let shown = '';
  const show = (row) => {
    node.hidden = !row?.members;
    const text = JSON.stringify([row?.members, row?.leader]);
    if (text === shown) return;
    shown = text;
    node.replaceChildren('Members: ', ...(row?.members ?? []).flatMap((name, index) =>
      [index === 0 ? '' : ', ', link('agent', name), name === row.leader ? ' (leader)' : '']));
  };
  return { node, show };
}

/** The coalitions except the owners of locks, each with its members, the leader first. */
export function coalitions() {
  const grid = element('div', { class: 'hosts' });
  const more = element('p', { class: 'faint', hidden: true });
  const node = element('section', { 'aria-label': 'Coalitions', hidden: true }, element('h2', {}, 'Coalitions'), grid, more);
  const cards = new Map();
  return {
    node,
    show(agents, own) {
      const all = Object.entries(agents).filter(([name, row]) => row.members && !name.startsWith('lock:')).sort(([a], [b]) => (a < b ? -1 : 1));
      const shown = new Map(all.slice(0, MAX_SHOWN));
      for (const [name, card] of cards) {
        if (!shown.has(name)) {
          card.node.remove();
          cards.delete(name);
        }
      }
      for (const [name, row] of shown) {
        if (!cards.has(name)) {
          cards.set(name, new Coalition(name));
          grid.append(cards.get(name).node);
        }
        cards.get(name).show(row, agents, own);
      }
      node.hidden = all.length === 0;
      more.hidden = all.length <= MAX_SHOWN;
      more.textContent = `and ${all.length - MAX_SHOWN} more, in the tables of their hosts`;
    },
  };
}
