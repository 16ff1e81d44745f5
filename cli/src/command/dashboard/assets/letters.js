// The newest letters, with their ways.

import { clock, count, element, link, table } from './elements.js';

const COLUMNS = [
  { title: 'Time' }, { title: 'From' }, { title: 'To' }, { title: 'Message' }, { title: 'Way', class: 'optional' },
  { title: 'Outcome' },
];

const OUTCOMES = { under_way: 'under way', taken: 'received' };

function outcome(fate) {
  const attempts = (fate.attempts ?? []).map((attempt) =>
    element('li', {}, `${attempt.via} to ${attempt.location}: ${attempt.error}`));
  const text = element('span', { class: fate.outcome === 'failed' ? 'bad-text' : null },
    fate.reason ? `${fate.outcome}: ${fate.reason}` : OUTCOMES[fate.outcome] ?? fate.outcome);
  return attempts.length === 0 ? [text]
    : [text, element('details', {}, element('summary', {}, count(attempts.length, 'failed attempt')), element('ul', {}, attempts))];
}

function letterRow(row) {
  const way = [row.via, row.gateway ? `gateway ${row.gateway}` : null].filter(Boolean).join(', ');
  return element('tr', { class: row.violation || row.fate.outcome === 'failed' ? 'bad' : null },
    element('td', { class: 'short' }, clock(row.time)),
    element('td', {}, link('agent', row.from)), element('td', {}, link('agent', row.to)),
    element('td', {}, row.performative, row.protocol ? element('span', { class: 'faint' }, ` ${row.protocol}`) : null,
      row.conversation ? element('div', {}, link('conversation', row.conversation)) : null,
      row.violation ? element('div', { class: 'bad-text' }, row.violation) : null),
    element('td', { class: 'optional' }, way, element('div', { class: 'faint' }, `${row.size} bytes`)),
    element('td', { class: row.fate.reason ? null : 'short' }, outcome(row.fate)));
}

/** A table of letters, the newest first or, for a conversation, in order. */
export function letterTable(inOrder = false) {
  const { node, rows } = table(inOrder ? 'Letters in order' : 'Letters, the newest first', COLUMNS, letterRow);
  const direction = inOrder ? 1 : -1;
  return {
    node: element('div', { class: 'card' }, node),
    show(letters, isShown = () => true) {
      const all = Object.entries(letters).filter(([, row]) => isShown(row));
      rows.show(all.sort(([, a], [, b]) => direction * (a.number - b.number)));
    },
  };
}

export function letters() {
  const { node, show } = letterTable();
  let latest = {};
  const search = element('input', { type: 'search', name: 'search' });
  const onlyProblems = element('input', { type: 'checkbox', name: 'problems' });
  const pause = element('button', { type: 'button', 'aria-pressed': 'false' }, 'Pause');
  const isPaused = () => pause.getAttribute('aria-pressed') === 'true';
  const draw = () => {
    const text = search.value.toLowerCase();
    const isShown = (row) => (!onlyProblems.checked || row.violation || row.fate.outcome === 'failed')
      && [row.from, row.to, row.performative, row.protocol, row.conversation].join(' ').toLowerCase().includes(text);
    show(latest, isShown);
  };
  search.addEventListener('input', draw);
  onlyProblems.addEventListener('change', draw);
  pause.addEventListener('click', () => {
    pause.setAttribute('aria-pressed', String(!isPaused()));
    pause.textContent = isPaused() ? 'Continue' : 'Pause';
  });
  const form = element('form', { on: { submit: (event) => event.preventDefault() } },
    element('label', {}, 'Search names, messages, conversations', search),
    element('label', { class: 'line' }, onlyProblems, 'Only problems'), pause);
  const update = (sections) => {
    if (isPaused()) return;
    latest = { ...sections.letters };
    draw();
  };
  return { node: element('div', {}, form, node), path: 'letters', update };
}
