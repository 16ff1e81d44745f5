// The resources that agents lock, and the goals that they run.

import { element, link, span, table } from './elements.js';
import { goalTables } from './goals.js';

const COLUMNS = [
  { title: 'Resource' }, { title: 'Holder' }, { title: 'Lease', class: 'number' }, { title: 'Waiting' },
  { title: 'Owner', class: 'optional' }, { title: 'Fence', class: 'optional' },
];

function lockRow(row) {
  const more = row.waiting - row.waiters.length;
  const holder = row.holder ? link('agent', row.holder) : row.answered ? 'free' : 'unknown: the owner does not answer';
  return element('tr', { class: row.answered && !row.contested_by ? null : 'bad' },
    element('td', { class: 'name' }, row.resource,
      row.contested_by ? element('div', { class: 'bad-text' }, `contested by ${row.contested_by}`) : null),
    element('td', {}, holder),
    element('td', { class: 'number' }, row.lease_ms === null ? '' : span(row.lease_ms * 1000)),
    element('td', {}, row.waiters.map((name, index) => element('div', {}, `${index + 1}. `, link('agent', name))),
      more > 0 ? element('div', {}, `and ${more} more`) : null),
    element('td', { class: 'optional' }, row.owner ?? ''),
    element('td', { class: 'optional faint' }, row.fence ?? ''));
}

export function locks() {
  const { node, rows } = table('Resources with their holders, asked every two seconds', COLUMNS, lockRow);
  const none = element('p', { class: 'faint' }, 'no resource is owned in this domain');
  const goals = goalTables();
  const update = (sections) => {
    goals.update(sections);
    const all = Object.entries(sections.locks ?? {}).sort(([a], [b]) => (a < b ? -1 : 1));
    rows.show(all);
    node.hidden = all.length === 0;
    none.hidden = all.length > 0;
  };
  const page = element('div', { class: 'stack' },
    element('h2', {}, 'Locks'), element('div', { class: 'card' }, node, none),
    element('h2', {}, 'Actions'), goals.node);
  return { node: page, path: 'locks', update };
}
