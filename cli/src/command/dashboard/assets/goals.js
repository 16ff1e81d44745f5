// The goals that agents run, and their cancel.

import { clock, element, link, table } from './elements.js';
import { post } from './live.js';

const COLUMNS = [
  { title: 'Action' }, { title: 'Robot' }, { title: 'Progress' }, { title: 'Since', class: 'optional' }, { title: '' },
];
const CANCELLED_COLUMNS = [
  { title: 'Time' }, { title: 'Action' }, { title: 'By' }, { title: 'Outcome' },
];

function progress(row) {
  const percent = row.fraction === null ? null : Math.round(row.fraction * 100);
  return [
    percent === null ? null : element('progress', { max: 100, value: percent, 'aria-label': `${row.action} of ${row.robot}` }),
    element('div', {}, [percent === null ? row.state : `${percent} %`, percent !== null && row.state !== 'executing' ? row.state : null, row.note]
      .filter(Boolean).join(' · ')),
    row.answered ? null : element('div', { class: 'bad-text' }, 'the robot does not answer'),
  ];
}

function cancelledRow(row) {
  return element('tr', {},
    element('td', { class: 'short' }, clock(row.time)),
    element('td', { class: 'act' }, row.action ?? row.goal, element('div', { class: 'faint' }, 'of ', link('agent', row.robot)),
      element('div', { class: 'faint' }, 'for ', link('agent', row.client))),
    element('td', { class: 'name' }, link('agent', row.by)), element('td', {}, row.reason ?? row.state));
}

/** Tables of goals: those that run, and those that pages cancel. */
export function goalTables() {
  const pending = new Set();
  const result = element('p', { role: 'status' });
  const cancel = async (row, key, button) => {
    pending.add(key);
    button.disabled = true;
    result.textContent = `cancelling ${row.action} of ${row.robot}`;
    const { robot, goal, client } = row;
    const answer = await post('api/cancel', { robot, goal, client });
    // The row of a goal that has ended disappears. A row that has changed has another button.
    if (!answer.ok) {
      pending.delete(key);
      const buttons = [...running.node.querySelectorAll('button')];
      buttons.filter((shown) => shown.dataset.key === key).forEach((shown) => { shown.disabled = false; });
    }
    const ended = answer.ok ? await answer.json() : null;
    result.textContent = ended
      ? `${ended.action} of ${ended.robot}: ${ended.reason ?? ended.state}`
      : `${row.action} of ${row.robot} is not cancelled: ${(await answer.text()).trim()}`;
  };
  const goalRow = (row, key) => {
    const button = element('button', { type: 'button', 'data-key': key, disabled: pending.has(key) }, 'Cancel');
    button.addEventListener('click', () => cancel(row, key, button));
    const act = row.may_cancel ? button
      : row.may_cancel === false ? element('span', { class: 'faint' }, `not permitted by ${row.robot}`) : null;
    return element('tr', { class: row.answered ? null : 'bad' },
      element('td', { class: 'name' }, row.action,
        element('div', { class: 'faint' }, 'for ', link('agent', row.client)),
        element('div', { class: 'faint optional' }, row.goal)),
      element('td', {}, link('agent', row.robot)), element('td', {}, progress(row)),
      element('td', { class: 'optional' }, clock(row.since)),
      element('td', { class: 'act' }, act));
  };
  const running = table('Running goals, asked every second', COLUMNS, goalRow);
  const cancelled = table('Cancels from pages of this gateway, the newest first', CANCELLED_COLUMNS, cancelledRow);
  const none = element('p', { class: 'faint' }, 'no agent runs an action');
  const cancelledBox = element('div', { class: 'card', hidden: true }, cancelled.node);
  const update = (sections) => {
    const goals = Object.entries(sections.goals ?? {}).sort(([a], [b]) => (a < b ? -1 : 1));
    const focused = document.activeElement?.dataset.key;
    for (const key of pending) if (!(key in (sections.goals ?? {}))) pending.delete(key);
    running.rows.show(goals);
    // A row that changes gets another button.
    if (focused) [...running.node.querySelectorAll('button')].find((button) => button.dataset.key === focused)?.focus();
    running.node.hidden = goals.length === 0;
    none.hidden = goals.length > 0;
    const ended = Object.entries(sections.cancelled ?? {});
    cancelled.rows.show(ended.sort(([a], [b]) => Number(b) - Number(a)));
    cancelledBox.hidden = ended.length === 0;
  };
  const node = element('div', { class: 'stack' }, element('div', { class: 'card' }, running.node, none, result), cancelledBox);
  return { node, update };
}
