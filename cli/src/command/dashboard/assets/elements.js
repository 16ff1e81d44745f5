// Elements are made with text nodes only: no name of an agent becomes markup.

const SVG = 'http://www.w3.org/2000/svg';

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === 'on') for (const [event, handler] of Object.entries(value)) node.addEventListener(event, handler);
    else node.setAttribute(name, value === true ? '' : String(value));
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}

export function element(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

export function drawing(name, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

/** A number of things. */
export function count(number, thing) {
  return `${number} ${thing}${number === 1 ? '' : 's'}`;
}

/** A link to a view. */
export function link(view, name, text = name) {
  return element('a', { href: `#/${view}/${encodeURIComponent(name)}` }, text);
}

/** The parts of a list of facts: of each the title, the value, and whether it is bad. */
export function facts(list) {
  return list.map(([title, value, isBad = false]) => element('div', {},
    element('dt', {}, title), element('dd', { class: isBad ? 'bad-text' : null }, value)));
}

/** Time for rows in one frame, in milliseconds. Further rows follow in the next frames, so that the page answers. */
const SLICE = 8;
/** The tables with rows to draw. */
const waiting = new Set();
let due = 0;

function work() {
  due = 0;
  const end = performance.now() + SLICE;
  for (const rows of waiting) {
    if (!rows.work(end)) break;
    waiting.delete(rows);
  }
  if (waiting.size > 0) due = requestAnimationFrame(work);
}

/** Makes a row like another one. The cells that are equal stay, and with them focus and selection. */
function patch(row, next) {
  row.className = next.className;
  [...next.children].forEach((cell, index) => {
    if (!row.children[index].isEqualNode(cell)) row.children[index].replaceWith(cell);
  });
}

/**
 * The body of a table whose rows have keys. A row whose value is the same object as before keeps its nodes, so that
 * focus, selection and the place of scrolling stay.
 */
export class Rows {
  constructor(body, draw, isPatched = false) {
    this.body = body;
    this.draw = draw;
    this.isPatched = isPatched;
    this.shown = new Map();
    this.next = null;
    this.steps = null;
  }

  /** Shows these rows, pairs of key and value, in this order: from the next frame on, and completely. */
  show(rows) {
    this.next = rows;
    waiting.add(this);
    due ||= requestAnimationFrame(work);
  }

  /** Draws until a time. Returns whether all rows are shown. */
  work(end) {
    while (this.steps || this.next) {
      this.steps ??= this.drawing();
      while (!this.steps.next().done) if (performance.now() >= end) return false;
      this.steps = null;
    }
    return true;
  }

  /** Shows the next rows, one a step. */
  * drawing() {
    const rows = this.next;
    this.next = null;
    const keys = new Set(rows.map(([key]) => key));
    for (const [key, { node }] of this.shown) {
      if (keys.has(key)) continue;
      node.remove();
      this.shown.delete(key);
    }
    let place = this.body.firstChild;
    for (const [key, value] of rows) {
      const before = this.shown.get(key);
      let node = before?.node;
      if (before?.value !== value) {
        const drawn = this.draw(value, key);
        if (before && this.isPatched) patch(node, drawn);
        else {
          before?.node.replaceWith(drawn);
          if (before && place === before.node) place = drawn;
          node = drawn;
        }
      }
      if (node === place) place = place.nextSibling;
      else this.body.insertBefore(node, place);
      this.shown.set(key, { node, value });
      yield;
    }
  }
}

/** A table with a caption for readers of the screen, in a box that scrolls sideways. */
export function table(caption, columns, draw) {
  const heads = columns.map((column) => element('th', { scope: 'col', class: column.class }, column.title));
  const body = element('tbody');
  const node = element('div', { class: 'wide' },
    element('table', {}, element('caption', {}, caption), element('thead', {}, element('tr', {}, heads)), body));
  return { node, rows: new Rows(body, draw) };
}

/**
 * A table for thousands of rows: the browser lays out only those in sight. Columns have the widths of the style sheet.
 * Cells must not have handlers that depend on the value.
 */
export function longTable(caption, columns, draw) {
  // The boxes are no boxes of a table, so the roles are written down.
  const role = (node, ofChildren) => {
    node.setAttribute('role', 'row');
    for (const cell of node.children) cell.setAttribute('role', ofChildren);
    return node;
  };
  const { node } = table(caption, columns, draw);
  node.classList.add('long');
  node.querySelector('table').setAttribute('role', 'table');
  const [head, body] = node.querySelectorAll('thead, tbody');
  for (const group of [head, body]) group.setAttribute('role', 'rowgroup');
  role(head.firstChild, 'columnheader');
  return { node, rows: new Rows(body, (value, key) => role(draw(value, key), 'cell'), true) };
}

/** The violations and failures of an agent or a conversation. */
export function problems({ violations, failures }) {
  const found = [];
  if (violations) found.push(count(violations, 'violation'));
  if (failures) found.push(`${failures} not delivered`);
  return found.join(', ');
}

export function rate(value) {
  return value === undefined || value === null ? '' : value >= 100 ? value.toFixed(0) : value.toFixed(1);
}

export function span(micros) {
  if (micros === undefined || micros === null) return '';
  if (micros < 1000) return `${micros} µs`;
  if (micros < 1_000_000) return `${(micros / 1000).toPrecision(3)} ms`;
  return `${(micros / 1_000_000).toPrecision(3)} s`;
}

export function seconds(value) {
  if (value === undefined || value === null) return '';
  if (value < 120) return `${value} s`;
  if (value < 7200) return `${Math.round(value / 60)} min`;
  return `${Math.round(value / 3600)} h`;
}

/** The time of day of a time in RFC 3339. */
export function clock(time) {
  if (!time) return '';
  const date = new Date(time);
  return Number.isNaN(date.getTime()) ? time : date.toLocaleTimeString([], { hour12: false });
}
