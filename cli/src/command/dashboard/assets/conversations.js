// All conversations, and one as a sequence diagram.

import { clock, drawing, element, facts, link, problems, table } from './elements.js';
import { letterTable } from './letters.js';

const COLUMNS = [
  { title: 'Conversation' }, { title: 'Protocol' }, { title: 'State' }, { title: 'Letters', class: 'number' },
  { title: 'Problems' }, { title: 'Last', class: 'optional' },
];

function conversationRow(row) {
  return element('tr', { class: row.violations ? 'bad' : null },
    element('td', { class: 'name' }, link('conversation', row.id),
      element('div', { class: 'faint' }, row.participants.join(', '))),
    element('td', {}, row.protocol ?? ''),
    element('td', {}, row.state ?? '', row.complete ? element('span', { class: 'good-text' }, ' complete') : null),
    element('td', { class: 'number' }, String(row.letters)),
    element('td', { class: 'bad-text' }, problems(row)),
    element('td', { class: 'optional' }, clock(row.last)));
}

/** A table of conversations: those with violations first, then those with the newest letters. */
export function conversationTable() {
  const { node, rows } = table('Conversations, those with violations first', COLUMNS, conversationRow);
  const none = element('p', { class: 'faint' }, 'no conversation since this page observes the domain');
  return {
    node: element('div', { class: 'card' }, node, none),
    show(conversations) {
      const all = Object.entries(conversations);
      const order = ([, a], [, b]) =>
        Number(b.violations > 0) - Number(a.violations > 0) || (a.last < b.last ? 1 : a.last > b.last ? -1 : 0);
      rows.show(all.sort(order));
      node.hidden = all.length === 0;
      none.hidden = all.length > 0;
    },
  };
}

export function conversations() {
  const { node, show } = conversationTable();
  return { node, path: 'conversations', update: (sections) => show(sections.conversations ?? {}) };
}

const LANE = 190;
const TOP = 52;
const STEP = 46;
const TIME = 76;

/** The sequence diagram of letters in order. */
function sequence(letters) {
  const names = [];
  for (const letter of letters) for (const name of [letter.from, letter.to]) if (!names.includes(name)) names.push(name);
  const x = (name) => TIME + LANE / 2 + names.indexOf(name) * LANE;
  const width = TIME + names.length * LANE;
  const height = TOP + letters.length * STEP + 16;
  const lanes = names.flatMap((name) => [
    drawing('line', { class: 'lifeline', x1: x(name), x2: x(name), y1: 34, y2: height }),
    drawing('rect', { class: 'box', x: x(name) - LANE / 2 + 8, y: 4, width: LANE - 16, height: 30, rx: 6 }),
    drawing('text', { x: x(name), y: 24, 'text-anchor': 'middle' }, name.length > 22 ? `${name.slice(0, 21)}…` : name),
  ]);
  const arrows = letters.map((letter, index) => {
    const y = TOP + index * STEP + 18;
    const [from, to] = [x(letter.from), x(letter.to)];
    const isWrong = Boolean(letter.violation) || letter.fate.outcome === 'failed';
    const label = `${letter.performative}${letter.via && letter.via !== 'shm' ? ` (${letter.via})` : ''}`;
    const note = letter.violation ?? (letter.fate.outcome === 'failed' ? `not delivered: ${letter.fate.reason}` : '');
    const direction = to >= from ? 1 : -1;
    const path = from === to ? `M${from} ${y} h36 v14 h-30` : `M${from} ${y} H${to - direction * 8}`;
    const head = from === to
      ? `M${from + 2} ${y + 14} l8 -5 v10 z` : `M${to} ${y} l${-direction * 10} -5 v10 z`;
    return drawing('g', { class: isWrong ? 'wrong' : '' },
      drawing('title', {}, `${letter.from} to ${letter.to}: ${label}${note ? `. ${note}` : ''}`),
      drawing('text', { class: 'time', x: 4, y: y + 4 }, clock(letter.time)),
      drawing('path', { class: 'arrow', d: path, 'stroke-dasharray': letter.fate.outcome === 'failed' ? '6 4' : null }),
      drawing('path', { class: 'head', d: head }),
      drawing('text', { x: from === to ? from + 44 : (from + to) / 2, y: y - 6, 'text-anchor': from === to ? 'start' : 'middle' },
        isWrong ? `✗ ${label}` : label));
  });
  return drawing('svg', {
    class: 'sequence', width, height, viewBox: `0 0 ${width} ${height}`, role: 'img',
    'aria-label': `Sequence diagram of ${letters.length} letters; the table below has the same letters`,
  }, lanes, arrows);
}

/** The state machine of the protocol of a conversation, with its state. The facts above have the same as text. */
function showMachine(machine, box, row) {
  box.hidden = !row?.protocol || machine.dataset.missing === row.protocol;
  if (box.hidden) return;
  const address = `api/protocol.svg?name=${encodeURIComponent(row.protocol)}&state=${encodeURIComponent(row.state ?? '')}`;
  if (machine.getAttribute('src') === address) return;
  machine.onerror = () => {
    machine.dataset.missing = row.protocol;
    box.hidden = true;
  };
  machine.alt = `State machine of ${row.protocol}, in state ${row.state ?? 'unknown'}`;
  machine.src = address;
}

export function conversation(id) {
  const about = element('dl', { class: 'totals' });
  const found = element('div', { role: 'status' });
  const diagram = element('div', { class: 'card wide' });
  const machine = element('img', { alt: '' });
  const machineBox = element('div', { class: 'card wide machine', hidden: true }, machine);
  const letters = letterTable(true);
  const node = element('div', {}, element('h2', {}, id), about, found,
    element('div', { class: 'beside' }, diagram, machineBox),
    element('details', { open: true }, element('summary', {}, 'The letters as a table'), letters.node));
  const update = (sections) => {
    const row = sections.conversation?.[id];
    const all = Object.values(sections.letters ?? {}).sort((a, b) => a.number - b.number);
    const known = row
      ? [['Protocol', row.protocol ?? '–'], ['State', row.complete ? `${row.state} (complete)` : row.state ?? '–'],
        ['Letters', row.letters], ['Violations', row.violations, row.violations > 0]]
      : [['State', 'unknown: it began before this page observed the domain, or is forgotten', true]];
    about.replaceChildren(...facts(known));
    const violations = all.filter((letter) => letter.violation);
    found.replaceChildren(...violations.map((letter) => element('p', { class: 'bad-text' },
      `${clock(letter.time)}: ${letter.violation}`)));
    diagram.replaceChildren(sequence(all));
    showMachine(machine, machineBox, row);
    letters.show(sections.letters ?? {});
  };
  return { node, path: `conversation?id=${encodeURIComponent(id)}`, update };
}
